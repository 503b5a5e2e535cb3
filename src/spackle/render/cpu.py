"""The CPU renderer."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.render.autograd import draw_differentiably
from spackle.render.pipeline import draw, wanted_tiles
from spackle.render.project import KernelCamera
from spackle.render.projection_cache import ProjectionCache
from spackle.render.protocol import Rendering


class CpuRenderer:
    """Classic 3D Gaussian splatting on the CPU; a `Renderer`.

    The last whole drawing is remembered: more sets on top of it, in some tiles, cost those tiles only. Changes that
    PyTorch makes in place are noticed; writes to the same memory through NumPy or `.data` are not.
    """

    def __init__(self) -> None:
        self._memory = ProjectionCache()

    def __reduce__(self) -> tuple[type[CpuRenderer], tuple[()]]:
        """Copies, as other processes get them, remember nothing."""
        return CpuRenderer, ()

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them; see `Renderer.render`. The result is float32."""
        sets = [gaussians] if isinstance(gaussians, Gaussians) else list(gaussians)
        view = KernelCamera.of(camera, eps2d)
        wanted = wanted_tiles(view, tiles)
        onto = onto if tiles is not None else None
        inputs = [t for part in sets for t in part.tensors] + (list(onto.tensors) if onto else [])
        if torch.is_grad_enabled() and any(t.requires_grad for t in inputs):
            return draw_differentiably(sets, view, wanted, onto)
        if tiles is not None:
            redrawn = self._memory.redraw(sets, view, wanted, onto)
            return (redrawn or draw(sets, view, wanted, onto)).canvas.rendering()
        drawing = draw(sets, view, wanted, None)
        self._memory.keep(sets, drawing)
        return drawing.canvas.rendering()
