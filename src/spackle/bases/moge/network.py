"""MoGe-2 (Wang et al. 2025, arXiv 2507.02546): predict points, a mask and a scale from one photo.

A DINOv2 transformer makes features of the photo, the neck spreads them over a pyramid of five
levels, and a pyramid for each output (a head) makes maps of them. Modules are named as in the
checkpoint. The checkpoint's `model_config` gives the sizes; options that no published checkpoint
uses are refused.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases.sharp.encoder import NORM_EPS, TransformerBlock
from spackle.runtime.errors import as_input_error, short_repr
from spackle.weights.checkpoints import load_strict, read_checkpoint, to_channels_last

ADVICE = "give MoGe-2's model.pt as it was downloaded"
BACKBONES = {  # channels of the tokens, number of blocks, and attention heads of each block
    "dinov2_vits14": (384, 12, 6),
    "dinov2_vitb14": (768, 12, 12),
    "dinov2_vitl14": (1024, 24, 16),
}
TOKEN_PX = 14  # side of a token in pixels
TRAINED_GRID = 37  # tokens along a side for which the positions were learned
LEVEL_COUNT = 5  # of a pyramid; each level is twice as fine as the previous level
PIXELS_PER_TOKEN = 2 ** (LEVEL_COUNT - 1)  # pixels of the finest level along a token's side
MAX_BLOCKS_PER_LEVEL = 64  # of a pyramid; a damaged file may ask for millions
PUBLISHED_PYRAMID_OPTIONS = {  # the same in all published checkpoints
    "res_block_in_norm": "none",
    "res_block_hidden_norm": "none",
    "dim_times_res_block_hidden": 1,
    "activation": "relu",
}


@dataclasses.dataclass(frozen=True)
class MogeOutput:
    """The network's output on a grid [h, w] over the photo; float32."""

    # [h, w, 3] x right, y down, z forward, up to the metric scale and a shift along z
    points: Tensor
    mask_logits: Tensor  # [h, w] above 0 for a surface, else sky
    metric_scale: Tensor  # [] metres for each unit of the points


class DinoBackbone(nn.Module):
    """DINOv2 (Oquab et al. 2023) without registers."""

    def __init__(self, width: int, block_count: int, head_count: int) -> None:
        """Build the transformer for tokens with `width` channels; weights are zeros or random."""
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + TRAINED_GRID**2, width))
        # Only DINOv2's training used this one; it is here because the checkpoint holds it.
        self.mask_token = nn.Parameter(torch.zeros(1, width))
        patch_conv = nn.Conv2d(3, width, TOKEN_PX, stride=TOKEN_PX)
        self.patch_embed = nn.ModuleDict({"proj": patch_conv})
        self.blocks = nn.ModuleList(TransformerBlock(width, head_count) for _ in range(block_count))
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)

    def forward(self, image: Tensor, layers: Sequence[int]) -> list[Tensor]:
        """Encode an image, and return the tokens after some of the transformer's blocks.

        Args:
            image: [1, 3, 14·h, 14·w], normalised as in DINOv2's training.
            layers: numbers of these blocks.

        Returns:
            For each of these blocks the normalised tokens [1, 1 + h·w, C], the class token first.
        """
        patches = self.patch_embed["proj"](image)  # [1, C, h, w]
        rows, columns = patches.shape[2:]
        tokens = patches.flatten(2).transpose(1, 2)  # [1, h·w, C]
        tokens = torch.cat([self.cls_token, tokens], dim=1) + self._positions(rows, columns)

        # The caller chooses: early blocks keep details, late blocks know more of the whole image.
        tokens_after_block = []
        for block in self.blocks:
            tokens = block(tokens)
            tokens_after_block.append(tokens)
        return [self.norm(tokens_after_block[layer]) for layer in layers]

    def _positions(self, rows: int, columns: int) -> Tensor:
        """Position embeddings for a grid of rows × columns tokens: [1, 1 + rows·columns, C].

        They are interpolated from those of the grid of 37 × 37 tokens in training. The first one
        belongs to the class token.
        """
        if (rows, columns) == (TRAINED_GRID, TRAINED_GRID):
            return self.pos_embed
        grid = self.pos_embed[:, 1:].reshape(1, TRAINED_GRID, TRAINED_GRID, -1)  # [1, 37, 37, C]
        # As in DINOv2's own code, the factor for n tokens is (n + 0.1) / 37 and not n / 37. This
        # moves the positions a little, as in the published network.
        factors = ((rows + 0.1) / TRAINED_GRID, (columns + 0.1) / TRAINED_GRID)
        resized = interpolate(
            grid.permute(0, 3, 1, 2), scale_factor=factors, mode="bicubic", align_corners=False
        )  # [1, C, rows, columns]
        return torch.cat([self.pos_embed[:, :1], resized.flatten(2).transpose(1, 2)], dim=1)


class DinoEncoder(nn.Module):
    """Encodes an image to features [1, C, h, w] and the class token [1, C'].

    The features are a sum over several blocks of the transformer, each projected to C channels.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Build the encoder for the part `encoder` of a checkpoint's `model_config`."""
        super().__init__()
        width, block_count, head_count = BACKBONES[config["backbone"]]
        # The transformer's blocks whose tokens become features. Looking a number up in the range
        # of all numbers turns -1 into the last block, and refuses a number that is too large.
        block_numbers = range(block_count)
        self.layers = [block_numbers[layer] for layer in config["intermediate_layers"]]
        # The checkpoint holds the mean and standard deviation of its training images.
        self.register_buffer("image_mean", torch.zeros(1, 3, 1, 1))
        self.register_buffer("image_std", torch.ones(1, 3, 1, 1))
        self.backbone = DinoBackbone(width, block_count, head_count)
        self.output_projections = nn.ModuleList(
            nn.Conv2d(width, config["dim_out"], 1) for _ in self.layers
        )

    def forward(self, image: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor]:
        """Features [1, C, rows, columns] and class token [1, C'] of an image [1, 3, H, W].

        The image is sRGB in 0..1.
        """
        # The image is resized to a whole number of tokens of 14 pixels along each side.
        resized = interpolate(
            image,
            size=(TOKEN_PX * rows, TOKEN_PX * columns),
            mode="bilinear",
            align_corners=False,
            antialias=True,
        )
        normalised = (resized - self.get_buffer("image_mean")) / self.get_buffer("image_std")
        tokens_by_layer = self.backbone(normalised, self.layers)

        features = []
        for project, tokens in zip(self.output_projections, tokens_by_layer, strict=True):
            without_class = tokens[:, 1:]  # the class token is the first one
            token_map = without_class.transpose(1, 2).unflatten(2, (rows, columns))
            features.append(project(token_map))  # [1, C, rows, columns]
        last_tokens = tokens_by_layer[-1]
        class_token = last_tokens[:, 0]
        return torch.stack(features).sum(0), class_token


def conv3(inputs: int, outputs: int) -> nn.Conv2d:
    """A 3×3 convolution that keeps the size: beyond the border, pixels are repeated."""
    return nn.Conv2d(inputs, outputs, kernel_size=3, padding=1, padding_mode="replicate")


class ConvBlock(nn.Module):
    """Two convolutions, whose output is added to the input [1, C, h, w] in float32."""

    def __init__(self, width: int) -> None:
        """Build the block for features with `width` channels."""
        super().__init__()
        # Other kinds of MoGe have normalisation layers in the places of the identities. The names
        # in the checkpoint contain each layer's number, so that the identities must be counted.
        self.layers = nn.Sequential(
            nn.Identity(),
            nn.ReLU(),
            conv3(width, width),
            nn.Identity(),
            nn.ReLU(),
            conv3(width, width),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Features [1, C, h, w] in float32 to features of the same shape and type."""
        dtype = next(self.parameters()).dtype  # float32 or bfloat16
        out: Tensor = x + self.layers(x.to(dtype))
        return out


def make_resampler(kind: str, inputs: int, outputs: int) -> nn.Sequential:
    """Layers that double the size of feature maps, and change channels from `inputs` to `outputs`.

    ValueError for a kind that is neither "conv_transpose" nor "bilinear".
    """
    if kind == "conv_transpose":
        return nn.Sequential(
            nn.ConvTranspose2d(inputs, outputs, 2, stride=2), conv3(outputs, outputs)
        )
    if kind != "bilinear":
        raise ValueError(f"a resampler is {short_repr(kind)}")
    return nn.Sequential(
        nn.Upsample(scale_factor=2, mode="bilinear", align_corners=False), conv3(inputs, outputs)
    )


class Pyramid(nn.Module):
    """Makes features from coarse to fine.

    Each of the five levels adds its input to the upsampled features of the coarser level.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Build the pyramid for a part of a checkpoint's `model_config`, such as `neck`.

        The part may be damaged: then any exception may be raised, and for options that no published
        checkpoint has, ValueError.
        """
        super().__init__()
        _check_pyramid_options(config)
        widths = config["dim_res_blocks"]  # channels of each level
        # None: a level's output has as many channels as the level.
        output_channels = config["dim_out"] or [None] * LEVEL_COUNT

        # Surplus entries of `dim_in` and `resamplers` are ignored (strict=False). If entries are
        # missing, so are layers, and the checkpoint's weights do not fit.
        self.input_blocks = nn.ModuleList(
            nn.Conv2d(inputs, width, kernel_size=1)
            for inputs, width in zip(config["dim_in"], widths, strict=False)
        )
        self.res_blocks = nn.ModuleList(
            nn.Sequential(*(ConvBlock(width) for _ in range(block_count)))
            for width, block_count in zip(widths, config["num_res_blocks"], strict=True)
        )
        self.output_blocks = nn.ModuleList(
            nn.Identity() if channels is None else nn.Conv2d(width, channels, 1)
            for width, channels in zip(widths, output_channels, strict=True)
        )
        # One from each level to the next finer level.
        self.resamplers = nn.ModuleList(
            make_resampler(kind, coarse_width, fine_width)
            for kind, coarse_width, fine_width in zip(
                config["resamplers"], widths[:-1], widths[1:], strict=False
            )
        )

    def forward(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """The outputs of all levels, coarse to fine: level l is [1, C, 2^l·h, 2^l·w].

        `inputs` are one map for each level, with that level's height and width.
        """
        outputs: list[Tensor] = []
        features: Tensor | None = None  # of the coarser level
        for level, level_input in enumerate(inputs):
            x = self.input_blocks[level](level_input)
            if features is not None:
                x = x + self.resamplers[level - 1](features)
            features = self.res_blocks[level](x)
            outputs.append(self.output_blocks[level](features))
        return outputs


def _check_pyramid_options(config: Mapping[str, Any]) -> None:
    """ValueError unless a pyramid has five levels, and the options of all published checkpoints.

    The number of blocks is limited, too, because a damaged file may ask for millions.
    """
    # Older checkpoints leave out these two options, and mean the values here.
    defaults = {"dim_times_res_block_hidden": 1, "activation": "relu"}
    options = {**defaults, **config}
    for key, value in PUBLISHED_PYRAMID_OPTIONS.items():
        if options.get(key) != value:
            raise ValueError(f"{key} is {short_repr(options.get(key))}")
    block_counts = config["num_res_blocks"]
    if len(config["dim_res_blocks"]) != LEVEL_COUNT or max(block_counts) > MAX_BLOCKS_PER_LEVEL:
        raise ValueError(f"num_res_blocks is {short_repr(block_counts)}")


class MogeNetwork(nn.Module):
    """Predicts points, mask and metric scale from a photo."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Build the network for a checkpoint's `model_config`.

        The configuration may be damaged: then any exception may be raised, and for options that no
        published checkpoint has, ValueError.
        """
        super().__init__()
        least_tokens, most_tokens = config["num_tokens_range"]
        self.least_tokens = int(least_tokens)
        self.most_tokens = int(most_tokens)
        # How numbers of the points' head become coordinates.
        if config["remap_output"] not in ("exp", "sinh_exp"):
            raise ValueError(f"remap_output is {short_repr(config['remap_output'])}")
        self.remap_output = config["remap_output"]
        self.encoder = DinoEncoder(config["encoder"])
        self.neck = Pyramid(config["neck"])
        self.points_head = Pyramid(config["points_head"])
        self.mask_head = Pyramid(config["mask_head"])

        # All published checkpoints have three layers here.
        inputs, hidden_1, hidden_2, outputs = config["scale_head"]["dims"]
        self.scale_head = nn.Sequential(
            nn.Linear(inputs, hidden_1),
            nn.ReLU(),
            nn.Linear(hidden_1, hidden_2),
            nn.ReLU(),
            nn.Linear(hidden_2, outputs),
        )

    def forward(self, image: Tensor, tokens: int, size: tuple[int, int]) -> MogeOutput:
        """Predict maps of `size` (h, w) from an image [1, 3, H, W], sRGB in 0..1.

        The image is encoded as about `tokens` tokens.
        """
        levels, metric_scale = self.features(image, tokens)
        x, y, log_z = self.decode(self.points_head, levels, size).unbind(-1)  # each [h, w]
        # The logarithm gives near and far surfaces the same relative accuracy.
        z = log_z.exp()
        if self.remap_output == "exp":  # the network predicts x / z and y / z
            x = x * z
            y = y * z
        else:  # it predicts the inverse hyperbolic sine of x and y, also a kind of logarithm
            x = x.sinh()
            y = y.sinh()
        mask_logits = self.decode(self.mask_head, levels, size)[..., 0]
        return MogeOutput(torch.stack([x, y, z], dim=-1), mask_logits, metric_scale)

    def features(self, image: Tensor, tokens: int) -> tuple[list[Tensor], Tensor]:
        """The neck's features of all levels, and the metric scale [], of an image [1, 3, H, W].

        Level l is [1, C, 2^l·h, 2^l·w], where h·w is about `tokens`.
        """
        height, width = image.shape[2:]
        rows, columns = token_grid(height, width, tokens)
        features, class_token = self.encoder(image, rows, columns)
        # Each level also gets its pixels' places on the photo, which tell the aspect ratio.
        planes = [
            view_plane(rows * 2**level, columns * 2**level, width / height).to(image)
            for level in range(LEVEL_COUNT)
        ]
        # The encoder's features go into the coarsest level; the finer levels get only the places.
        inputs = [torch.cat([features, planes[0]], dim=1), *planes[1:]]
        metric_scale = self.scale_head(class_token)[0, 0].exp()
        return self.neck(inputs), metric_scale

    @staticmethod
    def decode(head: Pyramid, levels: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        """A head's finest output, from the neck's levels, resized to `size` (h, w): [h, w, C]."""
        finest = head(levels)[-1]
        resized = interpolate(finest, size=size, mode="bilinear", align_corners=False)
        return resized[0].permute(1, 2, 0)


def token_grid(height: int, width: int, tokens: int) -> tuple[int, int]:
    """(rows, columns) of a grid of about `tokens` tokens over a photo of this size in pixels."""
    # rows · columns = tokens and columns / rows = aspect
    aspect = width / height
    rows = max(1, round(math.sqrt(tokens / aspect)))
    columns = max(1, round(math.sqrt(tokens * aspect)))
    return rows, columns


def view_plane(rows: int, columns: int, aspect: float) -> Tensor:
    """Where the cells of a grid over the photo have their centres: x and y [1, 2, rows, columns].

    They count from the photo's centre, in units of half its diagonal; `aspect` is the photo's width
    over its height.
    """
    # First from -1 to 1 across the photo.
    x = (2 * torch.arange(columns, dtype=torch.float64) + 1) / columns - 1
    y = (2 * torch.arange(rows, dtype=torch.float64) + 1) / rows - 1
    # Then in units of half the diagonal: in this unit, a lens with a certain diagonal angle of view
    # has the same focal length at every aspect ratio.
    diagonal = math.hypot(1, aspect)
    grid = torch.meshgrid(x * (aspect / diagonal), y / diagonal, indexing="xy")
    return torch.stack(grid)[None].float()


def load_network(path: str | os.PathLike[str], dtype: torch.dtype) -> MogeNetwork:
    """A frozen network from MoGe-2's model.pt, on the CPU.

    Residual blocks compute in `dtype`, float32 or bfloat16. The features that they add to are
    float32, because bfloat16's eight bits would turn slanted surfaces into stairs. Nothing in the
    file is executed. InputError for a wrong file or too little memory.
    """
    config, tensors = read_checkpoint(path, "model_config", ADVICE)
    unpublished = as_input_error(path, f"not a published kind of MoGe-2 ({{reason}}): {ADVICE}")
    with unpublished, torch.device("meta"):  # without memory; the weights come from the file
        network = MogeNetwork(config)  # type: ignore[arg-type]

    weights = {
        name.removeprefix("model."): tensor
        for name, tensor in tensors.items()
        # The head that predicts surface normals is left out: they are not needed.
        if name.startswith("model.") and not name.startswith("model.normal_head.")
    }
    convert = functools.partial(set_precision, dtype=dtype)
    return load_strict(network, weights, path, ADVICE, prepare=convert)


def set_precision(network: nn.Module, dtype: torch.dtype) -> None:
    """Convert the layers of residual blocks to `dtype`, in place; the other layers stay float32.

    These blocks take most of the time. Kernels of all layers become channels-last, which is fast on
    a CPU.
    """
    for block in network.modules():
        if isinstance(block, (TransformerBlock, ConvBlock)):
            for layer in block.modules():
                if isinstance(layer, (nn.Linear, nn.Conv2d)):
                    layer.to(dtype)
    to_channels_last(network)
