"""Gaussians of a photo whose every pixel has a depth: one for each, two at silhouettes, and a coarse backing."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases.blending import OPACITY, SPREAD_PX, blended_colors, blended_opacities
from spackle.bases.silhouettes import Layers, find_layers
from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.surface import EDGE, surface_gaussians, surface_slope

# Blobs of half a pixel reproduce the photo sharply, but light passes between them. Blobs wide enough to
# close the surface would blur it. So a coarse backing, one blob for 2×2 pixels, closes it from behind:
# 2 dB sharper at the photo's camera than one layer of wider blobs.
BACKING_SPREAD_PX = 1.1
BACKING_GAP = 0.005  # the backing's distance behind the front, relative
BACKING_SLOPE_GAP = 4.0  # and this many pixels further along a slanted surface, so that none pokes through
MAX_BACKING_GAP = 0.2
FLAT = 0.005  # most relative bend of the inverse depth over 4×4 pixels that one Gaussian of the backing stands for
LEAST_MIXED = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)


def layered_gaussians(inverse_depth: Tensor, colors: Tensor, camera: Camera) -> Gaussians:
    """At most 1.25 Gaussians a pixel, first one for each in row-major order, in what it shows most of.

    Where a pixel beside a depth step shows both surfaces, a second one stands for the rest; from the photo's camera
    they mix to what the photo shows. The backing follows.

    Args:
        inverse_depth: [H, W], positive everywhere.
        colors: [H, W, 3] linear RGB.
        camera: the photo's.
    """
    slope = surface_slope(inverse_depth)
    layers = find_layers(*(image.contiguous().numpy() for image in (inverse_depth, slope, colors)))
    for least in LEAST_MIXED:
        pixels = _split(layers, least, colors)
        backing, spare = _backing(pixels, camera)
        if spare >= 0:
            break
    every = torch.ones_like(pixels.mixed)
    return Gaussians.cat([pixels.most.gaussians(every, camera), pixels.rest.gaussians(pixels.mixed, camera), backing])


@dataclasses.dataclass(frozen=True)
class _Surface:
    """A surface in each pixel."""

    depth: Tensor  # [H, W] inverse
    slope: Tensor  # [H, W, 2]
    color: Tensor  # [H, W, 3] linear RGB
    opacity: Tensor  # [H, W]

    def instead(self, where: Tensor, other: _Surface) -> _Surface:
        """The other one at some pixels [H, W]."""
        pairs = ((getattr(one, f.name) for one in (other, self)) for f in dataclasses.fields(self))
        shaped = ((where if a.ndim == 2 else where[..., None], a, b) for a, b in pairs)
        return _Surface(*(torch.where(*images) for images in shaped))

    def gaussians(self, where: Tensor, camera: Camera) -> Gaussians:
        """One for each of some pixels [H, W], in row-major order."""
        uv = camera.pixel_centers()[where]
        depth, slope, color, opacity = self.depth[where], self.slope[where], self.color[where], self.opacity[where]
        return surface_gaussians(camera, uv, depth, slope, SPREAD_PX, color, opacity)


@dataclasses.dataclass(frozen=True)
class _Pixels:
    """What a photo's pixels show."""

    most: _Surface  # what a pixel shows most of
    rest: _Surface  # the other one, where `mixed`
    mixed: Tensor  # [H, W] bool
    near: Tensor  # [H, W] bool: most is of the near one of both
    edge: Tensor  # [H, W] bool: a depth step is close


def _split(layers: Layers, least: float, colors: Tensor) -> _Pixels:
    """Take a pixel as mixed where no less than `least` is of either surface; else it is all of one."""
    ring, alpha = torch.from_numpy(layers.ring), torch.from_numpy(layers.alpha)
    near = alpha >= 0.5
    mixed = torch.minimum(alpha, 1 - alpha) >= least
    opacity = float(OPACITY) * blended_opacities(torch.where(mixed, alpha, near.float()).numpy(), layers.ring)
    surfaces = []
    for side, opaque in enumerate((torch.from_numpy(opacity), torch.full_like(alpha, float(OPACITY)))):
        depth, slope, own = (torch.from_numpy(a[side]) for a in (layers.depth, layers.slope, layers.color))
        surfaces.append(_Surface(depth, slope, torch.where(mixed[..., None], own, colors), opaque))
    most, rest = surfaces[1].instead(near, surfaces[0]), surfaces[0].instead(near, surfaces[1])
    sharp = blended_colors(most.color.numpy(), most.depth.numpy(), layers.ring)
    return _Pixels(dataclasses.replace(most, color=torch.from_numpy(sharp)), rest, mixed, near, ring > 0)


def _backing(pixels: _Pixels, camera: Camera) -> tuple[Gaussians, int]:
    """One wide Gaussian for each 2×2 pixels, behind the farthest of them and in its surface; and how many to spare.

    None is where only the rest of mixed pixels lies behind. What mixed pixels cost is saved where it shows least: in
    the flattest places one for 4×4 pixels stands for four.
    """
    behind = pixels.mixed & pixels.near
    deepest = pixels.most.instead(behind, pixels.rest)
    cells = _cells(deepest.depth)
    if not cells.numel():  # one pixel high or wide
        return Gaussians.empty(), -int(pixels.mixed.sum())
    far, pick = cells.min(dim=-1)
    slope = _cells(deepest.slope).gather(2, pick[..., None, None].expand(*pick.shape, 1, 2)).squeeze(2)
    # The cell's centre lies half a pixel from the farthest pixel's.
    offset = torch.stack([0.5 - pick % 2, 0.5 - pick // 2], dim=-1)
    at_center = (far + (slope * offset).sum(-1)).clamp_min(0.5 * far.min())
    gap = BACKING_GAP + BACKING_SLOPE_GAP * slope.abs().sum(-1) / at_center
    recede = (1.0 - gap.clamp_max(MAX_BACKING_GAP))[..., None]
    # Its colour is the mean of the pixels on that surface.
    same = (cells - far[..., None] < 0.02 * far[..., None]).to(far)
    color = (_cells(deepest.color) * same[..., None]).sum(2) / same.sum(2)[..., None]
    wanted = ~_cells(behind).any(-1) | _cells(pixels.edge & ~pixels.near).any(-1)
    spare = int((~wanted).sum()) - int(pixels.mixed.sum())
    flat = _flattest(at_center, wanted & ~_cells(pixels.edge).any(-1), -(spare // 3))
    block = flat.repeat_interleave(2, 0).repeat_interleave(2, 1)
    wanted[: block.shape[0], : block.shape[1]] &= ~block
    fields = (camera.pixel_centers(stride=2), at_center[..., None] * recede, slope * recede, color)
    uv, depth, slope, color = (torch.cat([field[wanted], _cells(field).mean(2)[flat]]) for field in fields)
    spread = torch.full_like(depth[:, 0], BACKING_SPREAD_PX)
    spread[int(wanted.sum()) :] *= 2
    opacity = torch.full_like(spread, float(OPACITY))
    return surface_gaussians(camera, uv, depth[:, 0], slope, spread, color, opacity), spare + 3 * int(flat.sum())


def _flattest(inverse_depth: Tensor, free: Tensor, count: int) -> Tensor:
    """[h/2, w/2] bool: the 2×2 cells of [h, w] that lie best in one plane, up to a count, where all are free."""
    cells = _cells(inverse_depth)
    chosen = torch.zeros(cells.shape[:2], dtype=torch.bool)
    if count > 0 and cells.numel():
        bend = (cells[..., 0] + cells[..., 3] - cells[..., 1] - cells[..., 2]).abs() / cells.mean(-1)
        rise = (cells.amax(-1) - cells.amin(-1)) / cells.mean(-1)
        fit = (bend < FLAT) & (rise < EDGE) & _cells(free).all(-1)
        cost = torch.where(fit, bend + rise, torch.inf).flatten()
        best = cost.topk(min(count, int(fit.sum())), largest=False).indices
        chosen.view(-1)[best] = True
    return chosen


def _cells(image: Tensor) -> Tensor:
    """[H, W, ...] to [H/2, W/2, 4, ...]: the pixels of each 2×2 cell in row-major order."""
    height, width = (n // 2 for n in image.shape[:2])
    grid = image[: 2 * height, : 2 * width].reshape(height, 2, width, 2, *image.shape[2:])
    return grid.transpose(1, 2).flatten(2, 3)
