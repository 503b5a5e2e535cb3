"""The five functions of gsplat that Spackle calls, in plain PyTorch: the same arguments, shapes and meaning."""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.render.protocol import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP


def fully_fused_projection(
    means: Tensor, covars: Tensor, quats: None, scales: None, viewmats: Tensor, Ks: Tensor, width: int, height: int,
    *, eps2d: float, near_plane: float, opacities: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:  # fmt: skip
    """Radii [C, N, 2] int, means [C, N, 2], depths [C, N], conics [C, N, 3]; anything where the radii are 0."""
    assert covars.shape == (len(means), 6)
    assert opacities.shape == (len(means),)
    assert quats is scales is None
    full = covars[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    rotation, shift = viewmats[:, None, :3, :3], viewmats[:, None, :3, 3]
    x, y, z = ((rotation @ means[None, :, :, None])[..., 0] + shift).unbind(-1)
    fx, fy, cx, cy = (Ks[:, a, b, None] for a, b in ((0, 0), (1, 1), (0, 2), (1, 2)))
    slack_x, slack_y = 0.15 * width / fx, 0.15 * height / fy
    tx = torch.minimum(torch.maximum(x / z, -cx / fx - slack_x), (width - cx) / fx + slack_x)
    ty = torch.minimum(torch.maximum(y / z, -cy / fy - slack_y), (height - cy) / fy + slack_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).reshape(*z.shape, 2, 3)
    factor = jacobian @ rotation
    flat = factor @ full @ factor.transpose(-1, -2) + eps2d * torch.eye(2)
    det = flat[..., 0, 0] * flat[..., 1, 1] - flat[..., 0, 1] ** 2
    conics = torch.stack([flat[..., 1, 1], -flat[..., 0, 1], flat[..., 0, 0]], -1) / det[..., None]
    reach = (2 * (opacities / ALPHA_MIN).clamp_min(1).log()).sqrt().clamp_max(3.33)[None, :, None]
    radii = (reach * torch.stack([flat[..., 0, 0], flat[..., 1, 1]], -1).sqrt()).ceil()
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    inside = ((means2d + radii > 0) & (means2d - radii < torch.tensor([width, height]))).all(-1)
    seen = inside & (z > near_plane) & (det > 0) & (opacities >= ALPHA_MIN)
    rubbish = torch.where(seen[..., None], means2d, torch.nan)  # as the kernel, which does not write there
    return (radii * seen[..., None]).detach().nan_to_num(0).int(), rubbish, z, conics, None


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, columns: int, rows: int
) -> tuple[None, Tensor, Tensor]:
    """Keys [M] (camera and tile, then depth, here as pairs in one float64) and flat ids [M], sorted."""
    found: list[tuple[int, float, int]] = []
    count = means2d.shape[1]
    for c, n in (radii > 0).all(-1).nonzero().tolist():
        low = ((means2d[c, n] - radii[c, n]) / tile_size).floor().int().tolist()
        high = ((means2d[c, n] + radii[c, n]) / tile_size).ceil().int().tolist()
        for row in range(max(low[1], 0), min(high[1], rows)):
            for column in range(max(low[0], 0), min(high[0], columns)):
                found.append(((c * rows + row) * columns + column, float(depths[c, n]), c * count + n))
    found.sort()
    return None, torch.tensor([f[0] for f in found]).long(), torch.tensor([f[2] for f in found]).int()


def isect_offset_encode(keys: Tensor, images: int, columns: int, rows: int) -> Tensor:
    """[images, rows, columns] where each tile's ids begin."""
    counts = torch.bincount(keys, minlength=images * rows * columns)
    return (counts.cumsum(0) - counts).reshape(images, rows, columns).int()


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int, tile_size: int,
    offsets: Tensor, ids: Tensor, *, masks: Tensor | None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """[C, H, W, D] and [C, H, W, 1]; where the mask is False it holds anything, as the kernel's does."""
    images, rows, columns = offsets.shape
    assert opacities.shape == means2d.shape[:2] == colors.shape[:2]
    ends = torch.cat([offsets.flatten()[1:], torch.tensor([len(ids)])]).reshape(offsets.shape)
    canvases = []
    for c in range(images):
        drawn = []
        for row in range(rows):
            tiles = []
            for column in range(columns):
                mine = ids[offsets[c, row, column] : ends[c, row, column]].long()
                if masks is not None and not masks[c, row, column]:
                    tiles.append(torch.full((tile_size, tile_size, colors.shape[-1] + 1), torch.nan))
                    continue
                y, x = torch.meshgrid(
                    torch.arange(tile_size) + row * tile_size + 0.5,
                    torch.arange(tile_size) + column * tile_size + 0.5,
                    indexing="ij",
                )
                mean, conic = means2d.flatten(0, 1)[mine], conics.flatten(0, 1)[mine][:, :, None, None]
                dx, dy = x - mean[:, 0, None, None], y - mean[:, 1, None, None]
                power = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
                alpha = (opacities.flatten()[mine][:, None, None] * torch.exp(-power)).clamp_max(ALPHA_MAX)
                alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
                after = torch.cumprod(1 - alpha, 0)
                before = torch.cat([torch.ones_like(x)[None], after[:-1]])[: len(after)]
                weight = torch.where(after > TRANSMITTANCE_STOP, alpha * before, 0)
                color = torch.einsum("nhw,nd->hwd", weight, colors.flatten(0, 1)[mine])
                tiles.append(torch.cat([color, weight.sum(0)[..., None]], -1))
            drawn.append(torch.cat(tiles, 1))
        canvases.append(torch.cat(drawn)[:height, :width])
    whole = torch.stack(canvases)
    return whole[..., :-1], whole[..., -1:]
