"""Two eyes in place of one, and their two pictures in one frame."""

from __future__ import annotations

import dataclasses
import math
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional

from spackle.camera import Camera
from spackle.camera_path import DepthRange
from spackle.color import linear_to_srgb, srgb_to_linear

StereoLayout = Literal["sbs", "sbs-half", "ou", "ou-half", "anaglyph"]
LAYOUTS: tuple[StereoLayout, ...] = get_args(StereoLayout)
PARALLAX = 0.03  # of the picture's width, between the nearest thing and infinity: comfortable on a desk or a wall

# E. Dubois, "A projection method to generate anaglyph stereo images", ICASSP 2001: least squares over the spectra
# of a display and of red-cyan glasses, in linear light. Rows: what R, G and B take of the eye's R, G and B.
DUBOIS_LEFT = ((0.456, 0.500, 0.176), (-0.040, -0.038, -0.016), (-0.015, -0.021, -0.005))
DUBOIS_RIGHT = ((-0.043, -0.088, -0.002), (0.378, 0.734, -0.018), (-0.072, -0.113, 1.226))


@dataclasses.dataclass(frozen=True)
class Stereo:
    """How a view is seen by two eyes."""

    layout: StereoLayout
    ipd: float  # between the eyes, in the scene's unit (metres where the base is metric)
    convergence: float  # depth without parallax, where the screen is; inf: parallel axes

    def __post_init__(self) -> None:
        if self.layout not in LAYOUTS:
            raise ValueError(f"unknown stereo layout {self.layout!r}: choose one of {', '.join(LAYOUTS)}")
        if not (0 < self.ipd < math.inf and self.convergence > 0):
            raise ValueError(f"no stereo with eyes {self.ipd:g} apart and a screen at {self.convergence:g}")

    def eyes(self, camera: Camera) -> tuple[Camera, Camera]:
        """The left and the right eye of a view: moved along its x axis, never turned.

        Parallel cameras whose principal points are shifted show what is `convergence` deep at the same place.
        Turning them inwards instead would squeeze each picture into a trapezium, and shift its rows.
        """
        return _moved(camera, -self.ipd / 2, self.convergence), _moved(camera, self.ipd / 2, self.convergence)

    def pack(self, left: Tensor, right: Tensor) -> Tensor:
        """Two pictures [H, W, 3], sRGB, as one frame.

        sbs [H, 2W, 3] has the left eye on the left, ou [2H, W, 3] has it on top; their half variants squeeze the
        frame to [H, W, 3] (an odd side grows by one); anaglyph is for glasses that are red on the left.
        """
        if self.layout == "anaglyph":
            return anaglyph(left, right)
        side, half = self.layout.startswith("sbs"), self.layout.endswith("half")
        pictures = [_halved(picture, side) if half else picture for picture in (left, right)]
        return torch.cat(pictures, dim=1 if side else 0)

    def frame_size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of a frame of views of this size."""
        if self.layout in ("sbs", "sbs-half"):
            return 2 * (width if self.layout == "sbs" else (width + 1) // 2), height
        if self.layout in ("ou", "ou-half"):
            return width, 2 * (height if self.layout == "ou" else (height + 1) // 2)
        return width, height


def default_ipd(camera: Camera, depth_range: DepthRange) -> float:
    """Eyes so far apart that the scene's whole depth takes 3 % of the picture's width as parallax.

    parallax = fx · ipd · (1/near − 1/∞), so ipd = 0.03 · (W/fx) · z_near: no unit is needed, and things at arm's
    length are not torn apart. For a 30 mm lens and z_near = 1.8 m this is the human 65 mm.
    """
    return PARALLAX * camera.width / camera.focal[0] * depth_range.near


def anaglyph(left: Tensor, right: Tensor) -> Tensor:
    """Red-cyan [..., 3] of two sRGB pictures [..., 3], mixed in linear light by Dubois' matrices."""
    one, other = srgb_to_linear(left), srgb_to_linear(right)
    mixed = one @ one.new_tensor(DUBOIS_LEFT).T + other @ other.new_tensor(DUBOIS_RIGHT).T
    return linear_to_srgb(mixed)


def _moved(camera: Camera, right: float, convergence: float) -> Camera:
    K, matrix = camera.K.clone(), camera.world_to_camera.clone()
    matrix[0, 3] -= right
    K[0, 2] += K[0, 0] * (right / convergence)
    return dataclasses.replace(camera, K=K, world_to_camera=matrix)


def _halved(picture: Tensor, side: bool) -> Tensor:
    """Half the width or the height; pixels are averaged in linear light."""
    height, width = picture.shape[:2]
    size = (height, (width + 1) // 2) if side else ((height + 1) // 2, width)
    light = srgb_to_linear(picture).permute(2, 0, 1)[None]
    return linear_to_srgb(functional.adaptive_avg_pool2d(light, size))[0].permute(1, 2, 0)
