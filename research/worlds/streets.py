"""Streets by rules, from the first set of models. Read `street` first.

    street   a road with pavements, kerbs and lines; houses on both sides, in rows or apart, with
             gardens, fences and hedges before them; cars parked and driving, trees, lamps, people

The road runs along y, and the camera stands near y = 0. `gardens` has the rules of gardens.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from worlds.gardens import garden
from worlds.houses import choose_style, house, roof_kind
from worlds.library import Library
from worlds.meshes import Faces, Material, Mesh, joined, quad, rotation_z
from worlds.outdoors import KERB_M, PEOPLE, Scene, daylight, eye_height, held_camera, plain
from worlds.placing import Box
from worlds.plans import OpenPlan
from worlds.planting import CLIMATES, SHRUBS, border, hedge, plant
from worlds.shell import material_of
from worlds.viewpoints import Viewpoint

Rng = np.random.Generator
BEGIN, END = -24.0, 115.0  # of the street along y
CARS = (
    "fordFocus concept-sedan-01v2 concept-sedan-01v1 concept-sedan-02 VW-new-beetle seat_leon "
    "peugeot-308 renault-scenic suv smart-car van chevrolet concept-sedan-02-sport"
)
LARGE_CARS = "bus cityBus truck van"
TWO_WHEELS = "bicycle bike scooter2 yamaha-yzr-r6 scooter"


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
        eye = (float(x), float(own.uniform(-3, 3)), level + eye_height(own))
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
    """A flat disc on the ground: the cover of a drain."""
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
    roof = roof_kind(rng, town)
    same = rng.random() < 0.4  # one builder, one style
    while y < END:
        if not same:
            style = choose_style(rng, scene.surface)
            width = rng.uniform(6, 13) if town else rng.uniform(7, 12)
            if rng.random() < 0.6:
                floors = int(rng.integers(2, 6)) if town else int(rng.integers(1, 3))
                roof = roof_kind(rng, town)
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
        border(scene, side, edge + 0.1, y, y + length - gate, near)
        # A border between two neighbours.
        if rng.random() < 0.5:
            low, high = sorted((side * (edge + 0.4), side * (edge + deep - 0.2)))
            height = rng.uniform(0.7, 1.5)
            hedge(scene, (low, y - 0.3, KERB_M), (high, y + 0.2, KERB_M + height))
        for _ in range(int(rng.integers(1, 4))):
            x = side * rng.uniform(edge + 0.8, edge + deep - 0.6)
            at = rng.uniform(y + 0.5, y + length - 0.5)
            plant(scene, SHRUBS, x, at, tree=False)
        if deep > 3 and rng.random() < 0.3 and -8 < y < 60:
            at = y + rng.uniform(1, length - 1)
            x = side * (edge + deep * rng.uniform(0.3, 0.6))
            plant(scene, climate, x, at)
        if rng.random() < 0.35 and near:
            things = scene.find("mofx_mailbox residential-trashcan bicycle wheelbarrow tricycle")
            scene.put(things, side * (edge + 0.7), y + length - gate / 2, KERB_M, -90.0 * side)
        y += length


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
            plant(scene, one, row, y)
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
        plant(scene, climate, rng.uniform(-14, 14), END + rng.uniform(2, 12))
