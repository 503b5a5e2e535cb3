"""`spackle predict clip.mp4`: render each frame from a moving camera, without flicker."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.open import ResolvedBase
from spackle.clips.complete import ClipCompleter, CompletedView
from spackle.clips.files import Clip, clip_frames, read_clip
from spackle.clips.writer import ClipWriter
from spackle.core.focal_length import FocalSource, resolve_focal_length
from spackle.core.photo import Photo, check_photo_size, resize_photo
from spackle.core.trajectories import DEFAULT_OVERSCAN
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

VIDEO_FILE, REPORT_FILE = "video.mp4", "report.json"
RESULT_FILES = (VIDEO_FILE, REPORT_FILE)
# Names of frames, by their number: a folder may hold a depth map for each frame, 000000.npy for
# the first.
FRAME_NAME = "{:06d}"

DEFAULT_PHOTO_OPTIONS = PhotoOptions(lens={})  # those of a command without options


def clip_options(
    scene: PipelineOptions, photo: PhotoOptions, workers: int | None
) -> PipelineOptions:
    """The pipeline's options for a clip.

    Args:
        scene: the options as the user gave them.
        photo: options of reading and writing a photo, most of which do not apply to a clip.
        workers: number of processes that the user wants; None: no wish.

    Raises:
        InputError: an option does not apply to a clip, or OpenCV, which finds the motion, is not
            installed.
    """
    _check_options_suit_clips(scene, photo, workers)
    # Fails if OpenCV is not installed. The text is the beginning of the message.
    OpenCV("a clip, whose motion has to be followed,")
    if scene.fill.fill != "auto":
        return scene

    # For photos, "auto" may choose an inpainter, whose texture would flicker.
    network_fill = dataclasses.replace(scene.fill, fill="network")
    return dataclasses.replace(scene, fill=network_fill)


def _check_options_suit_clips(
    scene: PipelineOptions, photo: PhotoOptions, workers: int | None
) -> None:
    """Raise an InputError for an option that does not apply to a clip.

    `scene` and `photo` are the user's options; `workers` is the number of processes.
    """
    path = scene.path
    unsuitable: list[str] = []  # names of options, in the order of messages
    if path.video.suffix != ".mp4":
        unsuitable.append("format")
    # The result is an mp4 with the clip's own size and frame rate. So of the options of a video,
    # only the format may be given, and it must be mp4.
    default_video = VideoOptions()
    for field in dataclasses.fields(VideoOptions):
        is_given = getattr(path.video, field.name) != getattr(default_video, field.name)
        if is_given and field.name != "format":
            unsuitable.append(field.name)
    if path.cameras is not None:
        unsuitable.append("cameras")
    if path.path is not None:
        unsuitable.append("path")
    if path.seconds is not None:
        unsuitable.append("seconds")
    if scene.fill.mode != "scene":
        unsuitable.append("mode")
    if scene.fill.fill in ("exemplar", "lama"):
        unsuitable.append("fill")
    if photo.gaussian_files != DEFAULT_PHOTO_OPTIONS.gaussian_files:
        unsuitable.append("outputs")
    if photo.depth_out is not None:
        unsuitable.append("depth_out")
    if not photo.render:
        unsuitable.append("no_render")
    if (workers or 1) > 1:
        unsuitable.append("workers")
    if unsuitable:
        raise InputError(
            f"`{unsuitable[0]}`: not for a clip: leave the option out, see docs/clips.md"
        )

    depth = scene.base.depth
    if depth is not None and not (isinstance(depth, Path) and depth.is_dir()):
        raise InputError(
            f"`depth` {depth}: a clip needs a folder of maps: "
            f"{FRAME_NAME.format(0)}.npy for the first frame"
        )


def predict_clip(
    path: Path,
    folder: Path,
    pipeline: Pipeline,
    lens: Mapping[str, float | None],
    reporter: Reporter,
) -> None:
    """Write video.mp4, with as many frames as the clip, and report.json to `folder`.

    Args:
        path: the clip.
        folder: appears with its files once all of them are complete.
        pipeline: the base network, the renderer and the options for a clip.
        lens: `focal_px`, `focal_mm` and `fov`, as the user gave them; None for those not given.
        reporter: shows progress and messages.

    Raises:
        InputError: the clip, a frame, a depth map or the folder cannot be used.
    """
    reporter = reporter.restarted()
    with (
        results_folder(folder, RESULT_FILES, locked=True),
        atomic_files(folder, REPORT_FILE) as new_folder,
    ):
        with reporter.stage("read") as progress:
            clip = read_clip(path, pipeline.options.path.frames, progress)
        frame_predictor = FramePredictor(clip, pipeline, lens, reporter)
        if clip.hdr is not None:
            reporter.log(f"{path.name}: its HDR colours ({clip.hdr}) become sRGB")

        measures: list[FrameMeasures] = []
        video = new_folder / VIDEO_FILE
        with reporter.stage("frames") as progress, ClipWriter(video, clip) as writer:
            for view in frame_predictor.completed_views():
                writer.add(view.rendering.rgb)
                measures.append(FrameMeasures.of(view))
                progress(len(measures), len(clip))
        sound_was_copied = writer.sound_was_copied
        if clip.audio is not None and not sound_was_copied:
            reporter.log(
                f"{path.name}: an mp4 cannot hold the sound ({clip.audio}), which is left out"
            )

        first = frame_predictor.first_frame
        assert first is not None  # a clip has at least one frame
        run = report_run(first.photo, first.prediction, first.base, pipeline, reporter)
        disparity = pipeline.options.path.disparity_or(first.prediction.max_disparity)
        report = run.to_json() | clip_report(clip, measures, disparity, sound_was_copied)
        report["files"] = file_records(new_folder, [video])
        write_json(report, new_folder / REPORT_FILE)

    holes = report["hole_area_ratio"]
    reporter.log(
        f"{path.name}: {len(clip)} frames, holes {holes['before']:.2%} -> {holes['after']:.3%}, "
        f"{report['seconds']['total']:.1f} s -> {folder}"
    )
    reporter.result({"folder": folder, **report})


@dataclasses.dataclass(frozen=True)
class FrameMeasures:
    """What the report says about one frame."""

    hole_ratio_before: float  # share of the view that the frame's own Gaussians leave open
    hole_ratio_after: float
    aux_count: int  # Gaussians that fill holes
    starts_shot: bool  # whether the previous frame belongs to another shot

    @staticmethod
    def of(view: CompletedView) -> FrameMeasures:
        """Measure the completed view of a frame."""
        return FrameMeasures(
            hole_ratio_before=hole_area_ratio(view.base_rendering.alpha),
            hole_ratio_after=hole_area_ratio(view.rendering.alpha),
            aux_count=len(view.aux),
            starts_shot=view.starts_shot,
        )


def clip_report(
    clip: Clip, measures: Sequence[FrameMeasures], disparity: float, sound_was_copied: bool
) -> dict[str, Any]:
    """The fields of a clip's report that a photo's report lacks, or that mean something else there.

    Args:
        clip: the facts about the clip.
        measures: of each frame.
        disparity: the size of the camera's movement.
        sound_was_copied: whether the video has the clip's sound.
    """
    sound = None
    if clip.audio is not None:
        sound = {"codec": clip.audio, "copied": sound_was_copied}
    return {
        "clip": {
            "file": clip.path.name,
            "width": clip.width,
            "height": clip.height,
            "frames": len(clip),
            "fps": round(float(clip.rate), 3),
            "seconds": round(float(clip.seconds), 3),
            "cuts": [index for index, frame in enumerate(measures) if frame.starts_shot],
            "sound": sound,
        },
        "aux": {
            "gaussians": round(fmean(frame.aux_count for frame in measures))
        },  # mean over frames
        "disparity": disparity,
        "hole_area_ratio": {
            "before": fmean(frame.hole_ratio_before for frame in measures),
            "after": fmean(frame.hole_ratio_after for frame in measures),
            "worst_after": max(frame.hole_ratio_after for frame in measures),
        },
    }


@dataclasses.dataclass(frozen=True)
class FirstFrame:
    """What the first frame of a clip decides for all frames: base, disparity and focal length."""

    photo: Photo
    prediction: BasePrediction
    base: ResolvedBase


class FramePredictor:
    """Predicts and completes the frames of a clip, one after the other."""

    first_frame: FirstFrame | None = None  # once it was predicted

    def __init__(
        self,
        clip: Clip,
        pipeline: Pipeline,
        lens: Mapping[str, float | None],
        reporter: Reporter,
    ) -> None:
        """Find the focal length of the clip, and prepare to complete its views.

        `lens` has `focal_px`, `focal_mm` and `fov` as the user gave them, or None.
        """
        options = pipeline.options
        # A base network predicts each frame anew, and relative maps have their own scale in each
        # frame. Measured depth does not flicker, and is not changed.
        depth_may_flicker = options.base.depth is None or options.base.depth_kind in RELATIVE_KINDS
        self._clip = clip
        self._pipeline = pipeline
        self._reporter = reporter
        self._base = pipeline.base
        self._focal = resolve_focal_length(
            clip.path,
            clip.width,
            clip.height,
            exif={},  # a video has none
            **lens,
        )
        # One framing serves all frames of a clip, so it cannot be chosen for one of them.
        overscan = options.path.overscan
        if overscan is None:
            overscan = DEFAULT_OVERSCAN
        self._completer = ClipCompleter(
            trajectory=options.path.trajectory,
            disparity=options.path.disparity,
            frame_count=len(clip),
            renderer=pipeline.renderer,
            flow=OpenCV("a clip").flow,  # the text names what needs OpenCV, should it be missing
            align=depth_may_flicker,
            fill=options.fill.texture != "none",  # "none" leaves all holes open
            network=pipeline.network,
            precision=options.base.precision,
            overscan=overscan,
        )

    def completed_views(self) -> Iterator[CompletedView]:
        """The completed view of each frame; InputError, naming the frame, if one cannot be used."""
        for index, rgb in enumerate(clip_frames(self._clip)):
            yield self._complete_frame(index, rgb)

    def _complete_frame(self, index: int, rgb: Tensor) -> CompletedView:
        """Predict the Gaussians of a frame, and complete its view.

        Args:
            index: the frame's number, from 0.
            rgb: [H, W, 3] sRGB in 0..1.

        Raises:
            InputError: it names the frame, which cannot be predicted or completed.
        """
        focal_px, focal_source = self._focal
        photo = Photo(rgb, focal_px, focal_source, self._clip.path / FRAME_NAME.format(index))
        check_photo_size(photo.width, photo.height, photo.path)
        prediction, base = self._base.predict(photo, log=self._reporter.log)
        if self.first_frame is None:
            prediction = self._take_over(photo, prediction, base)

        try:
            view = self._completer.add(resize_photo(photo).rgb, prediction)
        except ValueError as error:
            raise InputError(
                f"{photo.path}: no camera path: {error}: check depth and focal length"
            ) from error
        if not view.aux.finite:
            raise InputError(
                f"{photo.path}: a view too extreme to complete: give a smaller `disparity`"
            )
        return view

    def _take_over(
        self, photo: Photo, prediction: BasePrediction, base: ResolvedBase
    ) -> BasePrediction:
        """Use base, disparity and focal length of the first frame for all frames, and log them.

        Returns the prediction, with the disparity that was chosen if the user gave none.
        """
        name = self._clip.path.name
        if self._completer.disparity is None:
            prediction = choose_disparity(prediction, self._pipeline.renderer, photo.path)
            self._completer.disparity = prediction.max_disparity
            self._reporter.log(f"{name}: {describe_movement(prediction)}")
        self.first_frame = FirstFrame(photo, prediction, base)
        self._base = self._base.only_chosen(base)

        focal_px = prediction.camera.focal[0]  # at the working size
        # If the base found the focal length (neither the user nor the file gave one), it stays the
        # same for all frames, so that the view does not zoom from frame to frame.
        if prediction.lens_source:
            clip_focal_px = focal_px * self._clip.width / prediction.camera.width
            self._focal = (clip_focal_px, FocalSource.FIRST_FRAME)
        if base.note:
            self._reporter.log(f"{name}: {base.note}")
        self._reporter.log(
            f"{name}: {len(self._clip)} frames, {len(prediction.gaussians):,} Gaussians from "
            f"{base.name} for each, focal length {focal_px:.0f} px "
            f"({prediction.lens_source or photo.focal_source.value})"
        )
        return prediction
