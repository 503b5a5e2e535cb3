"""Stored numbers become metres: depth in any unit, and relative depth of any scale."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from spackle.depth.depth_map import (
    NEAR_AND_FAR_QUANTILES,
    Array,
    DepthMap,
    Quantity,
    StrPath,
    build_depth_map,
    check_not_negative,
    quantisation_step,
)
from spackle.runtime.declared_options import DepthKind as DepthKind
from spackle.runtime.errors import InputError, short_repr

# What the numbers of a file mean. "near-white" is inverse depth and "near-black" is depth, both up
# to scale and shift; "auto" decides between metric depth and disparity.
DEPTH_KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
RELATIVE_KINDS: tuple[DepthKind, ...] = ("near-white", "near-black")

RELATIVE_NEAR_M = 1.5  # where the nearest surface of a relative map is placed
RELATIVE_FAR_M = 15.0  # where its farthest surface is placed
MAX_FAR_M = 1e9  # its square still fits float32
MAX_STRETCH = 4.0  # depths beyond near and far are limited to this factor nearer or farther
NEAREST_QUANTILE = 0.999  # of inverse depth, as for camera paths; nearer pixels are specks

METRES_PER_UNIT = {"km": 1000.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
NAMES_OF_UNITS = {"km": "kilometres", "m": "metres", "cm": "centimetres", "mm": "millimetres"}
INVERSE_METRES = "1/m"
MAX_UNIT_M = 1e9  # a unit, or its inverse, beyond this is a typing error

UNKNOWN_UINT16 = 65535  # the highest number of 16 bits means unknown in a picture, as 0 does
IMPLAUSIBLE_MEDIAN_M = 1000  # half of a photo is hardly farther away than a kilometre
FULL_RANGE_SHARE = 0.05  # relative maps come this close (as a share) to both ends of their range
# The least and the greatest number that a map of floats has if it was scaled to 0..1 or 0..255.
NORMALISED_ENDS = ((0.9, 1.001), (254.0, 255.001))
UNIT_ADVICE = "`depth_unit` (such as m, mm or 1/256)"
KIND_ADVICE = (
    "give `depth_kind` near-white (as MiDaS, Depth Anything and ComfyUI write it) or near-black, "
    f"or {UNIT_ADVICE}"
)


class UnclearDepth(InputError):
    """The numbers of a map do not look like metres, and nobody said what they are."""

    problem: str  # the message without what to do
    may_be_metres: bool  # whether they could be metres, of a very distant view

    @classmethod
    def of(cls, problem: str, *, may_be_metres: bool = False) -> UnclearDepth:
        """The error with its usual advice. `problem` names the file, and what is wrong."""
        error = cls(f"{problem}: {KIND_ADVICE}")
        error.problem = problem
        error.may_be_metres = may_be_metres
        return error


@dataclasses.dataclass(frozen=True)
class DepthUnit:
    """What one step of a map's numbers means."""

    factor: float  # metres; for inverse depth 1/m
    is_inverse: bool = False  # whether the numbers are inverse depths
    name: str = "metres"  # for messages


def parse_depth_unit(unit: str | float) -> DepthUnit:
    """The unit that a text or a number of metres names.

    A text is m, cm, mm or km; a number or fraction of metres, such as 0.001 or 1/256; both
    together, such as "0.1 mm"; or 1/m for inverse depth. InputError for other texts.
    """
    # Nine digits tell any two numbers of float32 apart, and 0.001 stays "0.001".
    text = f"{unit:.9g}" if isinstance(unit, int | float) else unit.strip()
    if text == INVERSE_METRES:
        return DepthUnit(1.0, is_inverse=True, name="inverse metres")

    # An optional number or fraction, and an optional name. One of them must be there. A number has
    # digits before or after its point, and may have an exponent, as 1e-3.
    number = r"\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?"
    match = re.fullmatch(rf"(?:({number})(?:/({number}))?)?\s*(km|m|cm|mm)?", text)
    factor = 0.0
    if match is not None and text:
        numerator, denominator, name = match.groups()
        divisor = float(denominator or 1)
        if divisor > 0:
            factor = float(numerator or 1) / divisor * METRES_PER_UNIT[name or "m"]
    if not 1 / MAX_UNIT_M <= factor <= MAX_UNIT_M:
        raise InputError(
            f"`depth_unit` {short_repr(text)}: give m, cm, mm or km, a number of metres such as "
            "0.001 or 1/256, or 1/m for inverse depth"
        )

    if text in NAMES_OF_UNITS:
        return DepthUnit(factor, name=NAMES_OF_UNITS[text])
    suffix = "" if text[-1] == "m" else " m"
    return DepthUnit(factor, name=f"units of {text}{suffix}")


METRE = parse_depth_unit("m")
MILLIMETRE = parse_depth_unit("mm")


@dataclasses.dataclass(frozen=True)
class StoredDepth:
    """The numbers of a depth map, before it is known what they mean."""

    numbers: Array  # [H, W] integers or floats
    path: Path  # the file, or what the map is called in messages
    # Whether they are a picture's: whole numbers that begin at 0, which also means unknown.
    is_picture: bool = False
    mask: Array | None = None  # [H, W] bool: false where the caller says that the depth is unknown

    @property
    def known(self) -> Array:
        """[H, W] bool: the numbers that are finite and not masked."""
        finite = np.isfinite(self.numbers)
        return finite if self.mask is None else finite & self.mask

    @property
    def are_integers(self) -> bool:
        """Whether the type of the numbers is one of integers, so that they have a common step."""
        # Floats may be whole numbers by chance.
        return self.numbers.dtype.kind in "iu"


def metric_depth(stored: StoredDepth, unit: DepthUnit | None = None) -> DepthMap:
    """The depth map of numbers that are depth, or inverse depth, in a unit.

    0, NaN and inf mean unknown, and in a picture of 16 bits also 65535. Without a `unit`, the
    numbers of a picture are millimetres, and others are metres.

    Raises:
        UnclearDepth: there is no `unit`, and the numbers cannot be in the usual one.
        InputError: numbers are negative, or no pixel is known.
    """
    numbers = stored.numbers
    known = stored.known
    check_not_negative(np.where(known, numbers, 0), stored.path)
    if stored.is_picture and numbers.dtype == np.uint16:
        known = known & (numbers != UNKNOWN_UINT16)
    if unit is None:
        _check_usual_unit(stored)
        unit_or_usual = MILLIMETRE if stored.is_picture else METRE
    else:
        unit_or_usual = unit

    scaled = numbers.astype(np.float64) * unit_or_usual.factor
    with np.errstate(divide="ignore"):  # an inverse depth of 0 is infinitely far, hence unknown
        depth = 1 / scaled if unit_or_usual.is_inverse else scaled
    return build_depth_map(
        numbers,
        depth=depth,
        valid=known,
        quantity="disparity" if unit_or_usual.is_inverse else "depth",
        stored_unit=unit_or_usual.factor if stored.are_integers else None,
        K=None,
        path=stored.path,
        meaning=unit_or_usual.name,
        is_guess=unit is None,
    )


def _check_usual_unit(stored: StoredDepth) -> None:
    """UnclearDepth for integers of an array, and for pictures of 8 bits.

    Only pictures of 16 bits have a usual unit, millimetres.
    """
    if not stored.are_integers:
        return
    # In 8 bits, no depth could be over 255 mm. Such a picture holds relative depth instead, and
    # does not say whether near surfaces are white or black in it.
    if stored.numbers.dtype.itemsize == 1:
        raise UnclearDepth.of(f"{stored.path}: 8 bits hold no metres")
    if stored.is_picture:
        return
    # Nobody measures a scene in whole metres: the numbers are millimetres, or codes of a unit that
    # an array does not state.
    median = np.median(stored.numbers)
    raise UnclearDepth.of(f"{stored.path}: integers around {median:.0f} are hardly metres")


def check_not_relative(stored: StoredDepth) -> None:
    """UnclearDepth if the numbers look like relative depth, and not like metres or millimetres.

    The reasons are a range that is filled from end to end (0 to 1, 255, or 16 bits), and floats
    whose median would be over a kilometre.
    """
    numbers = stored.numbers[stored.known]
    # 0 and UNKNOWN_UINT16, which is 65535, may stand for unknown pixels, and therefore say nothing
    # about the range of a picture's numbers.
    if stored.is_picture and stored.numbers.dtype == np.uint16:
        numbers = numbers[(numbers > 0) & (numbers < UNKNOWN_UINT16)]
        if numbers.size and _fills_range(float(numbers.min()), float(numbers.max())):
            # It looks like millimetres up to 65 m: better ask than be wrong.
            raise UnclearDepth.of(
                f"{stored.path}: its values fill the range of 16 bits, as relative depth does"
            )
        return

    # Integers that are no metres are found by their size.
    numbers = numbers[numbers > 0]
    if not numbers.size or stored.are_integers:
        return
    low, _ = np.quantile(numbers, NEAR_AND_FAR_QUANTILES)
    high = float(numbers.max())
    for least_end, greatest_end in NORMALISED_ENDS:
        if least_end <= high <= greatest_end and low < FULL_RANGE_SHARE * high:
            raise UnclearDepth.of(
                f"{stored.path}: its values fill the range from 0 to {greatest_end:.0f}, as "
                "relative depth does"
            )

    # A renderer's background has one huge number everywhere, and says nothing about the unit.
    surfaces = numbers[numbers < high]
    median = float(np.median(surfaces if surfaces.size else numbers))
    if median > IMPLAUSIBLE_MEDIAN_M:
        raise UnclearDepth.of(
            f"{stored.path}: values around {median:.6g} are hardly metres", may_be_metres=True
        )


def _fills_range(low: float, high: float) -> bool:
    """Whether numbers reach from nearly 0 to nearly 65535."""
    starts_low = low < FULL_RANGE_SHARE * UNKNOWN_UINT16
    ends_high = high > (1 - FULL_RANGE_SHARE) * UNKNOWN_UINT16
    return starts_low and ends_high


def relative_depth(
    stored: StoredDepth,
    kind: DepthKind,
    near: float = RELATIVE_NEAR_M,
    far: float = RELATIVE_FAR_M,
    step: float | None = None,
) -> DepthMap:
    """Convert inverse depth (near-white) or depth (near-black) of unknown scale to metres.

    The numbers are scaled linearly, so that their 1 % and 99 % quantiles become `near` and `far`.

    Args:
        stored: NaN, inf and masked numbers mean unknown.
        kind: "near-white" or "near-black".
        near: the nearest depth, in metres.
        far: the farthest depth, in metres.
        step: quantisation step of the numbers; None: found in integers, unknown for floats.

    Raises:
        InputError: nearly all numbers are equal, or not 0 < `near` < `far`.
    """
    if not 0 < near < far < MAX_FAR_M:
        raise InputError(
            f"`near` {near:g}, `far` {far:g}: give two distances in metres, the nearer one first"
        )
    known = stored.known
    with np.errstate(invalid="ignore"):  # some NaN of a damaged file cannot be converted quietly
        values = stored.numbers.astype(np.float64)
    low, high = _low_and_high_quantile(values[known], stored.path)

    # 0 at the low quantile, 1 at the high quantile. Numbers beyond the quantiles are outside of
    # 0..1, and their depths are limited below.
    share = (np.where(known, values, low) - low) / (high - low)
    quantity: Quantity
    if kind == "near-white":
        quantity = "disparity"
        meaning = "inverse depth of unknown scale"
        # Inverse depth is linear in these numbers, from 1/far to 1/near.
        inverse_span = 1 / near - 1 / far  # 1/m
        inverse_depth = 1 / far + share * inverse_span
        depth = 1 / np.clip(inverse_depth, 1 / (MAX_STRETCH * far), MAX_STRETCH / near)
        stored_unit = inverse_span / (high - low)
    else:
        quantity = "depth"
        meaning = "depth of unknown scale"
        # Depth itself is linear in these numbers.
        depth = np.clip(near + share * (far - near), near / MAX_STRETCH, MAX_STRETCH * far)
        stored_unit = (far - near) / (high - low)

    # Integers come from a picture of 8 or 16 bits, whose steps must not become edges.
    if step is None and stored.are_integers:
        step = quantisation_step(values[known])
    quantum = None if step is None else step * stored_unit
    metres = torch.from_numpy(depth.astype(np.float32))
    valid = torch.from_numpy(known)
    return DepthMap(
        depth=metres.where(valid, 0.0),
        valid=valid,
        K=None,
        quantum=quantum,
        quantity=quantity,
        path=stored.path,
        meaning=meaning,
    )


def _low_and_high_quantile(known_values: Array, path: StrPath) -> tuple[float, float]:
    """The 1 % and the 99 % quantile of the known numbers [N] of a map without scale.

    InputError if there is no number, or if both quantiles are equal.
    """
    # Quantiles instead of the extremes, because a few pixels may be noise.
    if known_values.size > 0:
        low, high = np.quantile(known_values, NEAR_AND_FAR_QUANTILES)
        if high > low:
            return low, high
    raise InputError(f"{path}: the depth is the same nearly everywhere: give another depth map")


def near_inverse_depth(inverse_depth: Tensor) -> Tensor:
    """The inverse depth [] of the nearest surface: the 99.9 % quantile of `inverse_depth` [N].

    Few pixels are nearer, and these are often specks; hence a quantile and not the maximum.
    """
    rank = round(NEAREST_QUANTILE * (len(inverse_depth) - 1))  # from 0
    return inverse_depth.kthvalue(1 + rank).values
