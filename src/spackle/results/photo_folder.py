"""Write a photo's scene, video and report to a folder; used by the command line and the server."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import spackle
from spackle.bases import BasePrediction
from spackle.bases.open import ResolvedBase
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo, load_photo
from spackle.depth.writers import save_depth
from spackle.formats import save_gray_png, save_ply, save_png
from spackle.pipeline import CompletedPhoto, Pipeline
from spackle.render import Renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.runtime.digests import file_records
from spackle.runtime.files import write_json
from spackle.runtime.folders import atomic_files, results_folder
from spackle.runtime.progress import Progress, Reporter
from spackle.video.encoding import save_video

REPORT = "report.json"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhotoOptions:
    """Options of reading a photo, and the files to write; other options belong to the pipeline."""

    lens: Mapping[str, float | None]  # `focal_px`, `focal_mm` and `fov`, as `load_photo` takes them
    render: bool = True  # write a video
    keep_base: bool = False  # write base.ply, the Gaussians of what the photo shows
    depth_out: str | None = None  # write the photo's depth, under this name
    keep_frame: bool = False  # keep a uniform frame around the photo


def predict_photo(
    path: Path,
    folder: Path,
    pipeline: Pipeline,
    reporter: Reporter,
    wanted: PhotoOptions,
    request: str | None = None,
) -> None:
    """Predict one photo into `folder`: scene.ply, report.json, and the files that `wanted` and --cameras add.

    The report stores the digest `request`. The files move to `folder` once all are complete.

    Raises:
        InputError: the photo, its depth map or the folder cannot be used.
    """
    reporter, options = reporter.restarted(), pipeline.options
    with reporter.stage("load"):
        photo = load_photo(
            path, keep_frame=wanted.keep_frame or options.give_geometry, **wanted.lens
        )
    video_file = f"video{options.path.video.suffix}"
    with contextlib.ExitStack() as folders:
        files = (
            ["base.ply"] * wanted.keep_base + ["scene.ply", REPORT] + [video_file] * wanted.render
        )
        files += [wanted.depth_out] if wanted.depth_out else []
        folders.enter_context(results_folder(folder, files, locked=True))
        stills = range(len(pipeline.given_views or []))
        if stills:
            pictures = [
                f"{index:04d}{kind}.png" for index in stills for kind in ("", "_base", "_mask")
            ]
            folders.enter_context(results_folder(folder / "views", pictures))
        done = pipeline.complete(photo, reporter)
        scene, views = done.scene, done.views
        new = folders.enter_context(atomic_files(folder, REPORT))
        with reporter.stage("write"):
            parts = {"scene.ply": scene.gaussians} | (
                {"base.ply": scene.base} if wanted.keep_base else {}
            )
            for file, part in parts.items():
                save_ply(
                    part,
                    new / file,
                    camera=scene.camera,
                    base_count=len(scene.base),
                    disparity=scene.disparity,
                )
            if wanted.depth_out is not None:
                save_depth(scene.depth_map(pipeline.renderer), new / wanted.depth_out)
        video = None
        if wanted.render:
            video = views.frame_maker.report_entry(
                video_file, views.cameras[views.frames[0][0]], len(views.frames)
            )
            with reporter.stage("video") as step:
                save_views(done, new / video_file, pipeline.renderer, step)
        if stills:
            (new / "views").mkdir()
            with reporter.stage("views") as step:
                _save_pictures(done, new / "views", pipeline.renderer, step)
        with reporter.stage("measure"):
            holes = _measure_holes(done, pipeline.renderer)
        report = {
            **shared_report(photo, done.prediction, done.choice, pipeline, reporter),
            "merged": len(scene.gaussians),
            "mode": options.fill.mode,
            "disparity": scene.disparity,
            "video": video,
            "hole_area_ratio": holes,
            "request": request
            if done.choice.lasting
            else None,  # None: the next run predicts the photo again
        }
        size = {"width": scene.camera.width, "height": scene.camera.height}
        frame = {} if photo.frame is None else {"frame_cut_off": photo.frame._asdict()}
        report["photo"] = {"file": path.name, **size, **frame}
        report["base"] |= done.prediction.notes
        report["residual"]["fill"] = options.fill.texture
        report["aux"] = {"gaussians": len(scene.aux), "share": len(scene.aux) / len(scene.base)}
        if done.saved_view is not None:
            report["scene_ply_view"] = (
                done.saved_view
            )  # the view whose aux Gaussians scene.ply holds
        report["files"] = file_records(
            new, sorted(file for file in new.rglob("*") if file.is_file())
        )
        write_json(report, new / REPORT)
    before, after = (sum(view[key] for view in holes) / len(holes) for key in ("before", "after"))
    reporter.log(
        f"{path.name}: {len(scene.aux):,} aux Gaussians ({report['aux']['share']:.1%} of the base's number, "
        f"residual weights: {report['residual']['weights']}), holes {before:.2%} -> {after:.3%}, "
        f"{report['seconds']['total']:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report})


def save_views(done: CompletedPhoto, path: Path, renderer: Renderer, step: Progress) -> None:
    """Write the planned views, which have one size, as a video; InputError if the file cannot be written."""
    views, video = done.views, done.views.frame_maker.options

    def frames() -> Iterator[Tensor]:
        for index, frame in enumerate(views.frames):
            if frame[0] in done.pictures:
                yield done.pictures[frame[0]]
            else:
                with torch.no_grad():
                    eyes = [
                        renderer.render(
                            done.scene.of_view(k),
                            views.frame_maker.resized_camera(views.cameras[k]),
                        )
                        for k in frame
                    ]
                    yield views.frame_maker.frame(eyes)
            step(index + 1, len(views.frames))

    save_video(frames(), path, video.frames_per_second, video.loop)


@torch.no_grad()
def _save_pictures(done: CompletedPhoto, folder: Path, renderer: Renderer, step: Progress) -> None:
    """Write each given view as PNG: 0000.png completed, 0000_base.png before, 0000_mask.png its holes (white)."""
    for index, camera in enumerate(done.views.cameras[: done.views.still_count]):
        before = renderer.render(done.scene.base, camera)
        save_png(
            renderer.render(done.scene.of_view(index), camera).rgb, folder / f"{index:04d}.png"
        )
        save_png(before.rgb, folder / f"{index:04d}_base.png")
        save_gray_png(hole_mask(before.alpha).to(torch.float32), folder / f"{index:04d}_mask.png")
        step(index + 1, done.views.still_count)


@torch.no_grad()
def _measure_holes(done: CompletedPhoto, renderer: Renderer) -> list[dict[str, Any]]:
    """Measure HAR (eq. 11) of each measured view, before and after completion."""

    def har(gaussians: list[Gaussians], view: int) -> float:
        return hole_area_ratio(renderer.render(gaussians, done.views.cameras[view]).alpha)

    return [
        {
            "view": name,
            "before": har([done.scene.base], index),
            "after": har(done.scene.of_view(index), index),
        }
        for name, index in done.views.measured.items()
    ]


def shared_report(
    photo: Photo,
    prediction: BasePrediction,
    choice: ResolvedBase,
    pipeline: Pipeline,
    reporter: Reporter,
) -> dict[str, Any]:
    """The fields that reports of photos and of clips have in common, ready for JSON."""
    path, weights = pipeline.options.path, pipeline.options.fill.weights
    given = path.cameras or path.path
    report: dict[str, Any] = {
        "spackle": spackle.__version__,
        "focal_px": round(prediction.camera.focal[0], 3),
        "focal_source": prediction.lens_source or photo.focal_source.value,
        "base": {
            "name": choice.name,
            "chosen": choice.reason,
            "gaussians": len(prediction.gaussians),
        },
        "residual": {"weights": weights},
        "views": given.name if given else path.trajectory,
        "disparity_source": None if given else "photo" if path.disparity is None else "--disparity",
        "seconds": {**reporter.seconds, "total": round(sum(reporter.seconds.values()), 3)},
    }
    if choice.failures:
        report["base"]["passed_over"] = list(choice.failures)
    return report


def earlier_report(folder: Path) -> dict[str, Any]:
    """The report of an earlier run; empty if the report is missing or damaged."""
    try:
        report = json.loads((folder / REPORT).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return report if isinstance(report, dict) else {}
