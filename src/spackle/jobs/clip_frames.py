"""One frame of a clip after the other: its depth held to that before, its holes filled as they were."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterator

import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, TrajectoryKind, view_at
from spackle.device import Precision
from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, ResidualNet, hole_mask
from spackle.residual.occlusion_guard import OcclusionGuard
from spackle.residual.temporal import (
    CompletedFrame,
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

FOLLOW = 0.05  # of the way to a new frame's depths, that is how far the path's go: a second or so to arrive


@dataclasses.dataclass(frozen=True)
class ClipChoices:
    """What stays the same for all frames."""

    trajectory: TrajectoryKind
    disparity: float
    frames: int  # of the clip, and so of the path
    steady: bool = True  # hold the base's depth to that of the frame before
    fill: bool = True  # fill holes
    network: ResidualNet | None = None
    precision: Precision = "auto"


@dataclasses.dataclass(frozen=True)
class Drawn:
    """A frame that is done."""

    camera: Camera
    gaussians: tuple[Gaussians, Gaussians]  # the base's, and aux
    view: Rendering  # of all of them
    before: Rendering  # of the base's
    alone: Rendering  # completed without the past
    cut: bool = False  # nothing of the frame before was found again
    flicker: dict[str, float] = dataclasses.field(default_factory=dict)  # what can be told of FIGURES

    @property
    def hole(self) -> Tensor:
        """[H, W] bool: not covered by the base."""
        return hole_mask(self.before.alpha)


# Mean change from the frame before along the motion found, in sRGB of 0..1: of what both frames show, and of holes in
# both, completed each frame by itself and as drawn.
FIGURES = ("seen", "alone", "carried")


@dataclasses.dataclass(frozen=True)
class _Past:
    """What is kept of a frame for the next one."""

    rgb: Tensor  # [H, W, 3] the input
    inverse_depth: Tensor  # [H, W] as the base said it, 0 where unknown
    stretch: DepthAlignment
    depths: DepthRange  # of the path
    memory: FrameMemory | None = None
    drawn: Drawn | None = None


class ClipCompleter:
    """Takes the frames in their order and completes the view of each; one frame is kept in memory."""

    def __init__(self, choices: ClipChoices, renderer: Renderer, flow: Flow) -> None:
        self.seconds: dict[str, float] = {}
        self._choices, self._renderer, self._flow = choices, renderer, flow
        self._past: _Past | None = None
        self._count = 0

    @torch.no_grad()
    def add(self, rgb: Tensor, prediction: BasePrediction) -> Drawn:
        """The next frame.

        Args:
            rgb: [H, W, 3] sRGB at the size of the prediction's camera.
            prediction: of the frame, in the frame of its camera.

        Raises:
            ValueError: depths and focal length allow no path.
        """
        with self.timed("depth"):
            base, shield, now, past = self._steadied(rgb, prediction)
        choices, even = self._choices, prediction.camera.even()
        camera = view_at(choices.trajectory, even, choices.disparity, now.depths, self._count, choices.frames)
        with self.timed("complete"):
            before, aux = self._renderer.render(base, camera), Gaussians.empty()
            alone = before
            if choices.fill:
                network, precision = choices.network, choices.precision
                completer = Completer(base, prediction.camera, self._renderer, network, precision=precision)
                aux, alone = completer.completed_view(camera, [shield], rendering=before)
        drawn, memory = Drawn(camera, (base, aux), alone, before, alone, cut=past is not self._past), None
        if choices.fill:
            with self.timed("carry"):
                memory_before = None if past is None else past.memory
                frame = propagate_colors(base, aux, camera, self._renderer, (before, alone), memory_before, self._flow)
                drawn, memory = _carried(drawn, frame, past), frame.memory
        self._past = dataclasses.replace(now, memory=memory, drawn=drawn)
        self._count += 1
        return drawn

    @contextlib.contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the block's time to a stage's seconds."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

    def _steadied(
        self, rgb: Tensor, prediction: BasePrediction
    ) -> tuple[Gaussians, OcclusionGuard, _Past, _Past | None]:
        """The base with its depth held to the past, what the photo shows of it, what to keep, and the shot's past."""
        seen = self._renderer.render(prediction.gaussians, prediction.camera)
        known = ~hole_mask(seen.alpha) & (seen.depth > 0)
        inverse_depth = torch.where(known, 1 / seen.depth.clamp_min(1e-6), 0.0)
        past, stretch = self._past, DepthAlignment()
        if past is not None:
            found = track(rgb, past.rgb, self._flow)
            if not found.same_shot():
                past = None
            elif self._choices.steady:
                stretch = past.stretch.after(align_depth(inverse_depth, past.inverse_depth, found)).leaked()
        base = stretch.of_gaussians(prediction.gaussians)
        shield = OcclusionGuard.of(dataclasses.replace(seen, depth=stretch.of_depth(seen.depth)), prediction.camera)
        depths = DepthRange.of(base)
        if past is not None:
            depths = past.depths.towards(depths, FOLLOW)
        return base, shield, _Past(rgb, inverse_depth, stretch, depths), past


def _carried(drawn: Drawn, frame: CompletedFrame, past: _Past | None) -> Drawn:
    """What was drawn, with the colours of the past."""
    drawn = dataclasses.replace(drawn, gaussians=(drawn.gaussians[0], frame.aux), view=frame.view)
    if past is None or past.drawn is None or frame.flow is None:
        return drawn
    earlier, hole = past.drawn, drawn.hole
    was = sample(earlier.hole[..., None].float(), pixel_grid(frame.flow) + frame.flow)[..., 0]
    both, neither = hole & (was > 0.999), ~hole & (was < 0.001)
    pairs = {
        "seen": (drawn.view, earlier.view, neither),
        "alone": (drawn.alone, earlier.alone, both),
        "carried": (drawn.view, earlier.view, both),
    }
    figures = {name: flicker(one.rgb, other.rgb, frame.flow, chosen) for name, (one, other, chosen) in pairs.items()}
    return dataclasses.replace(drawn, flicker={name: value for name, value in figures.items() if value is not None})
