"""Logarithm, power of two and sRGB for kernels: short polynomials that run in vector registers.

A library's functions have branches and calls, which keep a loop out of vector registers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

from spackle.runtime.kernels import MANTISSA_BITS, ONE, ZERO, inlined_kernel, kernel


def power_series(
    function: Callable[[Any], Any], low: float, high: float, degree: int
) -> list[np.float32]:
    """Coefficients of a polynomial that approximates a function on low..high, lowest power first.

    It interpolates at Chebyshev's nodes, so that its largest error is nearly the least possible.
    """
    fit = Chebyshev.interpolate(function, degree, [low, high])
    return [np.float32(coefficient) for coefficient in fit.convert(kind=Polynomial).coef]


# 2^x on -½..½; error 1e-7.
E0, E1, E2, E3, E4, E5 = power_series(np.exp2, -0.5, 0.5, 5)
MIN_EXPONENT = np.float32(-60.0)  # least x that callers pass to `exp2`; its power is invisible
# This plus a small float has the rounded float as an integer in its low bits.
ROUNDING_SHIFT = np.float32(1.5 * 2.0**23)
ROUNDING_SHIFT_BITS = np.int32(0x4B400000)

SRGB_KNEE = np.float32(0.0031308)  # linear value at which sRGB changes from a line to a power
SRGB_LINE = np.float32(12.92)  # the line's slope
# sRGB's power as a polynomial in t, with the fourth root of the linear value =
# ROOT_MIDDLE + ROOT_SPREAD·t; error 2e-7.
_root = float(SRGB_KNEE) ** 0.25
ROOT_MIDDLE, ROOT_SPREAD = np.float32((1 + _root) / 2), np.float32((1 - _root) / 2)
S0, S1, S2, S3, S4, S5, S6, S7, S8 = power_series(
    lambda t: 1.055 * ((1 + _root) / 2 + (1 - _root) / 2 * t) ** (5 / 3) - 0.055, -1.0, 1.0, 8
)

# The inverse power is y²·q^1.6, with q the fourth root of y; relative error of a few 1e-8.
ENCODED_KNEE = np.float32(0.04045)  # the sRGB value of SRGB_KNEE
_low_root = ((float(ENCODED_KNEE) + 0.055) / 1.055) ** 0.25
D0, D1, D2, D3, D4, D5 = power_series(lambda q: q**1.6, _low_root, 1.0, 5)

# ln((1 + t) / (1 - t)) = 2t + 2t³/3 + 2t⁵/5 + …; for t² < 0.0295, omitted terms are below float64's
# last digit.
L3, L5, L7, L9, L11, L13, L15, L17, L19 = (2.0 / k for k in range(3, 20, 2))
LN_2 = math.log(2.0)
ROOT_HALF_BITS = np.int32(0x3F3504F3)  # of the square root of a half, as float32


@kernel
def exp2(x: np.float32) -> np.float32:
    """2^x for x in -60..60, with a relative error below 5e-7."""
    # x = n + f with an integer n and f in -½..½. Adding 1.5·2²³ pushes all digits after the point
    # out of a float32, so that n is left, in the low bits.
    shifted = x + ROUNDING_SHIFT
    f = x - (shifted - ROUNDING_SHIFT)
    # 2^f, by a polynomial with the coefficients E0 to E5.
    series = E0 + f * (E1 + f * (E2 + f * (E3 + f * (E4 + f * E5))))

    # 2^n · 2^f: n is added to the exponent bits of the float 2^f.
    exponent = (np.float32(shifted).view(np.int32) - ROUNDING_SHIFT_BITS) << MANTISSA_BITS
    return np.int32(np.float32(series).view(np.int32) + exponent).view(np.float32)


@inlined_kernel
def natural_log(x: np.float32) -> float:
    """The logarithm of a positive float32, accurate to the last digits of float64."""
    # x = 2^exponent · m with m from sqrt(1/2) to sqrt(2): split the float's bits, which are the
    # exponent followed by the mantissa. The bits of sqrt(1/2) are subtracted first, so that the
    # exponent steps up at sqrt(1/2), sqrt(2), … and not at powers of 2.
    bits = np.float32(x).view(np.int32)
    exponent = (bits - ROOT_HALF_BITS) >> MANTISSA_BITS
    m = np.float64(np.int32(bits - (exponent << MANTISSA_BITS)).view(np.float32))

    # m = (1 + t) / (1 - t), so that ln m = 2t + 2t³/3 + 2t⁵/5 + …, with Ln = 2/n.
    t = (m - 1.0) / (m + 1.0)
    s = t * t
    series = L3 + s * (
        L5 + s * (L7 + s * (L9 + s * (L11 + s * (L13 + s * (L15 + s * (L17 + s * L19))))))
    )
    return np.float64(exponent) * LN_2 + (2.0 * t + t * s * series)


@kernel
def encode_srgb(linear: np.float32) -> np.float32:
    """Convert linear light to sRGB, both clamped to 0..1; error 1e-6."""
    value = min(max(linear, ZERO), ONE)

    # As a function of the fourth root of the linear value, sRGB's power curve is nearly straight.
    # So t is this root, moved to -1..1, and the curve is S0 + S1·t + … + S8·t⁸.
    t = (math.sqrt(math.sqrt(value)) - ROOT_MIDDLE) / ROOT_SPREAD
    curve = S0 + t * (S1 + t * (S2 + t * (S3 + t * (S4 + t * (S5 + t * (S6 + t * (S7 + t * S8)))))))
    return SRGB_LINE * value if value <= SRGB_KNEE else min(curve, ONE)


@kernel
def decode_srgb(encoded: np.float32) -> np.float32:
    """Convert sRGB to linear light, both clamped to 0..1; relative error 2e-6."""
    value = min(max(encoded, ZERO), ONE)

    # sRGB's formula is y^2.4. With q = y^¼ this is y²·q^1.6, and q^1.6 is so nearly straight that a
    # polynomial with the coefficients D0 to D5 approximates it well.
    y = (value + np.float32(0.055)) / np.float32(1.055)
    q = math.sqrt(math.sqrt(y))
    curve = y * y * (D0 + q * (D1 + q * (D2 + q * (D3 + q * (D4 + q * D5)))))
    return value / SRGB_LINE if value <= ENCODED_KNEE else min(curve, ONE)


@kernel
def srgb_slope(linear: np.float32, encoded: np.float32) -> np.float32:
    """The derivative of `encode_srgb` at `linear`, given `encoded = encode_srgb(linear)`.

    It is 0 outside of 0..1, where `encode_srgb` clamps.
    """
    if linear <= SRGB_KNEE:
        slope = SRGB_LINE
    else:
        # sRGB = 1.055·linear^(1/2.4) - 0.055, so its derivative is (sRGB + 0.055) / (2.4·linear).
        slope = (encoded + np.float32(0.055)) / (np.float32(2.4) * linear)
    return slope if ZERO <= linear <= ONE else ZERO
