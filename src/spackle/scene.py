"""A photo's completed scene: render it along a path, save it, export it, show it.

Read `Scene` first; `SceneReport` says how a scene was made.
"""

from __future__ import annotations

import dataclasses
import html
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases import DEFAULT_MAX_DISPARITY
from spackle.core.camera import Camera
from spackle.core.focal_length import resolve_focal_length
from spackle.core.gaussians import Gaussians
from spackle.core.keyframes import KeyframePath
from spackle.core.trajectories import (
    DepthRange,
    TrajectoryKind,
    trajectory_cameras,
)
from spackle.formats.html import (
    PREVIEW_SIDE_PX,
    PageScene,
    check_has_front,
    page_scene,
    single_html,
)
from spackle.formats.scene_content import SceneFile, is_at_origin
from spackle.formats.scene_files import encoder_for, load_scene
from spackle.render import Renderer, get_renderer
from spackle.render.protocol import Rendering
from spackle.residual.features import hole_mask
from spackle.runtime.files import PathOrFile, write_atomic
from spackle.runtime.progress import Cancel, Progress, cancellable
from spackle.video.encoding import save_video
from spackle.video.frames import FrameMaker
from spackle.video.options import Fit, Show, StereoLayout, VideoOptions, parse_size
from spackle.video.video_formats import check_video
from spackle.views import DEFAULT_FRAME_COUNT, PathOptions

DEFAULT_SIZE_PX = (1280, 720)  # width and height of the views of a file that stores no camera
KEYFRAMES_FPS = 30  # frame rate of a path through keyframes if no number of frames is given


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewHoles:
    """The holes of one view, as shares of the view's pixels (hole-area ratio, eq. 11)."""

    view: str  # its name: the disparity, such as "-0.3", a keyframe, or a given view's number
    before: float  # in the base
    after: float  # in the completed scene


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneReport:
    """How a scene was made from a photo.

    `spackle.complete`, which gets a prediction instead of a photo, knows neither the holes nor the
    base.
    """

    holes: tuple[ViewHoles, ...] = ()  # of the widest views, or of the given views
    base: str | None = None  # the base's name, such as "sharp"
    base_reason: str | None = None  # why this base
    focal_px: float  # focal length in pixels of the scene's camera
    focal_source: str | None = None  # where it comes from, such as "EXIF"; None: unknown
    warnings: tuple[str, ...] = ()  # about the photo, its depth and its base
    seconds: Mapping[str, float]  # duration of each stage

    @property
    def hole_ratio_before(self) -> float | None:
        """The mean share of holes in the base, over the views in `holes`; None without views."""
        if not self.holes:
            return None
        return sum(view.before for view in self.holes) / len(self.holes)

    @property
    def hole_ratio_after(self) -> float | None:
        """The mean share of holes that completion leaves; None if `holes` has no views."""
        if not self.holes:
            return None
        return sum(view.after for view in self.holes) / len(self.holes)


@dataclasses.dataclass(frozen=True)
class Scene:
    """Base and aux Gaussians of a photo, in the coordinates of the photo's camera.

    "Aux" are the Gaussians that completion adds where views of the base show holes.
    """

    base: Gaussians  # predicted from the photo; never changed
    aux: Gaussians  # added by completion
    camera: Camera  # the photo's camera, at the origin
    # In the modes view and paper, which complete each view by itself: each view's aux Gaussians.
    by_view: tuple[Gaussians, ...] | None = None
    disparity: float | None = None  # the camera's movement for which the scene was completed
    report: SceneReport | None = None  # how it was made; None for a scene from a file
    is_metric: bool = False  # whether the unit of length is known to be the metre

    def __repr__(self) -> str:
        size = f"{self.camera.width}×{self.camera.height}"
        counts = f"{len(self.base):,} base + {len(self.aux):,} aux Gaussians"
        return f"Scene({counts}, {size}, {self.base.means.device})"

    @staticmethod
    def load(
        path: str | os.PathLike[str], *, focal_px: float | None = None, fov: float | None = None
    ) -> Scene:
        """Read a scene of this or another program: PLY, SPZ, SOG, glTF or .splat.

        Args:
            path: the file.
            focal_px: focal length in pixels; by default the stored focal length, or a 35 mm
                equivalent of 30 mm.
            fov: horizontal field of view in degrees, instead of `focal_px`.

        Raises:
            InputError: another kind of file, a damaged one, or two focal lengths.
        """
        return Scene.of_file(load_scene(Path(path)), focal_px=focal_px, fov=fov)

    @staticmethod
    def of_file(
        file: SceneFile,
        size: tuple[int, int] | None = None,
        *,
        focal_px: float | None = None,
        fov: float | None = None,
    ) -> Scene:
        """The scene in a loaded file, in the coordinates of its camera; arguments as for `load`.

        `size` is the camera's width and height in pixels if a focal length is given or no camera is
        stored; by default that of the stored camera, or 1280×720.
        """
        camera = file.camera
        if camera is None or focal_px is not None or fov is not None:
            camera = _camera_with_lens(file, size, focal_px, fov)

        # Paths begin at the origin, so that is where the camera has to be.
        gaussians = file.gaussians
        if not is_at_origin(camera):
            gaussians = gaussians.transform(camera.world_to_camera)
            camera = dataclasses.replace(camera, world_to_camera=torch.eye(4))

        # The file of another program does not say which Gaussians were added; all count as base.
        base_count = len(gaussians) if file.base_count is None else file.base_count
        base = gaussians.select(slice(0, base_count))
        aux = gaussians.select(slice(base_count, None))
        return Scene(base, aux, camera, disparity=file.disparity, is_metric=file.is_metric)

    @property
    def gaussians(self) -> Gaussians:
        """All Gaussians, the base's first."""
        return Gaussians.cat([self.base, self.aux])

    @property
    def depth_range(self) -> DepthRange:
        """The depths on which a camera path depends; ValueError if nothing is before the camera.

        They are the base's, not those of the aux Gaussians, as when the scene was completed.
        """
        return DepthRange.of(self.base, is_metric=self.is_metric)

    def of_view(self, index: int) -> list[Gaussians]:
        """The sets of Gaussians from which a completed view is rendered: the base's and the aux.

        `index` is the view's number if each view was completed on its own, else without effect.
        """
        return [self.base, self.aux if self.by_view is None else self.by_view[index]]

    def path(
        self,
        trajectory: TrajectoryKind = "rotate-forward",
        disparity: float | None = None,
        frames: int = DEFAULT_FRAME_COUNT,
        looped: bool = False,
    ) -> list[Camera]:
        """Cameras of a path around the photo's camera position, of even width and height.

        Args:
            trajectory: see `spackle.core.trajectories.trajectory_cameras`.
            disparity: size of the camera's movement; by default `Scene.disparity`.
            frames: number of cameras.
            looped: make a path that repeats without a jump.
        """
        if disparity is None:
            disparity = self.disparity
        # A scene of another program does not say how far the camera may move.
        if disparity is None:
            disparity = DEFAULT_MAX_DISPARITY

        # Even sides, because most video formats need them.
        return trajectory_cameras(
            trajectory, self.camera.even(), disparity, self.depth_range, frames, looped
        )

    def along(self, keyframes: KeyframePath, frames: int | None = None) -> list[Camera]:
        """Cameras at equal time steps on a path through keyframes, of even width and height.

        Args:
            keyframes: the path, as `spackle.formats.load_path` reads it from a file.
            frames: number of cameras; by default 30 for each second of the path.

        Raises:
            ValueError: between two keyframes the camera would stand at the point that it looks at,
                or look straight up or down.
        """
        frame_count = frames or keyframes.frame_count(KEYFRAMES_FPS)
        return keyframes.cameras(self.camera.even(), frame_count, self.depth_range)

    def render(self, camera: Camera, renderer: Renderer | None = None) -> Rendering:
        """Render one view of the whole scene."""
        with torch.no_grad():
            return (renderer or get_renderer()).render([self.base, self.aux], camera)

    def frames(
        self, cameras: Iterable[Camera], renderer: Renderer | None = None
    ) -> Iterator[Rendering]:
        """Render the views one after the other, each when it is asked for.

        So a long path needs the memory of one view.
        """
        # Opened here once, not in `render` for each view.
        renderer = renderer or get_renderer()
        for camera in cameras:
            yield self.render(camera, renderer)

    def depth_map(self, renderer: Renderer | None = None) -> Tensor:
        """Depth [H, W] of the base at the photo's camera, 0 in holes; metres for a metric base."""
        with torch.no_grad():
            view = (renderer or get_renderer()).render(self.base, self.camera)
        # In a hole the depth is that of a few faint Gaussians, so it means nothing.
        return torch.where(hole_mask(view.alpha), 0, view.depth)

    def save(self, target: PathOrFile, disparity: float | None = None) -> None:
        """Write a plain PLY that every common viewer opens.

        Args:
            target: a path, or a file that is open for writing bytes.
            disparity: limit of the camera's movement in `spackle view`; by default
                `Scene.disparity`.
        """
        scene = self if disparity is None else dataclasses.replace(self, disparity=disparity)
        write_atomic(target, scene.to_bytes("ply"))

    def page(
        self, name: str, note: str = "", viewed_as: Mapping[str, object] | None = None
    ) -> PageScene:
        """The scene in the form that the page of `spackle view` shows.

        `name` is the title on the page, `note` a line for the user below it; `viewed_as` is the
        description of a former state of the scene, whose lens and paths the page keeps.
        """
        check_has_front(name, self.base)
        # Only a completed photo has a border beyond which things are made up. An edited scene keeps
        # the framing that it has.
        framing = None
        if self.disparity is not None and viewed_as is None:
            # Of all paths a swipe shows most of what lies beyond the border, as a drag does.
            framing = PathOptions(trajectory="swipe").choose_framing(
                self.base, self.camera, self.depth_range, self.disparity, get_renderer()
            )
        return page_scene(
            name,
            self.base,
            self.aux,
            self.camera,
            self.disparity,
            note,
            is_metric=self.is_metric,
            framing=framing,
            viewed_as=viewed_as,
        )

    def page_file(
        self,
        name: str,
        note: str = "",
        caption: str = "",
        viewed_as: Mapping[str, object] | None = None,
    ) -> bytes:
        """The bytes of an HTML file that shows the scene and its motion; it can be sent to anybody.

        `name` is its title, `caption` a text below the picture; `note` and `viewed_as` as in
        `page`.
        """
        page = self.page(name, note, viewed_as)
        # Drawing a scene for the first time takes a browser seconds: until then a small picture of
        # the same view stands there.
        preview = self.render(page.first_view(PREVIEW_SIDE_PX)).rgb
        return single_html(page, caption, preview)

    def export(self, target: PathOrFile, format: str | None = None) -> None:
        """Write a file for other viewers.

        Args:
            target: a path, or a file that is open for writing bytes.
            format: "ply", "compressed.ply", "spz", "v4.spz" (SPZ version 4), "splat", "sog",
                "glb", or "html" (viewer and scene in one file); by default the path's suffix.

        Raises:
            InputError: an unknown format, or a scene too large for the format.
        """
        if format:
            name = Path(f"scene.{format}")
        elif isinstance(target, str | os.PathLike):
            name = Path(target)
        else:
            name = Path("scene")  # without a suffix, so the message asks for the format
        write_atomic(target, self._encoded(name))

    def to_bytes(self, format: str) -> bytes:
        """The bytes that `export` would write."""
        return self._encoded(Path(f"scene.{format}"))

    def _encoded(self, name: Path) -> bytes:
        """The bytes of a file called `name`, whose suffix is the format."""

        def encode_page(file: SceneFile) -> bytes:
            """One HTML file with the viewer and this scene, titled by the file's name."""
            return self.page_file(file.path.stem)

        # A page is made of a scene with base and aux apart, not of the content of a file, so its
        # encoder is added to those of the other formats.
        encode = encoder_for(name, {".html": encode_page})
        content = SceneFile.of_scene(
            name,
            self.base,
            self.aux,
            self.camera,
            is_metric=self.is_metric,
            disparity=self.disparity,
        )
        return encode(content)

    def show(self, height: int = 480) -> InlinePage:
        """A viewer with the scene, `height` pixels high, which a notebook displays in a cell."""
        return InlinePage(self.page_file("scene").decode(), height)

    def save_video(
        self,
        target: PathOrFile,
        trajectory: TrajectoryKind = "rotate-forward",
        disparity: float | None = None,
        frames: int | None = None,
        fps: float = 30,
        loop: int | None = None,
        overscan: float | None = None,
        format: str | None = None,
        renderer: Renderer | None = None,
        *,
        seconds: float | None = None,
        size: str | tuple[int, int] | None = None,
        fit: Fit = "pad",
        show: Show = "color",
        stereo: StereoLayout | None = None,
        ipd: float | None = None,
        convergence: float | None = None,
        compare: bool = False,
        progress: Progress | None = None,
        cancel: Cancel | None = None,
    ) -> None:
        """Write a video of a camera path that repeats without a jump, as `spackle render` does.

        Args:
            target: a path, or a file that is open for writing bytes.
            trajectory: the camera path, see `spackle.core.trajectories.trajectory_cameras`.
            disparity: size of the camera's movement; by default `Scene.disparity`.
            frames: number of frames; by default the video lasts 4 seconds.
            fps: frames per second.
            loop: how often the video is shown; see `spackle.formats.VideoWriter`.
            overscan: relative gain in focal length, which hides most of the fill beyond the
                photo's border; by default it and the camera's target are chosen for the scene.
            format: "mp4", "webm", "gif" or "webp"; by default the path's suffix, or mp4 for an
                open file.
            renderer: by default the best of this machine, on its GPU if it has one.
            seconds: duration, instead of `frames`.
            size: of one eye's view: "1280x720", "16:9" or (width, height); by default the photo's.
            fit: how to reach the aspect ratio of `size`: "pad", "blur" or "crop".
            show: "color", or "depth" as colours.
            stereo: layout of a stereo video: "sbs", "sbs-half", "ou", "ou-half" or "anaglyph".
            ipd: distance of the eyes in metres.
            convergence: depth in metres that appears in the plane of the screen.
            compare: show the base on the left and the completed scene on the right.
            progress: called with (frames done, all frames).
            cancel: asks for the end of the work between two frames, as for `spackle.predict`.

        Raises:
            InputError: an option is impossible, or contradicts another one.
            Cancelled: `cancel` has asked for the end; no video is written.
        """
        # Numbers go the way of a text, too, because `parse_size` checks them.
        if size is not None and not isinstance(size, str):
            size = "x".join(map(str, size))
        video = VideoOptions(
            fps=fps,
            loop=loop,
            size=None if size is None else parse_size(size),
            fit=fit,
            show=show,
            stereo=stereo,
            ipd=ipd,
            convergence=convergence,
            compare=compare,
        )
        path = PathOptions(
            trajectory=trajectory,
            disparity=disparity,
            frames=frames,
            seconds=seconds,
            video=video,
            overscan=overscan,
        )

        self._write_video(target, format, path, renderer, cancellable(progress, cancel))

    def _write_video(
        self,
        target: PathOrFile,
        format: str | None,
        path: PathOptions,
        renderer: Renderer | None,
        progress: Progress,
    ) -> None:
        """Write a video along `path` to a path or an open file.

        `format` is the name of a video format; None: that of the target's suffix, or mp4 for an
        open file. `progress` is called with (frames done, all frames).
        """
        # The encoder writes to a path, and takes the format from its suffix.
        if format is None and isinstance(target, str | os.PathLike):
            file = Path(target)
            self._encode_video(file, path, renderer, progress, name_in_messages=file)
            return

        # In all other cases a temporary file has the right suffix. Messages must not name it by
        # its folder, which the user does not know.
        with tempfile.TemporaryDirectory() as folder:
            name = Path(f"video.{format or 'mp4'}")
            file = Path(folder) / name
            self._encode_video(file, path, renderer, progress, name_in_messages=name)
            write_atomic(target, file.read_bytes())

    def _encode_video(
        self,
        file: Path,
        path: PathOptions,
        renderer: Renderer | None,
        progress: Progress,
        *,
        name_in_messages: Path,
    ) -> None:
        """Render the scene along a path to a video file.

        Args:
            file: the video, whose suffix is its format.
            path: the options of path and video.
            renderer: None: the best renderer of this machine.
            progress: called with (frames done, all frames).
            name_in_messages: stands for `file` in error messages.

        Raises:
            InputError: an option is impossible, or contradicts another one.
        """
        # All options are checked before the first frame is rendered.
        fps = path.video.frames_per_second
        check_video(name_in_messages, fps, path.video.loop)
        video = path.video.for_file(file)
        path = dataclasses.replace(path, video=video)
        path.check()

        used_renderer = renderer or get_renderer()
        framing = path.choose_framing(
            self.base, self.camera, self.depth_range, self.disparity, used_renderer
        )
        cameras = path.video_cameras(
            self.depth_range, self.camera, keyframes=None, disparity=self.disparity, framing=framing
        )
        frame_maker = FrameMaker.of(
            video, self.base, cameras, name_in_messages, is_metric=self.is_metric
        )

        # A frame shows the scene; for a comparison, the base alone to the left of it.
        gaussian_sets = [[self.base, self.aux]]
        if video.compare:
            gaussian_sets.insert(0, [self.base])

        def render_frames() -> Iterator[Tensor]:
            """Render each frame [H, W, 3] when the encoder asks for it, to save memory."""
            progress(0, len(cameras))
            for index, camera in enumerate(cameras):
                frame, _ = frame_maker.render(gaussian_sets, camera, used_renderer)
                yield frame
                progress(index + 1, len(cameras))

        save_video(render_frames(), file, fps, video.loop, name_in_messages=name_in_messages)


def _camera_with_lens(
    file: SceneFile, size: tuple[int, int] | None, focal_px: float | None, fov: float | None
) -> Camera:
    """A camera of this focal length where the file's camera is, or at the origin without one.

    InputError if both `focal_px` and `fov` are given, or one is impossible.
    """
    # The focal length is in pixels of the views that will be rendered.
    if size is not None:
        width, height = size
    elif file.camera is not None:
        width = file.camera.width
        height = file.camera.height
    else:
        width, height = DEFAULT_SIZE_PX
    focal, _ = resolve_focal_length(
        file.path,
        width,
        height,
        exif={},  # a scene has none; without `focal_px` and `fov` a usual lens is assumed
        focal_px=focal_px,
        fov=fov,
    )
    camera = Camera.from_focal(focal, width, height)
    if file.camera is None:
        return camera

    # Another lens does not move the camera.
    return dataclasses.replace(camera, world_to_camera=file.camera.world_to_camera)


@dataclasses.dataclass(frozen=True)
class InlinePage:
    """The viewer, embedded in a notebook."""

    html: str = dataclasses.field(repr=False)
    height: int  # pixels

    def _repr_html_(self) -> str:
        """The page in a frame, as notebooks ask for it."""
        style = f"width: 100%; height: {self.height}px; border: 0"
        page = html.escape(self.html)
        return f'<iframe style="{style}" allowfullscreen srcdoc="{page}"></iframe>'
