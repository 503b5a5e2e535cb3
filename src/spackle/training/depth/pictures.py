"""Inverse depth as colours, and photos with what was predicted of them beside what is true."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

# Viridis at nine places: even steps to the eye, in grey and for the colour-blind too.
VIRIDIS = torch.tensor(
    [
        (68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 144, 140),
        (39, 173, 129), (93, 200, 99), (170, 220, 50), (253, 231, 37),
    ]
) / 255  # fmt: skip
UNKNOWN = 0.2  # grey of pixels without a value
ENDS = (0.02, 0.98)  # quantiles that have the first and the last colour


def colored(values: Tensor, low: float, high: float, known: Tensor | None = None) -> Tensor:
    """[H, W, 3] sRGB of values [H, W]; low and high are the ends of the colours, and what is beyond them."""
    place = ((values - low) / max(high - low, 1e-12)).clamp(0, 1) * (len(VIRIDIS) - 1)
    below = place.long().clamp_max(len(VIRIDIS) - 2)
    colors = torch.lerp(VIRIDIS[below], VIRIDIS[below + 1], (place - below)[..., None])
    return colors if known is None else torch.where(known[..., None], colors, UNKNOWN)


def ends(values: Tensor) -> tuple[float, float]:
    """The range of colours that shows values [N]."""
    low, high = torch.quantile(values.float(), torch.tensor(ENDS)).tolist()
    return low, high


def sheet(rows: Sequence[Sequence[Tensor]], side: int) -> Tensor:
    """[H, W, 3]: rows of pictures [h, w, 3], each at most `side` long; narrower rows are black at their end."""
    shown = [torch.cat([_at_most(picture, side) for picture in row], dim=1) for row in rows]
    widest = max(row.shape[1] for row in shown)
    return torch.cat([pad(row, (0, 0, 0, widest - row.shape[1])) for row in shown])


def _at_most(picture: Tensor, side: int) -> Tensor:
    height, width = picture.shape[:2]
    scale = min(1.0, side / max(height, width))
    size = max(1, round(height * scale)), max(1, round(width * scale))
    return interpolate(picture.movedim(-1, 0)[None], size=size, mode="area")[0].movedim(0, -1)
