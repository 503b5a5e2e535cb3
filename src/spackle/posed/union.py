"""Merge the Gaussians of several photos: each surface once, from the photo that sees it best."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render import Renderer
from spackle.residual.features import hole_mask

# A photo's depth counts where its own Gaussians cover at least this much of the pixel.
MIN_ALPHA = 0.5
# Two depths are of one surface if they differ by less than this many errors of both photos.
SAME_SURFACE_ERRORS = 3.0
# Bounds of this relative difference: below it are roundings, above it are other things.
MIN_TOLERANCE = 0.02
MAX_TOLERANCE = 0.1
# Where a Gaussian may be on its ray, as shares of the tolerance.
PIECE_STEPS = (0.0, -0.5, 0.5, -1.0, 1.0)  # the likeliest place first
# A photo of a later rank must see a surface this much more finely to replace one of an earlier
# rank: seams lie where photos end, and not where two of them are about equally good.
RANK_PENALTY = 0.5


@dataclasses.dataclass(frozen=True)
class PlacedPhoto:
    """A photo's Gaussians in the common world, and what the photo knows about its own view."""

    gaussians: Gaussians  # in the world
    camera: Camera  # float32, in the world
    depth: Tensor  # [H, W] rendered from its own Gaussians, in the world's unit
    alpha: Tensor  # [H, W] of the same rendering
    rgb: Tensor  # [H, W, 3] sRGB of the same rendering
    error: float  # median relative error of its depths

    @staticmethod
    def of(gaussians: Gaussians, camera: Camera, error: float, renderer: Renderer) -> PlacedPhoto:
        """A photo with the depth that its Gaussians have in its own view."""
        rendering = renderer.render(gaussians, camera).to(torch.device("cpu"))
        return PlacedPhoto(
            gaussians, camera, rendering.depth, rendering.alpha, rendering.rgb, error
        )


@dataclasses.dataclass(frozen=True)
class Union:
    """The Gaussians of several photos without doubles and without what a photo contradicts."""

    gaussians: Gaussians
    counts: tuple[int, ...]  # how many of each photo were kept
    doubled: int  # left out, because another photo sees the surface better
    contradicted: int  # left out, because another photo sees through them


@torch.no_grad()
def merge_photos(photos: Sequence[PlacedPhoto], renderer: Renderer) -> Union:
    """Merge photos: a Gaussian is kept where its own photo sees the surface best.

    It is left out where another photo sees the same surface better, or sees through it: there,
    that photo's own surface is farther away. Where this opens holes in a photo that had none, the
    photo's own Gaussians are put back, so that merging makes no holes.

    Args:
        photos: in the order of their rank: among equally good ones, the first decides.
        renderer: draws the merged scene.
    """
    kept: list[Tensor] = []  # [N] bool for each photo
    doubled = 0
    contradicted = 0
    for rank, photo in enumerate(photos):
        is_doubled = torch.zeros(len(photo.gaussians), dtype=torch.bool)
        is_contradicted = is_doubled.clone()
        own_cost = _cost(photo.camera, photo.gaussians.means, rank)
        for other_rank, other in enumerate(photos):
            if other_rank == rank:
                continue
            view = evidence_of(photo, other)
            is_contradicted |= view.sees_through

            # The cost grows with the rank, so that a later photo replaces an earlier one only if it
            # sees much better. Else the two would mix where they are about equally good.
            other_cost = _cost(other.camera, photo.gaussians.means, other_rank)
            is_doubled |= view.same_surface & (other_cost < own_cost)
        kept.append(~(is_doubled | is_contradicted))
        contradicted += int(is_contradicted.sum())
        doubled += int((is_doubled & ~is_contradicted).sum())

    _take_back(photos, kept, renderer)
    parts = [photo.gaussians.select(mask) for photo, mask in zip(photos, kept, strict=True)]
    counts = tuple(int(mask.sum()) for mask in kept)
    return Union(Gaussians.cat(parts), counts, doubled, contradicted)


def _cost(camera: Camera, means: Tensor, rank: int) -> Tensor:
    """[N] how coarsely a photo sees points [N, 3]: the width of a pixel there, in world units.

    Photos of later ranks are put at a disadvantage.
    """
    z = camera.to_camera(means)[:, 2].abs()
    return z / camera.focal[0] * (1 + RANK_PENALTY * rank)


@dataclasses.dataclass(frozen=True)
class Evidence:
    """What a photo says about the N Gaussians of another one."""

    same_surface: Tensor  # [N] bool: it sees a surface at the same depth
    # [N] bool: its surface is farther away, so there is nothing at the Gaussian's place
    sees_through: Tensor
    row: Tensor  # [N] the pixel in which it sees the surface; any pixel if it does not
    column: Tensor


def evidence_of(photo: PlacedPhoto, other: PlacedPhoto) -> Evidence:
    """What the photo `other` says about the Gaussians of `photo`.

    A Gaussian's depth is uncertain, so it may be anywhere on a short piece of its ray. The other
    photo contradicts it only if it sees through all of this piece; and it sees the same surface if
    it sees one anywhere on it. Otherwise a thing that two photos put at slightly different depths
    would be taken out of both.
    """
    tolerance = _tolerance(photo, other)
    nearest, farthest = _depth_bounds(other)
    eye = photo.camera.position
    rays = photo.gaussians.means - eye  # [N, 3]
    same_surface = torch.zeros(len(rays), dtype=torch.bool)
    sees_through = torch.ones(len(rays), dtype=torch.bool)
    surface_row = torch.zeros(len(rays), dtype=torch.long)
    surface_column = surface_row.clone()

    # Several places on the piece are tried: the Gaussian's own, then nearer and farther ones.
    for step in PIECE_STEPS:
        uv, z = other.camera.project(eye + (1 + step * tolerance) * rays)
        is_inside, row, column = _pixels(uv, z, other.camera)
        knows = is_inside & (other.alpha[row, column] >= MIN_ALPHA)
        # At an edge, a pixel may show either of two surfaces: a point before both lies before, one
        # behind both lies behind.
        lies_before = z < nearest[row, column] * (1 - tolerance)
        lies_behind = z > farthest[row, column] * (1 + tolerance)
        is_same = knows & ~lies_before & ~lies_behind

        # The pixel in which the other photo sees the surface is that of the first place that fits.
        is_first = is_same & ~same_surface
        surface_row = row.where(is_first, surface_row)
        surface_column = column.where(is_first, surface_column)
        same_surface |= is_same
        sees_through &= knows & lies_before
    return Evidence(same_surface, sees_through, surface_row, surface_column)


def _depth_bounds(photo: PlacedPhoto) -> tuple[Tensor, Tensor]:
    """The nearest and the farthest depth [H, W] of 3×3 pixels around each pixel of a photo.

    Beside an edge, either of the two surfaces may be meant.
    """
    is_known = photo.alpha >= MIN_ALPHA
    far_where_unknown = photo.depth.where(is_known, torch.inf)
    near_where_unknown = photo.depth.where(is_known, 0.0)
    nearest = -max_pool2d(-far_where_unknown[None], 3, stride=1, padding=1)[0]
    farthest = max_pool2d(near_where_unknown[None], 3, stride=1, padding=1)[0]
    return nearest, farthest


def _pixels(uv: Tensor, z: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Which of N points lie in a picture, [N] bool, and their rows and columns [N]."""
    is_inside = camera.has_in_frame(uv, z)
    column = uv[:, 0].floor().clamp(0, camera.width - 1).long()
    row = uv[:, 1].floor().clamp(0, camera.height - 1).long()
    return is_inside, row, column


def _tolerance(photo: PlacedPhoto, other: PlacedPhoto) -> float:
    """The relative difference up to which depths of two photos may be of one surface."""
    tolerance = SAME_SURFACE_ERRORS * (photo.error + other.error)
    return min(MAX_TOLERANCE, max(MIN_TOLERANCE, tolerance))


def _take_back(photos: Sequence[PlacedPhoto], kept: Sequence[Tensor], renderer: Renderer) -> None:
    """Mark those Gaussians as kept whose absence would open holes in their own photo.

    `kept` [N] bool for each photo is changed in place.
    """
    for photo, mask in zip(photos, kept, strict=True):
        others = [one.gaussians.select(keep) for one, keep in zip(photos, kept, strict=True)]
        rendering = renderer.render(others, photo.camera).to(torch.device("cpu"))
        is_opened = hole_mask(rendering.alpha) & ~hole_mask(photo.alpha)  # [H, W]
        is_inside, row, column = _pixels(*photo.camera.project(photo.gaussians.means), photo.camera)
        mask |= is_inside & is_opened[row, column]
