"""Write Gaussians in INRIA's PLY layout, and read the layouts of INRIA, SHARP and PlayCanvas."""

from __future__ import annotations

import dataclasses
import math
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.formats.camera_files import checked_camera
from spackle.formats.scene_files import SH_C0, GaussianColumns, SceneFile, function_named
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import atomic_path, check_file

MAX_HEADER_BYTES = 1 << 16
MAX_EXTRA_ROWS = 64  # larger tables than this hold no camera

_TYPES = "char uchar short ushort int uint float double int8 uint8 int16 uint16 int32 uint32 float32 float64"
_CODES = dict(
    zip(_TYPES.split(), ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"] * 2, strict=True)
)
_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}

SMALLEST_OPACITY, LARGEST_OPACITY = 1e-12, 1 - 2.0**-24  # bounds that keep the logit finite

# Gaussians that are converted at a time. Blocks are padded to full size, so that a row's bits depend neither on the
# rows after it nor on the number of threads.
ROWS_PER_BLOCK = 8192

_READ = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_READ += ["rot_0", "rot_1", "rot_2", "rot_3"]
_WRITTEN = [*_READ[:3], "nx", "ny", "nz", *_READ[3:]]
_SLICES = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 7),
    slice(7, 10),
    slice(10, 14),
)  # means, f_dc, opacity, scales, rot

StrPath = str | os.PathLike[str]


def save_ply(
    gaussians: Gaussians,
    path: StrPath,
    *,
    camera: Camera | None = None,
    base_count: int | None = None,
    disparity: float | None = None,
) -> None:
    """Write a binary PLY that viewers of 3D Gaussian splatting read.

    The one element, `vertex`, is float32: x y z, normals of zero, f_dc from the sRGB colour, opacity as logit, scales
    as logarithms, rot as unit quaternion wxyz. Each row depends only on its Gaussian. Comments in the header keep
    `camera`, `base_count` and `disparity`.

    Args:
        camera: the photo's camera, at the world's origin.
        base_count: the number of base Gaussians, which come first.
        disparity: the disparity for which the scene was completed, see `spackle.core.trajectories.disparity_to_offset`.

    Raises:
        InputError: `path` cannot be written.
        ValueError: a Gaussian is not finite.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.writelines(_written(gaussians, camera, base_count, disparity))


def encode_ply(scene: SceneFile) -> bytes:
    """Encode a scene as `save_ply` does; ValueError if a Gaussian is not finite."""
    return b"".join(
        _written(scene.gaussians, scene.untilted_camera, scene.base_count, scene.disparity)
    )


def _written(
    gaussians: Gaussians, camera: Camera | None, base_count: int | None, disparity: float | None
) -> Iterator[bytes]:
    """The header, then the rows, BLOCK at a time."""
    vertex = ("vertex", len(gaussians), "float", _WRITTEN)
    yield ply_header(vertex, camera=camera, base_count=base_count, disparity=disparity)
    gaussians = gaussians.detach().to("cpu", torch.float32)
    surplus = Gaussians(*(torch.zeros(ROWS_PER_BLOCK, *t.shape[1:]) for t in gaussians.tensors))
    table = np.zeros((ROWS_PER_BLOCK, len(_WRITTEN)), "<f4")
    for start in range(0, len(gaussians), ROWS_PER_BLOCK):
        block = gaussians.select(slice(start, start + ROWS_PER_BLOCK))
        columns = GaussianColumns.of(
            Gaussians.cat([block, surplus.select(slice(len(block), ROWS_PER_BLOCK))])
        )
        opacities = np.clip(columns.opacities, SMALLEST_OPACITY, LARGEST_OPACITY)
        table[:, 0:3], table[:, 6:9], table[:, 13:17] = (
            columns.means,
            columns.harmonics,
            columns.quats,
        )
        table[:, 9] = np.log(opacities / (1 - opacities))  # 1 - o is exact above one half
        table[:, 10:13] = columns.log_scales
        yield table[: len(block)].tobytes()


def ply_header(
    *tables: tuple[str, int, str, Sequence[str]],
    camera: Camera | None = None,
    base_count: int | None = None,
    disparity: float | None = None,
) -> bytes:
    """The header of a binary file; each table is (name, number of rows, type, properties)."""
    lines = ["ply", "format binary_little_endian 1.0"]
    if camera is not None:
        numbers = [*camera.focal, *camera.K[:2, 2].tolist(), camera.width, camera.height]
        lines.append(f"comment spackle_camera {' '.join(map(repr, numbers))}")
    for comment, number in (("spackle_base", base_count), ("spackle_disparity", disparity)):
        lines += [] if number is None else [f"comment {comment} {number!r}"]
    for name, count, kind, properties in tables:
        lines += [f"element {name} {count}", *(f"property {kind} {each}" for each in properties)]
    return "\n".join([*lines, "end_header", ""]).encode()


def load_ply(path: StrPath) -> Gaussians:
    """Read Gaussians from a binary PLY file of INRIA's, SHARP's or PlayCanvas's layout; see `PlyFile.gaussians`."""
    return PlyFile(path).gaussians()


@dataclasses.dataclass
class Element:
    """One table of a PLY file."""

    name: str
    count: int
    fields: list[tuple[str, str]] = dataclasses.field(
        default_factory=list
    )  # (name, NumPy type or "list")
    start: int = -1  # offset in the file, in bytes; -1 from the first table with lists on


class PlyFile:
    """A binary PLY file's header, and its tables up to the first one with lists.

    InputError if the file is no PLY file, has an endless or broken header, or is too short for its tables.
    """

    def __init__(self, path: StrPath) -> None:
        self.path, self._size = path, check_file(path, "PLY file")
        self.elements: list[Element] = []
        self.comments: dict[str, list[str]] = {}  # first word → the other words
        with open(path, "rb") as file:
            head = file.read(MAX_HEADER_BYTES)
        if head.split(b"\n", 1)[0].rstrip() != b"ply":
            raise InputError(
                f"{path}: not a PLY file: its first line must be 'ply' (`spackle predict` makes one)"
            )
        end = re.search(rb"\n[ \t]*end_header[ \t\r]*\n", head)
        if end is None:
            raise InputError(f"{path}: the header has no end: the file is damaged or cut off")
        with as_input_error(path, "broken PLY header: {reason}", ValueError, KeyError, IndexError):
            self._parse(head[: end.start()].decode("latin-1").split("\n")[1:])
            self._place_tables(end.end())

    def gaussians(self) -> Gaussians:
        """Read the scene; colours become linear RGB.

        Properties may have any order and type; spherical harmonics above degree 0 (f_rest) are ignored. SHARP's
        `color_space` states whether colours are sRGB (0) or linear (1). Without `color_space`, colours count as linear
        if the file has SHARP's camera (SHARP reads them so), else as sRGB.

        Raises:
            InputError: there are no Gaussians, or some contain NaN or inf. An infinite opacity logit is allowed: SHARP
                writes one for an opacity of 1.
        """
        vertex, extras = self._vertex(), self._extras()
        if chunks := [element for element in self.elements if element.name == "chunk"]:
            decode = function_named("spackle.formats.compressed_ply:decode_compressed_ply")
            with as_input_error(
                self.path, "the compressed tables cannot be read: {reason}: export the scene again"
            ):
                gaussians: Gaussians = decode(self._rows(chunks[0]), self._rows(vertex)).gaussians()
            return gaussians
        linear = (
            bool(extras["color_space"].any()) if "color_space" in extras else "intrinsic" in extras
        )
        parts = [torch.empty(vertex.count, columns.stop - columns.start) for columns in _SLICES]
        table, broken, whole = (
            np.zeros((len(_READ), ROWS_PER_BLOCK), np.float32),
            0,
            self._rows(vertex),
        )
        for start in range(0, vertex.count, ROWS_PER_BLOCK):
            rows = whole[start : start + ROWS_PER_BLOCK]
            with np.errstate(
                over="ignore", invalid="ignore"
            ):  # numbers beyond float32 become inf, and are counted
                for k, name in enumerate(_READ):
                    table[k, : len(rows)] = rows[name]
                table[7:10] = np.exp(table[7:10])
                rgb = torch.from_numpy(table[3:6] * np.float32(SH_C0) + np.float32(0.5))
            table[6:7] = torch.from_numpy(table[6:7]).sigmoid()
            broken += int(np.count_nonzero(~np.isfinite(table[:, : len(rows)]).all(axis=0)))
            table[3:6] = rgb.clamp_min(0) if linear else srgb_to_linear(rgb)
            for part, columns in zip(parts, _SLICES, strict=True):
                part[start : start + ROWS_PER_BLOCK] = torch.from_numpy(
                    table[columns, : len(rows)].T
                )
        if broken:
            raise InputError(
                f"{self.path}: {broken} of {vertex.count} Gaussians are not finite: export it again"
            )
        means, colors, opacities, scales, quats = parts
        return Gaussians(means, quats, scales, opacities[:, 0], colors)

    def camera(self) -> Camera | None:
        """The photo's camera, which SHARP stores after the Gaussians and `save_ply` in a comment.

        None if the file has no camera; InputError if the camera is invalid.
        """
        K, matrix = np.eye(3), np.eye(4)
        if numbers := self._numbers("spackle_camera", 6, lowest=-math.inf):
            K[0, 0], K[1, 1], K[0, 2], K[1, 2], width, height = numbers
        elif "intrinsic" in (extras := self._extras()):
            parts = [
                extras.get(name, np.empty(0)) for name in ("intrinsic", "extrinsic", "image_size")
            ]
            if [len(part) for part in parts] != [9, 16, 2]:
                raise InputError(
                    f"{self.path}: the stored camera is not as SHARP writes it: give the focal length"
                )
            K, matrix, (width, height) = parts[0].reshape(3, 3), parts[1].reshape(4, 4), parts[2]
        else:
            return None
        width, height = (int(side) if float(side).is_integer() else 0 for side in (width, height))
        where = f"{self.path}: the stored camera"
        return checked_camera(torch.from_numpy(K), torch.from_numpy(matrix), width, height, where)

    def base_count(self) -> int | None:
        """The number of base Gaussians, which come first; None for files of other programs.

        InputError if the file states more base Gaussians than it contains Gaussians.
        """
        numbers = self._numbers("spackle_base", 1, highest=self._vertex().count)
        return int(numbers[0]) if numbers else None

    def disparity(self) -> float | None:
        """The disparity for which the scene was completed; None if the file states none.

        InputError if the stored value is not a valid number.
        """
        numbers = self._numbers("spackle_disparity", 1)
        return numbers[0] if numbers else None

    def scene(self) -> SceneFile:
        """Read camera, counts, disparity and Gaussians; InputError if one of them is invalid."""
        rest = sum(
            name.startswith("f_rest_") for element in self.elements for name, _ in element.fields
        )
        known = self.camera(), self.base_count(), self.disparity()
        return SceneFile(Path(self.path), self.gaussians(), *known, harmonics=rest)

    def _parse(self, lines: list[str]) -> None:
        order = ""
        for words in map(str.split, lines):
            match words:
                case ["comment", name, *others]:
                    self.comments[name] = others
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", "ascii", _]:
                    raise ValueError("the file is text: export a binary PLY")
                case ["format", name, _]:
                    order = _ORDERS[name]
                case ["element", name, count] if int(count) >= 0:
                    self.elements.append(Element(name, int(count)))
                case ["property", "list", _, _, name]:
                    self.elements[-1].fields.append((name, "list"))
                case ["property", kind, name] if order:
                    self.elements[-1].fields.append((name, order + _CODES[kind]))
                case _:
                    raise ValueError(f"cannot understand the line {' '.join(words)[:80]!r}")
        if not order:
            raise ValueError("there is no format line")

    def _place_tables(self, start: int) -> None:
        """Set where each table starts; InputError if the file is too short."""
        for element in self.elements:
            if "list" in dict(element.fields).values():
                return
            element.start = start
            start += (
                element.count * np.dtype(element.fields).itemsize
            )  # ValueError for a name given twice
            if start > self._size:
                announced = f"{element.count} rows of {element.name!r} are announced"
                raise InputError(
                    f"{self.path}: cut off: {announced}, but the file ends after {self._size} bytes"
                )

    def _numbers(
        self, comment: str, count: int, lowest: float = 0, highest: float = math.inf
    ) -> list[float] | None:
        """The finite numbers in one of Spackle's comments; None if the file does not have this comment."""
        if (words := self.comments.get(comment)) is None:
            return None
        what = comment.removeprefix("spackle_")
        with as_input_error(self.path, f"the stored {what} makes no sense: {{reason}}", ValueError):
            numbers = [float(word) for word in words]
            if len(numbers) != count or not all(
                math.isfinite(n) and lowest <= n <= highest for n in numbers
            ):
                raise ValueError(" ".join(words))
        return numbers

    def _vertex(self) -> Element:
        """The element with the vertices; InputError if they are not Gaussians, or have no fixed size."""
        named = [element for element in self.elements if element.name == "vertex"]
        if len(named) != 1:
            raise InputError(
                f"{self.path}: holds {len(named)} elements called vertex: not a Gaussian scene"
            )
        read = PACKED if "packed_position" in dict(named[0].fields) else _READ
        missing = [name for name in read if name not in dict(named[0].fields)]
        if missing:
            raise InputError(
                f"{self.path}: not a Gaussian scene: its vertices have no {', '.join(missing)}"
            )
        if named[0].count == 0 or named[0].start < 0:
            problem = "no Gaussians" if named[0].count == 0 else "lists in or before its vertices"
            raise InputError(f"{self.path}: holds {problem}: export it as a plain Gaussian scene")
        return named[0]

    def _extras(self) -> dict[str, NDArray[np.float64]]:
        """The numbers in small tables, such as SHARP's camera, by their properties' names."""
        small = [
            element
            for element in self.elements
            if element.name != "vertex"
            and element.start >= 0
            and element.fields
            and element.count <= MAX_EXTRA_ROWS
        ]
        return {
            name: self._rows(each)[name].astype(np.float64)
            for each in small
            for name, _ in each.fields
        }

    def _rows(self, element: Element) -> NDArray[Any]:
        """The rows of a table, as a structured array."""
        return np.fromfile(self.path, element.fields, element.count, offset=element.start)
