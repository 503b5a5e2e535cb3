"""Align the depth of a frame with that of the previous frame, so that depth does not flicker."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from spackle.clips.flow import FIT_ROUNDS, Track, pixel_grid, sample, thinned
from spackle.core.gaussians import Gaussians

# Part of the correction that is kept from frame to frame, so that errors do not add up.
KEPT_CORRECTION = 0.95
MIN_TRACKED_PIXELS = 64  # for a fit
# A pixel with this error, as part of the median inverse depth, has half weight.
HALF_WEIGHT_RATIO = 0.02
# Weight of a penalty on the shift: if all depths are alike, only the scale changes.
SHIFT_PENALTY = 0.01
MAX_SCALE = 2.0  # largest scale between two frames
MIN_KEPT_RATIO = 0.25  # a shift leaves at least this fraction of an inverse depth


@dataclasses.dataclass(frozen=True)
class DepthAlignment:
    """An affine map of inverse depth in the photo's camera: scale · 1/z + shift."""

    scale: float = 1.0
    shift: float = 0.0  # 1/m

    def of(self, inverse_depth: Tensor) -> Tensor:
        """The mapped inverse depth, of any shape; positive values stay positive."""
        scaled = self.scale * inverse_depth
        return torch.maximum(scaled + self.shift, MIN_KEPT_RATIO * scaled)

    def after(self, first: DepthAlignment) -> DepthAlignment:
        """The composition that applies `first`, then this map."""
        return DepthAlignment(
            scale=self.scale * first.scale, shift=self.scale * first.shift + self.shift
        )

    def closer_to_identity(self) -> DepthAlignment:
        """A map that changes depths a little less than this one."""
        return DepthAlignment(scale=self.scale**KEPT_CORRECTION, shift=KEPT_CORRECTION * self.shift)

    def of_depth(self, depth: Tensor) -> Tensor:
        """Mapped depths of any shape; depths ≤ 0, which have no inverse, are only scaled."""
        in_front = depth > 0
        safe_depth = depth.where(in_front, 1.0)
        return torch.where(in_front, 1 / self.of(1 / safe_depth), depth / self.scale)

    def of_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Move and scale Gaussians along rays from the origin to their mapped depths.

        The image of a camera at the origin does not change.
        """
        if self == DepthAlignment():
            return gaussians
        z = gaussians.means[:, 2]
        safe_z = z.where(z != 0, 1.0)
        factor = torch.where(z == 0, 1.0, self.of_depth(z) / safe_z)[:, None]  # [N, 1]
        return dataclasses.replace(
            gaussians, means=gaussians.means * factor, scales=gaussians.scales * factor
        )


def align_depth(inverse_depth: Tensor, earlier: Tensor, tracked: Track) -> DepthAlignment:
    """Fit the map from a frame's inverse depth to an earlier frame's, by robust least squares.

    The map is scale · inverse depth + shift.

    Args:
        inverse_depth: [H, W] of the frame, 0 if unknown.
        earlier: [H, W] of the earlier frame, 0 if unknown.
        tracked: the flow from the frame to the earlier one.

    Returns:
        The identity, if too few pixels were tracked, or if the fit makes no sense.
    """
    sampled = sample(earlier[..., None], pixel_grid(earlier) + tracked.flow)[..., 0]  # [H, W]
    comparable = tracked.reliable & (inverse_depth > 0) & (sampled > 0)
    fitted = thinned(comparable, MIN_TRACKED_PIXELS)
    now = inverse_depth[fitted].double()  # [n]
    then = sampled[fitted].double()
    if len(now) < MIN_TRACKED_PIXELS:
        return DepthAlignment()

    half_weight_error = HALF_WEIGHT_RATIO * float(then.median())
    scale = float((then / now).median())
    shift = 0.0
    for _ in range(FIT_ROUNDS):
        # Pixels that the last fit does not explain, such as moving objects, have little weight.
        error = scale * now + shift - then
        weights = 1 / (1 + (error / half_weight_error) ** 2)
        # The normal equations of scale and shift. The penalty keeps the shift small where depths
        # are so similar that they do not tell it from a scale.
        weight_sum = weights.sum()
        now_sum = (weights * now).sum()
        then_sum = (weights * then).sum()
        normal = torch.stack(
            [
                torch.stack([(weights * now * now).sum(), now_sum]),
                torch.stack([now_sum, weight_sum * (1 + SHIFT_PENALTY)]),
            ]
        )
        right_side = torch.stack([(weights * now * then).sum(), then_sum])
        scale, shift = torch.linalg.solve(normal, right_side).tolist()

    if not (math.isfinite(scale) and math.isfinite(shift)):
        return DepthAlignment()
    if not 1 / MAX_SCALE <= scale <= MAX_SCALE:
        return DepthAlignment()
    return DepthAlignment(scale, shift)
