"""Initial Gaussians: a first guess for each hole cell of a view (paper, section 3.3), which the
network then corrects.

Behind a surface of the photo, colour and depth are continued from the far side of the hole's rim.
Beyond the photo's border, the surface at the border is extended along the epipolar line, at
constant depth in the photo's frame.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from spackle.core.camera import Camera, to_like
from spackle.core.filters import maximum_filter
from spackle.core.hole_filling import FAR_SIDE_BIAS, fill_from_far_side
from spackle.core.surfels import BEHIND_SURFACE_RATIO, inverse_depth_slope
from spackle.residual.epipolar import trace_epipolar_lines
from spackle.residual.features import CELL, MIN_DIVISOR, TINY, ViewFeatures, cell_centers

# A surface that ends farther inside the photo, as a fraction of the photo's width, is not extended
# beyond the border.
AT_BORDER_WIDTHS = 0.03
# An initial Gaussian reaches so many cells, so it lies behind all visible surfaces within this
# distance.
GAUSSIAN_REACH_CELLS = 2
EMPTY_VIEW_GREY = 0.5  # sRGB of the wall that fills a view in which nothing is visible
EMPTY_VIEW_INVERSE_DEPTH = 0.1  # 1/m: this wall stands ten metres away


@dataclasses.dataclass(frozen=True)
class InitialGaussians:
    """The first guess of one Gaussian for every cell (2×2 pixels) of a view: a point of a surface,
    and its colour.
    """

    uv: Tensor  # [h, w, 2] pixels (x, y)
    inverse_depth: Tensor  # [h, w] 1/z
    slope: Tensor  # [h, w, 2] derivative of the inverse depth per pixel, by x and y
    rgb: Tensor  # [h, w, 3] sRGB
    unit: float = 1.0  # the view's median inverse depth: the unit of the network's inverse depths

    def select(self, cells: Tensor) -> InitialGaussians:
        """The same fields for n cells only, flat: [n, ...].

        `cells` is a boolean grid [h, w], or holds row-major indices [n].
        """
        index = cells
        if cells.dtype == torch.bool:
            index = cells.flatten().nonzero()[:, 0]

        # The grid's axes are the first two; fields that are already flat have only one.
        last_cell_axis = self.inverse_depth.ndim - 1

        def pick(field: Tensor) -> Tensor:
            """The values [n, ...] of the chosen cells."""
            return field.flatten(0, last_cell_axis)[index.to(field.device)]

        return InitialGaussians(
            uv=pick(self.uv),
            inverse_depth=pick(self.inverse_depth),
            slope=pick(self.slope),
            rgb=pick(self.rgb),
            unit=self.unit,
        )


def initialize(features: ViewFeatures, camera: Camera, photo_camera: Camera) -> InitialGaussians:
    """The first guess of one Gaussian for every cell [h, w] of a view, which a network then
    changes.

    In holes, colour and depth are continued from the surfaces around; other cells keep what was
    rendered.

    Args:
        features: the rendered view, in cells of 2×2 pixels.
        camera: of the view.
        photo_camera: of the photo. Cells that it does not see are filled by extending the surfaces
            at the photo's border, all other cells from the far side of their hole.
    """
    uv = to_like(cell_centers(camera), features.rgb)

    # Holes are filled from the cells without a hole pixel. If there is none, cells with at least
    # one visible pixel take their place.
    known = ~features.mask
    if not bool(known.any()):
        known = features.inverse_depth > 0
    if not bool(known.any()):
        return _grey_wall(features, uv)

    # A first fill, in which near and far sides of a hole count alike, tells which cells lie beyond
    # the photo's border. It fills depths alone, and no colours.
    no_colors = features.rgb.permute(2, 0, 1)[:0]  # [0, h, w]
    unbiased_inverse_depth, _ = fill_from_far_side(
        features.inverse_depth, no_colors, known, far_bias=0.0
    )
    inside = inside_photo(unbiased_inverse_depth, camera, photo_camera)
    filled, rgb = fill_around(
        features, unbiased_inverse_depth, uv, known, inside, camera, photo_camera
    )
    inverse_depth = place_behind_surfaces(
        filled, features.mask, features.inverse_depth, GAUSSIAN_REACH_CELLS
    )
    return InitialGaussians(
        uv=uv,
        inverse_depth=inverse_depth,
        slope=inverse_depth_slope(inverse_depth) / CELL,  # per pixel, not per cell
        rgb=rgb.permute(1, 2, 0),  # [h, w, 3]
        unit=float(inverse_depth.median()),
    )


def _grey_wall(features: ViewFeatures, uv: Tensor) -> InitialGaussians:
    """A grey wall that faces the camera ten metres away, for a view in which nothing is visible.

    `uv` [h, w, 2] are the centres of the cells in pixels.
    """
    return InitialGaussians(
        uv=uv,
        inverse_depth=torch.full_like(features.alpha, EMPTY_VIEW_INVERSE_DEPTH),
        slope=torch.zeros_like(uv),
        rgb=torch.full_like(features.rgb, EMPTY_VIEW_GREY),
        unit=EMPTY_VIEW_INVERSE_DEPTH,  # the median inverse depth, as in other views
    )


# Points of the view in the photo ------------------------------------------------------------------


def inside_photo(inverse_depth: Tensor, camera: Camera, photo_camera: Camera) -> Tensor:
    """[h, w] bool: whether the point of a cell projects into the photo; it may be hidden there.

    `inverse_depth` [h, w] is 1/z of the cells' points as `camera` sees them.
    """
    place, z = _project_into_photo(inverse_depth, camera, photo_camera)
    return _is_inside(place, z).all(-1)


def sample_photo(
    photo: Tensor,
    fallback_colors: Tensor,
    inverse_depth: Tensor,
    camera: Camera,
    photo_camera: Camera,
) -> Tensor:
    """[h, w, 3] sRGB: the photo's colour at the point of each cell (2×2 pixels) of a view.

    Args:
        photo: [H', W', 3] sRGB.
        fallback_colors: [h, w, 3] sRGB, taken for points that lie outside of the photo, or behind
            its camera.
        inverse_depth: [h, w] 1/z of the cells' points as `camera` sees them.
        camera: of the view.
        photo_camera: of the photo.
    """
    place, z = _project_into_photo(inverse_depth, camera, photo_camera)

    # A cell has one colour, so the photo's pixels are averaged over 2×2 pixels as well.
    photo_channels_first = photo.to(inverse_depth.device).movedim(-1, 0)[None]  # [1, 3, H', W']
    photo_cells = avg_pool2d(photo_channels_first, CELL, ceil_mode=True, count_include_pad=False)

    # grid_sample counts from -1 to 1 across the photo. The clamp to -2..2 keeps the places of
    # points near the camera's plane finite; those outside are replaced below.
    grid = (2 * place / z.clamp_min(MIN_DIVISOR) - 1).clamp(-2, 2).to(photo_cells)[None]
    sampled = grid_sample(photo_cells, grid, padding_mode="border", align_corners=False)
    photo_colors = sampled[0].movedim(0, -1)  # [h, w, 3]
    return torch.where(_is_inside(place, z).all(-1, keepdim=True), photo_colors, fallback_colors)


def _is_inside(place: Tensor, z: Tensor) -> Tensor:
    """[h, w, 2] bool: whether the projected points lie in the photo, along x and along y.

    `place` [h, w, 2] is the position from 0 to 1 across the photo, times the depth z [h, w, 1]; a
    comparison with z needs no division.
    """
    return (z > 0) & (place >= 0) & (place < z)


def _project_into_photo(
    inverse_depth: Tensor, camera: Camera, photo_camera: Camera
) -> tuple[Tensor, Tensor]:
    """Project the points of a view's cells (2×2 pixels) into the photo, homogeneously.

    A point's place in the photo is (x, y), from 0 to 1 across the photo; its depth there is z. The
    result is (x·z, y·z) and z, because a division by z would fail for points in the plane of the
    photo's camera.

    Args:
        inverse_depth: [h, w] 1/z of the cells' points as `camera` sees them.
        camera: of the view.
        photo_camera: of the photo.

    Returns:
        (x·z, y·z) as [h, w, 2], and z as [h, w, 1], float64.
    """
    uv = to_like(cell_centers(camera), inverse_depth).double()
    rays, motion = _rays_in_photo(uv, camera, photo_camera)

    # A point is ray / inverse_depth + t in the photo's frame. Here it is multiplied by its inverse
    # depth, so that points at infinity stay finite; x, y and the sign of z do not change.
    points = rays + inverse_depth[..., None] * motion[:3, 3]  # [h, w, 3]
    z = points[..., 2:]
    photo_K = to_like(photo_camera.K.double(), points)
    pixels = points[..., :2] * photo_K.diagonal()[:2] + z * photo_K[:2, 2]
    photo_size = to_like(torch.tensor([photo_camera.width, photo_camera.height]), points)
    return pixels / photo_size, z


def _rays_in_photo(uv: Tensor, camera: Camera, photo_camera: Camera) -> tuple[Tensor, Tensor]:
    """Rays [h, w, 3] through a view's cells in the frame of the photo's camera, and the motion
    [4, 4] from the view's frame to the photo's.

    The point of a cell at depth z in the view is z · ray + t in the photo's frame, with the
    motion's translation t. `uv` [h, w, 2] are the cells' pixels.
    """
    world_to_view = camera.world_to_camera.cpu().double()
    world_to_photo = photo_camera.world_to_camera.cpu().double()
    motion = to_like(world_to_photo @ world_to_view.inverse(), uv)
    K = to_like(camera.K, uv)
    directions = (uv - K[:2, 2]) / K.diagonal()[:2]  # x and y at z = 1
    rays = directions @ motion[:3, :2].T + motion[:3, 2]  # rotated directions (x, y, 1)
    return rays, motion


# Depth of holes -----------------------------------------------------------------------------------


def place_behind_surfaces(filled: Tensor, cells: Tensor, visible: Tensor, radius: int) -> Tensor:
    """Inverse depth [h, w] of a view's cells, with some cells moved behind all surfaces nearby.

    Args:
        filled: [h, w] inverse depth of all cells.
        cells: [h, w] bool: the cells to move.
        visible: [h, w] inverse depth of visible surfaces; 0: none.
        radius: surfaces within so many rows and columns of a cell count.
    """
    # The least inverse depth nearby, computed as minus the maximum of the negative.
    farthest_nearby = -maximum_filter(-torch.where(visible > 0, visible, torch.inf), radius)
    # A Gaussian at exactly this depth would show through the surface, so it goes a little farther.
    behind = torch.minimum(filled, farthest_nearby) * (1 - BEHIND_SURFACE_RATIO)
    return torch.where(cells, behind, filled)


def fill_around(
    features: ViewFeatures,
    unbiased_inverse_depth: Tensor,
    uv: Tensor,
    known: Tensor,
    inside: Tensor,
    camera: Camera,
    photo_camera: Camera,
) -> tuple[Tensor, Tensor]:
    """Inverse depth [h, w] and sRGB [3, h, w] of all cells, with the holes filled.

    A hole that a nearer object of the photo covered is filled from the far side of its rim. A hole
    beyond the photo's border is filled by extending the surface that ends at the border.

    Args:
        features: the rendered view, in cells of 2×2 pixels.
        unbiased_inverse_depth: [h, w] inverse depth of a first fill, in which the near and the far
            side of a rim counted alike.
        uv: [h, w, 2] pixels of the cells.
        known: [h, w] bool: the cells whose depth and colour are continued into the holes.
        inside: [h, w] bool: the cells whose points project into the photo.
        camera: of the view.
        photo_camera: of the photo.
    """
    colors = features.rgb.movedim(-1, 0)  # [3, h, w]

    # Inside the photo, the far side of a rim decides. Beyond the border the bias is 0: near and far
    # side count alike.
    far_bias = FAR_SIDE_BIAS * inside
    beyond = features.mask & ~inside
    if not bool(beyond.any()):
        return fill_from_far_side(features.inverse_depth, colors, known, far_bias=far_bias)

    hidden, extended, extended_inverse_depth = _extend_border_surfaces(
        features, unbiased_inverse_depth, uv, beyond, known, camera, photo_camera
    )

    # Beyond the border, too, a nearer object may have covered a cell: such cells are filled from
    # the far side.
    far_bias = torch.where(hidden, FAR_SIDE_BIAS, far_bias)
    filled, filled_colors = fill_from_far_side(
        features.inverse_depth, colors, known, far_bias=far_bias
    )
    filled = torch.where(extended, extended_inverse_depth, filled)

    # The fill above did not know the extended surfaces. So the depths of the other cells beyond the
    # border are filled again, now also from the extended surfaces; their colours stay.
    others = beyond & ~extended
    if bool(others.any()):
        no_colors = colors[:0]
        refilled, _ = fill_from_far_side(filled, no_colors, extended | known, far_bias=far_bias)
        filled = torch.where(others, refilled, filled)
    return filled, filled_colors


def _extend_border_surfaces(
    features: ViewFeatures,
    unbiased_inverse_depth: Tensor,
    uv: Tensor,
    beyond: Tensor,
    known: Tensor,
    camera: Camera,
    photo_camera: Camera,
) -> tuple[Tensor, Tensor, Tensor]:
    """Extend the surfaces that end at the photo's border to the hole cells beyond the border.

    A surface is extended along epipolar lines, at constant depth z in the photo's frame; a floor
    thus stays a floor.

    Args:
        features: the rendered view, in cells of 2×2 pixels.
        unbiased_inverse_depth: [h, w] 1/z of a first fill, in which the near and the far side of a
            hole counted alike.
        uv: [h, w, 2] pixels of the cells.
        beyond: [h, w] bool: hole cells whose points project outside of the photo.
        known: [h, w] bool: cells whose depth was rendered.
        camera: of the view.
        photo_camera: of the photo.

    Returns:
        Three grids [h, w]: cells that lie behind a surface which ends inside the photo (bool);
        cells that continue a surface (bool); and the inverse depth of this surface.
    """
    rays, motion = _rays_in_photo(uv, camera, photo_camera)
    # The cells' points in the photo's frame, divided by their depth z in the view.
    points = rays + motion[:3, 3] * unbiased_inverse_depth[..., None]  # [h, w, 3]
    relative_z = points[..., 2:].clamp_min(MIN_DIVISOR)  # z in the photo / z in the view
    photo_K = to_like(photo_camera.K, uv)
    photo_pixels = points[..., :2] / relative_z * photo_K.diagonal()[:2] + photo_K[:2, 2]

    # A surface ends either at the photo's border, or inside the photo, where something nearer
    # covers the rest. Only the first kind is extended.
    photo_size = to_like(torch.tensor([photo_camera.width, photo_camera.height]), photo_pixels)
    to_border_px = torch.minimum(photo_pixels, photo_size - photo_pixels).amin(-1)
    ends_at_border = to_border_px < AT_BORDER_WIDTHS * photo_camera.width
    photo_inverse_depth = unbiased_inverse_depth / relative_z[..., 0]

    # Where the epipolar line of a cell meets the rim of its hole: the surface that ends there.
    values = torch.stack([photo_inverse_depth, ends_at_border.to(unbiased_inverse_depth)], dim=-1)
    at_rim, _, steps = trace_epipolar_lines(
        uv, values, unbiased_inverse_depth, features.mask, camera, photo_camera.position
    )
    rim_photo_inverse_depth = at_rim[..., 0]
    rim_ends_inside = at_rim[..., 1] == 0  # `ends_at_border` is false

    # Depths from a millionth of the nearest one to a million times as far, in any unit.
    nearest = torch.where(known, features.inverse_depth, 0).amax()  # as an inverse depth
    least_inverse = (MIN_DIVISOR * nearest).clamp_min(TINY)
    least_length = MIN_DIVISOR / nearest.clamp_min(TINY)

    # z_photo = ray_z · z_view + t_z, solved for z_view = (z_photo − t_z) / ray_z.
    z_minus_t = 1 / rim_photo_inverse_depth.clamp_min(least_inverse) - motion[2, 3]  # z_photo − t_z
    hidden = beyond & (steps > 0) & rim_ends_inside
    extended = beyond & ~hidden & (steps > 0) & (z_minus_t > 0) & (rays[..., 2] > 0)
    inverse_depth = (rays[..., 2] / z_minus_t.clamp_min(least_length)).clamp_min(least_inverse)

    # No extended surface comes nearer than the nearest visible one.
    return hidden, extended, torch.minimum(inverse_depth, nearest)
