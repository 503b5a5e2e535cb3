"""What every renderer backend promises."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.rendering import Rendering

ALPHA_MAX = 0.999  # one Gaussian's largest alpha (released gsplat; its main branch has 0.99)
ALPHA_MIN = 1.0 / 255.0  # fainter contributions are skipped
TRANSMITTANCE_STOP = 1e-4  # a pixel is full when less light than this passes
NEAR_PLANE = 0.01  # Gaussians nearer than this are not drawn
TILE = 16  # pixels along a tile's side


class Renderer(Protocol):
    """Classic 3D Gaussian splatting: one pass gives colour, expected depth and opacity."""

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them.

        Args:
            gaussians: one set, or several that are drawn together. Gradients reach the tensors that
                ask for them; a set that asks for none costs none.
            camera: the view.
            eps2d: added to the diagonal of each projected covariance, in pixels² (SHARP: 0,
                gsplat's default: 0.3).
            tiles: [ceil(H/16), ceil(W/16)] bool, the tiles to draw; all where None. No other tile
                is touched.
            onto: where `tiles` is given, the rendering whose other tiles are kept bit for bit; black,
                empty tiles where None.
        """
        ...
