"""The work of a worker process: a photo or scene becomes the page's data and files."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console

from spackle.bases.lite import LiteBase
from spackle.bases.settings import AUTO, BaseSettings
from spackle.core.trajectories import TRAJECTORIES, TrajectoryKind
from spackle.depth.units import DepthKind
from spackle.formats.camera_files import camera_from_json
from spackle.formats.html import PageScene, html_safe_json
from spackle.formats.scene_files import load_scene, scene_suffix
from spackle.pipeline import FillOptions, FillTexture, Pipeline, PipelineOptions
from spackle.render import get_renderer
from spackle.results.photo_folder import REPORT_NAME, PhotoOptions, predict_photo
from spackle.results.warm_up import compile_kernels
from spackle.runtime.declared_options import DECLARATIONS
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic, write_json
from spackle.runtime.progress import Progress, Reporter, StageProgress
from spackle.runtime.task_process import SendEvent
from spackle.scene import Scene
from spackle.video.video_formats import DEFAULT_FPS
from spackle.views import DEFAULT_VIDEO_SECONDS, PathOptions
from spackle.web.edits import (
    FORMER_PAGE,
    REMOVED_FILE,
    fill_views,
    remove_and_patch,
    sent_mask,
)
from spackle.web.jobs import WARM_UP, Job
from spackle.web.shared_videos import SharedVideo, shared_video_options

Download = Literal[
    "scene.ply",
    "scene.spz",
    "scene.sog",
    "scene.glb",
    "scene.html",
    "removed.ply",
    "report.json",
]
Video = Literal[
    "video.mp4",
    "swipe.mp4",
    "shake.mp4",
    "rotate.mp4",
    "rotate-forward.mp4",
    "vertical.mp4",
    "orbit.mp4",
    "dolly-zoom.mp4",
]
FileName = Literal[Download, Video, SharedVideo]  # one list, so that a refusal names all
DEFAULT_FILES: list[FileName] = [
    "scene.ply",
    "scene.spz",
    "scene.glb",
    "scene.html",
    "video.mp4",
    "report.json",
]
SCENE_FILE = "scene.ply"  # the scene, of which all other files are made
PAGE = "page.json"  # what the page draws, without the Gaussians
PREVIEW = "photo.jpg"  # the small photo that the page shows until the scene is ready
# What the page says of a scene whose depth a small network has guessed.
ROUGH_DEPTH_NOTE = "Rough depth: a quick guess."


def declared_field(name: str, **changes: Any) -> Any:
    """The field of a declared option in the HTTP interface: its default, limits and help.

    Args:
        name: Python name of the option, one of `DeclaredOptions`.
        **changes: arguments of pydantic's `Field` that go before what is declared.
    """
    declaration = DECLARATIONS[name]
    description = declaration.help
    if declaration.unset:
        description += f" null: {declaration.unset}."
    declared: dict[str, Any] = {
        "default": declaration.default,
        "description": description,
        **declaration.limits,
    }
    return Field(**{**declared, **changes})


class SceneOptions(BaseModel):
    """Options that a client can set for a scene."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    base: str | None = declared_field(
        "base",
        default=None,
        max_length=80,
        description="One of the server's bases; null: its default.",
    )
    depth_kind: DepthKind = declared_field("depth_kind")
    depth_unit: str | None = declared_field("depth_unit", max_length=40)
    disparity: float | None = declared_field("disparity")
    trajectory: TrajectoryKind = declared_field("trajectory")
    frames: int = declared_field(
        "frames",
        default=round(DEFAULT_VIDEO_SECONDS * DEFAULT_FPS),
        description="Number of frames of the video, 30 per second.",
    )
    fill: FillTexture = declared_field("fill")
    focal_px: float | None = declared_field("focal_px")
    focal_mm: float | None = declared_field("focal_mm")
    fov: float | None = declared_field("fov")
    keep_frame: bool = declared_field("keep_frame")
    files: list[FileName] = Field(
        DEFAULT_FILES, description="Files to make before the job is done."
    )


@dataclasses.dataclass
class SceneWork:
    """The function of a worker process: it makes scenes of photos, and files of scenes.

    A base is the network, or the depth map, that turns a photo into Gaussians. The process keeps
    the base that it used last, because loading a network takes seconds.
    """

    base: BaseSettings = dataclasses.field(default_factory=BaseSettings)  # the server's own base
    # Options of photos whose clients do not set them.
    default_options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    verbose: bool = False  # whether to report details
    pipeline: Pipeline | None = None  # with the base that was used last
    # Its files of weights: with "auto", others may come to this machine meanwhile.
    pipeline_files: Mapping[str, Path] = dataclasses.field(default_factory=dict)
    prepares_for_photos: ClassVar[bool] = True  # takes the task `WARM_UP`

    def bases(self) -> list[str]:
        """The names of the bases that a client may choose, without duplicates.

        They are the server's base, "auto", and those whose weights are on this machine.
        """
        names = [self.base.name, AUTO, *BaseSettings().model_files]
        return list(dict.fromkeys(names))

    def __call__(self, task: tuple[Job, str | None] | str, send_event: SendEvent) -> None:
        """Do a task: make the scene of a job's photo, or add a file to the job's finished scene.

        Args:
            task: the job, and the name of the file to add; None: make the scene, and the files that
                the job's options name. Or `WARM_UP`: prepare for the first photo.
            send_event: takes progress and log lines for the server.

        Raises:
            InputError: the photo, depth map or scene is unusable. The message has no path of this
                server.
        """
        if isinstance(task, str):
            assert task == WARM_UP, task
            self._warm_up()
            return
        job, file = task
        # What the client has set goes before the server's defaults.
        options = SceneOptions.model_validate({**self.default_options, **job.options})
        reporter = JobReporter(job, send_event, self.verbose)
        try:
            if file is None and job.edit is not None:
                scene = self._edit_scene(job, reporter)
                files: Sequence[str] = options.files
            elif file is None:
                scene = self._make_scene(job, options, reporter)
                files = options.files
            else:
                scene = Scene.load(job.results / SCENE_FILE)
                files = [file]
            for name in files:
                # Making the scene has made some of its files.
                if not (job.results / name).exists():
                    with reporter.stage(name) as progress:
                        self._make_file(job.results / name, scene, job, options, progress)
        except InputError as error:
            raise InputError(reporter.without_paths(str(error))) from error

    def _make_scene(self, job: Job, options: SceneOptions, reporter: JobReporter) -> Scene:
        """Make the scene of a job's photo, and write what the page draws.

        The job may hold a scene in place of a photo, which is only opened.
        """
        source = job.folder / job.source
        scene_file = job.results / SCENE_FILE
        note = ""
        if scene_suffix(source):  # a scene, not a photo: nothing is to be completed
            loaded = load_scene(source)
            Scene.of_file(loaded, focal_px=options.focal_px, fov=options.fov).save(scene_file)
            note = "; ".join(loaded.losses)
        else:
            note = self._complete_photo(job, options, reporter)

        # Read again, so that the page shows exactly what is in the file.
        scene = Scene.load(scene_file)
        with reporter.stage("page"):
            self._write_page(job, scene.page(job.name, note))
        return scene

    def _edit_scene(self, job: Job, reporter: JobReporter) -> Scene:
        """Make the scene of a job that edits another one, and write what the page draws.

        With a mask, the job removes a thing; without, it fills what its cameras see open.
        InputError if a mask marks nothing, or everything.
        """
        cameras = [camera_from_json(entry, "camera") for entry in job.cameras]
        scene_file = job.results / SCENE_FILE
        renderer = get_renderer(self.base.device)
        if job.mask is None:
            report = fill_views(job.folder / job.source, scene_file, cameras, renderer, reporter)
        else:
            mask = sent_mask(job.folder / job.mask, cameras[0])
            report = remove_and_patch(
                job.folder / job.source, scene_file, (cameras[0], mask), renderer, reporter
            )
        write_json(report, job.results / REPORT_NAME)

        # The page keeps the note, the lens and the paths that it had before the edit.
        scene = Scene.load(scene_file)
        with reporter.stage("page"):
            former = json.loads((job.folder / FORMER_PAGE).read_bytes())
            self._write_page(job, scene.page(job.name, former["note"], viewed_as=former))
        return scene

    def _write_page(self, job: Job, page: PageScene) -> None:
        """Write what the page draws into a job's results; the description last."""
        for name, content in page.files.items():
            write_atomic(job.results / name, content)
        write_atomic(job.results / PAGE, html_safe_json(page.description))

    def _complete_photo(self, job: Job, options: SceneOptions, reporter: JobReporter) -> str:
        """Complete a photo: write the scene and its report, and perhaps a video, into the results.

        Returns:
            A note for the user about the scene's quality; empty if there is nothing to say.
        """
        settings = self._base_settings(job, options)
        path = PathOptions(
            trajectory=options.trajectory, disparity=options.disparity, frames=options.frames
        )
        pipeline_options = PipelineOptions(
            base=settings, path=path, fill=FillOptions(fill=options.fill)
        )
        pipeline = dataclasses.replace(self._opened(pipeline_options), options=pipeline_options)

        photo_options = PhotoOptions(
            lens=options.model_dump(include={"focal_px", "focal_mm", "fov"}),
            render="video.mp4" in options.files,
            keep_frame=options.keep_frame,
        )
        photo = job.folder / job.source
        report = predict_photo(photo, job.results, pipeline, reporter, photo_options)
        # Without depth and without the weights of a better network, a small network guesses.
        return ROUGH_DEPTH_NOTE if report.run.base == LiteBase.name else ""

    def _opened(self, options: PipelineOptions) -> Pipeline:
        """The pipeline with the base that the options name; opened now, if it is not open yet."""
        settings = options.base
        files = settings.model_files
        is_open = self.pipeline is not None and self.pipeline.options.base == settings
        if self.pipeline is None or not is_open or files != self.pipeline_files:
            # The old network is freed before another one is loaded: both may not fit into memory.
            self.pipeline = None
            self.pipeline = Pipeline.open(options)
            self.pipeline_files = files
        return self.pipeline

    def _warm_up(self) -> None:
        """Compile the kernels, and load the base: the first photo then need not wait for them."""
        compile_kernels(self.base.device)
        self._opened(PipelineOptions(base=self.base, path=PathOptions(), fill=FillOptions()))

    def _base_settings(self, job: Job, options: SceneOptions) -> BaseSettings:
        """The settings of the base, which turns a photo into Gaussians.

        A photo with a depth map needs no network. Otherwise the client may have chosen one; else
        it is the server's own.
        """
        if job.depth is not None:
            # "auto" takes depth before any network; `checkpoint` belongs to the server's network.
            return dataclasses.replace(
                self.base,
                name=AUTO,
                checkpoint=None,
                depth=job.folder / job.depth,
                depth_kind=options.depth_kind,
                depth_unit=options.depth_unit,
            )
        if options.base is not None and options.base != self.base.name:
            return dataclasses.replace(self.base, name=options.base, checkpoint=None)
        return self.base

    def _make_file(
        self, target: Path, scene: Scene, job: Job, options: SceneOptions, progress: Progress
    ) -> None:
        """Write a video, a page or another format of a scene; the name of `target` says which.

        `progress` is called for each frame of a video.

        InputError if the report of a photo is wanted, but the job was a scene, not a photo.
        """
        # A photo's report was written with its scene. If it has to be made, there was no photo.
        if target.name == REPORT_NAME:
            raise InputError(f"{job.name}: has no report, because it was opened as a scene")
        if target.name == REMOVED_FILE:
            raise InputError(f"{job.name}: nothing was removed from this scene")
        shared = shared_video_options(target.name, scene.camera)
        if shared is not None:
            renderer = get_renderer(self.base.device)
            scene.save_video(
                target,
                options.trajectory,
                renderer=renderer,
                progress=progress,
                **dataclasses.asdict(shared),
            )
        elif target.suffix == ".mp4":
            # swipe.mp4, for example, shows the camera path "swipe"; video.mp4 shows the path of the
            # job's options. The loop tells the type checker that the name is one of the paths.
            trajectory = options.trajectory
            for name in TRAJECTORIES:
                if name == target.stem:
                    trajectory = name
            renderer = get_renderer(self.base.device)
            scene.save_video(
                target, trajectory, frames=options.frames, renderer=renderer, progress=progress
            )
        elif target.suffix == ".html":
            description = json.loads((job.results / PAGE).read_bytes())
            page = scene.page_file(job.name, description["note"], viewed_as=description)
            write_atomic(target, page)
        else:
            scene.export(target)


class JobReporter(Reporter):
    """Reports log lines and progress to the server, with the photo's name in place of paths."""

    def __init__(self, job: Job, send_event: SendEvent, verbose: bool) -> None:
        """Report the work on a job through `send_event`; with `verbose`, details, too."""

        def send_progress(update: StageProgress) -> None:
            send_event(dataclasses.asdict(update))

        console = Console(quiet=True, force_terminal=False)
        super().__init__(verbose, console, listener=send_progress)
        self._job = job
        self._send_event = send_event

    def without_paths(self, line: str) -> str:
        """A line for clients, who know the photo's name and must not learn this server's paths."""
        job = self._job
        line = line.removesuffix(f" -> {job.results}")
        line = line.replace(f"{job.folder}{os.sep}", "")
        return line.replace(job.source, job.name)

    def log(self, line: str) -> None:
        """Send a line to the server."""
        self._send_event({"line": self.without_paths(line)})
