"""Photos without depth made into scenes: cut-outs of some stand at known depths in front of another."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

BACKGROUND_M = (3.0, 8.0)  # depth of the farthest plane
NEARER = (1.15, 4.0)  # a cut-out's inverse depth over that of what it covers
NEAREST_M = 0.7
OBJECTS = (1, 4)
AREA = (0.01, 0.35)  # share of the frame that a cut-out may take

Photos = Callable[[np.random.Generator], Tensor]  # a random photo, [H, W, 3] sRGB


def composite(rng: np.random.Generator, photos: Photos, height: int, width: int) -> tuple[Tensor, Tensor]:
    """A picture [H, W, 3] sRGB of several photos, and its inverse depth [H, W] in 1/m, known exactly."""
    rgb = random_crop(rng, photos(rng), height, width)
    inverse_depth = _background(rng, height, width)
    for _ in range(rng.integers(OBJECTS[0], OBJECTS[1] + 1)):
        picture = random_crop(rng, photos(rng), height, width)
        shape = outline(rng, picture)
        share = float((shape > 0.5).float().mean())
        if not AREA[0] < share < AREA[1]:
            continue
        inside = shape > 0.5
        depth = float(inverse_depth[inside].max()) * rng.uniform(*NEARER)
        if depth > 1 / NEAREST_M:
            continue
        plane = depth * (1 + _tilt(rng, height, width, 0.1))
        rgb = torch.lerp(rgb, picture, shape[..., None])
        inverse_depth = torch.where(inside, plane, inverse_depth)
    return rgb, inverse_depth


def random_crop(rng: np.random.Generator, photo: Tensor, height: int, width: int) -> Tensor:
    """A part of a photo [h, w, 3] at a random scale, by chance mirrored, [height, width, 3]."""
    rows, columns = photo.shape[:2]
    smallest = max(height / rows, width / columns)
    scale = smallest * rng.uniform(1.0, 1.5)
    size = max(height, math.ceil(rows * scale)), max(width, math.ceil(columns * scale))
    resized = interpolate(photo.permute(2, 0, 1)[None], size=size, mode="bicubic", antialias=True)[0].clamp(0, 1)
    top, left = (int(rng.integers(0, have - want + 1)) for have, want in zip(size, (height, width), strict=True))
    part = resized[:, top : top + height, left : left + width].permute(1, 2, 0)
    return part.flip(1).contiguous() if rng.random() < 0.5 else part.contiguous()


def _background(rng: np.random.Generator, height: int, width: int) -> Tensor:
    """A wall, and by chance the ground in front of it or a second wall beside it."""
    far = 1.0 / rng.uniform(*BACKGROUND_M)
    plane = far * (1 + _tilt(rng, height, width, 0.3))
    if rng.random() < 0.5:  # the ground: inverse depth grows linearly below the horizon
        rows = (torch.arange(height) + 0.5) / height
        ground = far * rng.uniform(1.5, 4.0) * (rows - rng.uniform(0.2, 0.6))[:, None].clamp_min(0)
        plane = torch.maximum(plane, ground.expand(height, width))
    if rng.random() < 0.3:
        plane = torch.maximum(plane, far * (1 + _tilt(rng, height, width, 1.0)))
    return plane.clamp(0.5 * far, 1 / NEAREST_M)


def _tilt(rng: np.random.Generator, height: int, width: int, most: float) -> Tensor:
    """A linear ramp [H, W] of random direction, within ±most."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    a, b = (rng.uniform(-most, most) / 2 for _ in range(2))
    return a * x + b * y


def outline(rng: np.random.Generator, picture: Tensor) -> Tensor:
    """An outline [H, W] in 0..1, soft over about a pixel as a camera's edges are."""
    height, width = picture.shape[:2]
    cloud = _noise(rng, height, width, rng.uniform(0.1, 0.35))
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    cy, cx = rng.uniform(0.1, 1.0) * height, rng.uniform(0.0, 1.0) * width
    kind = rng.random()
    if kind < 0.35:  # what resembles the colour at a point: outlines that follow those of real things
        smooth = avg_pool2d(picture.permute(2, 0, 1)[None], 9, stride=1, padding=4, count_include_pad=False)[0]
        color = smooth[:, min(int(cy), height - 1), min(int(cx), width - 1)]
        unlike = ((smooth - color[:, None, None]) ** 2).sum(0) / rng.uniform(0.01, 0.04)
        away = ((x - cx) ** 2 + (y - cy) ** 2) / (rng.uniform(0.15, 0.5) * width) ** 2
        field = 1 - unlike - away + 0.1 * cloud
    elif kind < 0.75:  # a blob
        ry, rx = (rng.uniform(0.08, 0.4) * side for side in (height, width))
        field = 1 - ((x - cx) / rx) ** 2 - ((y - cy) / ry) ** 2 + rng.uniform(0.0, 0.8) * cloud
    else:  # a bar: poles, legs and frames
        angle = rng.uniform(-0.4, 0.4) + (math.pi / 2 if rng.random() < 0.25 else 0.0)
        across = ((x - cx) * math.cos(angle) + (y - cy) * math.sin(angle)).abs()
        field = 1 - across / (rng.uniform(0.008, 0.06) * width) + 0.2 * cloud
    soft = (field > 0).float()[None, None]
    return avg_pool2d(soft, 3, stride=1, padding=1, count_include_pad=False)[0, 0]


def _noise(rng: np.random.Generator, height: int, width: int, size: float) -> Tensor:
    """Smooth noise [H, W] of about ±1; `size` is that of its features over the width."""
    rows, columns = max(2, round(height / (size * width))), max(2, round(1 / size))
    coarse = torch.from_numpy(rng.standard_normal((1, 1, rows, columns)).astype(np.float32))
    return interpolate(coarse, size=(height, width), mode="bicubic", align_corners=True)[0, 0]
