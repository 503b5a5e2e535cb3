"""Whose depth map it is: Apple's in JPEG and HEIC, Android's GDepth and Dynamic Depth in JPEG."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import os
from itertools import accumulate
from typing import Any

import numpy as np

from spackle.bases.depth_map import Quantity
from spackle.bases.photo_depth.coded import (
    Array,
    BrokenDepth,
    CodedDepth,
    Lens,
    Scale,
    check_pixels,
    decoding,
    read_codes,
)
from spackle.bases.photo_depth.containers import (
    Bytes,
    MalformedBoxes,
    Node,
    end_of_picture,
    extended_xmp_of,
    find_depth_item,
    further_pictures,
    parse_xmp,
    to_number,
    xmp_of,
)

PIXELS, DEPTH = "http://ns.apple.com/pixeldatainfo/1.0/ ", "http://ns.apple.com/depthData/1.0/ "

# Core Video's formats of depth maps, half and full floats; any other is a matte, a gain map or a mask.
_FORMATS: dict[str, Quantity] = {"hdis": "disparity", "fdis": "disparity", "hdep": "depth", "fdep": "depth"}


@dataclasses.dataclass(frozen=True)
class Description:
    """What an auxiliary image's XMP says of a depth map."""

    scale: Scale | None  # None: the range is not given
    lens: Lens | None
    source: str


def find_apple(data: Bytes) -> CodedDepth | None:
    """The depth map among the further pictures of a JPEG, told from the others by its XMP."""
    for begin, end in further_pictures(data):
        if (described := describe(xmp_of(data, begin))) is None:
            continue
        if described.scale is None:
            raise BrokenDepth("does not say its range: FloatMinValue or FloatMaxValue is missing")
        if end > len(data):
            raise BrokenDepth("is cut off: the file ends before it does")
        codes, full = read_codes(data[begin:end])
        return CodedDepth(codes, full, described.scale, described.source, described.lens)
    return None


def describe(packet: bytes) -> Description | None:
    """What an XMP packet says of a depth map; None where it is about something else."""
    if PIXELS.encode().strip() not in packet:
        return None
    tree = parse_xmp(packet)
    if (quantity := _quantity(tree)) is None:
        return None
    first, last = (tree.number(f"{PIXELS}Float{end}Value") for end in ("Min", "Max"))
    lowest, highest = (tree.number(f"{PIXELS}Int{end}Value") for end in ("Min", "Max"))
    scale = None if first is None or last is None else Scale(quantity, first, last, lowest or 0.0, highest)
    accuracy = tree.find(f"{DEPTH}Accuracy")
    source = f"Apple {quantity}, {accuracy if accuracy in ('absolute', 'relative') else 'of unknown accuracy'}"
    return Description(scale, _apple_lens(tree), source)


def _quantity(tree: Node) -> Quantity | None:
    native, kind = tree.find(f"{PIXELS}NativeFormat"), tree.find(f"{PIXELS}AuxiliaryImageType")
    if native is not None:
        if native.isascii() and native.isdigit() and len(native) <= 10:  # four characters, written as the number
            native = int(native).to_bytes(5, "big")[1:].decode("latin-1")
        return _FORMATS.get(native)
    if tree.find(f"{PIXELS}AuxiliaryImageSubType") is not None:  # the mattes: they too are of type "depth"
        return None
    return "disparity" if kind == "disparity" else "depth" if kind == "depth" else None


def _apple_lens(tree: Node) -> Lens | None:
    """The intrinsics, which are listed column by column."""
    matrix = tree.numbers(f"{DEPTH}IntrinsicMatrix")
    try:
        size = [tree.number(f"{DEPTH}IntrinsicMatrixReference{side}") for side in ("Width", "Height")]
    except BrokenDepth:  # the map can do without
        return None
    if len(matrix) != 9 or size[0] is None or size[1] is None:
        return None
    fx, _, _, _, fy, _, cx, cy, _ = matrix
    return Lens((fx, fy), (cx, cy), (size[0], size[1]))


GDEPTH = "http://ns.google.com/photos/1.0/depthmap/ "
DYNAMIC = "http://ns.google.com/photos/dd/1.0/{}/ "
MAP, MODEL, ITEM = (DYNAMIC.format(name) for name in ("depthmap", "imagingmodel", "item"))

_UNITS_M = {"m": 1.0, "meter": 1.0, "meters": 1.0, "mm": 0.001, "millimeters": 0.001}
_PICTURE_STARTS = (b"\xff\xd8\xff", b"\x89PNG")


def find_android(data: Bytes) -> CodedDepth | None:
    """The depth map that a JPEG's XMP holds or points to."""
    main = xmp_of(data)
    extended, complete = extended_xmp_of(data, main)
    if not any(name.encode().strip() in packet for name in (GDEPTH, MAP) for packet in (main, extended)):
        return None
    if not complete:
        raise BrokenDepth("is cut off: a part of the photo's extended XMP is missing")
    tree = parse_xmp(main)
    if extended:
        tree.children.append(parse_xmp(extended))
    for node in tree.walk():
        uri = node.get(f"{MAP}DepthURI")
        if uri is not None and (node.get(f"{MAP}ItemSemantic") or "Depth").lower() == "depth":
            return _coded(node, MAP, _item(data, tree, uri), "Dynamic Depth", _android_lens(tree))
    text = tree.find(f"{GDEPTH}Data")
    # Editors that drop the extended XMP leave the rest behind: a photo whose depth is gone has none.
    return None if text is None else _coded(tree, GDEPTH, _decoded(text), "GDepth", None)


def _coded(node: Node, space: str, picture: bytes, layout: str, lens: Lens | None) -> CodedDepth:
    near, far = node.number(f"{space}Near"), node.number(f"{space}Far")
    if near is None or far is None:
        raise BrokenDepth("does not say its range: Near or Far is missing")
    unit = (node.find(f"{space}Units") or "").lower()
    # A Pixel says diopters of what grows from near to far, and so is none: the order counts, not the unit.
    known = unit in _UNITS_M or (unit == "diopters" and near > far)
    metre = _UNITS_M.get(unit, 1.0) if known else 1.0
    style = (node.find(f"{space}Format") or "").lower()
    scale = _scale(style, near * metre, far * metre, diopters=known and unit == "diopters")
    along_ray = (node.find(f"{space}MeasureType") or "").lower() == "opticray"
    source = f"{layout}, in {unit}" if known else f"{layout}, unit unknown"
    codes, full = read_codes(picture)
    return CodedDepth(codes, full, scale, source, lens, along_ray=along_ray, unit_known=known)


def _scale(style: str, near: float, far: float, *, diopters: bool) -> Scale:
    """Codes run from near to far: evenly, or evenly in the inverse."""
    if style not in ("rangeinverse", "rangelinear"):
        raise BrokenDepth(f"has the format {style[:40]!r}: RangeInverse and RangeLinear are read")
    inverse = style == "rangeinverse"
    if near == far or min(near, far) < 0 or (near > far) != diopters or (inverse and min(near, far) == 0):
        raise BrokenDepth(f"announces near {near:g} and far {far:g}, between which nothing can lie")
    if inverse:
        near, far = 1 / near, 1 / far
    return Scale("disparity" if inverse != diopters else "depth", near, far)


def _decoded(text: str) -> bytes:
    squeezed = "".join(text.split())
    try:
        return base64.b64decode(squeezed + "=" * (-len(squeezed) % 4), validate=True)
    except (binascii.Error, ValueError) as error:
        raise BrokenDepth(f"is not readable as base64 ({error})") from error


def _item(data: Bytes, tree: Node, uri: str) -> bytes:
    """The bytes of a directory entry; they are appended to the primary picture in the directory's order."""
    entries = [node for node in tree.walk() if (node.get(f"{ITEM}Mime") or node.get(f"{ITEM}Length")) is not None]
    index = next((i for i, node in enumerate(entries) if node.get(f"{ITEM}DataURI") == uri), None)
    if index is None:
        raise BrokenDepth("is named by its XMP, but missing from the photo's directory of items")
    lengths, paddings = (
        [int(to_number(node.get(f"{ITEM}{name}") or "0", f"{ITEM}{name}")) for node in entries]
        for name in ("Length", "Padding")
    )
    if min(lengths) < 0 or min(paddings) < 0:
        raise BrokenDepth("has a negative length in the photo's directory of items")
    length = lengths[index]
    for begin in _places(data, lengths, paddings, index):
        end = begin + length if length else len(data)  # 0: to the end of the file
        if begin > 0 and end <= len(data) and data[begin : begin + 4].startswith(_PICTURE_STARTS):
            return data[begin:end]
    raise BrokenDepth("is cut off, or not where the photo's directory of items has it")


def _places(data: Bytes, lengths: list[int], paddings: list[int], index: int) -> list[int]:
    """Where the item may begin: writers disagree on whether lengths include paddings, and on the primary's."""
    places = [len(data) - sum(lengths[index:])]  # counted from the end
    if (end := end_of_picture(data)) is not None:
        behind = [0, *lengths[1:]]
        padded = [length + padding for length, padding in zip(behind, paddings, strict=True)]
        places = [end + list(accumulate(sizes, initial=0))[index] for sizes in (padded, behind)] + places
    return places


def _android_lens(tree: Node) -> Lens | None:
    """The one imaging model, in pixels; its centre may be in shares of the picture, as the specification has it."""
    models = [node for node in tree.walk() if node.get(f"{MODEL}FocalLengthX") is not None]
    if len(models) != 1:
        return None
    names = ("FocalLengthX", "FocalLengthY", "PrincipalPointX", "PrincipalPointY", "ImageWidth", "ImageHeight")
    try:
        found = [models[0].number(f"{MODEL}{name}") for name in names]
    except BrokenDepth:  # the map can do without
        return None
    fx, fy, cx, cy, width, height = found
    if fx is None or fy is None or width is None or height is None:
        return None
    cx, cy = 0.5 if cx is None else cx, 0.5 if cy is None else cy
    center = (cx * width, cy * height) if max(cx, cy) <= 1 else (cx, cy)
    return Lens((fx, fy), center, (width, height))


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
    lens = None if described is None else described.lens
    return CodedDepth(codes, full, *_meaning(described, stated), lens, item.own_turn, item.turn)


def _decode(path: str | os.PathLike[str]) -> tuple[Array, int, dict[str, Any]]:
    """Codes [H, W] with the item's own rotation applied, the highest code, and HEVC's depth information."""
    import pillow_heif

    with decoding():
        images = pillow_heif.open_heif(os.fspath(path), hdr_to_16bit=False).info["depth_images"]
        if not images:
            raise BrokenDepth("is announced, but missing")
        check_pixels(*images[0].size)
        codes = np.array(images[0])
        return codes, FULL_CODES[images[0].mode], images[0].info.get("metadata") or {}


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
