"""Write glTF's extension KHR_gaussian_splatting, as a single .glb file."""

from __future__ import annotations

import json
import math
import struct
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.formats.scene_files import GaussianColumns, SceneFile
from spackle.runtime.errors import InputError

EXTENSION = "KHR_gaussian_splatting"
LARGEST_FILE = 2**32 - 1  # bytes that a .glb can announce
ROW = 64  # bytes for each Gaussian
FLOAT, UNSIGNED_SHORT, ARRAY_BUFFER, POINTS = 5126, 5123, 34962, 0
UNMOVED = np.eye(4).ravel().tolist()
NEAR_PLANE = 0.01  # glTF requires a near plane


def encode_glb(scene: SceneFile) -> bytes:
    """Encode a scene as binary glTF: order as in the scene, y up, z backward, linear scales, sRGB colours as harmonics.

    Viewers without the extension show points, with the linear colours of COLOR_0. The photo's camera becomes a glTF
    camera. `extras` hold the base's count and the camera's parameters that glTF cannot express.

    Raises:
        InputError: there are no Gaussians, or more than 4 GiB of Gaussians.
        ValueError: a Gaussian is not finite.
    """
    count = len(scene.gaussians)
    if count == 0:
        raise InputError("glTF cannot hold a scene without Gaussians: use another format")
    if count * ROW + (1 << 16) > LARGEST_FILE:
        raise InputError(
            f"{count:,} Gaussians are too many for .glb (4 GiB at most): use another format"
        )
    arrays = _attributes(GaussianColumns.of(scene.gaussians).flipped())
    parts = [array.tobytes() for array in arrays.values()]
    text = json.dumps(
        _description(arrays, scene.camera, scene.base_count), separators=(",", ":"), allow_nan=False
    ).encode()
    text += b" " * (-len(text) % 4)
    size = sum(len(part) for part in parts)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + size)
    return b"".join(
        [
            head,
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", size, b"BIN\0"),
            *parts,
        ]
    )


def _attributes(columns: GaussianColumns) -> dict[str, NDArray[Any]]:
    """The Gaussians' attributes; each has a multiple of four bytes."""
    linear = srgb_to_linear(torch.from_numpy(columns.srgb)).numpy()
    rgba = np.concatenate([linear, columns.opacities[:, None]], axis=1)
    return {
        "POSITION": columns.means.astype("<f4"),
        f"{EXTENSION}:ROTATION": columns.quats[:, [1, 2, 3, 0]].astype("<f4"),
        f"{EXTENSION}:SCALE": np.exp(columns.log_scales).astype("<f4"),
        f"{EXTENSION}:OPACITY": columns.opacities.astype("<f4"),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": columns.harmonics.astype("<f4"),
        "COLOR_0": np.round(rgba * 65535).astype("<u2"),
    }


def _description(
    arrays: dict[str, NDArray[Any]], camera: Camera | None, base_count: int | None
) -> dict[str, Any]:
    """The file's JSON part."""
    views, accessors, offset = [], [], 0
    for index, array in enumerate(arrays.values()):
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": ARRAY_BUFFER}
        )
        kind = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        accessor: dict[str, Any] = {
            "bufferView": index,
            "componentType": FLOAT,
            "count": len(array),
            "type": kind,
        }
        if array.dtype == np.uint16:
            accessor |= {"componentType": UNSIGNED_SHORT, "normalized": True}
        accessors.append(accessor)
        offset += array.nbytes
    means = arrays["POSITION"]  # glTF requires the bounds of this attribute
    accessors[0] |= {"min": means.min(axis=0).tolist(), "max": means.max(axis=0).tolist()}
    kernel = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": POINTS, "attributes": {name: index for index, name in enumerate(arrays)}}
    nodes: list[dict[str, Any]] = [{"name": "scene", "mesh": 0}]
    if base_count is not None:
        nodes[0]["extras"] = {"spackle_base": base_count}
    description: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Spackle"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0] if camera is None else [0, 1]}],
        "nodes": nodes,
        "meshes": [{"primitives": [primitive | {"extensions": {EXTENSION: kernel}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    if camera is not None:
        flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        matrix = (
            flip @ torch.linalg.inv(camera.world_to_camera.detach().to("cpu", torch.float64)) @ flip
        )
        pose = (matrix.T.flatten() + 0.0).tolist()  # camera to world, column by column, without -0
        nodes.append({"name": "photo", "camera": 0} | ({} if pose == UNMOVED else {"matrix": pose}))
        (fx, fy), width, height = camera.focal, camera.width, camera.height
        lens = {
            "yfov": 2 * math.atan2(height, 2 * fy),
            "aspectRatio": width * fy / (height * fx),
            "znear": NEAR_PLANE,
        }
        extras = {
            "K": camera.K.tolist(),
            "width": width,
            "height": height,
        }  # glTF has no principal point
        description["cameras"] = [{"type": "perspective", "perspective": lens, "extras": extras}]
    return description
