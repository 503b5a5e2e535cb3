"""Avoid flicker in clips: align depth between frames, and propagate colours along the optical flow.

The paper completes single views. In a clip, the aux Gaussians of a frame take colours from the previous frame; colours
seen in an earlier frame weigh more than completed colours. All blending is in linear light.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.hole_filling import fill_from_far_side
from spackle.render import Renderer, touched_tiles
from spackle.render.protocol import Rendering
from spackle.residual.features import CELL, hole_mask

# Maps two sRGB images [H, W, 3] to the offset [H, W, 2] from each pixel of the first image to its place in the second.
Flow = Callable[[Tensor, Tensor], Tensor]

RETURN_PX, RETURN_SHARE = (
    1.0,
    0.05,
)  # forward and backward flow may differ by so many pixels, plus this part of a flow
ALIKE = 0.1  # largest mean sRGB difference between two pixels that show the same content
SAME_SHOT = 0.3  # least fraction of a frame whose content the previous frame shows, unless a new shot begins
THINNING = 4  # a fit of six numbers uses every fourth pixel along each axis
ROUNDS = 8  # rounds of reweighting
FIT_PX = 0.5  # a pixel whose flow differs this much from the camera's motion has half weight

KEEP = 0.98  # factor on the trust in a colour per frame: a seen colour lasts over fifty frames
GUESS = 0.9  # trust in a completed colour; the trust in a seen colour is 1
NEARER = 0.1  # a pixel of the previous frame nearer by this relative difference belongs to another surface
CARRIED = 0.5  # a pixel in which the previous frame has more weight counts as propagated
THIN = 0.05  # lower bound of a share of a pixel's light, for safe division
FAINT = 0.25  # an aux contribution with a smaller share of a pixel is not remembered
MAX_GAIN = 2.0  # largest change of exposure between two frames

LEAK = 0.95  # part of the depth correction that is kept per frame, so that errors do not add up
FEWEST = 64  # least number of tracked pixels for a fit
OFF = 0.02  # a pixel with this error, as part of the median inverse depth, has half weight
NO_SHIFT = 0.01  # weight of a penalty on the shift: if all depths are alike, only the scale changes
MAX_SCALE = 2.0  # largest scale between two frames
LEAST = 0.25  # a shift leaves at least this fraction of an inverse depth


@dataclasses.dataclass(frozen=True)
class Track:
    """The flow from a frame to an earlier frame."""

    flow: Tensor  # [H, W, 2] pixels (x, y)
    sure: Tensor  # [H, W] bool: forward and backward flow agree, and so do the colours

    def same_shot(self, where: Tensor | None = None) -> bool:
        """Whether the earlier frame shows enough of this frame, or of the pixels `where` [H, W] bool."""
        sure = self.sure if where is None else self.sure[where]
        return sure.numel() > 0 and float(sure.float().mean()) >= SAME_SHOT


def track(picture: Tensor, earlier: Tensor, flow: Flow) -> Track:
    """Find the flow from a frame [H, W, 3] to an earlier frame of the same size."""
    back, forth = flow(picture, earlier), flow(earlier, picture)
    target = pixel_grid(back) + back
    gap = (back + sample(forth, target)).norm(dim=-1)
    sure = gap < RETURN_PX + RETURN_SHARE * back.norm(dim=-1)
    sure &= (sample(earlier, target) - picture).abs().mean(-1) < ALIKE
    return Track(back, sure & inside(target, *picture.shape[:2]))


def pixel_grid(image: Tensor) -> Tensor:
    """Pixel centres [H, W, 2] of an image [H, W, ...], as (x, y)."""
    rows, columns = (torch.arange(n, device=image.device) + 0.5 for n in image.shape[:2])
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)


def inside(uv: Tensor, height: int, width: int) -> Tensor:
    """[...] bool: whether a position [..., 2], in pixels, lies between the centres of the outermost pixels."""
    return ((uv >= 0.5) & (uv <= uv.new_tensor([width, height]) - 0.5)).all(-1)


def sample(image: Tensor, uv: Tensor) -> Tensor:
    """Sample an image [H, W, C] bilinearly at pixel positions [h, w, 2], with edge padding: [h, w, C]."""
    grid = 2 * uv / uv.new_tensor([image.shape[1], image.shape[0]]) - 1
    found = grid_sample(
        image.permute(2, 0, 1)[None], grid[None], align_corners=False, padding_mode="border"
    )
    return found[0].permute(1, 2, 0)


def extend_flow(found: Track, inverse_depth: Tensor, known: Tensor, camera: Camera) -> Tensor:
    """Extend the flow into holes: the camera's motion, plus the deviation from that motion at a hole's far rim.

    Args:
        found: the flow; where it is reliable and `known` is true, it is kept.
        inverse_depth: [H, W], positive; in holes the depth of the filling.
        known: [H, W] bool: pixels outside of holes.
        camera: of the frame.
    """
    trusted = known & found.sure
    if not bool(trusted.any()):
        return torch.zeros_like(found.flow)
    basis = _motions(inverse_depth, camera)
    rigid = basis @ _fit(basis, found.flow, trusted)
    rest = (found.flow - rigid).permute(2, 0, 1)
    _, filled = fill_from_far_side(inverse_depth, rest, trusted)
    return rigid + filled.permute(1, 2, 0)


def _motions(inverse_depth: Tensor, camera: Camera) -> Tensor:
    """The flow [H, W, 2, 6] of six small camera motions, translations before rotations (Longuet-Higgins, 1980)."""
    fx, fy = camera.focal
    center = camera.K[:2, 2].to(inverse_depth)
    x, y = ((pixel_grid(inverse_depth) - center) / inverse_depth.new_tensor([fx, fy])).unbind(-1)
    near, zero = inverse_depth, torch.zeros_like(x)
    across = [near, zero, -near * x, x * y, -(1 + x * x), y]
    down = [zero, near, -near * y, 1 + y * y, -x * y, -x]
    return torch.stack([fx * torch.stack(across, -1), fy * torch.stack(down, -1)], dim=-2)


def _thinned(chosen: Tensor, fewest: int) -> Tensor:
    thin = torch.zeros_like(chosen)
    thin[::THINNING, ::THINNING] = chosen[::THINNING, ::THINNING]
    return thin if int(thin.sum()) >= fewest else chosen


def _fit(basis: Tensor, flow: Tensor, trusted: Tensor) -> Tensor:
    """The six numbers of the camera motion, by robust least squares; moving objects have little weight."""
    chosen = _thinned(trusted, 6)
    rows, wanted = basis[chosen].double(), flow[chosen].double()
    size = rows.flatten(0, 1).norm(dim=0).clamp_min(1e-12)  # one ridge suits all normalised columns
    rows = rows / size
    weights = rows.new_ones(len(rows))
    motion = rows.new_zeros(6)
    for _ in range(ROUNDS):
        weighted = rows * weights[:, None, None]
        normal = torch.einsum("nci,ncj->ij", weighted, rows) + 1e-9 * torch.eye(6).to(rows)
        motion = torch.linalg.solve(normal, torch.einsum("nci,nc->i", weighted, wanted))
        off = (rows @ motion - wanted).norm(dim=-1)
        scale = max(FIT_PX, 1.5 * float(off.median()))
        weights = 1 / (1 + (off / scale) ** 2)
    found: Tensor = motion / size
    return found.to(flow.dtype)


@dataclasses.dataclass(frozen=True)
class FrameMemory:
    """The state of a completed view that the next frame needs."""

    view: Rendering  # completed
    light: (
        Tensor  # [H, W, 3] linear light of the view; in holes the light of the aux Gaussians alone
    )
    inverse_depth: Tensor  # [H, W] of the same surfaces, positive
    trust: Tensor  # [H, W] in 0..1: 1 if the base shows the pixel, about KEEP^n if a base showed it n frames ago


def propagate_colors(
    base: Gaussians,
    aux: Gaussians,
    camera: Camera,
    renderer: Renderer,
    views: tuple[Rendering, Rendering],
    past: FrameMemory | None,
    flow: Flow,
) -> tuple[Gaussians, FrameMemory]:
    """Give the aux Gaussians of a frame colours of the previous view; returns recoloured Gaussians and the memory.

    Args:
        base: the base Gaussians of the frame.
        aux: the aux Gaussians of the view, made without earlier frames.
        camera: the view.
        renderer: renders the view again.
        views: renderings of the base alone, and with `aux`.
        past: memory of the previous view; None at the start. A view of another shot is ignored, see `Track.same_shot`.
        flow: finds the optical flow between two images.
    """
    before, own = views
    hole = hole_mask(before.alpha)
    made_up, inverse_depth = behind(before, own, hole)
    share = torch.where(hole, own.alpha - before.alpha, 1.0).clamp_min(0)
    start = FrameMemory(own, made_up, inverse_depth, _trust(hole, share, torch.zeros_like(share)))
    found = None if past is None or not bool(hole.any()) else track(own.rgb, past.view.rgb, flow)
    if past is None or found is None or not found.same_shot(~hole):
        return aux, start
    motion = extend_flow(found, inverse_depth, ~hole, camera)
    recalled, weight = _recall(past, pixel_grid(motion) + motion, inverse_depth)
    # The change of exposure, measured on surfaces that both frames show.
    same = found.sure & ~hole
    was = sample(past.light, pixel_grid(made_up) + found.flow)[same]
    gain = made_up[same].mean(0) / was.mean(0).clamp_min(1e-4)
    recalled = recalled * torch.nan_to_num(gain, nan=1.0).clamp(1 / MAX_GAIN, MAX_GAIN)
    weight = torch.where(hole, KEEP * weight, 0.0)
    fresh = made_up + _beside(recalled - made_up, hole, weight, inverse_depth)
    blended = (fresh + weight[..., None] * (recalled - fresh)).clamp(0, 1)
    light = torch.where(hole[..., None], blended, made_up)
    # The colour of a faint cell is too noisy to measure a change.
    changed = _recoloured(
        aux, camera, light - made_up, torch.where(hole & (share >= FAINT), share, 0.0)
    )
    view = renderer.render(
        [base, changed], camera, tiles=touched_tiles(aux, camera), previous_rendering=own
    )
    return changed, FrameMemory(view, light, inverse_depth, _trust(hole, share, weight))


def _trust(hole: Tensor, share: Tensor, weight: Tensor) -> Tensor:
    filled = torch.where(share < FAINT, 0.0, weight.clamp_min(GUESS))
    return torch.where(hole, filled, 1.0)


def behind(before: Rendering, own: Rendering, hole: Tensor) -> tuple[Tensor, Tensor]:
    """Linear light [H, W, 3] and inverse depth [H, W] of a view; in holes, only those of the aux Gaussians.

    `before` is the rendering of the base, `own` the rendering of base and aux Gaussians.
    """
    share = (own.alpha - before.alpha).clamp_min(THIN)
    there, now = srgb_to_linear(before.rgb), srgb_to_linear(own.rgb)
    added = ((now - there) / share[..., None]).clamp(0, 1)
    depth = (own.depth * own.alpha - before.depth * before.alpha) / share
    depth = torch.where(hole & (depth > 0), depth, own.depth)
    inverse = torch.where(depth > 0, 1 / depth.clamp_min(1e-6), 0.0)
    smallest = inverse[inverse > 0].min() if bool((inverse > 0).any()) else inverse.new_tensor(1.0)
    return torch.where(hole[..., None], added, now), torch.where(inverse > 0, inverse, smallest)


def _recall(past: FrameMemory, uv: Tensor, inverse_depth: Tensor) -> tuple[Tensor, Tensor]:
    """Light [H, W, 3] and trust [H, W] of the previous view at its pixels uv [H, W, 2], nearer surfaces left out."""
    height, width = past.trust.shape
    corner = (uv - 0.5).floor()
    part = uv - 0.5 - corner
    light, mass, trust = (
        torch.zeros_like(past.light),
        torch.zeros_like(past.trust),
        torch.zeros_like(past.trust),
    )
    for dy in (0, 1):
        for dx in (0, 1):
            column = (corner[..., 0].long() + dx).clamp(0, width - 1)
            row = (corner[..., 1].long() + dy).clamp(0, height - 1)
            share = (part[..., 0] if dx else 1 - part[..., 0]) * (
                part[..., 1] if dy else 1 - part[..., 1]
            )
            nearer = (past.inverse_depth[row, column] / inverse_depth - 1).clamp_min(0)
            share = share * torch.exp(-((nearer / NEARER) ** 2)) * (past.trust[row, column] > 0)
            light += share[..., None] * past.light[row, column]
            trust += share * past.trust[row, column]
            mass += share
    there = inside(uv, height, width)
    return light / mass.clamp_min(1e-6)[..., None], torch.where(there, trust, 0.0)


def _beside(change: Tensor, hole: Tensor, weight: Tensor, inverse_depth: Tensor) -> Tensor:
    """Spread the change [H, W, 3] of propagated pixels over new pixels; it falls to 0 at the hole's rim."""
    carried = weight > CARRIED
    known = ~hole | carried
    values = torch.where(carried[..., None], change, 0.0).permute(2, 0, 1)
    if not bool(carried.any()) or bool(known.all()):
        return torch.zeros_like(change)
    _, spread = fill_from_far_side(inverse_depth, values, known, far_bias=0.0)
    return torch.where(known[..., None], 0.0, spread.permute(1, 2, 0))


def _recoloured(aux: Gaussians, camera: Camera, change: Tensor, share: Tensor) -> Gaussians:
    """Recolour aux Gaussians by the change [H, W, 3], averaged over cells with the weights `share` [H, W]."""
    weighted = torch.cat([change * share[..., None], share[..., None]], dim=-1)
    sums = avg_pool2d(weighted.permute(2, 0, 1)[None], CELL, ceil_mode=True)[0]
    mean = sums[:3] / sums[3:].clamp_min(1e-6)
    uv, _ = camera.project(aux.means)
    column, row = (uv / CELL).floor().long().unbind(-1)
    height, width = mean.shape[1:]
    picked = mean[:, row.clamp(0, height - 1), column.clamp(0, width - 1)].T
    return dataclasses.replace(aux, colors=(aux.colors + picked).clamp(0, 1))


@dataclasses.dataclass(frozen=True)
class DepthAlignment:
    """An affine map of inverse depth in the photo's camera: scale · 1/z + shift."""

    scale: float = 1.0
    shift: float = 0.0  # 1/m

    def of(self, inverse_depth: Tensor) -> Tensor:
        """The mapped inverse depth; positive values stay positive."""
        scaled = self.scale * inverse_depth
        return torch.maximum(scaled + self.shift, LEAST * scaled)

    def after(self, first: DepthAlignment) -> DepthAlignment:
        """The composition that applies `first`, then this map."""
        return DepthAlignment(self.scale * first.scale, self.scale * first.shift + self.shift)

    def leaked(self) -> DepthAlignment:
        """A map a little nearer to the identity."""
        return DepthAlignment(self.scale**LEAK, LEAK * self.shift)

    def of_depth(self, depth: Tensor) -> Tensor:
        """Mapped depths of any shape; depths ≤ 0 are only scaled."""
        front = depth > 0
        return torch.where(front, 1 / self.of(1 / depth.where(front, 1.0)), depth / self.scale)

    def of_gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Move and scale Gaussians along rays from the origin; the image of a camera at the origin does not change."""
        if self == DepthAlignment():
            return gaussians
        z = gaussians.means[:, 2]
        factor = torch.where(z == 0, 1.0, self.of_depth(z) / z.where(z != 0, 1.0))[:, None]
        return dataclasses.replace(
            gaussians, means=gaussians.means * factor, scales=gaussians.scales * factor
        )


def align_depth(inverse_depth: Tensor, earlier: Tensor, found: Track) -> DepthAlignment:
    """Fit the map from a frame's inverse depth [H, W] (0: unknown) to an earlier frame's, by robust least squares."""
    was = sample(earlier[..., None], pixel_grid(earlier) + found.flow)[..., 0]
    chosen = _thinned(found.sure & (inverse_depth > 0) & (was > 0), FEWEST)
    now, then = inverse_depth[chosen].double(), was[chosen].double()
    if len(now) < FEWEST:
        return DepthAlignment()
    unit = float(then.median())
    scale, shift = float((then / now).median()), 0.0
    for _ in range(ROUNDS):
        weights = 1 / (1 + ((scale * now + shift - then) / (OFF * unit)) ** 2)
        mass, x, y = weights.sum(), (weights * now).sum(), (weights * then).sum()
        normal = torch.stack(
            [torch.stack([(weights * now * now).sum(), x]), torch.stack([x, mass * (1 + NO_SHIFT)])]
        )
        scale, shift = torch.linalg.solve(
            normal, torch.stack([(weights * now * then).sum(), y])
        ).tolist()
    if not (math.isfinite(scale) and math.isfinite(shift) and 1 / MAX_SCALE <= scale <= MAX_SCALE):
        return DepthAlignment()
    return DepthAlignment(scale, shift)
