"""The depth map of a HEIC: found by its boxes, decoded by libheif."""

from __future__ import annotations

import os
import warnings
from typing import Any

import numpy as np

from spackle.bases.photo_depth.apple import Description, describe
from spackle.bases.photo_depth.boxes import MalformedBoxes, find_depth_item
from spackle.bases.photo_depth.coded import Array, BrokenDepth, CodedDepth, Scale, check_pixels
from spackle.bases.photo_depth.jpeg import Bytes
from spackle.errors import reason_in_a_line

FULL_CODES = {"L": 255, "I;10": 1023, "I;12": 4095}
ASSUMED = Scale("disparity", 0.1, 1.0)  # 10 m to 1 m: a portrait's usual range, where a file says none


def find_in_heif(data: Bytes, path: str | os.PathLike[str]) -> CodedDepth | None:
    """The auxiliary depth image of the primary picture, in any of the representations of HEVC's depth information."""
    try:
        item = find_depth_item(data)
    except MalformedBoxes:  # whoever decodes the photo will say what is wrong
        return None
    if item is None:
        return None
    codes, full, stated = _decode(path)
    described = describe(item.xmp)
    scale, source = _meaning(described, stated)
    lens = None if described is None else described.lens
    return CodedDepth(codes, full, scale, source, lens, item.own_turn, item.turn)


def _decode(path: str | os.PathLike[str]) -> tuple[Array, int, dict[str, Any]]:
    """Codes [H, W] with the item's own rotation applied, the highest code, and HEVC's depth information."""
    import pillow_heif

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            images = pillow_heif.open_heif(os.fspath(path), hdr_to_16bit=False).info["depth_images"]
            if not images:
                raise BrokenDepth("is announced, but missing")
            check_pixels(*images[0].size)
            codes = np.array(images[0])
            return codes, FULL_CODES[images[0].mode], images[0].info.get("metadata") or {}
    except BrokenDepth:
        raise
    except Exception as error:  # a decoder at work on a stranger's bytes raises anything
        raise BrokenDepth(f"cannot be decoded ({reason_in_a_line(error)})") from error


def _meaning(described: Description | None, stated: dict[str, Any]) -> tuple[Scale, str]:
    """Apple's words where they give a range, else HEVC's, else a portrait's usual range."""
    if described is not None and described.scale is not None:
        return described.scale, described.source
    kind = stated.get("representation_type")
    first, last = (stated.get(name) for name in (("d_min", "d_max") if kind == 1 else ("z_near", "z_far")))
    if kind == 3:
        raise BrokenDepth("is a disparity with steps of uneven size, which is not read")
    if first is None or last is None:
        return ASSUMED, "HEIF depth of unknown range, assumed to be 1 to 10 m"
    if kind == 1:
        return Scale("disparity", first, last), "HEIF disparity"
    if not 0 < first < last:
        raise BrokenDepth(f"announces near {first:g} and far {last:g}, between which nothing can lie")
    if kind == 2:
        return Scale("depth", first, last), "HEIF depth"
    return Scale("disparity", 1 / last, 1 / first), "HEIF inverse depth"
