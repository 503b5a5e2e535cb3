"""Render a scene that grows: after Gaussians were added, only the parts of a view that they touch
are redrawn.
"""

from __future__ import annotations

from collections.abc import Sequence

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render import Renderer, touched_tiles
from spackle.render.protocol import Rendering
from spackle.runtime.parallel_kernels import device_for_kernels


class IncrementalRenderer:
    """Holds the base and all Gaussians that were added to it, and the last rendering, on the
    renderer's device.
    """

    def __init__(self, renderer: Renderer, base: Gaussians) -> None:
        """Start with the base alone, and no rendering; `base` is on the renderer's device."""
        self._renderer = renderer
        self._device = renderer.device
        self._result_device = device_for_kernels(renderer.device)
        self._base = base
        self._added: list[Gaussians] = []
        # What was rendered last, which `render_added` updates.
        self._camera: Camera | None = None
        self._last: Rendering | None = None

    def add(self, *gaussians: Gaussians) -> None:
        """Add Gaussians from any device to the scene, without rendering."""
        self._added += [part.to(self._device) for part in gaussians]

    def render(self, camera: Camera, base_rendering: Rendering | None = None) -> Rendering:
        """The scene as a camera sees it, where kernels run: the renderer's device, or the CPU.

        `base_rendering`, if given, is the rendering of the base alone from this camera. Then only
        the parts of the image that added Gaussians touch are drawn.
        """
        self._camera = camera
        if base_rendering is None:
            self._last = self._renderer.render([self._base, *self._added], camera)
            return self._last.to(self._result_device)
        self._last = base_rendering.to(self._device)
        return self._redraw(self._added)

    def render_added(self, gaussians: Gaussians) -> Rendering:
        """Add Gaussians, and return the scene as the last camera sees it."""
        self.add(gaussians)
        return self._redraw([gaussians])

    def _redraw(self, changed: Sequence[Gaussians]) -> Rendering:
        """Draw the tiles of the last view that the Gaussians `changed` touch, and copy all
        others.

        Tiles are squares of pixels that the renderer draws one by one.
        """
        # A view must have been rendered before.
        assert self._camera is not None
        assert self._last is not None
        scene = [self._base, *self._added]
        if self._device.type != "cpu":
            # A GPU draws the whole view in less time than the processor finds the touched tiles.
            self._last = self._renderer.render(scene, self._camera)
            return self._last.to(self._result_device)

        tiles = touched_tiles(changed, self._camera)
        if bool(tiles.any()):
            self._last = self._renderer.render(
                scene, self._camera, tiles=tiles, previous_rendering=self._last
            )
        return self._last.to(self._result_device)
