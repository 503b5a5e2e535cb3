"""Write glTF's extension KHR_gaussian_splatting, as a single .glb file."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.spherical_harmonics import HARMONICS_COUNTS
from spackle.formats.gaussian_columns import GaussianColumns
from spackle.formats.quantization import ordinary_length_factor
from spackle.formats.scene_content import SceneFile
from spackle.runtime.errors import InputError

EXTENSION = "KHR_gaussian_splatting"

MAX_GLB_BYTES = 2**32 - 1  # a .glb states its size in 32 bits
ATTRIBUTE_BYTES_PER_GAUSSIAN = 64
HARMONIC_BYTES = 12  # of the three colours of a coefficient
MAX_DESCRIPTION_BYTES = 1 << 16  # more than the JSON part takes

# glTF's numbers for types, buffers and kinds of primitives.
GLTF_FLOAT = 5126
GLTF_UNSIGNED_SHORT = 5123
GLTF_ARRAY_BUFFER = 34_962
GLTF_POINTS = 0

IDENTITY_POSE = np.eye(4).ravel().tolist()
# In metres. glTF requires a near plane; viewers may choose their own.
NEAR_PLANE_M = 0.01


def encode_glb(scene: SceneFile) -> bytes:
    """Encode a scene as binary glTF with the extension KHR_gaussian_splatting.

    The Gaussians keep their order; the axes become y up and z backward. Scales are linear, colours
    are coefficients of spherical harmonics. A viewer that does not know the extension
    shows points with the linear colours of the attribute COLOR_0. The photo's camera becomes a
    glTF camera. The fields `extras` hold what glTF cannot express: how many Gaussians come from
    the photo, and the camera's principal point and size.

    Raises:
        InputError: there are no Gaussians, or more than 4 GiB of Gaussians.
        ValueError: a Gaussian is not finite.
    """
    count = len(scene.gaussians)
    if count == 0:
        raise InputError("glTF cannot hold a scene without Gaussians: use another format")
    bytes_per_gaussian = ATTRIBUTE_BYTES_PER_GAUSSIAN
    bytes_per_gaussian += HARMONIC_BYTES * scene.gaussians.harmonics_count
    if count * bytes_per_gaussian + MAX_DESCRIPTION_BYTES > MAX_GLB_BYTES:
        problem = f"{count:,} Gaussians are too many for .glb (4 GiB at most)"
        raise InputError(f"{problem}: use another format")

    columns = GaussianColumns.from_gaussians(scene.gaussians).flip_y_and_z()
    attributes = _attribute_arrays(columns)
    description = _describe_scene(attributes, scene.camera, scene.base_count)
    json_part = json.dumps(description, separators=(",", ":"), allow_nan=False).encode()
    # The length of each part must be a multiple of four; JSON is filled up with spaces.
    json_part = json_part.ljust(math.ceil(len(json_part) / 4) * 4)
    binary_part = b"".join(array.tobytes() for array in attributes.values())

    # The file's header has 12 bytes: a signature, the version 2 of glTF, and the file's length. The
    # header of each part has 8 bytes: the part's length and kind.
    file_bytes = 12 + 8 + len(json_part) + 8 + len(binary_part)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, file_bytes),
            struct.pack("<I4s", len(json_part), b"JSON"),
            json_part,
            struct.pack("<I4s", len(binary_part), b"BIN\0"),
            binary_part,
        ]
    )


def _attribute_arrays(columns: GaussianColumns) -> dict[str, NDArray[Any]]:
    """Return the arrays of N Gaussians by their names in glTF, in the file's order.

    Each array has a multiple of four bytes, as glTF requires.
    """
    linear_rgb = srgb_to_linear(torch.from_numpy(columns.srgb)).numpy()
    rgba = np.concatenate([linear_rgb, columns.opacities[:, None]], axis=1)  # [N, 4]
    xyzw = columns.quats[:, [1, 2, 3, 0]]  # glTF has w last
    arrays = {
        "POSITION": columns.means.astype("<f4"),
        f"{EXTENSION}:ROTATION": xyzw.astype("<f4"),
        f"{EXTENSION}:SCALE": np.exp(columns.log_scales).astype("<f4"),
        f"{EXTENSION}:OPACITY": columns.opacities.astype("<f4"),
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": columns.constant_harmonics.astype("<f4"),
        "COLOR_0": np.round(rgba * 65_535).astype("<u2"),
    }
    if columns.harmonics is not None:
        for degree in range(1, columns.harmonics_degree + 1):
            first = HARMONICS_COUNTS[degree - 1]
            for index in range(2 * degree + 1):
                name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"
                arrays[name] = columns.harmonics[:, first + index].astype("<f4")
    return arrays


def _describe_scene(
    attributes: Mapping[str, NDArray[Any]], camera: Camera | None, base_count: int | None
) -> dict[str, Any]:
    """Return the JSON part of a .glb file.

    Args:
        attributes: the arrays of the binary part, in their order, by their names in glTF.
        camera: the photo's camera, if it is known.
        base_count: how many Gaussians come from the photo, if it is known.
    """
    buffer_views, accessors = _describe_arrays(attributes)
    splat_settings = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "mode": GLTF_POINTS,
        # An attribute names its accessor; there is one for each array, in the same order.
        "attributes": {name: index for index, name in enumerate(attributes)},
        "extensions": {EXTENSION: splat_settings},
    }
    scene_node: dict[str, Any] = {"name": "scene", "mesh": 0}
    if base_count is not None:
        scene_node["extras"] = {"spackle_base": base_count}

    nodes = [scene_node]
    if camera is not None:
        nodes.append(_describe_photo_node(camera))
    description: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "Spackle"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": buffer_views,
        "buffers": [{"byteLength": sum(array.nbytes for array in attributes.values())}],
    }
    if camera is not None:
        # A scene in a small unit must not vanish before the near plane.
        near_plane = NEAR_PLANE_M / ordinary_length_factor(attributes["POSITION"])
        description["cameras"] = [_describe_lens(camera, near_plane)]
    return description


def _describe_arrays(
    attributes: Mapping[str, NDArray[Any]],
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return glTF's buffer views and accessors, which say where and what each array is."""
    buffer_views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    byte_offset = 0
    for name, array in attributes.items():
        buffer_views.append(
            {
                "buffer": 0,  # the only one
                "byteOffset": byte_offset,
                "byteLength": array.nbytes,
                "target": GLTF_ARRAY_BUFFER,
            }
        )
        byte_offset += array.nbytes

        accessor: dict[str, Any] = {
            "bufferView": len(accessors),  # each array has its own one, of the same index
            "componentType": GLTF_FLOAT,
            "count": len(array),
            "type": "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
        }
        if array.dtype == np.uint16:
            accessor["componentType"] = GLTF_UNSIGNED_SHORT
            accessor["normalized"] = True  # 65535 means 1
        # glTF requires the bounds of the positions, and of no other attribute.
        if name == "POSITION":
            accessor["min"] = array.min(axis=0).tolist()
            accessor["max"] = array.max(axis=0).tolist()
        accessors.append(accessor)
    return buffer_views, accessors


def _describe_photo_node(camera: Camera) -> dict[str, Any]:
    """Return the node of the photo's camera, with its pose unless it is at the origin."""
    # Both world and camera turn from y down, z forward to y up, z backward.
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    world_to_camera = camera.world_to_camera.detach().to("cpu", torch.float64)
    camera_to_world = flip @ torch.linalg.inv(world_to_camera) @ flip
    # glTF stores matrices column by column. Adding zero turns -0 into 0.
    pose = (camera_to_world.T.flatten() + 0.0).tolist()

    node: dict[str, Any] = {"name": "photo", "camera": 0}
    if pose != IDENTITY_POSE:
        node["matrix"] = pose
    return node


def _describe_lens(camera: Camera, near_plane: float) -> dict[str, Any]:
    """Return glTF's perspective camera; `extras` keep the principal point, which glTF lacks."""
    fx, fy = camera.focal
    # The field of view is the vertical one, in radians.
    lens = {
        "yfov": 2 * math.atan2(camera.height, 2 * fy),
        "aspectRatio": camera.width * fy / (camera.height * fx),
        "znear": near_plane,  # glTF requires a number
    }
    extras = {"K": camera.K.tolist(), "width": camera.width, "height": camera.height}
    return {"type": "perspective", "perspective": lens, "extras": extras}
