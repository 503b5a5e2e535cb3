"""Textures as pyramids of ever smaller pictures, in one array that compiled code can read.

Light is computed with linear colours, so pictures are averaged as linear colours, too, and
kept as sRGB bytes, which a table turns back.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.runtime.kernels import kernel

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
MAX_LEVELS = 12  # of a pyramid, down to one pixel
KEPT_PICTURES = 300
WHITE = 255


def srgb_to_linear(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Linear colours of sRGB colours in 0..1 (IEC 61966-2-1)."""
    values = np.asarray(values, np.float32)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )


def linear_to_srgb(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """SRGB colours of linear colours in 0..1."""
    values = np.clip(np.asarray(values, np.float32), 0, 1)
    return np.where(
        values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055
    ).astype(np.float32)


BYTE_TO_LINEAR = srgb_to_linear(np.arange(256) / 255)


@dataclasses.dataclass(frozen=True)
class Pyramids:
    """Many pictures in one array: all levels of all pictures, one after the other."""

    texels: Bytes  # [N, 4] sRGB and coverage
    offsets: NDArray[np.int64]  # [T, MAX_LEVELS] the first texel of each level
    sizes: NDArray[np.int32]  # [T, 2] width and height of level 0
    levels: NDArray[np.int32]  # [T] number of levels
    has_holes: NDArray[np.bool_]  # [T] whether coverage is below one half anywhere
    mean: Floats  # [T, 3] linear mean colour


def pyramids(pictures: Sequence[Bytes]) -> Pyramids:
    """Build the pyramids of pictures [H, W, 3 or 4]."""
    # At least one entry, because compiled code cannot index empty arrays.
    parts: list[Bytes] = []
    offsets = np.zeros((max(1, len(pictures)), MAX_LEVELS), np.int64)
    sizes = np.ones((max(1, len(pictures)), 2), np.int32)
    levels = np.ones(max(1, len(pictures)), np.int32)
    has_holes = np.zeros(max(1, len(pictures)), bool)
    mean = np.ones((max(1, len(pictures)), 3), np.float32)
    start = 0
    for number, picture in enumerate(pictures):
        chain = _kept_chain(picture)
        sizes[number] = chain[0].shape[1], chain[0].shape[0]
        levels[number] = len(chain)
        has_holes[number] = bool((chain[0][..., 3] < WHITE // 2).any())
        mean[number] = BYTE_TO_LINEAR[chain[-1][0, 0, :3]]
        for level, small in enumerate(chain):
            offsets[number, level] = start
            parts.append(small.reshape(-1, 4))
            start += small.shape[0] * small.shape[1]
    texels = np.concatenate(parts) if parts else np.full((1, 4), WHITE, np.uint8)
    return Pyramids(texels, offsets, sizes, levels, has_holes, mean)


_CHAINS: dict[int, tuple[Bytes, list[Bytes]]] = {}  # by the picture's identity, which it keeps


def _kept_chain(picture: Bytes) -> list[Bytes]:
    """See `_chain`; the levels of pictures that stay in memory are made once."""
    found = _CHAINS.get(id(picture))
    if found is None:
        if len(_CHAINS) > KEPT_PICTURES:
            _CHAINS.clear()
        found = (picture, _chain(picture))
        _CHAINS[id(picture)] = found
    return found[1]


def _chain(picture: Bytes) -> list[Bytes]:
    """A picture and its halves, down to one pixel, [h, w, 4] each."""
    if picture.shape[2] == 3:
        full = np.full((*picture.shape[:2], 1), WHITE, np.uint8)
        picture = np.concatenate([picture, full], -1)
    chain = [picture]
    current = np.concatenate(
        [BYTE_TO_LINEAR[picture[..., :3]], picture[..., 3:].astype(np.float32) / WHITE], -1
    )
    while current.shape[0] > 1 or current.shape[1] > 1:
        if len(chain) == MAX_LEVELS - 1:  # a very long picture: the last level is its mean
            current = current.mean((0, 1), keepdims=True)
        else:
            current = _halved(_halved(current, 0), 1)
        colors = linear_to_srgb(current[..., :3])
        both = np.concatenate([colors, current[..., 3:]], -1)
        chain.append((both * WHITE + 0.5).astype(np.uint8))
    return chain


def _halved(picture: Floats, axis: int) -> Floats:
    """Means of two neighbours along an axis; the last of an odd number counts alone."""
    count = picture.shape[axis]
    if count == 1:
        return picture
    first = np.take(picture, np.arange(0, count, 2), axis)
    second = np.take(picture, np.minimum(np.arange(1, count + 1, 2), count - 1), axis)
    return np.asarray((first + second) / 2, np.float32)


@functools.lru_cache(KEPT_PICTURES)
def load_picture(path: str) -> Bytes:
    """[H, W, 3 or 4] the picture in a file."""
    with Image.open(path) as picture:
        has_alpha = "A" in picture.getbands()
        return np.asarray(picture.convert("RGBA" if has_alpha else "RGB"))


def find_pictures(names: Sequence[str], made: Mapping[str, Bytes]) -> list[Bytes]:
    """The pictures with these names: made ones by their name, all others from their files."""
    return [made[name] if name in made else load_picture(name) for name in names]


@kernel
def fetch(
    texels: Any,
    offsets: Any,
    size: Any,
    levels: int,
    to_linear: Any,
    u: float,
    v: float,
    footprint: float,
    out: Any,
) -> None:
    """Write the filtered linear colour and coverage at (u, v) to `out` [4].

    Two levels whose texels are about as large as the footprint are read with bilinear weights, and
    blended. The picture repeats.

    Args:
        texels, offsets, size, levels: of one picture; see `Pyramids`.
        to_linear: [256] linear values of bytes.
        u, v: texture coordinates, v up.
        footprint: the width of the seen area in texels of level 0.
        out: [4] becomes red, green, blue and coverage.
    """
    # At level k a texel is 2^k wide.
    level = np.log2(max(footprint, 1.0))
    level = min(level, levels - 1.0)
    low = int(level)
    blend = level - low
    out[:] = 0.0
    for step in range(2):
        at = min(low + step, levels - 1)
        weight = 1.0 - blend if step == 0 else blend
        if weight <= 0.0:
            continue
        width = size[0]
        height = size[1]
        # Odd sides are rounded up; see `_halved`.
        for _ in range(at):
            width = (width + 1) // 2
            height = (height + 1) // 2
        # The four texels around the point, with bilinear weights. The modulus repeats the picture.
        x = u * width - 0.5
        y = (1.0 - v) * height - 0.5
        x_floor = np.floor(x)
        y_floor = np.floor(y)
        fx = x - x_floor
        fy = y - y_floor
        for j in range(2):
            row = (int(y_floor) + j) % height
            wy = fy if j == 1 else 1.0 - fy
            for i in range(2):
                column = (int(x_floor) + i) % width
                wx = fx if i == 1 else 1.0 - fx
                w = weight * wx * wy
                texel = offsets[at] + row * width + column
                for k in range(3):
                    out[k] += w * to_linear[texels[texel, k]]
                out[3] += w * texels[texel, 3] / 255.0
