"""Refuse photos that are no perspective pictures: 360° photos, panoramas, fisheyes.

Everything after this takes straight lines for straight. In a 360° photo or a fisheye they are
curved, and the scene would be bent without a word.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np
from PIL import Image
from torch import Tensor

from spackle.core.photo_containers import find_number, find_property, parse_xmp
from spackle.core.tiff_directories import MAKE, MODEL
from spackle.core.tiff_directories import XMP as TAG_XMP
from spackle.runtime.errors import InputError

_GPANO = "{http://ns.google.com/photos/1.0/panorama/}"  # Google's names, which all makers use
_LENS_PROPERTIES = (  # of XMP
    "{http://ns.adobe.com/exif/1.0/aux/}Lens",
    "{http://cipa.jp/exif/1.0/}LensModel",
)
_CORRECTED_PROPERTIES = (  # of XMP: Adobe's programs have straightened the lines
    "{http://ns.adobe.com/camera-raw-settings/1.0/}LensProfileEnable",
    "{http://ns.adobe.com/camera-raw-settings/1.0/}AlreadyApplied",
)
# Drones of Parrot, and cameras for surveys, name the lens's model.
_CAMERA_MODEL_NAME = re.compile(rb"ModelType\s*(?:=\s*[\"']|>)\s*fisheye", re.IGNORECASE)
_FISHEYE_NAME = re.compile(r"fish.?eye", re.IGNORECASE)
# Cameras whose pictures are 360° photos if they are twice as wide as high.
_CAMERAS_OF_360 = re.compile(
    r"ricoh theta|insta360|gear ?360|sm-[cr]2[01]0|keymission 360|virb 360|gopro (max|fusion)"
    r"|mi sphere|lg-r105|360 ?(fly|cam|vr)|vuze|qoocam|kandao|madv|xphase|trisio|garmin virb 360"
    r"|labpano|pilot era|detu|rylo|xdv360",
    re.IGNORECASE,
)
_TAG_CUSTOM_RENDERED = 0xA401
_APPLE_PANORAMA = 6  # its value for the panoramas of iPhones
_TAG_LENS_MODEL = 0xA434

ADVICE = (
    "cut a flat view out of it first, at most 100° wide (a panorama viewer does it; "
    "docs/inputs.md has a command)"
)

# A 360° photo whose metadata is lost is known by its pixels: its first and last column are
# neighbours, and its first and last row are one point each.
MIN_WIDTH_360 = 1000  # a smaller one is a thumbnail
MAX_SEAM_RATIO = 2.0  # difference of first and last column, over that of neighbouring columns
MAX_POLE_RATIO = 0.15  # contrast along the first and the last row, over that of the middle rows
MIN_CONTRAST = 0.02  # of the seam's column; less is a frame or a blank picture


def refuse_other_projections(
    path: str | os.PathLike[str],
    exif: Mapping[int, object],
    xmp: bytes,
    width: int,
    height: int,
) -> None:
    """Raise an InputError for a photo that is a 360° photo, a panorama or a fisheye.

    Args:
        path: the photo's file, for the message.
        exif: its tags, by number.
        xmp: its packet of XMP; empty if it has none.
        width: of the picture in pixels.
        height: of the picture in pixels.
    """
    projection = _projection_of_xmp(xmp)
    if projection is not None:
        raise InputError(f"{path}: a panorama ({projection}): {ADVICE}")

    camera = f"{exif.get(MAKE, '')} {exif.get(MODEL, '')}"
    if width == 2 * height and _CAMERAS_OF_360.search(camera):
        raise InputError(f"{path}: a 360° panorama (of a {camera.strip()}): {ADVICE}")
    is_apple = str(exif.get(MAKE, "")).startswith("Apple")
    if is_apple and exif.get(_TAG_CUSTOM_RENDERED) == _APPLE_PANORAMA:
        raise InputError(f"{path}: a panorama (cylindrical, of an iPhone): {ADVICE}")

    lens = _fisheye_lens(exif, xmp)
    if lens is not None:
        raise InputError(
            f"{path}: taken with a fisheye ({lens}): correct the lens in a photo editor first, or "
            + ADVICE
        )


def _projection_of_xmp(xmp: bytes) -> str | None:
    """Which projection XMP states, as words for the brackets of the message "a panorama (…)".

    Such as "cylindrical" or "equirectangular, 180° of 360°". None for a flat picture, or if no
    projection is stated.
    """
    # Most photos do not name the namespace of panoramas, and need not be parsed.
    if _GPANO.strip("{}").encode() not in xmp:
        return None
    try:
        tree = parse_xmp(xmp)
        projection = (find_property(tree, f"{_GPANO}ProjectionType") or "").lower()
        if projection == "rectilinear":
            return None
        full_width = find_number(tree, f"{_GPANO}FullPanoWidthPixels")
        cropped_width = find_number(tree, f"{_GPANO}CroppedAreaImageWidthPixels")
    except (ElementTree.ParseError, ValueError):
        return "of a broken description"  # in the message: "a panorama (of a broken description)"
    # Google's other entries, such as the number of photos, stand in ordinary photos, too.
    if not projection and full_width is None:
        return None
    name = projection[:40] or "equirectangular"  # the usual one, where only the size is stated
    if full_width is None or cropped_width is None or not 0 < cropped_width < full_width:
        return f"{name}, 360°" if name == "equirectangular" else name
    return f"{name}, {360 * cropped_width / full_width:.0f}° of 360°"


def _fisheye_lens(exif: Mapping[int, object], xmp: bytes) -> str | None:
    """The fisheye with which a photo was taken, as words for the message "a fisheye (…)".

    That is the name of the lens in EXIF or XMP. None for other lenses, and for a picture whose
    lines were straightened.
    """
    if _CAMERA_MODEL_NAME.search(xmp):
        return "its XMP says so"  # XMP states the kind of lens, not its name
    names = [str(exif.get(_TAG_LENS_MODEL, ""))]
    is_corrected = False
    try:
        tree = parse_xmp(xmp) if xmp else None
    except ElementTree.ParseError:
        tree = None
    if tree is not None:
        names += [find_property(tree, name) or "" for name in _LENS_PROPERTIES]
        is_corrected = all(
            (find_property(tree, name) or "").lower() in ("1", "true")
            for name in _CORRECTED_PROPERTIES
        )
    if is_corrected:
        return None
    for name in names:
        if _FISHEYE_NAME.search(name):
            return name[:60]
    return None


def looks_like_360(rgb: Tensor) -> bool:
    """Whether the pixels of a picture [H, W, 3] in 0..1 are those of a whole 360° photo."""
    height, width = rgb.shape[:2]
    if width != 2 * height or width < MIN_WIDTH_360:
        return False
    pixels = rgb.numpy()

    # The left and the right border of a 360° photo meet, so they differ as little as neighbouring
    # columns. The step of 8 bits (1 / 255) is for a photo whose neighbouring columns are equal.
    first_column = pixels[:, 0]
    neighbour_difference = float(np.abs(first_column - pixels[:, 1]).mean())
    seam_difference = float(np.abs(first_column - pixels[:, -1]).mean())
    is_closed = seam_difference <= MAX_SEAM_RATIO * neighbour_difference + 1 / 255

    # The first and the last row show a single point each, straight up and straight down. They have
    # much less contrast than rows in the middle third, of which every 16th is enough.
    middle_contrast = float(pixels[height // 3 : -height // 3 : 16].std(axis=1).mean())
    pole_contrast = float(pixels[[0, -1]].std(axis=1).max())
    has_poles = pole_contrast <= MAX_POLE_RATIO * middle_contrast

    # In a column without contrast, such as a white margin, the first test says nothing.
    return is_closed and has_poles and float(first_column.std()) > MIN_CONTRAST


def xmp_of_image(image: Image.Image, exif: Mapping[int, object]) -> bytes:
    """The packet of XMP that Pillow found in a picture; empty if there is none."""
    # Where Pillow keeps it depends on the format: that of JPEG and WebP, of PNG, and of TIFF.
    for packet in (
        image.info.get("xmp"),
        image.info.get("XML:com.adobe.xmp"),
        exif.get(TAG_XMP),
    ):
        if isinstance(packet, str):
            return packet.encode()
        if isinstance(packet, bytes):
            return packet
        if isinstance(packet, tuple):  # bytes as numbers, as TIFF stores them
            return bytes(number & 0xFF for number in packet if isinstance(number, int))

    # ImageMagick writes it into PNGs as text: a line "xmp", one with the length, then hex numbers.
    profile = image.info.get("Raw profile type xmp")
    if isinstance(profile, str):
        lines = profile.split("\n", 3)
        with contextlib.suppress(ValueError):
            return bytes.fromhex(lines[-1])
    return b""
