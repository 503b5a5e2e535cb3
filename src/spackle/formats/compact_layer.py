"""Layers of a page that is sent: a third of the bytes, for a picture that looks the same.

The bytes of `formats.html.encode_layer` are kept coarser, and each as its difference from the
Gaussian before, which compresses well because neighbours in the file are neighbours in the photo.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BYTES_PER_GAUSSIAN = 20
CENTER_PLANES = 9

# A centre is kept to a share of the picture's long side: an eighth of a pixel of 1536.
STEPS_PER_LONG_SIDE = 8 * 1536
# The depth is kept to a twelfth of a thousandth, so that surfaces that nearly touch keep their
# order: nothing else changes the picture as much. A photo of leaves with 1.15 million Gaussians
# differs from the exact picture by 40 dB, and by 34 dB with a quarter of these steps.
DEPTH_STEPS_PER_E = 12288  # steps while the depth grows e-fold
# Whole numbers of three bytes must be able to hold a difference.
MAX_STEP = 1 << 21

# Bits that a byte loses. Colours are half of the bytes. With one bit more of the colours and the
# rotations, that photo's page would have 19 % more bytes, for 2 dB.
SCALE_SHIFT = 2
QUATERNION_SHIFT = 4
COLOR_SHIFT = 2


def compact_layer(layer: bytes, lens: Mapping[str, Any]) -> bytes | None:
    """Return the planes of a layer's N Gaussians, coarser and as differences.

    The 20 planes of N bytes hold, in their order:

    * 9 planes: steps to the right, downwards and into the depth, on the picture and in the depth's
      logarithm; each the difference d from the Gaussian before, as 2d, or -2d - 1 if d < 0, in
      three bytes, lowest first.
    * 3 planes: the scales' bytes without their lowest bits.
    * 4 planes: the quaternion's index, and its bytes without their lowest bits.
    * 3 planes: green, red minus green, and blue minus green without their lowest bits, each the
      difference from the Gaussian before, modulo 256.
    * 1 plane: the opacity.

    Args:
        layer: the bytes of `formats.html.encode_layer`.
        lens: the page's camera: K in pixels, width and height.

    Returns:
        The bytes; None if a Gaussian lies behind the camera, or too far to the side.
    """
    planes = np.frombuffer(layer, np.uint8).reshape(BYTES_PER_GAUSSIAN, -1)
    steps = _center_steps(planes[:CENTER_PLANES], lens)
    if steps is None:
        return None
    differences = np.diff(steps, axis=1, prepend=0)
    unsigned = np.where(differences < 0, -2 * differences - 1, 2 * differences).astype(np.uint32)
    center_bytes = [(unsigned >> shift).astype(np.uint8) for shift in (0, 8, 16)]

    red, green, blue = (planes[16:19] >> COLOR_SHIFT).astype(np.int16)
    color_steps = np.stack([green, red - green, blue - green])
    color_differences = np.diff(color_steps, axis=1, prepend=0)

    compact = [
        np.stack(center_bytes, axis=1).reshape(CENTER_PLANES, -1),
        planes[9:12] >> SCALE_SHIFT,
        planes[12:13],
        planes[13:16] >> QUATERNION_SHIFT,
        color_differences.astype(np.uint8),
        planes[19:20],
    ]
    return np.concatenate(compact).tobytes()


def _center_steps(planes: NDArray[np.uint8], lens: Mapping[str, Any]) -> NDArray[np.int64] | None:
    """Return whole numbers [3, N] for centres in planes [9, N]; None if they are out of range."""
    words = planes.astype(np.uint32).reshape(3, 3, -1)
    floats = (words[:, 0] << 8) | (words[:, 1] << 16) | (words[:, 2] << 24)
    x, y, z = floats.view(np.float32).astype(np.float64)
    if (z <= 0).any():
        return None
    steps_per_px = STEPS_PER_LONG_SIDE / max(lens["width"], lens["height"])
    right = x / z * lens["K"][0][0] * steps_per_px
    down = y / z * lens["K"][1][1] * steps_per_px
    into = np.log(z) * DEPTH_STEPS_PER_E
    steps = np.round(np.stack([right, down, into]))
    if (np.abs(steps) >= MAX_STEP).any():
        return None
    return steps.astype(np.int64)
