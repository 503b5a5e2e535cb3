"""Frames of a video from renderings: size, margins, one eye or two, colour or depth.

`FrameMaker` makes the frames; the functions below it change the size of views and images.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.core.camera import Camera
from spackle.core.color import DepthColorScale
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import DepthRange
from spackle.render.protocol import Renderer, Rendering
from spackle.runtime.errors import InputError
from spackle.video.options import MAX_VIDEO_SIDE_PX, VideoOptions
from spackle.video.stereo import Stereo, default_ipd

# If the aspect ratios of view and video differ by less, the view is cropped, because margins
# would be very thin.
SAME_ASPECT_TOLERANCE = 0.01

# Blurred margins are a copy of the image, reduced to this long side and enlarged again, and
# darkened by this factor.
BLURRED_MARGIN_LONG_SIDE_PX = 12
BLURRED_MARGIN_BRIGHTNESS = 0.6

# A white bar between the two images of a comparison.
COMPARE_GAP_PX = 6

# A pixel of smaller opacity is shown without a depth.
MIN_ALPHA_WITH_DEPTH = 0.5


@dataclasses.dataclass(frozen=True)
class FrameMaker:
    """Makes frames of a video from renderings."""

    options: VideoOptions
    stereo: Stereo | None = None  # None: one eye
    depth: DepthColorScale | None = None  # None: colours are shown

    @staticmethod
    def of(
        options: VideoOptions,
        gaussians: Gaussians,
        cameras: Sequence[Camera],
        source: Path,
        *,
        is_metric: bool = False,
    ) -> FrameMaker:
        """Make a frame maker; what the options leave open follows from the scene and the cameras.

        Args:
            options: what the video looks like.
            gaussians: the scene.
            cameras: the views of all frames, of one size.
            source: the file whose name begins messages.
            is_metric: whether the scene's unit is known to be the metre.

        Raises:
            InputError: the video is impossible, or its frames are too large.
        """
        depth_scale = None
        try:
            # The eyes' distance follows from the first view, and stays the same in all others.
            stereo = _derive_stereo(options, gaussians, cameras[0], is_metric)
            if options.show == "depth":
                depth_scale = DepthColorScale.over(gaussians, cameras)
        except ValueError as error:
            raise InputError(f"{source}: this video is impossible: {error}") from error

        maker = FrameMaker(options, stereo=stereo, depth=depth_scale)
        # All views have one size, so the first one stands for all.
        width, height = maker.frame_size(maker.resized_camera(cameras[0]))
        if max(width, height) > MAX_VIDEO_SIDE_PX:
            problem = f"frames of {width}×{height} have more than {MAX_VIDEO_SIDE_PX} pixels a side"
            advice = "give a smaller `size`"
            if stereo is not None:
                advice += ", or `stereo` sbs-half"
            raise InputError(f"{source}: {problem}: {advice}")
        return maker

    @property
    def is_plain(self) -> bool:
        """Whether a frame is one colour view at the size of its camera."""
        return self.stereo is None and self.depth is None and self.options.size is None

    @property
    def image_size(self) -> tuple[int, int] | None:
        """Width and height in pixels of one eye's image with its margins.

        Both are made even, because in most videos each 2×2 pixels share a colour. None if the
        options give no size.
        """
        if self.options.size is None:
            return None
        width, height = self.options.size
        return width + width % 2, height + height % 2

    def eyes(self, camera: Camera) -> tuple[Camera, ...]:
        """Return the camera itself, or those of a stereo view's left and right eye."""
        if self.stereo is None:
            return (camera,)
        return self.stereo.eyes(camera)

    def render(
        self, scenes: Sequence[list[Gaussians]], camera: Camera, renderer: Renderer
    ) -> tuple[Tensor, list[Rendering]]:
        """Render a frame, which shows one scene, or compares two.

        Args:
            scenes: the scene; for a comparison, first the scene without the Gaussians that fill
                holes, then the scene with them. The Gaussians of a scene are given as a list, such
                as those from the photo and those that fill holes, and are rendered together.
            camera: the view.
            renderer: renders each scene for each eye.

        Returns:
            The frame [H, W, 3] sRGB, and the renderings from which it was made.
        """
        with torch.no_grad():
            eyes = [self.resized_camera(eye) for eye in self.eyes(camera)]
            renderings = [renderer.render(scene, eye) for scene in scenes for eye in eyes]
            return self.frame(renderings), renderings

    def frame(self, renderings: Sequence[Rendering]) -> Tensor:
        """Return one frame [H, W, 3] sRGB.

        Args:
            renderings: one for each eye, the left one first. A comparison has one eye and two
                renderings: of the scene without and with filled holes.
        """
        pictures = [self._picture(rendering) for rendering in renderings]
        if self.image_size is not None:
            width, height = self.image_size
            is_blurred = self.options.fit == "blur"
            pictures = [with_margins(image, width, height, is_blurred) for image in pictures]

        if self.options.compare:
            left, right = pictures
            white_bar = left.new_ones(len(left), COMPARE_GAP_PX, 3)
            return torch.cat([left, white_bar, right], dim=1)
        if self.stereo is None:
            return pictures[0]
        left, right = pictures
        return self.stereo.pack(left, right)

    def _picture(self, rendering: Rendering) -> Tensor:
        """Return what the video shows of a view, colours or depth, as [H, W, 3] sRGB."""
        if self.depth is None:
            return rendering.rgb
        has_depth = rendering.alpha >= MIN_ALPHA_WITH_DEPTH
        return self.depth(rendering.depth, has_depth)

    def resized_camera(self, camera: Camera) -> Camera:
        """Return the camera at the size at which one eye's image is rendered.

        That is the size of the image without its margins, which are added after rendering.
        """
        if self.image_size is None:
            return camera
        width, height = self.image_size
        scale_across = width / camera.width
        scale_down = height / camera.height
        is_same_aspect = abs(scale_across / scale_down - 1) < SAME_ASPECT_TOLERANCE
        if self.options.fit == "crop" or is_same_aspect:
            return crop_camera_to_size(camera, width, height)

        # The whole view fits into the image, and margins will fill the rest.
        scale = min(scale_across, scale_down)
        inner_width = max(1, round(scale * camera.width))
        inner_height = max(1, round(scale * camera.height))
        return camera.resized(inner_width, inner_height)

    def frame_size(self, camera: Camera) -> tuple[int, int]:
        """Return width and height of the video's frames in pixels.

        Args:
            camera: a view of the video. Unless the options give a size, one eye's image has the
                size of this view.
        """
        width = camera.width
        height = camera.height
        if self.image_size is not None:
            width, height = self.image_size
        if self.options.compare:
            return 2 * width + COMPARE_GAP_PX, height
        if self.stereo is not None:
            return self.stereo.frame_size(width, height)
        return width, height

    def report_entry(self, name: str, camera: Camera, frames: int) -> dict[str, object]:
        """Return the entry for the video in report.json.

        Args:
            name: the video's file name.
            camera: a view of the video; only its size matters.
            frames: how many frames the video has.
        """
        width, height = self.frame_size(self.resized_camera(camera))
        stereo = None
        if self.stereo is not None:
            stereo = dataclasses.asdict(self.stereo)
            if math.isinf(self.stereo.convergence):
                stereo["convergence"] = None  # JSON has no infinity
        return {
            "file": name,
            "frames": frames,
            "fps": self.options.frames_per_second,
            "plays": self.options.play_count,
            "width": width,
            "height": height,
            "show": self.options.show,
            "stereo": stereo,
        }


def _derive_stereo(
    options: VideoOptions, gaussians: Gaussians, camera: Camera, is_metric: bool
) -> Stereo | None:
    """Return the eyes of a stereo video, or None if the options ask for no stereo.

    If the options do not give the distance of the eyes (`ipd`) or the depth that appears at the
    screen (`convergence`), they follow from the scene's depth.

    Args:
        options: what the video looks like.
        gaussians: the scene.
        camera: the first view.
        is_metric: whether the scene's unit is known to be the metre.

    Raises:
        ValueError: the eyes are so far apart that their images have nothing in common.
    """
    if options.stereo is None:
        return None
    ipd = options.ipd
    convergence = options.convergence
    if ipd is None or convergence is None:
        depths = DepthRange.of(gaussians, is_metric=is_metric)
        if ipd is None:
            ipd = default_ipd(camera, depths)
        if convergence is None:
            convergence = depths.focus

    # By so many pixels the two images are shifted, so that the depth `convergence` coincides.
    parallax_px = camera.focal[0] * ipd / convergence
    if parallax_px > camera.width:
        eyes = f"eyes {ipd:g} apart, screen at {convergence:g}"
        raise ValueError(f"{eyes}: give a smaller `ipd` or larger `convergence`")
    return Stereo(options.stereo, ipd, convergence)


def crop_camera_to_size(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera whose view is scaled and cropped to another size in pixels.

    The view is scaled without distortion until it covers the new size. If the aspect ratio differs,
    it is cropped equally on two opposite sides.
    """
    scale = max(width / camera.width, height / camera.height)
    K = camera.zoomed(scale).K
    # The principal point keeps its scaled distance from the image's centre.
    old_center = torch.tensor([camera.width / 2, camera.height / 2])
    new_center = torch.tensor([width / 2, height / 2])
    K[:2, 2] = new_center + scale * (camera.K[:2, 2] - old_center)
    return dataclasses.replace(camera, K=K, width=width, height=height)


def with_margins(picture: Tensor, width: int, height: int, blurred: bool) -> Tensor:
    """Put an image [h, w, 3] in the middle of another one.

    Args:
        picture: sRGB, at most as large as the result.
        width, height: size of the result in pixels.
        blurred: whether the margins show a blurred copy of the image; else they are black.

    Returns:
        [height, width, 3] sRGB.
    """
    inner_height, inner_width = picture.shape[:2]
    if (inner_width, inner_height) == (width, height):
        return picture
    canvas = picture.new_zeros(height, width, 3)
    if blurred:
        canvas = _blurred_background(picture, width, height)
    top = (height - inner_height) // 2
    left = (width - inner_width) // 2
    canvas[top : top + inner_height, left : left + inner_width] = picture
    return canvas


def _blurred_background(picture: Tensor, width: int, height: int) -> Tensor:
    """Return a dark, blurred background [height, width, 3] that is made from an image [h, w, 3]."""
    picture_height, picture_width = picture.shape[:2]
    # The largest part of the image, around its middle, that has the background's aspect ratio.
    scale = max(width / picture_width, height / picture_height)
    row_count = min(picture_height, max(1, round(height / scale)))
    column_count = min(picture_width, max(1, round(width / scale)))
    top = (picture_height - row_count) // 2
    left = (picture_width - column_count) // 2
    middle = picture[top : top + row_count, left : left + column_count]
    middle = middle.permute(2, 0, 1)[None]  # [1, 3, row_count, column_count]

    # Reducing the image to a few pixels and enlarging it again blurs it.
    long_side = max(row_count, column_count)
    small_height = max(1, round(BLURRED_MARGIN_LONG_SIDE_PX * row_count / long_side))
    small_width = max(1, round(BLURRED_MARGIN_LONG_SIDE_PX * column_count / long_side))
    small = interpolate(middle, size=(small_height, small_width), mode="area")
    blurred = interpolate(small, size=(height, width), mode="bicubic")
    # Bicubic interpolation may overshoot 0..1.
    return BLURRED_MARGIN_BRIGHTNESS * blurred[0].clamp(0, 1).permute(1, 2, 0)


def video_problem(cameras: Sequence[Camera]) -> str | None:
    """Return the reason why these views cannot be the frames of one video; None if they can."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        return "the frames differ in size"
    if max(max(size) for size in sizes) > MAX_VIDEO_SIDE_PX:
        return f"the frames have more than {MAX_VIDEO_SIDE_PX} pixels a side"
    return None
