"""Which views a prediction is made for, and what they look like once it is done."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.errors import InputError
from spackle.formats import save_gray_png, save_png, save_video
from spackle.gaussians import Gaussians
from spackle.jobs.options import PredictOptions
from spackle.jobs.progress import Step
from spackle.jobs.setup import Tools
from spackle.render import Renderer
from spackle.residual import Completer, hole_area_ratio, hole_mask
from spackle.scene import even_camera, scene_path
from spackle.trajectory import DepthRange, extremes


@dataclasses.dataclass(frozen=True)
class Plan:
    """Views to complete: those to draw come first."""

    cameras: list[Camera]
    drawn: int  # how many of them make the video
    checked: dict[str, int]  # name → index: views whose holes go into the report


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


def make_plan(photo: Path, prediction: BasePrediction, options: PredictOptions, views: list[Camera] | None) -> Plan:
    """The given views, or a path and its two extremes.

    Raises:
        InputError: where depths and focal length allow no path.
    """
    if views:
        return Plan(views, len(views), {str(i): i for i in range(len(views))})
    gaussians, camera = prediction.gaussians, prediction.camera
    try:
        path = scene_path(gaussians, camera, options.trajectory, options.disparity, options.frames)
        sides = extremes(even_camera(camera), options.disparity, DepthRange.of(gaussians))
    except ValueError as error:
        raise InputError(f"{photo}: no camera path: {error}: check the depth map and the focal length") from error
    names = (f"{-options.disparity:g}", f"+{options.disparity:g}")
    return Plan([*path, *sides], len(path), {name: len(path) + k for k, name in enumerate(names)})


def complete(prediction: BasePrediction, plan: Plan, options: PredictOptions, tools: Tools, step: Step) -> Completed:
    """Fill the holes of all planned views, as --mode and --residual say."""
    base = prediction.gaussians
    if tools.residual == "none":
        return Completed(base, Gaussians.empty())
    completer = Completer(base, prediction.camera, tools.renderer, tools.network, precision=options.precision)
    if options.mode == "scene":
        given = options.cameras is not None
        return Completed(base, completer.complete_scene(plan.cameras, exact=given, progress=step))
    shields = [completer.photo_shield()]
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
    cameras = plan.cameras[: plan.drawn]

    def frames() -> Iterator[Tensor]:
        for index, camera in enumerate(cameras):
            with torch.no_grad():
                yield renderer.render(completed.of_view(index), camera).rgb
            step(index + 1, len(cameras))

    save_video(frames(), path)


def view_files(count: int) -> list[str]:
    """What `save_views` writes for so many views."""
    return [f"{index:04d}{kind}.png" for index in range(count) for kind in ("", "_base", "_mask")]


@torch.no_grad()
def save_views(folder: Path, plan: Plan, completed: Completed, renderer: Renderer, step: Step) -> None:
    """Each drawn view as PNG: 0000.png completed, 0000_base.png before, 0000_mask.png its holes (white)."""
    for index, camera in enumerate(plan.cameras[: plan.drawn]):
        before = renderer.render(completed.base, camera)
        save_png(renderer.render(completed.of_view(index), camera).rgb, folder / f"{index:04d}.png")
        save_png(before.rgb, folder / f"{index:04d}_base.png")
        save_gray_png(hole_mask(before.alpha).to(torch.float32), folder / f"{index:04d}_mask.png")
        step(index + 1, plan.drawn)


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
