"""The depth map inside a portrait photo: Apple's in JPEG and HEIC, Android's GDepth and Dynamic Depth in JPEG."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import io
import math
import re
import warnings
from pathlib import Path
from typing import Any, cast
from xml.etree.ElementTree import Element

import numpy as np
import torch
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from spackle.core.image_files import check_pixel_count
from spackle.depth.depth_map import (
    Array,
    DepthMap,
    Quantity,
    StrPath,
    is_valid_depth,
    quantisation_step,
)
from spackle.depth.in_photo.containers import (
    BY_ORIENTATION,
    extended_xmp_of,
    find,
    further_pictures,
    get,
    number,
    open_jpeg,
    parse_xmp,
    turn_of_depth_item,
    xmp_of,
    xmp_packets,
)
from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.files import check_file

_ORIENTATION = 0x0112
PLAUSIBLE_M = (0.3, 30.0)  # median depths beyond these are rescaled if the file states no unit
USUAL_M = 3.0  # the median after rescaling


@dataclasses.dataclass(frozen=True)
class Scale:
    """A linear function from the numbers that a picture stores (codes) to depths or disparities."""

    quantity: Quantity
    first: float  # value of code 0: metres of depth, or 1/m of disparity
    last: float  # value of the highest code that the picture's format has
    source: str  # for the report: layout, quantity and accuracy
    unit_known: bool = True


@dataclasses.dataclass(frozen=True)
class CodedDepth:
    """A depth map as the file stores it."""

    codes: Array  # [H, W] whole numbers
    full: int  # the highest code of the picture's format
    scale: Scale
    turn: str = ""  # the steps that make the codes upright, see `containers.BY_ORIENTATION`

    def decode(self) -> tuple[Array, float]:
        """Metres [H, W] (0 or less: unknown), and the quantisation step of the stored depth or disparity."""
        first, last = self.scale.first, self.scale.last
        if (
            not (math.isfinite(first) and math.isfinite(last))
            or first == last
            or max(first, last) <= 0
        ):
            raise ValueError(f"it announces a {self.scale.quantity} from {first:g} to {last:g}")
        if int(self.codes.min()) == int(self.codes.max()):
            raise ValueError("it has the same value everywhere")
        slope = (last - first) / self.full
        step = abs(slope) * (quantisation_step(self.codes) or 1)
        with np.errstate(all="ignore"):  # the caller marks infinite results as unknown
            values = first + slope * self.codes.astype(np.float64)
            if self.scale.quantity == "depth":
                return values, step
            # Disparities that are not above zero are the horizon, or were pushed beyond it by noise: far, but known.
            return 1 / np.maximum(values, abs(slope) / 2), step


def load_photo_depth(path: StrPath) -> DepthMap | None:
    """The depth map inside a photo, upright as the photo itself is; None if it has none.

    In HEIC this reads an auxiliary depth image with Apple's XMP or HEVC's depth information; in JPEG, Apple's auxiliary
    pictures, Android's Dynamic Depth and the older GDepth. `DepthMap.note` says which format it was and how reliable
    the metres are. The picture itself is not decoded. InputError for a missing file or a broken depth map.
    """
    check_file(path, "photo")
    try:
        with open(path, "rb") as file:
            start = file.read(8)
            jpeg = start.startswith(b"\xff\xd8\xff")
            data = start + file.read() if jpeg or start.endswith(b"ftyp") else b""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's warnings about untrusted bytes are of no use
            coded = _find_in_jpeg(data) if jpeg else _find_in_heif(data) if data else None
            return None if coded is None else _depth_map(coded, Path(path))
    except Exception as error:  # untrusted bytes can raise any exception in a decoder
        problem = f"the depth map in the photo cannot be used ({reason_in_a_line(error)})"
        raise InputError(
            f"{path}: {problem}: give another depth map with --depth FILE, or use --base lite"
        ) from error


def _depth_map(coded: CodedDepth, path: Path) -> DepthMap:
    stored, quantum = coded.decode()
    depth = torch.from_numpy(stored)
    for step in coded.turn:
        depth = depth.T if step == "t" else depth.flip(1 if step == "x" else 0)
    note = f"portrait depth of the photo ({coded.scale.source}"
    known = depth[is_valid_depth(depth)]
    middle = float(known.median()) if len(known) and not coded.scale.unit_known else USUAL_M
    if not PLAUSIBLE_M[0] <= middle <= PLAUSIBLE_M[1]:
        factor = USUAL_M / middle
        depth, note = depth * factor, f"{note}, scaled to a median of {USUAL_M:g} m"
        quantum *= factor if coded.scale.quantity == "depth" else 1 / factor
    metres = depth.float().contiguous()
    valid = is_valid_depth(metres)
    if not valid.any():
        raise ValueError("no pixel has a depth")
    return DepthMap(
        metres.where(valid, 0.0), valid, None, quantum, coded.scale.quantity, path, f"{note})"
    )


def _read_codes(picture: bytes) -> tuple[Array, int]:
    """[H, W] values of a JPEG or PNG, and the highest value that its format has."""
    with Image.open(io.BytesIO(picture), formats=("JPEG", "PNG")) as image:
        check_pixel_count(*image.size, len(picture), "the map")
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16), 65535
        return np.asarray(image.convert("L")), 255


def _find_in_jpeg(data: bytes) -> CodedDepth | None:
    """Apple's depth map, recognised among the further pictures by its XMP, or else Android's; None without either."""
    if (image := open_jpeg(data)) is None:  # whoever decodes the photo will say what is wrong
        return None
    turn = ""
    with contextlib.suppress(Exception):  # unreadable EXIF says nothing about the orientation
        turn = BY_ORIENTATION.get(image.getexif().get(_ORIENTATION, 1), "")
    for begin, end in further_pictures(image):
        if scale := apple_scale(xmp_of(open_jpeg(data[begin:end]))):
            if end > len(data):
                raise ValueError("the file ends before the map does")
            return CodedDepth(*_read_codes(data[begin:end]), scale, turn)
    found = _find_android(data, image)
    return found and CodedDepth(*_read_codes(found[0]), found[1], turn)


PIXELS, DEPTH = "{http://ns.apple.com/pixeldatainfo/1.0/}", "{http://ns.apple.com/depthData/1.0/}"
# Core Video's formats of depth maps, half and full floats; any other is a matte, a gain map or a mask.
_FORMATS: dict[str, Quantity] = {
    "hdis": "disparity",
    "fdis": "disparity",
    "hdep": "depth",
    "fdep": "depth",
}


def _is_about(packet: bytes, space: str) -> bool:
    return space.strip("{}").encode() in packet


def apple_scale(packet: bytes) -> Scale | None:
    """The scale that an XMP packet states for a depth map; None if it is about something else, or states no range."""
    if not _is_about(packet, PIXELS):
        return None
    tree = parse_xmp(packet)
    quantity = _quantity(tree)
    first, last = (number(tree, f"{PIXELS}{name}") for name in ("FloatMinValue", "FloatMaxValue"))
    if quantity is None or first is None or last is None:
        return None
    accuracy = find(tree, f"{DEPTH}Accuracy")
    accuracy = accuracy if accuracy in ("absolute", "relative") else "of unknown accuracy"
    return Scale(quantity, first, last, f"Apple {quantity}, {accuracy}")


def _quantity(tree: Element) -> Quantity | None:
    native, kind = find(tree, f"{PIXELS}NativeFormat"), find(tree, f"{PIXELS}AuxiliaryImageType")
    if native is not None:
        if native.isdecimal() and len(native) <= 10:  # four characters, written as one number
            native = int(native).to_bytes(5, "big")[1:].decode("latin-1")
        return _FORMATS.get(native)
    if (
        find(tree, f"{PIXELS}AuxiliaryImageSubType") is not None
    ):  # the mattes: they too are of type "depth"
        return None
    return cast("Quantity", kind) if kind in ("depth", "disparity") else None


GDEPTH = "{http://ns.google.com/photos/1.0/depthmap/}"
MAP, ITEM = (f"{{http://ns.google.com/photos/dd/1.0/{name}/}}" for name in ("depthmap", "item"))
_UNITS_M = {"m": 1.0, "meter": 1.0, "meters": 1.0, "mm": 0.001, "millimeters": 0.001}
_PICTURE_START, _PICTURE_ENDS = (
    re.compile(rb"\xff\xd8\xff|\x89PNG"),
    (b"\xff\xd9", b"IEND\xaeB`\x82"),
)


def _find_android(data: bytes, image: JpegImageFile) -> tuple[bytes, Scale] | None:
    """Find the depth map's picture, which a JPEG's XMP holds or points to, and its scale; None without a depth map."""
    main, extended = xmp_of(image), extended_xmp_of(image)
    if not any(_is_about(packet, space) for space in (GDEPTH, MAP) for packet in (main, extended)):
        return None
    tree = parse_xmp(main)
    if extended:
        tree.append(parse_xmp(extended))
    for node in tree.iter():
        uri = get(node, f"{MAP}DepthURI")
        if uri is not None and (get(node, f"{MAP}ItemSemantic") or "Depth").lower() == "depth":
            return _item(data, tree, uri), android_scale(node, MAP, "Dynamic Depth")
    text = find(tree, f"{GDEPTH}Data")
    if text is None:  # editors may drop the extended XMP, and the depth with it, but leave the rest
        return None
    return base64.b64decode(text + "=="), android_scale(tree, GDEPTH, "GDepth")


def android_scale(node: Element, space: str, layout: str) -> Scale:
    """The scale of codes linear in depth or in inverse depth, from near to far; ValueError if it is unknown."""
    near, far = number(node, f"{space}Near"), number(node, f"{space}Far")
    if near is None or far is None:
        raise ValueError("Near or Far is missing")
    unit, style, measure = (
        (find(node, f"{space}{name}") or "").lower() for name in ("Units", "Format", "MeasureType")
    )
    # Pixel phones state diopters even for values that grow from near to far: the order counts, not the unit.
    diopters = unit == "diopters" and near > far
    known = unit in _UNITS_M or diopters
    near, far = (value * _UNITS_M.get(unit, 1.0) for value in (near, far))
    if style not in ("rangeinverse", "rangelinear") or measure == "opticray":
        raise ValueError(f"the format {style[:40]!r} and the measure {measure[:40]!r} are not read")
    inverse = style == "rangeinverse"
    if (
        near == far
        or min(near, far) < 0
        or (near > far) != diopters
        or (inverse and min(near, far) == 0)
    ):
        raise ValueError(f"nothing can lie between near {near:g} and far {far:g}")
    if inverse:
        near, far = 1 / near, 1 / far
    source = f"{layout}, in {unit}" if known else f"{layout}, unit unknown"
    return Scale("disparity" if inverse != diopters else "depth", near, far, source, known)


def _item(data: bytes, tree: Element, uri: str) -> bytes:
    """The picture of an item in the photo's directory; the items lie at the file's end, in the directory's order."""
    entries = [
        node
        for node in tree.iter()
        if (get(node, f"{ITEM}Mime") or get(node, f"{ITEM}Length")) is not None
    ]
    index = next((i for i, node in enumerate(entries) if get(node, f"{ITEM}DataURI") == uri), None)
    if index is not None:
        lengths = [int(number(node, f"{ITEM}Length") or 0) for node in entries[index:]]
        last = len(data) - sum(
            lengths
        )  # the item begins here, or earlier if other bytes follow the items
        for begin in reversed(
            [found.start() for found in _PICTURE_START.finditer(data, 1) if found.start() <= last]
        ):
            if lengths[0] and (
                begin == last or data.endswith(_PICTURE_ENDS, begin, begin + lengths[0])
            ):
                return data[begin : begin + lengths[0]]
            if not lengths[0] and data.endswith(
                (*_PICTURE_ENDS, b"\0"), 0, begin
            ):  # it ends with the file
                return data[begin:]
    raise ValueError("the photo's directory of items does not lead to a picture")


FULL_CODES = {"L": 255, "I;10": 1023, "I;12": 4095}
ASSUMED = Scale(
    "disparity", 0.1, 1.0, "HEIF depth of unknown range, assumed to be 1 to 10 m"
)  # usual in portraits


def _find_in_heif(data: bytes) -> CodedDepth | None:
    """The auxiliary depth image of the primary picture, in any of the representations of HEVC's depth information."""
    import pillow_heif

    if (turn := turn_of_depth_item(data)) is None:
        return None
    image = pillow_heif.open_heif(io.BytesIO(data), hdr_to_16bit=False).info["depth_images"][0]
    width, height = image.size
    check_pixel_count(width, height, len(data), "the map")
    codes, full = np.array(image), FULL_CODES[image.mode]
    of_apple = next(
        filter(None, map(apple_scale, xmp_packets(data))), None
    )  # takes precedence over HEVC's range
    return CodedDepth(codes, full, of_apple or hevc_scale(image.info.get("metadata") or {}), turn)


def hevc_scale(stated: dict[str, Any]) -> Scale:
    """The depth range that HEVC's depth representation information states, else the usual range of portraits."""
    kind = stated.get("representation_type")
    first, last = (
        stated.get(name) for name in (("d_min", "d_max") if kind == 1 else ("z_near", "z_far"))
    )
    if kind == 3:
        raise ValueError("disparities with steps of uneven size are not read")
    if first is None or last is None:
        return ASSUMED
    if kind == 1:
        return Scale("disparity", first, last, "HEIF disparity")
    if not 0 < first < last:
        raise ValueError(f"nothing can lie between near {first:g} and far {last:g}")
    if kind == 2:
        return Scale("depth", first, last, "HEIF depth")
    return Scale("disparity", 1 / last, 1 / first, "HEIF inverse depth")
