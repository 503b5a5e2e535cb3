"""The lite base: rough depth from the photo alone, by two networks that come with the package."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.bases.depth_map import DepthMap
from spackle.bases.lift import lift
from spackle.bases.lite.network import STRIDE, LiteNet, load_networks
from spackle.bases.protocol import NEAREST_M, BasePrediction, Progress, nearest
from spackle.device import own_arithmetic, pick_device
from spackle.image import Photo, resize_photo

SHIPPED = Path(__file__).parents[2] / "weights" / "lite.safetensors"
FARTHEST = 60.0  # what is farther than the nearest things by this ratio is sky to it


@dataclasses.dataclass(frozen=True)
class InputScale:
    """A size at which a network sees a photo."""

    pixels: int  # of what the network sees of it, nearly
    network: int = 0  # which of the networks that a file has
    mirrored: bool = True  # whether it sees the mirror image, too
    tilt: bool = True  # whether it has a say in how the whole lies, and not in outlines alone


# One after the other; both have learned from up to 256×320. Small shows them more of a thing at once, large its
# outlines: the mean of what they say errs less than the best alone. The largest costs most, its mirror gains nothing.
INPUT_SCALES = (
    InputScale(64 * 96),
    InputScale(96 * 128),
    InputScale(192 * 256),
    InputScale(192 * 256, network=1),
    InputScale(256 * 320),
    InputScale(448 * 608, mirrored=False, tilt=False),
)
COARSE = (3, 4)  # how the whole lies is what is left of an output in so many cells, the longer side having more


class LiteBase:
    """Small networks' depth, lifted as a measured one is: plausible parallax, not measurement."""

    name = "lite"

    def __init__(self, networks: Sequence[LiteNet], device: torch.device) -> None:
        self.networks = [network.to(device) for network in networks]
        self.device = device

    @classmethod
    def load(cls, path: Path | None = None, *, device: str | None = None) -> LiteBase:
        """Read the networks in a file that lite's training wrote, the package's own by default.

        Args:
            path: the file; those of its networks are asked that `INPUT_SCALES` counts.
            device: cpu or a CUDA device; where None, CUDA if it is there.

        Raises:
            InputError: a file or device that cannot be used.
        """
        target = pick_device(device)
        return cls(load_networks(path or SHIPPED), target)

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of the pixels of the photo at its working size, as `lift` makes them."""
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
        """What the networks say of a photo [H, W, 3], sRGB in 0..1, at all `INPUT_SCALES`: the mean logarithm.

        Returns [h, w] float32 inverse depth up to a factor, on the processor; about 224×304, of the photo's shape.
        """
        scales = [scale for scale in INPUT_SCALES if scale.network < len(self.networks)]
        return merged(self.at_scales(rgb, scales), [scale.tilt for scale in scales]).exp()

    @torch.no_grad()
    def at_scales(self, rgb: Tensor, scales: Sequence[InputScale]) -> Tensor:
        """[n, h, w] the logarithm of inverse depth of a photo [H, W, 3] at each of n scales, as fine as the last."""
        picture = rgb.float().permute(2, 0, 1)[None].to(self.device)
        outputs = [self._ask(picture, scale) for scale in scales]
        finest = outputs[-1].shape
        return torch.cat([interpolate(scale[None, None], size=finest, mode="bilinear") for scale in outputs])[
            :, 0
        ].cpu()

    def _ask(self, picture: Tensor, scale: InputScale) -> Tensor:
        """[h/2, w/2] log inverse depth of a photo [1, 3, H, W] that is seen at (h, w)."""
        size = network_size(picture.shape[2], picture.shape[3], scale.pixels)
        seen = interpolate(picture, size=size, mode="bicubic", antialias=True).clamp(0, 1)
        ways = torch.cat([seen, seen.flip(-1)]) if scale.mirrored else seen
        with own_arithmetic(self.device):
            outputs = self.networks[scale.network](ways.contiguous(memory_format=torch.channels_last))
        straight, *mirrored = outputs.float()
        return torch.stack([straight, *(one.flip(-1) for one in mirrored)]).mean(0)


def merged(outputs: Tensor, tilt: Sequence[bool]) -> Tensor:
    """[h, w] the mean of outputs [n, h, w], but what is coarse in it is the mean of those that have a say in it."""
    cells = COARSE if outputs.shape[1] <= outputs.shape[2] else COARSE[::-1]
    coarse = interpolate(interpolate(outputs[None], size=cells, mode="area"), size=outputs.shape[1:], mode="bicubic")[0]
    return (outputs - coarse).mean(0) + coarse[torch.tensor(tilt)].mean(0)


def network_size(height: int, width: int, pixels: int) -> tuple[int, int]:
    """(height, width) of what the network sees of a photo: nearly its shape, nearly `pixels`."""
    return scaled_size(height, width, math.sqrt(pixels / (height * width)))


def scaled_size(height: int, width: int, scale: float) -> tuple[int, int]:
    """(height, width) times nearly `scale`, as a network takes it."""
    tall, wide = (max(STRIDE, round(side * scale / STRIDE) * STRIDE) for side in (height, width))
    return tall, wide
