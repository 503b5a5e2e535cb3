"""Complete a view for each frame of a clip, consistent with the previous frame."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.clips.alignment import DepthAlignment, align_depth
from spackle.clips.flow import Flow, track
from spackle.clips.propagation import FrameMemory, propagate_colors
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import DepthRange, TrajectoryKind, trajectory_cameras
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet, hole_mask
from spackle.residual.features import TINY
from spackle.runtime.device import Precision
from spackle.scene_fill import FillContext, OcclusionGuard, fill_view

# In each frame, the path's depth range moves by this part towards the frame's own depth range.
DEPTH_RANGE_FOLLOWING = 0.05


@dataclasses.dataclass(frozen=True)
class CompletedView:
    """The completed view of a frame: the frame's surfaces ("base") and what fills its holes."""

    camera: Camera
    base: Gaussians  # what the frame shows, with aligned depth
    aux: Gaussians  # what fills the view's holes
    rendering: Rendering  # of base and aux Gaussians
    base_rendering: Rendering  # of base Gaussians alone
    independent_rendering: Rendering  # as completed without earlier frames
    starts_shot: bool = False  # whether the previous frame belongs to another shot

    @property
    def hole(self) -> Tensor:
        """[H, W] bool: pixels that the base does not cover."""
        return hole_mask(self.base_rendering.alpha)


@dataclasses.dataclass(frozen=True)
class _FrameState:
    """What the next frame needs to know of a frame."""

    rgb: Tensor  # [H, W, 3] the input, sRGB
    inverse_depth: Tensor  # [H, W] as predicted by the base network, 0 if unknown
    alignment: DepthAlignment  # of the predicted depth
    depth_range: DepthRange  # of the camera's path
    memory: FrameMemory | None = None  # of the completed view; None if holes are not filled


@dataclasses.dataclass(frozen=True)
class _AlignedFrame:
    """A frame whose depth agrees with that of the previous frame."""

    base: Gaussians
    guard: OcclusionGuard  # keeps fillings from hiding what the frame shows
    state: _FrameState  # for the next frame, still without memory
    previous: _FrameState | None  # of the previous frame; None after a cut


@dataclasses.dataclass(kw_only=True)
class ClipCompleter:
    """Completes the views of a clip's frames in order; only one earlier frame is in memory."""

    trajectory: TrajectoryKind
    disparity: float | None  # size of the camera's movement; None: that of each prediction
    frame_count: int  # of the clip: the trajectory has as many cameras
    renderer: Renderer
    flow: Flow  # finds the optical flow between two images
    align: bool = True  # align a frame's depth with the depth of the previous frame
    fill: bool = True  # fill holes
    network: ResidualNet | None = None  # corrects the Gaussians that fill holes
    precision: Precision = "auto"  # of the network
    overscan: float = 0.0  # fraction by which the view's focal length exceeds the photo's
    _previous: _FrameState | None = None
    _completed_frames: int = 0

    @torch.no_grad()
    def add(self, rgb: Tensor, prediction: BasePrediction) -> CompletedView:
        """Complete the view of the next frame.

        Args:
            rgb: [H, W, 3] sRGB of the frame.
            prediction: the frame's Gaussians, from the base network or measured depth.

        Raises:
            ValueError: depths and focal length allow no path.
        """
        frame = self._align(rgb, prediction)
        camera = self._camera(prediction, frame.state.depth_range)
        base_rendering = self.renderer.render(frame.base, camera)
        # If the previous frame belongs to another shot, `_align` has dropped it.
        starts_shot = frame.previous is not self._previous

        if self.fill:
            view, memory = self._fill(frame, prediction, camera, base_rendering)
        else:
            # Holes stay open, so that nothing has to be remembered for the next frame.
            memory = None
            view = CompletedView(
                camera=camera,
                base=frame.base,
                aux=Gaussians.empty(),
                rendering=base_rendering,
                base_rendering=base_rendering,
                independent_rendering=base_rendering,
            )
        self._previous = dataclasses.replace(frame.state, memory=memory)
        self._completed_frames += 1
        return dataclasses.replace(view, starts_shot=starts_shot)

    def _camera(self, prediction: BasePrediction, depth_range: DepthRange) -> Camera:
        """The trajectory's camera for the next frame; ValueError if there is no path.

        The trajectory moves around the photo's camera, over the length of the clip.
        """
        disparity = prediction.max_disparity if self.disparity is None else self.disparity
        cameras = trajectory_cameras(
            self.trajectory,
            prediction.camera.even(),  # videos need even sides
            disparity,
            depth_range,
            self.frame_count,
            only=self._completed_frames,
        )
        # Zooming in keeps the uncovered margins of the photo out of the view.
        return cameras[0].zoomed(1 + self.overscan)

    def _fill(
        self,
        frame: _AlignedFrame,
        prediction: BasePrediction,
        camera: Camera,
        base_rendering: Rendering,
    ) -> tuple[CompletedView, FrameMemory]:
        """Fill the holes of a view, with colours of the previous frame where it shows them.

        Args:
            frame: the frame.
            prediction: of the frame; its Gaussians are not aligned with the previous frame's.
            camera: the view.
            base_rendering: the view of the frame's own Gaussians.

        Returns:
            The completed view, and what the next frame has to know of it.
        """
        # No texture is added, because each frame would find other patches for it, which flickers.
        context = FillContext.of(
            dataclasses.replace(prediction, gaussians=frame.base),
            self.renderer,
            self.network,
            texture=None,
            precision=self.precision,
        )
        # The guard holds the surfaces that the added Gaussians must not hide.
        filled = fill_view(context, camera, [frame.guard], base_rendering)

        # The Gaussians that fill holes ("aux") take colours of the previous frame.
        aux, memory = propagate_colors(
            base=frame.base,
            aux=filled.aux,
            camera=camera,
            renderer=self.renderer,
            renderings=(base_rendering, filled.rendering),
            previous=None if frame.previous is None else frame.previous.memory,
            flow=self.flow,
        )
        view = CompletedView(
            camera=camera,
            base=frame.base,
            aux=aux,
            rendering=memory.rendering,
            base_rendering=base_rendering,
            independent_rendering=filled.rendering,
        )
        return view, memory

    def _align(self, rgb: Tensor, prediction: BasePrediction) -> _AlignedFrame:
        """Align the depth of a frame, [H, W, 3] sRGB, with the previous frame's depth.

        The first frame of a shot keeps its depth. So does every frame if `align` is off.
        """
        photo_rendering = self.renderer.render(prediction.gaussians, prediction.camera)
        depth = photo_rendering.depth
        known = ~hole_mask(photo_rendering.alpha) & (depth > 0)
        inverse_depth = torch.where(known, 1 / depth.clamp_min(TINY), 0.0)  # [H, W]

        previous = self._previous
        alignment = DepthAlignment()
        if previous is not None:
            tracked = track(rgb, previous.rgb, self.flow)
            if not tracked.same_shot():
                previous = None
            elif self.align:
                # First map this frame's depth to the depth that was predicted for the previous
                # frame, then do what aligned that depth. The result is drawn a little to the
                # identity, so that errors do not add up from frame to frame.
                to_previous = align_depth(inverse_depth, previous.inverse_depth, tracked)
                alignment = previous.alignment.after(to_previous).closer_to_identity()

        base = alignment.of_gaussians(prediction.gaussians)
        # The guard keeps Gaussians that fill holes from hiding what the photo shows.
        aligned_rendering = dataclasses.replace(photo_rendering, depth=alignment.of_depth(depth))
        guard = OcclusionGuard.of(aligned_rendering, prediction.camera)

        # The camera's path depends on a range of depths. It follows the range of each frame slowly,
        # so that the camera moves smoothly.
        depth_range = DepthRange.of(base, is_metric=prediction.is_metric)
        if previous is not None:
            depth_range = previous.depth_range.towards(depth_range, DEPTH_RANGE_FOLLOWING)
        state = _FrameState(
            rgb=rgb, inverse_depth=inverse_depth, alignment=alignment, depth_range=depth_range
        )
        return _AlignedFrame(base=base, guard=guard, state=state, previous=previous)
