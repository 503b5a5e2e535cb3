"""Frames of a video: size, fit, one eye or two, colour or depth."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, cast, get_args

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from spackle.core.camera import Camera
from spackle.core.color import DepthColorScale, linear_to_srgb, srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import DepthRange
from spackle.render.protocol import Renderer, Rendering
from spackle.runtime.errors import InputError, check_name
from spackle.video.encoding import VIDEO_FORMATS, check_video

VideoFormatName = Literal["mp4", "webm", "gif", "webp"]
Show = Literal["color", "depth"]
StereoLayout = Literal["sbs", "sbs-half", "ou", "ou-half", "anaglyph"]
PARALLAX = (
    0.03  # difference in parallax between z_near and infinity, as a share of the image's width
)
Fit = Literal["pad", "blur", "crop"]
PRESETS = {
    "16:9": (1920, 1080),
    "9:16": (1080, 1920),
    "1:1": (1080, 1080),
}  # names that --size accepts
ALIKE = 0.01  # if aspect ratios differ by less, the view is cropped, which avoids thin margins
BLURRED_PX, BLURRED_LIGHT = (
    12,
    0.6,
)  # long side of the reduced image that makes blurred margins; margins' brightness
COMPARE_GAP_PX = 6  # pixels between the two images of --compare
MAX_VIDEO_SIDE = 8192
MAX_IPD = 1e6
DEFAULT_FPS = 30
COVERED = 0.5  # a pixel of smaller opacity has no depth

# E. Dubois, "A projection method to generate anaglyph stereo images", ICASSP 2001, for red-cyan glasses, in linear
# light. A row holds the weights of one eye's R, G and B in one channel of the result.
DUBOIS_LEFT = ((0.456, 0.500, 0.176), (-0.040, -0.038, -0.016), (-0.015, -0.021, -0.005))
DUBOIS_RIGHT = ((-0.043, -0.088, -0.002), (0.378, 0.734, -0.018), (-0.072, -0.113, 1.226))


@dataclasses.dataclass(frozen=True)
class Stereo:
    """The two eyes of a stereo view, and the layout of their images."""

    layout: StereoLayout
    ipd: float  # distance between the eyes, in the scene's unit (metres if the base is metric)
    convergence: float  # depth without parallax, which appears at the screen; may be infinite

    def eyes(self, camera: Camera) -> tuple[Camera, Camera]:
        """Cameras of the left and the right eye: parallel, on both sides of `camera` along its x axis.

        Principal points are shifted so that points at depth `convergence` have the same position in both images.
        """
        views = []
        for right in (-self.ipd / 2, self.ipd / 2):
            K, matrix = camera.K.clone(), camera.world_to_camera.clone()
            matrix[0, 3] -= right
            K[0, 2] += K[0, 0] * (right / self.convergence)
            views.append(dataclasses.replace(camera, K=K, world_to_camera=matrix))
        return views[0], views[1]

    def pack(self, left: Tensor, right: Tensor) -> Tensor:
        """Combine the eyes' images [H, W, 3], sRGB, in one frame.

        In sbs [H, 2W, 3] the left eye is on the left, in ou [2H, W, 3] on top. The half variants squeeze the frame to
        [H, W, 3] (an odd side grows by one). Anaglyph is for glasses with the red filter on the left eye.
        """
        if self.layout == "anaglyph":
            return anaglyph(left, right)
        side, half = self.layout.startswith("sbs"), self.layout.endswith("half")
        pictures = [_halved(picture, side) if half else picture for picture in (left, right)]
        return torch.cat(pictures, dim=1 if side else 0)

    def frame_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of a frame, for eyes' images of this size."""
        wide, tall = {"sbs": (2 * width, height), "ou": (width, 2 * height)}.get(
            self.layout, (width, height)
        )
        if self.layout == "sbs-half":
            wide += width % 2
        elif self.layout == "ou-half":
            tall += height % 2
        return wide, tall


def default_ipd(camera: Camera, depth_range: DepthRange) -> float:
    """The distance between the eyes that gives a parallax of 3 % of the image's width between z_near and infinity."""
    return PARALLAX * camera.width / camera.focal[0] * depth_range.near


def anaglyph(left: Tensor, right: Tensor) -> Tensor:
    """Mix two sRGB images [..., 3] to a red-cyan image, in linear light."""
    one, other = srgb_to_linear(left), srgb_to_linear(right)
    mixed = one @ one.new_tensor(DUBOIS_LEFT).T + other @ other.new_tensor(DUBOIS_RIGHT).T
    return linear_to_srgb(mixed)


def _halved(picture: Tensor, side: bool) -> Tensor:
    """Halve an image's width (`side`) or its height (not `side`), in linear light."""
    height, width = picture.shape[:2]
    size = (height, (width + 1) // 2) if side else ((height + 1) // 2, width)
    light = srgb_to_linear(picture).permute(2, 0, 1)[None]
    return linear_to_srgb(adaptive_avg_pool2d(light, size))[0].permute(1, 2, 0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class VideoOptions:
    """Options that all videos share."""

    format: VideoFormatName | None = None  # None: mp4
    fps: float | None = None  # None: 30; must be None for a clip, whose frame rate is kept
    loop: int | None = None  # None: gif and webp repeat for ever, mp4 and webm play once
    size: tuple[int, int] | None = None  # width and height of one eye's image; None: the photo's
    fit: Fit = (
        "pad"  # for a view of another aspect ratio: black margins, blurred margins, or cropping
    )
    show: Show = "color"
    stereo: StereoLayout | None = None
    ipd: float | None = None  # None: `default_ipd`
    convergence: float | None = None  # None: the focus depth
    compare: bool = (
        False  # whether each frame shows the base on the left and the completed scene on the right
    )

    @property
    def suffix(self) -> str:
        """The suffix of a file name."""
        return f".{self.format or 'mp4'}"

    @property
    def frames_per_second(self) -> float:
        """Frames a second."""
        return DEFAULT_FPS if self.fps is None else self.fps

    @property
    def plays(self) -> int:
        """How often the video is shown; 0: for ever."""
        return VIDEO_FORMATS[self.suffix].loop if self.loop is None else self.loop

    def check(self) -> None:
        """Raise an InputError for unknown names, and for options that contradict each other."""
        check_name("fit", self.fit, get_args(Fit))
        check_name("show", self.show, get_args(Show))
        if self.stereo is not None:
            check_name("stereo", self.stereo, get_args(StereoLayout))
        for option, loop in (
            (f"--fps {self.frames_per_second:g}", None),
            (f"--loop {self.loop}", self.loop),
        ):
            try:
                check_video(name := f"video{self.suffix}", self.frames_per_second, loop)
            except InputError as error:
                raise InputError(f"{option}: {str(error).removeprefix(f'{name}: ')}") from error
        for option, value in {"--ipd": self.ipd, "--convergence": self.convergence}.items():
            if value is None:
                continue
            if self.stereo is None:
                raise InputError(
                    f"{option} {value:g} needs --stereo: add --stereo, or leave {option} out"
                )
            if not value > 0 or (option == "--ipd" and value > MAX_IPD):
                raise InputError(f"{option} must be a positive number, got {value:g}")
        if self.compare and self.stereo is not None:
            raise InputError(
                f"--compare and --stereo {self.stereo} are given together: leave one of them out"
            )
        if self.show == "depth" and self.stereo == "anaglyph":
            raise InputError(
                "--show depth: an anaglyph would mix the colours that stand for depth: give --stereo sbs or ou"
            )

    def for_file(self, file: Path) -> VideoOptions:
        """Set the format by a file's suffix; InputError if --format contradicts the suffix."""
        suffix = file.suffix.lower()
        meant = "mp4" if suffix in (".m4v", ".mov") else cast(VideoFormatName, suffix[1:])
        if self.format not in (None, meant):
            raise InputError(
                f"--format {self.format}: the name {file} means {meant}: leave one of them out"
            )
        return dataclasses.replace(self, format=meant)


@dataclasses.dataclass(frozen=True)
class FrameMaker:
    """Makes frames of a video from renderings."""

    options: VideoOptions
    stereo: Stereo | None = None
    depth: DepthColorScale | None = None

    @staticmethod
    def of(
        options: VideoOptions, gaussians: Gaussians, cameras: Sequence[Camera], source: Path
    ) -> FrameMaker:
        """Derive missing options from the scene and the cameras; InputError, naming `source`, for impossible videos."""
        try:
            stereo = _stereo(options, gaussians, cameras[0])
            depth = DepthColorScale.over(gaussians, cameras) if options.show == "depth" else None
        except ValueError as error:
            raise InputError(f"{source}: this video is impossible: {error}") from error
        maker = FrameMaker(options, stereo, depth)
        width, height = maker.frame_size(maker.resized_camera(cameras[0]))
        if max(width, height) > MAX_VIDEO_SIDE:
            hint = (
                "give a smaller --size"
                if stereo is None
                else "give a smaller --size, or --stereo sbs-half"
            )
            raise InputError(
                f"{source}: frames of {width}×{height} have more than {MAX_VIDEO_SIDE} pixels a side: {hint}"
            )
        return maker

    @property
    def is_plain(self) -> bool:
        """Whether a frame is one colour view at the size of its camera."""
        return self.stereo is None and self.depth is None and self.options.size is None

    @property
    def canvas(self) -> tuple[int, int] | None:
        """Width and height of one eye's image, both even, if --size is given; else None."""
        size = self.options.size
        return size and (size[0] + size[0] % 2, size[1] + size[1] % 2)

    def eyes(self, camera: Camera) -> tuple[Camera, ...]:
        """The camera itself, or the cameras of a stereo view's left and right eye."""
        return (camera,) if self.stereo is None else self.stereo.eyes(camera)

    def render(
        self, parts: Sequence[list[Gaussians]], camera: Camera, renderer: Renderer
    ) -> tuple[Tensor, list[Rendering]]:
        """A frame, and renderings of each of `parts` (base and scene with `compare`, else the scene) by each eye."""
        with torch.no_grad():
            eyes = [self.resized_camera(eye) for eye in self.eyes(camera)]
            views = [renderer.render(part, eye) for part in parts for eye in eyes]
            return self.frame(views), views

    def frame(self, views: Sequence[Rendering]) -> Tensor:
        """One sRGB frame [H, W, 3] from renderings of `eyes`; with `compare`, from renderings of base and scene."""
        pictures = [
            v.rgb if self.depth is None else self.depth(v.depth, v.alpha >= COVERED) for v in views
        ]
        if self.canvas is not None:
            pictures = [
                with_margins(picture, *self.canvas, self.options.fit == "blur")
                for picture in pictures
            ]
        if self.options.compare:
            left, right = pictures
            return torch.cat([left, left.new_ones(len(left), COMPARE_GAP_PX, 3), right], dim=1)
        return pictures[0] if self.stereo is None else self.stereo.pack(*pictures)

    def resized_camera(self, camera: Camera) -> Camera:
        """The camera at the size of one eye's image without margins."""
        if self.canvas is None:
            return camera
        width, height = self.canvas
        across, down = width / camera.width, height / camera.height
        if self.options.fit == "crop" or abs(across / down - 1) < ALIKE:
            return crop_camera_to_size(camera, width, height)
        scale = min(across, down)
        return camera.resized(
            *(max(1, round(scale * side)) for side in (camera.width, camera.height))
        )

    def frame_size(self, camera: Camera) -> tuple[int, int]:
        """Width and height of a frame for a view of the camera's size."""
        width, height = self.canvas or (camera.width, camera.height)
        if self.options.compare:
            return 2 * width + COMPARE_GAP_PX, height
        return (width, height) if self.stereo is None else self.stereo.frame_size(width, height)

    def report_entry(self, name: str, camera: Camera, frames: int) -> dict[str, object]:
        """The report's entry for the video."""
        width, height = self.frame_size(self.resized_camera(camera))
        stereo = None if self.stereo is None else dataclasses.asdict(self.stereo)
        if stereo is not None and math.isinf(stereo["convergence"]):
            stereo["convergence"] = None  # JSON has no infinity
        return {
            "file": name,
            "frames": frames,
            "fps": self.options.frames_per_second,
            "plays": self.options.plays,
            "width": width,
            "height": height,
            "show": self.options.show,
            "stereo": stereo,
        }


def _stereo(options: VideoOptions, gaussians: Gaussians, camera: Camera) -> Stereo | None:
    if options.stereo is None:
        return None
    ipd, convergence = options.ipd, options.convergence
    if ipd is None or convergence is None:
        depths = DepthRange.of(gaussians)
        ipd = default_ipd(camera, depths) if ipd is None else ipd
        convergence = depths.focus if convergence is None else convergence
    if camera.focal[0] * ipd / convergence > camera.width:
        raise ValueError(
            f"eyes {ipd:g} apart, screen at {convergence:g}: give a smaller --ipd or larger --convergence"
        )
    return Stereo(options.stereo, ipd, convergence)


def crop_camera_to_size(camera: Camera, width: int, height: int) -> Camera:
    """The view at another size, scaled without distortion; two sides are cropped if the aspect ratio differs."""
    scale = max(width / camera.width, height / camera.height)
    K = camera.zoomed(scale).K
    center = torch.tensor([camera.width / 2, camera.height / 2])
    K[:2, 2] = torch.tensor([width / 2, height / 2]) + scale * (camera.K[:2, 2] - center)
    return dataclasses.replace(camera, K=K, width=width, height=height)


def with_margins(picture: Tensor, width: int, height: int, blurred: bool) -> Tensor:
    """Centre an image [h, w, 3] in another [height, width, 3]; margins are black, or a blurred copy of the image."""
    h, w = picture.shape[:2]
    if (w, h) == (width, height):
        return picture
    canvas = picture.new_zeros(height, width, 3)
    if blurred:
        scale = max(width / w, height / h)
        rows, columns = (
            min(side, max(1, round(n / scale))) for side, n in ((h, height), (w, width))
        )
        top, left = (h - rows) // 2, (w - columns) // 2
        seen = picture[top : top + rows, left : left + columns].permute(2, 0, 1)[None]
        small = [max(1, round(BLURRED_PX * side / max(rows, columns))) for side in (rows, columns)]
        coarse = interpolate(
            interpolate(seen, size=small, mode="area"), size=(height, width), mode="bicubic"
        )
        canvas = BLURRED_LIGHT * coarse[0].clamp(0, 1).permute(1, 2, 0)
    top, left = (height - h) // 2, (width - w) // 2
    canvas[top : top + h, left : left + w] = picture
    return canvas


def video_problem(cameras: Sequence[Camera]) -> str | None:
    """The reason why these views cannot be the frames of one video, or None."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    if len(sizes) > 1:
        return "the frames differ in size"
    if max(max(size) for size in sizes) > MAX_VIDEO_SIDE:
        return f"the frames have more than {MAX_VIDEO_SIDE} pixels a side"
    return None


def parse_size(text: str) -> tuple[int, int]:
    """Parse WxH, or a name in `PRESETS`, as (width, height); InputError for anything else."""
    if text in PRESETS:
        return PRESETS[text]
    match = re.fullmatch(r"([0-9]{1,5})[xX×]([0-9]{1,5})", text)
    width, height = (int(side) for side in match.groups()) if match else (0, 0)
    if not (1 <= width <= MAX_VIDEO_SIDE and 1 <= height <= MAX_VIDEO_SIDE):
        some = ", ".join(["1280x720", *PRESETS])
        raise InputError(
            f"--size {text}: give width and height up to {MAX_VIDEO_SIDE}, such as {some}"
        )
    return width, height
