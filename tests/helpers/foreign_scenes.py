"""Scenes as other programs write them: plain writers after each program's rules, from known
Gaussians with y down and z forward.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import math
import struct
import zipfile
from typing import Any

import numpy as np
import torch
from PIL import Image

from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians, quat_from_matrix, quat_to_matrix
from spackle.core.spherical_harmonics import harmonics_of

C0 = 0.28209479177387814
Files = dict[str, bytes]  # by name; the first one is the scene
Array = np.ndarray[Any, Any]


class Columns:
    """The numbers of Gaussians in float64, in the units of INRIA's PLY."""

    def __init__(self, gaussians: Gaussians) -> None:
        m, q, s, o, c = (tensor.double() for tensor in gaussians.with_harmonics_count(0).tensors)
        self.count = len(gaussians)
        self.means = m.numpy()
        self.quats = torch.nn.functional.normalize(q, dim=1).numpy()  # wxyz
        self.logs = s.log().numpy()
        self.logits = torch.logit(o).numpy()
        self.opacities = o.numpy()
        self.srgb = linear_to_srgb(c).numpy()
        self.harmonics = (self.srgb - 0.5) / C0
        self.rest = None  # [N, K, 3] coefficients of the degrees 1 to 3
        if gaussians.harmonics is not None:
            self.rest = gaussians.harmonics.double().numpy()


def turned(columns: Columns, axes: Array) -> tuple[Array, Array]:
    """Means and quaternions (wxyz) along other axes; `axes` [3, 3] has old axes as columns."""
    sign = round(float(np.linalg.det(axes)))
    rotation = torch.from_numpy(sign * axes) @ quat_to_matrix(torch.from_numpy(columns.quats))
    return columns.means @ axes.T, quat_from_matrix(rotation).numpy()


def turned_rest(rest: Array, axes: Array) -> Array:
    """Coefficients [N, K, 3] of the same functions of directions along other axes.

    They are found from the functions' values in many directions.
    """
    degree = math.isqrt(rest.shape[1] + 1) - 1
    generator = torch.Generator().manual_seed(1)
    directions = torch.randn(100, 3, dtype=torch.float64, generator=generator)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    values = np.einsum("dk,nkc->dnc", harmonics_of(directions, degree).numpy(), rest)
    basis = harmonics_of(directions @ torch.from_numpy(axes.T), degree).numpy()
    found = np.linalg.lstsq(basis, values.reshape(len(values), -1), rcond=None)[0]
    return found.reshape(-1, len(rest), 3).transpose(1, 0, 2)


# ---------------------------------------------------------------- PLY


def inria_table(gaussians: Gaussians, harmonics: int = 45) -> dict[str, Array]:
    """The columns of INRIA's PLY, in its order."""
    c = Columns(gaussians)
    zero = np.zeros(c.count)
    table = {name: c.means[:, i] for i, name in enumerate("xyz")}
    table |= {f"n{name}": zero for name in "xyz"}
    table |= {f"f_dc_{i}": c.harmonics[:, i] for i in range(3)}
    rest = np.stack([zero + 0.01 * i for i in range(harmonics)], 1) if harmonics else c.means[:, :0]
    if c.rest is not None:
        rest = c.rest.transpose(0, 2, 1).reshape(c.count, -1)
    table |= {f"f_rest_{i}": values for i, values in enumerate(rest.T)}
    table |= {"opacity": c.logits}
    table |= {f"scale_{i}": c.logs[:, i] for i in range(3)}
    return table | {f"rot_{i}": c.quats[:, i] for i in range(4)}


def ply(
    table: dict[str, Array],
    *,
    types: dict[str, str] | None = None,
    default: str = "float",
    order: str = "<",
    text: bool = False,
    comments: tuple[str, ...] = (),
    line_end: str = "\n",
    after: str = "",
) -> bytes:
    """A PLY file; `types` gives PLY's names of the types that are not the default."""
    types = types or {}
    codes = {"float": "f4", "double": "f8", "uchar": "u1", "ushort": "u2", "int": "i4"}
    named = {name: types.get(name, default) for name in table}
    count = len(next(iter(table.values())))
    form = "ascii" if text else {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    lines = ["ply", f"format {form} 1.0", *(f"comment {line}" for line in comments)]
    lines += [f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind in named.items()]
    lines += [*after.splitlines(), "end_header"]
    head = "".join(line + line_end for line in lines).encode()
    if text:
        rows = [
            " ".join(
                str(int(value)) if named[name] in ("uchar", "int") else repr(float(value))
                for name, value in zip(table, row, strict=True)
            )
            for row in zip(*table.values(), strict=True)
        ]
        return head + ("\n".join(rows) + "\n").encode()
    rows = np.zeros(count, [(name, order + codes[kind]) for name, kind in named.items()])
    for name, values in table.items():
        rows[name] = values
    return head + rows.tobytes()


# ---------------------------------------------------------------- SPZ


def spz(
    gaussians: Gaussians,
    version: int,
    *,
    degree: int = 0,
    axes: int = 0,
    basis: Array | None = None,
    bounds: tuple[float, float] | None = None,
) -> bytes:
    """An SPZ file; `axes` is the number of the axes in an extension, `basis` these axes [3, 3].

    Harmonics are those of the Gaussians, or any of a degree; another extension has their `bounds`.
    """
    c = Columns(gaussians)
    basis = np.diag([1.0, -1, -1]) if basis is None else basis
    means, quats = turned(c, basis)
    if version == 1:
        places = means.astype("<f2").tobytes()
    else:
        numbers = np.round(means * 4096).astype("<i4")
        places = numbers.view(np.uint8).reshape(-1, 4)[:, :3].tobytes()
    opacities = np.round(c.opacities * 255).astype(np.uint8).tobytes()
    colors = np.clip(np.round((0.5 + 0.15 * c.harmonics) * 255), 0, 255).astype(np.uint8)
    scales = np.clip(np.round((c.logs + 10) * 16), 0, 255).astype(np.uint8).tobytes()
    xyzw = quats[:, [1, 2, 3, 0]]
    if version < 3:
        xyz = xyzw[:, :3] * np.where(xyzw[:, 3:] < 0, -1, 1)
        rotations = np.clip(np.round(xyz * 127.5 + 127.5), 0, 255).astype(np.uint8).tobytes()
    else:
        rotations = b"".join(struct.pack("<I", smallest_three(q)) for q in xyzw)
    harmonics = bytes(range(100)) * c.count
    harmonics = harmonics[: c.count * 3 * ((degree + 1) ** 2 - 1)]
    if c.rest is not None:
        rest = turned_rest(c.rest, basis)
        degree = math.isqrt(rest.shape[1] + 1) - 1
        low, high = bounds or (-1, 255 / 128 - 1)
        codes = np.clip(np.round((rest - low) / (high - low) * 255), 0, 255)
        harmonics = codes.astype(np.uint8).tobytes()
    parts = [places, opacities, colors.tobytes(), scales, rotations, harmonics]

    flags = 2 if axes or bounds else 0
    extension = struct.pack("<II4xIII", 0x12340001, 4, 0xADBE0003, 4, axes) if axes else b""
    if bounds:
        extension += struct.pack("<IIBBff", 0xADBE0001, 10, 8, 8, *bounds)
    head = struct.pack("<4sIIBBB", b"NGSP", version, c.count, degree, 12, flags)
    if version < 4:
        return gzip.compress(head + b"\0" + b"".join(parts) + extension)
    parts = [part for part in parts if part]
    frames = [zstd_frame(part) for part in parts]
    table = b"".join(struct.pack("<QQ", len(f), len(p)) for f, p in zip(frames, parts, strict=True))
    start = 32 + len(extension)
    head += struct.pack("<BI12x", len(parts), start)
    return head + extension + table + b"".join(frames)


def smallest_three(xyzw: Array) -> int:
    """The word of 32 bits of a quaternion in SPZ 3."""
    largest = int(np.abs(xyzw).argmax())
    word = largest
    for index in range(4):
        if index != largest:
            value = xyzw[index] * (-1 if xyzw[largest] < 0 else 1)
            size = min(511, round(abs(value) * 511 * math.sqrt(2)))
            word = word << 10 | (512 if value < 0 else 0) | size
    return word


def zstd_frame(data: bytes) -> bytes:
    """A Zstandard frame without compression: a header, and blocks of raw bytes (RFC 8878)."""
    frame = struct.pack("<IBI", 0xFD2FB528, 0b10100000, len(data))  # one segment, size of 4 bytes
    blocks = [data[start : start + 65_536] for start in range(0, len(data), 65_536)] or [b""]
    for index, block in enumerate(blocks):
        is_last = index == len(blocks) - 1
        frame += (len(block) << 3 | is_last).to_bytes(3, "little") + block
    return frame


# ---------------------------------------------------------------- SOG


def sog(gaussians: Gaussians, version: int, *, bands: int = 0) -> Files:
    """The files of an unbundled SOG scene, the description first.

    Harmonics are those of the Gaussians, or zeros for as many `bands`.
    """
    c = Columns(gaussians)
    width = math.ceil(math.sqrt(c.count))
    logs = np.sign(c.means) * np.log1p(np.abs(c.means))
    means, means_bounds = fractions(logs, 65_535)
    quats = np.zeros((c.count, 4))
    for row, q in zip(quats, c.quats, strict=True):
        largest = int(np.abs(q).argmax())
        others = np.delete(q, largest) * (-1 if q[largest] < 0 else 1)
        row[:] = [*np.round((others / math.sqrt(2) + 0.5) * 255), 252 + largest]
    meta: dict[str, Any] = {"means": {**means_bounds, "files": ["means_l.webp", "means_u.webp"]}}
    meta["quats"] = {"files": ["quats.webp"]}
    if version == 2:
        book = np.linspace(c.logs.min(), c.logs.max(), 256)
        scales = np.abs(c.logs[..., None] - book).argmin(-1)
        meta |= {"version": 2, "count": c.count, "asset": {"generator": "a program 1.0"}}
        meta["scales"] = {"codebook": book.tolist(), "files": ["scales.webp"]}
        book = np.linspace(c.harmonics.min(), c.harmonics.max(), 256)
        colors = np.abs(c.harmonics[..., None] - book).argmin(-1)
        meta["sh0"] = {"codebook": book.tolist(), "files": ["sh0.webp"]}
        opacities = np.round(c.opacities * 255)[:, None]
        sh0 = np.concatenate([colors, opacities], axis=1)
    else:
        meta["means"] |= {"shape": [c.count, 3], "dtype": "float32"}
        scales, bounds = fractions(c.logs, 255)
        meta["scales"] = {**bounds, "shape": [c.count, 3], "files": ["scales.webp"]}
        sh0, bounds = fractions(np.concatenate([c.harmonics, c.logits[:, None]], axis=1), 255)
        meta["sh0"] = {**bounds, "shape": [c.count, 1, 4], "files": ["sh0.webp"]}
    rest = c.rest
    if rest is None:
        rest = np.zeros((c.count, (bands + 1) ** 2 - 1, 3))
    bands = math.isqrt(rest.shape[1] + 1) - 1
    centroids = np.zeros((0, 0, 4), np.uint8)
    if bands:
        # A palette of all Gaussians, in the opposite order; 64 of them side by side.
        entries = rest[::-1]
        low, high = float(rest.min()), float(rest.max())
        codes = np.round((entries - low) / max(high - low, 1e-9) * 255).astype(np.uint8)
        rows = math.ceil(c.count / 64)
        centroids = np.full((rows * 64 * rest.shape[1], 4), 255, np.uint8)
        centroids[: codes.shape[0] * codes.shape[1], :3] = codes.reshape(-1, 3)
        centroids = centroids.reshape(rows, 64 * rest.shape[1], 4)
        meta["shN"] = {"files": ["c.webp", "l.webp"]}
        if version == 2:
            book = np.linspace(low, high, 256).tolist()
            meta["shN"] |= {"count": c.count, "bands": bands, "codebook": book}
        else:
            shape = [c.count, 3 * rest.shape[1]]
            meta["shN"] |= {"shape": shape, "mins": low, "maxs": high, "quantization": 8}
    pictures = {"means_l.webp": means % 256, "means_u.webp": means // 256}
    pictures |= {"quats.webp": quats, "scales.webp": scales, "sh0.webp": sh0}
    if bands:
        labels = np.arange(c.count)[::-1]
        pictures["l.webp"] = np.stack([labels % 256, labels // 256], axis=1)
    files = {"meta.json": json.dumps(meta).encode()}
    if bands:
        stream = io.BytesIO()
        Image.fromarray(centroids).save(stream, "WEBP", lossless=True, exact=True)
        files["c.webp"] = stream.getvalue()
    for name, values in pictures.items():
        pixels = np.full((width * width, 4), 255, np.uint8)
        pixels[: c.count, : values.shape[1]] = values
        stream = io.BytesIO()
        Image.fromarray(pixels.reshape(width, width, 4)).save(
            stream, "WEBP", lossless=True, exact=True
        )
        files[name] = stream.getvalue()
    return files


def fractions(values: Array, largest: int) -> tuple[Array, dict[str, list[float]]]:
    """Codes 0 to `largest` between the bounds of each column, and these bounds."""
    low, high = values.min(0), values.max(0)
    codes = np.round((values - low) / (high - low) * largest)
    return codes, {"mins": low.tolist(), "maxs": high.tolist()}


def zipped(files: Files, folder: str = "") -> bytes:
    """A zip archive of files, within a folder of the archive."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(folder + name, content)
    return stream.getvalue()


# ---------------------------------------------------------------- glTF

LEFT_UP_FRONT = np.diag([-1.0, -1, 1])
CODES = {"f4": 5126, "i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123}
KHR = "KHR_gaussian_splatting"


class Gltf:
    """A glTF file with one primitive, to which arrays are added."""

    def __init__(self, generator: str = "a program 1.0") -> None:
        self.primitive: dict[str, Any] = {"mode": 0, "attributes": {}, "extensions": {}}
        self.node: dict[str, Any] = {"mesh": 0}
        self.description: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": generator},
            "extensionsUsed": [KHR],
            "scenes": [{"nodes": [0]}],
            "nodes": [self.node],
            "meshes": [{"primitives": [self.primitive]}],
            "accessors": [],
            "bufferViews": [],
        }
        self.body = b""

    def view(self, data: bytes) -> int:
        """Add bytes; returns the index of their view."""
        views = self.description["bufferViews"]
        views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data)})
        self.body += data + b"\0" * (-len(data) % 4)
        return len(views) - 1

    def add(self, name: str, values: Array, kind: str = "f4", *, normalized: bool = False) -> None:
        """Add an array; normalised whole numbers are fractions of the largest one."""
        values = np.asarray(values, np.float64)
        values = values.reshape(len(values), -1)
        if normalized:
            values = np.round(values * np.iinfo(kind).max)
        data = np.ascontiguousarray(values.astype("<" + kind))
        width = data.shape[1]
        row = data.itemsize * width
        padded = np.zeros((len(data), row + -row % 4), np.uint8)  # rows begin at multiples of 4
        padded[:, :row] = data.view(np.uint8).reshape(len(data), -1)
        accessor = {"bufferView": self.view(padded.tobytes()), "componentType": CODES[kind]}
        accessor |= {"count": len(data), "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width]}
        if normalized:
            accessor["normalized"] = True
        if padded.shape[1] != row:
            self.description["bufferViews"][-1]["byteStride"] = padded.shape[1]
        self.primitive["attributes"][name] = len(self.description["accessors"])
        self.description["accessors"].append(accessor)

    def glb(self) -> bytes:
        """The file as one."""
        self.description["buffers"] = [{"byteLength": len(self.body)}]
        text = json.dumps(self.description).encode()
        text += b" " * (-len(text) % 4)
        size = 12 + 8 + len(text) + 8 + len(self.body)
        head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self.body), b"BIN\0") + self.body

    def gltf(self, address: str | None = None) -> bytes:
        """The JSON, with the arrays in it, or at an address."""
        if address is None:
            address = "data:application/octet-stream;base64,"
            address += base64.b64encode(self.body).decode()
        self.description["buffers"] = [{"byteLength": len(self.body), "uri": address}]
        return json.dumps(self.description).encode()


def khr_gltf(gaussians: Gaussians, *, log_scales: bool = False, quantized: bool = False) -> Gltf:
    """Gaussians as KHR_gaussian_splatting stores them; its first drafts had logarithms."""
    c = Columns(gaussians)
    file = Gltf()
    means, quats = turned(c, LEFT_UP_FRONT)
    file.primitive["extensions"] = {KHR: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    whole = {"normalized": True} if quantized else {}
    file.add("POSITION", means)
    file.add(f"{KHR}:ROTATION", quats[:, [1, 2, 3, 0]], "i2" if quantized else "f4", **whole)
    file.add(f"{KHR}:SCALE", c.logs if log_scales else np.exp(c.logs))
    file.add(f"{KHR}:OPACITY", c.opacities, "u2" if quantized else "f4", **whole)
    file.add(f"{KHR}:SH_DEGREE_0_COEF_0", c.harmonics)
    if c.rest is not None:
        rest = turned_rest(c.rest, LEFT_UP_FRONT)
        names = [(degree, order) for degree in (1, 2, 3) for order in range(2 * degree + 1)]
        for index, (degree, order) in enumerate(names[: rest.shape[1]]):
            file.add(f"{KHR}:SH_DEGREE_{degree}_COEF_{order}", rest[:, index])
    return file


def draft_gltf(gaussians: Gaussians) -> Gltf:
    """Gaussians as the earliest draft of the extension stored them."""
    c = Columns(gaussians)
    file = Gltf()
    means, quats = turned(c, LEFT_UP_FRONT)
    file.primitive["extensions"] = {KHR: {}}
    file.add("POSITION", means)
    file.add("_ROTATION", quats[:, [1, 2, 3, 0]])
    file.add("_SCALE", np.exp(c.logs))
    rgba = np.concatenate([c.srgb, c.opacities[:, None]], axis=1)
    file.add("COLOR_0", rgba, "u1", normalized=True)
    return file


def spz_gltf(gaussians: Gaussians, name: str, version: int) -> Gltf:
    """An SPZ file within glTF, under one of the names that its extension has had."""
    file = Gltf()
    holder = {name: {"bufferView": file.view(spz(gaussians, version))}}
    is_inner = name.startswith(KHR)
    file.primitive["extensions"] = {KHR: {"extensions": holder}} if is_inner else holder
    return file
