"""The depth map inside a portrait photo: Apple's in JPEG and HEIC, Android's GDepth and Dynamic Depth in JPEG."""

from __future__ import annotations

import base64
import binascii
import mmap
import os
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from spackle.bases.depth_map import ASPECT_TOLERANCE, DepthMap, Quantity, StrPath, is_depth
from spackle.bases.photo_depth.coded import (
    BY_ORIENTATION,
    UPRIGHT,
    Array,
    BrokenDepth,
    CodedDepth,
    Lens,
    Scale,
    Turn,
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
from spackle.camera import Camera
from spackle.errors import InputError
from spackle.files import check_file
from spackle.image import DEFAULT_FOCAL_MM, check_pixels, film_to_pixels, focal_from_exif, read_image

_EXIF_IFD, _ORIENTATION = 0x8769, 0x0112
PLAUSIBLE_M = (0.3, 30.0)  # a scene's middle, where the file does not say its unit
USUAL_M = 3.0


def load_photo_depth(path: StrPath) -> DepthMap | None:
    """The depth map inside a photo, upright as the photo itself is; None where it has none.

    Read are, in HEIC, an auxiliary depth image with Apple's XMP or HEVC's depth information; in JPEG,
    Apple's auxiliary pictures, Android's Dynamic Depth and the older GDepth. `DepthMap.note` says what
    it was and how far its metres are to be trusted. The picture itself is not decoded.

    Raises:
        InputError: a missing file, or a photo whose depth map is broken or of another crop.
    """
    if check_file(path, "photo") < 12:
        return None
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[:3] == b"\xff\xd8\xff":
                coded = find_apple(data) or find_android(data)
            else:
                coded = find_in_heif(data, path) if data[4:8] == b"ftyp" else None
        return None if coded is None else _depth_map(coded, path)
    except BrokenDepth as error:
        raise InputError(
            f"{path}: the depth map in the photo {error}: give another one with --depth FILE, or use --base lite"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error}") from error


def _depth_map(coded: CodedDepth, path: StrPath) -> DepthMap:
    photo_width, photo_height, photo_turn, focal = read_image(path, _photo_header)
    turn = coded.turn.then(photo_turn)
    stored, quantum = coded.scale.decode(coded.codes, coded.full)
    depth = turn.grid(torch.from_numpy(stored))
    height, width = depth.shape
    if abs(width * photo_height / (height * photo_width) - 1) > ASPECT_TOLERANCE:
        raise BrokenDepth(f"has {width}×{height} pixels but the photo {photo_width}×{photo_height}, another crop")
    before = coded.codes.shape[:: 1 if coded.turned.transpose else -1]
    K = None if coded.lens is None else coded.lens.matrix(*before)
    K = None if K is None else coded.turned.then(turn).matrix(K, *before)
    if coded.along_ray:
        own = Camera.from_focal(focal, photo_width, photo_height).resized(width, height)
        camera = own if K is None else Camera(K, torch.eye(4), width, height)
        rays = camera.unproject(camera.pixel_centers(), torch.ones(height, width))
        depth, quantum = depth / rays.square().sum(-1).sqrt(), None  # from the way to a point to its z
    note = f"portrait depth of the photo ({coded.source}"
    known = depth[is_depth(depth)]
    middle = float(known.median()) if len(known) and not coded.unit_known else USUAL_M
    if not PLAUSIBLE_M[0] <= middle <= PLAUSIBLE_M[1]:
        factor = USUAL_M / middle
        depth, note = depth * factor, f"{note}, scaled to a median of {USUAL_M:g} m"
        quantum = quantum and quantum * (factor if coded.scale.quantity == "depth" else 1 / factor)
    metres = depth.float()
    valid = is_depth(metres)
    if not valid.any():
        raise BrokenDepth("has no pixel with a depth")
    return DepthMap(metres.where(valid, 0.0), valid, K, quantum, coded.scale.quantity, Path(path), f"{note})")


def _photo_header(image: Image.Image) -> tuple[int, int, Turn, float]:
    """Upright width and height of the photo, the turn of its stored pixels, and its focal length in pixels."""
    try:
        exif = image.getexif()
        orientation, tags = exif.get(_ORIENTATION, 1), {**exif, **exif.get_ifd(_EXIF_IFD)}
        turn = BY_ORIENTATION.get(orientation, UPRIGHT)
    except Exception:  # unreadable EXIF says nothing about the orientation
        turn, tags = UPRIGHT, {}
    width, height = image.size[::-1] if turn.transpose else image.size
    focal = focal_from_exif(tags, width, height) or film_to_pixels(DEFAULT_FOCAL_MM, width, height)
    return width, height, turn, focal


PIXELS, DEPTH = "http://ns.apple.com/pixeldatainfo/1.0/ ", "http://ns.apple.com/depthData/1.0/ "

# Core Video's formats of depth maps, half and full floats; any other is a matte, a gain map or a mask.
_FORMATS: dict[str, Quantity] = {"hdis": "disparity", "fdis": "disparity", "hdep": "depth", "fdep": "depth"}


Description = tuple[Scale | None, Lens | None, str]  # the scale if XMP gives the range, the lens, the source


def find_apple(data: Bytes) -> CodedDepth | None:
    """The depth map among the further pictures of a JPEG, told from the others by its XMP."""
    for begin, end in further_pictures(data):
        if (described := describe(xmp_of(data, begin))) is None:
            continue
        scale, lens, source = described
        if scale is None:
            raise BrokenDepth("does not say its range: FloatMinValue or FloatMaxValue is missing")
        if end > len(data):
            raise BrokenDepth("is cut off: the file ends before it does")
        codes, full = read_codes(data[begin:end])
        return CodedDepth(codes, full, scale, source, lens)
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
    return scale, _apple_lens(tree), source


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
    xmp, own_turn, turn = item
    codes, full, stated = _decode(path)
    scale, lens, source = describe(xmp) or (None, None, "")
    if scale is None:  # Apple's words count more than HEVC's
        scale, source = _meaning(stated)
    return CodedDepth(codes, full, scale, source, lens, own_turn, turn)


def _decode(path: str | os.PathLike[str]) -> tuple[Array, int, dict[str, Any]]:
    """Codes [H, W] with the item's own rotation applied, the highest code, and HEVC's depth information."""
    import pillow_heif

    with decoding():
        images = pillow_heif.open_heif(os.fspath(path), hdr_to_16bit=False).info["depth_images"]
        if not images:
            raise BrokenDepth("is announced, but missing")
        width, height = images[0].size
        check_pixels(width, height, os.path.getsize(path), "it")
        codes = np.array(images[0])
        return codes, FULL_CODES[images[0].mode], images[0].info.get("metadata") or {}


def _meaning(stated: dict[str, Any]) -> tuple[Scale, str]:
    """HEVC's range and its source, else a portrait's usual range."""
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
