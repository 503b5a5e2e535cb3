"""What a fill starts from: the base of a photo, the renderer, the network, the texture, and all
other settings.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import math

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import NEAR_QUANTILE
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual.completion import CellChoice, view_type_of
from spackle.residual.features import MASK_THRESHOLD
from spackle.residual.network import ResidualNet
from spackle.runtime.device import Precision
from spackle.scene_fill.occlusion_guard import OcclusionGuard
from spackle.scene_fill.texture import Texture, exemplar_texture
from spackle.scene_fill.view_completion import SceneViewCompletion


class PhotoRendering:
    """Renders a base from its photo's camera, and keeps the rendering until another one is asked
    for.
    """

    def __init__(self) -> None:
        self._inputs: tuple[Renderer, Gaussians, Camera] | None = None
        self._rendering: Rendering | None = None

    def render(self, renderer: Renderer, base: Gaussians, photo_camera: Camera) -> Rendering:
        """The base rendered from the photo's camera, or the same rendering as last time.

        It is rendered anew only if one of the three arguments is another object than last time.
        """
        inputs = (renderer, base, photo_camera)
        is_same = self._inputs is not None and all(
            new is last for new, last in zip(inputs, self._inputs, strict=True)
        )
        if self._rendering is None or not is_same:
            self._rendering = renderer.render(base, photo_camera)
            self._inputs = inputs
        return self._rendering


@dataclasses.dataclass(frozen=True)
class FillContext:
    """The base of a photo (its Gaussians, with holes in other views), and all settings for filling
    these holes.
    """

    base: Gaussians
    photo_camera: Camera
    renderer: Renderer
    network: ResidualNet | None = None  # None: the initial Gaussians are not changed
    # None: Gaussians keep the colours of the network, or of the initial Gaussians
    texture: Texture | None = exemplar_texture
    threshold: float = MASK_THRESHOLD  # pixels with a lower opacity are holes
    # Of the network; auto is bfloat16 if the hardware multiplies it natively.
    precision: Precision = "auto"
    # [H, W, 3] sRGB of the size of `photo_camera`: I of eq. 5, for a network that names the input
    # "photo". None, if the Gaussians came without their photo: their rendering stands in.
    photo: Tensor | None = dataclasses.field(default=None, repr=False, compare=False)
    # Shared by all contexts that `dataclasses.replace` makes of this one, so that none renders the
    # photo again.
    photo_cache: PhotoRendering = dataclasses.field(
        default_factory=PhotoRendering, repr=False, compare=False
    )

    @staticmethod
    def of(
        prediction: BasePrediction,
        renderer: Renderer,
        network: ResidualNet | None = None,
        *,
        texture: Texture | None = exemplar_texture,
        precision: Precision = "auto",
    ) -> FillContext:
        """The context of a base's prediction, with the photo that the base got; see the fields."""
        return FillContext(
            base=prediction.gaussians,
            photo_camera=prediction.camera,
            renderer=renderer,
            network=network,
            texture=texture,
            precision=precision,
            photo=prediction.photo,
        )

    @functools.cached_property
    def on_renderer_device(self) -> FillContext:
        """The same context, with base and network on the renderer's device."""
        device = self.renderer.device
        if self.base.means.device.type == device.type:
            return self

        # `to` moves a torch module in place. The caller's network must stay where it is, so a copy
        # is moved.
        network = None if self.network is None else copy.deepcopy(self.network).to(device)
        return dataclasses.replace(self, base=self.base.to(device), network=network)

    @property
    def photo_rendering(self) -> Rendering:
        """The base rendered from the photo's camera, on the renderer's device."""
        base = self.on_renderer_device.base
        return self.photo_cache.render(self.renderer, base, self.photo_camera)

    @property
    def near_depth(self) -> float:
        """Depth of the nearest surfaces that the photo shows, in the scene's unit.

        It is the same small quantile that camera paths use (z_near); 1 if the photo shows nothing.
        """
        rendering = self.photo_rendering
        visible_depth = rendering.depth[rendering.alpha >= self.threshold]
        if not len(visible_depth):
            return 1.0

        # Torch's `quantile` takes at most 2²⁴ numbers, and NumPy's would need them on the host. So
        # the quantile is interpolated between the two depths around it, counted from 1.
        position = 1 + NEAR_QUANTILE * (len(visible_depth) - 1)
        below = float(visible_depth.kthvalue(math.floor(position)).values)
        above = float(visible_depth.kthvalue(math.ceil(position)).values)
        return below + (position - math.floor(position)) * (above - below)

    @property
    def without_network(self) -> FillContext:
        """The same context, without network and texture: the initial Gaussians alone fill the
        holes.
        """
        return dataclasses.replace(self, network=None, texture=None)

    def photo_guard(self) -> OcclusionGuard:
        """The surfaces that the photo shows, in front of which no new Gaussian may lie."""
        return OcclusionGuard.of(self.photo_rendering, self.photo_camera, self.threshold)

    @torch.no_grad()
    def complete_as_paper(
        self,
        camera: Camera,
        base_rendering: Rendering | None = None,
        *,
        cells: CellChoice = "masked",
    ) -> Gaussians:
        """The Gaussians that fill the holes of one view by the paper's method alone (eqs. 2 to 7).

        There is one pass of the network, and one Gaussian for each chosen cell of 2×2 pixels.
        Texture and guards, which are beyond the paper, have no part in it.

        Args:
            camera: of the view.
            base_rendering: the base as this camera sees it, if already available.
            cells: "masked": the cells whose first pixel is a hole; if these are fewer than 64, the
                64 least opaque cells. "all": every cell, with or without a hole, as in the dense
                row of the paper's table tab:mask_guided_init.
        """
        context = self.on_renderer_device
        if base_rendering is None:
            base_rendering = context.renderer.render(context.base, camera)
        view = context.view(base_rendering, camera)
        chosen_cells = view.chosen_cells(cells)
        # The network's changes to a first guess of a Gaussian for each of these cells.
        deltas = view.deltas(context.network, context.precision, cells=chosen_cells)
        return view.gaussians(chosen_cells, deltas).to(self.base.means.device)

    def view(self, rendering: Rendering, camera: Camera) -> SceneViewCompletion:
        """The object that completes one view; its parts are computed when they are asked for.

        Args:
            rendering: the base, and what was added to it before, as the view's camera sees them.
            camera: of the view.
        """
        # A network that has inputs of its own also states the class that computes them.
        view_type = view_type_of(self.network, SceneViewCompletion)
        if not issubclass(view_type, SceneViewCompletion):
            raise TypeError(f"{view_type.__name__} must be a subclass of SceneViewCompletion")

        def get_photo() -> Tensor:
            """The photo [H, W, 3], sRGB; its rendering, if the Gaussians came without a photo."""
            return self.photo_rendering.rgb if self.photo is None else self.photo

        return view_type(rendering, camera, self.photo_camera, get_photo, self.threshold)
