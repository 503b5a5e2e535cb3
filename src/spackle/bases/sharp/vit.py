"""The vision transformer that SHARP runs over windows of the picture; parameters are named as in its checkpoint."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import gelu, scaled_dot_product_attention

from spackle.bases.sharp.config import SharpConfig
from spackle.bases.sharp.precision import ExactConv, lower

NORM_EPS = 1e-6
MLP_RATIO = 4


class VisionTransformer(nn.Module):
    """ViT with a class token, learned positions and scaled residuals (DINOv2's), without its classifier.

    The stream of tokens stays in float32 whatever the precision of the products: each block adds
    little to much, which bfloat16 would round away.
    """

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.grid = config.grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, config.embed))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + config.grid**2, config.embed))
        self.patch_embed = PatchEmbed(config)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.norm = nn.LayerNorm(config.embed, eps=NORM_EPS)

    def forward(self, windows: Tensor, taps: tuple[int, ...] = ()) -> tuple[Tensor, list[Tensor]]:
        """Feature maps of windows.

        Args:
            windows: [B, 3, S, S] in -1..1.
            taps: indices of blocks whose output is wanted too.

        Returns:
            The normalised features [B, C, G, G], and those of the taps, not normalised.
        """
        tokens = self.patch_embed(windows)
        tokens = torch.cat([self.cls_token.expand(len(tokens), -1, -1), tokens], dim=1) + self.pos_embed
        tapped = []
        for index, block in enumerate(self.blocks):
            tokens = block(tokens)
            if index in taps:
                tapped.append(self._to_map(tokens))
        return self._to_map(self.norm(tokens)), tapped

    def _to_map(self, tokens: Tensor) -> Tensor:
        """[B, 1 + G², C] to [B, C, G, G], without the class token."""
        return tokens[:, 1:].reshape(len(tokens), self.grid, self.grid, -1).permute(0, 3, 1, 2)


class PatchEmbed(nn.Module):
    """Windows [B, 3, S, S] to tokens [B, G², C]."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.proj = ExactConv(3, config.embed, config.patch, stride=config.patch)

    def forward(self, windows: Tensor) -> Tensor:
        tokens: Tensor = self.proj(windows)
        return tokens.flatten(2).transpose(1, 2)


class Block(nn.Module):
    """Attention, then a perceptron, each added to the stream; tokens [B, T, C] float32."""

    def __init__(self, config: SharpConfig) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(config.embed, eps=NORM_EPS)
        self.attn = Attention(config.embed, config.heads)
        self.ls1 = LayerScale(config.embed)
        self.norm2 = nn.LayerNorm(config.embed, eps=NORM_EPS)
        self.mlp = Mlp(config.embed)
        self.ls2 = LayerScale(config.embed)

    def forward(self, tokens: Tensor) -> Tensor:
        tokens = tokens + self.ls1(self.attn(self.norm1(tokens)))
        out: Tensor = tokens + self.ls2(self.mlp(self.norm2(tokens)))
        return out


class Attention(nn.Module):
    """Self-attention of several heads."""

    def __init__(self, embed: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(embed, 3 * embed)
        self.proj = nn.Linear(embed, embed)

    def forward(self, tokens: Tensor) -> Tensor:
        batch, count, width = tokens.shape
        qkv: Tensor = self.qkv(lower(tokens, self.qkv))
        query, key, value = qkv.view(batch, count, 3, self.heads, width // self.heads).permute(2, 0, 3, 1, 4)
        attended = scaled_dot_product_attention(query, key, value)
        projected: Tensor = self.proj(attended.transpose(1, 2).flatten(2))
        return projected


class Mlp(nn.Module):
    """Two linear maps with a GELU between them."""

    def __init__(self, embed: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(embed, MLP_RATIO * embed)
        self.fc2 = nn.Linear(MLP_RATIO * embed, embed)

    def forward(self, tokens: Tensor) -> Tensor:
        out: Tensor = self.fc2(gelu(self.fc1(lower(tokens, self.fc1))))
        return out


class LayerScale(nn.Module):
    """One learned factor for each channel; float32 comes out."""

    def __init__(self, embed: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(embed))

    def forward(self, tokens: Tensor) -> Tensor:
        return tokens * self.gamma
