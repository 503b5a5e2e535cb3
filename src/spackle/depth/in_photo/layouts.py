"""The layouts in which phones put a depth map into a portrait photo.

`load_photo_depth` is the entry. A map is stored as a picture of whole numbers (codes), and a
`CodeScale` says which depth or disparity a code means. The layouts are Apple's in JPEG and HEIC,
HEVC's in HEIC, and Android's GDepth and Dynamic Depth in JPEG.
"""

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
from PIL.JpegImagePlugin import JpegImageFile
from torch import Tensor

from spackle.core.heif_items import STEPS_OF_EXIF_ORIENTATION, steps_of_depth_item
from spackle.core.image_files import check_pixel_count, open_image
from spackle.core.photo_containers import (
    extended_xmp_of,
    find_number,
    find_property,
    further_pictures,
    open_jpeg,
    own_property,
    parse_xmp,
    xmp_of,
    xmp_packets,
)
from spackle.depth.depth_map import (
    Array,
    DepthMap,
    Quantity,
    StrPath,
    is_valid_depth,
    quantisation_step,
)
from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.runtime.files import check_file

EXIF_TAG_ORIENTATION = 0x0112
JPEG_MAGIC = b"\xff\xd8\xff"
HEIF_BRAND_BOX = b"ftyp"  # the fifth to eighth byte of a HEIF file
# Of a file that states no unit, depths are rescaled if their median is not in this range.
MIN_PLAUSIBLE_MEDIAN_M = 0.3
MAX_PLAUSIBLE_MEDIAN_M = 30.0
USUAL_MEDIAN_M = 3.0  # the median after rescaling


@dataclasses.dataclass(frozen=True)
class CodeScale:
    """A linear function from the numbers that a picture stores (codes) to depths or disparities."""

    quantity: Quantity
    first: float  # value of code 0: metres of depth, or 1/m of disparity
    last: float  # value of the highest code that the picture's format has
    source: str  # for the report: layout, quantity and accuracy
    unit_known: bool = True

    def check(self) -> None:
        """ValueError if the range is empty, holds nothing positive, or is not finite."""
        is_finite = math.isfinite(self.first) and math.isfinite(self.last)
        if not is_finite or self.first == self.last or max(self.first, self.last) <= 0:
            raise ValueError(f"it announces a {self.quantity} from {self.first:g} to {self.last:g}")


@dataclasses.dataclass(frozen=True)
class CodedDepth:
    """A depth map as the file stores it."""

    codes: Array  # [H, W] whole numbers
    max_code: int  # the highest code of the picture's format
    scale: CodeScale
    # The steps that make the codes upright, one letter each, in this order: "t" swaps rows and
    # columns, "x" left and right, "y" top and bottom.
    upright_steps: str = ""

    def decode(self) -> tuple[Array, float]:
        """Metres [H, W] (0 or less: unknown), and the quantisation step of what is stored.

        The step is in metres for depth, and in 1/m for disparity. ValueError if the map's range is
        impossible, or all codes are equal.
        """
        self.scale.check()
        if int(self.codes.min()) == int(self.codes.max()):
            raise ValueError("it has the same value everywhere")

        # What one code more adds to the depth or the disparity. The codes of a map in 16 bits may
        # be multiples of 256, if it was made from 8 bits: its step is then larger than one code.
        slope = (self.scale.last - self.scale.first) / self.max_code
        code_step = quantisation_step(self.codes) or 1
        step = abs(slope) * code_step
        with np.errstate(all="ignore"):  # infinite results are unknown
            values = self.scale.first + slope * self.codes.astype(np.float64)
            if self.scale.quantity == "depth":
                return values, step
            # A disparity of zero is the horizon, and noise makes some of its disparities negative.
            # These pixels are far, but known: they get the disparity of half a code.
            return 1 / np.maximum(values, abs(slope) / 2), step

    def upright(self, stored: Tensor) -> Tensor:
        """A map [H, W] that lies as the codes do, turned so that it is upright like the photo."""
        # Axis 1 runs from left to right, axis 0 from top to bottom.
        for step in self.upright_steps:
            stored = stored.T if step == "t" else stored.flip(1 if step == "x" else 0)
        return stored


def load_photo_depth(path: StrPath) -> DepthMap | None:
    """The depth map inside a photo, upright as the photo itself is; None if it has none.

    In HEIC this reads an auxiliary depth image with Apple's XMP or HEVC's depth information; in
    JPEG, Apple's auxiliary pictures, Android's Dynamic Depth and the older GDepth. `DepthMap.note`
    says which format it was and how reliable the metres are. The picture itself is not decoded.
    InputError for a missing file or a broken depth map.
    """
    check_file(path, "photo")
    try:
        with open(path, "rb") as file:
            # A HEIF begins with a box: 4 bytes of its size, then 4 bytes of its type.
            start = file.read(8)
            # Photos of all other formats have no depth, and are not read to the end.
            is_jpeg = start.startswith(JPEG_MAGIC)
            is_heif = start.endswith(HEIF_BRAND_BOX)
            if not (is_jpeg or is_heif):
                return None
            data = start + file.read()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's, which would not help the user
            coded = _find_in_jpeg(data) if is_jpeg else _find_in_heif(data)
            return None if coded is None else _to_depth_map(coded, Path(path))
    except Exception as error:  # untrusted bytes can raise any exception in a decoder
        raise InputError(
            f"{path}: the depth map in the photo cannot be used ({reason_in_a_line(error)}): "
            "give another depth map with `depth` FILE, or use `base` lite"
        ) from error


def _to_depth_map(coded: CodedDepth, path: Path) -> DepthMap:
    """The upright depth map in metres; ValueError if no pixel has a depth.

    If the file states no unit and the median is implausible, the map is scaled to a median of 3 m.
    """
    stored, quantum = coded.decode()
    depth = coded.upright(torch.from_numpy(stored))
    origin = coded.scale.source
    # A stated unit is trusted, even if the photo shows a mountain.
    factor = 1.0 if coded.scale.unit_known else _factor_to_plausible(depth)
    if factor != 1:
        depth = depth * factor
        origin += f", scaled to a median of {USUAL_MEDIAN_M:g} m"
        # The step of a map that stores disparity is an inverse depth.
        quantum_factor = factor if coded.scale.quantity == "depth" else 1 / factor
        quantum *= quantum_factor

    metres = depth.float().contiguous()
    valid = is_valid_depth(metres)
    if not valid.any():
        raise ValueError("no pixel has a depth")
    return DepthMap(
        depth=metres.where(valid, 0.0),
        valid=valid,
        K=None,
        quantum=quantum,
        quantity=coded.scale.quantity,
        path=path,
        note=f"portrait depth of the photo ({origin})",
    )


def _factor_to_plausible(depth: Tensor) -> float:
    """The factor that brings the median of depths [H, W] to 3 m; 1 if it is in 0.3 to 30 m."""
    known = depth[is_valid_depth(depth)]
    if not len(known):
        return 1.0
    # Portraits and still lifes are a few metres away. If the median is far from that, the numbers
    # are in another unit than metres.
    median = float(known.median())
    is_plausible = MIN_PLAUSIBLE_MEDIAN_M <= median <= MAX_PLAUSIBLE_MEDIAN_M
    return 1.0 if is_plausible else USUAL_MEDIAN_M / median


def _read_codes(picture: bytes) -> tuple[Array, int]:
    """The values [H, W] of a JPEG or PNG, and the highest value that its pixels can have."""
    with open_image(io.BytesIO(picture), ("JPEG", "PNG")) as image:
        width, height = image.size
        check_pixel_count(width, height, len(picture), "the map")
        if image.mode.startswith("I"):  # 16 bits
            return np.asarray(image).astype(np.uint16), 65535
        return np.asarray(image.convert("L")), 255


def _find_in_jpeg(data: bytes) -> CodedDepth | None:
    """Apple's depth map in a JPEG, or else Android's; None without either.

    Apple's is one of the further pictures behind the main one, and is recognised by its XMP, which
    states the scale: what depth or disparity a stored number means.
    """
    image = open_jpeg(data)
    if image is None:  # whoever decodes the photo will say what is wrong
        return None
    # Which turns make the map upright, one letter each; none if the orientation is not known.
    upright_steps = ""
    with contextlib.suppress(Exception):  # unreadable EXIF says nothing about the orientation
        orientation = image.getexif().get(EXIF_TAG_ORIENTATION, 1)
        upright_steps = STEPS_OF_EXIF_ORIENTATION.get(orientation, "")

    # A gain map or a matte may come first.
    for begin, end in further_pictures(image):
        further = open_jpeg(data[begin:end])
        scale = None if further is None else apple_scale(xmp_of(further))
        if scale is not None:
            if end > len(data):
                raise ValueError("the file ends before the map does")
            codes, max_code = _read_codes(data[begin:end])
            return CodedDepth(codes, max_code, scale, upright_steps)

    android = _find_android(data, image)
    if android is None:
        return None
    picture, scale = android
    codes, max_code = _read_codes(picture)
    return CodedDepth(codes, max_code, scale, upright_steps)


# --- Apple

# Namespaces of XMP, in the notation of ElementTree.
PIXEL_DATA = "{http://ns.apple.com/pixeldatainfo/1.0/}"
DEPTH_DATA = "{http://ns.apple.com/depthData/1.0/}"
# Core Video's formats of depth maps, half and full floats; others are mattes, gain maps or masks.
_QUANTITY_OF_PIXEL_FORMAT: dict[str, Quantity] = {
    "hdis": "disparity",
    "fdis": "disparity",
    "hdep": "depth",
    "fdep": "depth",
}


def _mentions(packet: bytes, namespace: str) -> bool:
    """Whether an XMP packet uses a namespace, which is given as "{address}"."""
    return namespace.strip("{}").encode() in packet


def apple_scale(packet: bytes) -> CodeScale | None:
    """The scale that an XMP packet states for a depth map.

    None if it is about something else, or states no range.
    """
    if not _mentions(packet, PIXEL_DATA):
        return None
    # Only now is the packet parsed: most photos have XMP about other things.
    tree = parse_xmp(packet)
    quantity = _apple_quantity(tree)
    # What the lowest and the highest code of the map mean.
    first = find_number(tree, f"{PIXEL_DATA}FloatMinValue")
    last = find_number(tree, f"{PIXEL_DATA}FloatMaxValue")
    if quantity is None or first is None or last is None:
        return None
    accuracy = find_property(tree, f"{DEPTH_DATA}Accuracy")
    if accuracy not in ("absolute", "relative"):
        accuracy = "of unknown accuracy"
    return CodeScale(quantity, first, last, f"Apple {quantity}, {accuracy}")


def _apple_quantity(tree: Element) -> Quantity | None:
    """Whether Apple's XMP is about a map of depth or of disparity; None if about another picture.

    The pixel format decides. Without one the type of the picture does, unless there is a subtype:
    only mattes (masks of hair or skin) have one, and their type is "depth", too.
    """
    pixel_format = find_property(tree, f"{PIXEL_DATA}NativeFormat")
    if pixel_format is not None:
        if pixel_format.isdecimal() and len(pixel_format) <= 10:
            # Its four characters, such as "hdis", are written as one number of 4 bytes. But a
            # damaged number of ten digits may need a fifth byte, which is dropped.
            four_bytes = int(pixel_format).to_bytes(5, "big")[1:]
            pixel_format = four_bytes.decode("latin-1")
        return _QUANTITY_OF_PIXEL_FORMAT.get(pixel_format)

    if find_property(tree, f"{PIXEL_DATA}AuxiliaryImageSubType") is not None:
        return None
    image_type = find_property(tree, f"{PIXEL_DATA}AuxiliaryImageType")
    return cast("Quantity", image_type) if image_type in ("depth", "disparity") else None


# --- Android

GDEPTH = "{http://ns.google.com/photos/1.0/depthmap/}"
DYNAMIC_DEPTH_MAP = "{http://ns.google.com/photos/dd/1.0/depthmap/}"
DYNAMIC_DEPTH_ITEM = "{http://ns.google.com/photos/dd/1.0/item/}"
_METRES_PER_UNIT = {"m": 1.0, "meter": 1.0, "meters": 1.0, "mm": 0.001, "millimeters": 0.001}
NO_PICTURE_IN_DIRECTORY = "the photo's directory of items does not lead to a picture"
_PICTURE_BEGIN = re.compile(rb"\xff\xd8\xff|\x89PNG")  # of a JPEG or a PNG
_PICTURE_ENDS = (b"\xff\xd9", b"IEND\xaeB`\x82")  # of a JPEG, and of a PNG


def _find_android(data: bytes, image: JpegImageFile) -> tuple[bytes, CodeScale] | None:
    """The bytes of the depth map's picture and its scale; None without a depth map.

    Dynamic Depth appends the picture to the photo `data`; the older GDepth holds it in XMP.
    """
    main = xmp_of(image)
    extended = extended_xmp_of(image)
    namespaces = (GDEPTH, DYNAMIC_DEPTH_MAP)
    if not any(_mentions(main, name) or _mentions(extended, name) for name in namespaces):
        return None
    tree = parse_xmp(main)
    if extended:
        tree.append(parse_xmp(extended))

    # Dynamic Depth is the newer format; a photo may have both.
    for node in tree.iter():
        address = own_property(node, f"{DYNAMIC_DEPTH_MAP}DepthURI")
        content = own_property(node, f"{DYNAMIC_DEPTH_MAP}ItemSemantic") or "Depth"
        if address is not None and content.lower() == "depth":
            picture = _appended_picture(data, tree, address)
            return picture, android_scale(node, DYNAMIC_DEPTH_MAP, "Dynamic Depth")

    text = find_property(tree, f"{GDEPTH}Data")
    if text is None:  # editors may drop the extended XMP, and the depth with it, but leave the rest
        return None
    picture = base64.b64decode(text + "==")  # more padding than needed does no harm
    return picture, android_scale(tree, GDEPTH, "GDepth")


def android_scale(node: Element, namespace: str, layout: str) -> CodeScale:
    """The scale of an Android depth map: which depth or inverse depth its codes mean.

    ValueError if it is missing, impossible, or of a kind that is not read.

    Args:
        node: the XMP element with the scale.
        namespace: of its properties.
        layout: what the report calls this way to store depth.
    """
    # Near and Far are what the lowest and the highest code mean. Between them, either the depth
    # ("rangelinear") or its inverse ("rangeinverse") changes by the same amount from code to code.
    near = find_number(node, f"{namespace}Near")
    far = find_number(node, f"{namespace}Far")
    if near is None or far is None:
        raise ValueError("Near or Far is missing")
    unit = (find_property(node, f"{namespace}Units") or "").lower()
    style = (find_property(node, f"{namespace}Format") or "").lower()
    measure = (find_property(node, f"{namespace}MeasureType") or "").lower()
    if style not in ("rangeinverse", "rangelinear") or measure == "opticray":
        raise ValueError(f"the format {style[:40]!r} and the measure {measure[:40]!r} are not read")

    # Diopters, which are 1/m, fall from near to far. Pixel phones state this unit even for values
    # that grow, which therefore are depths of unknown unit.
    in_diopters = unit == "diopters" and near > far
    unit_known = unit in _METRES_PER_UNIT or in_diopters
    near *= _METRES_PER_UNIT.get(unit, 1.0)
    far *= _METRES_PER_UNIT.get(unit, 1.0)
    is_inverse = style == "rangeinverse"
    # In metres, Near must be the smaller number; in diopters, the larger one.
    has_wrong_order = near <= far if in_diopters else near >= far
    divides_by_zero = is_inverse and min(near, far) == 0
    if has_wrong_order or min(near, far) < 0 or divides_by_zero:
        raise ValueError(f"nothing can lie between near {near:g} and far {far:g}")

    source = f"{layout}, in {unit}" if unit_known else f"{layout}, unit unknown"
    # Near and Far are depths or, in diopters, inverse depths, which are called disparity here.
    quantity: Quantity = "disparity" if in_diopters else "depth"
    # The codes are linear in Near and Far, or in their inverses. The inverse of a depth is a
    # disparity, and the inverse of a disparity is a depth.
    if is_inverse:
        quantity = "depth" if in_diopters else "disparity"
        near = 1 / near
        far = 1 / far
    return CodeScale(quantity, near, far, source, unit_known)


def _appended_picture(data: bytes, tree: Element, address: str) -> bytes:
    """The picture of the item `address` in the directory of the photo `data`.

    The directory is a list in the XMP. The items lie at the file's end, in the order of the list,
    which states their lengths in bytes. But some phones leave out the length of this item, and some
    write other bytes behind the items. ValueError if no picture is found.
    """
    entries = [node for node in tree.iter() if _is_directory_entry(node)]
    addresses = [own_property(node, f"{DYNAMIC_DEPTH_ITEM}DataURI") for node in entries]
    if address not in addresses:
        raise ValueError(NO_PICTURE_IN_DIRECTORY)
    index = addresses.index(address)
    # The lengths of this item and of all that follow it; 0 for a length that is missing.
    lengths = [
        int(find_number(node, f"{DYNAMIC_DEPTH_ITEM}Length") or 0) for node in entries[index:]
    ]
    length = lengths[0]

    # If the last item ends with the file, this one begins here. If other bytes follow, it begins
    # earlier. So the places where a picture could begin are tried from here to the front; the
    # search leaves out byte 0, where the photo itself begins.
    latest_begin = len(data) - sum(lengths)
    picture_begins = [match.start() for match in _PICTURE_BEGIN.finditer(data, 1)]
    for begin in reversed([begin for begin in picture_begins if begin <= latest_begin]):
        if length > 0:
            end = begin + length
            if begin == latest_begin or data.endswith(_PICTURE_ENDS, begin, end):
                return data[begin:end]
        # Without a length, the item reaches to the file's end. A thumbnail inside of a picture
        # begins like an item, too. But only an item follows directly on the end of another picture,
        # or on the zeros that pad it.
        elif data.endswith((*_PICTURE_ENDS, b"\0"), 0, begin):
            return data[begin:]
    raise ValueError(NO_PICTURE_IN_DIRECTORY)


def _is_directory_entry(node: Element) -> bool:
    """Whether an element of XMP describes an item: it has a type or a length."""
    mime = own_property(node, f"{DYNAMIC_DEPTH_ITEM}Mime")
    length = own_property(node, f"{DYNAMIC_DEPTH_ITEM}Length")
    return bool(mime) or length is not None


# --- HEIF

MAX_CODE_OF_MODE = {"L": 255, "I;10": 1023, "I;12": 4095}
ASSUMED_SCALE = CodeScale(  # usual in portraits
    "disparity", 0.1, 1.0, "HEIF depth of unknown range, assumed to be 1 to 10 m"
)


def _find_in_heif(data: bytes) -> CodedDepth | None:
    """The depth map of a HEIF's primary picture; None if there is none.

    What its codes mean is said by Apple's XMP, or else by HEVC's information about depth.
    """
    import pillow_heif

    upright_steps = steps_of_depth_item(data)
    if upright_steps is None:
        return None
    # 10 and 12 bits are kept, so that the codes are those of the file.
    heif = pillow_heif.open_heif(io.BytesIO(data), hdr_to_16bit=False)
    image = heif.info["depth_images"][0]  # the only one; with several, the steps are None
    width, height = image.size
    check_pixel_count(width, height, len(data), "the map")
    codes = np.array(image)
    max_code = MAX_CODE_OF_MODE[image.mode]

    for packet in xmp_packets(data):
        scale = apple_scale(packet)
        if scale is not None:
            return CodedDepth(codes, max_code, scale, upright_steps)
    scale = hevc_scale(image.info.get("metadata") or {})
    return CodedDepth(codes, max_code, scale, upright_steps)


# Values of HEVC's representation_type, which says what is linear in the codes; 0 is inverse depth.
HEVC_DISPARITY = 1
HEVC_DEPTH = 2
HEVC_UNEVEN_DISPARITY = 3


def hevc_scale(stated: dict[str, Any]) -> CodeScale:
    """What the codes of a HEIF's depth map mean, by HEVC's "depth representation information".

    Args:
        stated: that information: "representation_type", which says what is linear in the codes;
            and the range, which is "d_min" and "d_max" for disparities, else "z_near" and "z_far"
            in metres. Without a range, the usual one of 1 to 10 m is assumed.

    Raises:
        ValueError: the range is impossible, or the codes are not linear in a disparity or depth.
    """
    representation = stated.get("representation_type")
    if representation == HEVC_UNEVEN_DISPARITY:
        raise ValueError("disparities with steps of uneven size are not read")
    if representation == HEVC_DISPARITY:
        least = stated.get("d_min")
        greatest = stated.get("d_max")
        if least is None or greatest is None:
            return ASSUMED_SCALE
        if not least < greatest:
            raise ValueError(f"nothing can lie between disparity {least:g} and {greatest:g}")
        scale = CodeScale("disparity", least, greatest, "HEIF disparity")
        scale.check()
        return scale

    near = stated.get("z_near")
    far = stated.get("z_far")
    if near is None or far is None:
        return ASSUMED_SCALE
    if not 0 < near < far:
        raise ValueError(f"nothing can lie between near {near:g} and far {far:g}")
    if representation == HEVC_DEPTH:
        scale = CodeScale("depth", near, far, "HEIF depth")
    else:
        # The inverse depth is linear in the codes: code 0 means the farthest depth.
        scale = CodeScale("disparity", 1 / far, 1 / near, "HEIF inverse depth")
    scale.check()
    return scale
