"""Which views a prediction is made for, and what they look like once it is done."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, PathError, extremes
from spackle.errors import InputError
from spackle.formats import save_gray_png, save_png, save_video
from spackle.gaussians import Gaussians
from spackle.jobs.film import Film, fly, make_film
from spackle.jobs.options import PredictOptions
from spackle.jobs.setup import Tools
from spackle.progress import Step
from spackle.render import Renderer
from spackle.residual import Completer, hole_area_ratio, hole_mask

MOST_CHECKED = 16  # views at keyframes whose holes are measured


@dataclasses.dataclass(frozen=True)
class Plan:
    """Views to complete."""

    cameras: list[Camera]
    checked: dict[str, int]  # name → index: views whose holes go into the report
    shots: list[tuple[int, ...]]  # the video's frames: each a view, or the left eye's and the right eye's
    stills: int  # so many views, the first ones, are drawn as pictures, too
    film: Film

    @staticmethod
    def of(path: list[Camera], others: dict[str, Camera], film: Film, stills: bool) -> Plan:
        """The views of a path with a film's eyes, and others to look at. All have holes to fill."""
        looks = path if stills and film.stereo else []  # the pictures show what is between the eyes
        eyes = [film.views(camera) for camera in path]
        cameras = [*looks, *(eye for pair in eyes for eye in pair), *others.values()]
        first, each = len(looks), len(eyes[0])
        shots = [tuple(range(first + k * each, first + (k + 1) * each)) for k in range(len(path))]
        last = len(cameras) - len(others)
        checked = {name: last + k for k, name in enumerate(others)} or {str(k): k for k in range(len(path))}
        return Plan(cameras, checked, shots, len(path) if stills else 0, film)


@dataclasses.dataclass(frozen=True)
class Completed:
    """A base and its aux Gaussians: one set for all views of the plan, or one for each."""

    base: Gaussians
    aux: Gaussians  # what scene.ply holds besides the base
    by_view: list[Gaussians] | None = None  # in view mode
    saved_view: str | None = None  # in view mode: the view that `aux` belongs to

    def of_view(self, index: int) -> list[Gaussians]:
        """The sets that a view is drawn with."""
        return [self.base, self.aux if self.by_view is None else self.by_view[index]]


def make_plan(photo: Path, prediction: BasePrediction, options: PredictOptions, tools: Tools) -> Plan:
    """The given views; or a path, and where its holes are measured: at its two extremes, or at its keyframes.

    Raises:
        InputError: where depths and focal length allow no path, or a path file leads nowhere.
    """
    gaussians, camera = prediction.gaussians, prediction.camera
    if tools.views:
        return Plan.of(tools.views, {}, make_film(options.video, gaussians, tools.views, photo), stills=True)
    try:
        path = fly(
            gaussians, camera, tools.path or options.trajectory, options.disparity, options.frames, options.video
        )
        others = _checked(gaussians, camera.even(), options, tools)
    except PathError as error:
        raise InputError(f"{options.path}: {error}") from error
    except ValueError as error:
        raise InputError(f"{photo}: no camera path: {error}: check the depth map and the focal length") from error
    return Plan.of(path, others, make_film(options.video, gaussians, path, photo), stills=False)


def _checked(gaussians: Gaussians, camera: Camera, options: PredictOptions, tools: Tools) -> dict[str, Camera]:
    """The views whose holes are reported, by their names."""
    depths = DepthRange.of(gaussians)
    if tools.path is None:
        names = (f"{-options.disparity:g}", f"+{options.disparity:g}")
        return dict(zip(names, extremes(camera, options.disparity, depths), strict=True))
    keys = tools.path.key_cameras(camera, depths)
    step = math.ceil(len(keys) / MOST_CHECKED)
    return {f"keyframe {index}": keys[index] for index in range(0, len(keys), step)}


def complete(prediction: BasePrediction, plan: Plan, options: PredictOptions, tools: Tools, step: Step) -> Completed:
    """Fill the holes of all planned views, as --mode and --residual say."""
    base = prediction.gaussians
    if tools.residual == "none":
        return Completed(base, Gaussians.empty())
    completer = Completer(base, prediction.camera, tools.renderer, tools.network, precision=options.precision)
    if options.mode == "scene":
        given = options.cameras is not None
        return Completed(base, completer.complete_scene(plan.cameras, exact=given, progress=step))
    shields = [completer.photo_guard()]
    by_view = []
    for index, camera in enumerate(plan.cameras):
        by_view.append(completer.complete_view(camera, shields))
        step(index + 1, len(plan.cameras))
    # One file holds one view's Gaussians: those of the widest view that the report names.
    name, widest = max(plan.checked.items(), key=lambda item: _distance(plan.cameras[item[1]], prediction.camera))
    return Completed(base, by_view[widest], by_view, name)


def _distance(camera: Camera, other: Camera) -> float:
    return float((camera.position.double() - other.position.double()).norm())


def save_plan_video(path: Path, plan: Plan, completed: Completed, renderer: Renderer, step: Step) -> None:
    """The drawn views, all of one size, as a video.

    Raises:
        InputError: a file that cannot be written.
    """
    film = plan.film

    def frames() -> Iterator[Tensor]:
        for index, shot in enumerate(plan.shots):
            with torch.no_grad():
                views = [renderer.render(completed.of_view(k), film.sized(plan.cameras[k])) for k in shot]
                yield film.frame(views)
            step(index + 1, len(plan.shots))

    save_video(frames(), path, film.options.rate, film.options.loop)


def describe_video(plan: Plan, name: str) -> dict[str, object]:
    """What the report says of the video: its file, for there may be others from earlier runs, and what it shows."""
    return plan.film.note(name, [plan.cameras[shot[0]] for shot in plan.shots])


def view_files(count: int) -> list[str]:
    """What `save_views` writes for so many views."""
    return [f"{index:04d}{kind}.png" for index in range(count) for kind in ("", "_base", "_mask")]


@torch.no_grad()
def save_views(folder: Path, plan: Plan, completed: Completed, renderer: Renderer, step: Step) -> None:
    """Each given view as PNG: 0000.png completed, 0000_base.png before, 0000_mask.png its holes (white)."""
    for index, camera in enumerate(plan.cameras[: plan.stills]):
        before = renderer.render(completed.base, camera)
        save_png(renderer.render(completed.of_view(index), camera).rgb, folder / f"{index:04d}.png")
        save_png(before.rgb, folder / f"{index:04d}_base.png")
        save_gray_png(hole_mask(before.alpha).to(torch.float32), folder / f"{index:04d}_mask.png")
        step(index + 1, plan.stills)


@torch.no_grad()
def measure_holes(plan: Plan, completed: Completed, renderer: Renderer) -> list[dict[str, float | str]]:
    """HAR of the checked views, before and after completion."""
    rows: list[dict[str, float | str]] = []
    for name, index in plan.checked.items():
        camera = plan.cameras[index]
        before = hole_area_ratio(renderer.render(completed.base, camera).alpha)
        after = hole_area_ratio(renderer.render(completed.of_view(index), camera).alpha)
        rows.append({"view": name, "before": before, "after": after})
    return rows
