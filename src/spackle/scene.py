"""A photo's completed scene, and the way to it: open a base, predict, complete."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import html
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from spackle.bases.depth_map import DepthMap
from spackle.bases.open import BaseSettings, open_base, open_loaded
from spackle.bases.protocol import USUAL_DISPARITY, Base, BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, KeyframePath, TrajectoryKind, extremes, trajectory
from spackle.device import Precision
from spackle.downloads import installed
from spackle.errors import InputError
from spackle.files import write_whole
from spackle.formats import save_ply, save_video
from spackle.formats.scene_files import SceneFile, Writer, at_origin, writer_of
from spackle.formats.video import check_video
from spackle.gaussians import Gaussians
from spackle.image import Photo, focal_length, load_photo
from spackle.inpaint import InpainterOptions, get_inpainter
from spackle.progress import progress_line
from spackle.render import Renderer, get_renderer
from spackle.render.protocol import Rendering
from spackle.residual import Completer, ResidualNet
from spackle.residual.network import SHIPPED, load_residual, shipped_network
from spackle.residual.texture import EXEMPLAR, PaintedTexture, Texture
from spackle.viewer import PageScene, page_scene, single_html

PATH_FRAMES = 60
DEFAULT_SIZE = (1280, 720)  # of a scene without a camera
LOG = logging.getLogger("spackle")
Shipped = Literal["shipped"]  # the weights that come with the package, if it has any
Fill = Literal["auto", "network", "exemplar", "lama", "none"]  # of the texture in holes
Mode = Literal["scene", "view"]  # one set of aux Gaussians for all views, or the paper's one for each


@dataclasses.dataclass(frozen=True)
class ResidualChoice:
    """What fills the holes, as --residual and --fill name it."""

    named: str | None = None  # a file, "seeds", "none", or None for the shipped weights if there are any
    wanted: Fill = "auto"
    mode: Mode = "scene"

    @property
    def fill(self) -> Fill:
        """Where the texture comes from, "auto" resolved; "none" also where the residual is.

        Where each view is filled by itself, "auto" paints none: that would take seconds a view.
        """
        if self.mode == "view" and self.wanted == "auto" and self.named != "none":
            return "exemplar"
        return "none" if self.named == "none" else resolved(self.wanted)

    @property
    def weights(self) -> str:
        """For reports: "shipped", a file, "seeds" or "none"."""
        return "none" if self.fill == "none" else self.named or ("shipped" if SHIPPED.is_file() else "seeds")

    @property
    def file(self) -> Path | None:
        """Where the weights lie; None without a network."""
        return (
            SHIPPED if self.weights == "shipped" else None if self.weights in ("seeds", "none") else Path(self.weights)
        )

    def load(self) -> ResidualNet | None:
        """The network, if any; InputError for a file that cannot be used."""
        return None if self.file is None else load_residual(self.file)


@dataclasses.dataclass(frozen=True)
class Scene:
    """Base and aux Gaussians of a photo, in the frame of its camera."""

    base: Gaussians  # what the photo shows; never changed
    aux: Gaussians  # what completion added
    camera: Camera  # the photo's
    by_view: tuple[Gaussians, ...] | None = None  # in view mode: the aux Gaussians of each completed view
    disparity: float | None = None  # how far it was completed, where that is known

    def __repr__(self) -> str:
        size = f"{self.camera.width}×{self.camera.height}"
        return f"Scene({len(self.base):,} base + {len(self.aux):,} aux Gaussians, {size}, {self.base.means.device})"

    @staticmethod
    def load(path: str | os.PathLike[str], *, focal_px: float | None = None, fov: float | None = None) -> Scene:
        """Read a PLY of ours, of INRIA's or of SHARP's; InputError for another file.

        Args:
            path: the file.
            focal_px: focal length in pixels; by default what is stored, else that of 30 mm.
            fov: horizontal field of view in degrees, in its place.
        """
        return Scene.of_file(SceneFile.load(Path(path)), focal_px, fov)

    @staticmethod
    def of_file(file: SceneFile, focal_px: float | None = None, fov: float | None = None) -> Scene:
        """What a file holds, in the frame of its camera; see `load`."""
        gaussians, camera = file.gaussians, file.camera
        if camera is None or focal_px is not None or fov is not None:
            width, height = (camera.width, camera.height) if camera else DEFAULT_SIZE
            focal, _ = focal_length(file.path, width, height, {}, focal_px=focal_px, focal_mm=None, fov=fov)
            given = Camera.from_focal(focal, width, height)
            pose = given.world_to_camera if camera is None else camera.world_to_camera
            camera = dataclasses.replace(given, world_to_camera=pose)
        if not at_origin(camera):
            gaussians = gaussians.transform(camera.world_to_camera)
            camera = dataclasses.replace(camera, world_to_camera=torch.eye(4))
        count = len(gaussians) if file.base_count is None else file.base_count
        base, aux = gaussians.select(slice(0, count)), gaussians.select(slice(count, None))
        return Scene(base, aux, camera, disparity=file.disparity)

    @property
    def gaussians(self) -> Gaussians:
        """Everything, the base first."""
        return Gaussians.cat([self.base, self.aux])

    def _far(self, disparity: float | None) -> float:
        """How far a path goes: as somebody says, else as the scene was completed, else as usual."""
        own = USUAL_DISPARITY if self.disparity is None else self.disparity
        return own if disparity is None else disparity

    def of_view(self, index: int) -> list[Gaussians]:
        """The sets that a completed view is drawn with."""
        return [self.base, self.aux if self.by_view is None else self.by_view[index]]

    def path(
        self, kind: TrajectoryKind = "rotate-forward", disparity: float | None = None, frames: int = PATH_FRAMES
    ) -> list[Camera]:
        """Cameras of a video around the photo's eye, both sides of the picture even."""
        return scene_path(self.base, self.camera, kind, self._far(disparity), frames)

    def along(self, keyframes: KeyframePath, frames: int | None = None, fps: float = 30) -> list[Camera]:
        """Cameras through keyframes, see `spackle.formats.load_path`; without a number as many as they take at `fps`.

        ValueError for a path through a view that cannot be.
        """
        count = frames or keyframes.frame_count(fps)
        return keyframes.cameras(self.camera.even(), count, DepthRange.of(self.base))

    def render(self, camera: Camera, renderer: Renderer | None = None) -> Rendering:
        """One view of the whole scene."""
        with torch.no_grad():
            return (renderer or get_renderer()).render([self.base, self.aux], camera)

    def frames(self, cameras: Iterable[Camera], renderer: Renderer | None = None) -> Iterator[Rendering]:
        """Views along a path, one after the other."""
        renderer = renderer or get_renderer()
        for camera in cameras:
            yield self.render(camera, renderer)

    def save(self, path: str | os.PathLike[str], disparity: float | None = None) -> None:
        """Write a plain PLY that every common viewer opens.

        Args:
            path: the file.
            disparity: how far the scene was completed, by default as `Scene.disparity` has it: so far `spackle view`
                goes.
        """
        reach = self.disparity if disparity is None else disparity
        save_ply(self.gaussians, path, camera=self.camera, base_count=len(self.base), disparity=reach)

    def page(self, name: str, note: str = "") -> PageScene:
        """The scene for the page of `spackle view`, under a name, with a note as `page_scene` has it."""
        return page_scene(name, self.base, self.aux, self.camera, self.disparity, note)

    def export(self, path: str | os.PathLike[str]) -> None:
        """Write a file for other viewers: .ply, .compressed.ply, .spz, .splat, .sog, .glb, or .html, a page of its own.

        InputError for another name, and for a scene too large for a format.
        """
        target = Path(path)
        page: Writer = lambda file, place: write_whole(place, single_html(self.page(place.stem)))  # noqa: E731
        file = SceneFile(target, self.gaussians, self.camera, len(self.base), self.disparity)
        writer_of(target, {".html": page})(file, target)

    def show(self, height: int = 480) -> InlinePage:
        """The page with the scene in it, `height` pixels high: the last value of a notebook's cell is shown."""
        return InlinePage(single_html(self.page("scene")).decode(), height)

    def save_video(
        self,
        path: str | os.PathLike[str],
        kind: TrajectoryKind = "rotate-forward",
        disparity: float | None = None,
        frames: int = PATH_FRAMES,
        fps: float = 30,
        loop: int | None = None,
    ) -> None:
        """Write a video of a camera path: .mp4, .webm, .gif or .webp; `loop` as in `spackle.formats.VideoWriter`."""
        plays = check_video(path, fps, loop).loop if loop is None else loop
        cameras = scene_path(self.base, self.camera, kind, self._far(disparity), frames, looped=plays != 1)
        save_video((view.rgb for view in self.frames(cameras)), path, fps, loop)


@dataclasses.dataclass(frozen=True)
class InlinePage:
    """A page inside of a notebook."""

    html: str
    height: int  # pixels

    def __repr__(self) -> str:
        return f"InlinePage({len(self.html) / 1e6:.1f} MB, shown by a notebook)"

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return f'<iframe style="{style}" allowfullscreen srcdoc="{html.escape(self.html)}"></iframe>'


def predict(
    photo: str | os.PathLike[str] | Photo,
    depth: str | os.PathLike[str] | DepthMap | None = None,
    *,
    base: Base | None = None,
    kind: TrajectoryKind = "rotate-forward",
    disparity: float | None = None,
    network: ResidualNet | Shipped | None = "shipped",
    fill: Fill = "auto",
    renderer: Renderer | None = None,
    keep_frame: bool = False,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    fov: float | None = None,
    progress: bool = False,
) -> Scene:
    """A photo to a scene without holes along a camera path.

    Args:
        photo: a file, or a loaded photo.
        depth: of the photo, a file or a loaded depth map.
        base: what turns the photo into Gaussians, such as `SharpBase.load(weights)`. Where neither it nor the depth
            is given, the best that there is: the depth in the photo's file, else SHARP where its weights have been
            downloaded, else `LiteBase`, whose geometry is rough. The logger "spackle" is told which, and warned of
            what could not be used. A network is then loaded for this photo alone: for many, load a base once.
        kind: the path that the scene is completed for, besides the views farthest to the left and to the right.
        disparity: how far the path goes, see `spackle.camera_path.max_offset`; where None as the base has it: 0.15 for
            lite, else 0.3.
        network: residual weights, by default those that come with Spackle; None: the seeds alone fill the holes.
        fill: see `open_texture`; "none" leaves the holes open.
        renderer: the CPU's where None.
        keep_frame: otherwise a uniform frame around a file's picture is cut off, and the logger is told.
        focal_px: focal length of a photo's file in pixels; by default the file's own, see `load_photo`.
        focal_mm: its 35 mm film equivalent, in its place.
        fov: horizontal field of view in degrees, in its place.
        progress: show how far it is, on one line of the standard error.

    Raises:
        InputError: a photo or a depth map that cannot be used, or a base's name in place of a base.
        ValueError: depth and base both given, or a lens for a photo that is loaded.
    """
    if depth is not None and base is not None:
        raise ValueError("predict takes the photo's depth, or a base that needs none, but not both")
    if isinstance(base, str):
        raise InputError(f"base={base!r}: give a base that is loaded, such as base=spackle.LiteBase.load()")
    if isinstance(photo, Photo):
        if (focal_px, focal_mm, fov) != (None, None, None):
            raise ValueError("a loaded photo has a lens: give focal_px, focal_mm or fov to load_photo")
        loaded = photo
    else:
        loaded = load_photo(photo, focal_px=focal_px, focal_mm=focal_mm, fov=fov, keep_frame=keep_frame)
    if loaded.frame is not None:
        LOG.info("%s: %s", loaded.path.name, loaded.frame.note)
    source = Path(depth) if isinstance(depth, (str, os.PathLike)) else depth
    opened = open_base(BaseSettings(depth=source)) if base is None else open_loaded(base)
    with progress_line("base", progress) as step:
        prediction, choice = opened.load(loaded).predict(step)
    if choice.note:
        LOG.info("%s: %s", loaded.path.name, choice.note)
    far = prediction.disparity if disparity is None else disparity
    cameras = scene_path(prediction.gaussians, prediction.camera, kind, far)
    cameras += extremes(prediction.camera.even(), far, DepthRange.of(prediction.gaussians))
    with progress_line("complete", progress) as step:
        made = complete(prediction, cameras, network=network, fill=fill, renderer=renderer, progress=step)
    return dataclasses.replace(made, disparity=far)


def resolved(fill: Fill) -> Fill:
    """What "auto" means: "lama" where its weights have been downloaded, else "exemplar"."""
    if fill != "auto":
        return fill
    with contextlib.suppress(InputError):  # a machine without a home folder
        return "lama" if installed("lama") else "exemplar"
    return "exemplar"


def open_texture(fill: Fill) -> Texture | None:
    """What gives the fill its texture: "lama" paints the widest views, "exemplar" takes it from the view itself.

    "auto" is one of both, see `resolved`. "network" and "none" give None. InputError for "lama" without its weights.
    """
    chosen = resolved(fill)
    return _lama() if chosen == "lama" else EXEMPLAR if chosen == "exemplar" else None


@functools.cache
def _lama() -> Texture:
    return PaintedTexture(get_inpainter("lama", InpainterOptions()))


def complete(
    prediction: BasePrediction,
    cameras: Sequence[Camera],
    *,
    mode: Mode = "scene",
    exact: bool = False,
    network: ResidualNet | Shipped | None = "shipped",
    fill: Fill = "auto",
    renderer: Renderer | None = None,
    precision: Precision = "auto",
    progress: Callable[[int, int], None] | None = None,
    seen: dict[int, Tensor] | None = None,
) -> Scene:
    """Fill the holes of all views: in scene mode with one set of aux Gaussians, see `Completer.complete_scene`.

    Args:
        prediction: of a base.
        cameras: the views.
        mode: "view" fills each view by itself, as the paper does, and leaves `Scene.aux` empty.
        exact: the views are these and no others between them; for scene mode.
        network: see `predict`.
        fill: see `predict`.
        renderer: the CPU's where None.
        precision: of the network.
        progress: called with views done and their number.
        seen: in scene mode gets pictures of some views, for which they need not be drawn again; see `complete_scene`.
    """
    base, camera = prediction.gaussians, prediction.camera
    if fill == "none":
        return Scene(base, Gaussians.empty(), camera)
    chosen = shipped_network() if network == "shipped" else network
    completer = Completer(base, camera, renderer or get_renderer(), chosen, open_texture(fill), precision=precision)
    if mode == "scene":
        return Scene(base, completer.complete_scene(cameras, exact, progress, seen), camera)
    guards, by_view = [completer.photo_guard()], []
    for index, view in enumerate(cameras):
        by_view.append(completer.complete_view(view, guards))
        if progress:
            progress(index + 1, len(cameras))
    return Scene(base, Gaussians.empty(), camera, tuple(by_view))


def scene_path(
    base: Gaussians,
    camera: Camera,
    kind: TrajectoryKind,
    disparity: float,
    frames: int = PATH_FRAMES,
    looped: bool = False,
) -> list[Camera]:
    """Cameras around the photo's eye at the photo's size, both sides made even.

    A path ends where it began, but for `swipe`. `looped` leaves out that last camera, which would be shown twice
    in a row by a video that starts again.
    """
    once = looped and kind != "swipe"
    path = trajectory(kind, camera.even(), disparity, DepthRange.of(base), frames + once)
    return path[:frames]
