"""`spackle predict -i clip.mp4`: each frame seen from a camera that moves, its holes filled and calm."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import spackle
from spackle.bases.open import Choice, all_finite
from spackle.bases.protocol import BasePrediction
from spackle.camera_path import spelled
from spackle.errors import InputError
from spackle.formats.clip import Clip, ClipWriter, clip_frames, read_clip
from spackle.image import Photo, focal_length, resize_photo
from spackle.inpaint.opencv import OpenCV
from spackle.jobs.clip_frames import FIGURES, ClipChoices, ClipCompleter, Drawn
from spackle.jobs.options import PredictOptions
from spackle.jobs.report import focal_source, write_report
from spackle.jobs.setup import Tools
from spackle.jobs.video_options import VideoOptions
from spackle.output_folder import results_folder
from spackle.progress import Reporter, Step
from spackle.residual import hole_area_ratio

FILES = ("video.mp4", "report.json")
NOT_FOR_CLIPS = {
    "cameras": ("--cameras", "its camera follows a trajectory, once through the clip"),
    "path": ("--path", "its camera follows a trajectory, once through the clip"),
}
# Frames are named by their numbers, so that a folder may hold a depth map for each: 000000.npy is the first one's.
NAME = "{:06d}"


def check_clip_options(options: PredictOptions) -> None:
    """InputError for an option that a clip has no use for."""
    for field, (option, reason) in NOT_FOR_CLIPS.items():
        if (value := getattr(options, field)) is not None:
            raise InputError(f"{option} {value}: not for a clip: {reason}; leave the option out")
    if options.mode != "scene":
        raise InputError(f"--mode {options.mode}: not for a clip: each of its frames is one view; leave it out")
    if not options.render:
        raise InputError("--no-render: not for a clip: its video is all that there is to write; leave it out")
    if options.depth is not None and not os.path.isdir(options.depth):
        raise InputError(
            f"--depth {options.depth}: a clip takes a folder with a map for each frame: {NAME.format(0)}.npy and so on"
        )
    plain = dataclasses.replace(VideoOptions(), format=options.video.format)
    for choice in dataclasses.fields(plain):
        if getattr(options.video, choice.name) != getattr(plain, choice.name):
            raise InputError(f"--{choice.name}: not for a clip: its video is as the clip is; leave the option out")
    if options.video.suffix != ".mp4":
        raise InputError(
            f"--format {options.video.format}: a clip becomes an mp4, with its sound; leave the option out"
        )
    OpenCV("a clip, whose motion has to be followed,")


def predict_clip(path: Path, folder: Path, options: PredictOptions, tools: Tools, reporter: Reporter) -> None:
    """One clip to `folder`: video.mp4 with as many frames, and report.json.

    Raises:
        InputError: a clip, a frame or a depth map that cannot be used, or a folder that cannot be written to.
    """
    check_clip_options(options)
    seconds: dict[str, float] = {}
    with results_folder(folder, FILES):
        with reporter.stage("read", seconds) as step:
            clip = read_clip(path, options.frames, step)
        lens = focal_length(
            path, clip.width, clip.height, {}, focal_px=options.focal_px, focal_mm=options.focal_mm, fov=options.fov
        )
        if clip.hdr:
            reporter.say(f"{path.name}: its {clip.hdr} colours are taken as they are, so they may look pale")
        run = _Run(clip, lens, options, tools, reporter)
        (folder / "report.json").unlink(missing_ok=True)  # an earlier run's, which vouches for the video
        with reporter.stage("frames", seconds) as step:
            run.write(folder / "video.mp4", step)
        report = run.report(seconds)
        write_report(report, folder / "report.json")
    reporter.say(f"{path.name}: {_summary(report)} -> {folder}")
    reporter.result({"folder": folder, **report})


class _Run:
    """The work on one clip."""

    def __init__(
        self, clip: Clip, lens: tuple[float, str], options: PredictOptions, tools: Tools, reporter: Reporter
    ) -> None:
        self._clip, self._lens, self._options, self._tools, self._reporter = clip, lens, options, tools, reporter
        choices = ClipChoices(
            options.trajectory,
            options.disparity,
            len(clip),
            steady=options.depth is None,  # what was measured is not bent
            fill=tools.residual != "none",
            network=tools.network,
            precision=options.precision,
        )
        self._completer = ClipCompleter(choices, tools.renderer, OpenCV("a clip").flow)
        self._base = tools.opened
        self._first: tuple[Photo, BasePrediction, Choice] | None = None
        self._notes: list[dict[str, Any]] = []
        self._sound = False

    def write(self, path: Path, step: Step) -> None:
        """All frames, one after the other, into a video."""
        frames = clip_frames(self._clip)
        with ClipWriter(path, self._clip) as writer:
            for index in range(len(self._clip)):
                with self._completer.timed("decode"):
                    rgb = next(frames)
                drawn = self._draw(Photo(rgb, *self._lens, self._clip.path / NAME.format(index)))
                with self._completer.timed("encode"):
                    writer.add(drawn.view.rgb)
                self._notes.append(_note(drawn))
                step(index + 1, len(self._clip))
        self._sound = writer.sound
        if self._clip.audio and not self._sound:
            self._reporter.say(
                f"{self._clip.path.name}: its sound ({self._clip.audio}) does not go into an mp4: left out"
            )

    def _draw(self, photo: Photo) -> Drawn:
        """A frame's completed view."""
        with self._completer.timed("base"):
            prediction = self._predict(photo)
        small = resize_photo(photo)
        try:
            drawn = self._completer.add(small.rgb, prediction)
        except ValueError as error:
            raise InputError(f"{photo.path}: no camera path: {error}: check depth and focal length") from error
        if not all_finite(drawn.gaussians[1]):
            raise InputError(f"{photo.path}: a view too extreme to complete: give a smaller --disparity")
        return drawn

    def _predict(self, photo: Photo) -> BasePrediction:
        """A frame's Gaussians, by the base that the first frame got."""
        prediction, choice = self._base.load(photo, log=self._reporter.say).predict()
        if self._first is None:
            self._base, self._first = self._base.only(choice), (photo, prediction, choice)
            name, focal = self._clip.path.name, prediction.camera.focal[0]
            if choice.news:
                self._reporter.say(f"{name}: {choice.news}")
            self._reporter.say(
                f"{name}: {len(self._clip)} frames, {len(prediction.gaussians):,} Gaussians from {choice.base} "
                f"for each, focal length {focal:.0f} px ({focal_source(photo, prediction)})"
            )
        return prediction

    def report(self, seconds: dict[str, float]) -> dict[str, Any]:
        """Counts, holes, flicker and times, ready for JSON."""
        assert self._first is not None
        (photo, prediction, choice), clip, notes = self._first, self._clip, self._notes
        stages = {name: round(value, 3) for name, value in self._completer.seconds.items()}
        before, after = ([note["holes"][side] for note in notes] for side in (0, 1))
        camera = prediction.camera
        report: dict[str, Any] = {
            "spackle": spackle.__version__,
            "clip": {
                "file": clip.path.name,
                "width": clip.width,
                "height": clip.height,
                "frames": len(clip),
                "fps": round(float(clip.rate), 3),
                "seconds": round(float(clip.seconds), 3),
                "cuts": [index for index, note in enumerate(notes) if note["cut"]],
                "sound": {"codec": clip.audio, "copied": self._sound} if clip.audio else None,
            },
            "video": {"width": camera.width + camera.width % 2, "height": camera.height + camera.height % 2},
            "focal_px": round(camera.focal[0], 3),
            "focal_source": focal_source(photo, prediction),
            "base": {"name": choice.base, "chosen": choice.why, "gaussians": len(prediction.gaussians)},
            "residual": {"weights": self._tools.residual},
            "aux": {"gaussians": round(_mean([note["aux"] for note in notes]))},  # for each frame, on the mean
            "views": spelled(self._options.trajectory),
            "disparity": self._options.disparity,
            "hole_area_ratio": {"before": _mean(before), "after": _mean(after), "worst_after": max(after)},
            "flicker": _flicker(notes),
            "seconds": {**seconds, "by_stage": stages, "total": round(sum(seconds.values()), 3)},
        }
        if choice.passed_over:
            report["base"]["passed_over"] = list(choice.passed_over)
        return report


def _note(drawn: Drawn) -> dict[str, Any]:
    """What is remembered of a frame."""
    holes = (hole_area_ratio(drawn.before.alpha), hole_area_ratio(drawn.view.alpha))
    return {"holes": holes, "aux": len(drawn.gaussians[1]), "cut": drawn.cut, **drawn.flicker}


def _flicker(notes: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Means over the frames, in units of 1/255; None where no frame has any."""
    found = {name: [note[name] for note in notes if name in note] for name in FIGURES}
    return {name: round(255 * _mean(values), 3) if values else None for name, values in found.items()}


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _summary(report: dict[str, Any]) -> str:
    """A report in one line."""
    holes, figures, clip = report["hole_area_ratio"], report["flicker"], report["clip"]
    calm = ""
    if figures["carried"] is not None:
        calm = f", flicker in holes {figures['alone']:.1f} -> {figures['carried']:.1f}"
    return (
        f"{clip['frames']} frames, holes {holes['before']:.2%} -> {holes['after']:.3%}{calm}, "
        f"{report['seconds']['total']:.1f} s"
    )
