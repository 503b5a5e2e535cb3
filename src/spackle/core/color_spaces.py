"""From the numbers of a photo's file to sRGB: range, transfer function, primaries, tone mapping.

`to_srgb` is the one function for all files that state their colours. A `ColorSpace` says what the
numbers mean: which light a number stands for (transfer function), and which red, green and blue are
mixed (primaries). `color_space_of_cicp` makes one of the numbers of ITU-T H.273 ("CICP"), which
HEIF, AVIF, PNG and videos use.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import ONE, ZERO, kernel

Floats = NDArray[np.float64]
Codes = NDArray[Any]  # uint8 or uint16

REFERENCE_WHITE_NITS = 203.0  # of HDR, ITU-R BT.2408: this light becomes the white of sRGB
PQ_PEAK_NITS = 10_000.0  # the light of the highest code of PQ
# HLG has no absolute light. BT.2100 shows it at this peak with this system gamma, for which BT.2408
# states its reference levels.
HLG_PEAK_NITS = 1000.0
HLG_SYSTEM_GAMMA = 1.2
# The brightest 0.01 % of the pixels are sparks and noise, and do not decide how all others look.
PEAK_QUANTILE = 0.9999
MAX_PEAK_SAMPLES = 1_000_000  # pixels that are looked at to find the peak
SAME_MATRIX = 2e-3  # primaries that differ by less are rounded differently


class Chromaticities(NamedTuple):
    """The x and y of CIE 1931 of a colour space's red, green, blue and white."""

    red: tuple[float, float]
    green: tuple[float, float]
    blue: tuple[float, float]
    white: tuple[float, float]


D65 = (0.3127, 0.3290)
D50_XYZ = np.array([0.9642, 1.0, 0.8249])  # the white of ICC's connection space
SRGB_PRIMARIES = Chromaticities((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65)
ADOBE_RGB_PRIMARIES = Chromaticities((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), D65)
DISPLAY_P3_PRIMARIES = Chromaticities((0.68, 0.32), (0.265, 0.69), (0.15, 0.06), D65)
BT2020_PRIMARIES = Chromaticities((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65)
PROPHOTO_PRIMARIES = Chromaticities(
    (0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001), (0.3457, 0.3585)
)
_BT601_625 = Chromaticities((0.64, 0.33), (0.29, 0.60), (0.15, 0.06), D65)
_BT601_525 = Chromaticities((0.630, 0.340), (0.310, 0.595), (0.155, 0.070), D65)
_ILLUMINANT_C = (0.310, 0.316)
_PRIMARIES_OF_CICP = {
    1: SRGB_PRIMARIES,  # those of BT.709
    4: Chromaticities((0.67, 0.33), (0.21, 0.71), (0.14, 0.08), _ILLUMINANT_C),
    5: _BT601_625,
    6: _BT601_525,
    7: _BT601_525,
    8: Chromaticities((0.681, 0.319), (0.243, 0.692), (0.145, 0.049), _ILLUMINANT_C),
    9: BT2020_PRIMARIES,
    10: Chromaticities((1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (1 / 3, 1 / 3)),
    11: DISPLAY_P3_PRIMARIES._replace(white=(0.314, 0.351)),
    12: DISPLAY_P3_PRIMARIES,
    22: Chromaticities((0.630, 0.340), (0.295, 0.605), (0.155, 0.077), D65),
}
# The cones' responses to X, Y, Z, in which Bradford's method adapts one white to another.
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


@dataclasses.dataclass(frozen=True)
class Transfer:
    """From a file's numbers in 0..1 to light."""

    name: str
    # Light for numbers [n]: [n], or [3, n] if the channels differ. White is 1; for PQ, 1 is 203
    # nits (candela per square metre), and for HLG it is the scene's brightest light.
    decode: Callable[[Floats], Floats]
    is_pq: bool = False
    is_hlg: bool = False

    @property
    def is_hdr(self) -> bool:
        """Whether there is light brighter than white, which has to be mapped."""
        return self.is_pq or self.is_hlg


def _decode_srgb(code: Floats) -> Floats:
    """Light of sRGB (IEC 61966-2-1)."""
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def _decode_bt709(code: Floats) -> Floats:
    """Light of BT.709, BT.601 and BT.2020: the inverse of their function for cameras."""
    alpha = 1.09929682680944
    beta = 0.018053968510807
    return np.where(code < 4.5 * beta, code / 4.5, ((code + alpha - 1) / alpha) ** (1 / 0.45))


def _decode_smpte_240m(code: Floats) -> Floats:
    """Light of SMPTE ST 240."""
    return np.where(code < 4 * 0.0228, code / 4, ((code + 0.1115) / 1.1115) ** (1 / 0.45))


def _decode_logarithmic(decades: float) -> Callable[[Floats], Floats]:
    """The function for light that is stored as its logarithm over this many decades."""
    return lambda code: np.where(code <= 0, 0.0, 10 ** ((code - 1) * decades))


def _decode_st428(code: Floats) -> Floats:
    """Light of SMPTE ST 428 (digital cinema); its white is 48 of 52.37 units."""
    return 52.37 / 48 * code**2.6


# Constants of SMPTE ST 2084 (PQ).
_PQ_M1 = 2610 / 16384
_PQ_M2 = 2523 / 4096 * 128
_PQ_C1 = 3424 / 4096
_PQ_C2 = 2413 / 4096 * 32
_PQ_C3 = 2392 / 4096 * 32


def pq_to_nits(code: Floats) -> Floats:
    """Light in nits (cd/m²) of numbers of PQ (SMPTE ST 2084) in 0..1."""
    root = np.asarray(code, np.float64) ** (1 / _PQ_M2)
    return PQ_PEAK_NITS * (np.maximum(root - _PQ_C1, 0) / (_PQ_C2 - _PQ_C3 * root)) ** (1 / _PQ_M1)


def nits_to_pq(nits: Floats) -> Floats:
    """Numbers of PQ (SMPTE ST 2084) in 0..1 of light in nits (cd/m²)."""
    power = (np.maximum(np.asarray(nits, np.float64), 0) / PQ_PEAK_NITS) ** _PQ_M1
    return ((_PQ_C1 + _PQ_C2 * power) / (1 + _PQ_C3 * power)) ** _PQ_M2


# Constants of HLG (ITU-R BT.2100).
_HLG_A = 0.17883277
_HLG_B = 1 - 4 * _HLG_A
_HLG_C = 0.5 - _HLG_A * np.log(4 * _HLG_A)


def hlg_to_scene(code: Floats) -> Floats:
    """Light of the scene in 0..1 of numbers of HLG (ITU-R BT.2100) in 0..1."""
    code = np.asarray(code, np.float64)
    return np.where(code <= 0.5, code**2 / 3, (np.exp((code - _HLG_C) / _HLG_A) + _HLG_B) / 12)


def power_transfer(gamma: float) -> Transfer:
    """The transfer function light = number ** gamma."""
    return Transfer(f"gamma {gamma:.4g}", lambda code: code**gamma)


SRGB_TRANSFER = Transfer("sRGB", _decode_srgb)
BT709_TRANSFER = Transfer("BT.709", _decode_bt709)
LINEAR_TRANSFER = Transfer("linear", lambda code: code)
PQ_TRANSFER = Transfer("PQ", lambda code: pq_to_nits(code) / REFERENCE_WHITE_NITS, is_pq=True)
HLG_TRANSFER = Transfer("HLG", hlg_to_scene, is_hlg=True)
_TRANSFER_OF_CICP = {
    1: BT709_TRANSFER,
    4: power_transfer(2.2),
    5: power_transfer(2.8),
    6: BT709_TRANSFER,
    7: Transfer("SMPTE 240M", _decode_smpte_240m),
    8: LINEAR_TRANSFER,
    9: Transfer("logarithmic", _decode_logarithmic(2.0)),
    10: Transfer("logarithmic", _decode_logarithmic(2.5)),
    11: BT709_TRANSFER,  # extended to negative light, which sRGB has not
    12: BT709_TRANSFER,
    13: SRGB_TRANSFER,
    14: BT709_TRANSFER,
    15: BT709_TRANSFER,
    16: PQ_TRANSFER,
    17: Transfer("SMPTE ST 428", _decode_st428),
    18: HLG_TRANSFER,
}


@dataclasses.dataclass(frozen=True, eq=False)
class ColorSpace:
    """What the numbers of a picture mean."""

    name: str  # for messages
    transfer: Transfer
    to_xyz: Floats  # [3, 3]: linear RGB to X, Y, Z relative to D50, ICC's connection space
    luminance: Floats  # [3]: what linear red, green and blue contribute to the luminance
    is_full_range: bool = True  # otherwise black is 16 and white 235 of 255, as in videos

    @staticmethod
    def of(
        primaries: Chromaticities, transfer: Transfer, name: str, *, is_full_range: bool = True
    ) -> ColorSpace:
        """The colour space with these primaries; ValueError if they span no colours."""
        rgb_to_xyz = _rgb_to_xyz(primaries)
        return ColorSpace(
            name=name,
            transfer=transfer,
            to_xyz=_adapted_to_d50(rgb_to_xyz.sum(axis=1)) @ rgb_to_xyz,
            luminance=rgb_to_xyz[1],
            is_full_range=is_full_range,
        )

    @property
    def to_srgb_primaries(self) -> Floats:
        """[3, 3]: linear RGB of this space to linear RGB of sRGB."""
        matrix: Floats = np.linalg.inv(SRGB.to_xyz) @ self.to_xyz
        return matrix

    @property
    def is_srgb(self) -> bool:
        """Whether the numbers are sRGB already."""
        has_srgb_primaries = np.abs(self.to_srgb_primaries - np.eye(3)).max() < SAME_MATRIX
        return self.is_full_range and self.transfer is SRGB_TRANSFER and bool(has_srgb_primaries)


def _xyz_of(xy: tuple[float, float]) -> Floats:
    """[3]: X, Y, Z of luminance 1; ValueError for a chromaticity that has none."""
    x, y = xy
    if not y > 0:
        raise ValueError(f"a colour at x={x:g}, y={y:g} has no luminance")
    return np.array([x / y, 1.0, (1 - x - y) / y])


def _rgb_to_xyz(primaries: Chromaticities) -> Floats:
    """[3, 3]: linear RGB to X, Y, Z; white has luminance 1. ValueError if they span no colours."""
    # A column of X, Y, Z for each primary. They are not divided by y, which may be 0 for a primary
    # that is imaginary light.
    columns = [
        np.array([x, y, 1 - x - y]) for x, y in (primaries.red, primaries.green, primaries.blue)
    ]
    unscaled = np.stack(columns, axis=1)
    # The determinant is twice the area of the triangle of the three primaries. So small a triangle
    # is a line: its numbers are broken, and the inverse of the matrix would be huge.
    if not abs(np.linalg.det(unscaled)) > 1e-4:
        raise ValueError("the primaries lie in a line")

    # How much of each primary makes white.
    scales = np.linalg.solve(unscaled, _xyz_of(primaries.white))
    if not (scales > 0).all():
        raise ValueError("white lies outside of the primaries")
    matrix: Floats = unscaled * scales
    return matrix


def _adapted_to_d50(white_xyz: Floats) -> Floats:
    """[3, 3]: X, Y, Z under a white to those under D50, by Bradford's method."""
    gains = (_BRADFORD @ D50_XYZ) / (_BRADFORD @ white_xyz)
    matrix: Floats = np.linalg.inv(_BRADFORD) @ np.diag(gains) @ _BRADFORD
    return matrix


SRGB = ColorSpace.of(SRGB_PRIMARIES, SRGB_TRANSFER, "sRGB")
# 563/256, which is what Adobe's specification states; "2.2" is this number rounded.
ADOBE_RGB_GAMMA = 563 / 256
ADOBE_RGB = ColorSpace.of(ADOBE_RGB_PRIMARIES, power_transfer(ADOBE_RGB_GAMMA), "Adobe RGB")
PROPHOTO_RGB = ColorSpace.of(PROPHOTO_PRIMARIES, power_transfer(1.8), "ProPhoto RGB")

# How the numbers of CICP are called in messages.
_NAMES_OF_CICP_PRIMARIES = {1: "BT.709", 9: "BT.2020", 11: "DCI-P3", 12: "Display P3"}


def color_space_of_cicp(primaries: int, transfer: int, *, is_full_range: bool = True) -> ColorSpace:
    """The colour space of the numbers of ITU-T H.273, as HEIF, AVIF, PNG and videos state them.

    Numbers that are unspecified (2) or reserved mean those of sRGB.
    """
    transfer_function = _TRANSFER_OF_CICP.get(transfer, SRGB_TRANSFER)
    name = _NAMES_OF_CICP_PRIMARIES.get(primaries, f"primaries {primaries}")
    return ColorSpace.of(
        _PRIMARIES_OF_CICP.get(primaries, SRGB_PRIMARIES),
        transfer_function,
        f"{transfer_function.name}, {name}",
        is_full_range=is_full_range,
    )


# --- Conversion


def to_srgb(codes: Codes, max_code: int, space: ColorSpace, peak: float | None = None) -> Tensor:
    """Convert whole numbers [H, W, 3] of a colour space to [H, W, 3] float32 sRGB in 0..1.

    Colours outside of sRGB are clipped. Of HDR (PQ and HLG), the reference white of 203 nits
    becomes white, and what is brighter is compressed by the curve of ITU-R BT.2390, up to `peak`.

    Args:
        codes: uint8 or uint16 in 0..max_code.
        max_code: the number that stands for 1, such as 255 or 1023.
        space: what the numbers mean.
        peak: of HDR, the light that is the brightest white, in units of the reference white; None:
            the picture's own brightest light.
    """
    if space.is_srgb:
        return torch.from_numpy(codes.astype(np.float32)).div_(max_code)

    # Tables and matrices, so that a pixel needs no power or logarithm.
    light_of_code = _light_of_codes(max_code, space)  # [3, max_code + 1]
    luminance = space.luminance.astype(np.float32)
    matrix = space.to_srgb_primaries.astype(np.float32)
    if not space.transfer.is_hdr:
        peak = 1.0  # nothing is brighter than white
    elif peak is None:
        peak = _peak_of(codes, light_of_code, space)
    gains = tone_gains(peak).astype(np.float32)
    result = np.empty((*codes.shape[:2], 3), np.float32)

    def convert_rows(start: int, stop: int) -> None:
        """Convert the rows start..stop−1."""
        _convert(
            codes[start:stop],
            light_of_code,
            space.transfer.is_hlg,
            luminance,
            np.float32(peak),
            gains,
            matrix,
            _SRGB_OF_ROOT,
            result[start:stop],
        )

    parallel_for_chunks(convert_rows, len(codes))
    return torch.from_numpy(result)


def _light_of_codes(max_code: int, space: ColorSpace) -> NDArray[np.float32]:
    """[3, max_code + 1]: the light that each code of each channel stands for."""
    numbers = np.arange(max_code + 1) / max_code
    if not space.is_full_range:
        # In 8 bits, black is 16 and white is 235, 219 steps above. Longer codes are multiples.
        steps = numbers * max_code / ((max_code + 1) / 256)
        numbers = np.clip((steps - 16) / 219, 0, 1)
    light = space.transfer.decode(numbers)
    # What a file says may be nonsense; light is finite and not negative.
    light = np.maximum(np.nan_to_num(light, nan=0.0, posinf=0.0, neginf=0.0), 0)
    return np.ascontiguousarray(np.broadcast_to(light, (3, max_code + 1)), np.float32)


def _peak_of(codes: Codes, light_of_code: NDArray[np.float32], space: ColorSpace) -> float:
    """The brightest light of a picture [H, W, 3] in units of the reference white, at least 1.

    The peak of the picture itself, not that of the format, because most HDR photos use a small part
    of the format's range, and would be darkened for light that they do not have.
    """
    height, width = codes.shape[:2]
    step = max(1, int(np.sqrt(height * width / MAX_PEAK_SAMPLES)))
    sample = codes[::step, ::step]
    light = np.stack([light_of_code[c][sample[..., c]] for c in range(3)], axis=-1)
    if space.transfer.is_hlg:
        light *= hlg_display_gain(light @ space.luminance)[..., None]
    return max(1.0, float(np.quantile(light.max(axis=-1), PEAK_QUANTILE)))


def hlg_display_gain(luminance: Floats) -> Floats:
    """What a display multiplies HLG's light of the scene by (BT.2100's OOTF), for its luminance.

    The product is light in units of the reference white.
    """
    gain: Floats = np.maximum(luminance, 0) ** (HLG_SYSTEM_GAMMA - 1) * _HLG_PEAK
    return gain


_HLG_PEAK = HLG_PEAK_NITS / REFERENCE_WHITE_NITS

# Tables whose nodes lie evenly in the root of light, because dark light needs finer steps. Between
# the nodes the kernel interpolates; the error is below a hundred thousandth.
_ROOTS = np.linspace(0, 1, 4097)


def _encode_srgb(linear: Floats) -> Floats:
    """Numbers of sRGB (IEC 61966-2-1) of linear light in 0..1."""
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


_SRGB_OF_ROOT = _encode_srgb(_ROOTS**2).astype(np.float32)


def tone_gains(peak: float) -> Floats:
    """What to multiply light by, so that `peak` becomes 1: the curve of ITU-R BT.2390 (EETF).

    Light is in units of the reference white. The table's nodes lie evenly in the root of light over
    `peak`.
    """
    if peak <= 1:
        return np.ones_like(_ROOTS)
    # BT.2390 works with numbers of PQ, whose steps are equally visible: light becomes a number, the
    # number is mapped, and becomes light again.
    light = _ROOTS**2 * peak
    peak_code = float(nits_to_pq(np.array(peak * REFERENCE_WHITE_NITS)))
    codes = nits_to_pq(light * REFERENCE_WHITE_NITS)
    mapped_codes = _bt2390(codes / peak_code, peak_code) * peak_code
    mapped = pq_to_nits(mapped_codes) / REFERENCE_WHITE_NITS
    # Black stays black, whatever it is multiplied by.
    return np.divide(mapped, light, out=np.ones_like(light), where=light > 0)


def _bt2390(code: Floats, peak_code: float) -> Floats:
    """Map numbers of PQ, as shares of the peak's, so that the peak becomes the reference white.

    Up to a knee nothing changes; above it, a Hermite spline leads to the target.

    Args:
        code: [n] in 0..1, numbers of PQ over that of the picture's peak.
        peak_code: the number of PQ of the picture's peak.
    """
    target = float(nits_to_pq(np.array(REFERENCE_WHITE_NITS))) / peak_code
    knee = 1.5 * target - 0.5  # where BT.2390 puts it
    t = np.clip((code - knee) / (1 - knee), 0, 1)
    spline = (
        (2 * t**3 - 3 * t**2 + 1) * knee
        + (t**3 - 2 * t**2 + t) * (1 - knee)
        + (-2 * t**3 + 3 * t**2) * target
    )
    return np.where(code < knee, code, spline)


@kernel
def _at_root(table: Any, value: Any) -> Any:
    """The value of a table whose nodes lie evenly in the root of 0..1."""
    last = len(table) - 1
    position = np.sqrt(value) * np.float32(last)
    index = min(int(position), last - 1)
    share = position - np.float32(index)
    return table[index] + share * (table[index + 1] - table[index])


@kernel
def _convert(
    codes: Any,
    light_of_code: Any,
    is_hlg: bool,
    luminance: Any,
    peak: Any,
    gains: Any,
    matrix: Any,
    srgb_of_root: Any,
    result: Any,
) -> None:
    """Write the sRGB of codes [H, W, 3] to `result`; the other arguments are those of `to_srgb`.

    Args:
        codes: [H, W, 3] of the file's colour space.
        light_of_code: [3, n] linear light of each code of each channel.
        is_hlg: whether the light is that of HLG's scene.
        luminance: [3] what red, green and blue contribute to the luminance.
        peak: the light that becomes white; 1 without tone mapping.
        gains: what light is multiplied by; its nodes lie evenly in the root of light / peak.
        matrix: [3, 3] to the primaries of sRGB.
        srgb_of_root: sRGB; its nodes lie evenly in the root of light.
        result: [H, W, 3] float32 in 0..1.
    """
    for row in range(codes.shape[0]):
        for column in range(codes.shape[1]):
            red = light_of_code[0, codes[row, column, 0]]
            green = light_of_code[1, codes[row, column, 1]]
            blue = light_of_code[2, codes[row, column, 2]]
            if is_hlg:
                # HLG has the light of the scene. That of a display is a power of its luminance (the
                # system gamma), with the same ratios between red, green and blue.
                scene = luminance[0] * red + luminance[1] * green + luminance[2] * blue
                display = scene ** np.float32(HLG_SYSTEM_GAMMA - 1) * np.float32(_HLG_PEAK)
                red *= display
                green *= display
                blue *= display
            if peak > ONE:
                # The brightest channel decides for all three, so that hues stay.
                brightest = max(red, green, blue)
                # Beyond the peak everything is white.
                share = brightest / peak
                gain = _at_root(gains, min(share, ONE)) / max(share, ONE)
                red *= gain
                green *= gain
                blue *= gain
            srgb_red = matrix[0, 0] * red + matrix[0, 1] * green + matrix[0, 2] * blue
            srgb_green = matrix[1, 0] * red + matrix[1, 1] * green + matrix[1, 2] * blue
            srgb_blue = matrix[2, 0] * red + matrix[2, 1] * green + matrix[2, 2] * blue
            scale = ONE
            if peak > ONE:
                # In narrower primaries a channel may be brighter again. Clipped alone, it would
                # turn the orange of a sunset into yellow.
                scale = ONE / max(srgb_red, srgb_green, srgb_blue, ONE)
            result[row, column, 0] = _at_root(srgb_of_root, min(max(srgb_red * scale, ZERO), ONE))
            result[row, column, 1] = _at_root(srgb_of_root, min(max(srgb_green * scale, ZERO), ONE))
            result[row, column, 2] = _at_root(srgb_of_root, min(max(srgb_blue * scale, ZERO), ONE))
