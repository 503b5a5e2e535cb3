"""The network that ships with Spackle: a U-Net that can copy colours from the rim of a hole and
from patches.
"""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.core.crop import Crop
from spackle.residual.composer import (
    COLOR_DELTAS,
    DELTA_CHANNELS,
    GEOMETRY_CHANNELS,
    TEXTURE_CHANNELS,
)
from spackle.residual.network import ResidualNet, channel_slices, pad_to_stride
from spackle.residual.sharp_decoder import set_random_weights
from spackle.scene_fill.view_completion import SceneViewCompletion

WIDTHS = (48, 80, 128, 256, 256)  # channels of the U-Net from the finest grid to the coarsest
COARSEST_BLOCKS = 3  # residual blocks on the coarsest grid
# The last layers on the finest grid hold four convolutions of 3×3, two of the decoder and two of a
# head, and so a delta depends on the features of that grid up to four cells away.
FINEST_CONTEXT_CELLS = 4
STEM_GAIN = 3.0  # features are of order 0.3, activations should be of order 1
RELU_GAIN = math.sqrt(2)  # keeps the variance of activations that pass a ReLU (He et al. 2015)


class ResidualBlock(nn.Module):
    """x + conv(relu(conv(relu(x)))), initially the identity; without norms, whose statistics would
    depend on the crop.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Features of the same shape [B, C, h, w]."""
        # In place: at this size, allocation costs as much as the arithmetic.
        out: Tensor = self.second(self.first(torch.relu(x)).relu_())
        return out.add_(x)


class UNet(ResidualNet):
    """A U-Net with two heads like SHARP's: 8.02 M parameters; fast for a view with few holes.

    Besides 14 deltas, which change the initial Gaussian of a cell (the first guess of what fills a
    hole), it predicts three weights: how much of the colours at the rim, mirrored at the rim, and
    of patches it adds to the initial colour.
    """

    name = "unet"
    inputs = ("rgb", "depth", "alpha", "mask", "initial", "rim", "patches")
    local = True
    view_type = SceneViewCompletion

    def __init__(self) -> None:
        """Make the layers: encoder (`encode`, `down`), decoder (`up`, `decode`) and two heads.

        Weights are random; the heads start at zero, so that an untrained network changes nothing.
        """
        super().__init__()
        slices = channel_slices(self.inputs, SceneViewCompletion.INPUT_CHANNELS)
        channels = slices[self.inputs[-1]].stop  # of all inputs: the end of the last one
        rim = slices["rim"].start
        patches = slices["patches"].start

        # Where the colours that can be copied lie among the input's channels: the colour at the rim
        # of the hole, the colour mirrored at the rim, and the colour of patches. Each has three
        # channels, and is stored as a difference from the initial colour.
        self.copied_colors = (
            slice(rim, rim + 3),
            slice(rim + 3, rim + 6),
            slice(patches, patches + 3),
        )

        # Channels of neighbouring levels, from the finest level to the coarsest.
        fine_and_coarse = list(itertools.pairwise(WIDTHS))
        self.stem = nn.Conv2d(channels, WIDTHS[0], 3, padding=1)
        self.down = nn.ModuleList(
            nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in fine_and_coarse
        )
        self.encode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])
        self.coarse = nn.Sequential(*(ResidualBlock(WIDTHS[-1]) for _ in range(COARSEST_BLOCKS)))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in fine_and_coarse)
        self.decode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])

        # As in SHARP, one head predicts geometry, the other texture; here also the weights of the
        # copied colours.
        self.geometry = _head(WIDTHS[0], GEOMETRY_CHANNELS)
        self.texture = _head(WIDTHS[0], TEXTURE_CHANNELS + len(self.copied_colors))
        self._initialize_weights()

    def _initialize_weights(self) -> None:
        """Set random weights: activations of order one, blocks as the identity, heads at zero."""
        for name, layer in self.named_modules():
            if not isinstance(layer, nn.Conv2d):
                continue
            # A residual block has the convolutions `first` and `second`, and adds its input to the
            # output of `second`. Layer 2 of a head is its last one.
            if name.endswith("second") or name in ("geometry.2", "texture.2"):
                gain = 0.0
            elif name == "stem":
                gain = STEM_GAIN
            elif name.endswith("first"):
                gain = RELU_GAIN
            else:
                gain = 1.0
            set_random_weights(layer, gain)

    def forward(self, features: Tensor, inner: Crop | None = None) -> Tensor:
        """Deltas [B, 14, rows, columns] of the cells in the rectangle `inner`, by default of all
        cells.

        `features` [B, 21, h, w] are the channels named in `inputs`.
        """
        if inner is None:
            height, width = features.shape[-2:]
            inner = Crop(top=0, left=0, bottom=height, right=width)
        x = self.stem(pad_to_stride(features))

        # Encode: each level halves the grid. The decoder will need the features of each level.
        skips: list[Tensor] = []
        for encode, down in zip(self.encode, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.coarse(x)

        # Decode: each level doubles the grid. The layers on the finest grid (level 0) are the most
        # expensive; they need only a few cells around `inner`.
        height, width = skips[0].shape[-2:]
        near_inner = inner.grown(FINEST_CONTEXT_CELLS, step=1, height=height, width=width)
        for level in reversed(range(len(skips))):
            x = interpolate(self.up[level](x), scale_factor=2, mode="bilinear", align_corners=False)
            x = x.add_(skips[level])
            if level == 0:
                x = x[(..., *near_inner.slices)].contiguous(memory_format=torch.channels_last)
            x = self.decode[level](x)
        outputs = torch.cat([self.geometry(x), self.texture(x)], dim=1)

        # The same rectangle, counted from the corner of `near_inner`.
        inner_of_crop = inner.moved(-near_inner.top, -near_inner.left)
        outputs = outputs[(..., *inner_of_crop.slices)]
        return self._add_copied_colors(outputs, features[(..., *inner.slices)])

    def _add_copied_colors(self, outputs: Tensor, features: Tensor) -> Tensor:
        """Add weighted copies of known colours to the colour channels of the deltas.

        For each cell three colours are known: the colour at the rim of its hole, the colour of its
        mirror image beyond the rim, and the colour of a patch that matches.

        Args:
            outputs: [B, 17, h, w], 14 deltas and the weights of the three known colours.
            features: [B, 21, h, w], the network's input, which holds the known colours.

        Returns:
            Deltas [B, 14, h, w], changes of the Gaussian of each cell.
        """
        deltas, weights = torch.split(outputs, [DELTA_CHANNELS, len(self.copied_colors)], dim=1)
        copied = sum(
            weights[:, k : k + 1] * features[:, colors]
            for k, colors in enumerate(self.copied_colors)
        )  # [B, 3, h, w]
        # `COLOR_DELTAS` is the slice of the colour's channels; the others stay as they are.
        return torch.cat(
            [
                deltas[:, : COLOR_DELTAS.start],
                deltas[:, COLOR_DELTAS] + copied,
                deltas[:, COLOR_DELTAS.stop :],
            ],
            dim=1,
        )


def _head(width: int, channels: int) -> nn.Sequential:
    """The last layers, from features [B, width, h, w] to [B, channels, h, w]."""
    return nn.Sequential(ResidualBlock(width), nn.ReLU(), nn.Conv2d(width, channels, 1))
