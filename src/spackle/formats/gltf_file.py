"""The container of a glTF file: JSON, buffers and arrays. Knows nothing of Gaussians."""

from __future__ import annotations

import base64
import dataclasses
import json
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spackle.formats.gaussian_columns import Floats
from spackle.formats.scene_content import UnsupportedSceneError
from spackle.runtime.errors import short_repr

GLB_SIGNATURE = b"glTF"
GLB_HEADER = struct.Struct("<4sII")  # signature, version, bytes of the file
GLB_CHUNK = struct.Struct("<I4s")  # bytes and kind of a part

# NumPy's codes of glTF's types of numbers, and how many numbers an element of an array has.
COMPONENT_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
ELEMENT_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}

MAX_BUFFER_BYTES = 1 << 33  # of a file beside a .gltf; more than any scene's
# The extensions with which a part of a buffer may be compressed.
COMPRESSED_VIEWS = ("EXT_meshopt_compression", "KHR_meshopt_compression")


@dataclasses.dataclass
class GltfFile:
    """The JSON of a glTF file, and the arrays that it describes."""

    path: Path
    description: dict[str, Any]
    binary_part: bytes  # of a .glb; empty for a .gltf
    byte_count: int  # of the file, and of files beside it that were read so far
    _buffers: dict[int, bytes] = dataclasses.field(default_factory=dict)

    @staticmethod
    def read(path: Path) -> GltfFile:
        """Read a .glb or .gltf file; other files that it names are read when they are needed.

        Raises:
            UnsupportedSceneError: the file has the first version of glTF.
            Exception: any exception, if the file is damaged.
        """
        data = path.read_bytes()
        binary_part = b""
        json_part = data
        if data.startswith(GLB_SIGNATURE):
            json_part, binary_part = _split_glb(data)
        description = json.loads(json_part.decode("utf-8-sig"))
        if not isinstance(description, dict):
            raise ValueError("its JSON is no object")
        version = description.get("asset", {}).get("version", "2.0")
        if not str(version).startswith("2."):
            problem = f"glTF version {short_repr(version)} (version 2 is read)"
            raise UnsupportedSceneError(f"{problem}: save it as version 2, or as PLY")
        return GltfFile(path, description, binary_part, len(data))

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """Return an entry of one of the lists of the JSON, such as "nodes".

        Raises:
            ValueError, KeyError, IndexError: there is no such entry.
        """
        if not isinstance(index, int) or isinstance(index, bool) or index < 0:
            raise ValueError(f"{short_repr(index)} is no index of {kind}")
        entry = self.description[kind][index]
        if not isinstance(entry, dict):
            raise ValueError(f"{kind}[{index}] is no object")
        return entry

    def accessor_count(self, index: Any) -> int:
        """Return how many elements an array has."""
        return int(self.item("accessors", index)["count"])

    def array(self, index: Any) -> Floats:
        """Read an array [N, k] as floats; whole numbers become fractions if they are normalised.

        Raises:
            UnsupportedSceneError: the array is sparse, or compressed.
            ValueError: the array does not fit its buffer.
        """
        accessor = self.item("accessors", index)
        if "sparse" in accessor:
            raise UnsupportedSceneError("glTF with sparse arrays: save it without them, or as PLY")
        dtype = np.dtype(COMPONENT_TYPES[accessor["componentType"]])
        width = ELEMENT_WIDTHS[accessor["type"]]
        count = int(accessor["count"])
        view = self.item("bufferViews", accessor["bufferView"])
        data = self.view_bytes(accessor["bufferView"])

        start = int(accessor.get("byteOffset", 0))
        stride = int(view.get("byteStride", 0)) or dtype.itemsize * width
        end = start + stride * (count - 1) + dtype.itemsize * width
        if min(start, count - 1) < 0 or stride < dtype.itemsize * width or end > len(data):
            raise ValueError(f"an array of {count:,} elements does not fit its buffer")
        strided: NDArray[Any] = np.ndarray(
            (count, width), dtype, data, offset=start, strides=(stride, dtype.itemsize)
        )
        values = strided.astype(np.float32)
        # A normalised whole number is a fraction of the largest one; -128 counts as -127.
        if accessor.get("normalized") and dtype.kind in "iu":
            values = np.maximum(values / np.float32(np.iinfo(dtype).max), -1)
        return values

    def view_bytes(self, index: Any) -> memoryview:
        """Return a part of a buffer, which glTF calls a buffer view.

        Raises:
            UnsupportedSceneError: the part is compressed.
            ValueError: the part does not fit its buffer.
        """
        view = self.item("bufferViews", index)
        for name in COMPRESSED_VIEWS:
            if name in view.get("extensions", {}):
                advice = "save it without this compression, or as PLY"
                raise UnsupportedSceneError(f"glTF compressed with {name}: {advice}")
        buffer = self._buffer(view["buffer"])
        start = int(view.get("byteOffset", 0))
        byte_count = int(view["byteLength"])
        if min(start, byte_count) < 0 or start + byte_count > len(buffer):
            raise ValueError(f"a part of {byte_count:,} bytes does not fit its buffer")
        return memoryview(buffer)[start : start + byte_count]

    def _buffer(self, index: Any) -> bytes:
        """Read a buffer: the binary part of a .glb, a text in the JSON, or a file beside it."""
        address = self.item("buffers", index).get("uri")
        if address is None:
            return self.binary_part
        if index not in self._buffers:
            self._buffers[index] = self._read_address(str(address))
        return self._buffers[index]

    def _read_address(self, address: str) -> bytes:
        """Return the content of a data URI, or of a file in the folder of this file.

        Raises:
            UnsupportedSceneError: the address leads elsewhere, or the file is missing.
        """
        if address.startswith("data:"):
            return base64.b64decode(address.partition(",")[2], validate=True)
        name = urllib.parse.unquote(address)
        # A hostile file may not reach other files of this machine, nor the network.
        folder = self.path.parent.resolve()
        file = (folder / name).resolve()
        if "://" in name or not file.is_relative_to(folder):
            problem = f"its data are elsewhere, at {short_repr(address)}"
            raise UnsupportedSceneError(f"{problem}: put the file beside it")
        if not file.is_file() or file.stat().st_size > MAX_BUFFER_BYTES:
            problem = f"its data are in {short_repr(name)}, which is not there"
            raise UnsupportedSceneError(f"{problem}: put the file beside it")
        content = file.read_bytes()
        self.byte_count += len(content)
        return content


def _split_glb(data: bytes) -> tuple[bytes, bytes]:
    """Return the JSON and the binary part of a .glb file.

    Raises:
        UnsupportedSceneError: the file has the first version of the container.
        ValueError: the file is cut off.
    """
    _, version, byte_count = GLB_HEADER.unpack_from(data)
    if version != 2:
        problem = f"glTF version {version} (version 2 is read)"
        raise UnsupportedSceneError(f"{problem}: save it as version 2, or as PLY")
    if byte_count > len(data):
        raise ValueError(f"{byte_count:,} bytes are announced, but it ends after {len(data):,}")
    parts = {b"JSON": b"", b"BIN\0": b""}
    start = GLB_HEADER.size
    while start + GLB_CHUNK.size <= len(data):
        part_bytes, kind = GLB_CHUNK.unpack_from(data, start)
        start += GLB_CHUNK.size
        # Each kind counts once; parts of other kinds are skipped.
        if kind in parts and not parts[kind]:
            parts[kind] = data[start : start + part_bytes]
        start += part_bytes
    return parts[b"JSON"], parts[b"BIN\0"]
