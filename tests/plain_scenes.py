"""The plainest readers of the formats that scenes are exported to, straight from what their makers publish.

Each takes a file's bytes and gives rows of (means, quats wxyz, scales, opacity, sRGB) in the file's own axes.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import zipfile
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from PIL import Image

from spackle.color import srgb_to_linear
from spackle.gaussians import Gaussians

C0 = 0.28209479177387814
Row = tuple[Sequence[float], Sequence[float], Sequence[float], float, Sequence[float]]


def gaussians_of(rows: Iterator[Row], flipped: bool) -> Gaussians:
    """Rows as a scene; `flipped` turns y up, z backward into y down, z forward."""
    means, quats, scales, opacities, srgb = (torch.tensor(column) for column in zip(*rows, strict=True))
    if flipped:
        means, quats = means * torch.tensor([1, -1, -1]), quats * torch.tensor([1, 1, -1, -1])
    return Gaussians(means, quats, scales, opacities, srgb_to_linear(srgb))


def spz_rows(data: bytes) -> Iterator[Row]:
    raw = gzip.decompress(data)
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<4sIIBBBB", raw[:16])
    assert (magic, version, degree, flags, reserved) == (b"NGSP", 3, 0, 0, 0)
    assert len(raw) == 16 + 20 * count
    starts = [16 + count * width for width in (0, 9, 10, 13, 16)]
    for i in range(count):
        place, alpha, color, scale, turn = (
            raw[start + i * width : start + (i + 1) * width]
            for start, width in zip(starts, (9, 1, 3, 3, 4), strict=True)
        )
        means = [int.from_bytes(place[k : k + 3], "little", signed=True) / 2**bits for k in (0, 3, 6)]
        word = int.from_bytes(turn, "little")
        largest, xyzw = word >> 30, [0.0] * 4
        for k, axis in enumerate([axis for axis in range(4) if axis != largest]):
            part = word >> (10 * (2 - k)) & 1023
            xyzw[axis] = (-1 if part >> 9 else 1) * (part & 511) / 511 / math.sqrt(2)
        xyzw[largest] = math.sqrt(max(0, 1 - sum(v * v for v in xyzw)))
        srgb = [(v / 255 - 0.5) / 0.15 * C0 + 0.5 for v in color]
        yield means, [xyzw[3], *xyzw[:3]], [math.exp(v / 16 - 10) for v in scale], alpha[0] / 255, srgb


def splat_rows(data: bytes) -> Iterator[Row]:
    for row in struct.iter_unpack("<6f8B", data):
        yield row[:3], [(v - 128) / 128 for v in row[10:]], row[3:6], row[9] / 255, [v / 255 for v in row[6:9]]


def compressed_ply_rows(data: bytes) -> Iterator[Row]:
    head, body = data.split(b"end_header\n", 1)
    lines = [line for line in head.decode().splitlines() if not line.startswith("comment")]
    chunks, vertices = (int(line.split()[2]) for line in lines if line.startswith("element"))
    names = [line.split()[-1] for line in lines if line.startswith("property")]
    assert names[:6] == ["min_x", "min_y", "min_z", "max_x", "max_y", "max_z"]
    assert names[6:9] == ["min_scale_x", "min_scale_y", "min_scale_z"]
    assert names[12:18] == ["min_r", "min_g", "min_b", "max_r", "max_g", "max_b"]
    assert names[18:] == ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
    assert chunks == math.ceil(vertices / 256)
    assert len(body) == chunks * 72 + vertices * 16
    bounds = list(struct.iter_unpack("<18f", body[: chunks * 72]))
    for i, (place, turn, size, color) in enumerate(struct.iter_unpack("<4I", body[chunks * 72 :])):
        low_high = bounds[i // 256]

        def between(first: int, shares: list[float], ends: tuple[float, ...] = low_high) -> list[float]:
            return [ends[first + k] + s * (ends[first + 3 + k] - ends[first + k]) for k, s in enumerate(shares)]

        means, scales = (
            between(first, [(w >> 21) / 2047, (w >> 11 & 1023) / 1023, (w & 2047) / 2047])
            for first, w in ((0, place), (6, size))
        )
        parts = [(turn >> shift & 1023) / 1023 for shift in (20, 10, 0)]
        quat = [(part - 0.5) * math.sqrt(2) for part in parts]
        quat.insert(turn >> 30, math.sqrt(max(0, 1 - sum(v * v for v in quat))))
        rgba = [(color >> shift & 255) / 255 for shift in (24, 16, 8, 0)]
        yield means, quat, [math.exp(v) for v in scales], rgba[3], between(12, rgba[:3])


def sog_rows(data: bytes) -> Iterator[Row]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        meta = json.loads(archive.read("meta.json"))
        names = [name for key in ("means", "scales", "quats", "sh0") for name in meta[key]["files"]]
        pictures = [np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA")) for name in names]
    assert meta["version"] == 2
    assert len({picture.shape for picture in pictures}) == 1
    low, high, scales, quats, sh0 = (picture.reshape(-1, 4).tolist() for picture in pictures)
    mins, maxs = meta["means"]["mins"], meta["means"]["maxs"]
    for i in range(meta["count"]):
        means = []
        for k in range(3):
            value = mins[k] + (maxs[k] - mins[k]) * (high[i][k] << 8 | low[i][k]) / 65535
            means.append(math.copysign(math.expm1(abs(value)), value))
        quat = [(v / 255 - 0.5) * math.sqrt(2) for v in quats[i][:3]]
        quat.insert(quats[i][3] - 252, math.sqrt(max(0, 1 - sum(v * v for v in quat))))
        size = [math.exp(meta["scales"]["codebook"][v]) for v in scales[i][:3]]
        yield means, quat, size, sh0[i][3] / 255, [meta["sh0"]["codebook"][v] * C0 + 0.5 for v in sh0[i][:3]]


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """A .glb's JSON and its binary part."""
    magic, version, size, json_size, json_kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, json_kind) == (b"glTF", 2, len(data), b"JSON")
    bin_size, bin_kind = struct.unpack("<I4s", data[20 + json_size : 28 + json_size])
    assert bin_kind == b"BIN\0"
    assert json_size % 4 == bin_size % 4 == 0
    assert 28 + json_size + bin_size == size
    return json.loads(data[20 : 20 + json_size]), data[28 + json_size :]


def glb_rows(data: bytes) -> Iterator[Row]:
    gltf, body = glb_parts(data)
    assert gltf["extensionsUsed"] == ["KHR_gaussian_splatting"]
    (primitive,) = gltf["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    kernel = primitive["extensions"]["KHR_gaussian_splatting"]
    assert kernel == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    columns = {}
    for name, index in primitive["attributes"].items():
        accessor = gltf["accessors"][index]
        view = gltf["bufferViews"][accessor["bufferView"]]
        kind = {5126: "f", 5123: "H"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        columns[name.removeprefix("KHR_gaussian_splatting:")] = list(struct.iter_unpack(f"<{width}{kind}", part))
        assert len(part) == accessor["count"] * struct.calcsize(f"{width}{kind}")
    assert set(columns) == {"POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0", "COLOR_0"}
    for place, (x, y, z, w), scales, opacity, sh, _ in zip(*columns.values(), strict=True):
        yield place, (w, x, y, z), scales, opacity[0], [v * C0 + 0.5 for v in sh]
