"""Streets and gardens by rules, from the first set of models. Read `street` and `garden` first.

    street   a road with pavements, kerbs and lines; houses on both sides, in rows or apart, with
             gardens, fences and hedges before them; cars parked and driving, trees, lamps, people
    garden   a lawn behind a house, with a terrace, beds, hedges or fences around, trees, toys

The road runs along y, and the camera stands near y = 0.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from worlds.houses import (
    METAL,
    RoofKind,
    choose_style,
    house,
    leafy,
    paint,
)
from worlds.library import Library
from worlds.meshes import Faces, Material, Mesh, box, joined, quad, rotation_z
from worlds.outdoors import FULL_DETAIL_M, MAX_TREES, Scene, daylight, held_camera, plain
from worlds.placing import Box
from worlds.plans import OpenPlan
from worlds.shell import material_of
from worlds.viewpoints import Viewpoint

Rng = np.random.Generator
KERB_M = 0.12  # height of pavements above the road
BEGIN, END = -24.0, 115.0  # of the street along y
CARS = (
    "fordFocus concept-sedan-01v2 concept-sedan-01v1 concept-sedan-02 VW-new-beetle seat_leon "
    "peugeot-308 renault-scenic suv smart-car van chevrolet concept-sedan-02-sport"
)
LARGE_CARS = "bus cityBus truck van"
TWO_WHEELS = "bicycle bike scooter2 yamaha-yzr-r6 scooter"
PEOPLE = (
    "female01 female02 female03 male01 male02 male03 boyStanding girlStanding holdingFemale01 "
    "holdingMale01 female-01-casual-clothing male-01-suit"
)
# Trees of one climate stand together.
CLIMATES = (
    "acacia poplar pine ficusTree cypress bush",
    "copperBeech japaneseMaple poplar pine sycamoreMaple",
    "palm coconutTree cypress ficusTree sabalPalmeto",
    "peachBlossom poplar acacia ficusTree",
)
SHRUBS = "bush hedge high-hedge plant decorativePlant flowerBox plantie"
GREENS = ((0.2, 0.3, 0.1), (0.15, 0.25, 0.09), (0.28, 0.34, 0.12), (0.22, 0.24, 0.13))
ROOFS: tuple[RoofKind, ...] = ("ridge along", "ridge across", "flat")


def street_or_garden(rng: Rng, library: Library, cache: Path) -> OpenPlan:
    """A street in three of four cases, otherwise a garden, with its light.

    Args:
        rng: for all random choices.
        library: the first set of models.
        cache: below which surfaces are kept.
    """
    return street(rng, library, cache) if rng.random() < 0.75 else garden(rng, library, cache)


def street(rng: Rng, library: Library, cache: Path) -> OpenPlan:
    """A street with its light.

    Args:
        rng: for all random choices.
        library: the first set of models.
        cache: below which surfaces are kept.
    """
    scene = Scene(rng, library, cache)
    town = rng.random() < 0.5  # rows of high houses; otherwise single ones with gardens
    road = rng.uniform(2.7, 3.6) if not town else rng.uniform(2.9, 4.6)  # half of its width
    walk = rng.uniform(1.4, 2.4) if not town else rng.uniform(1.8, 3.6)  # width of a pavement
    garden_m = rng.uniform(2.5, 8.0) if not town else float(rng.choice([0.0, 1.8], p=[0.7, 0.3]))
    parking = rng.uniform(0.25, 0.85) if rng.random() < 0.85 else 0.0  # how many places are taken
    climate = CLIMATES[int(rng.integers(len(CLIMATES)))]
    edge = road + walk  # where gardens or houses begin, from the middle of the road

    _ground(scene, road, walk, garden_m)
    for side in (-1, 1):
        _houses(scene, side, edge, garden_m, town)
        if garden_m > 1:
            _front_gardens(scene, side, edge, garden_m, climate)
        _pavement(scene, side, road, walk, town, climate)
        _park(scene, side, road, parking)
    _end_of_street(scene, climate)
    _traffic(scene, road)

    def draw(own: Rng, height: int, width: int) -> Viewpoint:
        """A camera on a pavement, on the road, or at a garden's border."""
        place = own.random()
        if place < 0.55:
            x = own.choice([-1, 1]) * own.uniform(road + 0.3, edge - 0.3)
        elif place < 0.85:
            x = own.uniform(-road, road)
        else:
            x = own.choice([-1, 1]) * (edge + own.uniform(-0.2, min(1.0, garden_m + 0.01)))
        level = KERB_M if abs(x) > road else 0.0
        eye = (float(x), float(own.uniform(-3, 3)), level + _eye_height(own))
        # Along the street, a little towards its other side; sometimes straight at the houses.
        turn = own.normal(0, 0.22) + 0.16 * np.sign(x)
        if own.random() < 0.22:
            turn = np.sign(x) * own.uniform(0.5, 1.3)
        return held_camera(own, eye, math.pi / 2 + float(turn), height, width)

    return OpenPlan(
        kind="town street" if town else "suburban street",
        mesh=joined(scene.parts),
        pictures=scene.pictures,
        lights=daylight(rng),
        draw_viewpoint=draw,
        models=tuple(sorted(scene.used)),
        coarse_m=1.0,
    )


def _eye_height(rng: Rng) -> float:
    """Metres above the ground: standing in most cases, sometimes stooping."""
    return float(rng.uniform(1.35, 1.75) if rng.random() < 0.8 else rng.uniform(0.6, 1.3))


def _ground(scene: Scene, road: float, walk: float, garden_m: float) -> None:
    """Road, lines, kerbs, pavements, and gardens behind them."""
    rng = scene.rng
    length = END - BEGIN + 60
    start = BEGIN - 30
    tar = scene.surface("asphalt", "asphalt", "asphalt", "cobbles")
    slabs = scene.surface("paving")
    lawn = scene.surface("grass")
    stone = scene.surface("concrete")

    def strip(x0: float, x1: float, z: float, skin: Material, tile_m: float) -> Mesh:
        """A part of the ground along the whole street."""
        offset = (x0 / tile_m, start / tile_m)
        return quad((x0, start, z), (x1 - x0, 0, 0), (0, length, 0), skin, (tile_m,) * 2, offset)

    parts = scene.parts
    faces = Faces()
    parts.append(strip(-road, road, 0.0, material_of(tar), tar.tile_m))
    yard = scene.surface("grass", "grass", "earth") if garden_m > 1 else slabs
    for side in (-1, 1):
        low, high = sorted((side * road, side * (road + walk)))
        parts.append(strip(low, high, KERB_M, material_of(slabs), slabs.tile_m))
        low, high = sorted((side * (road + walk), side * (road + walk + garden_m + 40)))
        parts.append(strip(low, high, KERB_M, material_of(yard), yard.tile_m))
        # Kerbstones of a metre each, with small joints; far ones are longer.
        low, high = sorted((side * (road - 0.02), side * (road + 0.13)))
        top = KERB_M + 0.012
        edge = material_of(stone)
        y = BEGIN
        while y < END:
            size = 1.0 if y < 40 else 8.0
            faces.box((low, y + 0.006, -0.05), (high, y + size - 0.006, top), edge)
            y += size
    parts.append(faces.mesh())
    far = material_of(lawn)
    parts.append(quad((-600, -600, -0.06), (1200, 0, 0), (0, 1200, 0), far, (lawn.tile_m,) * 2))

    # Lines, covers of drains, and places where the road was mended.
    if tar.kind == "asphalt":
        white = plain([rng.uniform(0.62, 0.8)] * 3)
        if rng.random() < 0.65:
            every = rng.choice([4.0, 6.0, 9.0])
            for y in np.arange(BEGIN, END, every):
                parts.append(quad((-0.06, y, 0.006), (0.12, 0, 0), (0, every * 0.5, 0), white))
        if rng.random() < 0.3:
            for side in (-1, 1):
                x = side * (road - 0.35) - 0.05
                parts.append(quad((x, BEGIN, 0.006), (0.1, 0, 0), (0, END - BEGIN, 0), white))
        for _ in range(int(rng.integers(0, 6))):
            other = scene.surface("asphalt")
            x, y = rng.uniform(-road, road - 1), rng.uniform(-4, 40)
            wide, long = rng.uniform(0.6, 2.0), rng.uniform(0.8, 6)
            shade = float(rng.uniform(0.7, 0.95))
            patch = material_of(other, (shade,) * 3)
            parts.append(
                quad((x, y, 0.003), (wide, 0, 0), (0, long, 0), patch, (other.tile_m,) * 2)
            )
        if rng.random() < 0.3:  # a crossing
            y = rng.uniform(5, 18)
            for x in np.arange(-road + 0.3, road - 0.4, 0.95):
                parts.append(quad((x, y, 0.007), (0.5, 0, 0), (0, 3.2, 0), white))
    iron = plain((0.2, 0.19, 0.18), 0.05, 0.5)
    for _ in range(4):
        x, y = rng.uniform(-road + 0.5, road - 0.5), rng.uniform(1, 40)
        _disc(scene, x, y, 0.009, 0.32, iron)


def _disc(scene: Scene, x: float, y: float, z: float, radius: float, material: Material) -> None:
    """A flat disc on the ground, with a raised cross."""
    angle = 2 * math.pi * np.arange(17) / 16
    ring = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(17, z)], -1)
    corners = np.stack([np.broadcast_to((x, y, z), (16, 3)), ring[:-1], ring[1:]], 1)
    up = np.broadcast_to((0, 0, 1), corners.shape)
    scene.parts.append(
        Mesh(
            corners.astype(np.float32),
            up.astype(np.float32),
            np.zeros((16, 3, 2), np.float32),
            np.zeros(16, np.int32),
            (material,),
        )
    )


def _stood(mesh: Mesh, side: int, front: float, y0: float, y1: float) -> Mesh:
    """A house with its front at x = `side` · `front` towards the road, from y0 to y1."""
    if side > 0:  # its right end, seen from the road, is the near one
        return mesh.moved(rotation_z(-90), (front, y1, KERB_M))
    return mesh.moved(rotation_z(90), (-front, y0, KERB_M))


def _houses(scene: Scene, side: int, edge: float, garden_m: float, town: bool) -> None:
    """Houses along one side of the street."""
    rng = scene.rng
    y = BEGIN + rng.uniform(-4, 2)
    style = choose_style(rng, scene.surface)
    terrace = town or rng.random() < 0.3
    floors = int(rng.integers(2, 5)) if town else int(rng.integers(1, 3))
    width = rng.uniform(6, 9)
    roof = ROOFS[int(rng.choice(3, p=[0.6, 0.1, 0.3] if town else [0.5, 0.45, 0.05]))]
    same = rng.random() < 0.4  # one builder, one style
    while y < END:
        if not same:
            style = choose_style(rng, scene.surface)
            width = rng.uniform(6, 13) if town else rng.uniform(7, 12)
            if rng.random() < 0.6:
                floors = int(rng.integers(2, 6)) if town else int(rng.integers(1, 3))
                roof = ROOFS[int(rng.choice(3, p=[0.6, 0.1, 0.3] if town else [0.5, 0.45, 0.05]))]
        if terrace and roof == "ridge across":
            roof = "ridge along"
        gap = 0.0 if terrace else rng.uniform(2.5, 7)
        back = edge + garden_m + (0 if terrace else rng.uniform(0, 1.5))
        near = y < 45  # farther ones need no small parts
        mesh = house(
            rng,
            scene.surface,
            style,
            width,
            rng.uniform(8, 11),
            floors,
            roof,
            shop=town and garden_m == 0 and rng.random() < 0.45,
            balconies=town and near and rng.random() < 0.25,
        )
        scene.parts.append(_stood(mesh, side, back, y, y + width))
        low, high = sorted((side * back, side * (back + 11)))
        scene.taken.append(Box(low, y, high, y + width, 0, 20))
        if not town and garden_m > 4 and near and rng.random() < 0.4 and gap > 2.4:
            # A car on the drive beside the house.
            x = side * (edge + garden_m * 0.55)
            turn = -90.0 if side > 0 else 90.0
            scene.put(scene.find(CARS), x, y + width + gap / 2, KERB_M, turn, painted=True)
        y += width + gap


def _front_gardens(scene: Scene, side: int, edge: float, deep: float, climate: str) -> None:
    """Hedges, walls or fences towards the pavement; shrubs and trees behind."""
    rng = scene.rng
    y = BEGIN
    while y < 70:
        length = rng.uniform(6, 11)
        gate = rng.uniform(1.2, 3.2)
        near = -8 < y < 30
        _border(scene, side, edge + 0.1, y, y + length - gate, near)
        # A border between two neighbours.
        if rng.random() < 0.5:
            low, high = sorted((side * (edge + 0.4), side * (edge + deep - 0.2)))
            height = rng.uniform(0.7, 1.5)
            _hedge(scene, (low, y - 0.3, KERB_M), (high, y + 0.2, KERB_M + height))
        for _ in range(int(rng.integers(1, 4))):
            x = side * rng.uniform(edge + 0.8, edge + deep - 0.6)
            at = rng.uniform(y + 0.5, y + length - 0.5)
            _plant(scene, SHRUBS, x, at, tree=False)
        if deep > 3 and rng.random() < 0.3 and -8 < y < 60:
            at = y + rng.uniform(1, length - 1)
            x = side * (edge + deep * rng.uniform(0.3, 0.6))
            _plant(scene, climate, x, at)
        if rng.random() < 0.35 and near:
            things = scene.find("mofx_mailbox residential-trashcan bicycle wheelbarrow tricycle")
            scene.put(things, side * (edge + 0.7), y + length - gate / 2, KERB_M, -90.0 * side)
        y += length


def _plant(scene: Scene, names: str, x: float, y: float, *, tree: bool = True) -> None:
    """A tree or shrub at a place, unless something stands there or there are plants enough.

    Those that are far from the camera's usual place, which is (0, 0), have fewer, larger leaves.
    """
    rng = scene.rng
    models = scene.find(names)
    if scene.leaves > MAX_TREES or not models:
        return
    model = models[int(rng.integers(len(models)))]
    away = max(math.hypot(x, y), 1.0)
    keep = min(1.0, (FULL_DETAIL_M / away) ** 1.3)
    planted = scene.put([model], x, y, KERB_M - 0.02, rng.uniform(0, 360),
                        scale=rng.uniform(0.75, 1.25), keep=keep, solid=not tree)  # fmt: skip
    if planted:
        scene.leaves += int(model.triangles * keep)


def _hedge(
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
    leaf = 0.075 * max(1.0, float(np.linalg.norm(nearest)) / 6)
    count = int(min(25_000, surface * 1.5 / (0.28 * leaf * leaf)))
    scene.leaves += 2 * count
    green = GREENS[int(rng.integers(len(GREENS)))]
    scene.parts.append(leafy(rng, one, other, count, green, leaf))
    scene.taken.append(Box(low[0], low[1], high[0], high[1], low[2], high[2]))


def _border(scene: Scene, side: int, x: float, y0: float, y1: float, near: bool) -> None:
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
        _hedge(scene, (low, y0, base), (high, y1, base + height))
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
            _hedge(
                scene, (low + 0.02, y0, base + height), (high - 0.02 + 0.2, y1, base + height + 0.5)
            )
        return
    if kind < 0.9:
        _fence(scene, (side * x, y0), (side * x, y1), rng.uniform(0.8, 1.2), near)


def _fence(
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


def _pavement(scene: Scene, side: int, road: float, walk: float, town: bool, climate: str) -> None:
    """Lamps and trees in a row at the kerb; bins, benches and people."""
    rng = scene.rng
    row = side * (road + 0.55)
    # Lamps look over the road.
    lamp_turn = -90.0 if side > 0 else 90.0
    lamps = scene.find("candelabre") if rng.random() < 0.6 else scene.find("farola1")
    every = rng.uniform(18, 28)
    for y in np.arange(rng.uniform(-10, 6), 80, every):
        if rng.random() < 0.9:
            scene.put(lamps, row, y, KERB_M, lamp_turn, scale=rng.uniform(0.95, 1.1), solid=False)
    if rng.random() < (0.5 if walk > 1.8 else 0.25):
        every = rng.uniform(7, 14)
        one = climate.split()[int(rng.integers(len(climate.split())))]
        for y in np.arange(rng.uniform(-6, 8), 75, every):
            _plant(scene, one, row, y)
    for _ in range(int(rng.integers(2, 9)) if town else int(rng.integers(0, 5))):
        x = side * rng.uniform(road + 0.5, road + walk - 0.3)
        y = rng.uniform(2.0, 35)
        scene.put(
            scene.find(PEOPLE),
            x,
            y,
            KERB_M,
            float(rng.choice([0, 180, rng.uniform(0, 360)])),
            margin=0.2,
        )
    things = (
        "park-trashcan concrete-bench painted-bench wood_bank fire-hydrant residential-trashcan"
    )
    if town:
        things += " plantie letters_box cafe-table"
    for _ in range(int(rng.integers(1, 6))):
        x = side * (road + float(rng.choice([0.5, walk - 0.45])))
        scene.put(scene.find(things), x, rng.uniform(1.5, 30), KERB_M, lamp_turn, margin=0.2)
    for _ in range(int(rng.integers(0, 4))):
        x = side * (road + rng.uniform(0.4, 0.9))
        scene.put(
            scene.find(TWO_WHEELS), x, rng.uniform(1.5, 30), KERB_M, rng.normal(0, 15), margin=0.1
        )
    if town and walk > 2.4 and rng.random() < 0.4:  # a café
        y = rng.uniform(4, 14)
        for _ in range(int(rng.integers(2, 5))):
            x = side * (road + walk - 0.9)
            if scene.put(scene.find("cafe-table"), x, y, KERB_M, 0.0):
                for turn in (0.0, 180.0):
                    away = 0.6 if turn else -0.6
                    scene.put(scene.find("cafe-chair"), x, y - away, KERB_M, turn + 180, margin=0)
                if rng.random() < 0.5:
                    scene.put(
                        scene.find("umbrella"), x, y, KERB_M + 0.02, 0.0, solid=False, margin=-0.3
                    )
            y += rng.uniform(2.2, 3)


def _park(scene: Scene, side: int, road: float, share: float) -> None:
    """Cars at the kerb, at a share of all places."""
    rng = scene.rng
    y = rng.uniform(-14, -8)
    while y < 80:
        if rng.random() < share and abs(y) > 2.2:
            x = side * (road - 1.05 + rng.normal(0, 0.05))
            # Cars look along their lane, and few of them back.
            ahead = (side > 0) != (rng.random() < 0.1)
            angle = (180.0 if ahead else 0.0) + rng.normal(0, 1.2)
            scene.put(scene.find(CARS), x, y, 0.0, angle, painted=True)
        y += rng.uniform(5.0, 6.0)


def _traffic(scene: Scene, road: float) -> None:
    """A few vehicles that drive, on the right."""
    rng = scene.rng
    lane = max(0.95, road * 0.38)
    for _ in range(int(rng.integers(0, 5))):
        side = int(rng.choice([-1, 1]))
        models = scene.find(LARGE_CARS if rng.random() < 0.25 else CARS)
        angle = 180.0 if side > 0 else 0.0
        scene.put(models, side * lane, rng.uniform(9, 70), 0.0, angle, painted=True, margin=0.2)


def _end_of_street(scene: Scene, climate: str) -> None:
    """Trees or a house where the road ends, far away."""
    rng = scene.rng
    if rng.random() < 0.5:
        style = choose_style(rng, scene.surface)
        width = rng.uniform(18, 30)
        mesh = house(rng, scene.surface, style, width, 10, int(rng.integers(2, 5)), "ridge along")
        scene.parts.append(mesh.moved(np.eye(3), (-width / 2, END + 14, KERB_M)))
    for _ in range(5):
        _plant(scene, climate, rng.uniform(-14, 14), END + rng.uniform(2, 12))


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
    roofs = ROOFS[int(rng.choice(3, p=[0.5, 0.4, 0.1]))]
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

    # Hedges, fences or walls at both sides and behind the camera.
    for start, end in (((-half, -8.0), (-half, deep)), ((half, deep), (half, -8.0))):
        if rng.random() < 0.5:
            x = start[0]
            height = rng.uniform(1.0, 2.1)
            _hedge(scene, (x - 0.35, -8, KERB_M), (x + 0.35, deep, KERB_M + height))
        else:
            _fence(scene, start, end, rng.uniform(0.9, 1.9), True)
            scene.taken.append(Box(start[0] - 0.2, -8, start[0] + 0.2, deep, 0, 2))
    # Beds along the borders, with shrubs and flowers.
    soil = scene.surface("earth")
    for side in (-1, 1):
        if rng.random() < 0.8:
            broad = rng.uniform(0.7, 1.6)
            low, high = sorted((side * half, side * (half - broad)))
            scene.parts.append(
                quad((low, 0, KERB_M + 0.015), (high - low, 0, 0), (0, deep, 0),
                     material_of(soil), (soil.tile_m,) * 2)
            )  # fmt: skip
            for _ in range(int(rng.integers(4, 10))):
                plants = scene.find(
                    "bush hedge plant decorativePlant spider_plant tulips tulip white_lily "
                    "rock1 rock2 rock3 yuccaPlant mediumIndoorPlant"
                )
                x = side * (half - rng.uniform(0.45, broad))
                scene.put(plants, x, rng.uniform(1, deep - 1), KERB_M, rng.uniform(0, 360),
                          scale=rng.uniform(0.8, 1.4), margin=-0.05)  # fmt: skip
    for _ in range(int(rng.integers(1, 4))):
        x = rng.uniform(-half + 1, half - 1)
        _plant(scene, climate, x, rng.uniform(4, deep - out - 0.5))
    for _ in range(6):  # beyond the borders
        x = rng.choice([-1, 1]) * rng.uniform(half + 4, half + 25)
        _plant(scene, climate, x, deep + rng.uniform(5, 40))
    big = "childHut childSwing parque trampoline rectangle-swimming-pool garden-hut hammock " \
          "child_swing fountain campingTent"  # fmt: skip
    small = "dog-house sandpit wheelbarrow ballonFoot tricycle deckChair relaxChair poolLounge " \
            "beach_chair round-swimming-pool seesaw stoneLantern lantern football-goal " \
            "bench hose-reel umbrella"  # fmt: skip
    for names, count in ((big, int(rng.integers(0, 3))), (small, int(rng.integers(2, 7)))):
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
        eye = np.array([x, y, KERB_M + _eye_height(draws)])
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
