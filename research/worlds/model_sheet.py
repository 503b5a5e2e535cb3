"""A picture of all models of the library, a small one each, to look at.

    PYTHONPATH=src:research python -m worlds.model_sheet -o SHEETS

Each is seen from the front, above and to the right, in plain light, with its name below.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from spackle.cli.script_command import run_script
from spackle.runtime.folders import make_folder
from worlds.caster import World
from worlds.fetch import open_library
from worlds.library import Library, Model
from worlds.meshes import rotation_z
from worlds.pictures import linear_to_srgb
from worlds.torcs import open_torcs

SIDE_PX = 112
CAPTION_PX = 12
COLUMNS = 14
PER_SHEET = 140  # models
# Where the camera stands: so many degrees to the right of the model's front, and above it.
AZIMUTH = 30.0
ELEVATION = 22.0
BACKGROUND = 0.85  # linear grey
NO_PICTURES: dict[str, NDArray[np.uint8]] = {}  # all pictures of library models are files


def model_picture(library: Library, model: Model, side: int) -> NDArray[np.uint8]:
    """[side, side, 3] sRGB: the model in plain light, filling the picture."""
    # The model is turned, and its middle becomes the origin; the camera then looks towards +y.
    mesh = library.mesh(model)
    middle = (mesh.high + mesh.low) / 2
    turn = rotation_z(-AZIMUTH)
    mesh = mesh.moved(turn, (turn @ -middle).tolist())
    world = World(mesh, NO_PICTURES)
    # Of a ball around the model, in metres; one more millimetre, so that it is never 0.
    radius = float(np.linalg.norm(mesh.corners.reshape(-1, 3), axis=1).max()) + 1e-3

    # One ray for each pixel, N = side² in all. They are parallel, from the front and above, and
    # begin well outside of the ball.
    up_angle = np.radians(ELEVATION)
    forward = np.array([0, np.cos(up_angle), -np.sin(up_angle)])
    right = np.array([1, 0, 0])
    up = np.array([0, np.sin(up_angle), np.cos(up_angle)])
    y, x = np.mgrid[:side, :side]
    to_right = (2 * (x + 0.5) / side - 1).reshape(-1, 1) * radius  # [N, 1] metres
    upwards = (1 - 2 * (y + 0.5) / side).reshape(-1, 1) * radius
    origins = to_right * right + upwards * up - 3 * radius * forward
    directions = np.broadcast_to(forward, origins.shape).astype(np.float32)
    hits = world.first_hits(origins.astype(np.float32), np.ascontiguousarray(directions))

    # Light from everywhere (0.45), from above (0.4), and from the left front (0.25).
    normals, _ = world.normals(hits, directions)
    to_lamp = np.array([[-0.6], [-0.8], [0.0]])  # unit
    light = np.clip(0.45 + 0.4 * normals[:, 2:] + 0.25 * (normals @ to_lamp), 0.05, None)

    pixel_m = np.full(len(origins), 2 * radius / side, np.float32)
    is_model = hits.triangle[:, None] >= 0
    transmittance = hits.transmittance[:, None]  # of panes before the surface
    colors = world.albedo(hits, pixel_m) * light * transmittance
    colors = np.where(is_model, colors, BACKGROUND * transmittance)
    return (linear_to_srgb(colors) * 255).astype(np.uint8).reshape(side, side, 3)


def sheets(library: Library, output: Path) -> None:
    """Write the sheets models-00.png and so on into a folder, sorted by category."""
    models = sorted(library.models, key=lambda model: (model.entry.category, model.entry.key))
    tile_height = SIDE_PX + CAPTION_PX
    for first in range(0, len(models), PER_SHEET):
        part = models[first : first + PER_SHEET]
        rows = math.ceil(len(part) / COLUMNS)
        sheet = Image.new("RGB", (COLUMNS * SIDE_PX, rows * tile_height), "white")
        draw = ImageDraw.Draw(sheet)
        for place, model in enumerate(part):
            corner = (place % COLUMNS * SIDE_PX, place // COLUMNS * tile_height)
            sheet.paste(Image.fromarray(model_picture(library, model, SIDE_PX)), corner)
            name = model.entry.key.split("#")[-1][:18]  # as much as fits
            draw.text((corner[0] + 1, corner[1] + SIDE_PX), name, fill="black")
        sheet.save(output / f"models-{first // PER_SHEET:02d}.png")


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder for the sheets")
    parser.add_argument("--cache", type=Path, default=None, help="where models are kept")
    parser.add_argument("--torcs", action="store_true", help="the second set: tracks and cars")
    options = parser.parse_args()
    make_folder(options.output)
    library = open_torcs(options.cache) if options.torcs else open_library(options.cache)
    sheets(library, options.output)


if __name__ == "__main__":
    sys.exit(run_script(main))
