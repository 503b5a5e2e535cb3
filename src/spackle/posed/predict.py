"""`spackle predict --posed FOLDER`: scene, video and report of several photos with known cameras.

Read `predict_posed_folder` first; `complete_posed` in `scene.py` makes the scene.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import spackle
from spackle.bases.settings import AUTO, BaseSettings
from spackle.formats import save_ply
from spackle.pipeline import FillOptions, Pipeline, PipelineOptions
from spackle.posed.capture import Capture, read_capture
from spackle.posed.kept_predictions import KeptPredictions
from spackle.posed.path import path_seconds
from spackle.posed.scene import PosedScene, complete_posed
from spackle.render import get_renderer
from spackle.results.many_photos import PredictOptions, options_digest, say_if_kernels_compile
from spackle.results.photo_folder import REPORT_NAME, read_earlier_report
from spackle.runtime.digests import file_fingerprint, file_records, json_digest, matches_records
from spackle.runtime.errors import InputError, shorten_input_errors
from spackle.runtime.files import write_atomic, write_json
from spackle.runtime.folders import atomic_files, results_folder
from spackle.runtime.progress import (
    Cancel,
    LogReporter,
    Progress,
    ProgressListener,
    Reporter,
)
from spackle.video.encoding import save_video
from spackle.video.frames import FrameMaker
from spackle.views import MAX_FRAME_COUNT

SCENE_FILE = "scene.ply"
CAMERAS_FILE = "cameras.json"
KEPT_PREFIX = ".predicted-"  # folders of predictions, which are deleted once a scene is complete
DEFAULT_PATH_FRAMES = 120  # of a scene that Python asks for


@shorten_input_errors()
def predict_posed(
    folder: str | os.PathLike[str],
    *,
    base: str = AUTO,
    fill: str = "auto",
    device: str = "auto",
    progress: bool | ProgressListener = False,
    cancel: Cancel | None = None,
) -> PosedScene:
    """Turn a folder of photos with known cameras into one scene without holes between them.

    Args:
        folder: photos and their cameras: a COLMAP folder, transforms.json of nerfstudio, or a
            capture of Record3D or Polycam.
        base: what turns a photo into Gaussians, a name as for `spackle predict --base`. "auto"
            lifts the depth maps beside the photos, if there are any.
        fill: source of the texture in the holes; "none" keeps the holes.
        device: "auto", "cpu" or "cuda".
        progress: True draws a bar on the standard error; a function is called as for `predict`.
        cancel: asks for the end of the work, as for `predict`.

    Raises:
        InputError: the folder, a photo, or a name cannot be used.
        Cancelled: `cancel` has asked for the end.
    """
    options = PipelineOptions(
        base=BaseSettings(name=base, device=device), fill=FillOptions(fill=fill)
    )
    pipeline = Pipeline.open(options)
    return complete_posed(
        read_capture(Path(folder)),
        pipeline,
        LogReporter(progress, cancel),
        frame_count=DEFAULT_PATH_FRAMES,
    )


def predict_posed_folder(
    folder: Path, output: Path, options: PredictOptions, reporter: Reporter
) -> None:
    """Turn a folder of photos with known cameras into scene.ply, video.mp4 and report.json.

    They appear together in a folder of the same name in `output`, once all are complete. If they
    are there already, made from the same files with the same options, nothing is done.

    Args:
        folder: the photos and their cameras.
        output: where the folder of results goes.
        options: of the scene and its files.
        reporter: gets messages, progress and the result.

    Raises:
        InputError: the folder, a photo or an option cannot be used.
    """
    reporter = reporter.restarted()
    _check_options_suit(options)
    capture = read_capture(folder)
    pipeline = options.open_pipeline()
    say_if_kernels_compile(pipeline, reporter)

    results = output / folder.absolute().name
    video_name = f"video{options.scene.path.video.suffix}"
    names = [SCENE_FILE, CAMERAS_FILE, REPORT_NAME]
    if options.photo.render:
        names.append(video_name)
    request = json_digest(
        [options_digest(options), [file_fingerprint(file, "file") for file in capture.source_files]]
    )
    with results_folder(results, names, locked=True):
        if not options.overwrite and _is_done(results, request):
            reporter.log(f"{folder.name}: done already (`overwrite` does it again)")
            reporter.result({"folder": results, "done_already": True})
            return

        # Predictions of another request do not fit this one.
        kept = KeptPredictions(results / f"{KEPT_PREFIX}{request[:16]}")
        try:
            scene = complete_posed(
                capture,
                pipeline,
                reporter,
                frame_count=_frame_count(options, len(capture.photos)),
                kept=kept,
            )
        except InputError:
            kept.remove()  # other points or photos will be another request
            raise
        with atomic_files(results, REPORT_NAME) as new_folder:
            video = _write_files(scene, capture, new_folder, video_name, options, reporter)
            report = _report_of(scene, capture, options, reporter)
            report["video"] = video
            report["request"] = request
            files = sorted(file for file in new_folder.rglob("*") if file.is_file())
            report["files"] = file_records(new_folder, files)
            write_json(report, new_folder / REPORT_NAME)
        for folder_of_kept in results.glob(f"{KEPT_PREFIX}*"):
            KeptPredictions(folder_of_kept).remove()

    before = sum(view.before for view in scene.holes) / len(scene.holes)
    after = sum(view.after for view in scene.holes) / len(scene.holes)
    unit = "metres" if scene.is_metric else f"the unit of {capture.kind}, which need not be a metre"
    reporter.log(f"{folder.name}: its world is that of {capture.kind}, its lengths are {unit}")
    reporter.log(
        f"{folder.name}: {len(scene.base):,} + {len(scene.aux):,} Gaussians, "
        f"holes {before:.2%} -> {after:.3%}, {report['seconds']['total']:.1f} s -> {results}"
    )
    reporter.result({"folder": results, **report})


def _check_options_suit(options: PredictOptions) -> None:
    """Raise an InputError for an option that contradicts photos with known cameras."""
    scene = options.scene
    unsuitable: list[str] = []
    if scene.base.depth is not None:
        unsuitable.append("depth")
    unsuitable += [name for name, value in options.photo.lens.items() if value is not None]
    if scene.path.cameras is not None:
        unsuitable.append("cameras")
    if scene.path.path is not None:
        unsuitable.append("path")
    if scene.fill.mode != "scene":
        unsuitable.append("mode")
    if options.photo.depth_out is not None:
        unsuitable.append("depth_out")
    if options.photo.keep_base:
        unsuitable.append("keep_base")
    if (options.workers or 1) > 1:
        unsuitable.append("workers")
    if options.ray is not None:
        unsuitable.append("ray")
    if unsuitable:
        raise InputError(
            f"`{unsuitable[0]}`: not with `posed`, whose photos and cameras say it: "
            "leave the option out"
        )


def _is_done(results: Path, request: str) -> bool:
    """Whether an earlier run has written all files of the same request."""
    report = read_earlier_report(results)
    return report.get("request") == request and matches_records(
        results, REPORT_NAME, report.get("files")
    )


def _frame_count(options: PredictOptions, photo_count: int) -> int:
    """The number of frames of the video through so many photos and back."""
    path = options.scene.path
    asked = path.requested_frame_count()
    if asked is not None:
        return asked
    frames = round(path_seconds(photo_count) * path.video.frames_per_second)
    return min(MAX_FRAME_COUNT, max(1, frames))


def _write_files(
    scene: PosedScene,
    capture: Capture,
    folder: Path,
    video_name: str,
    options: PredictOptions,
    reporter: Reporter,
) -> dict[str, object] | None:
    """Write scene, cameras and video; returns the report's entry for the video, if there is one."""
    with reporter.stage("write"):
        save_ply(
            scene.gaussians,
            folder / SCENE_FILE,
            camera=scene.camera,
            base_count=len(scene.base),
            is_metric=scene.is_metric,
        )
        cameras = json.dumps(_cameras_json(scene), indent=1)
        write_atomic(folder / CAMERAS_FILE, f"{cameras}\n".encode())
    if not options.photo.render:
        return None

    renderer = get_renderer(options.scene.base.device)
    path = options.scene.path
    maker = FrameMaker.of(
        path.video, scene.base, scene.path, capture.folder, is_metric=scene.is_metric
    )

    def frames(progress: Progress) -> Iterator[Tensor]:
        """Each frame of the video, as the encoder asks for it."""
        for index, camera in enumerate(scene.path):
            frame, _ = maker.render([[scene.base, scene.aux]], camera, renderer)
            yield frame
            progress(index + 1, len(scene.path))

    with reporter.stage("video") as progress:
        video = path.video
        save_video(frames(progress), folder / video_name, video.frames_per_second, video.loop)
    return maker.report_entry(video_name, scene.path[0], len(scene.path))


def _cameras_json(scene: PosedScene) -> list[dict[str, Any]]:
    """The photos' cameras as 3DGS writes them beside a scene, where viewers look for them."""
    entries = []
    for index, (name, camera) in enumerate(scene.cameras.items()):
        focal_x, focal_y = camera.focal
        camera_to_world = torch.linalg.inv(camera.world_to_camera.double())
        entries.append(
            {
                "id": index,
                "img_name": name,
                "width": camera.width,
                "height": camera.height,
                "position": camera_to_world[:3, 3].tolist(),
                "rotation": camera_to_world[:3, :3].tolist(),
                "fx": focal_x,
                "fy": focal_y,
            }
        )
    return entries


def _report_of(
    scene: PosedScene, capture: Capture, options: PredictOptions, reporter: Reporter
) -> dict[str, Any]:
    """The content of report.json, without video, request and files."""
    photos = []
    for photo, kept in zip(scene.photos, scene.union.counts, strict=True):
        photos.append(
            {
                "file": photo.file.path.name,
                "width": photo.camera.width,
                "height": photo.camera.height,
                "focal_px": round(photo.camera.focal[0], 3),
                "base": photo.base_name,
                "gaussians": len(photo.gaussians),
                "kept": kept,
                "depth_from": photo.depth_source,
                "points": photo.point_count,
                "depth_error": round(photo.error, 5),
            }
        )
    seconds = dict(reporter.seconds)
    return {
        "spackle": spackle.__version__,
        "cameras": {"kind": capture.kind, "photos": len(capture.photos)},
        "photos": photos,
        "union": {
            "gaussians": len(scene.base),
            "doubled": scene.union.doubled,
            "contradicted": scene.union.contradicted,
        },
        "residual": {
            "weights": options.scene.fill.weights_name,
            "fill": options.scene.fill.texture,
        },
        "aux": {"gaussians": len(scene.aux), "share": len(scene.aux) / len(scene.base)},
        "merged": len(scene.gaussians),
        "is_metric": scene.is_metric,
        "hole_area_ratio": [dataclasses.asdict(view) for view in scene.holes],
        "seconds": {**seconds, "total": round(sum(seconds.values()), 3)},
    }
