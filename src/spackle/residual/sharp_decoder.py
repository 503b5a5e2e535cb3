"""The paper's residual network, `sharp-decoder`: the Gaussian decoder of SHARP behind a small
stem.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases.sharp.encoder import FULL_SIZE, SIZES, Float32Conv, SharpConfig
from spackle.bases.sharp.network import FeatureNetwork
from spackle.residual.completion import ViewCompletion
from spackle.residual.composer import GEOMETRY_CHANNELS, TEXTURE_CHANNELS
from spackle.residual.network import ResidualNet, channel_slices, pad_to_stride

STEM_WIDTH = 48  # channels of the stem: its 0.24 M parameters complete the paper's 8.02 M
STEM_GAIN = 3.0  # features are of order 0.3, activations should be of order 1
RELU_GAIN = math.sqrt(2)  # keeps the variance of activations that pass a ReLU (He et al. 2015)


class SharpDecoder(ResidualNet):
    """The paper's f_res, which "replicates the baseline architecture": SHARP's Gaussian decoder,
    8.02 M parameters.

    A stem with 0.24 M parameters replaces SHARP's encoder. In place of the photo and its two layers
    of disparity, the decoder receives colour and depth of the initial Gaussians (the first guess of
    what fills a hole), and the depth of the view.
    """

    name = "sharp-decoder"
    inputs = ("rgb", "depth", "alpha", "mask", "initial", "photo")
    local = False  # group norms make a cell depend on all others

    def __init__(self, config: SharpConfig = FULL_SIZE) -> None:
        """Make the layers, with random weights; the heads start at zero, so that an untrained
        network changes nothing.

        `config` is the size of SHARP, by default the published one.
        """
        super().__init__()
        self.slices = channel_slices(self.inputs, ViewCompletion.INPUT_CHANNELS)
        channels = self.slices[self.inputs[-1]].stop  # of all inputs: the end of the last one

        # The channels of the decoder's maps, finest first.
        widths = (config.depth_width, *config.pyramid_channels)
        self.stem = nn.Conv2d(channels, STEM_WIDTH, 3, padding=1)
        self.down = nn.ModuleList(
            nn.Conv2d(STEM_WIDTH, STEM_WIDTH, 3, stride=2, padding=1) for _ in widths[1:]
        )
        self.maps = nn.ModuleList(nn.Conv2d(STEM_WIDTH, width, 1) for width in widths)
        self.feature_model = FeatureNetwork(config)
        self.geometry = Float32Conv(config.feature_width, GEOMETRY_CHANNELS, 1)
        self.texture = Float32Conv(config.feature_width, TEXTURE_CHANNELS, 1)
        self._initialize_weights()

    def _initialize_weights(self) -> None:
        """Set random weights: activations of order one, residual blocks as the identity, heads at
        zero.
        """
        for name, layer in self.feature_model.named_modules():
            if isinstance(layer, (nn.Conv2d, nn.ConvTranspose2d)):
                # The last convolution of one of SHARP's residual blocks is its layer 5 if the block
                # has norms, otherwise its layer 3. With zero weights there, the block is the
                # identity.
                ends_block = name.endswith(("residual.3", "residual.5"))
                set_random_weights(layer, gain=0.0 if ends_block else 1.0)
        set_random_weights(self.stem, gain=STEM_GAIN)
        for layer in (*self.down, *self.maps):
            set_random_weights(layer, gain=RELU_GAIN)
        for head in (self.geometry, self.texture):
            set_random_weights(head, gain=0.0)

    @classmethod
    def untrained_for(cls, tensors: Mapping[str, Tensor]) -> SharpDecoder:
        """An untrained network of the size of SHARP's decoder in a file, given by the file's
        tensors.
        """
        return cls(decoder_size(tensors))

    def forward(self, features: Tensor) -> Tensor:
        """Deltas [B, 14, h, w]: changes of the Gaussian of each cell of 2×2 pixels.

        `features` [B, 13, h, w] are the channels that `inputs` names.
        """
        height, width = features.shape[-2:]
        features = pad_to_stride(features)

        # The decoder's maps, from fine to coarse. In the finest, a place is one cell; in each
        # further map it is twice as long and wide.
        x = torch.relu(self.stem(features))
        maps: list[Tensor] = []
        for to_map, down in itertools.zip_longest(self.maps, self.down):
            maps.append(to_map(x))
            if down is not None:  # nothing comes after the coarsest map
                x = torch.relu(down(x))

        # SHARP's decoder reads a picture of colours and disparities in -1..1. Here depths come as
        # log(d), and tanh(log(d) / 2) = (d - 1) / (d + 1) lies in -1..1.
        view_depth = self.slices["depth"].start
        initial_depth = self.slices["initial"].start
        depths = torch.tanh(features[:, [view_depth, initial_depth]] / 2)
        # The input "initial" is a depth followed by a colour in -0.5..0.5.
        initial_rgb = features[:, initial_depth + 1 : self.slices["initial"].stop]
        picture = torch.cat([2 * initial_rgb, depths], dim=1)  # [B, 5, h, w] in -1..1

        # The decoder predicts one Gaussian for 2×2 pixels of its picture, so each cell is repeated.
        pixels = interpolate(picture, scale_factor=2, mode="nearest")

        # There are no features coarser than the coarsest map. Zero in their place lets this map,
        # like the others, pass all layers that combine it with coarser features.
        no_coarser_features = x.new_zeros(())
        texture, geometry = self.feature_model(pixels, maps, no_coarser_features)
        deltas = torch.cat([self.geometry(geometry), self.texture(texture)], dim=1)
        return deltas[..., :height, :width]


def set_random_weights(layer: nn.Conv2d | nn.ConvTranspose2d, gain: float) -> None:
    """Set a layer's bias to zero, and its weights to random numbers of such a size that its outputs
    are about `gain` times as large as its inputs.
    """
    # The number of inputs that one output sums.
    inputs = layer.weight[0].numel()
    if isinstance(layer, nn.ConvTranspose2d):
        # Its 2×2 kernel has stride 2, so an output sums the channels of a single pixel.
        inputs = layer.in_channels
    nn.init.normal_(layer.weight, std=gain / math.sqrt(inputs))
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)


def decoder_size(tensors: Mapping[str, Tensor]) -> SharpConfig:
    """The size of the SHARP decoder whose weights a file holds; the published size if the file
    holds no such decoder.

    `tensors` are the file's tensors by name. The sizes differ in the channels of the decoder's last
    layer, and so in the length of its bias.
    """
    last_bias = tensors.get("feature_model.fusion.out_conv.bias")
    if last_bias is not None:
        for config in SIZES.values():
            if config.gaussian_width == last_bias.numel():
                return config
    return FULL_SIZE
