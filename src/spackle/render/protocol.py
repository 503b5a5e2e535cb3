"""What every renderer offers (`Renderer`), what it returns (`Rendering`), and the rules it obeys.

An image is divided into tiles of 16×16 pixels, from the left to the right and from the top to the
bottom. A caller can limit a rendering to some tiles.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians

ALPHA_MAX = 0.999  # largest alpha of a Gaussian in a pixel, as in gsplat 1.5
ALPHA_MIN = 1.0 / 255.0  # a Gaussian is skipped where its alpha is smaller
TRANSMITTANCE_STOP = 1e-4  # a pixel is full once its transmittance would fall to this
# The near plane, in front of which nothing is drawn, as a fraction of the depth within which the
# nearest 1 % of a view's Gaussians lie. It only keeps projections finite: with a rare thing 1 m
# away before mountains 9 km away, it must still be nearer than both.
NEAR_PLANE_RATIO = 1e-4
NEAR_PLANE_QUANTILE = 0.01
NEAR_PLANE_SAMPLES = 4096  # Gaussians from which this depth is estimated
MIN_NEAR_PLANE = 1e-30  # in the scene's unit; the inverse of a depth beyond it is finite
TILE_PX = 16  # pixels along a tile's side


@dataclasses.dataclass(frozen=True)
class Rendering:
    """One view: three images of the same size."""

    rgb: Tensor  # [H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [H, W] expected z, normalised by alpha; 0 where alpha is 0
    alpha: Tensor  # [H, W] accumulated opacity in 0..1

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor]:
        """The three images in field order."""
        return self.rgb, self.depth, self.alpha

    def to(self, device: torch.device) -> Rendering:
        """The images on another device; this object itself if they are there already."""
        if self.rgb.device == device:
            return self
        return Rendering(*(image.to(device) for image in self.tensors))

    def detach(self) -> Rendering:
        """The same values, detached from autograd."""
        return Rendering(*(image.detach() for image in self.tensors))


class Renderer(Protocol):
    """Classic 3D Gaussian splatting: one pass gives colour, expected depth and opacity.

    A class that derives from this one has to set `device` and to define `render`.
    """

    device: torch.device  # where the images are drawn

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        previous_rendering: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them.

        Args:
            gaussians: one set, or several sets that are drawn together as if they were one.
                Gradients reach tensors that require them.
            camera: the view.
            eps2d: added to the diagonal of each projected covariance, in pixels²
                (SHARP: 0, gsplat's default: 0.3).
            tiles: [ceil(H/16), ceil(W/16)] bool: the tiles to draw; None: all tiles. ValueError
                if the shape does not fit.
            previous_rendering: a rendering of this size from which all other tiles are copied;
                None: other tiles are black and empty.
        """

    def render_batch(
        self,
        scenes: Sequence[Sequence[Gaussians]],
        cameras: Sequence[Camera],
        *,
        eps2d: float = 0.0,
        tiles: Sequence[Tensor | None] | None = None,
        previous_renderings: Sequence[Rendering | None] | None = None,
    ) -> list[Rendering]:
        """Draw several views of one size; each has the same bits as if `render` had drawn it alone.

        This implementation draws one view after the other. A GPU renderer draws them together.

        Args:
            scenes: for each view, the sets of Gaussians that it shows.
            cameras: one for each view. ValueError if they differ in width or height.
            eps2d: as for `render`.
            tiles: for each view as for `render`; None: all tiles of all views.
            previous_renderings: for each view as for `render`; None: none for any view.
        """
        common_size(cameras)
        tiles_of_views = tiles or [None] * len(cameras)
        previous_of_views = previous_renderings or [None] * len(cameras)
        views = zip(scenes, cameras, tiles_of_views, previous_of_views, strict=True)
        return [
            self.render(
                sets, camera, eps2d=eps2d, tiles=view_tiles, previous_rendering=previous_rendering
            )
            for sets, camera, view_tiles, previous_rendering in views
        ]


@torch.no_grad()
def near_plane(sets: Sequence[Gaussians], camera: Camera) -> float:
    """The depth z of a view's near plane, in front of which Gaussians are not drawn.

    It is proportional to the depth of the scene, so that a scene in another unit of length looks
    the same. `sets` are all Gaussians of the view.
    """
    # Every n-th Gaussian of all sets, as if they were one.
    count = sum(len(part) for part in sets)
    step = max(1, math.ceil(count / NEAR_PLANE_SAMPLES))
    samples = []
    first_index = 0  # in the set, of its first Gaussian that is sampled
    for part in sets:
        if first_index < len(part):
            samples.append(part.means[first_index::step].to("cpu", torch.float64))
        first_index = (first_index - len(part)) % step
    if not samples:
        return MIN_NEAR_PLANE

    z = camera.to("cpu", torch.float64).to_camera(torch.cat(samples))[:, 2]
    in_front = z[(z > 0) & z.isfinite()]
    if not len(in_front):
        return MIN_NEAR_PLANE
    rank = int(NEAR_PLANE_QUANTILE * (len(in_front) - 1))  # from 0
    depth = float(in_front.kthvalue(rank + 1).values)
    return max(MIN_NEAR_PLANE, NEAR_PLANE_RATIO * depth)


def as_sets(gaussians: Gaussians | Sequence[Gaussians]) -> list[Gaussians]:
    """A list of sets of Gaussians, from one set or several."""
    if isinstance(gaussians, Gaussians):
        return [gaussians]
    return list(gaussians)


def common_size(cameras: Sequence[Camera]) -> tuple[int, int]:
    """Width and height in pixels that all cameras of a batch share; ValueError if they differ."""
    width, height = cameras[0].width, cameras[0].height
    if any((camera.width, camera.height) != (width, height) for camera in cameras):
        raise ValueError("views that are drawn together must be of one size")
    return width, height


def tile_grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of tiles that cover an image; the last ones may reach beyond it."""
    return math.ceil(height / TILE_PX), math.ceil(width / TILE_PX)


def check_tiles(tiles: Tensor, height: int, width: int) -> None:
    """ValueError if the shape of `tiles` does not fit an image of this size."""
    grid = tile_grid(height, width)
    if tuple(tiles.shape) != grid:
        raise ValueError(
            f"tiles has shape {tuple(tiles.shape)}, expected {grid}: "
            f"one for each {TILE_PX}×{TILE_PX} pixels"
        )


def tile_mask(tiles: Tensor, height: int, width: int) -> Tensor:
    """[H, W] bool: the pixels that belong to the tiles marked in `tiles` [rows, columns] bool.

    A tile has 16×16 pixels; those of the last row and column may reach beyond the image.

    ValueError if the shape of `tiles` does not fit an image of this size.
    """
    check_tiles(tiles, height, width)
    whole_tiles = tiles.repeat_interleave(TILE_PX, 0).repeat_interleave(TILE_PX, 1)
    return whole_tiles[:height, :width]


def paste(rendering: Rendering, tiles: Tensor, previous_rendering: Rendering | None) -> Rendering:
    """Take the pixels of some tiles from one rendering, and all others from another one.

    Args:
        rendering: the source of the pixels in the tiles.
        tiles: [rows, columns] bool, true for the tiles to take.
        previous_rendering: the source of the other pixels; None: they are black and empty.
    """
    mask = tile_mask(tiles, *rendering.alpha.shape)  # [H, W]
    if previous_rendering is None:
        previous_rendering = Rendering(*(torch.zeros_like(image) for image in rendering.tensors))
    return Rendering(
        rgb=torch.where(mask[..., None], rendering.rgb, previous_rendering.rgb),
        depth=torch.where(mask, rendering.depth, previous_rendering.depth),
        alpha=torch.where(mask, rendering.alpha, previous_rendering.alpha),
    )
