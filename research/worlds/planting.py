"""Trees, shrubs and hedges, and what stands at the borders of gardens.

All coordinates are metres with z up; gardens are at z = KERB_M. In streets x runs across the road,
whose middle is x = 0, and y along it.
"""

from __future__ import annotations

import math

import numpy as np

from worlds.houses import METAL, leafy, paint
from worlds.meshes import Faces, box
from worlds.outdoors import FULL_DETAIL_M, KERB_M, Scene, plain
from worlds.placing import Box
from worlds.shell import material_of

# Trees that grow in one climate, by the names of their models, separated by spaces.
TREES_OF_CLIMATES = (
    "acacia poplar pine ficusTree cypress bush",
    "copperBeech japaneseMaple poplar pine sycamoreMaple",
    "palm coconutTree cypress ficusTree sabalPalmeto",
    "peachBlossom poplar acacia ficusTree",
)
SHRUBS = "bush hedge high-hedge plant decorativePlant flowerBox plantie"
GREENS = ((0.2, 0.3, 0.1), (0.15, 0.25, 0.09), (0.28, 0.34, 0.12), (0.22, 0.24, 0.13))  # sRGB
CLIPPED = ("cypress", "hedgeTextured")  # plants whose surface is closed; they are never thinned
MAX_PLANT_TRIANGLES = 700_000  # in a world; then no more trees and shrubs are planted
TRIANGLES_OF_PLANT = 80_000  # of a plant close to the camera at most


def plant(scene: Scene, names: str, x: float, y: float, *, tree: bool = True) -> None:
    """Put a random tree or shrub at a place, unless something stands there or plants are enough.

    Those that are far from the camera's usual place, which is (0, 0), have fewer, larger leaves.

    Args:
        scene: gets it.
        names: of models, separated by spaces; one of them is chosen.
        x, y: of its middle in metres.
        tree: whether it is a tree, below whose crown other things may stand.
    """
    rng = scene.rng
    models = scene.find(names)
    if scene.leaves > MAX_PLANT_TRIANGLES or not models:
        return
    model = models[int(rng.integers(len(models)))]
    # 1 for a plant that is near, and less in inverse proportion to its distance.
    nearness = min(1.0, FULL_DETAIL_M / max(scene.distance_to_camera(x, y), 1.0))
    kept_share = min(nearness**1.3, nearness * TRIANGLES_OF_PLANT / model.triangles)
    if model.entry.key.endswith(CLIPPED):
        kept_share = 1.0
    angle = rng.uniform(0, 360)
    scale = rng.uniform(0.75, 1.25)
    ground = KERB_M - 0.02  # 2 cm in the earth
    planted = scene.put(
        [model], x, y, ground, angle, scale=scale, kept_share=kept_share, solid=not tree
    )
    if planted:
        scene.leaves += int(model.triangles * kept_share)


def hedge(
    scene: Scene,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
) -> None:
    """Add a clipped hedge that fills a box, in a random green; its place is then taken.

    Args:
        scene: gets it.
        low, high: corners of the box with the smallest and the largest x, y and z, in metres.
    """
    rng = scene.rng
    low_corner, high_corner = np.array(low), np.array(high)
    size = high_corner - low_corner
    area_m2 = 2 * size[2] * (size[0] + size[1]) + size[0] * size[1]  # of all sides but the lower
    # Leaves are 6 cm long up to 6 m from the camera's place (0, 0), and longer in proportion to
    # the distance from there on. The hedge's nearest point counts.
    nearest_xy = np.clip(0, low_corner[:2], high_corner[:2])
    leaf_m = 0.06 * max(1.0, float(np.linalg.norm(nearest_xy)) / 6)
    # So many leaves that they cover the sides 1.5 times: a leaf of length l has an area of 0.28 l²
    # (see `leafy`).
    count = int(min(30_000, area_m2 * 1.5 / (0.28 * leaf_m * leaf_m)))
    scene.leaves += 2 * count
    green = GREENS[int(rng.integers(len(GREENS)))]
    scene.parts.append(leafy(rng, low_corner, high_corner, count, green, leaf_m))
    scene.taken.append(Box(low[0], low[1], high[0], high[1], low[2], high[2]))


def border(
    scene: Scene, side: int, border_m: float, y0: float, y1: float, near_camera: bool
) -> None:
    """Add what is between a front garden and the pavement: hedge, wall, fence or, in 10 %, nothing.

    Args:
        scene: gets it.
        side: of the street, +1 for x > 0, −1 for x < 0.
        border_m: from the middle of the road, x = 0, to the border's side towards the road.
        y0, y1: where it begins and ends along the street; nothing is added if it is below 1 m.
        near_camera: whether a fence has all of its boards or bars, or every second of them.
    """
    rng = scene.rng
    if y1 - y0 < 1:
        return
    kind = rng.random()
    low_x, high_x = sorted((side * border_m, side * (border_m + 0.25)))
    scene.taken.append(Box(low_x, y0, high_x, y1, 0, 1.2))
    if kind < 0.3:
        height = rng.uniform(0.7, 1.6)
        low_x, high_x = sorted((side * border_m, side * (border_m + 0.55)))
        hedge(scene, (low_x, y0, KERB_M), (high_x, y1, KERB_M + height))
    elif kind < 0.6:
        _add_garden_wall(scene, low_x, high_x, y0, y1)
    elif kind < 0.9:
        start, end = (side * border_m, y0), (side * border_m, y1)
        fence(scene, start, end, rng.uniform(0.8, 1.2), near_camera)


def _add_garden_wall(scene: Scene, low_x: float, high_x: float, y0: float, y1: float) -> None:
    """Add a low wall with a cover of stone, and in some cases a hedge half a metre high on it.

    Args:
        scene: gets it.
        low_x, high_x: of its sides, in metres.
        y0, y1: of its ends.
    """
    rng = scene.rng
    wall = scene.surface("stone_wall", "brick", "plaster")
    top = KERB_M + rng.uniform(0.4, 1.1)
    cover = material_of(scene.surface("concrete"))
    tile = (wall.tile_m, wall.tile_m)
    scene.parts.append(box((low_x, y0, 0), (high_x, y1, top), material_of(wall), tile))
    # The cover is 6 cm thick and reaches 3 to 4 cm over the wall.
    low = (low_x - 0.04, y0 - 0.03, top)
    high = (high_x + 0.04, y1 + 0.03, top + 0.06)
    scene.parts.append(box(low, high, cover))
    if rng.random() < 0.35:
        hedge(scene, (low_x + 0.02, y0, top), (high_x - 0.02 + 0.2, y1, top + 0.5))


def fence(
    scene: Scene,
    start: tuple[float, float],
    end: tuple[float, float],
    height: float,
    near_camera: bool,
) -> None:
    """Add a fence of upright wooden boards or iron bars, with two rails and posts behind them.

    Args:
        scene: gets it.
        start, end: x and y of its ends in metres. Rails and posts are to the left of the way from
            `start` to `end`, seen from above.
        height: of its boards or bars above the ground, which is at KERB_M, in metres.
        near_camera: if not, only every second board or bar is there, as nobody sees the others.
    """
    rng = scene.rng
    length = math.dist(start, end)
    along = (np.array(end) - np.array(start)) / length
    across = np.array([-along[1], along[0]])
    ground = KERB_M
    wooden = rng.random() < 0.65
    material = paint(rng) if rng.random() < 0.6 else material_of(scene.surface("wood"))
    if not wooden:
        material = METAL if rng.random() < 0.5 else plain((0.08, 0.1, 0.09), 0.05, 0.3)
    spacing = 0.13 if wooden else 0.11  # from one board or bar to the next
    spacing *= 1 if near_camera else 2
    bar_width = 0.09 if wooden else 0.018
    faces = Faces()
    # In the fence's own axes: x from `start` to `end`, y through it, z up.
    for x in np.arange(0.05, length, spacing):
        # Boards differ in height by 1 %; bars do not.
        top = ground + height * (1 + (0.01 * rng.normal() if wooden else 0))
        faces.box((x, 0, ground + 0.06), (x + bar_width, 0.02, top), material)
    for share in (0.25, 0.85):  # of the height: two rails, 6 cm high and 3 cm thick
        bottom = ground + share * height
        faces.box((0, 0.02, bottom), (length, 0.05, bottom + 0.06), material)
    # Posts, about 2.2 m from each other.
    post_spacing = max(1.8, length / max(1, round(length / 2.2)))
    for x in np.arange(0, length + 0.01, post_spacing):
        faces.box((x - 0.05, 0.02, 0), (x + 0.05, 0.12, ground + height + 0.08), material)
    turn = np.eye(3)  # its columns are where the fence's axes go
    turn[:2, 0] = along
    turn[:2, 1] = across
    scene.parts.append(faces.mesh().moved(turn, (*start, 0)))
