"""How views become the frames of a video: one picture or two, colours or depth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.camera_path import DepthRange, KeyframePath, PathError, TrajectoryKind
from spackle.color import DepthColors
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.jobs.options import MAX_FRAMES
from spackle.jobs.video_options import MAX_VIDEO_SIDE, VideoOptions
from spackle.render.protocol import Rendering
from spackle.scene import PATH_FRAMES, scene_path
from spackle.stereo import Stereo, default_ipd

COVERED = 0.5  # less opaque pixels have no depth that a person would call one


@dataclasses.dataclass(frozen=True)
class Film:
    """What each view of a camera path is drawn as."""

    options: VideoOptions
    stereo: Stereo | None = None
    depth: DepthColors | None = None

    def views(self, camera: Camera) -> tuple[Camera, ...]:
        """The view itself, or what the left and the right eye see."""
        return (camera,) if self.stereo is None else self.stereo.eyes(camera)

    def frame(self, views: Sequence[Rendering]) -> Tensor:
        """One frame [H, W, 3], sRGB, of the renderings of `views`."""
        pictures = [self._picture(view) for view in views]
        return pictures[0] if self.stereo is None else self.stereo.pack(*pictures)

    def sized(self, camera: Camera) -> Camera:
        """A view at the size of the video."""
        if self.options.size is None:
            return camera
        width, height = self.options.size
        return cover(camera, width + width % 2, height + height % 2)

    def note(self, name: str, cameras: Sequence[Camera]) -> dict[str, object]:
        """What a report says of a video of these views."""
        width, height = self.frame_size(self.sized(cameras[0]))
        options, stereo = self.options, self.stereo
        return {
            "file": name,
            "frames": len(cameras),
            "fps": options.rate,
            "plays": options.plays,  # 0: for ever
            "width": width,
            "height": height,
            "show": options.show,
            "stereo": None if stereo is None else _stereo_note(stereo),
        }

    def frame_size(self, camera: Camera) -> tuple[int, int]:
        """Width and height of a frame of a view of this size; the file's, too, where these are even."""
        size = (camera.width, camera.height)
        return size if self.stereo is None else self.stereo.frame_size(*size)

    def _picture(self, view: Rendering) -> Tensor:
        if self.depth is None:
            return view.rgb
        return self.depth(view.depth, view.alpha >= COVERED)


def make_film(options: VideoOptions, gaussians: Gaussians, cameras: Sequence[Camera], source: Path) -> Film:
    """The film of a scene along a path; what was not chosen is measured on the scene.

    Raises:
        InputError: a scene where it cannot be measured, or frames that are too large; `source` is named.
    """
    try:
        stereo = _stereo(options, gaussians, cameras[0])
        depth = DepthColors.over(gaussians, cameras) if options.show == "depth" else None
    except ValueError as error:
        raise InputError(f"{source}: no such video: {error}") from error
    film = Film(options, stereo, depth)
    width, height = film.frame_size(film.sized(cameras[0]))
    if max(width, height) > MAX_VIDEO_SIDE:
        hint = "give a smaller --size" if stereo is None else "give a smaller --size, or --stereo sbs-half"
        raise InputError(f"{source}: frames of {width}×{height} have more than {MAX_VIDEO_SIDE} pixels a side: {hint}")
    return film


def _stereo(options: VideoOptions, gaussians: Gaussians, camera: Camera) -> Stereo | None:
    """The eyes that were chosen, or that suit the scene."""
    if options.stereo is None:
        return None
    ipd, convergence = options.ipd, options.convergence
    if ipd is None or convergence is None:
        depths = DepthRange.of(gaussians)
        ipd = default_ipd(camera, depths) if ipd is None else ipd
        convergence = depths.focus if convergence is None else convergence
    if camera.focal[0] * ipd / convergence > camera.width:
        raise ValueError(
            f"eyes {ipd:g} apart and a screen at {convergence:g}: give a smaller --ipd or a larger --convergence"
        )
    return Stereo(options.stereo, ipd, convergence)


def _stereo_note(stereo: Stereo) -> dict[str, object]:
    convergence = stereo.convergence if math.isfinite(stereo.convergence) else None  # JSON knows no infinity
    return {"layout": stereo.layout, "ipd": stereo.ipd, "convergence": convergence}


def fly(
    gaussians: Gaussians,
    camera: Camera,
    kind: TrajectoryKind | KeyframePath,
    disparity: float,
    frames: int | None,
    options: VideoOptions,
) -> list[Camera]:
    """The cameras of a video: along a trajectory, or through keyframes, at the photo's size made even.

    Without a number of frames a trajectory has 60, and keyframes take their seconds.

    Raises:
        ValueError: no such path through this scene.
    """
    if isinstance(kind, KeyframePath):
        count = frames or kind.frame_count(options.rate)
        if count > MAX_FRAMES:
            raise PathError(f"{kind.seconds:g} s take {count} frames (at most {MAX_FRAMES}): give --frames")
        return kind.cameras(camera.even(), count, DepthRange.of(gaussians))
    return scene_path(gaussians, camera, kind, disparity, frames or PATH_FRAMES, looped=options.plays != 1)


def cover(camera: Camera, width: int, height: int) -> Camera:
    """The view on another grid with nothing squeezed: another aspect ratio cuts off two sides."""
    scale = max(width / camera.width, height / camera.height)
    K = camera.K.clone()
    K[:2, :2] *= scale
    center = torch.tensor([camera.width / 2, camera.height / 2])
    K[:2, 2] = torch.tensor([width / 2, height / 2]) + scale * (camera.K[:2, 2] - center)
    return dataclasses.replace(camera, K=K, width=width, height=height)
