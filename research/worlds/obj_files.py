"""Wavefront OBJ models with their MTL materials become meshes."""

from __future__ import annotations

import itertools
import math
import posixpath
import re
from collections.abc import Callable

import numpy as np

from worlds.meshes import Material, Mesh, repaired_normals, smooth_normals

ReadFile = Callable[[str], bytes | None]  # the content of a file by its name, None if missing

# Colours that Sweet Home 3D's own models name without an MTL file.
NAMED_COLORS = {
    "white": (0.95, 0.95, 0.95), "black": (0.08, 0.08, 0.08), "grey": (0.5, 0.5, 0.5),
    "brown": (0.45, 0.28, 0.15), "wood": (0.6, 0.42, 0.25), "gold": (0.8, 0.65, 0.3),
    "red": (0.7, 0.12, 0.1), "green": (0.2, 0.5, 0.2), "blue": (0.2, 0.3, 0.65),
    "silver": (0.7, 0.7, 0.72), "glass": (0.85, 0.9, 0.92),
}  # fmt: skip
DEFAULT_COLOR = (0.7, 0.7, 0.7)
MAX_SPECULAR = 0.08  # plastics and varnish; exporters write 0.5 for anything
METAL_SPECULAR = 0.5  # a dark colour with a strong highlight
MAX_COORDINATE = 1e6  # larger numbers are damage


def read_obj(text: str, folder: str, read_file: ReadFile) -> Mesh:
    """The triangles of an OBJ file, in the file's own unit and axes.

    Polygons become fans of triangles. Missing or broken normals are made from the faces. Faces
    without area, and with corners that do not exist, are left out.

    Args:
        text: the file's content.
        folder: the file's folder, for the names of materials and pictures.
        read_file: gives other files by their path.

    Raises:
        ValueError: the file has no triangles, or a number in it cannot be read.
    """
    points: list[list[float]] = []
    textures: list[list[float]] = []  # coordinates in pictures
    normals: list[list[float]] = []
    corner_indices: list[tuple[int, int, int]] = []  # three a triangle
    face_materials: list[int] = []  # a triangle's number in `names`
    names: dict[str, int] = {}  # of materials that faces use, with their numbers
    materials: dict[str, Material] = {}  # that MTL files describe
    current = names.setdefault("", 0)  # faces before any `usemtl`

    # A backslash continues a line.
    for line in text.replace("\\\n", " ").splitlines():
        words = line.split()
        if not words:
            continue
        kind = words[0]
        if kind == "v":
            points.append([float(word) for word in words[1:4]])
        elif kind == "vt":
            textures.append([float(word) for word in [*words[1:3], "0"][:2]])
        elif kind == "vn":
            normals.append([float(word) for word in words[1:4]])
        elif kind == "f":
            counts = (len(points), len(textures), len(normals))
            corners = [_corner(word, counts) for word in words[1:]]
            # A fan: the first corner with each two neighbours.
            for second, third in itertools.pairwise(corners[1:]):
                corner_indices += [corners[0], second, third]
                face_materials.append(current)
        elif kind == "usemtl":
            current = names.setdefault(" ".join(words[1:]), len(names))
        elif kind == "mtllib":
            # A line may name several files, or one with spaces in its name.
            for name in {" ".join(words[1:]), *words[1:]}:
                content = read_file(posixpath.join(folder, name))
                if content is not None:
                    materials |= read_mtl(content.decode("latin1"), folder)

    if not corner_indices:
        raise ValueError("no triangles")
    index = np.array(corner_indices, np.int64).reshape(-1, 3, 3)  # [F, corner, (v, vt, vn)]
    material = np.array(face_materials, np.int32)
    all_points = np.array(points, np.float64)

    # Faces with corners that do not exist, or without area, are left out.
    exists = (index[..., 0] >= 0) & (index[..., 0] < len(points))
    whole = np.asarray(exists.all(1))
    xyz = all_points[np.where(whole[:, None], index[..., 0], 0)]
    crossed = np.cross(xyz[:, 1] - xyz[:, 0], xyz[:, 2] - xyz[:, 0])
    whole &= np.linalg.norm(crossed, axis=1) > 0
    whole &= (np.abs(xyz) < MAX_COORDINATE).all((1, 2))
    index = index[whole]
    material = material[whole]
    xyz = xyz[whole]
    if not len(xyz):
        raise ValueError("no triangles with an area")

    found = [_found_material(name, materials) for name in names]
    return Mesh(
        xyz.astype(np.float32),
        _normals(xyz, index[..., 2], normals),
        _texture_coordinates(index[..., 1], textures),
        material,
        tuple(found),
    )


def _corner(word: str, counts: tuple[int, int, int]) -> tuple[int, int, int]:
    """Indices from 0 of "v/vt/vn"; −1 for a missing one. Negative numbers count from the end."""
    parts = [*word.split("/"), "", ""][:3]
    indices = []
    for part, count in zip(parts, counts, strict=True):
        number = int(part) if part else 0  # the file counts from 1, so 0 becomes −1
        indices.append(number - 1 if number >= 0 else count + number)
    return indices[0], indices[1], indices[2]


def _normals(
    xyz: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
    index: np.ndarray[tuple[int, ...], np.dtype[np.int64]],
    normals: list[list[float]],
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """[F, 3, 3] the file's normals, or new ones where it has none."""
    if not normals:
        return smooth_normals(xyz)
    # Corners without a normal get the last row, which is none, and is repaired.
    table = np.array([*normals, [0.0, 0.0, 0.0]], np.float64)
    known = (index >= 0) & (index < len(normals))
    return repaired_normals(xyz, table[np.where(known, index, len(normals))])


def _texture_coordinates(
    index: np.ndarray[tuple[int, ...], np.dtype[np.int64]], textures: list[list[float]]
) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """[F, 3, 2] the file's texture coordinates, or 0 where it has none."""
    table = np.array([*textures, [0.0, 0.0]], np.float32)
    known = (index >= 0) & (index < len(textures))
    return table[np.where(known, index, len(textures))]


def _found_material(name: str, materials: dict[str, Material]) -> Material:
    """The material of this name, or a guess by the name."""
    if name in materials:
        return materials[name]
    for word, color in NAMED_COLORS.items():
        if word in name.lower():
            return Material(color, opacity=0.3 if word == "glass" else 1.0)
    return Material(DEFAULT_COLOR)


def read_mtl(text: str, folder: str) -> dict[str, Material]:
    """The materials of an MTL file by name; pictures get their path below `folder`."""
    found: dict[str, dict[str, list[str]]] = {}
    facts: dict[str, list[str]] = {}
    for line in text.splitlines():
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] == "newmtl":
            facts = found.setdefault(" ".join(words[1:]), {})
        else:
            facts[words[0].lower()] = words[1:]
    return {name: _material(facts, folder) for name, facts in found.items()}


def _material(facts: dict[str, list[str]], folder: str) -> Material:
    """A material from the lines of an MTL file."""
    color = _color(facts.get("kd"), DEFAULT_COLOR)
    shine = max(_color(facts.get("ks"), (0.0, 0.0, 0.0)))
    exponent = float(facts.get("ns", ["10"])[0])

    texture = None
    if facts.get("map_kd"):
        # Options such as "-s 1 1 1" come before the name, which may have spaces in it.
        name = re.sub(r"^(-\w+( -?[\d.]+| on| off)+ )+", "", " ".join(facts["map_kd"]))
        texture = posixpath.normpath(posixpath.join(folder, name.replace("\\", "/")))

    opacity = 1.0
    if "d" in facts:
        opacity = float(facts["d"][-1])
    elif "tr" in facts:
        opacity = 1 - float(facts["tr"][-1])

    # A Phong exponent n looks like a microfacet roughness of √(2 / (n + 2)).
    roughness = math.sqrt(2 / (max(exponent, 1.0) + 2))
    is_metal = shine > 0.6 and max(color) < 0.35 and texture is None and exponent > 60
    specular = METAL_SPECULAR * shine if is_metal else min(MAX_SPECULAR, 0.12 * shine)
    return Material(color, texture, specular, roughness, opacity)


def _color(
    words: list[str] | None, default: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Three numbers in 0..1."""
    if words is None or len(words) < 3:
        return default
    values = [min(max(float(word), 0.0), 1.0) for word in words[:3]]
    return values[0], values[1], values[2]
