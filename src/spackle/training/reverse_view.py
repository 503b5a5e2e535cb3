"""Supervision with real truth and no inpainter: what a virtual camera cannot see of a photo is a hole in the photo."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.training.sample import Sample

TOLERANCE = 0.02  # how far behind what the virtual camera sees a Gaussian may lie and still count as seen, relative


def reverse_view(prediction: BasePrediction, seen: Tensor, photo: Tensor, viewer: Camera, renderer: Renderer) -> Sample:
    """Keep the Gaussians that a virtual camera sees, and look at them from the photo's own camera.

    The holes are true disocclusions between the two, and the photo is the truth in them. So the virtual
    camera plays the part of the photo's, and the photo that of the novel view.

    Args:
        prediction: the photo's Gaussians and camera.
        seen: [N] bool, which of them the virtual camera sees: see `seen_from`.
        photo: [H, W, 3] sRGB at the camera's size.
        viewer: the virtual camera.
        renderer: draws the views.
    """
    camera = prediction.camera
    kept = prediction.gaussians.select(seen)
    rendering = renderer.render(kept, camera)
    return Sample.of(kept, rendering, camera, viewer, photo, torch.ones_like(rendering.alpha, dtype=torch.bool))


def seen_from(gaussians: Gaussians, viewer: Camera, renderer: Renderer) -> Tensor:
    """[N] bool: which Gaussians a camera sees, by the depth that it renders around their centres.

    Around, because a blob is wider than a pixel: at an outline the nearer surface's depth bleeds over
    the farther one, and on steep ground a pixel's depth is behind half of what lies in it.
    """
    depth = renderer.render(gaussians, viewer).depth
    around = max_pool2d(depth[None, None], 3, stride=1, padding=1)[0, 0]
    uv, z = viewer.project(gaussians.means)
    column, row = uv.floor().long().unbind(-1)
    inside = (column >= 0) & (column < viewer.width) & (row >= 0) & (row < viewer.height) & (z > 0)
    at = row.clamp(0, viewer.height - 1), column.clamp(0, viewer.width - 1)
    return inside & ((depth[at] == 0) | (z <= around[at] * (1 + TOLERANCE)))


def with_backing(seen: Tensor, z: Tensor, height: int, width: int) -> Tensor:
    """Which Gaussians of an RGB-D base are seen, a backing one counting as the pixel that it backs.

    A backing Gaussian lies behind its surface on purpose, so its own depth says nothing.

    Args:
        seen: [N] as `seen_from` gives it.
        z: [N] depths in the photo's camera: H·W pixels, then the backing (see `spackle.bases.lift.lift`).
        height: of the photo in pixels.
        width: likewise.
    """
    pixels, rows, columns = height * width, height // 2, width // 2

    def cells(image: Tensor) -> Tensor:
        grid = image[:pixels].reshape(height, width)[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2)
        return grid.transpose(1, 2).reshape(rows * columns, 4)

    backed = cells(z).argmax(-1, keepdim=True)
    return torch.cat([seen[:pixels], cells(seen).gather(-1, backed)[:, 0]])
