"""Streets with objects that stand on the ground (people, cars, animals, posts), labels of pixels,
and a score.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import torch
from depth_loss import FARTHEST_FACTOR, align
from frames import Frame
from objects import UP, Array, Rng, cut, flat, ground, lean, pole, solid, turn
from ray_tracer import BOX, CYLINDER, ELLIPSOID, SHEET, Floats, Solid, trace
from scene_kinds import Scene
from synthetic_scenes import SAMPLES, render_scene
from textures import LATTICE, LEAVES, RING, WHOLE
from torch import Tensor

from spackle.paper.training.composites import DrawPhoto

Things = list[list[Solid]]
MOST = 64  # more than a scene's number of objects
FARTHEST_M = 100.0  # farther pixels are sky, which would otherwise determine the scale


def _pavement(rng: Rng) -> tuple[list[Solid], Things, float]:
    """Background, objects in front of the background, and the downward angle of the camera."""
    eye = rng.uniform(1.1, 2.3)
    axes = turn(math.radians(rng.uniform(-20, 20)))
    behind = [ground(rng, axes, np.array([0.0, eye, 200.0]), 300.0, 300.0, repeats=200.0)]
    for side in (-1, 1):  # fronts of houses, hedges and walls along the street
        if rng.random() < 0.75:
            z, away = rng.uniform(-4, 8), rng.uniform(3.5, 14)
            while z < 70:
                deep, tall = (
                    rng.uniform(2, 14),
                    rng.uniform(0.5, 2) if rng.random() < 0.25 else rng.uniform(2, 7),
                )
                center = axes @ (side * (away + 5 + rng.uniform(0, 1)), eye - tall, z + deep)
                front = solid(rng, BOX, center, axes @ np.diag([5.0, tall, deep]))
                behind.append(dataclasses.replace(front, repeats=(float(rng.integers(1, 4)),) * 2))
                z += 2 * deep + (rng.uniform(1, 12) if rng.random() < 0.3 else 0.0)
    if rng.random() < 0.6:  # a wall at the end of the street
        behind.append(
            solid(
                rng,
                BOX,
                np.array([rng.uniform(-9, 9), eye - 4, rng.uniform(18, 90)]),
                np.diag([30.0, 9, 2]),
            )
        )
    for _ in range(rng.integers(0, 4)):  # trees in the background
        z = rng.uniform(12, 60)
        foot, tall = np.array([rng.uniform(-0.6, 0.6) * z, eye, z]), rng.uniform(3, 9)
        behind.append(pole(rng, foot, tall, 0.03 * tall, lean(rng.normal(0, 0.06))))
        behind.append(
            solid(rng, SHEET, foot + tall * UP, turn(rng.normal(0, 0.3)) * 0.4 * tall, LEAVES)
        )
    things: Things = []
    for _ in range(rng.integers(3, 10)):
        z = 2.2 + 22 * rng.random() ** 1.8
        foot = np.array([rng.uniform(-0.62, 0.62) * z, eye, z])
        kind = THINGS[int(rng.choice(len(THINGS), p=[share for _, share in THINGS]))][0]
        things.append(kind(rng, foot))
    return behind, things, math.radians(rng.uniform(-6, 9))


def person(rng: Rng, foot: Array) -> list[Solid]:
    """A person: legs, body, arms and a head in three textures; sometimes on a bicycle."""
    tall, axes = (
        rng.uniform(1.2, 1.95),
        turn(rng.uniform(-math.pi, math.pi)) @ lean(rng.normal(0, 0.04)),
    )
    legs, coat, skin = (int(rng.integers(WHOLE)) for _ in range(3))
    made, rides = [], rng.random() < 0.3
    up = 0.25 if rides else 0.0

    def part(
        kind: int, x: float, y: float, z: float, radii: tuple[float, float, float], texture: int
    ) -> None:
        place = foot + axes @ np.array([x, -y - up, z]) * tall
        made.append(solid(rng, kind, place, axes @ np.diag(radii) * tall, texture))

    stride = rng.uniform(0, 0.12)
    for side in (-1, 1):
        part(CYLINDER, side * 0.055, 0.24, side * stride, (0.042, 0.24, 0.05), legs)
        part(CYLINDER, side * 0.14, 0.63, rng.normal(0, 0.03), (0.03, 0.17, 0.035), coat)
    part(ELLIPSOID, 0.0, 0.64, 0.0, (rng.uniform(0.11, 0.16), 0.22, 0.09), coat)
    part(ELLIPSOID, 0.0, 0.92, 0.0, (0.055, 0.08, 0.065), skin)
    if rides:
        for z in (-0.3, 0.3):
            wheel = axes @ turn(math.pi / 2) @ np.diag([0.2, 0.2, 1.0]) * tall
            made.append(
                solid(rng, SHEET, foot + axes @ np.array([0.0, -0.2, z]) * tall, wheel, RING)
            )
        part(BOX, 0.0, 0.06, 0.0, (0.015, 0.02, 0.3), legs)
    return made


def car(rng: Rng, foot: Array) -> list[Solid]:
    """A car: a box on four wheels with a smaller box on top; some are vans."""
    axes = turn(rng.uniform(-0.4, 0.4) + (math.pi / 2 if rng.random() < 0.4 else 0.0))
    wide, long, body = rng.uniform(0.75, 1.0), rng.uniform(1.6, 2.4), rng.uniform(0.3, 0.42)
    cabin = rng.uniform(0.25, 0.35) if rng.random() < 0.8 else rng.uniform(0.5, 0.8)
    paint, glass, tyre = (int(rng.integers(WHOLE)) for _ in range(3))
    length = rng.uniform(0.5, 0.7) if cabin < 0.4 else 0.95
    made = [
        solid(rng, BOX, foot + (0.25 + body) * UP, axes @ np.diag([wide, body, long]), paint),
        solid(
            rng,
            BOX,
            foot + (0.25 + 2 * body + cabin) * UP + axes @ np.array([0, 0, rng.uniform(-0.3, 0.3)]),
            axes @ np.diag([0.88 * wide, cabin, length * long]),
            glass,
        ),
    ]
    for x in (-1, 1):
        for z in (-0.62, 0.62):
            wheel = axes @ lean(math.pi / 2) @ np.diag([0.32, 0.12, 0.32])
            made.append(
                solid(
                    rng,
                    CYLINDER,
                    foot + 0.32 * UP + axes @ np.array([x * wide, 0, z * long]),
                    wheel,
                    tyre,
                )
            )
    return made


def animal(rng: Rng, foot: Array) -> list[Solid]:
    """An animal: a body on four legs, a neck and a head."""
    size, axes, fur = (
        rng.uniform(0.25, 1.0),
        turn(rng.uniform(-math.pi, math.pi)),
        int(rng.integers(WHOLE)),
    )
    legs, thick = rng.uniform(0.5, 0.9) * size, rng.uniform(0.28, 0.42) * size
    made = [
        solid(
            rng,
            ELLIPSOID,
            foot + (legs + 0.6 * thick) * UP,
            axes @ np.diag([thick, thick, size]),
            fur,
        )
    ]
    for x in (-0.6, 0.6):
        for z in (-0.7, 0.7):
            made.append(
                pole(
                    rng,
                    foot + axes @ np.array([x * thick, 0, z * size]),
                    legs,
                    0.1 * size,
                    np.eye(3),
                    fur,
                )
            )
    head = foot + (legs + rng.uniform(0.6, 1.8) * thick) * UP + axes @ np.array([0, 0, 1.15 * size])
    made.append(solid(rng, ELLIPSOID, head, axes @ np.diag([0.2, 0.22, 0.35]) * size, fur))
    return made


def post(rng: Rng, foot: Array) -> list[Solid]:
    """A bollard, lamp post, sign or traffic light: thin, and tall enough to reach in front of
    distant background.
    """
    tall, thick = rng.uniform(0.7, 6), rng.uniform(0.025, 0.12)
    made = [pole(rng, foot, tall, thick, lean(rng.normal(0, 0.02)))]
    if rng.random() < 0.6:
        half = rng.uniform(0.12, 0.45)
        kind = SHEET if rng.random() < 0.6 else BOX
        shape = np.diag([half, half * rng.uniform(0.6, 2), 0.6 * half])
        made.append(solid(rng, kind, foot + tall * UP, turn(rng.normal(0, 0.6)) @ shape))
    return made


def trunk(rng: Rng, foot: Array) -> list[Solid]:
    """A tree trunk, whose crown may be above the picture."""
    tall = rng.uniform(2, 8)
    return [
        pole(rng, foot, tall, rng.uniform(0.07, 0.3), lean(rng.normal(0, 0.05))),
        solid(
            rng,
            SHEET,
            foot + tall * UP,
            turn(rng.normal(0, 0.3)) * rng.uniform(0.2, 0.45) * tall,
            LEAVES,
        ),
    ]


def board(rng: Rng, foot: Array) -> list[Solid]:
    """An upright cut-out: a hoarding or a railing."""
    if rng.random() < 0.4:
        return flat(rng, foot, rng.uniform(0.4, 1.2))
    half = rng.uniform(0.3, 1.0, 2)
    skin = (
        cut(rng)
        if rng.random() < 0.5
        else LATTICE
        if rng.random() < 0.4
        else int(rng.integers(WHOLE))
    )
    return [
        solid(
            rng, SHEET, foot + half[1] * UP, turn(rng.normal(0, 0.6)) @ np.diag([*half, 1.0]), skin
        )
    ]


THINGS: tuple[tuple[Callable[[Rng, Array], list[Solid]], float], ...] = (
    (person, 0.34),
    (car, 0.2),
    (animal, 0.1),
    (post, 0.2),
    (trunk, 0.07),
    (board, 0.09),
)


def labelled_scene(rng: Rng, photos: DrawPhoto, height: int, width: int) -> tuple[Frame, Tensor]:
    """A street, and labels [H, W] int64: 0 for background, else the number of the object that a
    pixel shows.
    """
    owners: list[int] = []

    def build(rng: Rng) -> Scene:
        behind, things, pitch = _pavement(rng)
        owners.extend(
            [0] * len(behind) + [number + 1 for number, thing in enumerate(things) for _ in thing]
        )
        return [*behind, *(part for thing in things for part in thing)], pitch

    seen = render_scene(rng, photos, height, width, build)
    # Render again under ambient light, with the number of its object as each solid's grey.
    marks = [owner / MOST for owner in owners]
    skins = np.stack(
        [
            _marked(seen.skins[one.texture], mark)
            for one, mark in zip(seen.solids, marks, strict=True)
        ]
    )
    solids = [dataclasses.replace(one, texture=index) for index, one in enumerate(seen.solids)]
    found, _ = trace(
        solids, skins, seen.rays, np.array([0, -1, 0], np.float32), 1.0, np.zeros_like(seen.rays)
    )
    owner = torch.from_numpy(found[:, 0] * MOST).round().long()
    owner = owner.reshape(height * SAMPLES, width * SAMPLES)[::SAMPLES, ::SAMPLES]
    known = torch.ones_like(seen.inverse_depth, dtype=torch.bool)
    return Frame(
        seen.rgb.permute(2, 0, 1).contiguous(), seen.inverse_depth, known
    ), owner.contiguous()


def _marked(skin: Floats, mark: float) -> Floats:
    """[S, S, 4] a texture's outline filled with one grey."""
    return np.concatenate([np.full((*skin.shape[:2], 3), mark, np.float32), skin[..., 3:]], -1)


SMALLEST = 0.001  # share of the picture; smaller objects are ignored


@dataclasses.dataclass(frozen=True)
class StandingScore:
    """The score of one picture's objects."""

    # mean |log z − log z* − its median over the object|; 0 if every object has its true shape
    within: float
    abs_rel: float  # mean |z − z*| / z* over objects, aligned by the whole picture
    things: int


def score_standing(inverse_depth: Tensor, frame: Frame, owner: Tensor) -> StandingScore:
    """Judge an inverse depth [H, W], up to scale and shift, within objects [H, W] (0: none), each
    with equal weight.
    """
    true = frame.inverse_depth.double()
    near = true > 1 / FARTHEST_M
    v, t = inverse_depth.double(), true[near]
    found = torch.zeros_like(true)
    found[near] = align(v[near], t).clamp_min(t.min() / FARTHEST_FACTOR)
    error = (true / found).log()
    within, off = [], []
    for number in torch.unique(owner).tolist():
        inside = (owner == number) & near
        if number and float(inside.double().mean()) > SMALLEST:
            own = error[inside]
            within.append(float((own - own.median()).abs().mean()))
            off.append(float((own.exp() - 1).abs().mean()))
    count = len(within)
    return StandingScore(sum(within) / max(1, count), sum(off) / max(1, count), count)
