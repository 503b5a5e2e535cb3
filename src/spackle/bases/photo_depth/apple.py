"""Apple's words for a depth map: the XMP beside the auxiliary image, in HEIC and JPEG alike."""

from __future__ import annotations

import dataclasses
from typing import Literal

from spackle.bases.photo_depth.coded import BrokenDepth, CodedDepth, Lens, Scale, read_codes
from spackle.bases.photo_depth.jpeg import Bytes, further_pictures, xmp_of
from spackle.bases.photo_depth.xmp import Node, parse_xmp

PIXELS, DEPTH = "http://ns.apple.com/pixeldatainfo/1.0/ ", "http://ns.apple.com/depthData/1.0/ "

# Core Video's formats of depth maps, half and full floats; any other is a matte, a gain map or a mask.
_FORMATS: dict[str, Literal["depth", "disparity"]] = {
    "hdis": "disparity",
    "fdis": "disparity",
    "hdep": "depth",
    "fdep": "depth",
}


@dataclasses.dataclass(frozen=True)
class Description:
    """What an auxiliary image's XMP says of a depth map."""

    quantity: Literal["depth", "disparity"]
    scale: Scale | None  # None: the range is not given
    lens: Lens | None
    source: str


def find_in_jpeg(data: Bytes) -> CodedDepth | None:
    """The depth map among the further pictures of a JPEG, told from the others by its XMP."""
    for begin, end in further_pictures(data):
        described = describe(xmp_of(data, begin))
        if described is None:
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
    quantity = _quantity(tree)
    if quantity is None:
        return None
    first, last = (tree.number(f"{PIXELS}Float{end}Value") for end in ("Min", "Max"))
    lowest, highest = (tree.number(f"{PIXELS}Int{end}Value") for end in ("Min", "Max"))
    scale = None if first is None or last is None else Scale(quantity, first, last, lowest or 0.0, highest)
    accuracy = tree.find(f"{DEPTH}Accuracy")
    source = f"Apple {quantity}, {accuracy if accuracy in ('absolute', 'relative') else 'of unknown accuracy'}"
    return Description(quantity, scale, _lens(tree), source)


def _quantity(tree: Node) -> Literal["depth", "disparity"] | None:
    native, kind = tree.find(f"{PIXELS}NativeFormat"), tree.find(f"{PIXELS}AuxiliaryImageType")
    if native is not None:
        if native.isascii() and native.isdigit() and len(native) <= 10:  # four characters, written as the number
            native = int(native).to_bytes(5, "big")[1:].decode("latin-1")
        return _FORMATS.get(native)
    if tree.find(f"{PIXELS}AuxiliaryImageSubType") is not None:  # the mattes: they too are of type "depth"
        return None
    return "disparity" if kind == "disparity" else "depth" if kind == "depth" else None


def _lens(tree: Node) -> Lens | None:
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
