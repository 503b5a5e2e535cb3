"""Read Gaussians from glTF files: KHR_gaussian_splatting, its drafts, and SPZ within glTF.

`gltf.py` writes such files; `gltf_file.py` knows the container.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import quat_from_matrix, quat_multiply, quat_to_matrix
from spackle.core.spherical_harmonics import MAX_DEGREE, rotate_harmonics
from spackle.formats.camera_files import camera_from_json
from spackle.formats.gaussian_columns import (
    MAX_SCALE,
    MIN_SCALE,
    Floats,
    GaussianColumns,
    axes_to_opencv,
    harmonics_to_srgb,
)
from spackle.formats.gltf import EXTENSION
from spackle.formats.gltf_file import GltfFile
from spackle.formats.scene_content import DecodedScene, UnsupportedSceneError
from spackle.formats.scene_limits import check_gaussian_count
from spackle.formats.spz import decode_spz
from spackle.runtime.errors import short_repr

# glTF has x left, y up and z front. Spackle's own files have the scene along z back, so that a
# camera of glTF, which looks along z back, sees it.
USUAL_AXES = "LUF"
OWN_AXES = "RUB"
OWN_GENERATOR = "Spackle"

# The extension that holds an SPZ file has had these names: first at the primitive itself, then
# within KHR_gaussian_splatting.
SPZ_OF_PRIMITIVE = ("KHR_spz_gaussian_splats_compression", "KHR_spz_compression")
SPZ_OF_SPLATTING = (
    "KHR_gaussian_splatting_compression_spz",
    "KHR_gaussian_splatting_compression_spz_2",
)

MAX_NODE_DEPTH = 64  # of a node in the tree; a deeper one is in a circle

# How far a rotation times its transpose may be from the identity.
ROTATION_TOLERANCE = 1e-4


def read_gltf(path: Path) -> DecodedScene:
    """Read all Gaussians of a .glb or .gltf file, with y down and z forward.

    Raises:
        UnsupportedSceneError: the file holds no Gaussians, or uses an unknown extension for them.
        Exception: any exception, if the file is damaged.
    """
    file = GltfFile.read(path)
    generator = file.description.get("asset", {}).get("generator")
    is_own = generator == OWN_GENERATOR
    axes = OWN_AXES if is_own else USUAL_AXES
    to_opencv = axes_to_opencv(axes)

    parts = []
    degrees = []
    base_count = None
    for node, matrix, primitive in _splat_primitives(file):
        columns, degree = _read_primitive(file, primitive, axes)
        parts.append(
            _transformed(
                columns, to_opencv @ matrix[:3, :3] @ to_opencv.T, to_opencv @ matrix[:3, 3]
            )
        )
        degrees.append(degree)
        if is_own and "spackle_base" in node.get("extras", {}):
            base_count = int(node["extras"]["spackle_base"])
        # A file may show the same Gaussians several times, but not any number of times.
        total_count = sum(len(part.means) for part in parts)
        most_harmonics = max(part.harmonics_degree for part in parts)
        check_gaussian_count(total_count, most_harmonics, file.byte_count)
    if not parts:
        raise UnsupportedSceneError(_what_else(file))

    columns = GaussianColumns.cat(parts)
    if base_count is not None and not 0 <= base_count <= len(columns.means):
        raise ValueError(f"{base_count} of {len(columns.means)} Gaussians are said to be the base")
    return DecodedScene(
        columns=columns,
        format="glTF 2",
        writer=generator if isinstance(generator, str) else None,
        harmonics_degree=max(degrees),
        camera=_own_camera(file) if is_own else None,
        base_count=base_count,
        byte_count=file.byte_count,
    )


def _splat_primitives(
    file: GltfFile,
) -> Iterator[tuple[dict[str, Any], NDArray[np.float64], dict[str, Any]]]:
    """Yield each primitive with Gaussians that the scene shows.

    Yields:
        Its node, the node's matrix [4, 4] to the world, and the primitive.
    """
    for node, matrix in _nodes(file):
        if "mesh" not in node:
            continue
        for primitive in file.item("meshes", node["mesh"])["primitives"]:
            extensions = primitive.get("extensions", {})
            if EXTENSION in extensions or set(SPZ_OF_PRIMITIVE) & set(extensions):
                yield node, matrix, primitive


def _nodes(file: GltfFile) -> Iterator[tuple[dict[str, Any], NDArray[np.float64]]]:
    """Yield the nodes of the scene, each with its matrix [4, 4] to the world."""
    description = file.description
    all_nodes = description.get("nodes", [])
    if description.get("scenes"):
        roots = file.item("scenes", description.get("scene", 0)).get("nodes", [])
    else:
        # Without a scene, all nodes that are nobody's children are shown.
        children = {child for node in all_nodes for child in node.get("children", [])}
        roots = [index for index in range(len(all_nodes)) if index not in children]

    pending = [(root, np.eye(4), 0) for root in reversed(roots)]
    while pending:
        index, parent_matrix, depth = pending.pop()
        if depth > MAX_NODE_DEPTH:
            raise ValueError("its nodes form a circle")
        node = file.item("nodes", index)
        matrix = parent_matrix @ _node_matrix(node)
        yield node, matrix
        for child in reversed(node.get("children", [])):
            pending.append((child, matrix, depth + 1))


def _node_matrix(node: Mapping[str, Any]) -> NDArray[np.float64]:
    """Return the matrix [4, 4] from a node to its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # stored column by column
    matrix = np.eye(4)
    x, y, z, w = np.array(node.get("rotation", [0, 0, 0, 1]), np.float64).reshape(4)
    rotation = quat_to_matrix(torch.tensor([w, x, y, z], dtype=torch.float64)).numpy()
    matrix[:3, :3] = rotation * np.array(node.get("scale", [1, 1, 1]), np.float64).reshape(3)
    matrix[:3, 3] = np.array(node.get("translation", [0, 0, 0]), np.float64).reshape(3)
    return matrix


def _read_primitive(
    file: GltfFile, primitive: Mapping[str, Any], axes: str
) -> tuple[GaussianColumns, int]:
    """Read the Gaussians of a primitive, in its node's coordinates but with OpenCV's axes.

    Args:
        file: the file.
        primitive: one with Gaussians.
        axes: where the file's axes point, such as "LUF" for x left, y up, z front.

    Returns:
        The Gaussians, and the degree of their spherical harmonics.
    """
    extensions = primitive.get("extensions", {})
    splatting = extensions.get(EXTENSION, {})
    holders = [(extensions, name) for name in SPZ_OF_PRIMITIVE]
    holders += [(splatting.get("extensions", {}), name) for name in SPZ_OF_SPLATTING]
    for holder, name in holders:
        if name in holder:
            decoded = decode_spz(bytes(file.view_bytes(holder[name]["bufferView"])))
            return decoded.columns, decoded.harmonics_degree

    # Another extension may change the meaning of the attributes, or replace them.
    for name in splatting.get("extensions", {}):
        problem = f"its Gaussians use the extension {short_repr(name)}, which is unknown"
        raise UnsupportedSceneError(f"{problem}: save it without the extension, or as PLY")
    columns = _read_attributes(file, primitive.get("attributes", {}), splatting)
    degrees = [0]
    for name in primitive.get("attributes", {}):
        # Such as KHR_gaussian_splatting:SH_DEGREE_3_COEF_6.
        _, mark, rest = str(name).partition(":SH_DEGREE_")
        if mark and rest[:1].isdigit():
            degrees.append(int(rest[0]))
    return columns.to_opencv_axes(axes), max(degrees)


def _read_harmonics(file: GltfFile, attributes: Mapping[str, Any]) -> Floats | None:
    """Read the coefficients [N, K, 3] of the degrees 1 to 3, with the axes of the file.

    A degree counts only if all its coefficients, and those of lower degrees, are there.
    """
    coefficients: list[Floats] = []
    for degree in range(1, MAX_DEGREE + 1):
        names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}" for index in range(2 * degree + 1)]
        if not all(name in attributes for name in names):
            break
        coefficients += [file.array(attributes[name])[:, :3] for name in names]
    return np.stack(coefficients, axis=1) if coefficients else None


def _read_attributes(
    file: GltfFile, attributes: Mapping[str, Any], splatting: Mapping[str, Any]
) -> GaussianColumns:
    """Read Gaussians from the arrays of a primitive, with the axes of the file.

    The names, and the meaning of some arrays, are those of the extension or of one of its drafts.

    Args:
        file: the file.
        attributes: the indices of the arrays by their names.
        splatting: what the extension says about the primitive.
    """
    means = file.array(attributes["POSITION"])
    xyzw = file.array(_attribute(attributes, "ROTATION"))
    scales = file.array(_attribute(attributes, "SCALE"))

    # The first drafts stored logarithms. Scales are not negative, and nearly all logarithms of a
    # scene are.
    are_logarithms = bool((scales < 0).any())
    log_scales = scales if are_logarithms else np.log(np.clip(scales, MIN_SCALE, MAX_SCALE))

    harmonics_name = f"{EXTENSION}:SH_DEGREE_0_COEF_0"
    colors = file.array(attributes["COLOR_0"]) if "COLOR_0" in attributes else None
    if harmonics_name in attributes:
        rgb = harmonics_to_srgb(file.array(attributes[harmonics_name]))
    elif colors is not None:
        rgb = colors[:, :3]  # the drafts have the final colour here
    else:
        raise ValueError("its Gaussians have no colours")
    is_linear = "lin" in str(splatting.get("colorSpace", "")).lower()
    # A sum in another space than sRGB would not fit these colours.
    has_harmonics = harmonics_name in attributes and not is_linear
    harmonics = _read_harmonics(file, attributes) if has_harmonics else None
    if is_linear:
        rgb = linear_to_srgb(torch.from_numpy(rgb)).numpy()

    opacity_index = _attribute(attributes, "OPACITY", must_exist=colors is None)
    if opacity_index is not None:
        opacities = file.array(opacity_index)[:, 0]
    else:
        assert colors is not None
        # A colour without a fourth component is opaque.
        opacities = colors[:, 3] if colors.shape[1] == 4 else np.ones(len(colors), np.float32)
    return GaussianColumns(
        means=means,
        quats=_unit_length(xyzw[:, [3, 0, 1, 2]]),
        log_scales=log_scales,
        opacities=np.clip(opacities, 0, 1),
        srgb=rgb if harmonics is not None else np.clip(rgb, 0, 1),
        harmonics=harmonics,
    )


def _attribute(attributes: Mapping[str, Any], name: str, *, must_exist: bool = True) -> Any:
    """Return the index of an array by its name in the extension, or in a draft of it.

    Raises:
        ValueError: there is none, but `must_exist`.
    """
    for full_name in (f"{EXTENSION}:{name}", f"_{name}"):
        if full_name in attributes:
            return attributes[full_name]
    if must_exist:
        raise ValueError(f"its Gaussians have no {name}")
    return None


def _unit_length(quats: Floats) -> Floats:
    """Return quaternions [N, 4] of length 1; those of length 0 become (1, 0, 0, 0)."""
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    identity = np.array([1, 0, 0, 0], np.float32)
    units: Floats = np.where(length > 0, quats / np.maximum(length, MIN_SCALE), identity)
    return units.astype(np.float32)


def _transformed(
    columns: GaussianColumns, linear: NDArray[np.float64], translation: NDArray[np.float64]
) -> GaussianColumns:
    """Return Gaussians moved by a node's matrix: x becomes linear · x + translation.

    A node may stretch its axes differently, so that ellipsoids get other axes.

    Args:
        columns: N Gaussians.
        linear: [3, 3].
        translation: [3].

    Raises:
        UnsupportedSceneError: the matrix mirrors the Gaussians, or flattens them.
    """
    if np.array_equal(linear, np.eye(3)):
        return dataclasses.replace(columns, means=(columns.means + translation).astype(np.float32))
    determinant = float(np.linalg.det(linear))
    if not determinant > 0:
        raise UnsupportedSceneError("a node mirrors or flattens its Gaussians: save it without")
    means = (columns.means @ linear.T + translation).astype(np.float32)
    if columns.harmonics is not None:
        # Of a stretched scene, colours turn by the rotation that is nearest to the matrix.
        left, _, right = np.linalg.svd(linear)
        coefficients = torch.from_numpy(columns.harmonics)
        turned_harmonics = rotate_harmonics(coefficients, torch.from_numpy(left @ right))
        columns = dataclasses.replace(columns, harmonics=turned_harmonics.numpy())

    # A rotation with an even scale turns and scales each Gaussian.
    scale = determinant ** (1 / 3)
    rotation = linear / scale
    quats = torch.from_numpy(columns.quats).double()
    if np.abs(rotation @ rotation.T - np.eye(3)).max() < ROTATION_TOLERANCE:
        turned = quat_multiply(quat_from_matrix(torch.from_numpy(rotation)), quats)
        log_scales = columns.log_scales + np.float32(np.log(scale))
        return dataclasses.replace(
            columns, means=means, quats=turned.float().numpy(), log_scales=log_scales
        )

    # Else the new ellipsoid's axes are those of the covariance L R S Sᵀ Rᵀ Lᵀ, which a singular
    # value decomposition of L R S gives.
    scales = torch.from_numpy(np.exp(columns.log_scales)).double()
    factor = torch.from_numpy(linear) @ quat_to_matrix(quats) * scales[:, None, :]  # [N, 3, 3]
    axes, lengths, _ = torch.linalg.svd(factor)
    # An axis may be turned around, so that the axes form a rotation and no mirror.
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()
    return dataclasses.replace(
        columns,
        means=means,
        quats=quat_from_matrix(axes).float().numpy(),
        log_scales=_log_lengths(lengths),
    )


def _log_lengths(lengths: Tensor) -> Floats:
    """Return the logarithms of lengths [N, 3], as NumPy."""
    return lengths.clamp(MIN_SCALE, MAX_SCALE).log().float().numpy()


def _own_camera(file: GltfFile) -> Camera | None:
    """Return the photo's camera that Spackle wrote into a file; None if there is none.

    Raises:
        InputError: the camera is impossible.
    """
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # y up, z back to y down, z forward, and back
    for node, matrix in _nodes(file):
        if "camera" not in node:
            continue
        extras = file.item("cameras", node["camera"]).get("extras", {})
        if "K" not in extras:
            continue
        world_to_camera = flip @ np.linalg.inv(matrix) @ flip
        entry = {**extras, "world_to_camera": world_to_camera.tolist()}
        return camera_from_json(entry, "the stored camera")
    return None


def _what_else(file: GltfFile) -> str:
    """Say what a file without Gaussians holds, and what to do."""
    modes = {
        primitive.get("mode", 4)  # triangles, if it is not said
        for mesh in file.description.get("meshes", [])
        for primitive in mesh["primitives"]
    }
    if modes == {0}:
        what = "a cloud of points, which have no sizes"
    elif modes:
        what = "a mesh"
    else:
        what = "no mesh at all"
    return f"glTF with {what}, not with Gaussians ({EXTENSION}): give a scene of Gaussians"
