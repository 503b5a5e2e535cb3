"""Base values ("seeds") of the aux Gaussians (paper, section 3.3), to which f_res adds deltas.

Behind a surface of the photo, colour and depth are propagated from the far side of a hole's rim. Beyond the photo's
border, the surface at the border is extended along the epipolar line, at constant depth in the photo's frame.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from spackle.camera import Camera, beside
from spackle.filters import FAR_BIAS, far_fill, greatest_around
from spackle.residual.epipolar_walk import walk
from spackle.residual.view_features import CELL, LEAST, ViewFeatures, cell_centers
from spackle.surface import BEHIND, surface_slope

AT_BORDER = 0.03  # of the photo's width: a surface that ends farther inside is not extended beyond the border
BLOB_CELLS = 2  # a seed lies behind all visible surfaces within so many cells, the reach of its Gaussian


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Base values for every cell of a grid."""

    uv: Tensor  # [h, w, 2] pixels
    inverse_depth: Tensor  # [h, w]
    slope: Tensor  # [h, w, 2] derivative of the inverse depth per pixel
    rgb: Tensor  # [h, w, 3] sRGB
    unit: float = 1.0  # the view's median inverse depth, the unit of inverse depths and their deltas

    def select(self, cells: Tensor) -> Seeds:
        """Flat fields [n, ...] of the cells `cells`: a boolean grid [h, w], or row-major indices [n]."""
        index = cells.flatten().nonzero()[:, 0] if cells.dtype == torch.bool else cells
        lead = self.inverse_depth.ndim - 1
        fields = (self.uv, self.inverse_depth, self.slope, self.rgb)
        uv, inverse_depth, slope, rgb = (field.flatten(0, lead)[index.to(field.device)] for field in fields)
        return Seeds(uv, inverse_depth, slope, rgb, self.unit)


def make_seeds(features: ViewFeatures, camera: Camera, photo_camera: Camera) -> Seeds:
    """Seeds for all cells of a view; unmasked cells keep their rendered colour and depth."""
    known, uv = ~features.mask, beside(cell_centers(camera), features.rgb)
    if not bool(known.any()):
        known = features.inverse_depth > 0
    if not bool(known.any()):
        # Nothing is visible: assume a grey wall ten metres away.
        grey = torch.full_like(features.rgb, 0.5)
        return Seeds(uv, torch.full_like(features.alpha, 0.1), torch.zeros_like(uv), grey, 0.1)
    across, _ = far_fill(features.inverse_depth, features.rgb.permute(2, 0, 1)[:0], known, far_bias=0.0)
    inside = inside_photo(across, camera, photo_camera)
    filled, rgb = fill_around(features, across, uv, known, inside, camera, photo_camera)
    inverse_depth = placed_behind(filled, features.mask, features.inverse_depth, BLOB_CELLS)
    slope = surface_slope(inverse_depth) / CELL
    return Seeds(uv, inverse_depth, slope, rgb.permute(1, 2, 0), float(inverse_depth.median()))


def inside_photo(inverse_depth: Tensor, camera: Camera, photo_camera: Camera) -> Tensor:
    """[h, w] bool: whether the point of a cell projects into the photo."""
    place, z = _place_in_photo(inverse_depth, camera, photo_camera)
    return ((z > 0) & (place >= 0) & (place < z)).all(-1)


def seen_in_photo(
    photo: Tensor, elsewhere: Tensor, inverse_depth: Tensor, camera: Camera, photo_camera: Camera
) -> Tensor:
    """[h, w, 3] sRGB: the colour of the photo [H, W, 3] at the point of each cell; outside of the photo `elsewhere`."""
    place, z = _place_in_photo(inverse_depth, camera, photo_camera)
    cells = avg_pool2d(photo.cpu().movedim(-1, 0)[None], CELL, ceil_mode=True, count_include_pad=False)
    grid = (2 * place / z.clamp_min(LEAST) - 1).clamp(-2, 2).to(cells)[None]
    seen = grid_sample(cells, grid, padding_mode="border", align_corners=False)[0].movedim(0, -1)
    return torch.where(((z > 0) & (place >= 0) & (place < z)).all(-1, keepdim=True), seen, elsewhere)


def _place_in_photo(inverse_depth: Tensor, camera: Camera, photo_camera: Camera) -> tuple[Tensor, Tensor]:
    """Points of cells projected into the photo: (x, y)·z [h, w, 2] with x and y in 0..1 inside, and z [h, w, 1]."""
    rays, motion = _rays_in_photo(cell_centers(camera).double(), camera, photo_camera)
    points, lens = rays + inverse_depth[..., None] * motion[:3, 3], photo_camera.K.cpu().double()
    place, z = points[..., :2] * lens.diagonal()[:2] + points[..., 2:] * lens[:2, 2], points[..., 2:]
    return place / torch.tensor([photo_camera.width, photo_camera.height]), z


def _rays_in_photo(uv: Tensor, camera: Camera, photo_camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays [h, w, 3] of a view's cells in the photo's frame, and the transform [4, 4] from view to photo.

    A point times its inverse depth is ray + translation · inverse depth.
    """
    here, photo = (view.world_to_camera.cpu().double() for view in (camera, photo_camera))
    motion, lens = beside(photo @ here.inverse(), uv), beside(camera.K, uv)
    return (uv - lens[:2, 2]) / lens.diagonal()[:2] @ motion[:3, :2].T + motion[:3, 2], motion


def placed_behind(filled: Tensor, chosen: Tensor, seen: Tensor, radius: int) -> Tensor:
    """Move the filled inverse depth [h, w] of chosen cells ([h, w] bool) behind all surfaces within `radius` cells.

    `seen` [h, w] is the inverse depth of visible surfaces; 0: none.
    """
    farthest = -greatest_around(-torch.where(seen > 0, seen, torch.inf), radius)
    return torch.where(chosen, torch.minimum(filled, farthest) * (1 - BEHIND), filled)


def fill_around(
    features: ViewFeatures,
    across: Tensor,
    uv: Tensor,
    known: Tensor,
    inside: Tensor,
    camera: Camera,
    photo_camera: Camera,
) -> tuple[Tensor, Tensor]:
    """Inverse depth [h, w] and colours [3, h, w] of all cells, extended beyond the photo's border.

    Args:
        features: of the view.
        across: [h, w] inverse depth, with holes filled from all sides.
        uv: [h, w, 2] pixels of the cells.
        known: [h, w] bool: cells from which values are propagated.
        inside: [h, w] bool: cells that project into the photo; their holes are filled from the far surface.
        camera, photo_camera: of the view and of the photo.
    """
    mask, bias, colors = features.mask, FAR_BIAS * inside, features.rgb.movedim(-1, 0)
    beyond = mask & ~inside
    if not bool(beyond.any()):
        return far_fill(features.inverse_depth, colors, known, far_bias=bias)
    rays, motion = _rays_in_photo(uv, camera, photo_camera)
    points, lens = rays + motion[:3, 3] * across[..., None], beside(photo_camera.K, uv)
    depth = points[..., 2:].clamp_min(LEAST)
    place = points[..., :2] / depth * lens.diagonal()[:2] + lens[:2, 2]
    size = beside(torch.tensor([photo_camera.width, photo_camera.height]), place)
    ends = torch.minimum(place, size - place).amin(-1) < AT_BORDER * photo_camera.width
    values = torch.stack([across / depth[..., 0], ends.to(across)], dim=-1)

    far, _, steps = walk(uv, values, across, mask, camera, photo_camera.position)
    away = 1 / far[..., 0].clamp_min(LEAST) - motion[2, 3]
    hidden = beyond & (steps > 0) & (far[..., 1] == 0)  # behind a nearer surface inside the photo
    traced = beyond & ~hidden & (steps > 0) & (away > 0) & (rays[..., 2] > 0)
    nearest = torch.where(known, features.inverse_depth, 0).amax()
    extended = torch.minimum((rays[..., 2] / away.clamp_min(LEAST)).clamp_min(LEAST), nearest)

    bias = torch.where(hidden, FAR_BIAS, bias)
    filled, mixed = far_fill(features.inverse_depth, colors, known, far_bias=bias)
    filled = torch.where(traced, extended, filled)
    others = beyond & ~traced
    if bool(others.any()):
        refilled, _ = far_fill(filled, colors[:0], traced | known, far_bias=bias)
        filled = torch.where(others, refilled, filled)
    return filled, mixed
