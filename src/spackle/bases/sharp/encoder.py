"""SHARP's sizes, precision and encoder: a vision transformer over windows of the picture at three sizes.

Modules are named as in the checkpoint.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, interpolate, scaled_dot_product_attention

from spackle.runtime.progress import Progress
from spackle.weights.checkpoints import to_channels_last

LAYER_COUNT = 2  # of Gaussians: the visible surface, and what may be behind it
CELL_STRIDE = 2  # pixels of the network's picture for each cell of Gaussians


@dataclasses.dataclass(frozen=True)
class SharpConfig:
    """Widths and depths of one size of SHARP; everything else is the same in all sizes."""

    embed: int = 1024  # width of both vision transformers
    depth: int = 24  # their blocks
    heads: int = 16
    taps: tuple[int, int] = (5, 11)  # blocks whose tokens become the two finest feature maps
    pyramid: tuple[int, int, int, int] = (
        256,
        512,
        1024,
        1024,
    )  # channels of the coarser feature maps, fine to coarse
    depth_width: int = 256  # channels of the depth decoder, and of the finest feature map
    gaussian_width: int = 128  # channels of the Gaussian decoder
    feature_width: int = 32  # channels that the Gaussians are predicted from
    patch: int = 16  # side of a token in pixels; the decoders assume 16
    window: int = 384  # side in pixels of a transformer's input, a multiple of 8 tokens

    @property
    def side(self) -> int:  # of the network's square input, in pixels
        return 4 * self.window

    @property
    def grid(self) -> int:  # number of tokens along a window's side
        return self.window // self.patch


FULL_SIZE = SharpConfig()
TINY_SIZE = SharpConfig(
    48, 4, 3, (0, 1), (16, 24, 32, 32), depth_width=16, gaussian_width=16, feature_width=16
)
MICRO_SIZE = dataclasses.replace(TINY_SIZE, window=128)  # a ninth of the pixels
SIZES = {"full": FULL_SIZE, "tiny": TINY_SIZE, "micro": MICRO_SIZE}

_HEAVY = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, nn.GroupNorm)


class Float32Conv(nn.Conv2d):
    """A convolution that stays in float32: it is cheap, and reads the pixels or writes the Gaussians' values."""

    def forward(self, x: Tensor) -> Tensor:
        with torch.autocast(x.device.type, enabled=False):  # the decoder is trained under autocast
            return super().forward(x.float())


def to_precision_of(x: Tensor, module: nn.Module) -> Tensor:
    """`x` in the module's precision."""
    weight: Tensor = module.weight  # type: ignore[assignment]
    return x.to(weight.dtype)


def set_precision(network: nn.Module, dtype: torch.dtype) -> None:
    """Convert the expensive layers to `dtype`, in place, and kernels to channels-last, which is fast on a CPU."""
    for module in network.modules():
        if isinstance(module, _HEAVY) and not isinstance(module, Float32Conv):
            module.to(dtype)
    to_channels_last(network)


NORM_EPS = 1e-6
MLP_RATIO = 4


class VisionTransformer(nn.Module):
    """DINOv2's ViT without classifier; tokens stay float32, because bfloat16 would round away small residuals."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.grid = config.grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, config.embed))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid**2, config.embed))
        self.patch_embed = nn.ModuleDict(
            {"proj": Float32Conv(3, config.embed, config.patch, stride=config.patch)}
        )
        self.blocks = nn.ModuleList(
            TransformerBlock(config.embed, config.heads) for _ in range(config.depth)
        )
        self.norm = nn.LayerNorm(config.embed, eps=NORM_EPS)

    def forward(self, windows: Tensor, taps: tuple[int, ...] = ()) -> tuple[Tensor, list[Tensor]]:
        """Normalised features [B, C, G, G] of windows [B, 3, S, S] in -1..1, and raw features after blocks `taps`."""
        tokens = self.patch_embed["proj"](windows).flatten(2).transpose(1, 2)
        tokens = (
            torch.cat([self.cls_token.expand(len(tokens), -1, -1), tokens], dim=1) + self.pos_embed
        )
        tapped = []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in taps:
                tapped.append(self._to_map(tokens))
        return self._to_map(self.norm(tokens)), tapped

    def _to_map(self, tokens: Tensor) -> Tensor:
        """[B, 1 + G², C] to [B, C, G, G], without the class token."""
        return tokens[:, 1:].reshape(len(tokens), self.grid, self.grid, -1).permute(0, 3, 1, 2)


class TransformerBlock(nn.Module):
    """DINOv2's block: self-attention, then an MLP, each scaled by channel and added to float32 tokens [B, T, C]."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = (nn.LayerNorm(width, eps=NORM_EPS) for _ in range(2))
        self.attn = nn.ModuleDict(
            {"qkv": nn.Linear(width, 3 * width), "proj": nn.Linear(width, width)}
        )
        self.mlp = nn.ModuleDict(
            {"fc1": nn.Linear(width, MLP_RATIO * width), "fc2": nn.Linear(MLP_RATIO * width, width)}
        )
        self.ls1, self.ls2 = (nn.ParameterDict({"gamma": torch.ones(width)}) for _ in range(2))

    def forward(self, tokens: Tensor) -> Tensor:
        tokens = tokens + self._attended(self.norm1(tokens)) * self.ls1["gamma"]
        hidden = gelu(self.mlp["fc1"](to_precision_of(self.norm2(tokens), self.mlp["fc1"])))
        out: Tensor = tokens + self.mlp["fc2"](hidden) * self.ls2["gamma"]
        return out

    def _attended(self, tokens: Tensor) -> Tensor:
        batch, count, width = tokens.shape
        qkv = self.attn["qkv"](to_precision_of(tokens, self.attn["qkv"]))
        query, key, value = qkv.view(batch, count, 3, self.heads, width // self.heads).permute(
            2, 0, 3, 1, 4
        )
        attended = scaled_dot_product_attention(query, key, value)
        projected: Tensor = self.attn["proj"](attended.transpose(1, 2).flatten(2))
        return projected


# Number of windows along a side of the picture: at full size they overlap by a quarter, at half size by a half.
# At a quarter of its size, the picture is one window.
FULL_WINDOWS, HALF_WINDOWS = 5, 3
WINDOW_COUNT = FULL_WINDOWS**2 + HALF_WINDOWS**2 + 1


class SlidingPyramid(nn.Module):
    """Encodes a picture to feature maps of five scales, [1, C, side/2, …] to [1, C, side/32, …]."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.taps = config.taps
        self.window = config.window
        self.full_trim, self.half_trim = (
            config.grid // 8,
            config.grid // 4,
        )  # tokens: half an overlap
        self.patch_encoder = VisionTransformer(config)
        self.image_encoder = VisionTransformer(config)
        fine, embed, dims = config.depth_width, config.embed, config.pyramid
        self.upsample_latent0 = _project_and_double(embed, dims[0], fine, 3)
        self.upsample_latent1 = _project_and_double(embed, dims[0], dims[0], 2)
        self.upsample0 = _project_and_double(embed, dims[1], dims[1], 1)
        self.upsample1 = _project_and_double(embed, dims[2], dims[2], 1)
        self.upsample2 = _project_and_double(embed, dims[3], dims[3], 1)
        self.upsample_lowres = nn.ConvTranspose2d(embed, dims[3], 2, stride=2)
        self.fuse_lowres = nn.Conv2d(2 * dims[3], dims[3], 1)

    def forward(self, image: Tensor, batch: int, progress: Progress | None = None) -> list[Tensor]:
        """Feature maps, fine to coarse, of a picture [1, 3, side, side] in -1..1, `batch` windows at a time."""
        half, quarter = (interpolate(image, scale_factor=f, mode="bilinear") for f in (0.5, 0.25))
        windows = torch.cat(
            [
                cut_windows(image, self.window, FULL_WINDOWS),
                cut_windows(half, self.window, HALF_WINDOWS),
                quarter,
            ]
        )
        maps, latents = self._encode(windows, batch, progress)
        full, middle, whole = torch.split(maps, [FULL_WINDOWS**2, HALF_WINDOWS**2, 1])
        whole = self.upsample2(whole)
        lowres = self.upsample_lowres(
            to_precision_of(self.image_encoder(quarter)[0], self.upsample_lowres)
        )
        return [
            self.upsample_latent0(merge_windows(latents[0], self.full_trim)),
            self.upsample_latent1(merge_windows(latents[1], self.full_trim)),
            self.upsample0(merge_windows(full, self.full_trim)),
            self.upsample1(merge_windows(middle, self.half_trim)),
            self.fuse_lowres(torch.cat([whole, lowres], dim=1)),
        ]

    def _encode(
        self, windows: Tensor, batch: int, progress: Progress | None
    ) -> tuple[Tensor, list[Tensor]]:
        found: list[list[Tensor]] = [[] for _ in range(1 + len(self.taps))]
        for start in range(0, len(windows), batch):
            features, tapped = self.patch_encoder(windows[start : start + batch], self.taps)
            kept = max(0, FULL_WINDOWS**2 - start)  # only full-size windows need taps
            for into, part in zip(found, [features, *(tap[:kept] for tap in tapped)], strict=True):
                into.append(to_precision_of(part, self.fuse_lowres))
            if progress:
                progress(min(start + batch, len(windows)), len(windows))
        features, *latents = (torch.cat(parts) for parts in found)
        return features, latents


def cut_windows(image: Tensor, window: int, count: int) -> Tensor:
    """count² evenly overlapping windows [count², C, window, window] of [1, C, S, S], in row-major order."""
    stride = (image.shape[-1] - window) // (count - 1)
    rows = image.unfold(2, window, stride).unfold(
        3, window, stride
    )  # [1, C, count, count, window, window]
    return rows[0].permute(1, 2, 0, 3, 4).flatten(0, 1)


def merge_windows(maps: Tensor, trim: int) -> Tensor:
    """The inverse of `cut_windows` for feature maps [n², C, G, G]; beside a neighbour, `trim` cells of a map are cut off."""
    count = int(len(maps) ** 0.5)
    size = maps.shape[-1]
    spans = [slice(trim if i else 0, size - trim if i < count - 1 else size) for i in range(count)]
    rows = []
    for i, vertical in enumerate(spans):
        tiles = [maps[i * count + j, :, vertical, horizontal] for j, horizontal in enumerate(spans)]
        rows.append(torch.cat(tiles, dim=2))
    return torch.cat(rows, dim=1)[None]


def _project_and_double(
    dim_in: int, dim_middle: int, dim_out: int, doublings: int
) -> nn.Sequential:
    layers: list[nn.Module] = [nn.Conv2d(dim_in, dim_middle, 1, bias=False)]
    for index in range(doublings):
        layers.append(
            nn.ConvTranspose2d(dim_out if index else dim_middle, dim_out, 2, stride=2, bias=False)
        )
    return nn.Sequential(*layers)
