"""`spackle predict clip.mp4`: each frame seen from a camera that moves, its depth and its filled holes kept calm."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import spackle
from spackle.app.complete import PhotoCompleter, disparity_source
from spackle.app.video import PathOptions, VideoOptions
from spackle.bases.open import BaseSettings, Choice
from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, TrajectoryKind, view_at
from spackle.clips.files import Clip, ClipWriter, clip_frames, read_clip
from spackle.clips.temporal import (
    CompletedFrame,
    DepthAlignment,
    Flow,
    FrameMemory,
    align_depth,
    flicker,
    pixel_grid,
    propagate_colors,
    sample,
    track,
)
from spackle.device import Precision
from spackle.errors import InputError
from spackle.files import file_records, results_folder, whole_set, write_json
from spackle.gaussians import Gaussians
from spackle.image import Photo, focal_length, resize_photo
from spackle.inpaint.opencv import OpenCV
from spackle.progress import Reporter, Step, timed
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, ResidualNet, hole_area_ratio, hole_mask
from spackle.residual.occlusion_guard import OcclusionGuard
from spackle.scene import ResidualChoice

FILES = ("video.mp4", "report.json")
# Frames are named by their numbers, so that a folder may hold a depth map for each: 000000.npy is the first one's.
NAME = "{:06d}"
FOLLOW = 0.05  # of the way to a new frame's depths, that is how far the path's go: a second or so to arrive


def check_clip_options(base: BaseSettings, path: PathOptions, residual: ResidualChoice, render: bool) -> None:
    """InputError for an option that a clip has no use for."""
    for option, file in (("--cameras", path.cameras), ("--path", path.path)):
        if file is not None:
            raise InputError(
                f"{option} {file}: not for a clip: its camera follows a trajectory, once through the clip; "
                "leave the option out"
            )
    if residual.mode != "scene":
        raise InputError(f"--mode {residual.mode}: not for a clip: each of its frames is one view; leave it out")
    if residual.wanted in ("exemplar", "lama"):
        raise InputError(f"--fill {residual.wanted}: not for a clip: its texture would flicker; leave it out")
    if not render:
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
    OpenCV("a clip, whose motion has to be followed,")


def predict_clip(
    path: Path, folder: Path, completer: PhotoCompleter, lens: Mapping[str, float | None], reporter: Reporter
) -> None:
    """One clip to `folder`: video.mp4 with as many frames, and report.json; `lens` as `load_photo` takes it.

    InputError for a clip, a frame, a depth map or a folder that cannot be used.
    """
    reporter = reporter.restarted()
    with results_folder(folder, FILES, alone=True), whole_set(folder, FILES[-1]) as new:
        with reporter.stage("read") as step:
            clip = read_clip(path, completer.path.frames, step)
        focal = focal_length(path, clip.width, clip.height, {}, **lens)
        if clip.hdr:
            reporter.log(f"{path.name}: its {clip.hdr} colours are taken as they are, so they may look pale")
        run = _Run(clip, focal, completer, reporter)
        with reporter.stage("frames") as step:
            run.write(new / FILES[0], step)
        report = run.report(reporter.seconds) | {"files": file_records(new, [new / FILES[0]])}
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


class _Run:
    """The work on one clip."""

    def __init__(self, clip: Clip, focal: tuple[float, str], completer: PhotoCompleter, reporter: Reporter) -> None:
        self._clip, self._focal, self._setting, self._reporter = clip, focal, completer, reporter
        self._completer = ClipCompleter(
            completer.path.trajectory,
            completer.path.disparity,
            len(clip),
            completer.renderer,
            OpenCV("a clip").flow,
            align=completer.settings.depth is None,  # measured depth stays as it is
            fill=completer.residual.fill != "none",
            network=completer.network,
            precision=completer.settings.precision,
        )
        self._base = completer.base
        self._first: tuple[Photo, BasePrediction, Choice] | None = None
        self._notes: list[dict[str, Any]] = []
        self._sound = False

    def write(self, path: Path, step: Step) -> None:
        """All frames, one after the other, into a video."""
        frames = clip_frames(self._clip)
        with ClipWriter(path, self._clip) as writer:
            for index in range(len(self._clip)):
                with timed("decode", self._completer.seconds):
                    rgb = next(frames)
                drawn = self._draw(Photo(rgb, *self._focal, self._clip.path / NAME.format(index)))
                with timed("encode", self._completer.seconds):
                    writer.add(drawn.view.rgb)
                holes = (hole_area_ratio(drawn.before.alpha), hole_area_ratio(drawn.view.alpha))
                aux = len(drawn.gaussians[1])
                self._notes.append({"holes": holes, "aux": aux, "cut": drawn.cut, **drawn.flicker})
                step(index + 1, len(self._clip))
        self._sound = writer.sound
        if self._clip.audio and not self._sound:
            self._reporter.log(
                f"{self._clip.path.name}: its sound ({self._clip.audio}) does not go into an mp4: left out"
            )

    def _draw(self, photo: Photo) -> CompletedView:
        """A frame's completed view."""
        with timed("base", self._completer.seconds):
            prediction = self._predict(photo)
        small = resize_photo(photo)
        try:
            drawn = self._completer.add(small.rgb, prediction)
        except ValueError as error:
            raise InputError(f"{photo.path}: no camera path: {error}: check depth and focal length") from error
        if not drawn.gaussians[1].finite:
            raise InputError(f"{photo.path}: a view too extreme to complete: give a smaller --disparity")
        return drawn

    def _predict(self, photo: Photo) -> BasePrediction:
        """A frame's Gaussians, by the base that the first frame got."""
        prediction, choice = self._base.load(photo, log=self._reporter.log).predict()
        if self._first is None:
            self._base, self._first = self._base.only(choice), (photo, prediction, choice)
            name, focal = self._clip.path.name, prediction.camera.focal[0]
            if choice.note:
                self._reporter.log(f"{name}: {choice.note}")
            self._reporter.log(
                f"{name}: {len(self._clip)} frames, {len(prediction.gaussians):,} Gaussians from {choice.base} "
                f"for each, focal length {focal:.0f} px ({prediction.lens_source or photo.focal_source})"
            )
        return prediction

    def report(self, seconds: dict[str, float]) -> dict[str, Any]:
        """Counts, holes, flicker and times, ready for JSON."""
        assert self._first is not None
        (photo, prediction, choice), clip, notes = self._first, self._clip, self._notes
        path = self._setting.path
        stages = {name: round(value, 3) for name, value in self._completer.seconds.items()}
        before, after = ([note["holes"][side] for note in notes] for side in (0, 1))
        found = {name: [note[name] for note in notes if name in note] for name in FIGURES}
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
            "focal_source": prediction.lens_source or photo.focal_source,
            "base": {"name": choice.base, "chosen": choice.why, "gaussians": len(prediction.gaussians)},
            "residual": {"weights": self._setting.residual.weights},
            "aux": {"gaussians": round(_mean([note["aux"] for note in notes]))},  # the mean over the frames
            "views": path.trajectory,
            "disparity": path.far(prediction.disparity),
            "disparity_source": disparity_source(path, choice),
            "hole_area_ratio": {"before": _mean(before), "after": _mean(after), "worst_after": max(after)},
            # In units of 1/255; None where no frame has the figure.
            "flicker": {name: round(255 * _mean(values), 3) if values else None for name, values in found.items()},
            "seconds": {**seconds, "by_stage": stages, "total": round(sum(seconds.values()), 3)},
        }
        if choice.failures:
            report["base"]["passed_over"] = list(choice.failures)
        return report


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


@dataclasses.dataclass(frozen=True)
class CompletedView:
    """The completed view of a frame."""

    camera: Camera
    gaussians: tuple[Gaussians, Gaussians]  # the base's, and aux
    view: Rendering  # of all of them
    before: Rendering  # of the base's
    alone: Rendering  # completed without the past
    cut: bool = False  # nothing of the frame before was found again
    flicker: dict[str, float] = dataclasses.field(default_factory=dict)  # what can be told of FIGURES

    @property
    def hole(self) -> Tensor:
        """[H, W] bool: not covered by the base."""
        return hole_mask(self.before.alpha)


# Mean change from the frame before along the motion found, in sRGB of 0..1: of what both frames show, and of holes in
# both, completed each frame by itself and as drawn.
FIGURES = ("seen", "alone", "carried")


@dataclasses.dataclass(frozen=True)
class _Past:
    """What is kept of a frame for the next one."""

    rgb: Tensor  # [H, W, 3] the input
    inverse_depth: Tensor  # [H, W] as the base said it, 0 where unknown
    alignment: DepthAlignment
    depths: DepthRange  # of the path
    memory: FrameMemory | None = None
    drawn: CompletedView | None = None


@dataclasses.dataclass
class ClipCompleter:
    """Takes the frames in their order and completes the view of each; one frame is kept in memory."""

    trajectory: TrajectoryKind
    disparity: float | None  # as the base has it where None
    frames: int  # of the clip, and so of the path
    renderer: Renderer
    flow: Flow
    align: bool = True  # align the base's depth with that of the frame before
    fill: bool = True  # fill holes
    network: ResidualNet | None = None
    precision: Precision = "auto"
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)  # spent on each stage
    _past: _Past | None = None
    _count: int = 0

    @torch.no_grad()
    def add(self, rgb: Tensor, prediction: BasePrediction) -> CompletedView:
        """The next frame: `rgb` [H, W, 3], sRGB at the size of the prediction's camera, and its prediction.

        ValueError where depths and focal length allow no path.
        """
        with timed("depth", self.seconds):
            base, guard, now, past = self._aligned(rgb, prediction)
        even = prediction.camera.even()
        disparity = prediction.disparity if self.disparity is None else self.disparity
        camera = view_at(self.trajectory, even, disparity, now.depths, self._count, self.frames)
        with timed("complete", self.seconds):
            before, aux = self.renderer.render(base, camera), Gaussians.empty()
            alone = before
            if self.fill:
                parts = (base, prediction.camera, self.renderer, self.network)
                # Texture is found anew in each frame: it would flicker.
                completer = Completer(*parts, texture=None, precision=self.precision)
                aux, alone = completer.completed_view(camera, [guard], rendering=before)
        drawn, memory = CompletedView(camera, (base, aux), alone, before, alone, cut=past is not self._past), None
        if self.fill:
            with timed("carry", self.seconds):
                memory_before = None if past is None else past.memory
                frame = propagate_colors(base, aux, camera, self.renderer, (before, alone), memory_before, self.flow)
                drawn, memory = _carried(drawn, frame, past), frame.memory
        self._past = dataclasses.replace(now, memory=memory, drawn=drawn)
        self._count += 1
        return drawn

    def _aligned(
        self, rgb: Tensor, prediction: BasePrediction
    ) -> tuple[Gaussians, OcclusionGuard, _Past, _Past | None]:
        """The base with its depth aligned to the past, the frame's occlusion guard, what to keep, the shot's past."""
        seen = self.renderer.render(prediction.gaussians, prediction.camera)
        known = ~hole_mask(seen.alpha) & (seen.depth > 0)
        inverse_depth = torch.where(known, 1 / seen.depth.clamp_min(1e-6), 0.0)
        past, alignment = self._past, DepthAlignment()
        if past is not None:
            found = track(rgb, past.rgb, self.flow)
            if not found.same_shot():
                past = None
            elif self.align:
                alignment = past.alignment.after(align_depth(inverse_depth, past.inverse_depth, found)).leaked()
        base = alignment.of_gaussians(prediction.gaussians)
        guard = OcclusionGuard.of(dataclasses.replace(seen, depth=alignment.of_depth(seen.depth)), prediction.camera)
        depths = DepthRange.of(base)
        if past is not None:
            depths = past.depths.towards(depths, FOLLOW)
        return base, guard, _Past(rgb, inverse_depth, alignment, depths), past


def _carried(drawn: CompletedView, frame: CompletedFrame, past: _Past | None) -> CompletedView:
    """What was drawn, with the colours of the past."""
    drawn = dataclasses.replace(drawn, gaussians=(drawn.gaussians[0], frame.aux), view=frame.view)
    if past is None or past.drawn is None or frame.flow is None:
        return drawn
    earlier, hole = past.drawn, drawn.hole
    was = sample(earlier.hole[..., None].float(), pixel_grid(frame.flow) + frame.flow)[..., 0]
    both, neither = hole & (was > 0.999), ~hole & (was < 0.001)
    pairs = {
        "seen": (drawn.view, earlier.view, neither),
        "alone": (drawn.alone, earlier.alone, both),
        "carried": (drawn.view, earlier.view, both),
    }
    figures = {name: flicker(one.rgb, other.rgb, frame.flow, chosen) for name, (one, other, chosen) in pairs.items()}
    return dataclasses.replace(drawn, flicker={name: value for name, value in figures.items() if value is not None})
