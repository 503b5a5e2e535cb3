"""`spackle predict clip.mp4`: render each frame from a moving camera; depth and filled holes do not flicker."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spackle.bases import BasePrediction
from spackle.bases.depth_map import RELATIVE
from spackle.bases.open import ResolvedBase
from spackle.cli.photo import PredictOptions
from spackle.clips.complete import ClipCompleter, CompletedView
from spackle.clips.files import ClipWriter, clip_frames, read_clip
from spackle.errors import InputError
from spackle.files import file_records, results_folder, whole_set, write_json
from spackle.image import Photo, focal_length, resize_photo
from spackle.inpaint.plain import OpenCV
from spackle.photo_results import shared_report
from spackle.pipeline import Options, Pipeline, move_in_words
from spackle.progress import Reporter, timed
from spackle.residual import hole_area_ratio
from spackle.video_frames import VideoOptions
from spackle.views import choose_move

FILES = ("video.mp4", "report.json")
# Frames are named by their numbers, so that a folder may hold a depth map for each: 000000.npy for the first.
NAME = "{:06d}"


def clip_options(predict: PredictOptions) -> Options:
    """The pipeline's options for a clip; InputError for an option that does not apply to a clip."""
    base, path, fill = predict.scene.base, predict.scene.path, predict.scene.fill
    video, plain = path.video, VideoOptions(format=path.video.format)
    follows = "its camera follows a trajectory, once through the clip"
    unfit: list[tuple[str, object, bool, str]] = [  # option, value, whether it was given, why it is not for a clip
        ("cameras", path.cameras, path.cameras is not None, follows),
        ("path", path.path, path.path is not None, follows),
        ("seconds", path.seconds, path.seconds is not None, "its video is as long; --frames N takes its first N"),
        ("mode", fill.mode, fill.mode != "scene", "each of its frames is one view"),
        ("fill", fill.fill, fill.fill in ("exemplar", "lama"), "its texture would flicker"),
        ("depth-out", predict.depth_out, predict.depth_out is not None, "its video is all that is written"),
        ("no-render", "", not predict.render, "its video is all that is written"),
        *(
            (field.name, "", getattr(video, field.name) != getattr(plain, field.name), "its video follows the clip")
            for field in dataclasses.fields(plain)
        ),
        ("format", video.format, video.suffix != ".mp4", "it becomes an mp4, with its sound"),
        ("workers", predict.workers, predict.workers > 1, "each frame needs the one before"),
    ]
    for option, value, given, why in unfit:
        if given:
            raise InputError(f"{f'--{option} {value}'.strip()}: not for a clip: {why}; leave it out")
    if base.depth is not None and not (isinstance(base.depth, Path) and base.depth.is_dir()):
        raise InputError(
            f"--depth {base.depth}: a clip takes a folder with a map for each frame: {NAME.format(0)}.npy and so on"
        )
    OpenCV("a clip, whose motion has to be followed,")
    if fill.fill == "auto":  # so that no inpainter is opened
        fill = dataclasses.replace(fill, fill="network")
    return dataclasses.replace(predict.scene, fill=fill)


def predict_clip(
    path: Path, folder: Path, pipeline: Pipeline, lens: Mapping[str, float | None], reporter: Reporter
) -> None:
    """Predict one clip into `folder`: video.mp4 with as many frames, and report.json; `lens` as for `load_photo`.

    InputError for a clip, a frame, a depth map or a folder that cannot be used.
    """
    reporter, options = reporter.restarted(), pipeline.options
    with results_folder(folder, FILES, alone=True), whole_set(folder, FILES[-1]) as new:
        with reporter.stage("read") as step:
            clip = read_clip(path, options.path.frames, step)
        completer = ClipCompleter(
            options.path.trajectory,
            options.path.disparity,
            len(clip),
            pipeline.renderer,
            OpenCV("a clip").flow,
            align=options.base.depth is None or options.base.depth_kind in RELATIVE,  # measured depth stays as it is
            fill=options.fill.texture != "none",
            network=pipeline.network,
            precision=options.base.precision,
            overscan=options.path.overscan,
        )
        focal = focal_length(path, clip.width, clip.height, {}, **lens)
        if clip.hdr:
            reporter.log(f"{path.name}: its {clip.hdr} colours are not converted, so they may look pale")
        base, frames = pipeline.base, list[dict[str, Any]]()
        first: tuple[Photo, BasePrediction, ResolvedBase] | None = None
        with reporter.stage("frames") as step, ClipWriter(new / FILES[0], clip) as writer:
            pictures = clip_frames(clip)
            for index in range(len(clip)):
                with timed("decode", completer.seconds):
                    photo = Photo(next(pictures), *focal, path / NAME.format(index))
                photo.check_shape()
                with timed("base", completer.seconds):
                    prediction, choice = base.predict(photo, log=reporter.log)
                if first is None:
                    if completer.disparity is None:  # the first frame's choice holds for all
                        prediction = choose_move(prediction, pipeline.renderer, photo.path)
                        completer.disparity = prediction.disparity
                        reporter.log(f"{path.name}: {move_in_words(prediction)}")
                    first, base = (photo, prediction, choice), base.only(choice)  # it predicts all other frames, too
                    if prediction.lens_source:  # a network's estimate; a clip has one lens, so it holds for all frames
                        seen = prediction.camera.focal[0] * clip.width / prediction.camera.width
                        focal = seen, prediction.lens_source
                    if choice.note:
                        reporter.log(f"{path.name}: {choice.note}")
                    reporter.log(
                        f"{path.name}: {len(clip)} frames, {len(prediction.gaussians):,} Gaussians from {choice.base} "
                        f"for each, focal length {prediction.camera.focal[0]:.0f} px "
                        f"({prediction.lens_source or photo.focal_source})"
                    )
                view = _complete(completer, photo, prediction)
                with timed("encode", completer.seconds):
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
            reporter.log(f"{path.name}: its sound ({clip.audio}) cannot be stored in an mp4 and is left out")
        assert first is not None
        camera = first[1].camera
        report = {
            **shared_report(*first, pipeline, reporter),
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
            "video": {"width": camera.width + camera.width % 2, "height": camera.height + camera.height % 2},
            "aux": {"gaussians": round(_mean([frame["aux"] for frame in frames]))},  # of a frame
            "disparity": options.path.reach(first[1].disparity),
            "hole_area_ratio": {
                "before": _mean([frame["before"] for frame in frames]),
                "after": _mean([frame["after"] for frame in frames]),
                "worst_after": max(frame["after"] for frame in frames),
            },
        }
        report["seconds"]["by_stage"] = {name: round(value, 3) for name, value in completer.seconds.items()}
        report["files"] = file_records(new, [new / FILES[0]])
        write_json(report, new / FILES[-1])
    holes = report["hole_area_ratio"]
    reporter.log(
        f"{path.name}: {len(clip)} frames, holes {holes['before']:.2%} -> {holes['after']:.3%}, "
        f"{report['seconds']['total']:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report})


def _complete(completer: ClipCompleter, photo: Photo, prediction: BasePrediction) -> CompletedView:
    """A frame's completed view; InputError, naming the frame, if this is impossible."""
    try:
        view = completer.add(resize_photo(photo).rgb, prediction)
    except ValueError as error:
        raise InputError(f"{photo.path}: no camera path: {error}: check depth and focal length") from error
    if not view.gaussians[1].finite:
        raise InputError(f"{photo.path}: a view too extreme to complete: give a smaller --disparity")
    return view


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
