"""Streets by rules, from the first set of models (see `fetch`). Read `street` first.

    street   a road with pavements, kerbs and lines; houses on both sides, in rows or apart, with
             gardens, fences and hedges before them; cars parked and driving, trees, lamps, people

All coordinates are metres. The road runs along y with its middle at x = 0: x is across the street,
z is up, and the road's surface is at z = 0. The camera stands near y = 0 and looks towards +y.
`side` is +1 for what stands at x > 0, right of the camera, and −1 for what stands at x < 0. A model
that is put at an angle of 0° looks towards −y, to the camera; at 180° it looks along the street,
and at −90° · `side` across it, towards the road. `gardens` has the rules of gardens.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from worlds.gardens import garden
from worlds.houses import choose_style, house, roof_kind
from worlds.library import Library
from worlds.meshes import Faces, Material, Mesh, joined, quad, rotation_z
from worlds.outdoors import KERB_M, PEOPLE, Scene, daylight, eye_height, held_camera, plain
from worlds.placing import Box
from worlds.plans import OUTDOORS, WorldPlan
from worlds.planting import SHRUBS, TREES_OF_CLIMATES, border, hedge, plant
from worlds.shell import material_of
from worlds.viewpoints import Viewpoint

Rng = np.random.Generator
BEGIN, END = -24.0, 115.0  # y of the street's ends; the first lies behind the camera
# Models' names, separated by spaces, as `Scene.find` takes them.
CARS = (
    "fordFocus concept-sedan-01v2 concept-sedan-01v1 concept-sedan-02 VW-new-beetle seat_leon "
    "peugeot-308 renault-scenic suv smart-car van chevrolet concept-sedan-02-sport"
)
LARGE_CARS = "bus cityBus truck van"
TWO_WHEELS = "bicycle bike scooter2 yamaha-yzr-r6 scooter"


@dataclasses.dataclass(frozen=True)
class Layout:
    """What is decided of a street before it is built; widths are metres across the street."""

    town: bool  # rows of high houses; otherwise a suburb: lower ones, most with gardens
    half_road_m: float  # from the middle of the road to each kerb
    pavement_m: float  # whole width of each of the two pavements
    garden_m: float  # from a pavement to the houses; 0: they stand at the pavement
    trees: str  # names of models of trees that grow in one climate, separated by spaces

    @property
    def pavement_end_m(self) -> float:
        """Metres from the middle of the road to where gardens or houses begin."""
        return self.half_road_m + self.pavement_m


def street_or_garden(rng: Rng, library: Library, cache: Path) -> WorldPlan:
    """A street in three of four cases, otherwise a garden: its triangles, light and cameras.

    Args:
        rng: for all random choices.
        library: the models that stand in it, those of `fetch.open_library`.
        cache: a folder; the pictures of made surfaces are kept in its folder `surfaces`, because
            they take long to draw and many worlds share them.
    """
    return street(rng, library, cache) if rng.random() < 0.75 else garden(rng, library, cache)


def street(rng: Rng, library: Library, cache: Path) -> WorldPlan:
    """A street: its triangles, light, cameras, and the models in it.

    The street runs along y with the middle of its road at x = 0; x is across it, z up, in metres.

    Args:
        rng: for all random choices.
        library: the models that stand in it, those of `fetch.open_library`.
        cache: a folder; the pictures of made surfaces are kept in its folder `surfaces`, because
            they take long to draw and many worlds share them.
    """
    scene = Scene(rng, library, cache)
    town = rng.random() < 0.5
    half_road_m = rng.uniform(2.7, 3.6) if not town else rng.uniform(2.9, 4.6)
    pavement_m = rng.uniform(1.4, 2.4) if not town else rng.uniform(1.8, 3.6)
    garden_m = rng.uniform(2.5, 8.0) if not town else float(rng.choice([0.0, 1.8], p=[0.7, 0.3]))
    # The fraction of the places at the kerb in which a car is parked; some streets have none.
    parked_share = rng.uniform(0.25, 0.85) if rng.random() < 0.85 else 0.0
    trees = TREES_OF_CLIMATES[int(rng.integers(len(TREES_OF_CLIMATES)))]
    layout = Layout(town, half_road_m, pavement_m, garden_m, trees)

    _add_ground(scene, layout)
    for side in (-1, 1):
        _add_houses(scene, layout, side)
        if garden_m > 1:
            _add_front_gardens(scene, layout, side)
        _furnish_pavement(scene, layout, side)
        _park_cars(scene, half_road_m, side, parked_share)
    _close_far_end(scene, trees)
    _add_traffic(scene, half_road_m)

    def draw_viewpoint(camera_rng: Rng, height_px: int, width_px: int) -> Viewpoint:
        """A camera on a pavement, on the road, or at the border of a garden or house."""
        where = camera_rng.random()
        if where < 0.55:  # on a pavement, 0.3 m from its ends
            nearest, farthest = half_road_m + 0.3, layout.pavement_end_m - 0.3
            x = camera_rng.choice([-1, 1]) * camera_rng.uniform(nearest, farthest)
        elif where < 0.85:
            x = camera_rng.uniform(-half_road_m, half_road_m)
        else:
            # Up to 1 m into a garden. Without gardens it stays 1 cm beyond the pavement at most,
            # because the houses begin there.
            side_of_road = camera_rng.choice([-1, 1])
            into_garden = camera_rng.uniform(-0.2, min(1.0, garden_m + 0.01))
            x = side_of_road * (layout.pavement_end_m + into_garden)
        ground = KERB_M if abs(x) > half_road_m else 0.0
        y = camera_rng.uniform(-3, 3)
        eye = (float(x), float(y), ground + eye_height(camera_rng))
        # Radians, counterclockwise from straight along the street: mostly a little towards its
        # other side, which is to the left from x > 0; sometimes towards the houses over there.
        turn = camera_rng.normal(0, 0.22) + 0.16 * np.sign(x)
        if camera_rng.random() < 0.22:
            turn = np.sign(x) * camera_rng.uniform(0.5, 1.3)
        azimuth = math.pi / 2 + float(turn)  # π / 2 is +y
        return held_camera(camera_rng, eye, azimuth, height_px, width_px)

    return WorldPlan(
        OUTDOORS,
        kind="town street" if town else "suburban street",
        mesh=joined(scene.parts),
        pictures=scene.pictures,
        lights=daylight(rng),
        draw_viewpoint=draw_viewpoint,
        models=tuple(sorted(scene.used)),
        coarse_m=1.0,
    )


def _add_ground(scene: Scene, layout: Layout) -> None:
    """Add all that is flat: the road with its marks, pavements with kerbs, the ground behind."""
    rng = scene.rng
    half_road = layout.half_road_m
    pavement_end = layout.pavement_end_m
    # The ground goes on for 30 m beyond the street's ends.
    start_y = BEGIN - 30
    length = END - BEGIN + 60
    road = scene.surface("asphalt", "asphalt", "asphalt", "cobbles")  # asphalt in 3 of 4 cases
    slabs = scene.surface("paving")
    lawn = scene.surface("grass")
    kerb = scene.surface("concrete")

    def strip(x0: float, x1: float, z: float, material: Material, tile_m: float) -> Mesh:
        """The ground from x0 to x1 at height z, along the whole street."""
        # Texture coordinates are metres of the world over `tile_m`, so that strips fit together.
        offset = (x0 / tile_m, start_y / tile_m)
        across = (x1 - x0, 0, 0)
        along = (0, length, 0)
        return quad((x0, start_y, z), across, along, material, (tile_m, tile_m), offset)

    parts = scene.parts
    kerbstones = Faces()
    parts.append(strip(-half_road, half_road, 0.0, material_of(road), road.tile_m))
    yard = scene.surface("grass", "grass", "earth") if layout.garden_m > 1 else slabs
    for side in (-1, 1):
        low_x, high_x = sorted((side * half_road, side * pavement_end))
        parts.append(strip(low_x, high_x, KERB_M, material_of(slabs), slabs.tile_m))
        # Gardens and the ground below houses, and 40 m more.
        low_x, high_x = sorted((side * pavement_end, side * (pavement_end + layout.garden_m + 40)))
        parts.append(strip(low_x, high_x, KERB_M, material_of(yard), yard.tile_m))
        # Kerbstones 15 cm wide and a metre long, with joints of 12 mm. Beyond y = 40 m joints
        # cannot be seen, so that stones of 8 m do.
        low_x, high_x = sorted((side * (half_road - 0.02), side * (half_road + 0.13)))
        top = KERB_M + 0.012
        kerb_material = material_of(kerb)
        y = BEGIN
        while y < END:
            stone_m = 1.0 if y < 40 else 8.0
            stone_end = y + stone_m - 0.006
            kerbstones.box((low_x, y + 0.006, -0.05), (high_x, stone_end, top), kerb_material)
            y += stone_m
    parts.append(kerbstones.mesh())
    # Grass to the horizon, 6 cm below the road, so that nothing of it shows through.
    lawn_tile = (lawn.tile_m, lawn.tile_m)
    far = material_of(lawn)
    parts.append(quad((-600, -600, -0.06), (1200, 0, 0), (0, 1200, 0), far, lawn_tile))

    if road.kind == "asphalt":
        _mark_asphalt(scene, half_road)
    iron = plain((0.2, 0.19, 0.18), 0.05, 0.5)
    for _ in range(4):  # round covers of drains
        x = rng.uniform(-half_road + 0.5, half_road - 0.5)
        y = rng.uniform(1, 40)
        scene.parts.append(_disc((x, y, 0.009), 0.32, iron))


def _mark_asphalt(scene: Scene, half_road_m: float) -> None:
    """Add white lines, mended patches and a zebra crossing to a road of asphalt at z = 0.

    They lie 3 to 7 mm above the road, each kind at its own height, so that none lies in another.

    Args:
        scene: gets them.
        half_road_m: from the middle of the road, x = 0, to each kerb.
    """
    rng = scene.rng
    parts = scene.parts
    white = plain([rng.uniform(0.62, 0.8)] * 3)
    if rng.random() < 0.65:  # a dashed line in the middle, 12 cm wide, as much line as gap
        period_m = rng.choice([4.0, 6.0, 9.0])
        for y in np.arange(BEGIN, END, period_m):
            parts.append(quad((-0.06, y, 0.006), (0.12, 0, 0), (0, period_m * 0.5, 0), white))
    if rng.random() < 0.3:  # a line at each side, 10 cm wide, 35 cm from the kerb
        for side in (-1, 1):
            left = side * (half_road_m - 0.35) - 0.05
            parts.append(quad((left, BEGIN, 0.006), (0.1, 0, 0), (0, END - BEGIN, 0), white))
    for _ in range(int(rng.integers(0, 6))):  # places where the road was mended
        patch = scene.surface("asphalt")
        x, y = rng.uniform(-half_road_m, half_road_m - 1), rng.uniform(-4, 40)
        width, length = rng.uniform(0.6, 2.0), rng.uniform(0.8, 6)
        shade = float(rng.uniform(0.7, 0.95))  # darker than the worn road around it
        material = material_of(patch, (shade, shade, shade))
        tile = (patch.tile_m, patch.tile_m)
        parts.append(quad((x, y, 0.003), (width, 0, 0), (0, length, 0), material, tile))
    if rng.random() < 0.3:  # a zebra crossing: bars 0.5 m wide and 3.2 m long
        y = rng.uniform(5, 18)
        for x in np.arange(-half_road_m + 0.3, half_road_m - 0.4, 0.95):
            parts.append(quad((x, y, 0.007), (0.5, 0, 0), (0, 3.2, 0), white))


def _disc(middle: tuple[float, float, float], radius: float, material: Material) -> Mesh:
    """A flat disc of 16 triangles that faces upwards.

    Args:
        middle: x, y and z in metres.
        radius: metres.
        material: of one colour; texture coordinates are all 0.
    """
    x, y, z = middle
    angle = 2 * math.pi * np.arange(17) / 16
    ring = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), np.full(17, z)], -1)
    corners = np.stack([np.broadcast_to((x, y, z), (16, 3)), ring[:-1], ring[1:]], 1)
    up = np.broadcast_to((0, 0, 1), corners.shape)
    return Mesh(
        corners.astype(np.float32),
        up.astype(np.float32),
        np.zeros((16, 3, 2), np.float32),
        np.zeros(16, np.int32),
        (material,),
    )


def _facing_road(mesh: Mesh, side: int, front_m: float, y0: float, y1: float) -> Mesh:
    """A house that is turned and moved to its place at the street, with its front to the road.

    Args:
        mesh: as `house` makes it: its front from x = 0 to x = y1 − y0 at y = 0, looking to −y.
        side: of the street, +1 for x > 0, −1 for x < 0.
        front_m: from the middle of the road to its front.
        y0, y1: where it begins and ends along the street.
    """
    if side > 0:  # its right end, seen from the road, is the one nearer to the camera
        return mesh.moved(rotation_z(-90), (front_m, y1, KERB_M))
    return mesh.moved(rotation_z(90), (-front_m, y0, KERB_M))


def _add_houses(scene: Scene, layout: Layout, side: int) -> None:
    """Add houses along one side of the street, and cars on drives beside some of them.

    Args:
        scene: gets them.
        layout: of the street.
        side: +1 for x > 0, −1 for x < 0.
    """
    rng = scene.rng
    town = layout.town
    garden_end = layout.pavement_end_m + layout.garden_m
    y = BEGIN + rng.uniform(-4, 2)
    style = choose_style(rng, scene.surface)
    terrace = town or rng.random() < 0.3  # houses without gaps between them
    floors = int(rng.integers(2, 5)) if town else int(rng.integers(1, 3))
    width = rng.uniform(6, 9)
    roof = roof_kind(rng, town)
    all_alike = rng.random() < 0.4  # one builder, one style
    while y < END:
        if not all_alike:
            style = choose_style(rng, scene.surface)
            width = rng.uniform(6, 13) if town else rng.uniform(7, 12)
            if rng.random() < 0.6:
                floors = int(rng.integers(2, 6)) if town else int(rng.integers(1, 3))
                roof = roof_kind(rng, town)
        if terrace and roof == "ridge across":  # its eaves would reach into the next house
            roof = "ridge along"
        gap = 0.0 if terrace else rng.uniform(2.5, 7)  # to the next house
        front = garden_end + (0 if terrace else rng.uniform(0, 1.5))
        near = y < 45  # small parts of farther houses would not be seen
        mesh = house(
            rng,
            scene.surface,
            style,
            width,
            rng.uniform(8, 11),
            floors,
            roof,
            shop=town and layout.garden_m == 0 and rng.random() < 0.45,
            balconies=town and near and rng.random() < 0.25,
        )
        scene.parts.append(_facing_road(mesh, side, front, y, y + width))
        # The place that it takes is 11 m deep, as the deepest house.
        low_x, high_x = sorted((side * front, side * (front + 11)))
        scene.taken.append(Box(low_x, y, high_x, y + width, 0, 20))
        if not town and layout.garden_m > 4 and near and rng.random() < 0.4 and gap > 2.4:
            # A car on the drive in the gap, which looks towards the road.
            x = side * (layout.pavement_end_m + layout.garden_m * 0.55)
            middle_y = y + width + gap / 2
            scene.put(scene.find(CARS), x, middle_y, KERB_M, -90.0 * side, painted=True)
        y += width + gap


def _add_front_gardens(scene: Scene, layout: Layout, side: int) -> None:
    """Add the gardens along one side of the street, between the pavement and the houses.

    Each has a hedge, wall or fence at the pavement, with a gap as its gate, then shrubs, and
    sometimes a tree, a hedge to the next garden, and a thing at the gate.

    Args:
        scene: gets them.
        layout: of the street.
        side: +1 for x > 0, −1 for x < 0.
    """
    rng = scene.rng
    begin_m = layout.pavement_end_m  # from the middle of the road to where gardens begin
    garden_m = layout.garden_m  # from there to the houses
    y = BEGIN
    while y < 70:  # what is farther away is hardly seen
        length = rng.uniform(6, 11)  # of this garden along the street
        gate = rng.uniform(1.2, 3.2)  # width of the gap at its far end
        near_camera = -8 < y < 30  # where small things can be seen
        border(scene, side, begin_m + 0.1, y, y + length - gate, near_camera)
        if rng.random() < 0.5:  # a hedge between this garden and the one before it
            low_x, high_x = sorted((side * (begin_m + 0.4), side * (begin_m + garden_m - 0.2)))
            height = rng.uniform(0.7, 1.5)
            hedge(scene, (low_x, y - 0.3, KERB_M), (high_x, y + 0.2, KERB_M + height))
        for _ in range(int(rng.integers(1, 4))):
            shrub_x = side * rng.uniform(begin_m + 0.8, begin_m + garden_m - 0.6)
            shrub_y = rng.uniform(y + 0.5, y + length - 0.5)
            plant(scene, SHRUBS, shrub_x, shrub_y, tree=False)
        if garden_m > 3 and rng.random() < 0.3 and -8 < y < 60:
            tree_y = y + rng.uniform(1, length - 1)
            tree_x = side * (begin_m + garden_m * rng.uniform(0.3, 0.6))
            plant(scene, layout.trees, tree_x, tree_y)
        if rng.random() < 0.35 and near_camera:
            # One of these in the gate, which looks towards the road.
            things = scene.find("mofx_mailbox residential-trashcan bicycle wheelbarrow tricycle")
            gate_y = y + length - gate / 2
            scene.put(things, side * (begin_m + 0.7), gate_y, KERB_M, -90.0 * side)
        y += length


def _furnish_pavement(scene: Scene, layout: Layout, side: int) -> None:
    """Put lamps and trees in a row at the kerb of a pavement; then people, benches, bins, bicycles.

    Things of which small parts matter stand up to 30 or 35 m from the camera only.

    Args:
        scene: gets them.
        layout: of the street.
        side: of the street, +1 for x > 0, −1 for x < 0.
    """
    rng = scene.rng
    kerb = layout.half_road_m  # metres from the middle of the road
    pavement_end = layout.pavement_end_m
    row_x = side * (kerb + 0.55)  # of lamps and trees
    to_road = -90.0 if side > 0 else 90.0  # the angle at which things look towards the road
    lamps = scene.find("candelabre") if rng.random() < 0.6 else scene.find("farola1")
    spacing = rng.uniform(18, 28)
    for y in np.arange(rng.uniform(-10, 6), 80, spacing):
        if rng.random() < 0.9:
            scene.put(lamps, row_x, y, KERB_M, to_road, scale=rng.uniform(0.95, 1.1), solid=False)
    if rng.random() < (0.5 if layout.pavement_m > 1.8 else 0.25):  # a row of trees of one kind
        spacing = rng.uniform(7, 14)
        names = layout.trees.split()
        tree = names[int(rng.integers(len(names)))]
        for y in np.arange(rng.uniform(-6, 8), 75, spacing):
            plant(scene, tree, row_x, y)
    for _ in range(int(rng.integers(2, 9)) if layout.town else int(rng.integers(0, 5))):
        x = side * rng.uniform(kerb + 0.5, pavement_end - 0.3)
        y = rng.uniform(2.0, 35)
        # Towards the camera, away from it, or anywhere.
        angle = float(rng.choice([0, 180, rng.uniform(0, 360)]))
        scene.put(scene.find(PEOPLE), x, y, KERB_M, angle, margin=0.2)
    things = (
        "park-trashcan concrete-bench painted-bench wood_bank fire-hydrant residential-trashcan"
    )
    if layout.town:
        things += " plantie letters_box cafe-table"
    for _ in range(int(rng.integers(1, 6))):  # at the kerb or at the pavement's other side
        x = side * (kerb + float(rng.choice([0.5, layout.pavement_m - 0.45])))
        scene.put(scene.find(things), x, rng.uniform(1.5, 30), KERB_M, to_road, margin=0.2)
    for _ in range(int(rng.integers(0, 4))):
        x = side * (kerb + rng.uniform(0.4, 0.9))
        y = rng.uniform(1.5, 30)
        # They stand along the kerb, some degrees askew.
        scene.put(scene.find(TWO_WHEELS), x, y, KERB_M, rng.normal(0, 15), margin=0.1)
    if layout.town and layout.pavement_m > 2.4 and rng.random() < 0.4:
        _add_cafe(scene, side * (pavement_end - 0.9))


def _add_cafe(scene: Scene, x: float) -> None:
    """Put two to four tables of a café in a row along the street at this x.

    Each has two chairs, one at each side along the street, and some have an umbrella.
    """
    rng = scene.rng
    y = rng.uniform(4, 14)
    for _ in range(int(rng.integers(2, 5))):
        if scene.put(scene.find("cafe-table"), x, y, KERB_M, 0.0):
            # Where each chair stands along the street, and its angle: it looks at the table. The
            # model's back rest is at +y at 0 degrees.
            for chair_y, angle in ((y + 0.6, 0.0), (y - 0.6, 180.0)):
                scene.put(scene.find("cafe-chair"), x, chair_y, KERB_M, angle, margin=0)
            if rng.random() < 0.5:
                # Over the table, so that it may come 0.3 m into what stands there.
                umbrella = scene.find("umbrella")
                scene.put(umbrella, x, y, KERB_M + 0.02, 0.0, solid=False, margin=-0.3)
        y += rng.uniform(2.2, 3)


def _park_cars(scene: Scene, half_road_m: float, side: int, parked_share: float) -> None:
    """Park cars along the kerb at one side of the road.

    Args:
        scene: gets them.
        half_road_m: from the middle of the road to the kerb.
        side: of the road, +1 for x > 0, −1 for x < 0.
        parked_share: the fraction of all places in which a car stands, 0 to 1.
    """
    rng = scene.rng
    y = rng.uniform(-14, -8)
    while y < 80:
        # No car stands beside the camera, where it would fill the picture.
        if rng.random() < parked_share and abs(y) > 2.2:
            x = side * (half_road_m - 1.05 + rng.normal(0, 0.05))  # 1.05: half a car and a gap
            # Traffic is on the right: cars at x > 0 look towards +y, the others towards the camera.
            # One of ten is parked the wrong way round.
            looks_ahead = (side > 0) != (rng.random() < 0.1)
            angle = (180.0 if looks_ahead else 0.0) + rng.normal(0, 1.2)
            scene.put(scene.find(CARS), x, y, 0.0, angle, painted=True)
        y += rng.uniform(5.0, 6.0)


def _add_traffic(scene: Scene, half_road_m: float) -> None:
    """Put up to four vehicles on the road, each in the middle of its lane; they keep to the right.

    Args:
        scene: gets them.
        half_road_m: from the middle of the road to each kerb.
    """
    rng = scene.rng
    # Metres from the road's middle to a lane's: less than half, because cars may be parked.
    lane_m = max(0.95, half_road_m * 0.38)
    for _ in range(int(rng.integers(0, 5))):
        side = int(rng.choice([-1, 1]))
        models = scene.find(LARGE_CARS if rng.random() < 0.25 else CARS)
        angle = 180.0 if side > 0 else 0.0  # away from the camera at x > 0, towards it at x < 0
        scene.put(models, side * lane_m, rng.uniform(9, 70), 0.0, angle, painted=True, margin=0.2)


def _close_far_end(scene: Scene, trees: str) -> None:
    """Add five trees where the road ends, and in half of all streets a wide house behind them.

    Args:
        scene: gets them.
        trees: names of models of trees, separated by spaces.
    """
    rng = scene.rng
    if rng.random() < 0.5:
        style = choose_style(rng, scene.surface)
        width = rng.uniform(18, 30)
        depth = 10
        floors = int(rng.integers(2, 5))
        mesh = house(rng, scene.surface, style, width, depth, floors, "ridge along")
        # A house looks towards −y as it is made, which is towards the camera.
        scene.parts.append(mesh.moved(np.eye(3), (-width / 2, END + 14, KERB_M)))
    for _ in range(5):
        plant(scene, trees, rng.uniform(-14, 14), END + rng.uniform(2, 12))
