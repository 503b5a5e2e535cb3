"""The four functions of gsplat 1.5.3 that Spackle calls, in PyTorch; they refuse all inputs that
gsplat cannot take.
"""

from __future__ import annotations

import torch
from torch import Tensor

from spackle.render.protocol import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_STOP

__version__ = "1.5.3"


def fully_fused_projection(
    means: Tensor,
    covars: Tensor | None,
    quats: Tensor | None,
    scales: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    eps2d: float = 0.3,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    *,
    opacities: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, None]:
    """Radii [C, N, 2] int, means [C, N, 2], depths [C, N], conics [C, N, 3]; radii are 0 for
    invisible Gaussians.
    """
    assert quats is scales is None
    assert covars is not None
    assert opacities is not None
    n, c = len(means), len(viewmats)
    assert n > 0, "divides by the number of Gaussians: a signal ends the process"
    check(
        means, (n, 3), covars=(covars, (n, 6)), viewmats=(viewmats, (c, 4, 4)), Ks=(Ks, (c, 3, 3))
    )
    check(means, (n, 3), opacities=(opacities, (n,)))
    xx, xy, xz, yy, yz, zz = covars.unbind(-1)
    full = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(-1, 3, 3)
    rotation, shift = viewmats[:, None, :3, :3], viewmats[:, None, :3, 3]
    x, y, z = ((rotation @ means[None, :, :, None])[..., 0] + shift).unbind(-1)
    fx, fy, cx, cy = (Ks[:, a, b, None] for a, b in ((0, 0), (1, 1), (0, 2), (1, 2)))
    slack_x, slack_y = 0.15 * width / fx, 0.15 * height / fy
    tx = torch.minimum(torch.maximum(x / z, -cx / fx - slack_x), (width - cx) / fx + slack_x)
    ty = torch.minimum(torch.maximum(y / z, -cy / fy - slack_y), (height - cy) / fy + slack_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).reshape(
        *z.shape, 2, 3
    )
    factor = jacobian @ rotation
    flat = factor @ full @ factor.transpose(-1, -2)
    a, b, d = flat[..., 0, 0] + eps2d, flat[..., 0, 1], flat[..., 1, 1] + eps2d
    det = a * d - b * b
    conics = torch.stack([d, -b, a], -1) / det[..., None]
    reach = (2 * (opacities / ALPHA_MIN).clamp_min(1).log()).sqrt().clamp_max(3.33)[None, :, None]
    radii = (reach * torch.stack([a, d], -1).sqrt()).ceil()
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    low, high = means2d - radii, means2d + radii
    inside = (high > 0).all(-1) & (low[..., 0] < width) & (low[..., 1] < height)
    seen = inside & (z >= near_plane) & (z <= far_plane) & (det > 0) & (opacities >= ALPHA_MIN)
    # the kernel does not write these elements
    rubbish = torch.where(seen[..., None], means2d, torch.nan)
    return (radii * seen[..., None]).detach().nan_to_num(0).int(), rubbish, z, conics, None


def isect_tiles(
    means2d: Tensor,
    radii: Tensor,
    depths: Tensor,
    tile_size: int,
    tile_width: int,
    tile_height: int,
    *,
    packed: bool = False,
    n_images: int | None = None,
    image_ids: Tensor | None = None,
    gaussian_ids: Tensor | None = None,
) -> tuple[None, Tensor, Tensor]:
    """Keys [M] (image and tile) and ids [M] of packed Gaussians, sorted by key and depth."""
    assert packed
    assert n_images is not None
    assert image_ids is not None
    assert gaussian_ids is not None
    n = len(means2d)
    check(means2d, (n, 2), depths=(depths, (n,)))
    check(means2d, (n, 2), radii=(radii, (n, 2)), dtype=torch.int32)
    check(
        means2d,
        (n, 2),
        image_ids=(image_ids, (n,)),
        gaussian_ids=(gaussian_ids, (n,)),
        dtype=torch.int64,
    )
    found: list[tuple[int, float, int]] = []
    place = means2d.device
    numbers = torch.cat([means2d, radii, depths[:, None], image_ids[:, None]], 1).cpu().tolist()
    for k, (u, v, right, down, depth, image) in enumerate(numbers):
        if right <= 0 or down <= 0:
            continue
        tiles = [edge / tile_size for edge in (v - down, v + down, u - right, u + right)]
        for row in range(max(int(tiles[0] // 1), 0), min(-int(-tiles[1] // 1), tile_height)):
            for column in range(max(int(tiles[2] // 1), 0), min(-int(-tiles[3] // 1), tile_width)):
                found.append(((int(image) * tile_height + row) * tile_width + column, depth, k))
    found.sort()
    keys, ids = (
        torch.tensor([f[0] for f in found]).long(),
        torch.tensor([f[2] for f in found]).int(),
    )
    return None, keys.to(place), ids.to(place)


def isect_offset_encode(
    isect_ids: Tensor, n_images: int, tile_width: int, tile_height: int
) -> Tensor:
    """The index [n_images, rows, columns] of each tile's first id."""
    check(isect_ids, isect_ids.shape, dtype=torch.int64)
    counts = torch.bincount(isect_ids, minlength=n_images * tile_height * tile_width)
    return (counts.cumsum(0) - counts).reshape(n_images, tile_height, tile_width).int()


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    *,
    masks: Tensor | None = None,
    packed: bool = False,
) -> tuple[Tensor, Tensor]:
    """Colours [I, H, W, D] and alphas [I, H, W, 1]; NaN in tiles that are not in the mask."""
    assert packed
    n, (images, rows, columns) = len(means2d), isect_offsets.shape
    assert colors.shape[1] in (1, 2, 3, 4, 5, 8), "kernels are built for these numbers of channels"
    check(
        means2d,
        (n, 2),
        conics=(conics, (n, 3)),
        colors=(colors, (n, colors.shape[1])),
        opacities=(opacities, (n,)),
    )
    check(means2d, (n, 2), isect_offsets=(isect_offsets, isect_offsets.shape), dtype=torch.int32)
    check(means2d, (n, 2), flatten_ids=(flatten_ids, flatten_ids.shape), dtype=torch.int32)
    if masks is not None:
        check(means2d, (n, 2), masks=(masks, isect_offsets.shape), dtype=torch.bool)
    assert rows * tile_size >= image_height
    assert columns * tile_size >= image_width
    starts = [*isect_offsets.flatten().cpu().tolist(), len(flatten_ids)]
    wanted = [True] * (len(starts) - 1) if masks is None else masks.flatten().cpu().tolist()
    y, x = (
        steps.to(means2d.device)
        for steps in torch.meshgrid(*[torch.arange(tile_size) + 0.5] * 2, indexing="ij")
    )
    tiles = []
    for tile in range(images * rows * columns):
        if not wanted[tile]:
            tiles.append(means2d.new_full((tile_size, tile_size, colors.shape[-1] + 1), torch.nan))
            continue
        mine = flatten_ids[starts[tile] : starts[tile + 1]].long()
        mean, conic = means2d[mine], conics[mine][:, :, None, None]
        dx = x + tile % columns * tile_size - mean[:, 0, None, None]
        dy = y + tile // columns % rows * tile_size - mean[:, 1, None, None]
        power = 0.5 * (conic[:, 0] * dx * dx + conic[:, 2] * dy * dy) + conic[:, 1] * dx * dy
        alpha = (opacities[mine][:, None, None] * torch.exp(-power)).clamp_max(ALPHA_MAX)
        alpha = torch.where((alpha >= ALPHA_MIN) & (power >= 0), alpha, 0)
        after = torch.cumprod(1 - alpha, 0)
        before = torch.cat([torch.ones_like(x)[None], after[:-1]])[: len(after)]
        weight = torch.where(after > TRANSMITTANCE_STOP, alpha * before, 0)
        color = (weight[..., None] * colors[mine][:, None, None, :]).sum(0)
        tiles.append(torch.cat([color, weight.sum(0)[..., None]], -1))
    grid = (
        torch.stack(tiles).reshape(images, rows, columns, tile_size, tile_size, -1).transpose(2, 3)
    )
    whole = grid.reshape(images, rows * tile_size, columns * tile_size, -1)[
        :, :image_height, :image_width
    ]
    return whole[..., :-1], whole[..., -1:]


def check(
    first: Tensor,
    shape: tuple[int, ...],
    dtype: torch.dtype = torch.float32,
    **others: tuple[Tensor, tuple[int, ...]],
) -> None:
    for name, (tensor, expected) in {"first": (first, shape), **others}.items():
        wanted = torch.float32 if name == "first" and first.is_floating_point() else dtype
        assert tensor.dtype == wanted, f"{name}: expected {wanted}, found {tensor.dtype}"
        assert tuple(tensor.shape) == tuple(expected), (
            f"{name}: expected {expected}, found {tuple(tensor.shape)}"
        )
        assert tensor.device == first.device, (
            f"{name} lies on {tensor.device}, not on {first.device}"
        )
