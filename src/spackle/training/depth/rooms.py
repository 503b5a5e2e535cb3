"""Made scenes with exact depth: rooms, streets, tables and walls, their surfaces cut from photos."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.training.composites import Photos, outline, random_crop
from spackle.training.depth.raycast import BOX, CYLINDER, ELLIPSOID, SHEET, Solid, trace

Floats = NDArray[np.float32]
Array = NDArray[Any]
Rng = np.random.Generator
TEXTURE = 160  # pixels of a texture's side
SKINS, CUTOUTS = 9, 4  # textures of a scene: whole ones, and such with an outline
SAMPLES = 2  # rays along each side of a pixel
KINDS, SHARES = ("room", "street", "table", "sheets"), (0.4, 0.2, 0.25, 0.15)


def made_scene(rng: Rng, photos: Photos, height: int, width: int) -> tuple[Tensor, Tensor]:
    """A picture [H, W, 3] sRGB, and its inverse depth [H, W] in 1/m (0 in the sky), known exactly.

    Args:
        rng: all choices come from here.
        photos: gives the pictures that surfaces are cut from.
        height: in pixels.
        width: likewise.
    """
    kind = str(rng.choice(KINDS, p=SHARES))
    textures = np.stack([_texture(rng, photos, n >= SKINS) for n in range(SKINS + CUTOUTS)])
    solids, pitch = {"room": _room, "street": _street, "table": _table, "sheets": _sheets}[kind](rng)
    focal = width * rng.uniform(0.7, 1.5)
    rays = _rays(height, width, focal, pitch, math.radians(rng.normal(0, 2.5)))
    sky = _sky(rng, photos, height, width)
    above = rng.normal(size=3) * (1.0, 0.4, 1.0) - (0.0, rng.uniform(0.5, 1.5), 0.5)  # y points down
    light = (above / np.linalg.norm(above)).astype(np.float32)
    colors, distances = trace(solids, textures, rays, light, rng.uniform(0.35, 0.9), sky)
    fine = (height * SAMPLES, width * SAMPLES)
    rgb = avg_pool2d(torch.from_numpy(colors).reshape(*fine, 3).permute(2, 0, 1)[None], SAMPLES)[0]
    inverse = torch.from_numpy(1.0 / distances).reshape(fine)[::SAMPLES, ::SAMPLES]  # one of them: no in-between
    return rgb.permute(1, 2, 0).clamp(0, 1).contiguous(), inverse.contiguous()


def _rays(height: int, width: int, focal: float, pitch: float, roll: float) -> Floats:
    """[N, 3] directions of depth one, for `SAMPLES`² rays a pixel, turned down by `pitch` and around by `roll`."""
    y, x = np.mgrid[: height * SAMPLES, : width * SAMPLES].astype(np.float32)
    x, y = ((x + 0.5) / SAMPLES - width / 2) / focal, ((y + 0.5) / SAMPLES - height / 2) / focal
    x, y = x * math.cos(roll) - y * math.sin(roll), x * math.sin(roll) + y * math.cos(roll)
    c, s = math.cos(pitch), math.sin(pitch)
    return np.stack([x, y * c + s, c - y * s], -1).reshape(-1, 3).astype(np.float32)


def _room(rng: Rng) -> tuple[list[Solid], float]:
    """Floor, three walls and by chance a ceiling, turned; things along the walls and on the floor."""
    eye, ceiling = rng.uniform(0.8, 1.8), rng.uniform(2.2, 3.2)
    deep, left, right = rng.uniform(2.0, 7.0), rng.uniform(0.8, 4.0), rng.uniform(0.8, 4.0)
    yaw = math.radians(rng.uniform(-40, 40))
    turn = _turn(yaw)
    middle, tall = (right - left) / 2, ceiling / 2
    span = (left + right) / 2

    def wall(center: tuple[float, float, float], across: float, up: float, face: float) -> Solid:
        axes = turn @ _turn(face) @ np.diag([across, up, 1.0])
        return _solid(rng, SHEET, turn @ center, axes, casts=False)

    y = eye - tall
    solids = [
        _ground(rng, turn, (middle, eye, 0.0), span + 1, deep),
        wall((middle, y, deep), span, tall, 0.0),
        wall((-left, y, 0.0), deep, tall, math.pi / 2),
        wall((right, y, 0.0), deep, tall, math.pi / 2),
    ]
    if rng.random() < 0.6:
        solids.append(_ground(rng, turn, (middle, eye - ceiling, 0.0), span, deep))
    for _ in range(rng.integers(2, 9)):
        place = (rng.uniform(-left, right), eye, rng.uniform(0.9, deep))
        if rng.random() < 0.5:  # along a wall, as furniture stands
            side = rng.integers(3)
            place = ((-left, right, place[0])[side], eye, deep if side == 2 else place[2])
        angle = yaw if rng.random() < 0.7 else rng.uniform(-math.pi, math.pi)
        solids += _thing(rng, turn @ place, rng.uniform(0.15, 0.9), angle)
    return solids, math.radians(rng.uniform(-8, 30))


def _street(rng: Rng) -> tuple[list[Solid], float]:
    """Ground to the horizon, houses to both sides, things in front of them."""
    eye = rng.uniform(1.0, 2.2)
    turn = _turn(math.radians(rng.uniform(-25, 25)))
    solids = [_ground(rng, turn, (0.0, eye, 200.0), 300.0, 300.0, repeats=200.0)]
    for _ in range(rng.integers(0, 9)):
        size = rng.uniform(2, 9)
        side = rng.choice((-1, 1)) * rng.uniform(3, 14)
        center = turn @ (side + np.sign(side) * size, eye - rng.uniform(0.2, 0.9) * size, rng.uniform(4, 60))
        half = np.diag([size, size * rng.uniform(0.6, 1.5), size])
        solids.append(_solid(rng, BOX, center, turn @ half))
    for _ in range(rng.integers(1, 9)):
        place = (rng.uniform(-6, 6), eye, 3 + 25 * rng.random() ** 2)
        solids += _thing(rng, np.array(place), rng.uniform(0.3, 2.0), rng.uniform(-math.pi, math.pi))
    return solids, math.radians(rng.uniform(-8, 14))


def _table(rng: Rng) -> tuple[list[Solid], float]:
    """A surface seen from above with small things on it, by chance a wall behind."""
    eye, reach = rng.uniform(0.25, 0.9), rng.uniform(0.8, 2.5)
    turn = _turn(math.radians(rng.uniform(-30, 30)))
    solids = [_ground(rng, turn, (0.0, eye, 0.0), 4.0, reach if rng.random() < 0.6 else 4.0)]
    solids.append(_solid(rng, SHEET, turn @ (0, 0, reach), turn @ np.diag([6.0, 4.0, 1.0]), casts=False))
    solids.append(_ground(rng, turn, (0.0, eye + 0.7, 0.0), 8.0, 8.0))
    for _ in range(rng.integers(3, 12)):
        place = (rng.uniform(-0.8, 0.8), eye, rng.uniform(0.35, reach))
        solids += _thing(rng, np.array(place), rng.uniform(0.04, 0.3), rng.uniform(-math.pi, math.pi))
    return solids, math.radians(rng.uniform(0, 45))


def _sheets(rng: Rng) -> tuple[list[Solid], float]:
    """Leaning boards, cut-outs and balls in front of a wall, floating as they like."""
    reach = rng.uniform(1.5, 4.0)
    tilt = _turn(rng.normal(0, 0.4)) @ _nod(rng.normal(0, 0.3))
    solids = [_solid(rng, SHEET, np.array([0, 0, reach]), tilt @ np.diag([9.0, 9.0, 1.0]), casts=False)]
    for _ in range(rng.integers(2, 9)):
        z = reach * rng.uniform(0.3, 0.95)
        center = np.array([rng.uniform(-0.6, 0.6) * z, rng.uniform(-0.5, 0.6) * z, z])
        axes = _turn(rng.normal(0, 0.5)) @ _nod(rng.normal(0, 0.4)) @ np.diag(rng.uniform(0.05, 0.4, 3) * z)
        kind = int(rng.choice((SHEET, SHEET, BOX, ELLIPSOID, CYLINDER)))
        solids.append(_solid(rng, kind, center, axes, cut=kind == SHEET and rng.random() < 0.5))
    return solids, 0.0


def _thing(rng: Rng, foot: Array, size: float, yaw: float) -> list[Solid]:
    """Something that stands with its foot at a place: a box, a table, a ball, a tube or a cut-out."""
    choice = rng.random()
    wide, deep, tall = size * rng.uniform(0.4, 1.3), size * rng.uniform(0.3, 1.2), size * rng.uniform(0.3, 1.6)
    turn, up = _turn(yaw), np.array([0.0, 1.0, 0.0])
    center = foot - tall * up
    if choice < 0.4:
        body = [_solid(rng, BOX, center, turn @ np.diag([wide, tall, deep]))]
        if rng.random() < 0.4:  # something on top
            body += _thing(rng, foot - 2 * tall * up, 0.5 * size, rng.uniform(-math.pi, math.pi))
        return body
    if choice < 0.55:  # a top and four legs
        top = _solid(rng, BOX, foot - 1.9 * tall * up, turn @ np.diag([wide, 0.1 * tall, deep]))
        corners = ((a * 0.85 * wide, -0.9 * tall, b * 0.85 * deep) for a in (-1, 1) for b in (-1, 1))
        leg = turn @ np.diag([0.06 * wide, 0.9 * tall, 0.06 * wide])
        return [top, *(_solid(rng, BOX, foot + turn @ np.array(c), leg, like=top) for c in corners)]
    if choice < 0.7:
        return [_solid(rng, ELLIPSOID, center, turn @ np.diag([wide, tall, deep]))]
    if choice < 0.82:
        round_ = 0.6 * min(wide, deep)
        tube = _solid(rng, CYLINDER, center, np.diag([round_, tall, round_]))
        lid = _solid(rng, SHEET, foot - 2 * tall * up, _nod(math.pi / 2) @ np.diag([0.7 * round_, 0.7 * round_, 1]))
        return [tube, lid]
    return [_solid(rng, SHEET, center, _turn(rng.normal(0, 0.4)) @ np.diag([wide, tall, 1.0]), cut=True)]


def _ground(
    rng: Rng, turn: Array, center: tuple[float, float, float], wide: float, deep: float, repeats: float = 3.0
) -> Solid:
    axes = turn @ _nod(math.pi / 2) @ np.diag([wide, deep, 1.0])
    many = float(rng.uniform(1, repeats))
    return Solid(SHEET, _f(turn @ center), _f(axes), int(rng.integers(SKINS)), (many, many), casts=False)


def _solid(
    rng: Rng,
    kind: int,
    center: Array,
    axes: Array,
    *,
    casts: bool = True,
    cut: bool = False,
    like: Solid | None = None,
) -> Solid:
    texture = like.texture if like else int(rng.integers(CUTOUTS)) + SKINS if cut else int(rng.integers(SKINS))
    many = (2.0, 1.0) if kind in (ELLIPSOID, CYLINDER) else (1.0, 1.0)
    return Solid(kind, _f(center), _f(axes), texture, many, casts)


def _turn(yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _nod(pitch: float) -> Array:
    c, s = math.cos(pitch), math.sin(pitch)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def _f(value: object) -> Floats:
    return np.asarray(value, np.float32)


def _texture(rng: Rng, photos: Photos, cut: bool) -> Floats:
    """[S, S, 4]: a part of a photo, as it is, or as a faint pattern on a paint; with an outline where cut."""
    picture = random_crop(rng, photos(rng), TEXTURE, TEXTURE)
    coverage = torch.ones(TEXTURE, TEXTURE)
    if cut:
        shape = outline(rng, picture)
        coverage = shape if float(shape.mean()) > 0.05 else coverage
    elif (how := rng.random()) < 0.65:
        paint = (
            torch.from_numpy(rng.uniform(0.1, 0.95, 3).astype(np.float32))
            if rng.random() < 0.3
            else picture.mean((0, 1))
        )
        picture = torch.lerp(paint.expand_as(picture), picture, float(rng.uniform(0.0, 0.25 if how < 0.4 else 0.7)))
    return torch.cat([picture, coverage[..., None]], -1).numpy()


def _sky(rng: Rng, photos: Photos, height: int, width: int) -> Floats:
    """[N, 3] for all rays: a gradient, with a faint photo in it."""
    rows = torch.linspace(0, 1, height * SAMPLES)[:, None, None]
    above, below = (torch.from_numpy(rng.uniform(low, 1.0, 3).astype(np.float32)) for low in (0.3, 0.6))
    above[2] = torch.maximum(above[2], above[:2].max())  # never redder than blue
    sky = torch.lerp(above, below, rows).expand(-1, width * SAMPLES, -1)
    if rng.random() < 0.5:
        clouds = (
            random_crop(rng, photos(rng), height, width).repeat_interleave(SAMPLES, 0).repeat_interleave(SAMPLES, 1)
        )
        sky = torch.lerp(sky, clouds, 0.2 * float(rng.random()))
    return sky.reshape(-1, 3).contiguous().numpy()
