"""Stored numbers become metres: depth in metres or millimetres, and relative depth of any scale."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

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
from spackle.runtime.errors import InputError, short_repr

# What the numbers of a file mean. "near-white" is inverse depth and "near-black" is depth, both up
# to scale and shift; "auto" decides between metric depth and disparity.
DepthKind = Literal["auto", "metric", "disparity", "near-white", "near-black"]
DEPTH_KINDS: tuple[DepthKind, ...] = get_args(DepthKind)
RELATIVE_KINDS: tuple[DepthKind, ...] = ("near-white", "near-black")

RELATIVE_NEAR_M = 1.5  # where the nearest surface of a relative map is placed
RELATIVE_FAR_M = 15.0  # where its farthest surface is placed
MAX_FAR_M = 1e9  # its square still fits float32
MAX_STRETCH = 4.0  # depths beyond near and far are limited to this factor nearer or farther
NEAREST_QUANTILE = 0.999  # of inverse depth, as for camera paths; nearer pixels are specks

MILLIMETRE_M = 0.001  # a 16-bit PNG stores millimetres
UNKNOWN_MILLIMETRES = 65535  # the highest number of 16 bits means unknown, as 0 does
IMPLAUSIBLE_MEDIAN_M = 500  # whole numbers around or above this are hardly metres
FULL_RANGE_SHARE = 0.05  # a relative PNG comes this close (as a share) to both ends of 16 bits
KIND_ADVICE = (
    "give `depth_kind` near-white (as MiDaS, Depth Anything and ComfyUI write it), near-black "
    "or metric"
)


def depth_from_array(stored: Array, path: Path, kind: DepthKind = "auto") -> DepthMap:
    """A depth map from an array [H, W] of metres, or of depth without a scale.

    If `kind` is "near-white" or "near-black", the numbers are inverse depth or depth up to an
    unknown scale and shift; else they are metres, in which 0, NaN and inf mean unknown. `path` is
    the name of the array in messages. InputError for an array of another shape or type, or one that
    cannot be depth.
    """
    # A caller's array may be anything: objects, texts, or a picture with channels.
    if stored.ndim != 2 or not stored.size or stored.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: an array of {stored.dtype} {short_repr(stored.shape)}: "
            "give [height, width] in metres"
        )
    if kind in RELATIVE_KINDS:
        return relative_depth(stored, kind, path)
    return metric_depth(stored, path)


def metric_depth(stored: Array, path: StrPath) -> DepthMap:
    """The depth map of an array [H, W] of metres, in which 0, NaN and inf mean unknown.

    InputError, naming `path`, for negative numbers, for integers so large that they must be
    millimetres, and if no pixel is known.
    """
    check_not_negative(stored, path)
    # Only integers have a common step. Floats may be whole metres by chance.
    are_integers = stored.dtype.kind in "iu"
    if are_integers and np.median(stored) > IMPLAUSIBLE_MEDIAN_M:
        raise InputError(
            f"{path}: integers around {np.median(stored):.0f} are hardly metres: "
            "divide them by 1000"
        )
    return build_depth_map(
        stored,
        depth=stored,
        valid=np.isfinite(stored),
        quantity="depth",
        stored_unit=1.0 if are_integers else None,
        K=None,
        path=path,
    )


def millimetre_depth(stored: Array, path: StrPath) -> DepthMap:
    """The depth map of a PNG's numbers [H, W]: millimetres, in which 0 and 65535 mean unknown.

    InputError, naming `path`, if the PNG has 8 bits, or no pixel is known.
    """
    # In 8 bits, no depth could be over 255 mm. Such a PNG holds relative depth instead, and does
    # not say whether near surfaces are white or black in it.
    if stored.dtype == np.uint8:
        raise InputError(
            f"{path}: an 8-bit PNG holds no metres: "
            "give 16 bits, or `depth_kind` near-white or near-black"
        )
    return build_depth_map(
        stored,
        depth=stored * MILLIMETRE_M,
        valid=stored != UNKNOWN_MILLIMETRES,  # 0, which is no depth, becomes unknown anyway
        quantity="depth",
        stored_unit=MILLIMETRE_M,
        K=None,
        path=path,
    )


def fills_16_bits(stored: Array) -> bool:
    """Whether a PNG's numbers reach from nearly 0 to nearly 65535, as relative depth does."""
    # 0 and UNKNOWN_MILLIMETRES, which is 65535, may stand for unknown pixels, and therefore say
    # nothing about the range.
    known = stored[(stored > 0) & (stored < UNKNOWN_MILLIMETRES)]
    if not known.size:
        return False
    starts_low = known.min() < FULL_RANGE_SHARE * UNKNOWN_MILLIMETRES
    ends_high = known.max() > (1 - FULL_RANGE_SHARE) * UNKNOWN_MILLIMETRES
    return bool(starts_low and ends_high)


def relative_depth(
    stored: Array,
    kind: DepthKind,
    path: StrPath,
    near: float = RELATIVE_NEAR_M,
    far: float = RELATIVE_FAR_M,
    step: float | None = None,
) -> DepthMap:
    """Convert inverse depth (near-white) or depth (near-black) of unknown scale to metres.

    The numbers are scaled linearly, so that their 1 % and 99 % quantiles become `near` and `far`.

    Args:
        stored: [H, W]; NaN and inf mean unknown.
        kind: "near-white" or "near-black".
        path: the file, for messages.
        near: the nearest depth, in metres.
        far: the farthest depth, in metres.
        step: quantisation step of `stored`; None: found in integers, unknown for floats.

    Raises:
        InputError: nearly all numbers are equal, or not 0 < `near` < `far`.
    """
    if not 0 < near < far < MAX_FAR_M:
        raise InputError(
            f"`near` {near:g}, `far` {far:g}: give two distances in metres, the nearer one first"
        )
    known = np.isfinite(stored)
    values = stored.astype(np.float64)
    low, high = _low_and_high_quantile(values[known], path)

    # 0 at the low quantile, 1 at the high quantile. Numbers beyond the quantiles are outside of
    # 0..1, and their depths are limited below.
    share = (np.where(known, values, low) - low) / (high - low)
    quantity: Quantity
    if kind == "near-white":
        quantity = "disparity"
        # Inverse depth is linear in these numbers, from 1/far to 1/near.
        inverse_span = 1 / near - 1 / far  # 1/m
        inverse_depth = 1 / far + share * inverse_span
        depth = 1 / np.clip(inverse_depth, 1 / (MAX_STRETCH * far), MAX_STRETCH / near)
        stored_unit = inverse_span / (high - low)
    else:
        quantity = "depth"
        # Depth itself is linear in these numbers.
        depth = np.clip(near + share * (far - near), near / MAX_STRETCH, MAX_STRETCH * far)
        stored_unit = (far - near) / (high - low)

    # Integers come from a picture of 8 or 16 bits, whose steps must not become edges.
    if step is None and stored.dtype.kind in "iu":
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
        path=Path(path),
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
