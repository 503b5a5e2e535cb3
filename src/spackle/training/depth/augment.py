"""One photo with depth into many: seen by a turned and zoomed camera, in other light."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

Rng = np.random.Generator
FOCAL = 1.1  # in widths: of photos whose lens is not known; only turning the camera asks for it


@dataclasses.dataclass(frozen=True)
class Frame:
    """A photo with depth."""

    rgb: Tensor  # [3, H, W] sRGB in 0..1
    inverse_depth: Tensor  # [H, W] in any unit, 0 for infinitely far
    valid: Tensor  # [H, W] bool, where it is known


@dataclasses.dataclass(frozen=True)
class Turning:
    """How far the camera of a frame is turned and zoomed."""

    zoom: tuple[float, float]  # drawn between these; 1 shows as much of the frame as fits
    degrees: tuple[float, float, float]  # standard deviations of yaw, pitch and roll


MEASURED = Turning((1.0, 1.6), (4.0, 4.0, 4.0))  # few scenes have to look like many
MADE = Turning((1.0, 1.4), (2.0, 2.0, 3.0))  # made scenes are drawn from every side already
GUESSED = Turning((1.0, 1.4), (3.0, 3.0, 4.0))  # photos are many
MINGLED_SCALE = (-0.2, 0.8)  # logarithms: of the front frame's median inverse depth over the back one's


def turned(rng: Rng, frame: Frame, height: int, width: int, turning: Turning) -> Frame:
    """What a camera at the same place sees that looks elsewhere, and by chance its mirror image.

    Turning needs no depth; the inverse depth changes by the known factor between the two cameras' axes.
    """
    rows, columns = frame.inverse_depth.shape
    focal = FOCAL * columns
    scale = max(width / columns, height / rows) * math.exp(rng.uniform(*np.log(turning.zoom)))
    stretch = math.exp(rng.normal(0, 0.06))
    rotation = torch.from_numpy(_rotation(np.radians(rng.normal(0, 1, 3) * turning.degrees))).float()
    slack = [max(0.0, have * scale - want) / 2 for have, want in ((columns, width), (rows, height))]
    cx, cy = (want / 2 + rng.uniform(-s, s) for want, s in zip((width, height), slack, strict=True))
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    ray = torch.stack([(x - cx) / (focal * scale * stretch), (y - cy) / (focal * scale), torch.ones_like(x)], -1)
    ray = ray @ rotation  # in the frame's own camera
    u, v = (ray[..., k] / ray[..., 2] * focal for k in (0, 1))
    grid = torch.stack([2 * u / columns, 2 * v / rows], -1)[None]
    rgb = grid_sample(frame.rgb[None], grid, padding_mode="reflection", align_corners=False)[0]
    depth = torch.stack([frame.inverse_depth, frame.valid.float()])[None]
    inverse_depth, valid = grid_sample(depth, grid, mode="nearest", padding_mode="zeros", align_corners=False)[0]
    result = Frame(rgb, inverse_depth * ray[..., 2], valid > 0.5)
    if rng.random() < 0.5:
        return Frame(*(tensor.flip(-1) for tensor in (result.rgb, result.inverse_depth, result.valid)))
    return result


def _rotation(angles: NDArray[Any]) -> NDArray[Any]:
    """[3, 3] from yaw, pitch and roll in radians."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
    yaw = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    pitch = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return np.asarray(roll @ pitch @ yaw)


def mingled(rng: Rng, back: Frame, front: Frame) -> Frame:
    """Two frames of one size as one scene: each pixel shows the one that is nearer there, at a random relative scale.

    Outlines and textures are real ones, and so is the depth; only that these things ever stood together is not.
    """
    both = back.valid & front.valid
    if not bool(both.any()):
        return back
    medians = [frame.inverse_depth[both].median() for frame in (back, front)]
    scale = float(medians[0] / medians[1].clamp_min(1e-9)) * math.exp(rng.uniform(*MINGLED_SCALE))
    nearer = both & (front.inverse_depth * scale > back.inverse_depth)
    return Frame(
        torch.where(nearer, front.rgb, back.rgb),
        torch.where(nearer, front.inverse_depth * scale, back.inverse_depth),
        back.valid,
    )


def relit(rng: Rng, rgb: Tensor) -> Tensor:
    """[3, H, W] in another light, through another camera: brightness, tint, contrast, glare, grey, blur, noise."""
    tint = np.exp(rng.normal(0, 0.12, (3, 1, 1)) + rng.normal(0, 0.2)).astype(np.float32)
    rgb = rgb * torch.from_numpy(tint)
    mean = rgb.mean((1, 2), keepdim=True)
    harsh = rng.uniform(0.3, 1.0) if rng.random() < 0.12 else 0.0  # black shadows, and what is bright is white
    rgb = mean + (rgb - mean) * math.exp(rng.normal(harsh, 0.25)) + harsh * rng.uniform(-0.1, 0.3)
    grey = rgb.mean(0, keepdim=True)
    rgb = grey + (rgb - grey) * (0.0 if rng.random() < 0.2 else math.exp(rng.normal(0, 0.3)))
    rgb = rgb.clamp(1e-4, 1) ** math.exp(rng.normal(0, 0.2))
    if rng.random() < 0.2:
        rgb = avg_pool2d(rgb[None], 3, 1, 1, count_include_pad=False)[0]
    if rng.random() < 0.3:
        noise = torch.from_numpy(rng.standard_normal(rgb.shape).astype(np.float32))
        rgb = rgb + float(rng.uniform(0, 0.04)) * noise
    return rgb.clamp(0, 1)
