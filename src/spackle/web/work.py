"""The work of a worker process: turn a photo or scene into the page's data and files to download."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from PIL import Image, ImageOps
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console

from spackle.bases.lite import LiteBase
from spackle.bases.settings import AUTO, ROUGH_GEOMETRY_ADVICE, BaseSettings
from spackle.core.image_files import read_image
from spackle.core.photo import PHOTO_SUFFIXES, check_photo_size
from spackle.core.trajectories import MAX_DISPARITY, TRAJECTORIES, TrajectoryKind
from spackle.depth.units import DepthKind
from spackle.formats.html import html_safe_json, single_html
from spackle.formats.scene_files import scene_suffix
from spackle.pipeline import FillOptions, FillTexture, Pipeline, PipelineOptions
from spackle.render import get_renderer
from spackle.results.photo_folder import REPORT_NAME, PhotoOptions, predict_photo
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.progress import Progress, Reporter
from spackle.runtime.task_process import SendEvent
from spackle.scene import Scene
from spackle.video.video_formats import DEFAULT_FPS
from spackle.views import DEFAULT_VIDEO_SECONDS, MAX_FRAME_COUNT, PathOptions
from spackle.web.jobs import Job

Download = Literal["scene.ply", "scene.spz", "scene.sog", "scene.glb", "scene.html", "report.json"]
Video = Literal[
    "video.mp4", "swipe.mp4", "shake.mp4", "rotate.mp4", "rotate-forward.mp4", "vertical.mp4", "orbit.mp4",
    "dolly-zoom.mp4",
]  # fmt: skip
FileName = Literal[Download, Video]  # one list, so that a refusal names all
DEFAULT_FILES: list[FileName] = [
    "scene.ply",
    "scene.spz",
    "scene.glb",
    "scene.html",
    "video.mp4",
    "report.json",
]  # the default
PAGE = "page.json"
PREVIEW = "photo.jpg"
PREVIEW_SIDE_PX = 1280  # pixels of the preview's long side
# The formats that Pillow may decode: for EPS, for example, Pillow would start another program.
PILLOW_FORMATS = frozenset({"JPEG", "MPO", "PNG", "WEBP", "HEIF", "TIFF"})


class SceneOptions(BaseModel):
    """Options that a client can set for a scene."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    base: str | None = Field(
        None, max_length=80, description="One of the server's bases; null: its default."
    )
    depth_kind: DepthKind = Field("auto", description="What the numbers in the depth map mean.")
    disparity: float | None = Field(
        None, ge=0, le=MAX_DISPARITY, description="How far the camera moves; 0.3 is large."
    )
    trajectory: TrajectoryKind = Field("rotate-forward", description="Camera path of the video.")
    frames: int = Field(
        round(DEFAULT_VIDEO_SECONDS * DEFAULT_FPS),
        ge=1,
        le=MAX_FRAME_COUNT,
        description="Number of frames of the video, 30 per second.",
    )
    fill: FillTexture = Field("auto", description="Source of the texture in the holes.")
    focal_px: float | None = Field(None, gt=0, description="Focal length in pixels of the photo.")
    focal_mm: float | None = Field(None, gt=0, description="Focal length in mm, 35 mm equivalent.")
    fov: float | None = Field(
        None, gt=0, lt=180, description="Horizontal field of view in degrees."
    )
    keep_frame: bool = Field(False, description="Keep a uniform frame around the picture.")
    files: list[FileName] = Field(
        DEFAULT_FILES, description="Files to make before the job is done."
    )


@dataclasses.dataclass
class SceneWork:
    """The function of a worker process; it keeps the last base loaded."""

    base: BaseSettings = dataclasses.field(default_factory=BaseSettings)
    usual: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # default options of jobs
    verbose: bool = False
    opened: Pipeline | None = None

    def bases(self) -> list[str]:
        """The bases that a client may choose: the server's base, "auto", and those with weights on this machine."""
        return list(dict.fromkeys([self.base.name, AUTO, *BaseSettings().model_files]))

    def __call__(self, task: tuple[Job, str | None], tell: SendEvent) -> None:
        """Do a task; InputError, without any path of this server, for an unusable photo, depth map or scene."""
        job, file = task
        options, teller = (
            SceneOptions.model_validate({**self.usual, **job.options}),
            JobReporter(job, tell, self.verbose),
        )
        ply, source, note = job.results / "scene.ply", job.folder / job.source, ""
        try:
            if file is None:
                if scene_suffix(source):
                    Scene.load(source, focal_px=options.focal_px, fov=options.fov).save(ply)
                else:
                    note = self._complete(job, options, teller)
                scene = Scene.load(ply)
                with teller.stage("page"):
                    page = scene.page(job.name, note)
                    for name, data in {
                        **page.files,
                        PAGE: html_safe_json(page.description),
                    }.items():
                        write_atomic(job.results / name, data)
            else:
                scene = Scene.load(ply)
            for name in options.files if file is None else [file]:
                if not (job.results / name).exists():
                    with teller.stage(name):
                        self._make(job.results / name, scene, job, options)
        except InputError as error:
            raise InputError(teller.cleaned(str(error))) from error

    def _complete(self, job: Job, options: SceneOptions, teller: JobReporter) -> str:
        """Complete a photo: make the files of `predict_photo`; returns a note for the user."""
        settings = self.base
        if job.depth is not None:
            depth, kind = job.folder / job.depth, options.depth_kind
            settings = dataclasses.replace(
                settings, name=AUTO, checkpoint=None, depth=depth, depth_kind=kind
            )
        elif options.base not in (None, settings.name):
            settings = dataclasses.replace(settings, name=options.base, checkpoint=None)
        path = PathOptions(
            trajectory=options.trajectory, disparity=options.disparity, frames=options.frames
        )
        chosen = PipelineOptions(base=settings, path=path, fill=FillOptions(fill=options.fill))
        if self.opened is None or self.opened.options.base != settings:
            self.opened = None  # frees the network before another one is loaded
            self.opened = Pipeline.open(chosen)
        pipeline = dataclasses.replace(self.opened, options=chosen)
        lens = options.model_dump(include={"focal_px", "focal_mm", "fov"})
        wanted = PhotoOptions(
            lens=lens, render="video.mp4" in options.files, keep_frame=options.keep_frame
        )
        report = predict_photo(job.folder / job.source, job.results, pipeline, teller, wanted)
        return ROUGH_GEOMETRY_ADVICE if report.run.base == LiteBase.name else ""

    def _make(self, target: Path, scene: Scene, job: Job, options: SceneOptions) -> None:
        if target.name == REPORT_NAME:
            raise InputError(f"{job.name}: has no report, because it was opened as a scene")
        if target.suffix == ".mp4":
            kind = next((kind for kind in TRAJECTORIES if kind == target.stem), options.trajectory)
            scene.save_video(
                target, kind, frames=options.frames, renderer=get_renderer(self.base.device)
            )
        elif target.suffix == ".html":
            note = json.loads((job.results / PAGE).read_bytes())["note"]
            write_atomic(target, single_html(scene.page(job.name, note)))
        else:
            scene.export(target)


class JobReporter(Reporter):
    """Reports log lines and progress to the server, with the photo's name in place of paths."""

    def __init__(self, job: Job, tell: SendEvent, verbose: bool) -> None:
        super().__init__(verbose, Console(quiet=True, force_terminal=False))
        self._job, self._tell = job, tell

    def cleaned(self, line: str) -> str:
        job = self._job
        line = line.removesuffix(f" -> {job.results}").replace(f"{job.folder}{os.sep}", "")
        return line.replace(job.source, job.name)

    def log(self, line: str) -> None:
        self._tell({"line": self.cleaned(line)})

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Progress]:
        """Like `Reporter.stage`; a total of 0 means unknown."""
        self._tell({"stage": name, "done": 0, "total": 0})
        with super().stage(name):
            yield lambda done, total: self._tell({"stage": name, "done": done, "total": total})


def check_photo(path: Path, name: str, preview: Path) -> None:
    """Decode a photo, and write a small JPEG to `preview`, which the page shows until the scene is ready.

    InputError, naming the file `name`, if the file is no photo of an accepted format.
    """

    def decode(image: Image.Image) -> None:
        if image.format not in PILLOW_FORMATS:
            raise InputError(f"{path}: a {image.format} picture: give {', '.join(PHOTO_SUFFIXES)}")
        check_photo_size(image.width, image.height, path)
        image.load()
        upright = ImageOps.exif_transpose(image)
        upright.thumbnail((PREVIEW_SIDE_PX, PREVIEW_SIDE_PX))
        upright.convert("RGB").save(preview, quality=85)

    try:
        read_image(path, decode)
    except InputError as error:
        raise InputError(str(error).replace(str(path), name)) from error
