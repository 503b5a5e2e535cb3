"""The depth map inside a portrait photo: Apple's in JPEG and HEIC, Android's GDepth and Dynamic Depth in JPEG."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import io
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.bases.depth_map import ASPECT_TOLERANCE, DepthMap, Quantity, StrPath, grid_step, is_depth
from spackle.bases.photo_depth.containers import (
    BY_ORIENTATION,
    RDF_ITEM,
    BrokenDepth,
    end_of_picture,
    extended_xmp_of,
    find,
    find_depth_item,
    further_pictures,
    get,
    number,
    open_jpeg,
    parse_xmp,
    xmp_of,
    xmp_packets,
)
from spackle.camera import Camera
from spackle.errors import InputError, reading, reason_in_a_line
from spackle.files import check_file
from spackle.image import DEFAULT_FOCAL_MM, LENSES, check_pixels, film_to_pixels, focal_from_exif, read_image

Array = NDArray[Any]

_EXIF_IFD, _ORIENTATION = 0x8769, 0x0112
PLAUSIBLE_M = (0.3, 30.0)  # median depths beyond these are rescaled if the file states no unit
USUAL_M = 3.0  # the median after rescaling


@dataclasses.dataclass(frozen=True)
class Scale:
    """A linear map from codes to values."""

    quantity: Quantity
    first: float  # value of the lowest code: metres of depth, or 1/m of disparity
    last: float  # value of the highest code
    lowest: float = 0.0
    highest: float | None = None  # None: the highest that the picture's format has

    def decode(self, codes: Array, full: int) -> tuple[Array, float | None]:
        """Decode stored codes [H, W] to metres (0 or less: unknown), and the step between the codes that occur."""
        highest = full if self.highest is None else self.highest
        if not all(map(math.isfinite, (self.first, self.last, self.lowest, highest))) or highest <= self.lowest:
            raise BrokenDepth("does not say what its values mean: a number of its range makes no sense")
        if self.first == self.last or max(self.first, self.last) <= 0:
            raise BrokenDepth(f"announces a {self.quantity} from {self.first:g} to {self.last:g}")
        if int(codes.min()) == int(codes.max()):
            raise BrokenDepth("has the same value everywhere")
        slope = (self.last - self.first) / (highest - self.lowest)
        grid = grid_step(codes)
        step = None if grid is None else abs(slope) * grid
        with np.errstate(all="ignore"):  # what comes out infinite is marked by the caller
            values = self.first + slope * (codes.astype(np.float64) - self.lowest)
            if self.quantity == "depth":
                return values, step
            # Values not above zero are the horizon, or were pushed beyond it by noise: far, but not unknown.
            return 1 / np.maximum(values, abs(slope) / 2), step


Lens = tuple[float, float, float, float, float, float]  # a picture's focal length, centre and size: x, y in pixels


def _turned(values: Tensor, turn: str) -> Tensor:
    """[H, W] to [H, W] or [W, H] by a list of rotations and flips, see `containers.BY_ORIENTATION`."""
    for step in turn:
        values = values.T if step == "t" else values.flip(1 if step == "x" else 0)
    return values.contiguous()


def _intrinsics(lens: Lens, width: int, height: int, turn: str) -> Tensor | None:
    """Intrinsics [3, 3] of a width×height map after its rotation; None if the numbers cannot belong to this map."""
    focal, center, size = np.array(lens).reshape(3, 2)
    if not np.isfinite(lens).all() or size.min() <= 0:
        return None
    shortest, longest = (side * size.max() for side in LENSES)
    believable = shortest <= focal.min() and focal.max() <= longest and ((center > 0) & (center < size)).all()
    if not believable or abs(size[0] * height / (size[1] * width) - 1) > ASPECT_TOLERANCE:
        return None
    scale = np.array([width, height]) / size
    fx, fy, cx, cy = np.array([focal * scale, center * scale], np.float32).ravel().tolist()
    for step in turn:
        if step == "t":
            fx, cx, fy, cy, width, height = fy, cy, fx, cx, height, width
        cx = width - cx if step == "x" else cx
        cy = height - cy if step == "y" else cy
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


@dataclasses.dataclass(frozen=True)
class CodedDepth:
    """A depth map as the file stores it."""

    codes: Array  # [H, W] whole numbers
    full: int  # the highest code of the picture's format
    scale: Scale
    source: str  # for the report: layout, quantity and accuracy
    lens: Lens | None = None
    turned: str = ""  # the turn that the decoder has applied to the codes, but not to the lens
    turn: str = ""  # the turn that is still needed to match the photo as Pillow opens it
    along_ray: bool = False  # distances from the eye instead of z
    unit_known: bool = True


def load_photo_depth(path: StrPath) -> DepthMap | None:
    """The depth map inside a photo, upright as the photo itself is; None if it has none.

    In HEIC this reads an auxiliary depth image with Apple's XMP or HEVC's depth information; in JPEG, Apple's auxiliary
    pictures, Android's Dynamic Depth and the older GDepth. `DepthMap.note` says which format it was and how reliable
    the metres are. The picture itself is not decoded.

    Raises:
        InputError: the file is missing, or the photo's depth map is broken or shows another crop.
    """
    check_file(path, "photo")
    try:
        with reading(path, "cannot be read: {reason}", OSError), open(path, "rb") as file:
            start = file.read(8)
            jpeg = start.startswith(b"\xff\xd8\xff")
            data = start + file.read() if jpeg or start.endswith(b"ftyp") else b""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's warnings about untrusted bytes are of no use
            coded = _find_in_jpeg(data) if jpeg else _find_in_heif(data) if data else None
            return None if coded is None else _depth_map(coded, path)
    except BrokenDepth as error:
        advice = "give another one with --depth FILE, or use --base lite"
        raise InputError(f"{path}: the depth map in the photo {error}: {advice}") from error


def _depth_map(coded: CodedDepth, path: StrPath) -> DepthMap:
    photo_width, photo_height, photo_turn, focal = read_image(path, _photo_header)
    turn = coded.turn + photo_turn
    stored, quantum = coded.scale.decode(coded.codes, coded.full)
    depth = _turned(torch.from_numpy(stored), turn)
    height, width = depth.shape
    if abs(width * photo_height / (height * photo_width) - 1) > ASPECT_TOLERANCE:
        raise BrokenDepth(f"has {width}×{height} pixels but the photo {photo_width}×{photo_height}, another crop")
    columns, rows = coded.codes.shape[:: 1 if coded.turned.count("t") % 2 else -1]  # before the decoder's turn
    K = None if coded.lens is None else _intrinsics(coded.lens, columns, rows, coded.turned + turn)
    if coded.along_ray:
        own = Camera.from_focal(focal, photo_width, photo_height).resized(width, height)
        camera = own if K is None else Camera(K, torch.eye(4), width, height)
        rays = camera.unproject(camera.pixel_centers(), torch.ones(height, width))
        depth, quantum = depth / rays.square().sum(-1).sqrt(), None  # from the distance along a ray to z
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


def _photo_header(image: Image.Image) -> tuple[int, int, str, float]:
    """Upright width and height of the photo, the turn of its stored pixels, and its focal length in pixels."""
    turn, tags = "", {}
    with contextlib.suppress(Exception):  # unreadable EXIF says nothing about the orientation
        exif = image.getexif()
        tags = {**exif, **exif.get_ifd(_EXIF_IFD)}
        turn = BY_ORIENTATION.get(exif.get(_ORIENTATION, 1), "")
    width, height = image.size[:: -1 if "t" in turn else 1]
    focal = focal_from_exif(tags, width, height) or film_to_pixels(DEFAULT_FOCAL_MM, width, height)
    return width, height, turn, focal


@contextlib.contextmanager
def _decoding() -> Iterator[None]:
    """Turn every exception of a decoder into BrokenDepth."""
    try:
        yield
    except Exception as error:
        raise BrokenDepth(f"cannot be decoded ({reason_in_a_line(error)})") from error


def _read_codes(picture: bytes) -> tuple[Array, int]:
    """[H, W] values of a JPEG or PNG, and the highest value that its format has."""
    with _decoding(), Image.open(io.BytesIO(picture), formats=("JPEG", "PNG")) as image:
        check_pixels(*image.size, len(picture), "it")
        if image.mode.startswith("I"):
            return np.asarray(image).astype(np.uint16), 65535
        return np.asarray(image.convert("L")), 255


def _find_in_jpeg(data: bytes) -> CodedDepth | None:
    """Apple's depth map, recognised among the further pictures by its XMP, or else Android's; None without either."""
    if (image := open_jpeg(data)) is None:  # whoever decodes the photo will say what is wrong
        return None
    for begin, end in further_pictures(image):
        if (described := describe(xmp_of(open_jpeg(data[begin:end])))) is None:
            continue
        scale, lens, source = described
        if scale is None:
            raise BrokenDepth("does not say its range: FloatMinValue or FloatMaxValue is missing")
        if end > len(data):
            raise BrokenDepth("is cut off: the file ends before it does")
        return CodedDepth(*_read_codes(data[begin:end]), scale, source, lens)
    return _find_android(data, xmp_of(image), *extended_xmp_of(image))


PIXELS, DEPTH = "{http://ns.apple.com/pixeldatainfo/1.0/}", "{http://ns.apple.com/depthData/1.0/}"
# Core Video's formats of depth maps, half and full floats; any other is a matte, a gain map or a mask.
_FORMATS: dict[str, Quantity] = {"hdis": "disparity", "fdis": "disparity", "hdep": "depth", "fdep": "depth"}


def _is_about(packet: bytes, space: str) -> bool:
    return space.strip("{}").encode() in packet


def describe(packet: bytes) -> tuple[Scale | None, Lens | None, str] | None:
    """The depth scale (None without a range), lens and source stated by an XMP packet; None if it describes none."""
    if not _is_about(packet, PIXELS):
        return None
    tree = parse_xmp(packet)
    if (quantity := _quantity(tree)) is None:
        return None
    first, last, lowest, highest = (
        number(tree, f"{PIXELS}{name}Value") for name in ("FloatMin", "FloatMax", "IntMin", "IntMax")
    )
    scale = None if first is None or last is None else Scale(quantity, first, last, lowest or 0.0, highest)
    accuracy = find(tree, f"{DEPTH}Accuracy")
    source = f"Apple {quantity}, {accuracy if accuracy in ('absolute', 'relative') else 'of unknown accuracy'}"
    return scale, _apple_lens(tree), source


def _quantity(tree: Element) -> Quantity | None:
    native, kind = find(tree, f"{PIXELS}NativeFormat"), find(tree, f"{PIXELS}AuxiliaryImageType")
    if native is not None:
        if native.isascii() and native.isdigit() and len(native) <= 10:  # four characters, written as one number
            native = int(native).to_bytes(5, "big")[1:].decode("latin-1")
        return _FORMATS.get(native)
    if find(tree, f"{PIXELS}AuxiliaryImageSubType") is not None:  # the mattes: they too are of type "depth"
        return None
    return "disparity" if kind == "disparity" else "depth" if kind == "depth" else None


def _apple_lens(tree: Element) -> Lens | None:
    """The intrinsics, listed column by column; None if missing, because the map is usable without them."""
    entries = [entry.text or "" for matrix in tree.iter(f"{DEPTH}IntrinsicMatrix") for entry in matrix.iter(RDF_ITEM)]
    size = [find(tree, f"{DEPTH}IntrinsicMatrixReference{side}") or "" for side in ("Width", "Height")]
    with contextlib.suppress(ValueError):
        fx, _, _, _, fy, _, cx, cy, _ = map(float, entries)
        return fx, fy, cx, cy, float(size[0]), float(size[1])
    return None


GDEPTH = "{http://ns.google.com/photos/1.0/depthmap/}"
MAP, MODEL, ITEM = (f"{{http://ns.google.com/photos/dd/1.0/{name}/}}" for name in ("depthmap", "imagingmodel", "item"))
_UNITS_M = {"m": 1.0, "meter": 1.0, "meters": 1.0, "mm": 0.001, "millimeters": 0.001}
_PICTURE_STARTS = (b"\xff\xd8\xff", b"\x89PNG")


def _find_android(data: bytes, main: bytes, extended: bytes, complete: bool) -> CodedDepth | None:
    """The depth map that a JPEG's XMP (the main packet and its extension) holds or points to; None without one."""
    if not any(_is_about(packet, space) for space in (GDEPTH, MAP) for packet in (main, extended)):
        return None
    if not complete:
        raise BrokenDepth("is cut off: a part of the photo's extended XMP is missing")
    tree = parse_xmp(main)
    if extended:
        tree.append(parse_xmp(extended))
    for node in tree.iter():
        uri = get(node, f"{MAP}DepthURI")
        if uri is not None and (get(node, f"{MAP}ItemSemantic") or "Depth").lower() == "depth":
            return _coded(node, MAP, _item(data, tree, uri), "Dynamic Depth", _android_lens(tree))
    text = find(tree, f"{GDEPTH}Data")
    if text is None:  # editors may drop the extended XMP, and the depth with it, but leave the rest
        return None
    squeezed = "".join(text.split())
    with _decoding():
        picture = base64.b64decode(squeezed + "=" * (-len(squeezed) % 4), validate=True)
    return _coded(tree, GDEPTH, picture, "GDepth", None)


def _coded(node: Element, space: str, picture: bytes, layout: str, lens: Lens | None) -> CodedDepth:
    """Read a picture whose codes are linear, from near to far, in depth or in inverse depth."""
    near, far = number(node, f"{space}Near"), number(node, f"{space}Far")
    if near is None or far is None:
        raise BrokenDepth("does not say its range: Near or Far is missing")
    unit, style, measure = ((find(node, f"{space}{name}") or "").lower() for name in ("Units", "Format", "MeasureType"))
    # Pixel phones state diopters even for values that grow from near to far: the order counts, not the unit.
    diopters = unit == "diopters" and near > far
    known = unit in _UNITS_M or diopters
    near, far = (value * _UNITS_M.get(unit, 1.0) for value in (near, far))
    if style not in ("rangeinverse", "rangelinear"):
        raise BrokenDepth(f"has the format {style[:40]!r}: only RangeInverse and RangeLinear are read")
    inverse = style == "rangeinverse"
    if near == far or min(near, far) < 0 or (near > far) != diopters or (inverse and min(near, far) == 0):
        raise BrokenDepth(f"announces near {near:g} and far {far:g}, between which nothing can lie")
    if inverse:
        near, far = 1 / near, 1 / far
    scale = Scale("disparity" if inverse != diopters else "depth", near, far)
    source = f"{layout}, in {unit}" if known else f"{layout}, unit unknown"
    codes, full = _read_codes(picture)
    return CodedDepth(codes, full, scale, source, lens, along_ray=measure == "opticray", unit_known=known)


def _item(data: bytes, tree: Element, uri: str) -> bytes:
    """The bytes of an item in the photo's directory; items follow the primary picture in the directory's order."""
    entries = [node for node in tree.iter() if (get(node, f"{ITEM}Mime") or get(node, f"{ITEM}Length")) is not None]
    index = next((i for i, node in enumerate(entries) if get(node, f"{ITEM}DataURI") == uri), None)
    if index is None:
        raise BrokenDepth("is named by its XMP, but missing from the photo's directory of items")
    lengths, paddings = (
        [int(number(node, f"{ITEM}{name}") or 0) for node in entries] for name in ("Length", "Padding")
    )
    if min(lengths) < 0 or min(paddings) < 0:
        raise BrokenDepth("has a negative length in the photo's directory of items")
    length = lengths[index]
    places = [len(data) - sum(lengths[index:])]  # counted from the end
    if (end := end_of_picture(data)) is not None:
        # Writers disagree on whether lengths include paddings, and on the primary picture's length.
        behind = [0, *lengths[1:]]
        padded = [length + padding for length, padding in zip(behind, paddings, strict=True)]
        places = [end + sum(sizes[:index]) for sizes in (padded, behind)] + places
    for begin in places:
        end = begin + length if length else len(data)  # 0: to the end of the file
        if begin > 0 and end <= len(data) and data.startswith(_PICTURE_STARTS, begin):
            return data[begin:end]
    raise BrokenDepth("is cut off, or not where the photo's directory of items says")


def _android_lens(tree: Element) -> Lens | None:
    """The lens of the only imaging model; its centre may be stored relative to the picture's size, as specified."""
    models = [node for node in tree.iter() if get(node, f"{MODEL}FocalLengthX") is not None]
    names = ("FocalLengthX", "FocalLengthY", "PrincipalPointX", "PrincipalPointY", "ImageWidth", "ImageHeight")
    try:
        fx, fy, cx, cy, width, height = (number(models[0], f"{MODEL}{name}") for name in names)
    except (IndexError, BrokenDepth):  # the map is usable without a lens
        return None
    if len(models) > 1 or fx is None or fy is None or width is None or height is None:
        return None
    cx, cy = 0.5 if cx is None else cx, 0.5 if cy is None else cy
    if max(cx, cy) <= 1:
        cx, cy = cx * width, cy * height
    return fx, fy, cx, cy, width, height


FULL_CODES = {"L": 255, "I;10": 1023, "I;12": 4095}
ASSUMED = Scale("disparity", 0.1, 1.0)  # 10 m to 1 m: a portrait's usual range, if a file states none


def _find_in_heif(data: bytes) -> CodedDepth | None:
    """The auxiliary depth image of the primary picture, in any of the representations of HEVC's depth information."""
    import pillow_heif

    if (item := find_depth_item(data)) is None:
        return None
    alone, turned, turn = item
    with _decoding():
        image = pillow_heif.open_heif(io.BytesIO(data), hdr_to_16bit=False).info["depth_images"][0]
        width, height = image.size
        check_pixels(width, height, len(data), "it")
        codes, full = np.array(image), FULL_CODES[image.mode]  # already turned by the item's rotation
    packets = xmp_packets(data) if alone else ()
    scale, lens, source = next(filter(None, map(describe, packets)), (None, None, ""))
    if scale is None:  # Apple's XMP takes precedence over HEVC's range
        scale, source = _hevc_scale(image.info.get("metadata") or {})
    return CodedDepth(codes, full, scale, source, lens, turned, turn)


def _hevc_scale(stated: dict[str, Any]) -> tuple[Scale, str]:
    """The depth range that HEVC states, else the usual range of portraits; and its source, for the report."""
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
