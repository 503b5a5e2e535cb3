"""Sweet Home 3D's catalogues of furniture: what there is, its size, its licence."""

from __future__ import annotations

import dataclasses
import posixpath
import re
import zipfile
from pathlib import Path

import numpy as np

from worlds.meshes import Mesh
from worlds.obj_files import read_obj

CM = 0.01  # catalogues give centimetres
CATALOGUE_FILE = "PluginFurnitureCatalog.properties"
DEFAULT_TOP = None  # things may stand on the top of the model's box
# Axes of a model file are x right, y up, z towards the viewer; a room has z up and y away.
TO_ROOM = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]], np.float64)


@dataclasses.dataclass(frozen=True)
class Entry:
    """A model of a catalogue."""

    key: str  # "Scopia#bed1": the catalogue and the model's name in it
    name: str
    category: str
    file: str  # path of the OBJ file in the catalogue
    size_m: tuple[float, float, float]  # width, depth, height
    elevation_m: float  # how high it hangs, 0 on the floor
    top_m: float | None  # height at which things stand on it; negative: nothing does
    opening: bool  # a door or a window
    turn: tuple[float, ...] | None  # [9] a rotation of the model, row by row
    creator: str
    licence: str


def read_catalogue(path: Path) -> list[Entry]:
    """All models of a catalogue file (.sh3f)."""
    with zipfile.ZipFile(path) as archive:
        text = archive.read(CATALOGUE_FILE).decode("latin1")
    general = dict(re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE))
    facts: dict[int, dict[str, str]] = {}
    for name, number, value in re.findall(r"^(\w+)#(\d+)=(.*)$", text, re.MULTILINE):
        facts.setdefault(int(number), {})[name] = value.strip()
    licence = general.get("license", "").strip()
    return [_entry(path.stem, one, licence) for one in facts.values()]


def _entry(catalogue: str, facts: dict[str, str], licence: str) -> Entry:
    """A model from its lines in the catalogue."""
    sizes = [float(facts[side]) * CM for side in ("width", "depth", "height")]
    turn = facts.get("modelRotation")
    top = facts.get("dropOnTopElevation")
    return Entry(
        key=f"{catalogue}#{facts['id'].rsplit('#', 1)[-1]}",
        name=facts["name"],
        category=facts["category"],
        file=facts["model"].lstrip("/"),
        size_m=(sizes[0], sizes[1], sizes[2]),
        elevation_m=float(facts.get("elevation", 0)) * CM,
        top_m=None if top is None else float(top) * CM,
        opening=facts.get("doorOrWindow") == "true",
        turn=None if turn is None else tuple(float(word) for word in turn.split()),
        creator=facts.get("creator", ""),
        licence=licence,
    )


def read_model(archive: zipfile.ZipFile, entry: Entry) -> Mesh:
    """A catalogue's model in metres, as it stands in a room.

    Its box has the catalogue's size, is centred at x = y = 0 and stands on z = 0. Its front looks
    towards −y.

    Raises:
        ValueError: the model has no triangles.
    """
    names = {name.lower(): name for name in archive.namelist()}

    def read_file(path: str) -> bytes | None:
        """The content of a file of the catalogue, in any case of letters; None if missing."""
        name = names.get(posixpath.normpath(path).lower())
        return None if name is None else archive.read(name)

    content = read_file(entry.file)
    if content is None:
        raise ValueError(f"{entry.key}: {entry.file} is missing")
    mesh = read_obj(content.decode("latin1"), posixpath.dirname(entry.file), read_file)

    turn = np.eye(3) if entry.turn is None else np.array(entry.turn).reshape(3, 3)
    mesh = mesh.moved(TO_ROOM @ turn)
    sizes = np.maximum(mesh.high - mesh.low, 1e-9)
    scale = np.array(entry.size_m) / sizes
    # A flat side has no size to scale by, and stays flat.
    scale = np.where(sizes > 1e-6 * sizes.max(), scale, 1.0)
    middle = (mesh.high + mesh.low) / 2
    offset = -np.array([middle[0], middle[1], mesh.low[2]]) * scale
    return mesh.moved(np.diag(scale), offset.tolist())
