"""The CPU renderer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render.drawing import draw, tiles_to_draw
from spackle.render.gradients import draw_with_gradients
from spackle.render.project import KernelCamera
from spackle.render.protocol import Renderer, Rendering, as_sets, near_plane
from spackle.render.view_colors import as_seen


class CpuRenderer(Renderer):
    """Classic 3D Gaussian splatting on the CPU."""

    device = torch.device("cpu")

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        previous_rendering: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them, in float32.

        Args:
            gaussians: one set, or several sets that are drawn together as if they were one.
                Gradients reach tensors that require them.
            camera: the view.
            eps2d: added to the diagonal of each projected covariance, in pixels².
            tiles: [ceil(H/16), ceil(W/16)] bool: the tiles of 16×16 pixels to draw; None: all.
            previous_rendering: where all other tiles are copied from; None: they are black.
        """
        sets = as_sets(gaussians)
        view = KernelCamera.of(camera, eps2d, near_plane(sets, camera))
        drawn_tiles = tiles_to_draw(view, tiles)
        sets = [as_seen(part, camera) for part in sets]

        # If all tiles are drawn, nothing is left of a previous rendering, not even a gradient.
        background = None if tiles is None else previous_rendering

        inputs = [tensor for part in sets for tensor in part.tensors]
        if background is not None:
            inputs += background.tensors
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in inputs):
            return draw_with_gradients(sets, view, drawn_tiles, background)
        return draw(sets, view, drawn_tiles, background)
