"""Trees, shrubs and hedges, and what stands at the borders of gardens."""

from __future__ import annotations

import math

import numpy as np

from worlds.houses import METAL, leafy, paint
from worlds.meshes import Faces, box
from worlds.outdoors import FULL_DETAIL_M, KERB_M, Scene, plain
from worlds.placing import Box
from worlds.shell import material_of

# Trees of one climate stand together.
CLIMATES = (
    "acacia poplar pine ficusTree cypress bush",
    "copperBeech japaneseMaple poplar pine sycamoreMaple",
    "palm coconutTree cypress ficusTree sabalPalmeto",
    "peachBlossom poplar acacia ficusTree",
)
SHRUBS = "bush hedge high-hedge plant decorativePlant flowerBox plantie"
GREENS = ((0.2, 0.3, 0.1), (0.15, 0.25, 0.09), (0.28, 0.34, 0.12), (0.22, 0.24, 0.13))
CLIPPED = ("cypress", "hedgeTextured")  # plants whose surface is closed; they are never thinned
MAX_TREES = 700_000  # triangles of plants in a world; then no more are planted
TRIANGLES_OF_PLANT = 80_000  # of a plant close to the camera at most


def plant(scene: Scene, names: str, x: float, y: float, *, tree: bool = True) -> None:
    """A tree or shrub at a place, unless something stands there or there are plants enough.

    Those that are far from the camera's usual place, which is (0, 0), have fewer, larger leaves.
    """
    rng = scene.rng
    models = scene.find(names)
    if scene.leaves > MAX_TREES or not models:
        return
    model = models[int(rng.integers(len(models)))]
    near = min(1.0, FULL_DETAIL_M / max(scene.away(x, y), 1.0))
    keep = min(near**1.3, near * TRIANGLES_OF_PLANT / model.triangles)
    if model.entry.key.endswith(CLIPPED):
        keep = 1.0
    planted = scene.put([model], x, y, KERB_M - 0.02, rng.uniform(0, 360),
                        scale=rng.uniform(0.75, 1.25), keep=keep, solid=not tree)  # fmt: skip
    if planted:
        scene.leaves += int(model.triangles * keep)


def hedge(
    scene: Scene,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
) -> None:
    """A clipped hedge from one corner to the other."""
    rng = scene.rng
    one, other = np.array(low), np.array(high)
    size = other - one
    surface = 2 * size[2] * (size[0] + size[1]) + size[0] * size[1]  # m²
    # Leaves of a far hedge are larger; a kite of length l covers 0.28 l².
    nearest = np.clip(0, one[:2], other[:2])
    leaf = 0.06 * max(1.0, float(np.linalg.norm(nearest)) / 6)
    count = int(min(30_000, surface * 1.5 / (0.28 * leaf * leaf)))
    scene.leaves += 2 * count
    green = GREENS[int(rng.integers(len(GREENS)))]
    scene.parts.append(leafy(rng, one, other, count, green, leaf))
    scene.taken.append(Box(low[0], low[1], high[0], high[1], low[2], high[2]))


def border(scene: Scene, side: int, x: float, y0: float, y1: float, near: bool) -> None:
    """What stands between a garden and the pavement: hedge, wall, fence, railing or nothing."""
    rng = scene.rng
    if y1 - y0 < 1:
        return
    kind = rng.random()
    base = KERB_M
    low, high = sorted((side * x, side * (x + 0.25)))
    scene.taken.append(Box(low, y0, high, y1, 0, 1.2))
    if kind < 0.3:
        height = rng.uniform(0.7, 1.6)
        low, high = sorted((side * x, side * (x + 0.55)))
        hedge(scene, (low, y0, base), (high, y1, base + height))
        return
    if kind < 0.6:
        skin = scene.surface("stone_wall", "brick", "plaster")
        height = rng.uniform(0.4, 1.1)
        tile = (skin.tile_m, skin.tile_m)
        cap = material_of(scene.surface("concrete"))
        scene.parts.append(box((low, y0, 0), (high, y1, base + height), material_of(skin), tile))
        scene.parts.append(
            box((low - 0.04, y0 - 0.03, base + height),
                (high + 0.04, y1 + 0.03, base + height + 0.06), cap)
        )  # fmt: skip
        if rng.random() < 0.35:
            hedge(
                scene, (low + 0.02, y0, base + height), (high - 0.02 + 0.2, y1, base + height + 0.5)
            )
        return
    if kind < 0.9:
        fence(scene, (side * x, y0), (side * x, y1), rng.uniform(0.8, 1.2), near)


def fence(
    scene: Scene, start: tuple[float, float], end: tuple[float, float], height: float, near: bool
) -> None:
    """A fence between two points on the ground: of boards, or of iron bars."""
    rng = scene.rng
    length = math.dist(start, end)
    along = (np.array(end) - np.array(start)) / length
    across = np.array([-along[1], along[0]])
    z = KERB_M
    wooden = rng.random() < 0.65
    skin = paint(rng) if rng.random() < 0.6 else material_of(scene.surface("wood"))
    if not wooden:
        skin = METAL if rng.random() < 0.5 else plain((0.08, 0.1, 0.09), 0.05, 0.3)
    step = 0.13 if wooden else 0.11
    step *= 1 if near else 2
    wide = 0.09 if wooden else 0.018
    faces = Faces()
    # In the fence's own axes: x along it, y through it.
    for at in np.arange(0.05, length, step):
        top = z + height * (1 + (0.01 * rng.normal() if wooden else 0))
        faces.box((at, 0, z + 0.06), (at + wide, 0.02, top), skin)
    for level in (0.25, 0.85):
        bar = z + level * height
        faces.box((0, 0.02, bar), (length, 0.05, bar + 0.06), skin)
    every = max(1.8, length / max(1, round(length / 2.2)))
    for at in np.arange(0, length + 0.01, every):
        faces.box((at - 0.05, 0.02, 0), (at + 0.05, 0.12, z + height + 0.08), skin)
    turn = np.eye(3)
    turn[:2, 0] = along
    turn[:2, 1] = across
    scene.parts.append(faces.mesh().moved(turn, (*start, 0)))
