"""Complete a view for each frame of a clip, consistent with the depth and colours of the previous frame."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.clips.temporal import (
    DepthAlignment,
    Flow,
    FrameMemory,
    align_depth,
    propagate_colors,
    track,
)
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import DepthRange, TrajectoryKind, trajectory_cameras
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet, hole_mask
from spackle.runtime.device import Precision
from spackle.scene_fill import FillContext, OcclusionGuard, fill_view

FOLLOW = (
    0.05  # in each frame, the path's depth range moves by this part towards the frame's depth range
)


@dataclasses.dataclass(frozen=True)
class CompletedView:
    """The completed view of a frame."""

    camera: Camera
    gaussians: tuple[Gaussians, Gaussians]  # base and aux
    view: Rendering  # of base and aux Gaussians
    before: Rendering  # of base Gaussians
    alone: Rendering  # completed without earlier frames
    cut: bool = False  # whether the previous frame belongs to another shot

    @property
    def hole(self) -> Tensor:
        """[H, W] bool: pixels that the base does not cover."""
        return hole_mask(self.before.alpha)


@dataclasses.dataclass(frozen=True)
class _Past:
    """The state of a frame that the next frame needs."""

    rgb: Tensor  # [H, W, 3] the input
    inverse_depth: Tensor  # [H, W] as predicted by the base, 0 if unknown
    alignment: DepthAlignment
    depths: DepthRange  # of the path
    memory: FrameMemory | None = None


@dataclasses.dataclass
class ClipCompleter:
    """Completes the views of frames in order; only one earlier frame is in memory."""

    trajectory: TrajectoryKind
    disparity: float | None  # None: the disparity of each prediction
    frames: int  # number of frames in the clip
    renderer: Renderer
    flow: Flow
    align: bool = True  # align the base's depth with the depth of the previous frame
    fill: bool = True  # fill holes
    network: ResidualNet | None = None
    precision: Precision = "auto"
    overscan: float = 0.0  # fraction by which the view's focal length exceeds the photo's
    _past: _Past | None = None
    _count: int = 0

    @torch.no_grad()
    def add(self, rgb: Tensor, prediction: BasePrediction) -> CompletedView:
        """Complete the next frame, `rgb` [H, W, 3] sRGB, from the base's prediction for this frame.

        ValueError if depths and focal length allow no path.
        """
        base, guard, now, past = self._aligned(rgb, prediction)
        even = prediction.camera.even()
        disparity = prediction.max_disparity if self.disparity is None else self.disparity
        (camera,) = trajectory_cameras(
            self.trajectory, even, disparity, now.depths, self.frames, only=self._count
        )
        camera = camera.zoomed(1 + self.overscan)
        before, aux = self.renderer.render(base, camera), Gaussians.empty()
        alone = before
        if self.fill:
            parts = (base, prediction.camera, self.renderer, self.network)
            # Without texture, which would flicker: each frame would find other patches.
            context = FillContext(*parts, texture=None, precision=self.precision)
            filled = fill_view(context, camera, [guard], before)
            aux, alone = filled.aux, filled.rendering
        drawn, memory = (
            CompletedView(camera, (base, aux), alone, before, alone, cut=past is not self._past),
            None,
        )
        if self.fill:
            memory_before = None if past is None else past.memory
            views = (before, alone)
            aux, memory = propagate_colors(
                base, aux, camera, self.renderer, views, memory_before, self.flow
            )
            drawn = dataclasses.replace(drawn, gaussians=(base, aux), view=memory.view)
        self._past = dataclasses.replace(now, memory=memory)
        self._count += 1
        return drawn

    def _aligned(
        self, rgb: Tensor, prediction: BasePrediction
    ) -> tuple[Gaussians, OcclusionGuard, _Past, _Past | None]:
        """Align the base's depth with the previous frame's depth.

        Returns the aligned base, the photo's occlusion guard, the state for the next frame, and the state of the
        previous frame (None after a cut).
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
                alignment = past.alignment.after(
                    align_depth(inverse_depth, past.inverse_depth, found)
                ).leaked()
        base = alignment.of_gaussians(prediction.gaussians)
        guard = OcclusionGuard.of(
            dataclasses.replace(seen, depth=alignment.of_depth(seen.depth)), prediction.camera
        )
        depths = DepthRange.of(base)
        if past is not None:
            depths = past.depths.towards(depths, FOLLOW)
        return base, guard, _Past(rgb, inverse_depth, alignment, depths), past
