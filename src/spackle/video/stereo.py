"""Views for two eyes, and their images in one frame."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.trajectories import DepthRange
from spackle.video.options import StereoLayout

# By default, the parallax of the nearest and of infinitely far points differs by this share of
# the image's width.
DEFAULT_PARALLAX = 0.03

# E. Dubois, "A projection method to generate anaglyph stereo images", ICASSP 2001, for red-cyan
# glasses, in linear light. A row holds the weights of one eye's R, G and B in one channel of the
# result.
DUBOIS_LEFT = ((0.456, 0.500, 0.176), (-0.040, -0.038, -0.016), (-0.015, -0.021, -0.005))
DUBOIS_RIGHT = ((-0.043, -0.088, -0.002), (0.378, 0.734, -0.018), (-0.072, -0.113, 1.226))


@dataclasses.dataclass(frozen=True)
class Stereo:
    """The two eyes of a stereo view, and the layout of their images."""

    layout: StereoLayout
    # The distance between the eyes, in the scene's unit (metres if the base is metric).
    ipd: float
    # The depth without parallax, which appears at the screen; may be infinite.
    convergence: float

    def eyes(self, camera: Camera) -> tuple[Camera, Camera]:
        """Return the cameras of the left and the right eye.

        They are parallel, on both sides of `camera` along its x axis. Their principal points are
        shifted so that points at depth `convergence` have the same position in both images.
        """
        left = self._shifted_camera(camera, -self.ipd / 2)
        right = self._shifted_camera(camera, self.ipd / 2)
        return left, right

    def _shifted_camera(self, camera: Camera, offset: float) -> Camera:
        """Return the camera moved by `offset` to the right, with its principal point shifted."""
        K = camera.K.clone()
        world_to_camera = camera.world_to_camera.clone()
        # A camera moves right as the world moves left.
        world_to_camera[0, 3] -= offset
        # A point at depth z appears to move by fx · offset / z pixels to the left.
        K[0, 2] += K[0, 0] * (offset / self.convergence)
        return dataclasses.replace(camera, K=K, world_to_camera=world_to_camera)

    def pack(self, left: Tensor, right: Tensor) -> Tensor:
        """Combine the eyes' images in one frame: side by side (sbs), or one over the other (ou).

        Args:
            left, right: [H, W, 3] sRGB in 0..1.

        Returns:
            sRGB in 0..1: in the layout sbs [H, 2W, 3] with the left eye on the left, in ou
            [2H, W, 3] with the left eye on top. The half variants squeeze the frame to [H, W, 3],
            where an odd side grows by one. An anaglyph [H, W, 3] is for glasses with the red
            filter on the left eye.
        """
        if self.layout == "anaglyph":
            return anaglyph(left, right)
        if self.layout == "sbs-half":
            left = _halve_width(left)
            right = _halve_width(right)
        elif self.layout == "ou-half":
            left = _halve_height(left)
            right = _halve_height(right)
        is_side_by_side = self.layout in ("sbs", "sbs-half")
        return torch.cat([left, right], dim=1 if is_side_by_side else 0)

    def frame_size(self, width: int, height: int) -> tuple[int, int]:
        """Return width and height of a frame in pixels, for eyes' images of this size."""
        if self.layout == "sbs":
            return 2 * width, height
        if self.layout == "ou":
            return width, 2 * height
        # The halves of an odd side are rounded up, so the frame grows by one.
        if self.layout == "sbs-half":
            return width + width % 2, height
        if self.layout == "ou-half":
            return width, height + height % 2
        return width, height


def default_ipd(camera: Camera, depth_range: DepthRange) -> float:
    """Return a distance between the eyes (ipd) that is comfortable to look at.

    The parallax between the scene's nearest points and infinity is then 3 % of the image's width:
    fx · ipd / z_near = 0.03 · width.

    Args:
        camera: the photo's camera.
        depth_range: the scene's depths, of which only the nearest one, `near`, is used.

    Returns:
        The distance in the scene's unit.
    """
    fx = camera.focal[0]
    return DEFAULT_PARALLAX * camera.width / fx * depth_range.near


def anaglyph(left: Tensor, right: Tensor) -> Tensor:
    """Mix the images of two eyes [..., 3] to an image for red-cyan glasses; all are sRGB in 0..1.

    The colours are mixed in linear light, by Dubois's matrices.
    """
    left_light = srgb_to_linear(left)
    right_light = srgb_to_linear(right)
    left_weights = left_light.new_tensor(DUBOIS_LEFT)  # [3, 3]
    right_weights = left_light.new_tensor(DUBOIS_RIGHT)
    return linear_to_srgb(left_light @ left_weights.T + right_light @ right_weights.T)


def _halve_width(picture: Tensor) -> Tensor:
    """Return an image [H, W, 3] sRGB at half its width, rounded up: [H, ceil(W / 2), 3]."""
    height, width = picture.shape[:2]
    return _average_to_size(picture, height, (width + 1) // 2)


def _halve_height(picture: Tensor) -> Tensor:
    """Return an image [H, W, 3] sRGB at half its height, rounded up: [ceil(H / 2), W, 3]."""
    height, width = picture.shape[:2]
    return _average_to_size(picture, (height + 1) // 2, width)


def _average_to_size(picture: Tensor, height: int, width: int) -> Tensor:
    """Shrink an image [H, W, 3] sRGB to [height, width, 3] by averaging pixels in linear light."""
    light = srgb_to_linear(picture).permute(2, 0, 1)[None]  # [1, 3, H, W]
    small = linear_to_srgb(adaptive_avg_pool2d(light, (height, width)))
    return small[0].permute(1, 2, 0)
