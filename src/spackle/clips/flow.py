"""Follow the content of a clip from one frame to an earlier one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from spackle.core.camera import Camera
from spackle.core.hole_filling import fill_from_far_side

# Maps two sRGB images [H, W, 3] to the offset [H, W, 2], in pixels (x, y), from each pixel of the
# first image to its place in the second.
Flow = Callable[[Tensor, Tensor], Tensor]

# Forward and backward flow may differ by so many pixels, plus this part of the flow.
RETURN_TOLERANCE_PX = 1.0
RETURN_TOLERANCE_RATIO = 0.05
MAX_COLOR_DIFFERENCE = 0.1  # mean over sRGB channels, between pixels that show the same content
# Least fraction of a frame whose content the previous frame shows, unless a new shot begins.
MIN_SAME_SHOT_RATIO = 0.3

THINNING_STEP = 4  # a fit of few numbers uses every fourth pixel along each axis
MIN_MOTION_PIXELS = 6  # for a fit of the camera's motion, which has six numbers
FIT_ROUNDS = 8  # rounds of reweighting
# A pixel whose flow differs this much from the camera's motion has half weight; if most pixels
# differ more, so does this factor times their median.
HALF_WEIGHT_PX = 0.5
HALF_WEIGHT_MEDIANS = 1.5
MOTION_RIDGE = 1e-9  # added to the normalised equations, for motions that the depth cannot tell


@dataclasses.dataclass(frozen=True)
class Track:
    """The flow from a frame to an earlier frame."""

    flow: Tensor  # [H, W, 2] pixels (x, y)
    reliable: Tensor  # [H, W] bool: forward and backward flow agree, and so do the colours

    def same_shot(self, where: Tensor | None = None) -> bool:
        """Whether the earlier frame shows at least 30 % of this frame's content.

        With `where` [H, W] bool, only these pixels count; False if there are none.
        """
        reliable = self.reliable if where is None else self.reliable[where]
        if reliable.numel() == 0:
            return False
        return float(reliable.float().mean()) >= MIN_SAME_SHOT_RATIO


def track(picture: Tensor, earlier: Tensor, flow: Flow) -> Track:
    """Find the flow from a frame to an earlier frame, both [H, W, 3] sRGB of the same size."""
    back = flow(picture, earlier)
    forth = flow(earlier, picture)
    target = pixel_grid(back) + back  # [H, W, 2] positions in the earlier frame

    # A pixel that goes there and back must return to where it started, and look the same there.
    return_error = (back + sample(forth, target)).norm(dim=-1)
    reliable = return_error < RETURN_TOLERANCE_PX + RETURN_TOLERANCE_RATIO * back.norm(dim=-1)
    color_difference = (sample(earlier, target) - picture).abs().mean(-1)
    reliable &= color_difference < MAX_COLOR_DIFFERENCE
    height, width = picture.shape[:2]
    return Track(back, reliable & inside(target, height, width))


def pixel_grid(image: Tensor) -> Tensor:
    """Pixel centres [H, W, 2] of an image [H, W, ...], as (x, y)."""
    height, width = image.shape[:2]
    y = torch.arange(height, device=image.device) + 0.5
    x = torch.arange(width, device=image.device) + 0.5
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)


def inside(uv: Tensor, height: int, width: int) -> Tensor:
    """[...] bool: whether a position lies between the centres of an image's outermost pixels.

    Positions `uv` [..., 2] are (x, y) in pixels, with pixel centres at half-integers.
    """
    last = uv.new_tensor([width, height]) - 0.5
    return ((uv >= 0.5) & (uv <= last)).all(-1)


def sample(image: Tensor, uv: Tensor) -> Tensor:
    """Sample an image [H, W, C] bilinearly at pixel positions uv [h, w, 2]: [h, w, C].

    Beyond the outermost pixels' centres, the border is repeated.
    """
    # `grid_sample` wants positions in -1..1.
    grid = 2 * uv / uv.new_tensor([image.shape[1], image.shape[0]]) - 1
    sampled = grid_sample(
        image.permute(2, 0, 1)[None], grid[None], align_corners=False, padding_mode="border"
    )  # [1, C, h, w]
    return sampled[0].permute(1, 2, 0)


def extend_flow(tracked: Track, inverse_depth: Tensor, known: Tensor, camera: Camera) -> Tensor:
    """Extend the flow into holes: [H, W, 2] pixels (x, y) at every pixel.

    A hole is what the frame does not show of this view. Its flow is the camera's motion, plus the
    deviation from that motion at the hole's far rim, because a hole uncovers the surface behind.

    Args:
        tracked: the flow; where it is reliable and `known` is true, it is kept.
        inverse_depth: [H, W], positive; in holes the depth of the filling.
        known: [H, W] bool: pixels outside of holes.
        camera: of the frame.
    """
    trusted = known & tracked.reliable
    if not bool(trusted.any()):
        return torch.zeros_like(tracked.flow)
    basis = camera_motion_basis(inverse_depth, camera)
    camera_flow = basis @ fit_camera_motion(basis, tracked.flow, trusted)
    deviation = (tracked.flow - camera_flow).permute(2, 0, 1)  # [2, H, W]
    _, filled_deviation = fill_from_far_side(inverse_depth, deviation, trusted)
    return camera_flow + filled_deviation.permute(1, 2, 0)


def camera_motion_basis(inverse_depth: Tensor, camera: Camera) -> Tensor:
    """How far each pixel moves, in pixels (x, y), by one unit of each of six camera motions.

    The motions are small translations along x, y and z, then small rotations about x, y and z. With
    the slopes (x, y) of a pixel's ray and the inverse depth d, the ray's slopes change by (d, 0),
    (0, d), (-d·x, -d·y), (x·y, 1 + y²), (-1 - x², -x·y) and (y, -x) (Longuet-Higgins, 1980).

    `inverse_depth` is [H, W]; the result is [H, W, 2, 6].
    """
    fx, fy = camera.focal
    center = camera.K[:2, 2].to(inverse_depth)
    focal = inverse_depth.new_tensor([fx, fy])
    # The slopes X/Z and Y/Z of the pixels' rays, [H, W] each.
    x, y = ((pixel_grid(inverse_depth) - center) / focal).unbind(-1)
    zero = torch.zeros_like(x)
    flow_x = [inverse_depth, zero, -inverse_depth * x, x * y, -(1 + x * x), y]
    flow_y = [zero, inverse_depth, -inverse_depth * y, 1 + y * y, -x * y, -x]
    return torch.stack([fx * torch.stack(flow_x, -1), fy * torch.stack(flow_y, -1)], dim=-2)


def fit_camera_motion(basis: Tensor, flow: Tensor, trusted: Tensor) -> Tensor:
    """The six numbers of the camera motion that explains the flow, by robust least squares.

    Moving objects deviate from the motion of most pixels, and so have little weight.

    Args:
        basis: [H, W, 2, 6] the flow of six motions.
        flow: [H, W, 2] pixels (x, y).
        trusted: [H, W] bool: the pixels that count.
    """
    fitted = thinned(trusted, MIN_MOTION_PIXELS)
    equations = basis[fitted].double()  # [n, 2, 6]
    target = flow[fitted].double()  # [n, 2]
    # Translations and rotations have other units and sizes. All columns are scaled to length 1, so
    # that one ridge (a small number on the diagonal, for a stable solution) suits all of them.
    column_lengths = equations.flatten(0, 1).norm(dim=0).clamp_min(1e-12)
    equations = equations / column_lengths

    weights = equations.new_ones(len(equations))
    motion = equations.new_zeros(6)
    for _ in range(FIT_ROUNDS):
        weighted = equations * weights[:, None, None]
        normal = torch.einsum("nci,ncj->ij", weighted, equations)
        normal = normal + MOTION_RIDGE * torch.eye(6).to(equations)
        motion = torch.linalg.solve(normal, torch.einsum("nci,nc->i", weighted, target))
        # Pixels that move otherwise than this solution says have less weight in the next round.
        error_px = (equations @ motion - target).norm(dim=-1)
        half_weight_px = max(HALF_WEIGHT_PX, HALF_WEIGHT_MEDIANS * float(error_px.median()))
        weights = 1 / (1 + (error_px / half_weight_px) ** 2)
    unscaled: Tensor = motion / column_lengths
    return unscaled.to(flow.dtype)


def thinned(mask: Tensor, min_count: int) -> Tensor:
    """Every fourth pixel of a mask [H, W] bool along each axis, which makes a fit faster.

    The whole mask, if fewer than `min_count` pixels would remain.
    """
    thin = torch.zeros_like(mask)
    thin[::THINNING_STEP, ::THINNING_STEP] = mask[::THINNING_STEP, ::THINNING_STEP]
    if int(thin.sum()) < min_count:
        return mask
    return thin
