"""Made scenes with exact depth: rooms, shelves, tables and yards, their surfaces cut from photos."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.training.composites import Photos
from spackle.training.depth import indoors, outdoors, still_lifes
from spackle.training.depth.indoors import Scene
from spackle.training.depth.raycast import Floats, trace
from spackle.training.depth.skins import skins, sky

Rng = np.random.Generator
SAMPLES = 2  # rays along each side of a pixel
KINDS: tuple[tuple[Callable[[Rng], Scene], float], ...] = (  # and how often
    (indoors.room, 0.17),
    (indoors.table, 0.09),
    (indoors.sheets, 0.05),
    (still_lifes.still_life, 0.25),
    (still_lifes.heap, 0.09),
    (still_lifes.shelf, 0.08),
    (outdoors.street, 0.07),
    (outdoors.yard, 0.2),
)


def made_scene(rng: Rng, photos: Photos, height: int, width: int) -> tuple[Tensor, Tensor]:
    """A picture [H, W, 3] sRGB, and its inverse depth [H, W] in 1/m (0 in the sky), known exactly.

    Args:
        rng: all choices come from here.
        photos: gives the pictures that surfaces are cut from.
        height: in pixels.
        width: likewise.
    """
    build = KINDS[int(rng.choice(len(KINDS), p=[share for _, share in KINDS]))][0]
    textures = skins(rng, photos)
    solids, pitch = build(rng)
    focal = width * rng.uniform(0.7, 1.5)
    rays = _rays(height, width, focal, pitch, math.radians(rng.normal(0, 2.5)))
    behind = sky(rng, photos, height, width).repeat(SAMPLES, 0).repeat(SAMPLES, 1).reshape(-1, 3)
    above = rng.normal(size=3) * (1.0, 0.4, 1.0) - (0.0, rng.uniform(0.5, 1.5), 0.5)  # y points down
    light = (above / np.linalg.norm(above)).astype(np.float32)
    colors, distances = trace(solids, textures, rays, light, rng.uniform(0.25, 0.9), behind)
    fine = (height * SAMPLES, width * SAMPLES)
    rgb = _exposed(rng, torch.from_numpy(colors))
    rgb = avg_pool2d(rgb.reshape(*fine, 3).permute(2, 0, 1)[None], SAMPLES)[0]
    inverse = torch.from_numpy(1.0 / distances).reshape(fine)[::SAMPLES, ::SAMPLES]  # one of them: no in-between
    return rgb.permute(1, 2, 0).contiguous(), inverse.contiguous()


def _exposed(rng: Rng, rgb: Tensor) -> Tensor:
    """As bright as photos are on the whole; what is brighter than white is white."""
    return (rgb * (rng.uniform(0.25, 0.6) / float(rgb.mean().clamp_min(0.02)))).clamp(0, 1)


def _rays(height: int, width: int, focal: float, pitch: float, roll: float) -> Floats:
    """[N, 3] directions of depth one, for `SAMPLES`² rays a pixel, turned down by `pitch` and around by `roll`."""
    y, x = np.mgrid[: height * SAMPLES, : width * SAMPLES].astype(np.float32)
    x, y = ((x + 0.5) / SAMPLES - width / 2) / focal, ((y + 0.5) / SAMPLES - height / 2) / focal
    x, y = x * math.cos(roll) - y * math.sin(roll), x * math.sin(roll) + y * math.cos(roll)
    c, s = math.cos(pitch), math.sin(pitch)
    return np.stack([x, y * c + s, c - y * s], -1).reshape(-1, 3).astype(np.float32)
