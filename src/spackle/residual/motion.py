"""How a picture came about from the one before it: flow where it can be seen, and a guess of it in the holes."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from spackle.camera import Camera
from spackle.fill import far_fill

# Of two sRGB pictures [H, W, 3]: how far from each pixel of the first its content lies in the second, [H, W, 2].
Flow = Callable[[Tensor, Tensor], Tensor]

RETURN_PX, RETURN_SHARE = 1.0, 0.05  # there and back again must end this near, plus this share of the way
ALIKE = 0.1  # mean difference of sRGB between what is taken for the same thing
SAME_SHOT = 0.3  # share of a picture that must be found again in the one before, or this is another shot
STRIDE = 4  # every fourth pixel each way is enough for six numbers
ROUNDS = 8  # of reweighting
FIT_PX = 0.5  # how far a pixel may be off the camera's motion and count half


@dataclasses.dataclass(frozen=True)
class Track:
    """Where a picture's content was in the one before."""

    flow: Tensor  # [H, W, 2] pixels (x, y), from this picture's pixels to the earlier one's
    sure: Tensor  # [H, W] bool: found there, and found here again from there

    def same_shot(self, where: Tensor | None = None) -> bool:
        """Whether enough of the picture, or of its pixels `where` [H, W] bool, was there before."""
        sure = self.sure if where is None else self.sure[where]
        return sure.numel() > 0 and float(sure.float().mean()) >= SAME_SHOT


def track(picture: Tensor, earlier: Tensor, flow: Flow) -> Track:
    """Follow a picture [H, W, 3] back into an earlier one of its size."""
    back, forth = flow(picture, earlier), flow(earlier, picture)
    target = pixel_grid(back) + back
    gap = (back + sample(forth, target)).norm(dim=-1)
    sure = gap < RETURN_PX + RETURN_SHARE * back.norm(dim=-1)
    sure &= (sample(earlier, target) - picture).abs().mean(-1) < ALIKE
    return Track(back, sure & inside(target, *picture.shape[:2]))


def pixel_grid(image: Tensor) -> Tensor:
    """Centres of the pixels of an image [H, W, ...]: [H, W, 2] as (x, y)."""
    rows, columns = (torch.arange(n, device=image.device) + 0.5 for n in image.shape[:2])
    return torch.stack(torch.meshgrid(columns, rows, indexing="xy"), dim=-1)


def inside(uv: Tensor, height: int, width: int) -> Tensor:
    """[...] bool: which pixel positions [..., 2] lie between the outermost pixels' centres."""
    return ((uv >= 0.5) & (uv <= uv.new_tensor([width, height]) - 0.5)).all(-1)


def sample(image: Tensor, uv: Tensor) -> Tensor:
    """Bilinear values [h, w, C] of an image [H, W, C] at pixel positions [h, w, 2]; the border goes on outside."""
    grid = 2 * uv / uv.new_tensor([image.shape[1], image.shape[0]]) - 1
    found = grid_sample(image.permute(2, 0, 1)[None], grid[None], align_corners=False, padding_mode="border")
    return found[0].permute(1, 2, 0)


def extend(found: Track, inverse_depth: Tensor, known: Tensor, camera: Camera) -> Tensor:
    """The flow with a guess of it where nothing was seen: as the camera moved, and as the far rim differs from that.

    Args:
        found: what could be followed.
        inverse_depth: [H, W] positive everywhere, in the holes that of what is to stand there.
        known: [H, W] bool, where the flow is one of the scene's content.
        camera: whose picture it is.

    Returns:
        [H, W, 2]; as found wherever it is known and sure.
    """
    trusted = known & found.sure
    if not bool(trusted.any()):
        return torch.zeros_like(found.flow)
    basis = _motions(inverse_depth, camera)
    rigid = basis @ _fit(basis, found.flow, trusted)
    rest = (found.flow - rigid).permute(2, 0, 1)
    _, filled = far_fill(inverse_depth, rest, trusted)
    return rigid + filled.permute(1, 2, 0)


def _motions(inverse_depth: Tensor, camera: Camera) -> Tensor:
    """The flow of each of the camera's six small motions, [H, W, 2, 6]: translation first (Longuet-Higgins, 1980)."""
    fx, fy = camera.focal
    center = camera.K[:2, 2].to(inverse_depth)
    x, y = ((pixel_grid(inverse_depth) - center) / inverse_depth.new_tensor([fx, fy])).unbind(-1)
    near, zero = inverse_depth, torch.zeros_like(x)
    across = [near, zero, -near * x, x * y, -(1 + x * x), y]
    down = [zero, near, -near * y, 1 + y * y, -x * y, -x]
    return torch.stack([fx * torch.stack(across, -1), fy * torch.stack(down, -1)], dim=-2)


def _fit(basis: Tensor, flow: Tensor, trusted: Tensor) -> Tensor:
    """The six numbers of the motion that most of the picture follows; what moves by itself is outvoted."""
    chosen = torch.zeros_like(trusted)
    chosen[::STRIDE, ::STRIDE] = True
    chosen &= trusted
    if int(chosen.sum()) < 6:
        chosen = trusted
    rows, wanted = basis[chosen].double(), flow[chosen].double()
    size = rows.flatten(0, 1).norm(dim=0).clamp_min(1e-12)  # so that one small ridge suits all columns
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
