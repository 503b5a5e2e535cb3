"""`spackle predict clip.mp4`: each frame seen from a camera that moves, its depth and its filled holes kept calm."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import spackle
from spackle.bases.open import OpenedBase, ResolvedBase
from spackle.bases.protocol import BasePrediction
from spackle.cli.photo import PredictOptions
from spackle.clips.complete import FIGURES, ClipCompleter, CompletedView
from spackle.clips.files import Clip, ClipWriter, clip_frames, read_clip
from spackle.errors import InputError
from spackle.files import write_json
from spackle.folders import file_records, results_folder, whole_set
from spackle.image import Photo, focal_length, resize_photo
from spackle.inpaint.opencv import OpenCV
from spackle.pipeline import Options, Pipeline
from spackle.progress import Reporter, timed
from spackle.residual import hole_area_ratio
from spackle.views import VideoOptions

FILES = ("video.mp4", "report.json")
# Frames are named by their numbers, so that a folder may hold a depth map for each: 000000.npy is the first one's.
NAME = "{:06d}"


def clip_options(predict: PredictOptions) -> Options:
    """The pipeline's options for a clip; InputError for an option that a clip has no use for."""
    base, path, fill = predict.scene.base, predict.scene.path, predict.scene.fill
    for option, file in (("--cameras", path.cameras), ("--path", path.path)):
        if file is not None:
            raise InputError(
                f"{option} {file}: not for a clip: its camera follows a trajectory, once through the clip; "
                "leave the option out"
            )
    if fill.mode != "scene":
        raise InputError(f"--mode {fill.mode}: not for a clip: each of its frames is one view; leave it out")
    if fill.fill in ("exemplar", "lama"):
        raise InputError(f"--fill {fill.fill}: not for a clip: its texture would flicker; leave it out")
    if not predict.render:
        raise InputError("--no-render: not for a clip: its video is all that there is to write; leave it out")
    if base.depth is not None and not (isinstance(base.depth, Path) and base.depth.is_dir()):
        raise InputError(
            f"--depth {base.depth}: a clip takes a folder with a map for each frame: {NAME.format(0)}.npy and so on"
        )
    video, plain = path.video, VideoOptions(format=path.video.format)
    for choice in dataclasses.fields(plain):
        if getattr(video, choice.name) != getattr(plain, choice.name):
            raise InputError(f"--{choice.name}: not for a clip: its video is as the clip is; leave the option out")
    if video.suffix != ".mp4":
        raise InputError(f"--format {video.format}: a clip becomes an mp4, with its sound; leave the option out")
    for option, value in (("--workers", predict.workers if predict.workers > 1 else None), ("--ray", predict.ray)):
        if value is not None:
            raise InputError(f"{option} {value}: not for a clip: each frame needs the one before; leave it out")
    OpenCV("a clip, whose motion has to be followed,")
    if fill.fill == "auto":  # and no inpainter is opened
        fill = dataclasses.replace(fill, fill="network")
    return dataclasses.replace(predict.scene, fill=fill)


def predict_clip(
    path: Path, folder: Path, pipeline: Pipeline, lens: Mapping[str, float | None], reporter: Reporter
) -> None:
    """One clip to `folder`: video.mp4 with as many frames, and report.json; `lens` as `load_photo` takes it.

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
            align=options.base.depth is None,  # measured depth stays as it is
            fill=options.fill.texture != "none",
            network=pipeline.network,
            precision=options.base.precision,
        )
        focal = focal_length(path, clip.width, clip.height, {}, **lens)
        if clip.hdr:
            reporter.log(f"{path.name}: its {clip.hdr} colours are taken as they are, so they may look pale")
        source, notes = _FirstBase(pipeline.base, clip, reporter), []
        with reporter.stage("frames") as step, ClipWriter(new / FILES[0], clip) as writer:
            frames = clip_frames(clip)
            for index in range(len(clip)):
                with timed("decode", completer.seconds):
                    photo = Photo(next(frames), *focal, path / NAME.format(index))
                with timed("base", completer.seconds):
                    prediction = source.predict(photo)
                view = _complete(completer, photo, prediction)
                with timed("encode", completer.seconds):
                    writer.add(view.view.rgb)
                notes.append(_Note.of(view))
                step(index + 1, len(clip))
        if clip.audio and not writer.sound:
            reporter.log(f"{path.name}: its sound ({clip.audio}) does not go into an mp4: left out")
        report = _report(clip, writer.sound, source, notes, completer.seconds, pipeline, reporter.seconds)
        report["files"] = file_records(new, [new / FILES[0]])
        write_json(report, new / FILES[-1])
    holes, figures = report["hole_area_ratio"], report["flicker"]
    calm = ""
    if figures["carried"] is not None:
        calm = f", flicker in holes {figures['alone']:.1f} -> {figures['carried']:.1f}"
    reporter.log(
        f"{path.name}: {report['clip']['frames']} frames, holes {holes['before']:.2%} -> {holes['after']:.3%}{calm}, "
        f"{report['seconds']['total']:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report})


class _FirstBase:
    """Predicts each frame by the base that the first frame got."""

    def __init__(self, base: OpenedBase, clip: Clip, reporter: Reporter) -> None:
        self._base, self._clip, self._reporter = base, clip, reporter
        self.first: tuple[Photo, BasePrediction, ResolvedBase] | None = None

    def predict(self, photo: Photo) -> BasePrediction:
        """A frame's Gaussians."""
        prediction, choice = self._base.predict(photo, log=self._reporter.log)
        if self.first is None:
            self._base, self.first = self._base.only(choice), (photo, prediction, choice)
            name, focal = self._clip.path.name, prediction.camera.focal[0]
            if choice.note:
                self._reporter.log(f"{name}: {choice.note}")
            self._reporter.log(
                f"{name}: {len(self._clip)} frames, {len(prediction.gaussians):,} Gaussians from {choice.base} "
                f"for each, focal length {focal:.0f} px ({prediction.lens_source or photo.focal_source})"
            )
        return prediction


def _complete(completer: ClipCompleter, photo: Photo, prediction: BasePrediction) -> CompletedView:
    """A frame's completed view; InputError, naming the frame, where it cannot be."""
    try:
        view = completer.add(resize_photo(photo).rgb, prediction)
    except ValueError as error:
        raise InputError(f"{photo.path}: no camera path: {error}: check depth and focal length") from error
    if not view.gaussians[1].finite:
        raise InputError(f"{photo.path}: a view too extreme to complete: give a smaller --disparity")
    return view


@dataclasses.dataclass(frozen=True)
class _Note:
    """What the report needs of a frame, whose pictures are gone by then."""

    before: float  # HAR
    after: float
    aux: int
    cut: bool
    flicker: Mapping[str, float]

    @staticmethod
    def of(view: CompletedView) -> _Note:
        har = hole_area_ratio(view.before.alpha), hole_area_ratio(view.view.alpha)
        return _Note(*har, len(view.gaussians[1]), view.cut, view.flicker)


def _report(
    clip: Clip,
    sound: bool,
    source: _FirstBase,
    notes: Sequence[_Note],
    stages: Mapping[str, float],
    pipeline: Pipeline,
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """Counts, holes, flicker and times, ready for JSON."""
    assert source.first is not None
    photo, prediction, choice = source.first
    path, camera = pipeline.options.path, prediction.camera
    after = [note.after for note in notes]
    flicker = {name: [note.flicker[name] for note in notes if name in note.flicker] for name in FIGURES}
    report: dict[str, Any] = {
        "spackle": spackle.__version__,
        "clip": {
            "file": clip.path.name,
            "width": clip.width,
            "height": clip.height,
            "frames": len(clip),
            "fps": round(float(clip.rate), 3),
            "seconds": round(float(clip.seconds), 3),
            "cuts": [index for index, note in enumerate(notes) if note.cut],
            "sound": {"codec": clip.audio, "copied": sound} if clip.audio else None,
        },
        "video": {"width": camera.width + camera.width % 2, "height": camera.height + camera.height % 2},
        "focal_px": round(camera.focal[0], 3),
        "focal_source": prediction.lens_source or photo.focal_source,
        "base": {"name": choice.base, "chosen": choice.why, "gaussians": len(prediction.gaussians)},
        "residual": {"weights": pipeline.options.fill.weights},
        "aux": {"gaussians": round(_mean([note.aux for note in notes]))},  # the mean over the frames
        "views": path.trajectory,
        "disparity": path.reach(prediction.disparity),
        "disparity_source": pipeline.disparity_source(choice),
        "hole_area_ratio": {
            "before": _mean([note.before for note in notes]),
            "after": _mean(after),
            "worst_after": max(after),
        },
        # In units of 1/255; None where no frame has the figure.
        "flicker": {name: round(255 * _mean(values), 3) if values else None for name, values in flicker.items()},
        "seconds": {
            **seconds,
            "by_stage": {name: round(value, 3) for name, value in stages.items()},
            "total": round(sum(seconds.values()), 3),
        },
    }
    if choice.failures:
        report["base"]["passed_over"] = list(choice.failures)
    return report


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
