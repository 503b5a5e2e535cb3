"""A video's path completed as one scene, beside the same frames rendered and completed each by itself."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, trajectory
from spackle.evaluation.suite.clock import TOTAL, Lap, measure
from spackle.evaluation.suite.values import Found, Row, Target
from spackle.formats import save_video
from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.residual import Completer, ResidualNet

FRAMES = 60
DISPARITY = 0.3
RUNS = 3  # at most
LIFT, COMPLETE, DRAW, ENCODE = "photo and depth to Gaussians", "completion of the path", "frames drawn", "video encoded"
STAGES = (LIFT, COMPLETE, DRAW, ENCODE)
SCENE, SCRATCH = "one scene: photo to video", "frame by frame: photo to video"
EACH, SHIELDS = "frames rendered and completed, each by itself", "the photo's shield, for each of them"
RATIO, RATIO_KEPT = "frame by frame over one scene", "the same, the photo's shield made once"
FASTER = Target(3.0, at_most=False)


def video_section(
    runs: int,
    lift: Callable[[], BasePrediction],
    renderer: Renderer,
    network: ResidualNet | None,
    frames: int = FRAMES,
) -> Found:
    """A photo to an MP4 along `rotate_forward`, in both ways.

    Frame by frame, each is rendered and completed from scratch, and shares nothing with the others but the Gaussians of
    the photo. Lifting and encoding are the same in both ways, and counted in both.

    Args:
        runs: that count; more than three are not done.
        lift: the photo to Gaussians.
        renderer: draws everything.
        network: None: the seeds alone fill the holes.
        frames: of the video.
    """
    runs = min(runs, RUNS)
    prediction = lift()
    path = _path(prediction, frames)
    completer = Completer(prediction.gaussians, prediction.camera, renderer, network)
    made: list[Gaussians] = []

    def scene(lap: Lap) -> None:
        base = lift()
        lap(LIFT)
        fresh = Completer(base.gaussians, base.camera, renderer, network)
        made.append(fresh.complete_scene(path))
        lap(COMPLETE)
        pictures = _draw(base.gaussians, made[-1], path, renderer)
        lap(DRAW)
        _encode(pictures)
        lap(ENCODE)

    def scratch(lap: Lap) -> None:
        for camera in path:
            shield = completer.photo_guard()
            lap(SHIELDS)
            completer.completed_view(camera, [shield])
            lap(EACH)

    times = measure(runs, {"scene": scene, "scratch": scratch})
    scenes, lifts, codes = (np.array(times["scene", stage]) for stage in (TOTAL, LIFT, ENCODE))
    each, shields = (np.array(times["scratch", stage]) for stage in (EACH, SHIELDS))
    anew = lifts + each + shields + codes
    kept = anew - shields * (frames - 1) / frames
    rows = [Row(name, times["scene", name]) for name in STAGES]
    rows += [Row(SCENE, tuple(scenes)), Row(EACH, tuple(each)), Row(SHIELDS, tuple(shields)), Row(SCRATCH, tuple(anew))]
    rows += [Row(RATIO, tuple(anew / scenes), "×", target=FASTER), Row(RATIO_KEPT, tuple(kept / scenes), "×")]
    facts = {
        "gaussians": len(prediction.gaussians),
        "added": len(made[-1]),
        "width": path[0].width,
        "height": path[0].height,
        "frames": frames,
        "disparity": DISPARITY,
    }
    note = "Frame by frame is from scratch, so each frame makes the photo's shield; `--mode view` makes it once."
    return Found(tuple(rows), facts, (note,))


def _path(prediction: BasePrediction, frames: int) -> list[Camera]:
    camera = prediction.camera
    even = camera.even()
    return trajectory("rotate_forward", even, DISPARITY, DepthRange.of(prediction.gaussians), frames)


def _draw(base: Gaussians, aux: Gaussians, path: Sequence[Camera], renderer: Renderer) -> list[Tensor]:
    """[H, W, 3] each; as bytes, so that all of them fit into memory."""
    with torch.no_grad():
        return [(renderer.render([base, aux], camera).rgb * 255).round().to(torch.uint8) for camera in path]


def _encode(pictures: Sequence[Tensor]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        save_video((picture / 255 for picture in pictures), Path(folder) / "video.mp4")
