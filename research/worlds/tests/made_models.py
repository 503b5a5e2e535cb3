"""A catalogue of boxes, as a file like those of Sweet Home 3D, and lights."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from worlds.lights import Lights

BOX = """mtllib box.mtl
v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
v -1 2 -1
v 1 2 -1
v 1 2 1
v -1 2 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl skin
f 1/1 2/2 3/3 4/4
f 8/1 7/2 6/3 5/4
f 1/1 5/2 6/3 2/4
f 2/1 6/2 7/3 3/4
usemtl grey
f 3/1 7/2 8/3 4/4
f 4/1 8/2 5/3 1/4
"""
MTL = """newmtl skin
Kd 0.8 0.8 0.8
map_Kd picture.png
newmtl grey
Kd 0.6 0.6 0.6
Ks 0.5 0.5 0.5
Ns 100
"""
# Name, width, depth, height in cm, and the height on which things stand.
MadeModel = tuple[str, int, int, int, str | None]
MODELS: tuple[MadeModel, ...] = (
    ("sofa", 180, 80, 80, "40"),
    ("chair", 45, 45, 85, "45"),
    ("table", 140, 80, 75, None),
    ("coffeeTable", 100, 60, 45, None),
    ("bookcase", 80, 30, 180, "180"),
    ("plant", 40, 40, 90, "-1"),
    ("bed1", 160, 200, 60, "55"),
    ("desk", 140, 70, 74, "74"),
    ("chest", 120, 45, 80, None),
    ("book", 20, 14, 3, None),
    ("lamp", 25, 25, 45, "-1"),
    ("cup", 8, 8, 9, None),
)


def write_catalogue(path: Path, models: Sequence[MadeModel] = MODELS) -> None:
    """Write a catalogue whose models are all boxes."""
    lines = ["name=Boxes", "license=CC0"]
    picture = io.BytesIO()
    Image.new("RGB", (8, 8), (200, 60, 40)).save(picture, "PNG")
    with zipfile.ZipFile(path, "w") as archive:
        for number, (name, width, depth, height, top) in enumerate(models, 1):
            facts = {
                "id": f"Boxes#{name}",
                "name": name.title(),
                "category": "Boxes",
                "model": f"/boxes/{name}/box.obj",
                "width": width,
                "depth": depth,
                "height": height,
                "doorOrWindow": "false",
                "creator": "A tester",
            }
            if top is not None:
                facts["dropOnTopElevation"] = top
            lines += [f"{key}#{number}={value}" for key, value in facts.items()]
            archive.writestr(f"boxes/{name}/box.obj", BOX)
            archive.writestr(f"boxes/{name}/box.mtl", MTL)
            archive.writestr(f"boxes/{name}/picture.png", picture.getvalue())
        archive.writestr("PluginFurnitureCatalog.properties", "\n".join(lines))


def lights(**changes: object) -> Lights:
    """A white sky and nothing else, but for the changes."""
    facts: dict[str, object] = {
        "sky": np.ones((8, 16, 3), np.float32),
        "sun_direction": np.array([0, 0, 1], np.float32),
        "sun_color": np.zeros(3, np.float32),
        "sun_spread": 0.0,
        "portals": np.zeros((0, 3, 3), np.float32),
        "lamp_positions": np.zeros((0, 3), np.float32),
        "lamp_radii": np.zeros(0, np.float32),
        "lamp_colors": np.zeros((0, 3), np.float32),
    }
    return Lights(**(facts | changes))  # type: ignore[arg-type]
