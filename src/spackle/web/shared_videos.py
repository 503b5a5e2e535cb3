"""Short videos for sharing: their shapes, and how a picture of another shape fits into them."""

from __future__ import annotations

import dataclasses
from pathlib import PurePath
from typing import Literal

from spackle.core.camera import Camera
from spackle.video.options import Fit
from spackle.video.video_formats import DEFAULT_FPS

SharedVideo = Literal[
    "story.mp4",
    "square.mp4",
    "wide.mp4",
    "story.gif",
    "square.gif",
    "wide.gif",
]
SHARED_SECONDS = 5.0  # of a shared video; the camera path is closed, so it can play for ever

# Width and height in pixels: of a video that fills a phone, and of a GIF, which has no compression
# between its frames worth the name.
MP4_SIZES = {"story": (720, 1280), "square": (720, 720), "wide": (1280, 720)}
GIF_SIZES = {"story": (270, 480), "square": (360, 360), "wide": (480, 270)}
GIF_FPS = 15.0

# If at least this share of a picture stays, it is cropped to the video's shape. Less would cut off
# heads: then the whole picture stands before a blurred one.
MIN_CROPPED_SHARE = 0.7


@dataclasses.dataclass(frozen=True, kw_only=True)
class SharedVideoOptions:
    """Arguments of `Scene.save_video` for a shared video."""

    seconds: float
    fps: float
    size: tuple[int, int]
    fit: Fit


def shared_video_options(name: str, camera: Camera) -> SharedVideoOptions | None:
    """Return the options of the video called `name` of a scene; None for another file's name.

    `camera` is the camera of the scene's photo, whose shape decides how the picture fits.
    """
    path = PurePath(name)
    is_gif = path.suffix == ".gif"
    sizes = GIF_SIZES if is_gif else MP4_SIZES
    if path.stem not in sizes:
        return None

    width, height = sizes[path.stem]
    photo_ratio = camera.width / camera.height
    video_ratio = width / height
    kept_share = min(photo_ratio, video_ratio) / max(photo_ratio, video_ratio)
    return SharedVideoOptions(
        seconds=SHARED_SECONDS,
        fps=GIF_FPS if is_gif else DEFAULT_FPS,
        size=(width, height),
        fit="crop" if kept_share >= MIN_CROPPED_SHARE else "blur",
    )
