"""A photo's completed scene: render it along a path, save it, export it, show it."""

from __future__ import annotations

import dataclasses
import html
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases import DEFAULT_MAX_DISPARITY
from spackle.core import trajectories as camera_path
from spackle.core.camera import Camera
from spackle.core.focal_length import resolve_focal_length
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import DEFAULT_OVERSCAN, DepthRange, KeyframePath, TrajectoryKind
from spackle.formats.html import PageScene, page_scene, single_html
from spackle.formats.scene_content import SceneFile, is_at_origin
from spackle.formats.scene_files import Encoder, encoder_for, load_scene
from spackle.render import Renderer, get_renderer
from spackle.render.protocol import Rendering
from spackle.residual.features import hole_mask
from spackle.runtime.files import PathOrFile, write_atomic
from spackle.video.encoding import check_video, save_video
from spackle.video.frames import FrameMaker
from spackle.video.options import Fit, Show, StereoLayout, VideoOptions, parse_size
from spackle.views import DEFAULT_FRAME_COUNT, PathOptions

DEFAULT_SIZE = (1280, 720)  # width and height for a file that stores no camera


@dataclasses.dataclass(frozen=True)
class Scene:
    """Base and aux Gaussians of a photo, in the coordinates of the photo's camera."""

    base: Gaussians  # predicted from the photo; never changed
    aux: Gaussians  # added by completion
    camera: Camera  # the photo's camera, at the origin
    by_view: tuple[Gaussians, ...] | None = (
        None  # in view mode: the aux Gaussians of each completed view
    )
    disparity: float | None = None  # the disparity for which the scene was completed, if known

    def __repr__(self) -> str:
        size = f"{self.camera.width}×{self.camera.height}"
        return f"Scene({len(self.base):,} base + {len(self.aux):,} aux Gaussians, {size}, {self.base.means.device})"

    @staticmethod
    def load(
        path: str | os.PathLike[str], *, focal_px: float | None = None, fov: float | None = None
    ) -> Scene:
        """Read a PLY (ours, INRIA's, SHARP's or PlayCanvas's), SPZ, SOG or .splat file; InputError for any other.

        Args:
            path: the file.
            focal_px: focal length in pixels; by default the stored focal length, or a 35 mm equivalent of 30 mm.
            fov: horizontal field of view in degrees, instead of `focal_px`.
        """
        return Scene.of_file(load_scene(Path(path)), focal_px=focal_px, fov=fov)

    @staticmethod
    def of_file(
        file: SceneFile, size: tuple[int, int] | None = None, **lens: float | None
    ) -> Scene:
        """The scene in a loaded file; see `load`. `size` is the camera's size if a lens is given, or none is stored."""
        gaussians, camera = file.gaussians, file.camera
        if camera is None or any(value is not None for value in lens.values()):
            width, height = size or ((camera.width, camera.height) if camera else DEFAULT_SIZE)
            focal, _ = resolve_focal_length(file.path, width, height, {}, **lens)
            given = Camera.from_focal(focal, width, height)
            pose = given.world_to_camera if camera is None else camera.world_to_camera
            camera = dataclasses.replace(given, world_to_camera=pose)
        if not is_at_origin(camera):
            gaussians = gaussians.transform(camera.world_to_camera)
            camera = dataclasses.replace(camera, world_to_camera=torch.eye(4))
        count = len(gaussians) if file.base_count is None else file.base_count
        base, aux = gaussians.select(slice(0, count)), gaussians.select(slice(count, None))
        return Scene(base, aux, camera, disparity=file.disparity)

    @property
    def gaussians(self) -> Gaussians:
        """All Gaussians, the base's first."""
        return Gaussians.cat([self.base, self.aux])

    def of_view(self, index: int) -> list[Gaussians]:
        """The sets of Gaussians from which a completed view is rendered."""
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
            disparity: by default `Scene.disparity`.
            frames: number of cameras.
            looped: make a path that repeats without a jump.
        """
        usual = DEFAULT_MAX_DISPARITY if self.disparity is None else self.disparity
        reach, depths = usual if disparity is None else disparity, DepthRange.of(self.base)
        return camera_path.trajectory_cameras(
            trajectory, self.camera.even(), reach, depths, frames, looped
        )

    def along(self, keyframes: KeyframePath, frames: int | None = None) -> list[Camera]:
        """Cameras through keyframes (see `spackle.formats.load_path`), by default 30 for each second.

        Raises:
            ValueError: a view between two keyframes is impossible.
        """
        count = frames or keyframes.frame_count(30)
        return keyframes.cameras(self.camera.even(), count, DepthRange.of(self.base))

    def render(self, camera: Camera, renderer: Renderer | None = None) -> Rendering:
        """Render one view of the whole scene."""
        with torch.no_grad():
            return (renderer or get_renderer()).render([self.base, self.aux], camera)

    def frames(
        self, cameras: Iterable[Camera], renderer: Renderer | None = None
    ) -> Iterator[Rendering]:
        """Render the views one after the other."""
        renderer = renderer or get_renderer()
        for camera in cameras:
            yield self.render(camera, renderer)

    def depth_map(self, renderer: Renderer | None = None) -> Tensor:
        """Depth [H, W] of the base at the photo's camera, in metres for a metric base; 0 in holes."""
        with torch.no_grad():
            view = (renderer or get_renderer()).render(self.base, self.camera)
        return torch.where(hole_mask(view.alpha), 0, view.depth)

    def save(self, target: PathOrFile, disparity: float | None = None) -> None:
        """Write a plain PLY that every common viewer opens.

        Args:
            target: a path, or a file that is open for writing bytes.
            disparity: limit of the camera's movement in `spackle view`; by default `Scene.disparity`.
        """
        scene = self if disparity is None else dataclasses.replace(self, disparity=disparity)
        write_atomic(target, scene.to_bytes("ply"))

    def page(self, name: str, note: str = "") -> PageScene:
        """The scene in the form that `spackle view` shows; see `page_scene`."""
        return page_scene(name, self.base, self.aux, self.camera, self.disparity, note)

    def export(self, target: PathOrFile, format: str | None = None) -> None:
        """Write a file for other viewers.

        Args:
            target: a path, or a file that is open for writing bytes.
            format: "ply", "compressed.ply", "spz", "splat", "sog", "glb", or "html" (viewer and scene in one file); by
                default the path's suffix.

        Raises:
            InputError: an unknown format, or a scene too large for the format.
        """
        name = target if isinstance(target, str | os.PathLike) else "scene"
        write_atomic(target, self._encoded(Path(f"scene.{format}" if format else name)))

    def to_bytes(self, format: str) -> bytes:
        """The bytes that `export` would write."""
        return self._encoded(Path(f"scene.{format}"))

    def _encoded(self, name: Path) -> bytes:
        page: Encoder = lambda file: single_html(self.page(file.path.stem))  # noqa: E731
        file = SceneFile(name, self.gaussians, self.camera, len(self.base), self.disparity)
        return encoder_for(name, {".html": page})(file)

    def show(self, height: int = 480) -> InlinePage:
        """A viewer with the scene, `height` pixels high, which a notebook displays as the value of a cell."""
        return InlinePage(single_html(self.page("scene")).decode(), height)

    def save_video(
        self,
        target: PathOrFile,
        trajectory: TrajectoryKind = "rotate-forward",
        disparity: float | None = None,
        frames: int | None = None,
        fps: float = 30,
        loop: int | None = None,
        overscan: float = DEFAULT_OVERSCAN,
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
    ) -> None:
        """Write a video of a camera path that repeats without a jump, as `spackle render` does; see `path`.

        Args:
            target: a path, or a file that is open for writing bytes.
            trajectory, disparity: see `path`.
            frames, seconds: number of frames or duration; by default, the video lasts 4 seconds.
            fps: frames per second.
            loop: see `spackle.formats.VideoWriter`.
            overscan: relative gain in focal length, which hides most of the fill beyond the photo's border.
            format: "mp4", "webm", "gif" or "webp"; by default the path's suffix, or mp4 for an open file.
            renderer: by default the best of this machine, on its GPU if it has one.
            size, fit, show, stereo, ipd, convergence, compare: see the options of `spackle render`; `size` is
                "1280x720", "16:9" or (width, height).

        Raises:
            InputError: an option is impossible, or contradicts another one.
        """
        named = format is None and isinstance(target, str | os.PathLike)
        pixels = (
            None
            if size is None
            else parse_size(size if isinstance(size, str) else "x".join(map(str, size)))
        )
        with tempfile.TemporaryDirectory() as folder:
            file = Path(target) if named else Path(folder) / f"video.{format or 'mp4'}"  # type: ignore[arg-type]
            shown = file if named else Path(file.name)
            check_video(shown, fps, loop)
            video = VideoOptions(
                fps=fps,
                loop=loop,
                size=pixels,
                fit=fit,
                show=show,
                stereo=stereo,
                ipd=ipd,
                convergence=convergence,
                compare=compare,
            ).for_file(file)
            path = PathOptions(
                trajectory=trajectory,
                disparity=disparity,
                frames=frames,
                seconds=seconds,
                video=video,
                overscan=overscan,
            )
            path.check()
            cameras = path.video_cameras(self.base, self.camera, None, self.disparity)
            maker = FrameMaker.of(video, self.base, cameras, shown)
            parts = [[self.base]] * compare + [[self.base, self.aux]]
            used = renderer or get_renderer()
            save_video(
                (maker.render(parts, camera, used)[0] for camera in cameras),
                file,
                fps,
                loop,
                name_in_messages=shown,
            )
            if not named:
                write_atomic(target, file.read_bytes())


@dataclasses.dataclass(frozen=True)
class InlinePage:
    """The viewer, embedded in a notebook."""

    html: str = dataclasses.field(repr=False)
    height: int  # pixels

    def _repr_html_(self) -> str:
        style = f"width: 100%; height: {self.height}px; border: 0"
        return (
            f'<iframe style="{style}" allowfullscreen srcdoc="{html.escape(self.html)}"></iframe>'
        )
