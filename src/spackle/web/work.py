"""What a worker process does: a photo or a scene to what the page shows and to the files that people download."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from PIL import Image, ImageOps
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console

from spackle.bases.depth_map import DepthKind
from spackle.bases.lite import LiteBase
from spackle.bases.settings import AUTO, ROUGH, BaseSettings
from spackle.camera_path import MAX_DISPARITY, TRAJECTORIES, TrajectoryKind
from spackle.errors import InputError
from spackle.files import write_whole
from spackle.formats import save_video
from spackle.image import PHOTO_SUFFIXES, read_image
from spackle.photo_results import REPORT, predict_photo
from spackle.pipeline import Fill, FillOptions, Options, Pipeline
from spackle.progress import Reporter, Step
from spackle.render import get_renderer
from spackle.scene import Scene
from spackle.task_process import Tell
from spackle.views import MAX_FRAMES, PATH_FRAMES, PathOptions
from spackle.web.jobs import SceneTask
from spackle.web.page import as_json, single_html

Download = Literal["scene.ply", "scene.spz", "scene.sog", "scene.glb", "scene.html", "report.json"]
Video = Literal["video.mp4", "swipe.mp4", "shake.mp4", "rotate.mp4", "rotate-forward.mp4"]
FileName = Download | Video
MADE: list[FileName] = ["scene.ply", "scene.spz", "scene.glb", "scene.html", "video.mp4", "report.json"]  # as usual
PAGE, PREVIEW, SIDE = "page.json", "photo.jpg", 1280  # pixels of the long side of what stands for the photo
# What Pillow may find in a file, whatever its name says: it knows formats that are read by other programs, too.
FORMATS = frozenset({"JPEG", "MPO", "PNG", "WEBP", "HEIF", "TIFF"})


class SceneOptions(BaseModel):
    """How a photo becomes a scene."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    base: str | None = Field(None, max_length=80, description="One of the server's bases; the server's own where null.")
    disparity: float | None = Field(None, ge=0, le=MAX_DISPARITY, description="How far the camera moves; 0.3 is large.")
    trajectory: TrajectoryKind = Field("rotate-forward", description="Camera path of the video.")
    frames: int = Field(PATH_FRAMES, ge=1, le=MAX_FRAMES, description="Frames of the video, 30 a second.")
    fill: Fill = Field("auto", description="Texture of what fills the holes.")
    focal_px: float | None = Field(None, gt=0, description="Focal length in pixels of the photo.")
    focal_mm: float | None = Field(None, gt=0, description="Focal length in mm, 35 mm equivalent.")
    fov: float | None = Field(None, gt=0, lt=180, description="Horizontal field of view in degrees.")
    keep_frame: bool = Field(False, description="Keep a uniform frame around the picture.")
    files: list[FileName] = Field(MADE, description="What is made before the job is done.")

    @property
    def lens(self) -> dict[str, float | None]:
        return {"focal_px": self.focal_px, "focal_mm": self.focal_mm, "fov": self.fov}


@dataclasses.dataclass
class SceneWork:
    """Does tasks, and keeps the last base loaded."""

    base: BaseSettings = dataclasses.field(default_factory=BaseSettings)
    disparity: float | None = None
    keep_frame: bool = False
    depth_kind: DepthKind = "auto"  # how depth maps are read
    verbose: bool = False
    opened: Pipeline | None = None

    @property
    def bases(self) -> list[str]:
        """What a client may name: this one, auto, and those that need no download."""
        return list(dict.fromkeys([self.base.name, AUTO, *BaseSettings().files]))

    def __call__(self, task: SceneTask, tell: Tell) -> None:
        """InputError for a photo, a depth map or a scene that cannot be used; no line of it holds a path of ours."""
        options, teller = SceneOptions.model_validate(task.options), Teller(task, tell, self.verbose)
        ply, wanted = task.results / "scene.ply", [task.file] if task.file else options.files
        try:
            if task.file is None and is_scene(task.source):
                scene = Scene.load(task.source, focal_px=options.focal_px, fov=options.fov)
                scene.save(ply)
                self._show(scene, task, "", teller)
            elif task.file is None:
                note = self._complete(task, options, teller)
                self._show(Scene.load(ply), task, note, teller)
            for file in wanted:
                if not (task.results / file).exists():
                    self._make(file, Scene.load(ply), task, options, teller)
        except InputError as error:
            raise InputError(teller.cleaned(str(error))) from error

    def _complete(self, task: SceneTask, options: SceneOptions, teller: Teller) -> str:
        """A photo to the files of `predict_photo`; what a person should know of the scene."""
        disparity = self.disparity if options.disparity is None else options.disparity
        path = PathOptions(options.trajectory, disparity, frames=options.frames)
        settings = self.base
        if task.depth is not None:
            kind = self.depth_kind
            settings = dataclasses.replace(settings, name=AUTO, depth=task.depth, depth_kind=kind, checkpoint=None)
        elif options.base not in (None, settings.name):
            settings = dataclasses.replace(settings, name=options.base, checkpoint=None)
        chosen = Options(settings, path, FillOptions(fill=options.fill))
        if self.opened is None or self.opened.options.base != settings:
            self.opened = None  # before another network is loaded
            self.opened = Pipeline.open(chosen)
        pipeline = dataclasses.replace(self.opened, options=chosen)
        keep, film = options.keep_frame or self.keep_frame, "video.mp4" in options.files
        predict_photo(task.source, task.results, pipeline, teller, lens=options.lens, keep_frame=keep, render=film)
        (task.results / "base.ply").unlink()
        report = json.loads((task.results / REPORT).read_text(encoding="utf-8"))
        return ROUGH if report["base"]["name"] == LiteBase.name else ""

    def _show(self, scene: Scene, task: SceneTask, note: str, teller: Teller) -> None:
        """Write what the page draws."""
        with teller.stage("page"):
            page = scene.page(task.name, note)
            for name, data in {**page.files, PAGE: as_json(page.description)}.items():
                write_whole(task.results / name, data)

    def _make(self, file: str, scene: Scene, task: SceneTask, options: SceneOptions, teller: Teller) -> None:
        target = task.results / file
        if file == REPORT:
            raise InputError(f"{task.name}: has no report: it was a scene already")
        with teller.stage(file) as step:
            if file.endswith(".mp4"):
                kind = target.stem if target.stem in TRAJECTORIES else options.trajectory
                cameras, renderer = scene.path(kind, None, options.frames), get_renderer(self.base.device)
                frames = (step(k, len(cameras)) or view.rgb for k, view in enumerate(scene.frames(cameras, renderer)))
                save_video(frames, target)
            elif file.endswith(".html"):
                note = json.loads((task.results / PAGE).read_bytes())["note"]
                write_whole(target, single_html(scene.page(task.name, note)))
            else:
                scene.export(target)


class Teller(Reporter):
    """Tells the server what a terminal would get."""

    def __init__(self, task: SceneTask, tell: Tell, verbose: bool) -> None:
        super().__init__(verbose, Console(file=io.StringIO(), force_terminal=False))
        self._task, self._tell = task, tell

    def cleaned(self, line: str) -> str:
        """With the photo's own name, and no path of this machine."""
        task = self._task
        line = line.removesuffix(f" -> {task.results}")
        for path in (task.source, task.depth, task.results):
            line = line if path is None else line.replace(f"{path.parent}{os.sep}", "")
        return line.replace(task.source.name, task.name)

    def log(self, line: str) -> None:
        self._tell({"line": self.cleaned(line)})

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[Step]:
        """As `Reporter.stage`; a total of 0 is unknown."""
        self._tell({"stage": name, "done": 0, "total": 0})
        with super().stage(name):
            yield lambda done, total: self._tell({"stage": name, "done": done, "total": total})


def is_scene(path: Path) -> bool:
    """Whether a file claims to be a scene, by its name or its first bytes."""
    with open(path, "rb") as file:
        return path.suffix.lower() == ".ply" or file.read(3) == b"ply"


def check_photo(path: Path, name: str, preview: Path) -> None:
    """Decode all of a photo, and write a small JPEG of it, which the page shows meanwhile.

    InputError, which calls the file `name`, for what is no photo of a kind that is taken.
    """

    def decode(image: Image.Image) -> None:
        if image.format not in FORMATS:
            raise InputError(f"{path}: a {image.format} picture: give {', '.join(PHOTO_SUFFIXES)}")
        image.load()
        upright = ImageOps.exif_transpose(image)
        upright.thumbnail((SIDE, SIDE))
        upright.convert("RGB").save(preview, quality=85)

    try:
        read_image(path, decode)
    except InputError as error:
        raise InputError(str(error).replace(str(path), name)) from error
