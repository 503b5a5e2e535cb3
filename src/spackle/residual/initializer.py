"""Base values ("seeds") of the aux Gaussians (paper, section 3.3), to which f_res adds deltas.

Behind a surface of the photo, colour and depth are propagated from the far side of a hole's rim. Beyond the photo's
border, the surface at the border is extended along the epipolar line, at constant depth in the photo's frame.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from spackle.core.camera import Camera, to_like
from spackle.core.filters import maximum_filter
from spackle.core.hole_filling import FAR_SIDE_BIAS, fill_from_far_side
from spackle.core.surfels import BEHIND_SURFACE_RATIO, inverse_depth_slope
from spackle.residual.features import CELL, LEAST, ViewFeatures, cell_centers
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import kernel

AT_BORDER = 0.03  # of the photo's width: a surface that ends farther inside is not extended beyond the border
BLOB_CELLS = (
    2  # a seed lies behind all visible surfaces within so many cells, the reach of its Gaussian
)
SAME_DEPTH = 1.1  # a cell mirrored at the rim and the rim belong to one surface if inverse depths differ by less
SAME_EYE = 1e-9 * CELL  # a shorter offset between cell and epipole (homogeneous) has no direction


@dataclasses.dataclass(frozen=True)
class InitialGaussians:
    """Base values for every cell of a grid."""

    uv: Tensor  # [h, w, 2] pixels
    inverse_depth: Tensor  # [h, w]
    slope: Tensor  # [h, w, 2] derivative of the inverse depth per pixel
    rgb: Tensor  # [h, w, 3] sRGB
    unit: float = (
        1.0  # the view's median inverse depth, the unit of inverse depths and their deltas
    )

    def select(self, cells: Tensor) -> InitialGaussians:
        """Flat fields [n, ...] of the cells `cells`: a boolean grid [h, w], or row-major indices [n]."""
        index = cells.flatten().nonzero()[:, 0] if cells.dtype == torch.bool else cells
        lead = self.inverse_depth.ndim - 1
        fields = (self.uv, self.inverse_depth, self.slope, self.rgb)
        uv, inverse_depth, slope, rgb = (
            field.flatten(0, lead)[index.to(field.device)] for field in fields
        )
        return InitialGaussians(uv, inverse_depth, slope, rgb, self.unit)


def initialize(features: ViewFeatures, camera: Camera, photo_camera: Camera) -> InitialGaussians:
    """Seeds for all cells of a view; unmasked cells keep their rendered colour and depth."""
    known, uv = ~features.mask, to_like(cell_centers(camera), features.rgb)
    if not bool(known.any()):
        known = features.inverse_depth > 0
    if not bool(known.any()):
        # Nothing is visible: assume a grey wall ten metres away.
        grey = torch.full_like(features.rgb, 0.5)
        return InitialGaussians(
            uv, torch.full_like(features.alpha, 0.1), torch.zeros_like(uv), grey, 0.1
        )
    across, _ = fill_from_far_side(
        features.inverse_depth, features.rgb.permute(2, 0, 1)[:0], known, far_bias=0.0
    )
    inside = inside_photo(across, camera, photo_camera)
    filled, rgb = fill_around(features, across, uv, known, inside, camera, photo_camera)
    inverse_depth = placed_behind_surfaces(
        filled, features.mask, features.inverse_depth, BLOB_CELLS
    )
    slope = inverse_depth_slope(inverse_depth) / CELL
    return InitialGaussians(
        uv, inverse_depth, slope, rgb.permute(1, 2, 0), float(inverse_depth.median())
    )


def inside_photo(inverse_depth: Tensor, camera: Camera, photo_camera: Camera) -> Tensor:
    """[h, w] bool: whether the point of a cell projects into the photo."""
    place, z = _place_in_photo(inverse_depth, camera, photo_camera)
    return ((z > 0) & (place >= 0) & (place < z)).all(-1)


def seen_in_photo(
    photo: Tensor, elsewhere: Tensor, inverse_depth: Tensor, camera: Camera, photo_camera: Camera
) -> Tensor:
    """[h, w, 3] sRGB: the colour of the photo [H, W, 3] at each cell's point; `elsewhere` outside of the photo."""
    place, z = _place_in_photo(inverse_depth, camera, photo_camera)
    cells = avg_pool2d(
        photo.cpu().movedim(-1, 0)[None], CELL, ceil_mode=True, count_include_pad=False
    )
    grid = (2 * place / z.clamp_min(LEAST) - 1).clamp(-2, 2).to(cells)[None]
    seen = grid_sample(cells, grid, padding_mode="border", align_corners=False)[0].movedim(0, -1)
    return torch.where(
        ((z > 0) & (place >= 0) & (place < z)).all(-1, keepdim=True), seen, elsewhere
    )


def _place_in_photo(
    inverse_depth: Tensor, camera: Camera, photo_camera: Camera
) -> tuple[Tensor, Tensor]:
    """Project cells' points into the photo: (x, y)·z [h, w, 2] and z [h, w, 1]; in the photo x and y are in 0..1."""
    rays, motion = _rays_in_photo(cell_centers(camera).double(), camera, photo_camera)
    points, lens = rays + inverse_depth[..., None] * motion[:3, 3], photo_camera.K.cpu().double()
    place, z = (
        points[..., :2] * lens.diagonal()[:2] + points[..., 2:] * lens[:2, 2],
        points[..., 2:],
    )
    return place / torch.tensor([photo_camera.width, photo_camera.height]), z


def _rays_in_photo(uv: Tensor, camera: Camera, photo_camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays [h, w, 3] of a view's cells in the photo's frame, and the transform [4, 4] from view to photo.

    A point times its inverse depth is ray + translation · inverse depth.
    """
    here, photo = (view.world_to_camera.cpu().double() for view in (camera, photo_camera))
    motion, lens = to_like(photo @ here.inverse(), uv), to_like(camera.K, uv)
    return (uv - lens[:2, 2]) / lens.diagonal()[:2] @ motion[:3, :2].T + motion[:3, 2], motion


def placed_behind_surfaces(filled: Tensor, chosen: Tensor, seen: Tensor, radius: int) -> Tensor:
    """Move the filled inverse depth [h, w] of chosen cells ([h, w] bool) behind all surfaces within `radius` cells.

    `seen` [h, w] is the inverse depth of visible surfaces; 0: none.
    """
    farthest = -maximum_filter(-torch.where(seen > 0, seen, torch.inf), radius)
    return torch.where(chosen, torch.minimum(filled, farthest) * (1 - BEHIND_SURFACE_RATIO), filled)


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

    `across` [h, w] is the inverse depth with holes filled from all sides; `uv` [h, w, 2] are the cells' pixels.
    Values are propagated from the cells `known` ([h, w] bool). Cells `inside` ([h, w] bool) project into the photo;
    their holes are filled from the far surface.
    """
    mask, bias, colors = features.mask, FAR_SIDE_BIAS * inside, features.rgb.movedim(-1, 0)
    beyond = mask & ~inside
    if not bool(beyond.any()):
        return fill_from_far_side(features.inverse_depth, colors, known, far_bias=bias)
    rays, motion = _rays_in_photo(uv, camera, photo_camera)
    points, lens = rays + motion[:3, 3] * across[..., None], to_like(photo_camera.K, uv)
    depth = points[..., 2:].clamp_min(LEAST)
    place = points[..., :2] / depth * lens.diagonal()[:2] + lens[:2, 2]
    size = to_like(torch.tensor([photo_camera.width, photo_camera.height]), place)
    ends = torch.minimum(place, size - place).amin(-1) < AT_BORDER * photo_camera.width
    values = torch.stack([across / depth[..., 0], ends.to(across)], dim=-1)

    far, _, steps = trace_epipolar_lines(uv, values, across, mask, camera, photo_camera.position)
    away = 1 / far[..., 0].clamp_min(LEAST) - motion[2, 3]
    hidden = beyond & (steps > 0) & (far[..., 1] == 0)  # behind a nearer surface inside the photo
    traced = beyond & ~hidden & (steps > 0) & (away > 0) & (rays[..., 2] > 0)
    nearest = torch.where(known, features.inverse_depth, 0).amax()
    extended = torch.minimum((rays[..., 2] / away.clamp_min(LEAST)).clamp_min(LEAST), nearest)

    bias = torch.where(hidden, FAR_SIDE_BIAS, bias)
    filled, mixed = fill_from_far_side(features.inverse_depth, colors, known, far_bias=bias)
    filled = torch.where(traced, extended, filled)
    others = beyond & ~traced
    if bool(others.any()):
        refilled, _ = fill_from_far_side(filled, colors[:0], traced | known, far_bias=bias)
        filled = torch.where(others, refilled, filled)
    return filled, mixed


# Epipolar lines -----------------------------------------------------------------------------------


def trace_epipolar_lines(
    uv: Tensor, values: Tensor, inverse_depth: Tensor, mask: Tensor, camera: Camera, eye: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Walk from each masked cell in both directions along its epipolar line, and take the farther surface.

    Args:
        uv: [h, w, 2] pixels of the cells.
        values: [h, w, c], read at the rim.
        inverse_depth: [h, w], positive.
        mask: [h, w] bool.
        camera: of the view.
        eye: [3] position of the other camera; its projection into the view is the epipole.

    Returns:
        Values [h, w, c] at the far rim; values [h, w, c] at the cell's mirror image beyond the rim; distance [h, w] to
        the rim in cells. If the mirror image lies on another surface, the rim's values replace it. Unmasked cells, and
        cells whose line meets no surface, have their own values and distance 0.
    """
    eye = eye.double()
    # Homogeneous, because the epipole may lie at infinity.
    epipole = (camera.K.to(eye) @ camera.to_camera(eye)).detach().cpu().numpy()
    view = [image.contiguous().numpy() for image in (uv, values, inverse_depth, mask)]
    grids = (view[1].copy(), view[1].copy(), np.zeros(mask.shape, np.float32))
    parallel_for_chunks(
        lambda start, stop: _walk(start, stop, *view, epipole, SAME_DEPTH, *grids), len(mask)
    )
    far, mirrored, distance = map(torch.from_numpy, grids)
    return far, mirrored, distance


@kernel
def _walk(
    start: int, stop: int, uv: Any, rgb: Any, depths: Any, mask: Any, epipole: Any, same: float,
    found: Any, mirrored: Any, distance: Any,
) -> None:  # fmt: skip
    height, width = depths.shape
    for y in range(start, stop):
        for x in range(width):
            if not mask[y, x]:
                continue
            across, down = _line(epipole, uv[y, x, 0], uv[y, x, 1])
            best, steps, side = np.float32(np.inf), 0, 0.0
            for turn in (1.0, -1.0):
                k = _steps_to_rim(mask, y, x, turn * down, turn * across)
                if k == 0:
                    continue
                v, u = _cell(y, x, k * turn * down, k * turn * across)
                if depths[v, u] < best:
                    best, steps, side = depths[v, u], k, turn
            if steps == 0:
                continue
            dy, dx = side * down, side * across
            v, u = _cell(y, x, steps * dy, steps * dx)
            found[y, x], mirrored[y, x], distance[y, x] = rgb[v, u], rgb[v, u], steps
            q, p = _cell(y, x, 2 * steps * dy, 2 * steps * dx)
            if 0 <= q < height and 0 <= p < width and not mask[q, p]:
                ratio = depths[q, p] / best
                if ratio < same and ratio > 1.0 / same:
                    mirrored[y, x] = rgb[q, p]


@kernel
def _line(epipole: Any, u: float, v: float) -> Any:
    """The unit vector (x, y) along a pixel's epipolar line; (1, 0) if both camera positions coincide."""
    x, y = epipole[0] - epipole[2] * u, epipole[1] - epipole[2] * v
    length = np.sqrt(x * x + y * y)
    if length > SAME_EYE:
        return x / length, y / length
    return 1.0, 0.0


@kernel
def _steps_to_rim(mask: Any, y: int, x: int, dy: float, dx: float) -> int:
    """The number of one-cell steps to the first unmasked cell; 0 if the steps leave the image first."""
    height, width = mask.shape
    k = 1
    while True:
        v, u = _cell(y, x, k * dy, k * dx)
        if v < 0 or u < 0 or v >= height or u >= width:
            return 0
        if not mask[v, u]:
            return k
        k += 1


@kernel
def _cell(y: int, x: int, dy: float, dx: float) -> Any:
    return int(np.floor(y + dy + 0.5)), int(np.floor(x + dx + 0.5))
