"""The two architectures of f_res, and their weight files."""

from __future__ import annotations

import functools
import itertools
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, pad

from spackle.bases.sharp.encoder import FULL_SIZE, SIZES, Float32Conv, SharpConfig
from spackle.bases.sharp.network import FeatureNetwork
from spackle.core.crop import Crop
from spackle.residual.network import (
    COLOR,
    DELTA_CHANNELS,
    GEOMETRY_CHANNELS,
    KNOWN_COLORS,
    PHOTO,
    RIM_CHANNELS,
    SEED_DEPTH,
    SEED_RGB,
    STRIDE,
    TEXTURE_CHANNELS,
    VIEW_CHANNELS,
    VIEW_DEPTH,
    ResidualNet,
)
from spackle.runtime.errors import InputError, printable_line
from spackle.weights.checkpoints import load_strict, read_metadata, read_tensors, to_channels_last

SHIPPED = Path(__file__).parent.parent / "weights" / "residual.safetensors"
NOTE = "spackle.residual"  # metadata key of the architecture's name; a file without this key holds a UNet
WIDTHS = (48, 80, 128, 256, 256)  # channels of the U-Net from the finest grid to the coarsest
COARSE_BLOCKS = 3  # residual blocks on the coarsest grid
FINEST_REACH = 4  # cells: a U-Net's last layers hold four convolutions of 3×3, two of the decoder and two of a head
STEM_WIDTH = 48  # channels of the decoder's stem: its 0.24 M parameters complete the paper's 8.02 M
STEM_GAIN = 3.0  # features are of order 0.3


def padded(features: Tensor) -> Tensor:
    """Pad features [B, C, h, w] to multiples of `STRIDE`."""
    height, width = features.shape[-2:]
    return pad(features, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate")


class ResidualBlock(nn.Module):
    """x + conv(act(conv(act(x)))), initially the identity; without norms, whose statistics would depend on the crop."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(channels, channels, 3, padding=1)
        self.second = nn.Conv2d(channels, channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        # In place: at this size, allocation costs as much as the arithmetic.
        out: Tensor = self.second(self.first(torch.relu(x)).relu_())
        return out.add_(x)


class UNet(ResidualNet):
    """A U-Net with two heads like SHARP's: 8.02 M parameters; fast for a view with few holes."""

    name, sees_photo, local = "unet", False, True

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(RIM_CHANNELS, WIDTHS[0], 3, padding=1)
        pairs = list(itertools.pairwise(WIDTHS))
        self.down = nn.ModuleList(
            nn.Conv2d(fine, coarse, 3, stride=2, padding=1) for fine, coarse in pairs
        )
        self.encode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])
        self.coarse = nn.Sequential(*(ResidualBlock(WIDTHS[-1]) for _ in range(COARSE_BLOCKS)))
        self.up = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairs)
        self.decode = nn.ModuleList(ResidualBlock(width) for width in WIDTHS[:-1])
        self.geometry = _head(WIDTHS[0], GEOMETRY_CHANNELS)
        self.texture = _head(WIDTHS[0], TEXTURE_CHANNELS + len(KNOWN_COLORS))
        _initialise(self)

    def forward(self, features: Tensor, inner: Crop | None = None) -> Tensor:
        """Deltas of the cells in `inner`, by default of all cells."""
        inner = inner or Crop(0, 0, *features.shape[-2:])
        x = self.stem(padded(features[:, :RIM_CHANNELS]))
        near, skips = inner.grown(FINEST_REACH, 1, *x.shape[-2:]), []
        for encode, down in zip(self.encode, self.down, strict=True):
            x = encode(x)
            skips.append(x)
            x = down(x)
        x = self.coarse(x)
        for skip, up, decode in reversed(list(zip(skips, self.up, self.decode, strict=True))):
            x = interpolate(up(x), scale_factor=2, mode="bilinear", align_corners=False).add_(skip)
            if skip is skips[0]:
                x = x[(..., *near.slices)].contiguous(memory_format=torch.channels_last)
            x = decode(x)
        heads = torch.cat([self.geometry(x), self.texture(x)], dim=1)
        heads, features = (
            heads[(..., *inner.moved(-near.top, -near.left).slices)],
            features[(..., *inner.slices)],
        )
        # The last outputs are weights of the known colours.
        deltas, shares = torch.split(heads, [DELTA_CHANNELS, len(KNOWN_COLORS)], dim=1)
        copied = sum(
            shares[:, k : k + 1] * features[:, colors] for k, colors in enumerate(KNOWN_COLORS)
        )
        return torch.cat(
            [deltas[:, : COLOR.start], deltas[:, COLOR] + copied, deltas[:, COLOR.stop :]], dim=1
        )


class SharpDecoder(ResidualNet):
    """The paper's network, which "replicates the baseline architecture": SHARP's Gaussian decoder, 8.02 M parameters.

    A stem with 0.24 M parameters replaces SHARP's encoder. Instead of photo and two layers of disparity, the decoder
    receives the base values' colours and depth, and the view's depth.
    """

    name, sees_photo, local = (
        "sharp-decoder",
        True,
        False,
    )  # group norms make a cell depend on all others

    def __init__(self, config: SharpConfig = FULL_SIZE) -> None:
        super().__init__()
        dims = (config.depth_width, *config.pyramid_channels)
        self.stem = nn.Conv2d(VIEW_CHANNELS + 3, STEM_WIDTH, 3, padding=1)
        self.down = nn.ModuleList(
            nn.Conv2d(STEM_WIDTH, STEM_WIDTH, 3, stride=2, padding=1) for _ in dims[1:]
        )
        self.maps = nn.ModuleList(nn.Conv2d(STEM_WIDTH, dim, 1) for dim in dims)
        self.feature_model = FeatureNetwork(config)
        self.geometry = Float32Conv(config.feature_width, GEOMETRY_CHANNELS, 1)
        self.texture = Float32Conv(config.feature_width, TEXTURE_CHANNELS, 1)
        for name, layer in self.feature_model.named_modules():
            if isinstance(layer, (nn.Conv2d, nn.ConvTranspose2d)):
                _scale(
                    0.0 if name.endswith(("residual.3", "residual.5")) else 1.0, layer
                )  # blocks: identity
        _scale(STEM_GAIN, self.stem)
        _scale(math.sqrt(2), *self.down, *self.maps)
        _scale(0.0, self.geometry, self.texture)

    def forward(self, features: Tensor) -> Tensor:
        height, width = features.shape[-2:]
        features = padded(features)
        seen = torch.cat([features[:, :VIEW_CHANNELS], features[:, PHOTO]], dim=1)
        x, maps = torch.relu(self.stem(seen)), list[Tensor]()
        for to_map, down in itertools.zip_longest(self.maps, self.down):
            maps.append(to_map(x))
            x = torch.relu(down(x)) if down is not None else x
        # Depths in -1..1 like SHARP's disparities: tanh(log(d) / 2) = (d - 1) / (d + 1).
        depths = torch.tanh(features[:, [VIEW_DEPTH, SEED_DEPTH]] / 2)
        picture = torch.cat([2 * features[:, SEED_RGB], depths], dim=1)
        pixels = interpolate(picture, scale_factor=2, mode="nearest")
        texture, geometry = self.feature_model(pixels, maps, x.new_zeros(()))
        return torch.cat([self.geometry(geometry), self.texture(texture)], dim=1)[
            ..., :height, :width
        ]


def _head(width: int, channels: int) -> nn.Sequential:
    return nn.Sequential(ResidualBlock(width), nn.ReLU(), nn.Conv2d(width, channels, 1))


def _initialise(network: UNet) -> None:
    """Initialise weights: activations of order one, blocks as the identity, heads at zero."""
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d):
            zero = name.endswith("second") or name in ("geometry.2", "texture.2")
            gain = math.sqrt(2) if name.endswith("first") else 1.0
            _scale(0.0 if zero else STEM_GAIN if name == "stem" else gain, module)


def _scale(gain: float, *layers: Any) -> None:
    """Set random weights that scale the input's magnitude by about `gain`, and zero biases."""
    for layer in layers:
        taps = (
            layer.in_channels if isinstance(layer, nn.ConvTranspose2d) else layer.weight[0].numel()
        )
        nn.init.normal_(layer.weight, std=gain / math.sqrt(taps))
        if layer.bias is not None:
            nn.init.zeros_(layer.bias)


def open_residual(name: str, config: SharpConfig = FULL_SIZE) -> ResidualNet:
    """An untrained network of the named architecture; `config` is the size of a `SharpDecoder`."""
    return UNet() if name == UNet.name else SharpDecoder(config)


@functools.cache
def shipped_network() -> ResidualNet | None:
    """The network with the weights in the package; None if this build has no weights."""
    return load_residual(SHIPPED) if SHIPPED.is_file() else None


def load_residual(path: str | os.PathLike[str]) -> ResidualNet:
    """Read a network; InputError if the file is missing or broken, or holds another network."""
    advice = "give the residual's weights, 'seeds' or 'none'"
    tensors, name = read_tensors(path, advice), read_metadata(path, NOTE) or UNet.name
    if name not in (UNet.name, SharpDecoder.name):
        raise InputError(f"{path}: unknown architecture {printable_line(name)[:60]}: {advice}")
    return load_strict(
        open_residual(name, decoder_size(tensors)), tensors, path, advice, prepare=to_channels_last
    )


def decoder_size(tensors: Mapping[str, Tensor]) -> SharpConfig:
    """The size of the SHARP decoder in a file, from its tensors; the published size if there is no decoder."""
    last = tensors.get("feature_model.fusion.out_conv.bias")
    width = FULL_SIZE.gaussian_width if last is None else last.numel()
    return next((config for config in SIZES.values() if config.gaussian_width == width), FULL_SIZE)
