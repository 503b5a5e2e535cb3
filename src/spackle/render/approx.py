"""The few functions of a pixel or a Gaussian, without branches or calls, so that loops run in vector registers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from spackle._numba import inlined_kernel, kernel
from spackle.render.protocol import ALPHA_MAX, ALPHA_MIN

# Constants of the pixels' functions are float32 throughout: a Python float would widen a whole expression to float64.
ZERO, HALF, ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
LIMIT = np.float32(ALPHA_MAX)
FAINT = np.float32(ALPHA_MIN)
LOWEST = np.float32(-60.0)
ROUND = np.float32(1.5 * 2.0**23)  # adding this rounds a small float to an integer in its low bits
ROUND_BITS = np.int32(0x4B400000)
MANTISSA = np.int32(23)
KNEE = np.float32(0.0031308)  # where sRGB turns from a line into a power
LINE = np.float32(12.92)
ROOT_HALF_BITS = np.int32(0x3F3504F3)  # of the square root of a half
LN_2 = math.log(2.0)


def _power_series(function: Any, low: float, high: float, degree: int) -> list[np.float32]:
    """Coefficients of a near-minimax polynomial on low..high, lowest power first."""
    fit = Chebyshev.interpolate(function, degree, [low, high])
    return [np.float32(c) for c in fit.convert(kind=Polynomial).coef]


# 2^x on -½..½, to 1e-7.
E0, E1, E2, E3, E4, E5 = _power_series(np.exp2, -0.5, 0.5, 5)
# sRGB's power in t, where the fourth root of the linear value is MIDDLE + SPREAD·t, to 2e-7.
_root = float(KNEE) ** 0.25
MIDDLE, SPREAD = np.float32((1 + _root) / 2), np.float32((1 - _root) / 2)
S0, S1, S2, S3, S4, S5, S6, S7, S8 = _power_series(
    lambda t: 1.055 * ((1 + _root) / 2 + (1 - _root) / 2 * t) ** (5 / 3) - 0.055, -1.0, 1.0, 8
)
# Its inverse is y²·q^1.6, where q is the fourth root of y, to a few 1e-8 of itself.
ENCODED_KNEE = np.float32(0.04045)
_low_root = ((float(ENCODED_KNEE) + 0.055) / 1.055) ** 0.25
D0, D1, D2, D3, D4, D5 = _power_series(lambda q: q**1.6, _low_root, 1.0, 5)

# ln((1 + t) / (1 - t)) is 2t + 2t³/3 + 2t⁵/5 + …; what is left out is below float64's last digit for t² < 0.0295.
L3, L5, L7, L9, L11, L13, L15, L17, L19 = (2.0 / k for k in range(3, 20, 2))


@kernel
def exp2(x: np.float32) -> np.float32:
    """2^x for x in -60..60."""
    shifted = x + ROUND
    f = x - (shifted - ROUND)
    series = E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * E5))))
    exponent = (np.float32(shifted).view(np.int32) - ROUND_BITS) << MANTISSA
    return np.int32(np.float32(series).view(np.int32) + exponent).view(np.float32)


@kernel
def alpha_of(power: np.float32) -> np.float32:
    """A Gaussian's alpha where its opacity has fallen to 2^power: clamped, and 0 where too faint."""
    alpha = min(exp2(max(power, LOWEST)), LIMIT)
    return alpha if alpha >= FAINT else ZERO


@kernel
def encode_srgb(linear: np.float32) -> np.float32:
    """Linear light to sRGB, both clamped to 0..1."""
    value = min(max(linear, ZERO), ONE)
    t = (np.sqrt(np.sqrt(value)) - MIDDLE) / SPREAD
    curve = S0 + t * (S1 + t * (S2 + t * (S3 + t * (S4 + t * (S5 + t * (S6 + t * (S7 + t * S8)))))))
    return LINE * value if value <= KNEE else min(curve, ONE)


@kernel
def decode_srgb(encoded: np.float32) -> np.float32:
    """sRGB to linear light, both clamped to 0..1."""
    value = min(max(encoded, ZERO), ONE)
    y = (value + np.float32(0.055)) / np.float32(1.055)
    q = np.sqrt(np.sqrt(y))
    curve = y * y * (D0 + q * (D1 + q * (D2 + q * (D3 + q * (D4 + q * D5)))))
    return value / LINE if value <= ENCODED_KNEE else min(curve, ONE)


@kernel
def srgb_slope(linear: np.float32, encoded: np.float32) -> np.float32:
    """The derivative of `encode_srgb`, whose value is known: 0 where it clamps."""
    slope = LINE if linear <= KNEE else (encoded + np.float32(0.055)) / (np.float32(2.4) * linear)
    return slope if ZERO <= linear <= ONE else ZERO


@inlined_kernel
def natural_log(x: np.float32) -> float:
    """The logarithm of a positive number, to float64's last digits."""
    bits = np.float32(x).view(np.int32)
    exponent = (bits - ROOT_HALF_BITS) >> MANTISSA
    m = np.float64(np.int32(bits - (exponent << MANTISSA)).view(np.float32))  # from sqrt(1/2) to sqrt(2)
    t = (m - 1.0) / (m + 1.0)
    s = t * t
    series = L3 + s * (L5 + s * (L7 + s * (L9 + s * (L11 + s * (L13 + s * (L15 + s * (L17 + s * L19)))))))
    return np.float64(exponent) * LN_2 + (2.0 * t + t * s * series)
