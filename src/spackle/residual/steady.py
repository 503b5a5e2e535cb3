"""Depth that a network says anew for each frame of a clip, held to that of the frames before."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from spackle.gaussians import Gaussians
from spackle.residual.motion import STRIDE, Track, pixel_grid, sample

LEAK = 0.95  # of the correction, from frame to frame: flicker goes, what changes slowly stays as the base has it
ROUNDS = 8  # of reweighting
FEWEST = 64  # followed pixels that a fit needs
OFF = 0.02  # of the median inverse depth: a pixel that is off by this much counts half
NO_SHIFT = 0.01  # weight of the wish for no shift, against all pixels: where depths are alike, scale explains all
MAX_SCALE = 2.0  # between two frames
LEAST = 0.25  # a shift takes at most this away from the farthest


@dataclasses.dataclass(frozen=True)
class Stretch:
    """An affine map of inverse depth, seen from the photo's eye: scale · 1/z + shift."""

    scale: float = 1.0
    shift: float = 0.0  # 1/m

    def of(self, inverse_depth: Tensor) -> Tensor:
        """The mapped inverse depth; what is positive stays so."""
        scaled = self.scale * inverse_depth
        return torch.maximum(scaled + self.shift, LEAST * scaled)

    def after(self, first: Stretch) -> Stretch:
        """This map, applied to what the other one gives."""
        return Stretch(self.scale * first.scale, self.scale * first.shift + self.shift)

    def leaked(self) -> Stretch:
        """A little nearer to no map at all."""
        return Stretch(self.scale**LEAK, LEAK * self.shift)

    def of_depth(self, depth: Tensor) -> Tensor:
        """Mapped depth of any shape; what is not in front of the eye only scales."""
        front = depth > 0
        return torch.where(front, 1 / self.of(1 / depth.where(front, 1.0)), depth / self.scale)

    def of_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of a camera at the world's origin, moved along its rays: it sees them as before."""
        if self == Stretch():
            return gaussians
        z = gaussians.means[:, 2]
        factor = torch.where(z == 0, 1.0, self.of_depth(z) / z.where(z != 0, 1.0))[:, None]
        return dataclasses.replace(gaussians, means=gaussians.means * factor, scales=gaussians.scales * factor)


def align(inverse_depth: Tensor, earlier: Tensor, found: Track) -> Stretch:
    """What brings the inverse depth of a frame to that of the one before, where it shows the same.

    Robust least squares: what moves by itself, and where the two disagree in shape, is outvoted.

    Args:
        inverse_depth: [H, W], 0 where unknown.
        earlier: [H, W], of the frame before.
        found: where the frame's pixels were in that one.
    """
    was = sample(earlier[..., None], pixel_grid(earlier) + found.flow)[..., 0]
    chosen = found.sure & (inverse_depth > 0) & (was > 0)
    thin = torch.zeros_like(chosen)
    thin[::STRIDE, ::STRIDE] = True
    if int((chosen & thin).sum()) >= FEWEST:
        chosen = chosen & thin
    now, then = inverse_depth[chosen].double(), was[chosen].double()
    if len(now) < FEWEST:
        return Stretch()
    unit = float(then.median())
    scale, shift = float((then / now).median()), 0.0
    for _ in range(ROUNDS):
        weights = 1 / (1 + ((scale * now + shift - then) / (OFF * unit)) ** 2)
        mass, x, y = weights.sum(), (weights * now).sum(), (weights * then).sum()
        normal = torch.stack([torch.stack([(weights * now * now).sum(), x]), torch.stack([x, mass * (1 + NO_SHIFT)])])
        scale, shift = torch.linalg.solve(normal, torch.stack([(weights * now * then).sum(), y])).tolist()
    if not (math.isfinite(scale) and math.isfinite(shift) and 1 / MAX_SCALE <= scale <= MAX_SCALE):
        return Stretch()
    return Stretch(scale, shift)
