"""Gardens behind houses by rules, from the first set of models."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from worlds.houses import choose_style, house, roof_kind
from worlds.library import Library
from worlds.meshes import box, joined, quad
from worlds.outdoors import KERB_M, PEOPLE, Scene, daylight, eye_height, held_camera
from worlds.placing import Box
from worlds.plans import OpenPlan
from worlds.planting import CLIMATES, fence, hedge, plant
from worlds.shell import material_of
from worlds.viewpoints import Viewpoint

Rng = np.random.Generator
LARGE = (
    "childHut childSwing parque trampoline rectangle-swimming-pool garden-hut hammock child_swing "
    "fountain campingTent"
)
SMALL = (
    "dog-house sandpit wheelbarrow ballonFoot tricycle deckChair relaxChair poolLounge beach_chair "
    "round-swimming-pool seesaw stoneLantern lantern football-goal bench hose-reel umbrella"
)
FLOWERS = (
    "bush hedge plant decorativePlant spider_plant tulips tulip white_lily rock1 rock2 rock3 "
    "yuccaPlant mediumIndoorPlant"
)


def garden(rng: Rng, library: Library, cache: Path) -> OpenPlan:
    """A garden behind a house, with its light. The house stands at its far end, the camera before.

    Args:
        rng: for all random choices.
        library: the first set of models.
        cache: below which surfaces are kept.
    """
    scene = Scene(rng, library, cache)
    wide = rng.uniform(10, 22)
    deep = rng.uniform(10, 24)
    climate = CLIMATES[int(rng.integers(len(CLIMATES)))]
    lawn = scene.surface("grass")
    tile = (lawn.tile_m, lawn.tile_m)
    half = wide / 2
    scene.parts.append(
        quad((-400, -400, KERB_M), (800, 0, 0), (0, 800, 0), material_of(lawn), tile)
    )
    # The house, its neighbours, and a terrace before it.
    style = choose_style(rng, scene.surface)
    width = min(wide - 1, rng.uniform(8, 13))
    shift = rng.uniform(-(wide - width) / 2, (wide - width) / 2)
    roofs = roof_kind(rng, town=False)
    own = house(rng, scene.surface, style, width, 9, int(rng.integers(1, 3)), roofs)
    scene.parts.append(own.moved(np.eye(3), (shift - width / 2, deep, KERB_M)))
    scene.taken.append(Box(-half, deep - 0.2, half, deep + 12, 0, 12))
    for side in (-1, 1):
        other = choose_style(rng, scene.surface)
        near = house(
            rng, scene.surface, other, rng.uniform(8, 12), 9, int(rng.integers(1, 3)), roofs
        )
        x = half + 3 if side > 0 else -half - 14
        scene.parts.append(near.moved(np.eye(3), (x, deep + rng.uniform(-3, 5), KERB_M)))
    slabs = scene.surface("paving", "planks", "tiles")
    out = rng.uniform(2.5, 4.5)
    left = shift - width / 2 * rng.uniform(0.5, 1)
    right = shift + width / 2 * rng.uniform(0.5, 1)
    scene.parts.append(
        box((left, deep - out, KERB_M - 0.1), (right, deep, KERB_M + 0.07),
            material_of(slabs), (slabs.tile_m,) * 2)
    )  # fmt: skip
    _terrace(scene, left, right, deep - out, deep)

    _borders(scene, half, deep)
    for side in (-1, 1):
        if rng.random() < 0.8:
            _bed(scene, side, half, deep)
    for _ in range(int(rng.integers(1, 4))):
        plant(scene, climate, rng.uniform(-half + 1, half - 1), rng.uniform(4, deep - out - 0.5))
    for _ in range(6):  # beyond the borders
        x = rng.choice([-1, 1]) * rng.uniform(half + 4, half + 25)
        plant(scene, climate, x, deep + rng.uniform(5, 40))
    for names, count in ((LARGE, int(rng.integers(0, 3))), (SMALL, int(rng.integers(2, 7)))):
        for _ in range(count):
            x = rng.uniform(-half + 1.5, half - 1.5)
            y = rng.uniform(2.5, deep - out - 1)
            scene.put(scene.find(names), x, y, KERB_M, rng.uniform(0, 360), margin=0.2)
    for _ in range(int(rng.integers(0, 4))):
        x = rng.uniform(-half + 1.5, half - 1.5)
        people = scene.find(PEOPLE + " dog cat")
        scene.put(people, x, rng.uniform(2.5, deep - 0.6), KERB_M, rng.uniform(0, 360))

    def draw(draws: Rng, height: int, width_px: int) -> Viewpoint:
        """A camera at the garden's end or at one of its sides, which looks towards the house."""
        x = draws.uniform(-half + 0.8, half - 0.8)
        y = draws.uniform(-2, 0.4 * deep)
        eye = np.array([x, y, KERB_M + eye_height(draws)])
        target = np.array([draws.uniform(-half, half) * 0.7, deep])
        azimuth = math.atan2(target[1] - y, target[0] - x)
        return held_camera(draws, eye.tolist(), azimuth, height, width_px, -0.07)

    return OpenPlan(
        kind="garden",
        mesh=joined(scene.parts),
        pictures=scene.pictures,
        lights=daylight(rng),
        draw_viewpoint=draw,
        models=tuple(sorted(scene.used)),
        coarse_m=0.6,
    )


def _borders(scene: Scene, half: float, deep: float) -> None:
    """A hedge or a fence at both sides of a garden that is 2 · `half` wide."""
    rng = scene.rng
    for start, end in (((-half, -8.0), (-half, deep)), ((half, deep), (half, -8.0))):
        x = start[0]
        if rng.random() < 0.5:
            height = rng.uniform(1.0, 2.1)
            hedge(scene, (x - 0.35, -8, KERB_M), (x + 0.35, deep, KERB_M + height))
        else:
            fence(scene, start, end, rng.uniform(0.9, 1.9), True)
            scene.taken.append(Box(x - 0.2, -8, x + 0.2, deep, 0, 2))


def _bed(scene: Scene, side: int, half: float, deep: float) -> None:
    """Soil along one side of a garden, with shrubs, flowers and rocks."""
    rng = scene.rng
    soil = scene.surface("earth")
    broad = rng.uniform(0.7, 1.6)
    low, high = sorted((side * half, side * (half - broad)))
    tile = (soil.tile_m, soil.tile_m)
    width = (high - low, 0, 0)
    scene.parts.append(quad((low, 0, KERB_M + 0.015), width, (0, deep, 0), material_of(soil), tile))
    for _ in range(int(rng.integers(4, 10))):
        x = side * (half - rng.uniform(0.45, broad))
        scene.put(
            scene.find(FLOWERS),
            x,
            rng.uniform(1, deep - 1),
            KERB_M,
            rng.uniform(0, 360),
            scale=rng.uniform(0.8, 1.4),
            margin=-0.05,
        )


def _terrace(scene: Scene, left: float, right: float, y0: float, y1: float) -> None:
    """Table and chairs, a sofa or deck chairs, flower pots, an umbrella."""
    rng = scene.rng
    z = KERB_M + 0.07
    middle = ((left + right) / 2 + rng.normal(0, 0.5), (y0 + y1) / 2)
    if rng.random() < 0.6:
        chairs = "silla_teca foldingChair cafe-chair plasticChair rattanArmchair"
        chair = (
            [scene.find(chairs)[int(rng.integers(len(scene.find(chairs))))]]
            if scene.find(chairs)
            else []
        )
        tables = "table-on-trestles cafe-table oakTable round-table folding-table"
        if scene.put(scene.find(tables), *middle, z, 0.0):
            for x, y, turn in (
                (-0.5, -0.75, 180),
                (0.5, -0.75, 180),
                (-0.5, 0.75, 0),
                (0.5, 0.75, 0),
            ):
                if rng.random() < 0.8:
                    scene.put(
                        chair,
                        middle[0] + x,
                        middle[1] + y,
                        z,
                        turn + rng.normal(0, 12),
                        margin=-0.2,
                    )
            if rng.random() < 0.4:
                scene.put(
                    scene.find("umbrella"), *middle, z, 0.0, solid=False, margin=-0.4, scale=1.15
                )
    else:
        if scene.put(scene.find("rattanSofa ext_chair wood_bank"), middle[0], y1 - 0.8, z, 0.0):
            scene.put(scene.find("rattanTable ext_table"), middle[0], y1 - 1.9, z, 0.0)
        scene.put(scene.find("rattanArmchair silla_teca"), middle[0] + 1.5, y1 - 1.6, z, -70.0)
    for _ in range(int(rng.integers(2, 7))):
        pots = scene.find(
            "flowerBox plantie maceta plant decorativePlant bonsai-tree ficus yuccaPlant"
        )
        scene.put(
            pots, rng.uniform(left + 0.3, right - 0.3), rng.uniform(y0 + 0.2, y1 - 0.3), z, 0.0
        )
