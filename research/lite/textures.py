"""Textures of synthetic scenes: parts of photos, whole or with an outline, and skies."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.paper.training.composites import DrawPhoto, random_crop, random_outline

Floats = NDArray[np.float32]
Rng = np.random.Generator
SIDE = 160  # pixels of a texture
# number of a scene's textures that cover a whole surface, and of those with an outline
WHOLE, CUT = (
    9,
    3,
)
FIRST_SHAPE = WHOLE + CUT
# one texture of each of these shapes
LATTICE, LEAVES, RING, PEAK = (FIRST_SHAPE + n for n in range(4))


def textures(rng: Rng, photos: DrawPhoto) -> Floats:
    """[T, S, S, 4] the textures of a scene: colours 0..1 and coverage 0 or 1."""
    return np.stack([_skin(rng, photos, number) for number in range(PEAK + 1)])


def sky(rng: Rng, photos: DrawPhoto, height: int, width: int) -> Floats:
    """[H, W, 3] a sky: a gradient with a faint photo in it, or plain white."""
    if rng.random() < 0.2:
        return np.full((height, width, 3), rng.uniform(0.92, 1.0), np.float32)
    rows = torch.linspace(0, 1, height)[:, None, None]
    # never more red than blue; at the zenith and at the horizon
    red = [rng.uniform(low, 1.0) for low in (0.35, 0.7)]
    above, below = (
        torch.tensor([r, rng.uniform(r, 1.0), 1.0]) * rng.uniform(0.7, 1.0) for r in red
    )
    result = torch.lerp(above, below, rows).expand(-1, width, -1)
    if rng.random() < 0.5:
        clouds = random_crop(rng, photos(rng), height, width)
        result = torch.lerp(result, clouds, 0.2 * float(rng.random()))
    return result.contiguous().numpy()


def _skin(rng: Rng, photos: DrawPhoto, number: int) -> Floats:
    """[S, S, 4]: part of a photo, unchanged or as a faint pattern on a colour; `number` determines
    the outline.
    """
    picture = random_crop(rng, photos(rng), SIDE, SIDE)
    coverage = np.ones((SIDE, SIDE), np.float32)
    if number >= FIRST_SHAPE:
        coverage = _shape(rng, number)
    elif number >= WHOLE:
        shape = random_outline(rng, picture)
        coverage = shape.numpy() if float(shape.mean()) > 0.05 else coverage
    if number >= FIRST_SHAPE or (number < WHOLE and rng.random() < 0.5):
        picture = _painted(rng, picture)
    return np.concatenate([picture.numpy(), coverage[..., None]], -1)


def _painted(rng: Rng, picture: Tensor) -> Tensor:
    """A single colour, blended with the picture to a random degree."""
    own = rng.random() < 0.8
    paint = (
        picture.mean((0, 1))
        if own
        else torch.from_numpy(rng.uniform(0.05, 0.95, 3).astype(np.float32))
    )
    return torch.lerp(paint.expand_as(picture), picture, float(rng.uniform(0.05, 0.8)))


def _shape(rng: Rng, number: int) -> Floats:
    """[S, S] the outline with this number, as 0 and 1."""
    y, x = (np.mgrid[:SIDE, :SIDE].astype(np.float32) + 0.5) / SIDE
    if number == LATTICE:  # horizontal or vertical bars, or both: fences, grids, window frames
        thick, many = rng.uniform(0.15, 0.5), rng.integers(2, 9, 2)
        slant = rng.uniform(-1, 1) if rng.random() < 0.3 else 0.0
        bars = [
            ((many[0] * (x + slant * y)) % 1) < thick,
            ((many[1] * (y - slant * x)) % 1) < thick,
        ]
        kept = bars[0] | bars[1] if (which := rng.random()) < 0.6 else bars[int(which < 0.8)]
    elif number == LEAVES:
        cells = int(rng.integers(6, 26))
        noise = torch.from_numpy(rng.standard_normal((1, 1, cells, cells)).astype(np.float32))
        cloud = interpolate(noise, size=(SIDE, SIDE), mode="bicubic", align_corners=True)[
            0, 0
        ].numpy()
        kept = cloud > rng.uniform(-0.4, 0.6) + 1.5 * np.maximum(
            0, np.hypot(x - 0.5, y - 0.5) - 0.3
        )
    elif number == RING:
        away = np.hypot(x - 0.5, y - 0.5)
        kept = (away < 0.49) & (away > rng.uniform(0.25, 0.42))
    else:  # a peak: cones, roofs, pennants
        kept = np.abs(x - 0.5) < y * rng.uniform(0.25, 0.5) * (
            1 if rng.random() < 0.5 else math.sqrt(2)
        )
    return np.asarray(kept, np.float32)
