"""SHARP's sizes, precision and encoder: a vision transformer over windows of the picture.

The picture (1536 pixels a side, as published) is cut into windows of 384 pixels at three sizes.
`SlidingPyramid` is the whole encoder, `VisionTransformer` processes the windows. Modules are named
as in Apple's checkpoint.
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

# Number of windows along a side of the picture: at full size they overlap by a quarter, at half
# size by a half. At a quarter of its size, the picture is one window.
FULL_SIZE_WINDOWS = 5
HALF_SIZE_WINDOWS = 3
WINDOW_COUNT = FULL_SIZE_WINDOWS**2 + HALF_SIZE_WINDOWS**2 + 1

NORM_EPS = 1e-6  # added to the variance in layer norms, as in DINOv2
MLP_RATIO = 4  # width of a transformer's hidden layer over that of its tokens


@dataclasses.dataclass(frozen=True)
class SharpConfig:
    """Widths and depths of one size of SHARP; everything else is the same in all sizes."""

    embed_width: int = 1024  # channels of the tokens in both vision transformers
    block_count: int = 24  # of each transformer
    head_count: int = 16  # of each block's attention
    early_blocks: tuple[int, int] = (5, 11)  # their tokens become the two finest feature maps
    # Channels of the coarser feature maps, fine to coarse.
    pyramid_channels: tuple[int, int, int, int] = (256, 512, 1024, 1024)
    depth_width: int = 256  # channels of the depth decoder, and of the finest feature map
    gaussian_width: int = 128  # channels of the Gaussian decoder
    feature_width: int = 32  # channels that the Gaussians are predicted from
    patch: int = 16  # side of a token in pixels; the decoders assume 16
    window: int = 384  # side in pixels of a transformer's input, a multiple of 8 tokens

    @property
    def side(self) -> int:
        """The side of the network's square input, in pixels."""
        return 4 * self.window

    @property
    def tokens_per_side(self) -> int:
        """The number of tokens along a window's side."""
        return self.window // self.patch


FULL_SIZE = SharpConfig()
TINY_SIZE = SharpConfig(
    embed_width=48,
    block_count=4,
    head_count=3,
    early_blocks=(0, 1),
    pyramid_channels=(16, 24, 32, 32),
    depth_width=16,
    gaussian_width=16,
    feature_width=16,
)
MICRO_SIZE = dataclasses.replace(TINY_SIZE, window=128)  # a ninth of the pixels
SIZES = {"full": FULL_SIZE, "tiny": TINY_SIZE, "micro": MICRO_SIZE}

# The layers that take most of the time; the others, such as layer norms, stay float32.
_EXPENSIVE_LAYERS = (nn.Linear, nn.Conv2d, nn.ConvTranspose2d, nn.GroupNorm)


class Float32Conv(nn.Conv2d):
    """A convolution that stays in float32.

    It stands where a network reads the pixels or writes the Gaussians' values, and is cheap there.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Convolve features [B, C, H, W] of any float type, also under autocast."""
        with torch.autocast(x.device.type, enabled=False):  # the decoder is trained under autocast
            return super().forward(x.float())


def to_precision_of(x: Tensor, module: nn.Module) -> Tensor:
    """`x` in the number type of the module's weights."""
    weight: Tensor = module.weight  # type: ignore[assignment]
    return x.to(weight.dtype)


def set_precision(network: nn.Module, dtype: torch.dtype) -> None:
    """Convert the expensive layers (linear layers, convolutions, group norms) to `dtype`, in place.

    The other layers stay float32, and so does each `Float32Conv`. Kernels become channels-last,
    which is fast on a CPU.
    """
    for module in network.modules():
        if isinstance(module, _EXPENSIVE_LAYERS) and not isinstance(module, Float32Conv):
            module.to(dtype)
    to_channels_last(network)


class VisionTransformer(nn.Module):
    """DINOv2's ViT without classifier.

    Tokens stay float32, because bfloat16 would round away small residuals.
    """

    def __init__(self, config: SharpConfig) -> None:
        """Build the transformer of one size of SHARP; its weights are zeros or random."""
        super().__init__()
        width = config.embed_width
        self.tokens_per_side = config.tokens_per_side
        # The modules are named as in DINOv2's checkpoints.
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.tokens_per_side**2, width))
        patch_conv = Float32Conv(3, width, config.patch, stride=config.patch)
        self.patch_embed = nn.ModuleDict({"proj": patch_conv})
        self.blocks = nn.ModuleList(
            TransformerBlock(width, config.head_count) for _ in range(config.block_count)
        )
        self.norm = nn.LayerNorm(width, eps=NORM_EPS)

    def forward(
        self, windows: Tensor, early_blocks: tuple[int, ...] = ()
    ) -> tuple[Tensor, list[Tensor]]:
        """Encode windows of a picture.

        Args:
            windows: [B, 3, window, window] in -1..1, as published [B, 3, 384, 384].
            early_blocks: numbers of blocks whose tokens are returned, too.

        Returns:
            The normalised features after the last block, as published [B, 1024, 24, 24], and the
            features after each of `early_blocks`, of the same shape and not normalised.
        """
        patches = self.patch_embed["proj"](windows)  # [B, C, G, G], G tokens a side
        tokens = patches.flatten(2).transpose(1, 2)  # [B, G², C]
        class_tokens = self.cls_token.expand(len(tokens), -1, -1)  # [B, 1, C]
        tokens = torch.cat([class_tokens, tokens], dim=1) + self.pos_embed  # [B, 1 + G², C]

        early_features = []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in early_blocks:
                early_features.append(self._to_map(tokens))
        return self._to_map(self.norm(tokens)), early_features

    def _to_map(self, tokens: Tensor) -> Tensor:
        """Arrange tokens [B, 1 + G², C] as a map [B, C, G, G], without the class token."""
        side = self.tokens_per_side
        return tokens[:, 1:].reshape(len(tokens), side, side, -1).permute(0, 3, 1, 2)


class TransformerBlock(nn.Module):
    """DINOv2's block: self-attention, then an MLP.

    Each is scaled by channel and added to the float32 tokens.
    """

    def __init__(self, width: int, head_count: int) -> None:
        """Build a block for tokens with `width` channels, which `head_count` must divide."""
        super().__init__()
        self.heads = head_count
        # The names are those of DINOv2's checkpoints: `ls` is "layer scale", one factor
        # for each channel.
        self.norm1 = nn.LayerNorm(width, eps=NORM_EPS)
        self.norm2 = nn.LayerNorm(width, eps=NORM_EPS)
        self.attn = nn.ModuleDict(
            {"qkv": nn.Linear(width, 3 * width), "proj": nn.Linear(width, width)}
        )
        self.mlp = nn.ModuleDict(
            {"fc1": nn.Linear(width, MLP_RATIO * width), "fc2": nn.Linear(MLP_RATIO * width, width)}
        )
        self.ls1 = nn.ParameterDict({"gamma": torch.ones(width)})
        self.ls2 = nn.ParameterDict({"gamma": torch.ones(width)})

    def forward(self, tokens: Tensor) -> Tensor:
        """Tokens [B, T, C] in float32 to tokens of the same shape and type."""
        # The sums stay float32; only what is added is computed in lower precision.
        tokens = tokens + self._attention(self.norm1(tokens)) * self.ls1["gamma"]
        hidden = gelu(self.mlp["fc1"](to_precision_of(self.norm2(tokens), self.mlp["fc1"])))
        out: Tensor = tokens + self.mlp["fc2"](hidden) * self.ls2["gamma"]
        return out

    def _attention(self, tokens: Tensor) -> Tensor:
        """Multi-head self-attention of tokens [B, T, C], in the precision of the weights."""
        batch, token_count, width = tokens.shape
        qkv = self.attn["qkv"](to_precision_of(tokens, self.attn["qkv"]))  # [B, T, 3·C]
        qkv = qkv.view(batch, token_count, 3, self.heads, width // self.heads)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)  # each [B, heads, T, C / heads]
        attended = scaled_dot_product_attention(query, key, value)
        projected: Tensor = self.attn["proj"](attended.transpose(1, 2).flatten(2))  # [B, T, C]
        return projected


class SlidingPyramid(nn.Module):
    """Encodes a picture to feature maps of five scales, [1, C, side/2, …] to [1, C, side/32, …].

    One transformer sees the picture in 35 windows: 25 at full size, 9 at half size, and 1 at a
    quarter of the size. A second one, `image_encoder`, sees only the last.
    """

    def __init__(self, config: SharpConfig) -> None:
        """Build the encoder of one size of SHARP; its weights are zeros or random."""
        super().__init__()
        self.early_blocks = config.early_blocks
        self.window = config.window
        # Neighbouring windows overlap by a quarter of their side in the full-size picture, and by a
        # half in the half-size one. Where their maps are joined, half of the overlap is trimmed
        # from each: an eighth or a quarter of the side, in tokens.
        self.full_size_trim = config.tokens_per_side // 8
        self.half_size_trim = config.tokens_per_side // 4
        self.patch_encoder = VisionTransformer(config)
        self.image_encoder = VisionTransformer(config)

        # These layers give each feature map its number of channels and its size, from the finest
        # map to the coarsest. `latent` maps come from early blocks. The names are the checkpoint's.
        embed = config.embed_width
        finest = config.depth_width
        fine, middle, coarse, coarsest = config.pyramid_channels
        self.upsample_latent0 = _project_and_upsample(embed, fine, finest, doublings=3)
        self.upsample_latent1 = _project_and_upsample(embed, fine, fine, doublings=2)
        self.upsample0 = _project_and_upsample(embed, middle, middle, doublings=1)
        self.upsample1 = _project_and_upsample(embed, coarse, coarse, doublings=1)
        self.upsample2 = _project_and_upsample(embed, coarsest, coarsest, doublings=1)
        # For the coarsest map, both transformers' outputs for the smallest picture are joined.
        self.upsample_lowres = nn.ConvTranspose2d(embed, coarsest, 2, stride=2)
        self.fuse_lowres = nn.Conv2d(2 * coarsest, coarsest, 1)

    def forward(
        self, image: Tensor, windows_per_batch: int, progress: Progress | None = None
    ) -> list[Tensor]:
        """Encode a picture [1, 3, side, side] in -1..1, as published [1, 3, 1536, 1536].

        The picture is cut into 35 windows, of which `windows_per_batch` go through the transformer
        at once. `progress` is called with the number of windows done and that of all windows.

        Returns:
            Five feature maps, fine to coarse; as published [1, 256, 768, 768], [1, 256, 384, 384],
            [1, 512, 192, 192], [1, 1024, 96, 96] and [1, 1024, 48, 48].
        """
        # A large object fills several windows at full size; at a smaller size, one window shows all
        # of it.
        half = interpolate(image, scale_factor=0.5, mode="bilinear")
        quarter = interpolate(image, scale_factor=0.25, mode="bilinear")
        windows = torch.cat(
            [
                cut_windows(image, self.window, FULL_SIZE_WINDOWS),
                cut_windows(half, self.window, HALF_SIZE_WINDOWS),
                quarter,
            ]
        )  # [35, 3, window, window]
        # Features after the last block, and after two earlier blocks.
        last, (early, later) = self._encode_windows(windows, windows_per_batch, progress)
        last_full, last_half, last_quarter = torch.split(
            last, [FULL_SIZE_WINDOWS**2, HALF_SIZE_WINDOWS**2, 1]
        )

        # The coarsest map comes from both transformers.
        coarsest = self.upsample2(last_quarter)
        context, _ = self.image_encoder(quarter)
        context = self.upsample_lowres(to_precision_of(context, self.upsample_lowres))
        return [
            self.upsample_latent0(merge_windows(early, self.full_size_trim)),
            self.upsample_latent1(merge_windows(later, self.full_size_trim)),
            self.upsample0(merge_windows(last_full, self.full_size_trim)),
            self.upsample1(merge_windows(last_half, self.half_size_trim)),
            self.fuse_lowres(torch.cat([coarsest, context], dim=1)),
        ]

    def _encode_windows(
        self, windows: Tensor, windows_per_batch: int, progress: Progress | None
    ) -> tuple[Tensor, list[Tensor]]:
        """Send windows [35, 3, window, window] through the transformer, a batch at a time.

        `progress` is called after each batch with the number of windows done, and that of all.

        Returns:
            The last block's features, as published [35, 1024, 24, 24], and for each of the two
            `early_blocks` the features of the full-size windows, as published [25, 1024, 24, 24].
        """
        last_batches: list[Tensor] = []
        early_batches: list[list[Tensor]] = [[] for _ in self.early_blocks]  # a list for each block
        for start in range(0, len(windows), windows_per_batch):
            end = start + windows_per_batch
            last, early = self.patch_encoder(windows[start:end], self.early_blocks)
            last_batches.append(to_precision_of(last, self.fuse_lowres))
            # Early features are needed only of the full-size windows, which come first. In a batch
            # after the last of them, the slice is empty.
            full_size_left = max(0, FULL_SIZE_WINDOWS**2 - start)
            for batches, features in zip(early_batches, early, strict=True):
                batches.append(to_precision_of(features[:full_size_left], self.fuse_lowres))
            if progress:
                progress(min(end, len(windows)), len(windows))
        return torch.cat(last_batches), [torch.cat(batches) for batches in early_batches]


def cut_windows(image: Tensor, window: int, count: int) -> Tensor:
    """Cut a picture [1, C, S, S] into count × count evenly overlapping windows.

    They come in row-major order: [count², C, window, window].
    """
    # The first window begins at 0, and the last one ends with the picture.
    stride = (image.shape[-1] - window) // (count - 1)
    rows = image.unfold(2, window, stride)  # [1, C, count, S, window]
    windows = rows.unfold(3, window, stride)  # [1, C, count, count, window, window]
    return windows[0].permute(1, 2, 0, 3, 4).flatten(0, 1)


def merge_windows(maps: Tensor, trim: int) -> Tensor:
    """Join feature maps [n², C, G, G] of n × n windows to one map [1, C, S, S].

    The windows overlap, as `cut_windows` cut them. On each side with a neighbour, `trim` cells are
    cut off from a window's map: half of the overlap.
    """
    count = int(len(maps) ** 0.5)  # n
    size = maps.shape[-1]
    # The part of a map that is kept is the same range of rows for all windows in a row, and the
    # same range of columns for all windows in a column.
    spans = []
    for i in range(count):
        begin = trim if i > 0 else 0
        end = size - trim if i < count - 1 else size
        spans.append(slice(begin, end))

    # Windows lie in row-major order.
    rows = []
    for i, vertical in enumerate(spans):
        tiles = [maps[i * count + j, :, vertical, horizontal] for j, horizontal in enumerate(spans)]
        rows.append(torch.cat(tiles, dim=2))
    return torch.cat(rows, dim=1)[None]


def _project_and_upsample(
    dim_in: int, dim_middle: int, dim_out: int, doublings: int
) -> nn.Sequential:
    """Layers that change channels from `dim_in` to `dim_out`, and double the size of a map.

    First a 1×1 convolution projects to `dim_middle` channels. Then come `doublings` transposed
    convolutions, each of which doubles the width and height.
    """
    layers: list[nn.Module] = [nn.Conv2d(dim_in, dim_middle, 1, bias=False)]
    channels = dim_middle
    for _ in range(doublings):
        layers.append(nn.ConvTranspose2d(channels, dim_out, 2, stride=2, bias=False))
        channels = dim_out
    return nn.Sequential(*layers)
