"""Independent readers of the formats, from bytes to means, quats (wxyz), scales, opacities, sRGB in
the file's axes.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import sys
import zipfile
from typing import Any

import numpy as np
import torch
from PIL import Image

from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

C0 = 0.28209479177387814
Columns = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def gaussians_of(columns: Columns, flipped: bool) -> Gaussians:
    """Convert columns to Gaussians; `flipped` turns the axes y up, z backward into y down, z
    forward.
    """
    means, quats, scales, opacities, srgb = (
        torch.tensor(np.asarray(column), dtype=torch.float32) for column in columns
    )
    if flipped:
        means, quats = means * torch.tensor([1, -1, -1]), quats * torch.tensor([1, 1, -1, -1])
    return Gaussians(means, quats, scales, opacities, srgb_to_linear(srgb))


def with_largest(parts: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] from their three smaller components [N, 3] and the index of the largest
    one.
    """
    largest = np.sqrt(np.maximum(0, 1 - np.square(parts).sum(1)))
    return np.array([np.insert(*numbers) for numbers in zip(parts, places, largest, strict=True)])


# By the flags of an SPZ file: without extensions, and with the one that states the unit: a
# kind, a length and a float64.
EXTENSION_BYTES = {0: 0, 2: 16}


def spz_columns(data: bytes) -> Columns:
    raw = gzip.decompress(data)
    magic, version, count, degree, bits, flags, reserved = struct.unpack("<4sIIBBBB", raw[:16])
    assert (magic, version, degree, reserved) == (b"NGSP", 3, 0, 0)
    assert len(raw) == 16 + 20 * count + EXTENSION_BYTES[flags]
    return spz_body_columns(np.frombuffer(raw, np.uint8, 20 * count, offset=16), count, bits)


def spz_4_columns(data: bytes) -> Columns:
    magic, version, count, degree, bits, flags, frames, start = struct.unpack(
        "<4sIIBBBBI12x", data[:32]
    )
    assert (magic, version, degree, frames) == (b"NGSP", 4, 0, 5)
    assert start == 32 + EXTENSION_BYTES[flags]
    sizes = np.frombuffer(data, "<u8", 2 * frames, offset=start).reshape(frames, 2)
    ends = start + 16 * frames + np.cumsum(sizes[:, 0])
    assert ends[-1] == len(data)
    parts = [
        zstd.decompress(data[end - size : end])
        for end, size in zip(ends.tolist(), sizes[:, 0].tolist(), strict=True)
    ]
    assert [len(part) for part in parts] == sizes[:, 1].tolist()
    return spz_body_columns(np.frombuffer(b"".join(parts), np.uint8), count, bits)


def spz_body_columns(body: np.ndarray, count: int, bits: int) -> Columns:
    places, alphas, colors, scales, turns = np.split(body, count * np.array([9, 10, 13, 16]))
    # of 24 bits each
    means = np.pad(places.reshape(-1, 3), ((0, 0), (1, 0))).view("<i4").reshape(-1, 3) >> 8
    words = turns.view("<u4")[:, None] >> np.array([20, 10, 0])
    xyz = np.where(words >> 9 & 1, -1, 1) * (words & 511) / 511 / math.sqrt(2)
    quats = np.roll(with_largest(xyz, turns.view("<u4") >> 30), 1, axis=1)
    srgb = (colors.reshape(-1, 3) / 255 - 0.5) / 0.15 * C0 + 0.5
    return means / 2.0**bits, quats, np.exp(scales.reshape(-1, 3) / 16 - 10), alphas / 255, srgb


def splat_columns(data: bytes) -> Columns:
    rows = np.frombuffer(data, "3<f4, 3<f4, 4u1, 4u1")
    means, scales, rgba, turns = (rows[name] for name in rows.dtype.names)
    return means, (turns - 128.0) / 128, scales, rgba[:, 3] / 255, rgba[:, :3] / 255


def compressed_ply_columns(data: bytes) -> Columns:
    head, body = data.split(b"end_header\n", 1)
    lines = [line for line in head.decode().splitlines() if not line.startswith("comment")]
    chunks, vertices = (int(line.split()[2]) for line in lines if line.startswith("element"))
    names = [line.split()[-1] for line in lines if line.startswith("property")]
    ends = [
        f"{end}_{name}"
        for group in ("x y z", "scale_x scale_y scale_z", "r g b")
        for end in ("min", "max")
        for name in group.split()
    ]
    assert names == [*ends, "packed_position", "packed_rotation", "packed_scale", "packed_color"]
    assert chunks == math.ceil(vertices / 256)
    assert len(body) == chunks * 72 + vertices * 16
    bounds = np.frombuffer(body, "<f4", chunks * 18).reshape(-1, 3, 2, 3).repeat(256, 0)[:vertices]
    place, turn, size, color = (
        np.frombuffer(body, "<u4", offset=chunks * 72).reshape(-1, 4).T[..., None]
    )
    position, scale = (
        (word >> [21, 11, 0] & [2047, 1023, 2047]) / [2047, 1023, 2047] for word in (place, size)
    )
    rgba = (color >> [24, 16, 8, 0] & 255) / 255
    low, high = bounds[:, :, 0], bounds[:, :, 1]
    means, logs, srgb = (
        low + np.stack([position, scale, rgba[:, :3]], 1) * (high - low)
    ).transpose(1, 0, 2)
    quats = with_largest(
        ((turn >> [20, 10, 0] & 1023) / 1023 - 0.5) * math.sqrt(2), turn[:, 0] >> 30
    )
    return means, quats, np.exp(logs), rgba[:, 3], srgb


def sog_columns(data: bytes) -> Columns:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        meta = json.loads(archive.read("meta.json"))
        names = [name for key in ("means", "scales", "quats", "sh0") for name in meta[key]["files"]]
        pictures = [
            np.asarray(Image.open(io.BytesIO(archive.read(name))).convert("RGBA")) for name in names
        ]
    assert meta["version"] == 2
    low, high, scales, quats, sh0 = np.stack(pictures).reshape(5, -1, 4)[:, : meta["count"]]
    least, most = (np.array(meta["means"][name]) for name in ("mins", "maxs"))
    logs = least + (most - least) * (high[:, :3] * 256.0 + low[:, :3]) / 65535
    turned = with_largest((quats[:, :3] / 255 - 0.5) * math.sqrt(2), quats[:, 3] - 252)
    sizes, colors = (
        np.array(meta[name]["codebook"])[codes[:, :3]]
        for name, codes in (("scales", scales), ("sh0", sh0))
    )
    return (
        np.sign(logs) * np.expm1(np.abs(logs)),
        turned,
        np.exp(sizes),
        sh0[:, 3] / 255,
        colors * C0 + 0.5,
    )


def glb_parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, size, json_size, json_kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, json_kind) == (b"glTF", 2, len(data), b"JSON")
    bin_size, bin_kind = struct.unpack("<I4s", data[20 + json_size : 28 + json_size])
    assert bin_kind == b"BIN\0"
    assert json_size % 4 == bin_size % 4 == 0
    assert 28 + json_size + bin_size == size
    return json.loads(data[20 : 20 + json_size]), data[28 + json_size :]


def glb_columns(data: bytes) -> Columns:
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
        kind = {5126: "f4", 5123: "u2"}[accessor["componentType"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        part = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        assert len(part) == accessor["count"] * width * int(kind[1])
        columns[name.removeprefix("KHR_gaussian_splatting:")] = np.frombuffer(
            part, f"<{kind}"
        ).reshape(-1, width)
    assert set(columns) == {
        "POSITION",
        "ROTATION",
        "SCALE",
        "OPACITY",
        "SH_DEGREE_0_COEF_0",
        "COLOR_0",
    }
    means, xyzw, scales, opacities, sh, _ = columns.values()
    return means, np.roll(xyzw, 1, axis=1), scales, opacities[:, 0], sh * C0 + 0.5


FORMATS = {
    "compressed.ply": compressed_ply_columns,
    "spz": spz_columns,
    "v4.spz": spz_4_columns,
    "splat": splat_columns,
    "sog": sog_columns,
    "glb": glb_columns,
}
