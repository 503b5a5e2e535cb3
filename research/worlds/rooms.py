"""Furnished rooms: the rules by which a room is built and filled. Read `furnish` first.

    living room   sofa at a wall, table before it, rug below, television opposite, armchairs beside
    bedroom       bed with its head at a wall, a small table at each side, wardrobe, clothes around
    kitchen       cabinets in a row with sink and stove, cabinets above, fridge, table with chairs
    dining room   table in the middle, chairs around it that look at it, laid, a lamp above
    office        desks at walls or in the room, chair before, computer and papers on, shelves
    bathroom      tiled; bath, basin with small things, toilet, towels
    child's room  bed, shelves, toys on the floor
    hobby room    billiards, table tennis, a workshop, things that are stored

Then every room gets bookcases, plants, lamps, pictures, clutter, and sometimes people and pets.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from worlds.furniture import Furniture
from worlds.lights import Lights, direction_to_sun, made_sky
from worlds.meshes import Material, Mesh, box, joined, quad, rotation_z
from worlds.placing import WALLS, Box, Opening, Place, Placed, WallName
from worlds.plans import CLOSE, INDOORS, WorldPlan
from worlds.shell import (
    WALL_M,
    WHITE,
    WallFrame,
    curtain,
    door_way,
    made_shelf,
    material_of,
    picture_frame,
    strip,
    wall_with_openings,
    window_frame,
)
from worlds.surfaces import Surface, surfaces
from worlds.viewpoints import close_viewpoint, indoor_viewpoint
from worlds.views import COARSE_M

Rng = np.random.Generator
Bytes = NDArray[np.uint8]
DrawPhoto = Callable[[Rng], Bytes]  # gives a random photo [H, W, 3] sRGB

KINDS = ("living", "bedroom", "kitchen", "dining", "office", "bathroom", "kids", "hobby")
KIND_SHARES = (0.26, 0.15, 0.15, 0.12, 0.12, 0.06, 0.07, 0.07)
NEUTRAL_SATURATION = 0.12  # a colour with less is grey: no one chose it
SKIN_SHARE = 0.75  # of the grey materials of furniture get another colour or a texture
SOFT_GROUPS = ("sofa", "armchair", "bed", "kids_bed")


class Builder:
    """Collects the meshes of a room while its rules run."""

    def __init__(
        self, rng: Rng, furniture: Furniture, cache: Path, photo: DrawPhoto | None
    ) -> None:
        """Start with an empty room of random kind and size."""
        self.rng = rng
        self.furniture = furniture
        self.cache = cache / "surfaces"
        self.photo = photo
        self.parts: list[Mesh] = []
        self.pictures: dict[str, Bytes] = {}
        self.lamps: list[tuple[tuple[float, float, float], float, NDArray[np.float64]]] = []
        self.lit: set[int] = set()  # numbers of things whose shades shine
        self.kind = str(rng.choice(KINDS, p=KIND_SHARES))
        small = self.kind in ("bathroom", "kitchen")
        width = rng.uniform(2.0, 3.6) if small else rng.uniform(2.8, 6.5)
        depth = rng.uniform(2.4, 4.2) if small else rng.uniform(3.0, 7.0)
        height = rng.uniform(2.35, 3.1)
        self.place = Place(rng, width, depth, height, _openings(rng, width, depth, height, small))

    def surface(self, *kinds: str) -> Surface:
        """A random surface of one of these kinds."""
        kind = kinds[int(self.rng.integers(len(kinds)))]
        found = surfaces(self.cache, kind)
        return found[int(self.rng.integers(len(found)))]

    def photo_material(self) -> Material:
        """A photo as a material; an abstract picture if there are no photos."""
        if self.photo is None:
            return material_of(self.surface("rug", "wallpaper", "marble"))
        name = f"photo-{len(self.pictures)}"
        self.pictures[name] = self.photo(self.rng)
        return Material((1.0, 1.0, 1.0), name, 0.04, 0.15)


def _openings(rng: Rng, width: float, depth: float, height: float, small: bool) -> list[Opening]:
    """Windows in one or two walls, and a door or passage in another.

    Width, depth and height of the room are in metres; `small` rooms have windows in one wall only.
    """
    walls = list(WALLS)
    rng.shuffle(walls)
    openings: list[Opening] = []
    lengths = {"back": width, "front": width, "left": depth, "right": depth}
    for wall in walls[: 1 if small else int(rng.choice([1, 2], p=[0.6, 0.4]))]:
        length = lengths[wall]
        count = 1 if length < 3.5 else int(rng.integers(1, 4))
        # A quarter of the windows reach to the floor.
        bottom = float(rng.choice([0.02, rng.uniform(0.5, 1.1)], p=[0.25, 0.75]))
        top = min(height - 0.12, rng.uniform(1.9, 2.5))
        # Each window stands in the middle of an equal part of the wall.
        each = length / count
        window = min(rng.uniform(0.7, 2.4), each - 0.4)
        for number in range(count):
            start = each * number + (each - window) / 2
            openings.append(Opening(wall, start, window, bottom, top, "window"))

    # At most two walls have windows, so the third in the random order has none.
    door_wall = walls[2]
    length = lengths[door_wall]
    wide = rng.uniform(0.8, 0.95)
    kind: Literal["door", "passage"] = "door"
    if rng.random() < 0.45:
        wide = min(rng.uniform(0.9, 2.4), length - 0.5)
        kind = "passage"
    start = rng.uniform(0.15, max(0.16, length - wide - 0.15))
    top = min(2.08, height - 0.1)
    openings.append(Opening(door_wall, start, wide, 0.0, top, kind))
    return openings


def furnish(
    rng: Rng, furniture: Furniture, cache: Path, photo: DrawPhoto | None, close: bool = False
) -> WorldPlan:
    """A furnished room with its light.

    Args:
        rng: draws all of it.
        furniture: models by group.
        cache: the folder in which drawn textures of surfaces are kept.
        photo: gives photos for picture frames and windows; None: there are none.
        close: whether it is photographed from close to a thing, not as a room.
    """
    room = Builder(rng, furniture, cache, photo)
    # Things find their places first, because pictures and lamps depend on them.
    RULES[room.kind](room)
    _everywhere(room)
    _build_shell(room)
    _hang_pictures(room)
    lights = _light(room)
    for number, thing in enumerate(room.place.things):
        room.parts.append(_mesh_of(room, thing, number in room.lit))
    keys = sorted({thing.model.entry.key for thing in room.place.things})
    draw_viewpoint = close_viewpoint if close else indoor_viewpoint
    return WorldPlan(
        CLOSE if close else INDOORS,
        kind=room.kind,
        mesh=joined(room.parts),
        pictures=room.pictures,
        lights=lights,
        draw_viewpoint=functools.partial(draw_viewpoint, room.place),
        models=tuple(keys),
        coarse_m=COARSE_M,
    )


def _living(room: Builder) -> None:
    """Sofa, table before it, television opposite, armchairs beside."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    sofa = place.at_wall(models_of("sofa"), gap=rng.choice([0.03, rng.uniform(0.1, 0.8)]))
    if sofa is not None:
        # Points are given as (sideways, forward) of the sofa's middle.
        depth = sofa.model.entry.size_m[1]
        front = sofa.beside(0.0, depth / 2 + rng.uniform(0.5, 0.8))
        _rug(room, sofa.beside(0.0, depth / 2 + 0.4), sofa.angle)
        table = place.on_floor(
            models_of("coffee_table"), front, 0.06, sofa.angle + rng.normal(0, 4)
        )
        if table is not None:
            place.on_top(
                table, models_of("living_small"), count=int(rng.integers(1, 6)), facing=False
            )
            place.on_top(table, models_of("vase") + models_of("small_plant"), count=1)
        for side in (-1, 1):
            if rng.random() < 0.6:
                where = sofa.beside(side * rng.uniform(1.2, 1.9), rng.uniform(1.0, 1.6))
                place.on_floor(
                    models_of("armchair"), where, 0.1, sofa.angle - side * rng.uniform(50, 100)
                )
            # A small table at the sofa's end, with a lamp.
            if rng.random() < 0.5:
                beside = sofa.beside(side * (sofa.model.entry.size_m[0] / 2 + 0.35), 0.0)
                small = place.on_floor(models_of("bedside"), beside, 0.0, sofa.angle, tries=3)
                if small is not None:
                    place.on_top(small, models_of("table_lamp"), count=1)
        place.on_top(
            sofa, models_of("pet") + models_of("sitting_person"), count=int(rng.random() < 0.2)
        )
        stand = place.at_wall(models_of("tv_stand"), _opposite(sofa.angle))
        if stand is not None:
            place.on_top(stand, models_of("tv"), count=1, at=(0.0, 0.0))
            place.on_top(stand, models_of("living_small") + models_of("vase"), count=3)
    if rng.random() < 0.25:
        place.at_wall(models_of("fireplace"))
    if rng.random() < 0.12:
        place.at_wall(models_of("piano"))
    if rng.random() < 0.5:
        _dining_group(room, None)


def _bedroom(room: Builder) -> None:
    """A bed with its head at a wall, a small table at each side, a wardrobe."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    bed = place.at_wall(models_of("bed"))
    if bed is not None:
        width, depth, _ = bed.model.entry.size_m
        _rug(room, bed.beside(rng.normal(0, 0.4), depth / 2), bed.angle)
        # Both small tables are of one kind.
        table = models_of("bedside")
        chosen = [table[int(rng.integers(len(table)))]] if table else []
        for side in (-1, 1):
            where = bed.beside(side * (width / 2 + 0.33), -depth / 2 + 0.3)
            small = place.on_floor(chosen, where, 0.0, bed.angle, 0.0, tries=1)
            if small is not None:
                place.on_top(small, models_of("table_lamp"), count=1)
                place.on_top(small, models_of("bedroom_small"), count=2)
        place.on_top(
            bed,
            models_of("bedroom_small") + models_of("toy"),
            count=int(rng.integers(0, 3)),
            facing=False,
        )
        place.on_top(
            bed,
            models_of("pet") + models_of("floor_person"),
            count=int(rng.random() < 0.2),
            facing=False,
        )
    place.at_wall(models_of("wardrobe"))
    chest = place.at_wall(models_of("sideboard"))
    if chest is not None:
        place.on_top(
            chest,
            models_of("bedroom_small") + models_of("vase") + models_of("small_plant"),
            count=4,
        )
    if rng.random() < 0.5:
        _desk(room)
    if rng.random() < 0.5:
        place.in_corner(models_of("armchair"))


def _kitchen(room: Builder) -> None:
    """Cabinets in a row with sink and stove, others above, a fridge, a table if there is room."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    lower = models_of("lower_cabinet")
    upper = models_of("upper_cabinet")
    if lower and upper:
        # One kitchen has one kind of cabinet.
        base = lower[int(rng.integers(len(lower)))]
        family = base.entry.key.split("#")[0]
        lower = [one for one in lower if one.entry.key.startswith(family)]
        upper = [one for one in upper if one.entry.key.startswith(family)] or upper
    walls = list(WALLS)
    rng.shuffle(walls)
    for wall in walls[: int(rng.choice([1, 2], p=[0.4, 0.6]))]:
        # Cabinets stand side by side from the wall's left end; fridge, sink, stove and washer come
        # in between, each once.
        length = place.length(wall)
        along = 0.02 if rng.random() < 0.5 else rng.uniform(0.05, 0.6)
        special = [models_of("fridge"), models_of("sink"), models_of("stove"), models_of("washer")]
        rng.shuffle(special)
        while along < length - 0.3:
            group = special.pop() if special and rng.random() < 0.45 else lower
            if not group:
                break
            model = group[int(rng.integers(len(group)))]
            width = model.entry.size_m[0]
            if along + width > length:
                break
            thing = place.at_wall([model], wall, along + width / 2, margin=-0.01)
            if thing is not None:
                # Low ones carry small things, and have another cabinet or a hood above.
                if model.entry.size_m[2] < 1.0:
                    place.on_top(thing, models_of("kitchen_small"), count=int(rng.integers(0, 4)))
                above = upper if group is not models_of("stove") else models_of("hood")
                if rng.random() < 0.75 and model.entry.size_m[2] < 1.3 and above:
                    chosen = above[int(rng.integers(len(above)))]
                    place.at_wall([chosen], wall, along + width / 2, z=1.45, margin=-0.02)
            along += width + 0.002  # a joint of 2 mm

    # A block in the middle of the room.
    if rng.random() < 0.3:
        island = place.on_floor(models_of("island"), angle=float(rng.choice([0, 90])), margin=0.5)
        if island is not None:
            place.on_top(island, models_of("kitchen_small"), count=4)
            place.on_floor(models_of("stool"), island.beside(0, 0.6), 0.2)
    _dining_group(room, None)


def _dining(room: Builder) -> None:
    """A table in the middle with chairs, and a sideboard."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    middle = (place.width / 2 + rng.normal(0, 0.3), place.depth / 2 + rng.normal(0, 0.3))
    _rug(room, middle, float(rng.choice([0, 90])))
    _dining_group(room, middle)
    for _ in range(2):
        board = place.at_wall(models_of("sideboard"))
        if board is not None:
            things = (
                models_of("vase")
                + models_of("small_plant")
                + models_of("living_small")
                + models_of("table_lamp")
            )
            place.on_top(board, things, count=int(rng.integers(2, 6)))


def _dining_group(room: Builder, middle: tuple[float, float] | None) -> None:
    """A table with chairs around it that look at it, laid or not."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    angle = float(rng.choice([0, 90])) + rng.normal(0, 2)
    table = place.on_floor(models_of("dining_table"), middle, 0.15, angle, margin=0.35)
    if table is None:
        return
    chairs = models_of("chair")
    chair = [chairs[int(rng.integers(len(chairs)))]] if chairs else []
    # Seats are (sideways, forward, turn) from the table's middle and angle: the two long sides, two
    # seats each at a long table, then the two ends.
    width, depth, _ = table.model.entry.size_m
    seats = [(0.0, depth / 2, 180.0), (0.0, -depth / 2, 0.0)]
    if width > 1.2:
        seats = [(side * width / 4, y, turn) for side in (-1, 1) for _, y, turn in seats]
    seats += [(width / 2, 0.0, -90.0), (-width / 2, 0.0, 90.0)]
    for sideways, forward, turn in seats:
        if rng.random() < 0.2:
            continue
        # The chair's middle is farther out than the table's edge: forward at a long side, sideways
        # at an end.
        out = 0.22 + abs(rng.normal(0, 0.12))
        away = (
            sideways + (math.copysign(out, sideways) if forward == 0 else 0),
            forward + (math.copysign(out, forward) if forward else 0),
        )
        # The chair may reach under the table, so it is only kept from other things.
        x, y = table.beside(*away)
        if chair:
            thing = Placed(chair[0], x, y, 0.0, table.angle + turn + rng.normal(0, 8))
            others = [box_ for box_ in place.taken if box_ != table.box]
            inside = thing.box.x0 > 0 and thing.box.x1 < place.width
            inside = inside and thing.box.y0 > 0 and thing.box.y1 < place.depth
            if inside and not any(thing.box.meets(other) for other in others):
                place.put(thing)
                if rng.random() < 0.06:
                    place.on_top(thing, models_of("sitting_person"), count=1, at=(0.0, 0.05))
                # A plate and a cup on the table's edge before the chair.
                if rng.random() < 0.7:
                    inner = (
                        sideways - (math.copysign(0.25, sideways) if forward == 0 else 0),
                        forward - (math.copysign(0.25, forward) if forward else 0),
                    )
                    place.on_top(table, models_of("table_setting"), count=1, at=inner)
    things = (
        models_of("vase")
        + models_of("small_plant")
        + models_of("kitchen_small")
        + models_of("living_small")
    )
    place.on_top(table, things, count=int(rng.integers(1, 6)), facing=False)
    if rng.random() < 0.5:
        _pendant(room, table.x, table.y)


def _office(room: Builder) -> None:
    """Desks with chairs and computers, shelves."""
    rng = room.rng
    place = room.place
    for _ in range(int(rng.integers(1, 4))):
        _desk(room)
    for _ in range(2):
        cabinet = place.at_wall(room.furniture.of("sideboard"))
        if cabinet is not None:
            place.on_top(cabinet, room.furniture.of("office_small"), count=3)
    if rng.random() < 0.5:
        place.at_wall(room.furniture.of("workshop"))


def _desk(room: Builder) -> None:
    """A desk at a wall, or in the room; a chair before it, a computer and papers on it."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    desk = place.at_wall(models_of("desk"), gap=rng.choice([0.02, 0.9], p=[0.75, 0.25]), margin=0.2)
    if desk is None:
        return
    depth = desk.model.entry.size_m[1]
    seat = desk.beside(rng.normal(0, 0.15), depth / 2 + 0.3)
    place.on_floor(models_of("desk_chair"), seat, 0.08, desk.angle + 180 + rng.normal(0, 40), 0.0)
    place.on_top(desk, models_of("computer"), count=1, at=(rng.normal(0, 0.15), -0.05))
    place.on_top(desk, models_of("table_lamp"), count=int(rng.random() < 0.6))
    place.on_top(desk, models_of("office_small"), count=int(rng.integers(2, 7)), facing=False)


def _bathroom(room: Builder) -> None:
    """Bath or shower, basin with small things, toilet, towels."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    place.at_wall(models_of("bath") if rng.random() < 0.7 else models_of("shower"))
    for group, share in (("basin", 1.0), ("toilet", 1.0), ("bidet", 0.3), ("washer", 0.4)):
        if rng.random() < share:
            thing = place.at_wall(models_of(group))
            if thing is not None and group != "toilet":
                place.on_top(thing, models_of("bath_small"), count=3)
    place.at_wall(models_of("towel_rack"))
    place.on_floor(models_of("floor_clutter"), tries=6)


def _kids(room: Builder) -> None:
    """A bed, shelves, and toys on the floor."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    bed = place.at_wall(models_of("kids_bed"))
    if bed is not None:
        place.on_top(bed, models_of("toy"), count=2, facing=False)
    _desk(room)
    _rug(room, (place.width / 2, place.depth / 2), 0.0)
    chest = place.at_wall(models_of("sideboard"))
    if chest is not None:
        place.on_top(chest, models_of("toy"), count=4)
    place.at_wall(models_of("wardrobe"))
    for _ in range(int(rng.integers(4, 12))):
        place.on_floor(models_of("toy"))
    if rng.random() < 0.4:
        place.on_floor(models_of("floor_person"))


def _hobby(room: Builder) -> None:
    """Games or a workshop, and things that are stored."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    if rng.random() < 0.6:
        middle = (place.width / 2, place.depth / 2)
        place.on_floor(models_of("hobby"), middle, 0.4, float(rng.choice([0, 90])), 0.4)
    for _ in range(int(rng.integers(4, 12))):
        thing = place.at_wall(models_of("workshop"), gap=rng.uniform(0.02, 0.2))
        if thing is not None:
            place.on_top(thing, models_of("tool"), count=2, facing=False)
    for _ in range(int(rng.integers(1, 5))):
        place.on_floor(models_of("workshop"))


RULES: dict[str, Callable[[Builder], None]] = {
    "living": _living,
    "bedroom": _bedroom,
    "kitchen": _kitchen,
    "dining": _dining,
    "office": _office,
    "bathroom": _bathroom,
    "kids": _kids,
    "hobby": _hobby,
}


def _everywhere(room: Builder) -> None:
    """What any room may have: bookcases, plants, lamps, clutter, people."""
    rng = room.rng
    place = room.place
    models_of = room.furniture.of
    if room.kind not in ("bathroom", "kitchen"):
        for _ in range(int(rng.integers(0, 4))):
            _bookcase(room)
        for _ in range(int(rng.integers(0, 3))):
            place.at_wall(models_of("bookcase"))
        for _ in range(int(rng.integers(0, 2))):
            place.at_wall(models_of("sideboard"))
        if rng.random() < 0.3:
            place.at_wall(models_of("radiator"))
    for _ in range(int(rng.choice([0, 1, 2, 4]))):
        place.in_corner(models_of("floor_plant"))
    if rng.random() < 0.3:
        place.in_corner(models_of("floor_lamp"))
    for _ in range(int(rng.choice([0, 1, 3, 6], p=[0.3, 0.3, 0.25, 0.15]))):
        place.on_floor(models_of("floor_clutter"))
    for _ in range(int(rng.integers(0, 3))):
        place.at_wall(models_of("wall_thing"), margin=0.0)
    if rng.random() < 0.12:
        place.on_floor(models_of("person"))
    if rng.random() < 0.08:
        place.on_floor(models_of("pet"))
    for base in list(place.things):
        # Chairs, chests and shelves collect things.
        if rng.random() < 0.15 and (base.model.entry.top_m or 0) > 0.3 and base.z < 0.1:
            place.on_top(
                base, models_of("living_small") + models_of("bedroom_small"), count=2, facing=False
            )


def _opposite(angle: float) -> WallName:
    """The wall at which a thing at this angle looks."""
    # At 0° it looks at the front wall, at −90° (its back to the right wall) at the left one.
    names: tuple[WallName, ...] = ("front", "left", "back", "right")
    return names[round(-angle / 90) % 4]


def _rug(room: Builder, middle: tuple[float, float], angle: float) -> None:
    """A rug on the floor, below whatever stands there."""
    rng = room.rng
    if rng.random() < 0.35:
        return
    place = room.place
    wide = rng.uniform(1.2, 2.6)
    deep = wide * rng.uniform(0.55, 0.8)
    if round(angle / 90) % 2:  # turned by a quarter
        wide, deep = deep, wide
    x0 = max(0.05, middle[0] - wide / 2)
    y0 = max(0.05, middle[1] - deep / 2)
    x1 = min(place.width - 0.05, middle[0] + wide / 2)
    y1 = min(place.depth - 0.05, middle[1] + deep / 2)
    if x1 - x0 < 0.6 or y1 - y0 < 0.6:
        return
    room.parts.append(
        box((x0, y0, 0.0), (x1, y1, 0.012), material_of(room.surface("rug", "rug", "carpet")))
    )


def _bookcase(room: Builder) -> None:
    """A bookcase with books at a wall, with small things on its free places."""
    rng = room.rng
    place = room.place
    wood = room.surface("wood")
    shelf = made_shelf(rng, material_of(wood), wood.tile_m)
    library = room.furniture.of("bookcase")
    if not library:
        return
    # It is placed as a model of its size would be, and then replaced by its own mesh.
    entry = dataclasses.replace(
        library[0].entry,
        key="made#shelf",
        size_m=(shelf.width, shelf.depth, shelf.height),
        elevation_m=0.0,
        top_m=shelf.height,
    )
    stand_in = dataclasses.replace(library[0], entry=entry)
    thing = place.at_wall([stand_in])
    if thing is None:
        return
    turn = rotation_z(thing.angle)
    back = turn @ np.array([0, shelf.depth / 2, 0])
    room.parts.append(shelf.mesh.moved(turn, [thing.x + back[0], thing.y + back[1], 0.0]))
    models_of = room.furniture.of
    things = (
        models_of("vase") + models_of("small_plant") + models_of("living_small") + models_of("toy")
    )
    for left, right, level in shelf.free:
        model = things[int(rng.integers(len(things)))] if things else None
        if model is None or rng.random() < 0.35:
            continue
        wide, deep, high = model.entry.size_m
        if wide > right - left or deep > shelf.depth or high > 0.28:
            continue
        x, y = thing.beside((left + right) / 2, 0.0)
        place.things.append(Placed(model, x, y, level, thing.angle + rng.normal(0, 15)))
    place.on_top(thing, things, count=int(rng.integers(0, 3)))


def _pendant(room: Builder, x: float, y: float) -> None:
    """A lamp that hangs from the ceiling."""
    models = room.furniture.of("pendant")
    if not models:
        return
    model = models[int(room.rng.integers(len(models)))]
    z = room.place.height - model.entry.size_m[2]
    if z > 1.4:
        room.place.things.append(Placed(model, x, y, z, float(room.rng.uniform(0, 360))))


def _build_shell(room: Builder) -> None:
    """Floor, ceiling, walls, skirting, frames, doors and curtains."""
    rng = room.rng
    place = room.place
    wet = room.kind in ("bathroom", "kitchen")
    floor = (
        room.surface("tiles", "marble", "tiles")
        if wet and rng.random() < 0.7
        else room.surface("planks", "planks", "parquet", "tiles", "carpet", "concrete", "marble")
    )
    wall = room.surface("plaster", "plaster", "plaster", "plaster", "wallpaper")
    if room.kind == "bathroom":
        wall = room.surface("wall_tiles")
    accent = (
        room.surface("plaster", "wallpaper", "brick", "concrete") if rng.random() < 0.35 else wall
    )
    width = place.width
    depth = place.depth
    height = place.height

    # The floor's texture runs along the room or across it.
    floor_tile = (floor.tile_m, floor.tile_m)
    along_x = (width, 0, 0)
    along_y = (0, depth, 0)
    if rng.random() < 0.5:
        floor_mesh = quad((width, 0, 0), along_y, (-width, 0, 0), material_of(floor), floor_tile)
    else:
        floor_mesh = quad((0, 0, 0), along_x, along_y, material_of(floor), floor_tile)
    room.parts.append(floor_mesh)
    ceiling = (
        Material((0.95, 0.95, 0.94))
        if rng.random() < 0.85
        else material_of(room.surface("wood", "plaster"))
    )
    room.parts.append(quad((0, depth, height), (width, 0, 0), (0, -depth, 0), ceiling, (1.5, 1.5)))
    _beams(room)

    # Skirting, casings and some window frames have one paint, from white to brown.
    shade = rng.choice([0.93, 0.9, 0.6, 0.3])
    trim = Material(
        (shade, shade * rng.uniform(0.85, 1), shade * rng.uniform(0.7, 1)),
        specular=0.04,
        roughness=0.4,
    )
    # One wall may look different.
    accent_wall = WALLS[int(rng.integers(4))]
    skirting = rng.uniform(0.05, 0.14)
    rail = room.kind in ("dining", "living", "office") and rng.random() < 0.2
    for name in WALLS:
        frame = WallFrame(place, name)
        length = place.length(name)
        mine = [one for one in place.openings if one.wall == name]
        skin = accent if name == accent_wall else wall
        room.parts += wall_with_openings(
            frame, length, height, mine, material_of(skin), skin.tile_m
        )
        if room.kind != "bathroom":
            room.parts += strip(frame, length, mine, 0, skirting, 0.015, trim)
        if rail:
            room.parts += strip(frame, length, mine, 0.9, 0.96, 0.02, trim)
        for opening in mine:
            if opening.kind == "window":
                paint = (
                    trim if rng.random() < 0.3 else Material(WHITE, specular=0.04, roughness=0.4)
                )
                room.parts += window_frame(rng, frame, opening, paint)
                _curtains(room, frame, opening, length)
            else:
                room.parts += door_way(frame, opening, trim)
                if opening.kind == "door":
                    _close_door(room, frame, opening)
                else:
                    _build_next_room(room, frame, opening)


def _beams(room: Builder) -> None:
    """Beams under the ceiling of some rooms."""
    rng = room.rng
    place = room.place
    if rng.random() > 0.1 or place.height < 2.5:
        return
    wood = room.surface("wood")
    count = int(place.depth / rng.uniform(0.6, 1.1))
    for number in range(count):
        y = (number + 0.5) * place.depth / count
        low = (0.0, y - 0.06, place.height - 0.14)
        high = (place.width, y + 0.06, place.height)
        room.parts.append(box(low, high, material_of(wood), (wood.tile_m,) * 2))


def _curtains(room: Builder, frame: WallFrame, opening: Opening, length: float) -> None:
    """Curtains at both sides of a window, on a rod."""
    rng = room.rng
    if rng.random() < 0.45:
        return
    cloth = room.surface("fabric", "fabric", "plaster")
    material = material_of(cloth)
    low = 0.03 if rng.random() < 0.6 else max(0.03, opening.bottom - 0.15)
    high = min(room.place.height - 0.04, opening.top + 0.12)
    wide = opening.width * rng.uniform(0.15, 0.4)
    away = 0.14
    left = max(0.02, opening.start - 0.2)
    right = min(length - 0.02, opening.start + opening.width + 0.2)
    room.parts.append(
        curtain(rng, frame, left, left + wide, low, high, away, material, cloth.tile_m)
    )
    room.parts.append(
        curtain(rng, frame, right - wide, right, low, high, away, material, cloth.tile_m)
    )
    rod = Material((0.25, 0.22, 0.2), specular=0.2, roughness=0.3)
    room.parts.append(
        frame.block(
            left - 0.03, right + 0.03, high - 0.01, high + 0.015, -away - 0.012, -away + 0.012, rod
        )
    )


def _close_door(room: Builder, frame: WallFrame, opening: Opening) -> None:
    """A closed door in an opening, with four panels and a handle."""
    left = opening.start
    right = opening.start + opening.width
    middle = (left + right) / 2
    color = WHITE if room.rng.random() < 0.5 else (0.5, 0.33, 0.2)
    paint = Material(color, specular=0.04, roughness=0.4)
    room.parts.append(frame.block(left, right, 0.005, opening.top, 0.04, 0.08, paint))
    for low, high in ((0.15, 0.8), (1.0, opening.top - 0.15)):
        for start, end in ((left + 0.1, middle - 0.04), (middle + 0.04, right - 0.1)):
            room.parts.append(frame.block(start, end, low, high, 0.03, 0.04, paint))
    knob = Material((0.7, 0.65, 0.5), specular=0.4, roughness=0.25)
    room.parts.append(frame.block(right - 0.12, right - 0.06, 1.0, 1.03, -0.03, 0.04, knob))


def _build_next_room(room: Builder, frame: WallFrame, opening: Opening) -> None:
    """What one sees through a passage: a corridor or another room.

    It is a box behind the wall, with a lamp of its own and some furniture.
    """
    rng = room.rng
    reach = rng.uniform(1.2, 4.0)
    left = opening.start - rng.uniform(0.1, 1.5)
    right = opening.start + opening.width + rng.uniform(0.1, 1.5)
    wall = room.surface("plaster", "plaster", "wallpaper")
    floor = room.surface("planks", "tiles", "parquet", "carpet")
    skin = material_of(wall)
    height = room.place.height
    inner = WALL_M
    outer = WALL_M + reach
    # The wall opposite, the walls at both sides, floor and ceiling; then the back of the wall with
    # the passage, left of it, right of it and above.
    parts = [
        frame.block(left, right, 0, height, outer, outer + 0.01, skin, wall.tile_m),
        frame.block(left - 0.01, left, 0, height, inner, outer, skin, wall.tile_m),
        frame.block(right, right + 0.01, 0, height, inner, outer, skin, wall.tile_m),
        frame.block(left, right, -0.01, 0.0, 0.0, outer, material_of(floor), floor.tile_m),
        frame.block(left, right, height, height + 0.01, inner, outer, Material((0.94, 0.94, 0.93))),
        frame.block(left, opening.start, 0, height, inner - 0.005, inner, skin, wall.tile_m),
        frame.block(
            opening.start + opening.width, right, 0, height, inner - 0.005, inner, skin, wall.tile_m
        ),
        frame.block(
            opening.start,
            opening.start + opening.width,
            opening.top,
            height,
            inner - 0.005,
            inner,
            skin,
        ),
    ]
    room.parts += parts

    middle = frame.point((left + right) / 2, height - 0.35, inner + reach / 2)
    glow = np.array([1.0, 0.9, 0.75]) * rng.uniform(0.3, 2.0)
    room.lamps.append(((middle[0], middle[1], middle[2]), 0.12, glow))

    # Furniture at the wall opposite, which looks towards the passage.
    groups = (
        "sideboard",
        "floor_plant",
        "chair",
        "bookcase",
        "floor_clutter",
        "wardrobe",
        "person",
    )
    for _ in range(3):
        models = room.furniture.of(groups[int(rng.integers(len(groups)))])
        if not models:
            continue
        model = models[int(rng.integers(len(models)))]
        wide, deep, _ = model.entry.size_m
        along = rng.uniform(left, right)
        if deep + 0.1 > reach or along - wide / 2 < left or along + wide / 2 > right:
            continue
        x, y, _ = frame.point(along, 0, outer - deep / 2 - 0.03)
        inwards = math.degrees(math.atan2(-float(frame.out[1]), -float(frame.out[0]))) + 90
        thing = Placed(model, x, y, model.entry.elevation_m, inwards)
        if not any(thing.box.meets(other.box) for other in room.place.things):
            room.place.things.append(thing)


def _hang_pictures(room: Builder) -> None:
    """Framed photos on free parts of the walls."""
    rng = room.rng
    place = room.place
    for _ in range(int(rng.choice([0, 1, 2, 4, 7], p=[0.15, 0.2, 0.3, 0.2, 0.15]))):
        wall = WALLS[int(rng.integers(4))]
        wide = rng.uniform(0.18, 1.1)
        high = wide * rng.uniform(0.65, 1.4)
        height = rng.uniform(1.35, 1.75)
        if high > 1.2 or wide > place.length(wall) - 0.2 or height + high / 2 > place.height - 0.1:
            continue
        middle = rng.uniform(wide / 2 + 0.05, place.length(wall) - wide / 2 - 0.05)

        # Not before or beside windows and doors, nor where something else hangs or stands.
        blocked = any(
            one.wall == wall
            and middle - wide / 2 < one.start + one.width + 0.25
            and middle + wide / 2 > one.start - 0.25
            for one in place.openings
        )
        frame = WallFrame(place, wall)
        one = np.array(frame.point(middle - wide / 2 - 0.05, height - high / 2 - 0.05, -0.04))
        other = np.array(frame.point(middle + wide / 2 + 0.05, height + high / 2 + 0.05, 0.0))
        low = np.minimum(one, other)
        top = np.maximum(one, other)
        region = Box(low[0], low[1], top[0], top[1], low[2], top[2])
        if blocked or any(region.meets(taken) for taken in place.taken):
            continue
        place.taken.append(region)
        room.parts += picture_frame(rng, frame, middle, height, (wide, high), room.photo_material())


def _mesh_of(room: Builder, thing: Placed, shines: bool) -> Mesh:
    """A thing's triangles in the room, with a new skin where its own is plain grey."""
    if thing.model.entry.key == "made#shelf":
        return quad((0, 0, -5), (0.01, 0, 0), (0, 0.01, 0), Material())  # its mesh is there already
    mesh = room.furniture.library.mesh(thing.model)
    materials = [_skinned(room, thing, material) for material in mesh.materials]
    if shines:
        materials = [_shining(material) for material in materials]
    mesh = mesh.with_materials(materials)
    turn = rotation_z(thing.angle) * thing.scale
    return _with_box_uv(mesh, thing, room).moved(turn, (thing.x, thing.y, thing.z))


def _skinned(room: Builder, thing: Placed, material: Material) -> Material:
    """The material, or another one if it is an untextured grey, which no one chose."""
    rng = room.rng
    # Textures, glass and metal stay.
    if material.texture is not None or material.opacity < 0.6 or material.specular > 0.3:
        return material
    high = max(material.color)
    low = min(material.color)
    if high - low > NEUTRAL_SATURATION or high < 0.25 or rng.random() > SKIN_SHARE:
        return _toned(rng, material)
    # Small things get any colour, soft ones cloth, others wood.
    size = max(thing.model.entry.size_m)
    if size < 0.4:
        hue = np.clip(rng.random(3) * rng.uniform(0.3, 1.0) + 0.1, 0.05, 0.92)
        red, green, blue = (float(value) for value in hue)
        return dataclasses.replace(
            material, color=(red, green, blue), specular=0.05, roughness=0.25
        )
    soft = any(thing.model in room.furniture.of(group) for group in SOFT_GROUPS)
    if soft:
        return material_of(room.surface("fabric"))
    if room.kind == "bathroom" or rng.random() < 0.4:
        return _toned(rng, material)
    return material_of(room.surface("wood"))


def _toned(rng: Rng, material: Material) -> Material:
    """The material in a little different colour."""
    shift = np.clip(
        np.array(material.color) * rng.uniform(0.8, 1.1) + rng.normal(0, 0.02, 3), 0.02, 0.95
    )
    red, green, blue = (float(value) for value in shift)
    return dataclasses.replace(material, color=(red, green, blue))


def _shining(material: Material) -> Material:
    """A lamp's bright materials shine; its foot does not."""
    bright = material.texture is None and min(material.color) > 0.45
    is_shade = bright or material.opacity < 0.95
    return dataclasses.replace(material, emission=2.5, opacity=1.0) if is_shade else material


def _with_box_uv(mesh: Mesh, thing: Placed, room: Builder) -> Mesh:
    """The mesh with texture coordinates in metres on triangles whose texture is a made surface.

    Each triangle is seen along the axis it faces most.
    """
    folder = str(room.cache)
    is_made = np.array(
        [
            material.texture is not None and material.texture.startswith(folder)
            for material in mesh.materials
        ],
        bool,
    )
    chosen = is_made[mesh.material]  # [F]
    if not chosen.any():
        return mesh

    # The coordinates along the two other axes become u and v.
    axis = np.abs(mesh.normals[chosen].mean(1)).argmax(1)
    corners = mesh.corners[chosen] * thing.scale / 0.6  # a repeat of 60 cm, as cloth and wood have
    first = np.where(axis == 0, 1, 0)
    second = np.where(axis == 2, 1, 2)
    rows = np.arange(len(corners))
    planar = np.stack(
        [
            corners[rows[:, None], np.arange(3)[None], first[:, None]],
            corners[rows[:, None], np.arange(3)[None], second[:, None]],
        ],
        -1,
    )
    uv = mesh.uv.copy()
    uv[chosen] = planar
    return dataclasses.replace(mesh, uv=uv)


def _light(room: Builder) -> Lights:
    """Day or evening: the sun through the windows, the sky behind them, and lamps."""
    rng = room.rng
    place = room.place
    evening = rng.random() < 0.22
    azimuth = rng.uniform(0, 2 * math.pi)
    windows = [one for one in place.openings if one.kind == "window"]
    if windows and rng.random() < 0.65:
        # The sun shines into a window, more or less along its axis.
        frame = WallFrame(place, windows[0].wall)
        azimuth = math.atan2(frame.out[1], frame.out[0]) + rng.normal(0, 0.6)  # radians
    elevation = math.radians(rng.uniform(12, 60))
    sun = direction_to_sun(azimuth, elevation)
    # A photo stands at the horizon of most skies, if there are photos.
    backdrop = room.photo(rng) if room.photo is not None and rng.random() < 0.8 else None
    sky = made_sky(rng, sun, backdrop)
    # Irradiance of the sun, in units in which a white sky gives π; 0: behind clouds.
    warm = np.array([1.0, 0.9, 0.75]) ** rng.uniform(0.3, 2.0)
    strength = 0.0 if rng.random() < 0.4 else rng.uniform(4, 16)
    brightness = rng.uniform(0.7, 1.5)
    if evening:
        brightness = rng.uniform(0.005, 0.08)
        strength = 0.0

    # Windows, through which the sky's light comes, lie a little outside of the wall's inner side.
    portals = []
    for opening in windows:
        frame = WallFrame(place, opening.wall)
        corner = frame.point(opening.start, opening.bottom, 0.05)
        portals.append(
            [corner, (opening.width * frame.along), ((opening.top - opening.bottom) * frame.up)]
        )

    _switch_on(room, evening)
    count = len(room.lamps)
    return Lights(
        sky=(sky * brightness).astype(np.float32),
        sun_direction=sun,
        sun_color=(warm * strength).astype(np.float32),
        sun_spread=float(rng.uniform(0.004, 0.012)),
        portals=np.array([[np.asarray(p, np.float64) for p in one] for one in portals], np.float64)
        .reshape(-1, 3, 3)
        .astype(np.float32),
        lamp_positions=np.array([lamp[0] for lamp in room.lamps], np.float32).reshape(count, 3),
        lamp_radii=np.array([lamp[1] for lamp in room.lamps], np.float32),
        lamp_colors=np.array([lamp[2] for lamp in room.lamps], np.float32).reshape(count, 3),
    )


def _switch_on(room: Builder, evening: bool) -> None:
    """Lamps of the room that shine: most in the evening, few by day."""
    rng = room.rng
    place = room.place
    lamp_groups = ("table_lamp", "pendant", "floor_lamp")
    lamps = {model.entry.key for group in lamp_groups for model in room.furniture.of(group)}
    for number, thing in enumerate(place.things):
        if thing.model.entry.key in lamps and rng.random() < (0.8 if evening else 0.3):
            height = thing.model.entry.size_m[2]
            at = 0.75 if thing.z < 1.2 else 0.2  # the bulb is in the upper part, or hangs
            radius = min(0.16, 0.45 * min(thing.model.entry.size_m[:2]))
            color = np.array([1.0, 0.78, 0.5]) * rng.uniform(0.4, 1.2)
            room.lamps.append(((thing.x, thing.y, thing.z + at * height), radius, color))
            room.lit.add(number)
    if evening or rng.random() < 0.25 or not any(o.kind == "window" for o in place.openings):
        # A ceiling lamp: a disc of milky glass.
        x = place.width * rng.uniform(0.4, 0.6)
        y = place.depth * rng.uniform(0.4, 0.6)
        radius = rng.uniform(0.1, 0.2)
        z = place.height
        glow = Material((0.95, 0.93, 0.88), emission=3.0)
        room.parts.append(
            box((x - radius, y - radius, z - 0.06), (x + radius, y + radius, z - 0.001), glow)
        )
        warm = np.array([1.0, rng.uniform(0.75, 0.97), rng.uniform(0.5, 0.95)])
        room.lamps.append(((x, y, z - 0.18), 0.1, warm * rng.uniform(1.5, 4.0)))
