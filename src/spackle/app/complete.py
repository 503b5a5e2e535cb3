"""A loaded photo to a completed scene in memory: the base, the views that its holes are filled for, the completion."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.app.video import FrameMaker, PathOptions
from spackle.bases.open import BaseSettings, Choice, open_base
from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, PathError, extremes
from spackle.errors import InputError
from spackle.formats import save_gray_png, save_png, save_video
from spackle.gaussians import Gaussians
from spackle.image import Photo
from spackle.progress import Reporter, Step
from spackle.render import Renderer, get_renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.scene import Mode, ResidualChoice, Scene, complete, open_texture


@dataclasses.dataclass(frozen=True)
class PlannedViews:
    """Views to complete."""

    cameras: list[Camera]
    checked: dict[str, int]  # name → index: views whose holes go into the report
    frames: list[tuple[int, ...]]  # of the video: each a view, or the left eye's and the right eye's
    stills: int  # so many views, the first ones, are drawn as pictures, too
    maker: FrameMaker

    @staticmethod
    def of(path: list[Camera], others: dict[str, Camera], maker: FrameMaker, stills: bool) -> PlannedViews:
        """The views of a path by a frame's eyes, and others to look at. All have holes to fill."""
        middles = path if stills and maker.stereo else []  # the pictures show what is between the eyes
        eyes = [maker.eyes(camera) for camera in path]
        cameras = [*middles, *(eye for pair in eyes for eye in pair), *others.values()]
        first, each = len(middles), len(eyes[0])
        frames = [tuple(range(first + k * each, first + (k + 1) * each)) for k in range(len(path))]
        last = len(cameras) - len(others)
        checked = {name: last + k for k, name in enumerate(others)} or {str(k): k for k in range(len(path))}
        return PlannedViews(cameras, checked, frames, len(path) if stills else 0, maker)


@dataclasses.dataclass(frozen=True)
class CompletedPhoto:
    """What became of a photo."""

    photo: Photo  # at its full size
    prediction: BasePrediction
    choice: Choice
    views: PlannedViews
    scene: Scene  # its disparity is None for given views and keyframes
    seen: dict[int, Tensor]  # pictures of views that completion has drawn as they are, by index
    saved_view: str | None  # in view mode: the view that `scene.aux` belongs to


class PhotoCompleter:
    """Completes photos by one base, residual and renderer; InputError for an option that no photo can use."""

    def __init__(self, base: BaseSettings, residual: ResidualChoice, path: PathOptions, mode: Mode = "scene") -> None:
        base.check()
        path.check()
        self.settings, self.residual, self.path, self.mode = base, residual, path, mode
        self.network = residual.load()
        open_texture(residual.fill)  # fails before long work
        self.given_views, self.keyframes = path.load()
        self.base = open_base(base)
        self.renderer = get_renderer(base.device)

    def complete(self, photo: Photo, reporter: Reporter) -> CompletedPhoto:
        """A photo at its full size to its completed scene; InputError for a photo or depth map that cannot be used."""
        if photo.frame is not None:
            reporter.log(f"{photo.path.name}: {photo.frame.note}; --keep-frame keeps it")
        with reporter.stage("prepare"):
            base = self.base.load(photo, log=reporter.log)
        with reporter.stage("base") as step:
            prediction, choice = base.predict(step)
        disparity = None
        if self.given_views is None and self.keyframes is None:
            disparity = self.path.far(prediction.disparity)
        self._say_base(photo, prediction, choice, disparity, reporter)
        views = self._plan(photo.path, prediction)
        with reporter.stage("complete") as step:
            seen: dict[int, Tensor] = {}
            scene, saved_view = self._fill(prediction, views, seen, step)
            if not scene.aux.finite:
                raise InputError(f"{self.path.cameras or photo.path}: views too extreme to complete: check their K")
        scene = dataclasses.replace(scene, disparity=disparity)
        return CompletedPhoto(photo, prediction, choice, views, scene, seen, saved_view)

    def _say_base(
        self, photo: Photo, prediction: BasePrediction, choice: Choice, disparity: float | None, reporter: Reporter
    ) -> None:
        """Say which base predicted, the focal length, how far the camera goes, and how much depth was filled."""
        name = photo.path.name
        if choice.note:
            reporter.log(f"{name}: {choice.note}")
        reporter.log(
            f"{name}: {len(prediction.gaussians):,} Gaussians from {choice.base}, "
            f"focal length {prediction.camera.focal[0]:.0f} px ({prediction.lens_source or photo.focal_source})"
            + ("" if disparity is None else f", disparity {disparity:g} ({disparity_source(self.path, choice)})")
        )
        if missing := float(prediction.notes.get("depth_filled", 0)):
            reporter.log(f"{name}: {missing:.1%} of the depth was missing and has been filled")
        if self.settings.depth is not None and (size := prediction.notes.get("depth_resampled_from")):
            width, height = prediction.camera.width, prediction.camera.height
            reporter.log(f"{name}: the depth map is {size}, and was resampled to the photo's {width}×{height}")

    def _plan(self, photo: Path, prediction: BasePrediction) -> PlannedViews:
        """The given views; or a path, and where its holes are measured: at its two extremes, or at its keyframes."""
        gaussians, video = prediction.gaussians, self.path.video
        if self.given_views:
            maker = FrameMaker.of(video, gaussians, self.given_views, photo)
            return PlannedViews.of(self.given_views, {}, maker, stills=True)
        try:
            path = self.path.fly(gaussians, prediction.camera, self.keyframes, prediction.disparity)
            others = self._checked(gaussians, prediction.camera.even(), prediction.disparity)
        except PathError as error:
            raise InputError(f"{self.path.path}: {error}") from error
        except ValueError as error:
            raise InputError(f"{photo}: no camera path: {error}: check the depth map and the focal length") from error
        return PlannedViews.of(path, others, FrameMaker.of(video, gaussians, path, photo), stills=False)

    def _checked(self, gaussians: Gaussians, camera: Camera, disparity: float) -> dict[str, Camera]:
        """The views whose holes are reported, by their names."""
        depths, far = DepthRange.of(gaussians), self.path.far(disparity)
        if self.keyframes is None:
            return dict(zip((f"{-far:g}", f"+{far:g}"), extremes(camera, far, depths), strict=True))
        keys = self.keyframes.key_cameras(camera, depths)
        step = math.ceil(len(keys) / 16)  # at most 16 views are measured
        return {f"keyframe {index}": keys[index] for index in range(0, len(keys), step)}

    def _fill(
        self, prediction: BasePrediction, views: PlannedViews, seen: dict[int, Tensor], step: Step
    ) -> tuple[Scene, str | None]:
        """Fill the holes, as the options say; in view mode also says which view the scene's file holds."""
        scene = complete(
            prediction,
            views.cameras,
            mode=self.mode,
            exact=self.given_views is not None,
            network=self.network,
            fill=self.residual.fill,
            renderer=self.renderer,
            precision=self.settings.precision,
            progress=step,
            seen=seen if views.maker.plain else None,
        )
        if scene.by_view is None:
            return scene, None
        # One file holds one view's Gaussians: those of the checked view that is farthest from the photo's.
        eye = prediction.camera.position.double()
        far = {name: float((views.cameras[k].position.double() - eye).norm()) for name, k in views.checked.items()}
        name = max(far, key=lambda name: far[name])
        return dataclasses.replace(scene, aux=scene.by_view[views.checked[name]]), name


def disparity_source(path: PathOptions, choice: Choice) -> str:
    """Who says how far the camera goes."""
    return f"default of {choice.base}" if path.disparity is None else "--disparity"


def save_views_video(
    path: Path, views: PlannedViews, scene: Scene, seen: dict[int, Tensor], renderer: Renderer, step: Step
) -> None:
    """The views of the video's frames, all of one size; InputError for a file that cannot be written."""

    def frames() -> Iterator[Tensor]:
        for index, frame in enumerate(views.frames):
            if frame[0] in seen:
                yield seen[frame[0]]
            else:
                with torch.no_grad():
                    eyes = [renderer.render(scene.of_view(k), views.maker.sized(views.cameras[k])) for k in frame]
                    yield views.maker.frame(eyes)
            step(index + 1, len(views.frames))

    save_video(frames(), path, views.maker.options.rate, views.maker.options.loop)


def picture_files(count: int) -> list[str]:
    """What `save_pictures` writes for so many views."""
    return [f"{index:04d}{kind}.png" for index in range(count) for kind in ("", "_base", "_mask")]


@torch.no_grad()
def save_pictures(folder: Path, views: PlannedViews, scene: Scene, renderer: Renderer, step: Step) -> None:
    """Each given view as PNG: 0000.png completed, 0000_base.png before, 0000_mask.png its holes (white)."""
    for index, camera in enumerate(views.cameras[: views.stills]):
        before = renderer.render(scene.base, camera)
        save_png(renderer.render(scene.of_view(index), camera).rgb, folder / f"{index:04d}.png")
        save_png(before.rgb, folder / f"{index:04d}_base.png")
        save_gray_png(hole_mask(before.alpha).to(torch.float32), folder / f"{index:04d}_mask.png")
        step(index + 1, views.stills)


@torch.no_grad()
def measure_holes(views: PlannedViews, scene: Scene, renderer: Renderer) -> list[dict[str, float | str]]:
    """HAR of the checked views (eq. 11), before and after completion."""
    rows: list[dict[str, float | str]] = []
    for name, index in views.checked.items():
        camera = views.cameras[index]
        before = hole_area_ratio(renderer.render(scene.base, camera).alpha)
        after = hole_area_ratio(renderer.render(scene.of_view(index), camera).alpha)
        rows.append({"view": name, "before": before, "after": after})
    return rows
