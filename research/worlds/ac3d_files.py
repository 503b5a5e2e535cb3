"""AC3D models (.ac), and the layered ones of TORCS (.acc), become meshes.

An AC3D file is text: materials first, then a tree of objects, each with a picture, points and
faces. In TORCS' variant a point has its normal behind it, an object up to four pictures one over
the other, and faces are often strips of triangles. Of the pictures the lowest is used.
"""

from __future__ import annotations

import dataclasses
import itertools
import shlex
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from worlds.meshes import Material, Mesh, joined, repaired_normals, smooth_normals

NO_PICTURE = "empty_texture_no_mapping"  # what TORCS writes for a layer without a picture
UPPER_LAYERS = ("tiled", "skids", "shad")  # shading, tyre marks and shadows over the lowest picture
FACE_KIND = 0x0F  # the bits of a face's flags that tell its kind; the others: smooth, two-sided
POLYGON, STRIP = 0, 4  # kinds of faces; other kinds are lines
# Share of light that paint and glass mirror when looked at straight on. Files give a strength of
# highlights in 0..1 that says little of the material: 0.5 for grass, too. So it is scaled down, and
# limited: half strength is already that of paint.
MAX_SPECULAR = 0.06
SPECULAR_OF_HIGHLIGHT = 0.12
# Files have x to the right, y up and z towards the viewer; worlds have y away and z up.
TO_WORLD = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)


@dataclasses.dataclass
class _Object:
    """A node of the tree while it is read; a point p of it lies at turn · p + shift in the file."""

    turn: NDArray[np.float64]  # [3, 3]
    shift: NDArray[np.float64]  # [3] in the file's unit
    texture: str | None = None  # the picture's name
    repeat: tuple[float, float] = (1.0, 1.0)  # how often the picture is there along u and v
    offset: tuple[float, float] = (0.0, 0.0)  # added to u and v
    points: NDArray[np.float64] | None = None  # [P, 3] in the object's own axes
    normals: NDArray[np.float64] | None = None  # [P, 3]; None: the file gives none


class _Lines:
    """The lines of a file, one after the other, with their numbers for messages."""

    def __init__(self, text: str) -> None:
        """Start before the first line of a text."""
        self._lines = text.split("\n")
        self.number = 0  # how many lines were read

    def next(self) -> list[str]:
        """The words of the next line that has any; an empty list at the end."""
        while self.number < len(self._lines):
            line = self._lines[self.number]
            self.number += 1
            # Quoted names may have spaces in them.
            words = shlex.split(line) if '"' in line else line.split()
            if words:
                return words
        return []

    def skip(self, characters: int) -> None:
        """Pass over the lines of an object's note, a text of this many characters."""
        left = characters
        while left >= 0 and self.number < len(self._lines):
            left -= len(self._lines[self.number]) + 1  # and the line's end
            self.number += 1

    def numbers(self, count: int) -> NDArray[np.float64]:
        """[count, K] the numbers of the next `count` lines; ValueError unless each has K."""
        rows = [line.split() for line in self._lines[self.number : self.number + count]]
        self.number += count
        if len(rows) < count or len({len(row) for row in rows}) > 1:
            raise ValueError(
                f"line {self.number}: expected {count} lines with as many numbers each"
            )
        return np.array(rows, np.float64).reshape(count, -1)


def read_ac3d(text: str) -> Mesh:
    """The triangles of an AC3D file's content, in the file's unit, z up, x as in the file.

    Textures have the name that the file gives. Faces that are lines, and those without area, are
    left out. Missing or broken normals are made from the faces.

    Raises:
        ValueError: no AC3D file, a line that cannot be read (with its number), or no triangles.
    """
    if not text.startswith("AC3D"):
        raise ValueError("no AC3D file: it does not begin with AC3D")
    lines = _Lines(text)
    lines.next()  # passes over "AC3D" and the version
    materials: list[Material] = []
    parts: list[Mesh] = []
    try:
        while words := lines.next():
            if words[0] == "MATERIAL":
                materials.append(_material_of_line(words))
            elif words[0] == "OBJECT":
                root = _Object(np.eye(3), np.zeros(3))
                _read_object(lines, root, materials, parts)
            else:
                raise ValueError(f"unknown word {words[0]}")
    except (ValueError, IndexError) as error:
        raise ValueError(f"line {lines.number}: {error}") from error
    if not parts:
        raise ValueError("no triangles")
    return joined(parts).moved(TO_WORLD)


def _material_of_line(words: list[str]) -> Material:
    """A material from its line in an AC3D file.

    Args:
        words: of the line; a quoted name is one word. After "MATERIAL" and the material's name
            come settings, each a word with its numbers, such as "rgb 1 1 1 trans 0 shi 10".
    """
    facts: dict[str, list[float]] = {}
    setting = ""
    for word in words[2:]:
        if word[0].isalpha():
            setting = word
            facts[setting] = []
        else:
            facts[setting].append(float(word))
    red, green, blue = (min(max(value, 0.0), 1.0) for value in facts["rgb"])
    highlight = max(facts.get("spec", [0.0]))  # its strength in the strongest of three colours
    exponent = max(facts.get("shi", [0.0])[0], 1.0)  # Phong's: the size of highlights
    return Material(
        (red, green, blue),
        specular=min(MAX_SPECULAR, SPECULAR_OF_HIGHLIGHT * highlight),
        # With this roughness highlights are as large as with Phong's exponent.
        roughness=float(np.sqrt(2 / (exponent + 2))),
        opacity=1 - facts.get("trans", [0.0])[0],
    )


def _read_object(
    lines: _Lines, parent: _Object, materials: list[Material], parts: list[Mesh]
) -> None:
    """Read an object and those below it; adds their triangles to `parts`.

    Args:
        lines: of the file, of which the object's first one was read.
        parent: whose turn and shift the object has, besides its own.
        materials: of the file; faces name them by their number.
        parts: receives a mesh for each object that has triangles, in the file's axes.

    Raises:
        ValueError: a line cannot be read, or the file ends inside the object.
    """
    own = _Object(parent.turn, parent.shift)
    while words := lines.next():
        kind = words[0]
        if kind == "texture":
            # In TORCS' variant a third word names the layer; the lowest one is called "base".
            layer = words[2] if len(words) > 2 else "base"
            if layer not in UPPER_LAYERS and words[1] != NO_PICTURE:
                own.texture = words[1]
        elif kind == "texrep":
            own.repeat = (float(words[1]), float(words[2]))
        elif kind == "texoff":
            own.offset = (float(words[1]), float(words[2]))
        elif kind == "rot":
            # The file has the matrix for points as rows, which is the transpose.
            rotation = np.array([float(word) for word in words[1:10]]).reshape(3, 3).T
            own.turn = own.turn @ rotation
        elif kind == "loc":
            own.shift = own.shift + parent.turn @ np.array([float(word) for word in words[1:4]])
        elif kind == "data":
            lines.skip(int(words[1]))
        elif kind == "numvert":
            table = lines.numbers(int(words[1]))
            own.points = table[:, :3]
            own.normals = table[:, 3:6] if table.shape[1] >= 6 else None
        elif kind == "numsurf":
            mesh = _read_faces(lines, int(words[1]), own, materials)
            if mesh is not None:
                parts.append(mesh)
        elif kind == "kids":
            for _ in range(int(words[1])):
                first = lines.next()
                if not first:  # the file's end: TORCS' tools write too large a number
                    return
                if first[0] != "OBJECT":
                    raise ValueError(f"expected OBJECT, not {' '.join(first)}")
                _read_object(lines, own, materials, parts)
            return
    raise ValueError("the file ends inside an object")


def _read_faces(lines: _Lines, count: int, own: _Object, materials: list[Material]) -> Mesh | None:
    """The triangles of an object's faces, in the file's axes; None if it has none.

    Args:
        lines: of the file; the next ones are the faces.
        count: the number of faces.
        own: the object, whose points were read.
        materials: of the file.

    Raises:
        ValueError: a face cannot be read, or has a material that does not exist.
    """
    corners: list[int] = []  # three a triangle: rows of the references below
    face_material: list[int] = []
    references: list[list[float]] = []  # index of the point, u, v
    for _ in range(count):
        head = _read_face_head(lines)
        first = len(references)
        references += lines.numbers(head.corners)[:, :3].tolist()
        for triangle in _triangles(head.flags & FACE_KIND, first, head.corners):
            corners += triangle
            face_material.append(head.material)
    if not corners or own.points is None:
        return None
    table = np.array(references)
    index = np.array(corners).reshape(-1, 3)  # [F, 3] rows of `table`
    point = table[index, 0].astype(np.int64)  # [F, 3] rows of `own.points`
    # Triangles whose three points exist and enclose an area; TORCS writes −1 for no point.
    whole = ((point >= 0) & (point < len(own.points))).all(1)
    xyz = own.points[np.where(whole[:, None], point, 0)]
    area = np.linalg.norm(np.cross(xyz[:, 1] - xyz[:, 0], xyz[:, 2] - xyz[:, 0]), axis=1)
    whole &= area > 0
    if not whole.any():
        return None
    xyz = xyz[whole]
    normals = smooth_normals(xyz)
    if own.normals is not None:
        normals = repaired_normals(xyz, own.normals[point[whole]])
    uv = table[index[whole], 1:3] * own.repeat + own.offset
    used = np.array(face_material, np.int32)[whole]
    if used.max() >= len(materials):
        raise ValueError(f"material {used.max()} does not exist: the file has {len(materials)}")
    # In the file pictures belong to objects, in a mesh to materials.
    skins = [dataclasses.replace(one, texture=own.texture) for one in materials]
    mesh = Mesh(xyz.astype(np.float32), normals, uv.astype(np.float32), used, tuple(skins))
    return mesh.moved(own.turn, own.shift.tolist())


class _FaceHead(NamedTuple):
    """The first lines of a face, before those of its corners."""

    flags: int  # `FACE_KIND` and others
    material: int  # its number in the file
    corners: int  # how many lines of corners follow


def _read_face_head(lines: _Lines) -> _FaceHead:
    """The first lines of the next face, up to that which tells its number of corners.

    Raises:
        ValueError: an unknown line, or the file ends.
    """
    flags, material = 0, 0
    while words := lines.next():
        if words[0] == "SURF":
            flags = int(words[1], 16)
        elif words[0] == "mat":
            material = int(words[1])
        elif words[0] == "refs":
            return _FaceHead(flags, material, corners=int(words[1]))
        else:
            raise ValueError(f"unknown word {words[0]} in a face")
    raise ValueError("the file ends inside a face")


def _triangles(kind: int, first: int, number: int) -> Iterator[tuple[int, int, int]]:
    """The triangles of a face, each as the numbers of its three corners; none for lines.

    Args:
        kind: POLYGON, STRIP, or that of lines.
        first: the number of the face's first corner.
        number: how many corners it has; they are numbered one after the other.
    """
    if kind == POLYGON:  # a fan around the first corner
        for second, third in itertools.pairwise(range(first + 1, first + number)):
            yield first, second, third
    elif kind == STRIP:  # every other triangle runs the other way round
        for step in range(number - 2):
            corner = first + step
            if step % 2:
                yield corner + 1, corner, corner + 2
            else:
                yield corner, corner + 1, corner + 2
