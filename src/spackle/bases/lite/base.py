"""The lite base: rough depth from the photo alone, by a network that comes with the package."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.bases.depth_maps import DepthMap
from spackle.bases.device import own_arithmetic, pick_device
from spackle.bases.lite.network import STRIDE, LiteNet
from spackle.bases.protocol import BasePrediction, Progress
from spackle.bases.relative import NEAREST_M, nearest
from spackle.bases.rgbd import lift
from spackle.image import Photo, resize_photo
from spackle.network_file import read_network

SHIPPED = Path(__file__).parents[2] / "weights" / "lite.safetensors"
# What the network looks at, nearly, one after the other; it has learned from 256×320. Small shows it more of a
# thing at once, large its outlines: the mean of what it says of all of them errs less than the best alone.
INPUT_PIXELS = (64 * 96, 96 * 128, 192 * 256, 256 * 320, 448 * 608)
MIRRORED_PX = 256 * 320  # so much is looked at both ways round; larger takes longest and gains nothing by it
FARTHEST = 60.0  # what is farther than the nearest things by this ratio is sky to it


class LiteBase:
    """A small network's depth, lifted as a measured one is: plausible parallax, not measurement."""

    name = "lite"

    def __init__(self, network: LiteNet, device: torch.device) -> None:
        self.network = network.to(device)
        self.device = device

    @classmethod
    def load(cls, path: Path | None = None, *, device: str | None = None) -> LiteBase:
        """Read the network's weights.

        Args:
            path: a file that `spackle train --method lite` wrote; None takes the weights of the package.
            device: cpu or a CUDA device; where None, CUDA if it is there.

        Raises:
            InputError: a file or device that cannot be used.
        """
        target = pick_device(device)
        return cls(read_network(LiteNet(), path or SHIPPED, "lite", "a .safetensors file"), target)

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the pixels of the photo at its working size, as `rgbd.lift` makes them."""
        photo = resize_photo(photo)
        inverse_depth = self.inverse_depth(photo.rgb)
        depth = NEAREST_M / (inverse_depth / nearest(inverse_depth.flatten())).clamp(1 / FARTHEST, 1)
        known = torch.ones_like(depth, dtype=torch.bool)
        if progress:
            progress(1, 2)
        prediction = lift(photo.rgb, DepthMap(depth, known, None, None, "disparity", photo.path), photo.camera)
        if progress:
            progress(2, 2)
        notes = {**prediction.notes, "precision": "fp32", "depth_scale": f"relative, the nearest at {NEAREST_M:g} m"}
        return dataclasses.replace(prediction, notes=notes)

    def inverse_depth(self, rgb: Tensor) -> Tensor:
        """What the network says of a photo, and of its mirror image, at several sizes: the mean of the logarithms.

        Args:
            rgb: [H, W, 3] sRGB in 0..1, of any size.

        Returns:
            [h, w] float32 inverse depth up to a factor, on the processor; about 224×304, of the photo's shape.
        """
        return self.looks(rgb).mean(0).exp()

    @torch.no_grad()
    def looks(self, rgb: Tensor, sizes_px: Sequence[int] = INPUT_PIXELS, mirrored_px: int = MIRRORED_PX) -> Tensor:
        """[n, h, w] the logarithm of inverse depth of a photo [H, W, 3] at each of n sizes, the last the largest."""
        picture = rgb.float().permute(2, 0, 1)[None].to(self.device)
        height, width = rgb.shape[:2]
        said = [
            self._look(picture, network_size(height, width, pixels), both=pixels <= mirrored_px) for pixels in sizes_px
        ]
        finest = said[-1].shape
        return torch.cat([interpolate(look[None, None], size=finest, mode="bilinear") for look in said])[:, 0].cpu()

    def _look(self, picture: Tensor, size: tuple[int, int], both: bool) -> Tensor:
        """[h/2, w/2] log inverse depth of a photo [1, 3, H, W], seen at a size (h, w), perhaps both ways round."""
        seen = interpolate(picture, size=size, mode="bicubic", antialias=True).clamp(0, 1)
        ways = torch.cat([seen, seen.flip(-1)]) if both else seen
        with own_arithmetic(self.device):
            straight, *mirrored = self.network(ways.contiguous(memory_format=torch.channels_last)).float()
        return torch.stack([straight, *(look.flip(-1) for look in mirrored)]).mean(0)


def network_size(height: int, width: int, pixels: int) -> tuple[int, int]:
    """(height, width) of what the network sees of a photo: nearly its shape, nearly `pixels`."""
    scale = math.sqrt(pixels / (height * width))
    tall, wide = (max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (height, width))
    return tall, wide
