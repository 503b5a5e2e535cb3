"""Complete the view of each of a clip's frames in order, consistent with the depth and colours of the frame before."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, TrajectoryKind, view_at
from spackle.clips.temporal import (
    DepthAlignment,
    Flow,
    FrameMemory,
    align_depth,
    flicker,
    pixel_grid,
    propagate_colors,
    sample,
    track,
)
from spackle.device import Precision
from spackle.gaussians import Gaussians
from spackle.progress import timed
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet, hole_mask
from spackle.scene_fill import FillContext, OcclusionGuard, fill_view

FOLLOW = 0.05  # each frame moves the path's depths by this part towards the frame's own: they arrive in about a second


@dataclasses.dataclass(frozen=True)
class CompletedView:
    """A frame's completed view."""

    camera: Camera
    gaussians: tuple[Gaussians, Gaussians]  # the base's, and aux
    view: Rendering  # of all of them
    before: Rendering  # of the base's alone
    alone: Rendering  # completed without the past
    cut: bool = False  # whether the frame before belongs to another shot
    flicker: dict[str, float] = dataclasses.field(default_factory=dict)  # those of FIGURES that are known

    @property
    def hole(self) -> Tensor:
        """[H, W] bool: pixels that the base does not cover."""
        return hole_mask(self.before.alpha)


# Mean change from the frame before, along the motion found, in sRGB of 0..1: of pixels that both bases cover ("seen"),
# and of pixels that are holes in both, each frame completed by itself ("alone") or as finally drawn ("carried").
FIGURES = ("seen", "alone", "carried")


@dataclasses.dataclass(frozen=True)
class _Past:
    """The state that a frame leaves for the next one."""

    rgb: Tensor  # [H, W, 3] the input
    inverse_depth: Tensor  # [H, W] as the base predicted it, 0 where unknown
    alignment: DepthAlignment
    depths: DepthRange  # the path's
    memory: FrameMemory | None = None
    drawn: CompletedView | None = None


@dataclasses.dataclass
class ClipCompleter:
    """Takes the frames in order and completes the view of each; only the last frame is kept in memory."""

    trajectory: TrajectoryKind
    disparity: float | None  # None: the base's own
    frames: int  # number of frames in the clip, and so on the path
    renderer: Renderer
    flow: Flow
    align: bool = True  # align the base's depth with that of the frame before
    fill: bool = True  # fill holes
    network: ResidualNet | None = None
    precision: Precision = "auto"
    overscan: float = 0.0  # fraction by which the focal length is longer than the photo's
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)  # time spent on each stage
    _past: _Past | None = None
    _count: int = 0

    @torch.no_grad()
    def add(self, rgb: Tensor, prediction: BasePrediction) -> CompletedView:
        """Complete the next frame: `rgb` [H, W, 3], sRGB at the size of the prediction's camera, and its prediction.

        ValueError if depths and focal length allow no path.
        """
        with timed("depth", self.seconds):
            base, guard, now, past = self._aligned(rgb, prediction)
        even = prediction.camera.even()
        disparity = prediction.disparity if self.disparity is None else self.disparity
        camera = view_at(self.trajectory, even, disparity, now.depths, self._count, self.frames)
        camera = camera.zoomed(1 + self.overscan)
        with timed("complete", self.seconds):
            before, aux = self.renderer.render(base, camera), Gaussians.empty()
            alone = before
            if self.fill:
                parts = (base, prediction.camera, self.renderer, self.network)
                # No texture: it would be found anew in each frame, and flicker.
                context = FillContext(*parts, texture=None, precision=self.precision)
                filled = fill_view(context, camera, [guard], before)
                aux, alone = filled.aux, filled.rendering
        drawn, memory = CompletedView(camera, (base, aux), alone, before, alone, cut=past is not self._past), None
        if self.fill:
            with timed("carry", self.seconds):
                memory_before = None if past is None else past.memory
                views = (before, alone)
                aux, memory, flow = propagate_colors(base, aux, camera, self.renderer, views, memory_before, self.flow)
                drawn = dataclasses.replace(drawn, gaussians=(base, aux), view=memory.view)
                if past is not None and past.drawn is not None and flow is not None:
                    drawn = dataclasses.replace(drawn, flicker=_flicker(drawn, past.drawn, flow))
        self._past = dataclasses.replace(now, memory=memory, drawn=drawn)
        self._count += 1
        return drawn

    def _aligned(
        self, rgb: Tensor, prediction: BasePrediction
    ) -> tuple[Gaussians, OcclusionGuard, _Past, _Past | None]:
        """Align the base's depth to the past.

        Returns the aligned base, the frame's occlusion guard, the state to keep, and the past; None after a cut.
        """
        seen = self.renderer.render(prediction.gaussians, prediction.camera)
        known = ~hole_mask(seen.alpha) & (seen.depth > 0)
        inverse_depth = torch.where(known, 1 / seen.depth.clamp_min(1e-6), 0.0)
        past, alignment = self._past, DepthAlignment()
        if past is not None:
            found = track(rgb, past.rgb, self.flow)
            if not found.same_shot():
                past = None
            elif self.align:
                alignment = past.alignment.after(align_depth(inverse_depth, past.inverse_depth, found)).leaked()
        base = alignment.of_gaussians(prediction.gaussians)
        guard = OcclusionGuard.of(dataclasses.replace(seen, depth=alignment.of_depth(seen.depth)), prediction.camera)
        depths = DepthRange.of(base)
        if past is not None:
            depths = past.depths.towards(depths, FOLLOW)
        return base, guard, _Past(rgb, inverse_depth, alignment, depths), past


def _flicker(drawn: CompletedView, earlier: CompletedView, flow: Tensor) -> dict[str, float]:
    """Those of FIGURES that can be measured between this frame and the one before."""
    hole = drawn.hole
    was = sample(earlier.hole[..., None].float(), pixel_grid(flow) + flow)[..., 0]
    both, neither = hole & (was > 0.999), ~hole & (was < 0.001)
    pairs = ((drawn.view, earlier.view, neither), (drawn.alone, earlier.alone, both), (drawn.view, earlier.view, both))
    values = (flicker(one.rgb, other.rgb, flow, chosen) for one, other, chosen in pairs)
    return {name: value for name, value in zip(FIGURES, values, strict=True) if value is not None}
