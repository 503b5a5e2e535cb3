"""Where things stand in a room: on the floor, at walls and on each other, never in each other."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal

import numpy as np

from worlds.library import Model

Rng = np.random.Generator
WallName = Literal["back", "right", "front", "left"]
WALLS: tuple[WallName, ...] = ("back", "right", "front", "left")
# A model at this angle, in degrees, has its back to the wall.
ANGLES: dict[WallName, float] = {"back": 0.0, "right": -90.0, "front": 180.0, "left": 90.0}
TRIES = 24  # random places before a thing is left out
WALL_GAP_M = 0.02
INSET = 0.82  # things stand within this share of a table's sides


@dataclasses.dataclass(frozen=True)
class Box:
    """A region that is taken, with sides along the room's."""

    x0: float
    y0: float
    x1: float
    y1: float
    z0: float
    z1: float

    def meets(self, other: Box) -> bool:
        """Whether two regions have room in common."""
        return (
            self.x0 < other.x1
            and other.x0 < self.x1
            and self.y0 < other.y1
            and other.y0 < self.y1
            and self.z0 < other.z1
            and other.z0 < self.z1
        )


@dataclasses.dataclass(frozen=True)
class Placed:
    """A model in a room."""

    model: Model
    x: float  # of the middle of its box
    y: float
    z: float  # of its lower side
    angle: float  # degrees, counterclockwise from above; at 0 it looks towards −y
    scale: float = 1.0

    @property
    def box(self) -> Box:
        """The region that it takes."""
        width, depth, height = (side * self.scale for side in self.model.entry.size_m)
        turn = math.radians(self.angle)
        half_x = (abs(math.cos(turn)) * width + abs(math.sin(turn)) * depth) / 2
        half_y = (abs(math.sin(turn)) * width + abs(math.cos(turn)) * depth) / 2
        return Box(
            self.x - half_x,
            self.y - half_y,
            self.x + half_x,
            self.y + half_y,
            self.z,
            self.z + height,
        )

    def beside(self, sideways: float, forward: float) -> tuple[float, float]:
        """The point this far to the thing's left (seen from its front: right) and before it."""
        turn = math.radians(self.angle)
        x = self.x + sideways * math.cos(turn) + forward * math.sin(turn)
        y = self.y + sideways * math.sin(turn) - forward * math.cos(turn)
        return x, y


@dataclasses.dataclass(frozen=True)
class Opening:
    """A window or door in a wall."""

    wall: WallName
    start: float  # along the wall in metres, from its left end seen from inside
    width: float
    bottom: float
    top: float
    kind: Literal["window", "door", "passage"]


class Place:
    """A room that is being furnished."""

    def __init__(
        self, rng: Rng, width: float, depth: float, height: float, openings: list[Opening]
    ) -> None:
        """An empty room of x in 0..width, y in 0..depth and z in 0..height."""
        self.rng = rng
        self.width = width
        self.depth = depth
        self.height = height
        self.openings = openings
        self.things: list[Placed] = []
        self.taken: list[Box] = []
        for opening in openings:
            if opening.kind != "window":
                self.taken.append(self._before(opening))

    def length(self, wall: WallName) -> float:
        """The length of a wall."""
        return self.width if wall in ("back", "front") else self.depth

    def wall_point(self, wall: WallName, along: float, away: float) -> tuple[float, float]:
        """The point `along` a wall from its left end, seen from inside, and `away` from it."""
        if wall == "back":
            return along, self.depth - away
        if wall == "right":
            return self.width - away, self.depth - along
        if wall == "front":
            return self.width - along, away
        return away, along

    def put(self, thing: Placed) -> Placed:
        """Add a thing without asking."""
        self.things.append(thing)
        self.taken.append(thing.box)
        return thing

    def fits(self, box: Box, margin: float = 0.0) -> bool:
        """Whether a region is inside the room and free."""
        inside = (
            box.x0 >= 0
            and box.y0 >= 0
            and box.x1 <= self.width
            and box.y1 <= self.depth
            and box.z1 <= self.height
        )
        wider = dataclasses.replace(
            box, x0=box.x0 - margin, y0=box.y0 - margin, x1=box.x1 + margin, y1=box.y1 + margin
        )
        return inside and not any(wider.meets(other) for other in self.taken)

    def at_wall(
        self,
        models: list[Model],
        wall: WallName | None = None,
        along: float | None = None,
        z: float | None = None,
        gap: float = WALL_GAP_M,
        margin: float = 0.03,
    ) -> Placed | None:
        """A model with its back to a wall, not before doors, nor before windows if it is high.

        Args:
            models: one of these.
            wall: which wall; None: any.
            along: middle of the thing along the wall; None: anywhere.
            z: height of its lower side; None: as the catalogue has it.
            gap: between its back and the wall.
            margin: free space to other things.
        """
        if not models:
            return None
        for _ in range(TRIES):
            model = models[int(self.rng.integers(len(models)))]
            side = wall or WALLS[int(self.rng.integers(4))]
            width, depth, height = model.entry.size_m
            length = self.length(side)
            if width > length - 0.05:
                continue
            lower = model.entry.elevation_m if z is None else z
            middle = self.rng.uniform(width / 2, length - width / 2) if along is None else along
            if self._covers_opening(side, middle - width / 2, middle + width / 2, lower, height):
                continue
            x, y = self.wall_point(side, middle, depth / 2 + gap)
            thing = Placed(model, x, y, lower, ANGLES[side])
            if self.fits(thing.box, margin):
                return self.put(thing)
        return None

    def on_floor(
        self,
        models: list[Model],
        near: tuple[float, float] | None = None,
        spread: float = 0.0,
        angle: float | None = None,
        margin: float = 0.02,
        tries: int = TRIES,
    ) -> Placed | None:
        """A model on the floor, at any free place or near a point, at any angle or a given one."""
        if not models:
            return None
        for _ in range(tries):
            model = models[int(self.rng.integers(len(models)))]
            if near is None:
                x = self.rng.uniform(0, self.width)
                y = self.rng.uniform(0, self.depth)
            else:
                x = near[0] + self.rng.normal(0, spread) if spread else near[0]
                y = near[1] + self.rng.normal(0, spread) if spread else near[1]
            turn = self.rng.uniform(0, 360) if angle is None else angle
            thing = Placed(model, x, y, 0.0, turn)
            if self.fits(thing.box, margin):
                return self.put(thing)
        return None

    def in_corner(self, models: list[Model]) -> Placed | None:
        """A model near one of the room's corners."""
        corners = [(x, y) for x in (0.45, self.width - 0.45) for y in (0.45, self.depth - 0.45)]
        self.rng.shuffle(corners)
        for corner in corners:
            thing = self.on_floor(models, corner, 0.12, tries=6)
            if thing is not None:
                return thing
        return None

    def on_top(
        self,
        base: Placed,
        models: list[Model],
        count: int,
        facing: bool = True,
        at: tuple[float, float] | None = None,
    ) -> list[Placed]:
        """Up to `count` small models on the place of `base` that the catalogue gives for it.

        Args:
            base: stands already.
            models: one of these each time; too large ones are passed over.
            count: at most this many.
            facing: whether they look to the front of `base`, roughly.
            at: sideways and forward of the middle of `base`; None: anywhere on it.
        """
        width, depth, height = base.model.entry.size_m
        top = base.model.entry.top_m
        level = base.z + (height if top is None else top)
        found: list[Placed] = []
        if (top is not None and top < 0) or not models:
            return found
        for _ in range(count * 5):
            if len(found) == count:
                break
            model = models[int(self.rng.integers(len(models)))]
            small_width, small_depth, small_height = model.entry.size_m
            free_x = (width * INSET - small_width) / 2
            free_y = (depth * INSET - small_depth) / 2
            if free_x < 0 or free_y < 0 or level + small_height > self.height:
                continue
            sideways = self.rng.uniform(-free_x, free_x)
            forward = self.rng.uniform(-free_y, free_y)
            if at is not None:
                sideways, forward = at
            x, y = base.beside(sideways, forward)
            turn = self.rng.normal(0, 20) if facing else self.rng.uniform(0, 360)
            thing = Placed(model, x, y, level, base.angle + turn)
            clash = any(thing.box.meets(other.box) for other in self.things if other is not base)
            if not clash:
                found.append(self.put(thing))
        return found

    def _before(self, opening: Opening) -> Box:
        """The floor before a door, which stays free."""
        x0, y0 = self.wall_point(opening.wall, opening.start, 0.0)
        x1, y1 = self.wall_point(opening.wall, opening.start + opening.width, 0.7)
        return Box(min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1), 0.0, opening.top)

    def _covers_opening(
        self, wall: WallName, left: float, right: float, z: float, height: float
    ) -> bool:
        """Whether a thing at a wall would hide an opening."""
        return any(
            opening.wall == wall
            and left < opening.start + opening.width + 0.05
            and right > opening.start - 0.05
            and z + height > opening.bottom + 0.1
            and z < opening.top
            for opening in self.openings
        )
