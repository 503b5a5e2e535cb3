"""MoGe-2 (Wang et al. 2025, arXiv 2507.02546): a DINOv2 backbone, a pyramid of features, and a pyramid for each output.

Modules are named as in the checkpoint. The checkpoint's `model_config` gives the sizes; options that no published
checkpoint uses are refused.
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
BACKBONES = {
    "dinov2_vits14": (384, 12, 6),
    "dinov2_vitb14": (768, 12, 12),
    "dinov2_vitl14": (1024, 24, 16),
}
PATCH_PX = 14  # side of a token in pixels
TRAINED_GRID = 37  # tokens along a side for which the positions were learned
LEVEL_COUNT = 5  # of a pyramid; each level is twice as fine as the previous level
PIXELS_PER_TOKEN = 2 ** (LEVEL_COUNT - 1)  # output pixels along a token's side
conv3 = functools.partial(nn.Conv2d, kernel_size=3, padding=1, padding_mode="replicate")

MOST_BLOCKS = 64  # of a pyramid's level
USUAL = {  # options of a pyramid that are the same in all published checkpoints
    "res_block_in_norm": "none",
    "res_block_hidden_norm": "none",
    "dim_times_res_block_hidden": 1,
    "activation": "relu",
}


@dataclasses.dataclass(frozen=True)
class MogeOutput:
    """The network's output on a grid [h, w] over the photo; float32."""

    points: (
        Tensor  # [h, w, 3] x right, y down, z forward, up to the metric scale and a shift along z
    )
    mask_logits: Tensor  # [h, w] above 0 for a surface, else sky
    metric_scale: Tensor  # [] metres for each unit of the points


class DinoBackbone(nn.Module):
    """DINOv2 (Oquab et al. 2023) without registers."""

    def __init__(self, width: int, depth: int, heads: int) -> None:
        super().__init__()
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + TRAINED_GRID**2, width))
        self.mask_token = nn.Parameter(torch.zeros(1, width))  # for training only
        self.patch_embed = nn.ModuleDict({"proj": nn.Conv2d(3, width, PATCH_PX, stride=PATCH_PX)})
        self.blocks = nn.ModuleList(TransformerBlock(width, heads) for _ in range(depth))
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)

    def forward(self, image: Tensor, layers: Sequence[int]) -> list[Tensor]:
        """Normalised tokens [1, 1 + T, C] (class token first) after the blocks `layers`; image [1, 3, 14·h, 14·w]."""
        patches, positions = self.patch_embed["proj"](image), self.pos_embed
        rows, columns = patches.shape[2:]
        if (rows, columns) != (TRAINED_GRID, TRAINED_GRID):
            # DINOv2 resizes by a factor of (n + 0.1) / 37, which puts positions a little off the grid.
            factors = ((rows + 0.1) / TRAINED_GRID, (columns + 0.1) / TRAINED_GRID)
            grid = positions[:, 1:].reshape(1, TRAINED_GRID, TRAINED_GRID, -1).permute(0, 3, 1, 2)
            grid = interpolate(grid, scale_factor=factors, mode="bicubic", align_corners=False)
            positions = torch.cat([positions[:, :1], grid.flatten(2).transpose(1, 2)], dim=1)  # type: ignore[assignment]
        tokens = torch.cat([self.cls_token, patches.flatten(2).transpose(1, 2)], dim=1) + positions
        after = []
        for block in self.blocks:
            tokens = block(tokens)
            after.append(tokens)
        return [self.norm(after[layer]) for layer in layers]


class DinoEncoder(nn.Module):
    """Encodes an image to features [1, C, h, w] and the class token [1, C']."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        super().__init__()
        width, depth, heads = BACKBONES[config["backbone"]]
        self.layers = [range(depth)[layer] for layer in config["intermediate_layers"]]
        self.register_buffer("image_mean", torch.zeros(1, 3, 1, 1))
        self.register_buffer("image_std", torch.ones(1, 3, 1, 1))
        self.backbone = DinoBackbone(width, depth, heads)
        self.output_projections = nn.ModuleList(
            nn.Conv2d(width, config["dim_out"], 1) for _ in self.layers
        )

    def forward(self, image: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor]:
        size = (PATCH_PX * rows, PATCH_PX * columns)
        seen = interpolate(image, size=size, mode="bilinear", align_corners=False, antialias=True)
        tokens = self.backbone(
            (seen - self.get_buffer("image_mean")) / self.get_buffer("image_std"), self.layers
        )
        maps = [each[:, 1:].transpose(1, 2).unflatten(2, (rows, columns)) for each in tokens]
        features = [
            project(each) for project, each in zip(self.output_projections, maps, strict=True)
        ]
        return torch.stack(features).sum(0), tokens[-1][:, 0]


class ConvBlock(nn.Module):
    """Two convolutions, whose output is added to the input [1, C, h, w] in float32."""

    def __init__(self, width: int) -> None:
        super().__init__()
        first, second = conv3(width, width), conv3(width, width)
        self.layers = nn.Sequential(
            nn.Identity(), nn.ReLU(), first, nn.Identity(), nn.ReLU(), second
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.layers(x.to(next(self.parameters()).dtype))
        return out


def make_resampler(kind: str, inputs: int, outputs: int) -> nn.Sequential:
    """Layers that double the size of feature maps."""
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
    """Features from coarse to fine: each level adds its input to the upsampled features of the coarser level."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        super().__init__()
        options = {"dim_times_res_block_hidden": 1, "activation": "relu", **config}
        for key, value in USUAL.items():
            if options.get(key) != value:
                raise ValueError(f"{key} is {short_repr(options.get(key))}")
        widths, counts, outs = (
            config["dim_res_blocks"],
            config["num_res_blocks"],
            config["dim_out"] or [None] * LEVEL_COUNT,
        )
        if len(widths) != LEVEL_COUNT or max(counts) > MOST_BLOCKS:
            raise ValueError(f"num_res_blocks is {short_repr(counts)}")
        self.input_blocks = nn.ModuleList(
            map(functools.partial(nn.Conv2d, kernel_size=1), config["dim_in"], widths)
        )
        self.res_blocks = nn.ModuleList(
            nn.Sequential(*(ConvBlock(width) for _ in range(count)))
            for width, count in zip(widths, counts, strict=True)
        )
        self.output_blocks = nn.ModuleList(
            nn.Identity() if out is None else nn.Conv2d(width, out, 1)
            for width, out in zip(widths, outs, strict=True)
        )
        self.resamplers = nn.ModuleList(
            map(make_resampler, config["resamplers"], widths[:-1], widths[1:])
        )

    def forward(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """The outputs of all levels [1, C, 2^l·h, 2^l·w]; each level's input has the same height and width."""
        outputs: list[Tensor] = []
        carried: Tensor | None = None
        for level, x in enumerate(inputs):
            x = self.input_blocks[level](x)
            carried = self.res_blocks[level](
                x if carried is None else x + self.resamplers[level - 1](carried)
            )
            outputs.append(self.output_blocks[level](carried))
        return outputs


class MogeNetwork(nn.Module):
    """Predicts points, mask and metric scale from a photo."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Build the network for a checkpoint's `model_config`; an unpublished kind can raise any exception."""
        super().__init__()
        self.least_tokens, self.most_tokens = map(int, config["num_tokens_range"])
        self.plain_exp = {"exp": True, "sinh_exp": False}[config["remap_output"]]
        self.encoder = DinoEncoder(config["encoder"])
        self.neck = Pyramid(config["neck"])
        self.points_head, self.mask_head = (
            Pyramid(config["points_head"]),
            Pyramid(config["mask_head"]),
        )
        dims = config["scale_head"]["dims"]
        first, second, third = map(nn.Linear, dims[:-1], dims[1:])
        self.scale_head = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), third)

    def forward(self, image: Tensor, tokens: int, size: tuple[int, int]) -> MogeOutput:
        """Maps of `size` (h, w) from an image [1, 3, H, W], sRGB in 0..1, which is encoded as about `tokens` tokens."""
        levels, scale = self.features(image, tokens)
        x, y, z = self.decode(self.points_head, levels, size).unbind(-1)
        z = z.exp()
        x, y = (x * z, y * z) if self.plain_exp else (x.sinh(), y.sinh())
        mask_logits = self.decode(self.mask_head, levels, size)[..., 0]
        return MogeOutput(torch.stack([x, y, z], dim=-1), mask_logits, scale)

    def features(self, image: Tensor, tokens: int) -> tuple[list[Tensor], Tensor]:
        """The neck's features [1, C, 2^l·h, 2^l·w] of all levels, and the metric scale []."""
        height, width = image.shape[2:]
        rows, columns = token_grid(height, width, tokens)
        features, class_token = self.encoder(image, rows, columns)
        planes = [
            view_plane(rows << level, columns << level, width / height).to(image)
            for level in range(LEVEL_COUNT)
        ]
        inputs = [torch.cat([features, planes[0]], dim=1), *planes[1:]]
        return self.neck(inputs), self.scale_head(class_token)[0, 0].exp()

    @staticmethod
    def decode(head: Pyramid, levels: Sequence[Tensor], size: tuple[int, int]) -> Tensor:
        """A head's finest output, resized to `size` (h, w): [h, w, C]."""
        return interpolate(head(levels)[-1], size=size, mode="bilinear", align_corners=False)[
            0
        ].permute(1, 2, 0)


def token_grid(height: int, width: int, tokens: int) -> tuple[int, int]:
    """(rows, columns) of a grid of about the given number of tokens over a photo."""
    return max(1, round(math.sqrt(tokens / (width / height)))), max(
        1, round(math.sqrt(tokens * (width / height)))
    )


def view_plane(rows: int, columns: int, aspect: float) -> Tensor:
    """[1, 2, rows, columns]: x and y of each cell's centre, from the photo's centre, in units of half its diagonal."""
    x, y = (((2 * torch.arange(n, dtype=torch.float64) + 1) / n - 1) for n in (columns, rows))
    diagonal = math.hypot(1, aspect)
    grid = torch.meshgrid(x * (aspect / diagonal), y / diagonal, indexing="xy")
    return torch.stack(grid)[None].float()


def load_network(path: str | os.PathLike[str], dtype: torch.dtype) -> MogeNetwork:
    """A frozen network from MoGe-2's model.pt, on the CPU; InputError for a wrong file or too little memory.

    Residual blocks compute in `dtype`, float32 or bfloat16, and add to float32 features, because bfloat16's eight bits
    would turn slanted surfaces into stairs. Nothing in the file is executed.
    """
    config, tensors = read_checkpoint(path, "model_config", ADVICE)
    with (
        as_input_error(path, f"not a published kind of MoGe-2 ({{reason}}): {ADVICE}"),
        torch.device("meta"),
    ):
        network = MogeNetwork(config)  # type: ignore[arg-type]
    weights = {  # without the head for normals, which Spackle does not use
        name.removeprefix("model."): tensor
        for name, tensor in tensors.items()
        if name.startswith("model.") and not name.startswith("model.normal_head.")
    }
    return load_strict(
        network, weights, path, ADVICE, prepare=functools.partial(set_precision, dtype=dtype)
    )


def set_precision(network: nn.Module, dtype: torch.dtype) -> None:
    """Convert the residual blocks to `dtype`, in place, and kernels to channels-last."""
    for block in network.modules():
        if isinstance(block, (TransformerBlock, ConvBlock)):
            for layer in block.modules():
                if isinstance(layer, (nn.Linear, nn.Conv2d)):
                    layer.to(dtype)
    to_channels_last(network)
