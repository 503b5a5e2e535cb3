"""`spackle predict clip.mp4`: render each frame from a moving camera; depth and filled holes do not flicker."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean as mean

from spackle.bases import BasePrediction
from spackle.bases.open import ResolvedBase
from spackle.clips.complete import ClipCompleter, CompletedView
from spackle.clips.files import ClipWriter, clip_frames, read_clip
from spackle.core.focal_length import FocalSource, resolve_focal_length
from spackle.core.photo import Photo, check_photo_size, resize_photo
from spackle.depth.units import RELATIVE_KINDS
from spackle.inpaint.plain import OpenCV
from spackle.pipeline import Pipeline, PipelineOptions, describe_movement
from spackle.residual import hole_area_ratio
from spackle.results.photo_folder import PhotoOptions, report_run
from spackle.runtime.digests import file_records
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_json
from spackle.runtime.folders import atomic_files, results_folder
from spackle.runtime.progress import Reporter
from spackle.video.options import VideoOptions
from spackle.views import choose_disparity

RESULT_FILES = ("video.mp4", "report.json")
# Names of frames, by their number: a folder may hold a depth map for each frame, 000000.npy for the first.
FRAME_NAME = "{:06d}"


def clip_options(scene: PipelineOptions, photo: PhotoOptions, workers: int) -> PipelineOptions:
    """The pipeline's options for a clip; InputError for an option that does not apply to a clip."""
    depth, path, fill = scene.base.depth, scene.path, scene.fill
    plain = vars(VideoOptions())
    unfit = {
        **{name: value != plain[name] for name, value in vars(path.video).items()},
        "cameras": path.cameras is not None,
        "path": path.path is not None,
        "seconds": path.seconds is not None,
        "mode": fill.mode != "scene",
        "fill": fill.fill in ("exemplar", "lama"),
        "depth-out": photo.depth_out is not None,
        "no-render": not photo.render,
        "workers": workers > 1,
        "format": path.video.suffix != ".mp4",
    }
    for option, given in unfit.items():
        if given:
            raise InputError(f"--{option}: not for a clip: leave the option out, see docs/clips.md")
    if depth is not None and not (isinstance(depth, Path) and depth.is_dir()):
        raise InputError(
            f"--depth {depth}: a clip needs a folder of maps: {FRAME_NAME.format(0)}.npy for the first frame"
        )
    OpenCV("a clip, whose motion has to be followed,")
    if fill.fill == "auto":  # opens no inpainter
        fill = dataclasses.replace(fill, fill="network")
    return dataclasses.replace(scene, fill=fill)


def predict_clip(
    path: Path,
    folder: Path,
    pipeline: Pipeline,
    lens: Mapping[str, float | None],
    reporter: Reporter,
) -> None:
    """Write video.mp4, with as many frames as the clip, and report.json to `folder`; `lens` as for `load_photo`.

    Raises:
        InputError: the clip, a frame, a depth map or the folder cannot be used.
    """
    reporter, options = reporter.restarted(), pipeline.options
    with (
        results_folder(folder, RESULT_FILES, locked=True),
        atomic_files(folder, RESULT_FILES[-1]) as new,
    ):
        with reporter.stage("read") as step:
            clip = read_clip(path, options.path.frames, step)
        completer = ClipCompleter(
            options.path.trajectory,
            options.path.disparity,
            len(clip),
            pipeline.renderer,
            OpenCV("a clip").flow,
            align=options.base.depth is None
            or options.base.depth_kind in RELATIVE_KINDS,  # measured depth is not changed
            fill=options.fill.texture != "none",
            network=pipeline.network,
            precision=options.base.precision,
            overscan=options.path.overscan,
        )
        focal = resolve_focal_length(path, clip.width, clip.height, {}, **lens)
        if clip.hdr:
            reporter.log(f"{path.name}: the {clip.hdr} colours are not converted and may look pale")
        base, frames = pipeline.base, list[dict[str, float]]()
        first: tuple[Photo, BasePrediction, ResolvedBase] | None = None
        with reporter.stage("frames") as step, ClipWriter(new / RESULT_FILES[0], clip) as writer:
            pictures = clip_frames(clip)
            for index in range(len(clip)):
                photo = Photo(next(pictures), *focal, path / FRAME_NAME.format(index))
                check_photo_size(photo.width, photo.height, photo.path)
                prediction, choice = base.predict(photo, log=reporter.log)
                if first is None:  # its base, disparity and focal length hold for all frames
                    if completer.disparity is None:
                        prediction = choose_disparity(prediction, pipeline.renderer, photo.path)
                        completer.disparity = prediction.max_disparity
                        reporter.log(f"{path.name}: {describe_movement(prediction)}")
                    first, base = (photo, prediction, choice), base.only_chosen(choice)
                    if prediction.lens_source:
                        seen = prediction.camera.focal[0] * clip.width / prediction.camera.width
                        focal = seen, FocalSource.FIRST_FRAME
                    if choice.note:
                        reporter.log(f"{path.name}: {choice.note}")
                    reporter.log(
                        f"{path.name}: {len(clip)} frames, {len(prediction.gaussians):,} Gaussians from {choice.name} "
                        f"for each, focal length {prediction.camera.focal[0]:.0f} px "
                        f"({prediction.lens_source or photo.focal_source.value})"
                    )
                view = _complete(completer, photo, prediction)
                writer.add(view.view.rgb)
                frames.append(
                    {
                        "before": hole_area_ratio(view.before.alpha),
                        "after": hole_area_ratio(view.view.alpha),
                        "aux": len(view.gaussians[1]),
                        "cut": view.cut,
                    }
                )
                step(index + 1, len(clip))
        if clip.audio and not writer.sound:
            reporter.log(
                f"{path.name}: an mp4 cannot hold the sound ({clip.audio}), which is left out"
            )
        assert first is not None
        report = {
            **report_run(*first, pipeline, reporter).to_json(),
            "clip": {
                "file": path.name,
                "width": clip.width,
                "height": clip.height,
                "frames": len(clip),
                "fps": round(float(clip.rate), 3),
                "seconds": round(float(clip.seconds), 3),
                "cuts": [index for index, frame in enumerate(frames) if frame["cut"]],
                "sound": {"codec": clip.audio, "copied": writer.sound} if clip.audio else None,
            },
            "aux": {"gaussians": round(mean(frame["aux"] for frame in frames))},  # of a frame
            "disparity": options.path.disparity_or(first[1].max_disparity),
            "hole_area_ratio": {
                end: mean(frame[end] for frame in frames) for end in ("before", "after")
            }
            | {"worst_after": max(frame["after"] for frame in frames)},
        }
        report["files"] = file_records(new, [new / RESULT_FILES[0]])
        write_json(report, new / RESULT_FILES[-1])
    holes = report["hole_area_ratio"]
    reporter.log(
        f"{path.name}: {len(clip)} frames, holes {holes['before']:.2%} -> {holes['after']:.3%}, "
        f"{report['seconds']['total']:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report})


def _complete(completer: ClipCompleter, photo: Photo, prediction: BasePrediction) -> CompletedView:
    """Complete a frame's view; InputError, naming the frame, if this is impossible."""
    try:
        view = completer.add(resize_photo(photo).rgb, prediction)
    except ValueError as error:
        raise InputError(
            f"{photo.path}: no camera path: {error}: check depth and focal length"
        ) from error
    if not view.gaussians[1].finite:
        raise InputError(
            f"{photo.path}: a view too extreme to complete: give a smaller --disparity"
        )
    return view
