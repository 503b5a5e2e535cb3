"""Android's two layouts in a JPEG: GDepth inside the XMP, and Dynamic Depth behind the picture."""

from __future__ import annotations

import base64
import binascii
from itertools import accumulate

from spackle.bases.photo_depth.coded import BrokenDepth, CodedDepth, Lens, Scale, read_codes
from spackle.bases.photo_depth.jpeg import Bytes, end_of_picture, extended_xmp_of, xmp_of
from spackle.bases.photo_depth.xmp import Node, parse_xmp, to_number

GDEPTH = "http://ns.google.com/photos/1.0/depthmap/ "
DYNAMIC = "http://ns.google.com/photos/dd/1.0/{}/ "
MAP, MODEL, ITEM = (DYNAMIC.format(name) for name in ("depthmap", "imagingmodel", "item"))

_UNITS_M = {"m": 1.0, "meter": 1.0, "meters": 1.0, "mm": 0.001, "millimeters": 0.001}
_PICTURE_STARTS = (b"\xff\xd8\xff", b"\x89PNG")


def find_in_jpeg(data: Bytes) -> CodedDepth | None:
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
            return _coded(node, MAP, _item(data, tree, uri), "Dynamic Depth", _lens(tree))
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


def _lens(tree: Node) -> Lens | None:
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
