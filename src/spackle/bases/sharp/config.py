"""Sizes of the SHARP network: the published one, and a tiny one of the same classes."""

from __future__ import annotations

import dataclasses

LAYERS = 2  # of Gaussians: the visible surface, and what may be behind it
STRIDE = 2  # pixels of the network's picture for each cell of Gaussians


@dataclasses.dataclass(frozen=True)
class SharpConfig:
    """Widths and depths; whatever else there is about SHARP is the same in all sizes."""

    embed: int = 1024  # width of both vision transformers
    depth: int = 24  # their blocks
    heads: int = 16
    classes: int = 21841  # of the transformers' classifiers, which are in the checkpoint and never used
    taps: tuple[int, int] = (5, 11)  # blocks whose tokens become the two finest feature maps
    pyramid: tuple[int, int, int, int] = (256, 512, 1024, 1024)  # channels of the coarser feature maps, fine to coarse
    depth_width: int = 256  # channels of the depth decoder, and of the finest feature map
    gaussian_width: int = 128  # channels of the Gaussian decoder
    feature_width: int = 32  # channels that the Gaussians are predicted from
    patch: int = 16  # pixels of a token's side; the decoders count on 16
    window: int = 384  # pixels of a transformer's picture, a multiple of 8 tokens

    @property
    def side(self) -> int:
        """Pixels of the side of the square picture that the network looks at."""
        return 4 * self.window

    @property
    def grid(self) -> int:
        """Tokens of a window's side."""
        return self.window // self.patch


FULL = SharpConfig()
TINY = SharpConfig(
    embed=48,
    depth=4,
    heads=3,
    classes=8,
    taps=(0, 1),
    pyramid=(16, 24, 32, 32),
    depth_width=16,
    gaussian_width=16,
    feature_width=16,
)
CONFIGS = {"full": FULL, "tiny": TINY}
