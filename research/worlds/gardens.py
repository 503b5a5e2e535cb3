"""Gardens behind houses by rules, from the first set of models (see `fetch`).

All coordinates are metres. The garden lies around x = 0, from the camera at y ≈ 0 to the house at
its far end; x is across the garden, z is up, and the lawn is at z = KERB_M. A model that is put at
an angle of 0° looks towards −y, to the camera.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from worlds.houses import choose_style, house, roof_kind
from worlds.library import Library
from worlds.meshes import box, joined, quad
from worlds.outdoors import KERB_M, PEOPLE, Scene, daylight, eye_height, held_camera
from worlds.placing import Box
from worlds.plans import OUTDOORS, WorldPlan
from worlds.planting import TREES_OF_CLIMATES, fence, hedge, plant
from worlds.shell import material_of
from worlds.viewpoints import Viewpoint

Rng = np.random.Generator
BORDERS_BEGIN = -8.0  # y of the ends of hedges and fences behind the camera, in metres
HOUSE_DEPTH_M = 9.0
TERRACE_M = 0.07  # height of a terrace above the lawn
# Models' names, separated by spaces, as `Scene.find` takes them.
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


def garden(rng: Rng, library: Library, cache: Path) -> WorldPlan:
    """A garden that ends at a house: its triangles, light, cameras, and the models in it.

    The garden lies around x = 0; the house stands at its far end, at y = `depth`, and the camera
    before it, near y = 0. Coordinates are metres with z up.

    Args:
        rng: for all random choices.
        library: the models that stand in it, those of `fetch.open_library`.
        cache: a folder; the pictures of made surfaces are kept in its folder `surfaces`, because
            they take long to draw and many worlds share them.
    """
    scene = Scene(rng, library, cache)
    width = rng.uniform(10, 22)  # of the garden, from x = −width / 2 to width / 2
    depth = rng.uniform(10, 24)  # from the camera's place to the house
    trees = TREES_OF_CLIMATES[int(rng.integers(len(TREES_OF_CLIMATES)))]
    lawn = scene.surface("grass")
    half_width = width / 2
    # Grass to the horizon: a square of 800 m around the camera's place.
    lawn_tile = (lawn.tile_m, lawn.tile_m)
    scene.parts.append(
        quad((-400, -400, KERB_M), (800, 0, 0), (0, 800, 0), material_of(lawn), lawn_tile)
    )

    # The house, somewhere at the garden's far end, and its neighbours at both sides.
    style = choose_style(rng, scene.surface)
    house_width = min(width - 1, rng.uniform(8, 13))
    most_shift = (width - house_width) / 2
    house_x = rng.uniform(-most_shift, most_shift)  # its middle
    roof = roof_kind(rng, town=False)
    floors = int(rng.integers(1, 3))
    own_house = house(rng, scene.surface, style, house_width, HOUSE_DEPTH_M, floors, roof)
    # A house looks towards −y as it is made, which is towards the garden.
    not_turned = np.eye(3)
    scene.parts.append(own_house.moved(not_turned, (house_x - house_width / 2, depth, KERB_M)))
    scene.taken.append(Box(-half_width, depth - 0.2, half_width, depth + 12, z0=0, z1=12))
    for side in (-1, 1):
        neighbour_style = choose_style(rng, scene.surface)
        neighbour_width = rng.uniform(8, 12)
        floors = int(rng.integers(1, 3))
        neighbour = house(
            rng, scene.surface, neighbour_style, neighbour_width, HOUSE_DEPTH_M, floors, roof
        )
        # Its left end: 3 m beyond the border, or so that the widest ends 2 m before the border.
        left = half_width + 3 if side > 0 else -half_width - 14
        y = depth + rng.uniform(-3, 5)
        scene.parts.append(neighbour.moved(not_turned, (left, y, KERB_M)))

    # A terrace before the house, which reaches 10 cm into the ground.
    slabs = scene.surface("paving", "planks", "tiles")
    terrace_begin = depth - rng.uniform(2.5, 4.5)  # y of its end towards the camera
    terrace_left = house_x - house_width / 2 * rng.uniform(0.5, 1)
    terrace_right = house_x + house_width / 2 * rng.uniform(0.5, 1)
    low = (terrace_left, terrace_begin, KERB_M - 0.1)
    high = (terrace_right, depth, KERB_M + TERRACE_M)
    scene.parts.append(box(low, high, material_of(slabs), (slabs.tile_m, slabs.tile_m)))
    _furnish_terrace(scene, terrace_left, terrace_right, terrace_begin, depth)

    _add_borders(scene, half_width, depth)
    for side in (-1, 1):
        if rng.random() < 0.8:
            _add_flower_bed(scene, side, half_width, depth)
    for _ in range(int(rng.integers(1, 4))):  # trees on the lawn
        x = rng.uniform(-half_width + 1, half_width - 1)
        plant(scene, trees, x, rng.uniform(4, terrace_begin - 0.5))
    for _ in range(6):  # trees beyond the borders, behind the house's front
        x = rng.choice([-1, 1]) * rng.uniform(half_width + 4, half_width + 25)
        plant(scene, trees, x, depth + rng.uniform(5, 40))
    large_count = int(rng.integers(0, 3))
    small_count = int(rng.integers(2, 7))
    for names, count in ((LARGE, large_count), (SMALL, small_count)):
        for _ in range(count):
            x = rng.uniform(-half_width + 1.5, half_width - 1.5)
            y = rng.uniform(2.5, terrace_begin - 1)
            scene.put(scene.find(names), x, y, KERB_M, rng.uniform(0, 360), margin=0.2)
    for _ in range(int(rng.integers(0, 4))):  # people and animals
        x = rng.uniform(-half_width + 1.5, half_width - 1.5)
        y = rng.uniform(2.5, depth - 0.6)
        scene.put(scene.find(PEOPLE + " dog cat"), x, y, KERB_M, rng.uniform(0, 360))

    def draw_viewpoint(camera_rng: Rng, height_px: int, width_px: int) -> Viewpoint:
        """A camera in the garden's nearer part, which looks at a point of the house's front."""
        x = camera_rng.uniform(-half_width + 0.8, half_width - 0.8)
        y = camera_rng.uniform(-2, 0.4 * depth)
        eye = (float(x), float(y), float(KERB_M + eye_height(camera_rng)))
        target_x = camera_rng.uniform(-half_width, half_width) * 0.7
        azimuth = math.atan2(depth - y, target_x - x)
        return held_camera(camera_rng, eye, azimuth, height_px, width_px, pitch=-0.07)

    return WorldPlan(
        OUTDOORS,
        kind="garden",
        mesh=joined(scene.parts),
        pictures=scene.pictures,
        lights=daylight(rng),
        draw_viewpoint=draw_viewpoint,
        models=tuple(sorted(scene.used)),
        coarse_m=0.6,  # width of the coarse cells of light; gardens are smaller than streets
    )


def _add_borders(scene: Scene, half_width: float, depth: float) -> None:
    """Add a hedge or a fence at the left and at the right side of a garden, and take their places.

    Both begin behind the camera, at y = BORDERS_BEGIN.

    Args:
        scene: gets them.
        half_width: metres; the sides are at x = ± this.
        depth: metres; they end at y = `depth`, at the house.
    """
    rng = scene.rng
    # The ends (x, y) of each. A fence has its rails and posts to the left of the way from the first
    # to the second, so in this order they are outside of the garden.
    left = ((-half_width, BORDERS_BEGIN), (-half_width, depth))
    right = ((half_width, depth), (half_width, BORDERS_BEGIN))
    for start, end in (left, right):
        x = start[0]
        if rng.random() < 0.5:
            top = KERB_M + rng.uniform(1.0, 2.1)
            # `hedge` also adds its box to `scene.taken`; `fence` does not.
            hedge(scene, (x - 0.35, BORDERS_BEGIN, KERB_M), (x + 0.35, depth, top))
        else:
            height = rng.uniform(0.9, 1.9)
            fence(scene, start, end, height, near_camera=True)
            scene.taken.append(Box(x - 0.2, BORDERS_BEGIN, x + 0.2, depth, z0=0, z1=2))


def _add_flower_bed(scene: Scene, side: int, half_width: float, depth: float) -> None:
    """Add a strip of soil along one side of a garden, with shrubs, flowers and rocks.

    Args:
        scene: gets them.
        side: of the garden, +1 for x > 0, −1 for x < 0.
        half_width: metres from the garden's middle, x = 0, to its side.
        depth: metres; the bed goes from y = 0 to `depth`.
    """
    rng = scene.rng
    soil = scene.surface("earth")
    bed_width = rng.uniform(0.7, 1.6)
    low_x, high_x = sorted((side * half_width, side * (half_width - bed_width)))
    corner = (low_x, 0, KERB_M + 0.015)  # 15 mm above the lawn, so as to hide it
    tile = (soil.tile_m, soil.tile_m)
    scene.parts.append(quad(corner, (high_x - low_x, 0, 0), (0, depth, 0), material_of(soil), tile))
    for _ in range(int(rng.integers(4, 10))):
        x = side * (half_width - rng.uniform(0.45, bed_width))
        y = rng.uniform(1, depth - 1)
        angle = rng.uniform(0, 360)
        scale = rng.uniform(0.8, 1.4)
        # Plants may reach 5 cm into each other.
        scene.put(scene.find(FLOWERS), x, y, KERB_M, angle, scale=scale, margin=-0.05)


def _furnish_terrace(scene: Scene, left: float, right: float, begin: float, end: float) -> None:
    """Put a table with chairs or a sofa with an armchair on a terrace; then flower pots.

    Args:
        scene: gets them.
        left, right: x of the terrace's ends in metres.
        begin, end: y of its ends towards the camera and at the house.
    """
    rng = scene.rng
    floor = KERB_M + TERRACE_M
    x = (left + right) / 2 + rng.normal(0, 0.5)
    y = (begin + end) / 2
    if rng.random() < 0.6:
        _add_table(scene, x, y, floor)
    else:
        # A sofa before the house's wall, a low table before it, and an armchair to the right of
        # both, turned towards the table.
        if scene.put(scene.find("rattanSofa ext_chair wood_bank"), x, end - 0.8, floor, 0.0):
            scene.put(scene.find("rattanTable ext_table"), x, end - 1.9, floor, 0.0)
        scene.put(scene.find("rattanArmchair silla_teca"), x + 1.5, end - 1.6, floor, -70.0)
    for _ in range(int(rng.integers(2, 7))):
        pots = scene.find(
            "flowerBox plantie maceta plant decorativePlant bonsai-tree ficus yuccaPlant"
        )
        pot_x = rng.uniform(left + 0.3, right - 0.3)
        pot_y = rng.uniform(begin + 0.2, end - 0.3)
        scene.put(pots, pot_x, pot_y, floor, 0.0)


def _add_table(scene: Scene, x: float, y: float, floor: float) -> None:
    """Put a table, if there is room for it, with up to four equal chairs and maybe an umbrella.

    Args:
        scene: gets them.
        x, y: of the table's middle in metres.
        floor: height on which all stand.
    """
    rng = scene.rng
    chairs = scene.find("silla_teca foldingChair cafe-chair plasticChair rattanArmchair")
    chair = [chairs[int(rng.integers(len(chairs)))]] if chairs else []
    tables = scene.find("table-on-trestles cafe-table oakTable round-table folding-table")
    if not scene.put(tables, x, y, floor, 0.0):
        return
    # From the table's middle to each chair, and the angle at which the chair looks at the table.
    places = ((-0.5, -0.75, 180), (0.5, -0.75, 180), (-0.5, 0.75, 0), (0.5, 0.75, 0))
    for dx, dy, angle in places:
        if rng.random() < 0.8:
            # Chairs stand a few degrees askew, and up to 0.2 m below the table.
            askew = angle + rng.normal(0, 12)
            scene.put(chair, x + dx, y + dy, floor, askew, margin=-0.2)
    if rng.random() < 0.4:
        # Through the table, so that it may reach 0.4 m into it.
        umbrella = scene.find("umbrella")
        scene.put(umbrella, x, y, floor, 0.0, solid=False, margin=-0.4, scale=1.15)
