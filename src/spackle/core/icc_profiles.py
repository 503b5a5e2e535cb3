"""ICC profiles: by LittleCMS for pictures of 8 bits, by formula for deeper ones.

Most profiles of photos consist of three primaries and three curves, which become a `ColorSpace`.
LittleCMS, as Pillow offers it, reads all profiles, but only pictures of 8 bits.
"""

from __future__ import annotations

import io
import re
import struct

import numpy as np
from PIL import Image, ImageCms

from spackle.core.color_spaces import (
    D50_XYZ,
    SRGB,
    ColorSpace,
    Floats,
    Transfer,
    color_space_of_cicp,
)

MAX_TAGS = 100  # a profile has a dozen
SAME_LIGHT = 0.005  # curves that differ by less are rounded differently
CURVE_SAMPLES = 256  # where two curves are compared
# The numbers that each of the five kinds of parametric curves has, by their names in `_parametric`.
_PARAMETER_NAMES = ("g", "gab", "gabe", "gabcd", "gabcdef")
Curve = tuple[Floats, Floats]  # positions in 0..1, increasing, and the light there


def color_space_of_icc(profile: bytes) -> ColorSpace | None:
    """The colour space of a profile that consists of primaries and curves; None for any other.

    A profile for grey pictures has one curve, and gets the primaries of sRGB.
    """
    try:
        tags = _tags(profile)
        kind = profile[16:20]  # what the numbers of a picture are
        # Tables ("A2B0", …), or a connection space (bytes 20 to 23) other than X, Y, Z, are more
        # than primaries and curves.
        has_tables = any(name in tags for name in (b"A2B0", b"A2B1", b"A2B2"))
        if has_tables or profile[20:24] != b"XYZ ":
            return None
        if kind == b"GRAY":
            curves = [_curve(tags[b"kTRC"])] * 3
            to_xyz = SRGB.to_xyz
        elif kind == b"RGB ":
            curves = [_curve(tags[name]) for name in (b"rTRC", b"gTRC", b"bTRC")]
            to_xyz = np.stack([_xyz(tags[name]) for name in (b"rXYZ", b"gXYZ", b"bXYZ")], axis=1)
        else:
            return None
        # A profile whose primaries do not make its white is broken, or uses them otherwise.
        if np.abs(to_xyz.sum(axis=1) - D50_XYZ).max() > 0.05:
            return None
    except (struct.error, KeyError, ValueError, IndexError):
        return None
    transfer = Transfer("ICC", lambda code: np.stack([np.interp(code, *curve) for curve in curves]))
    return ColorSpace("ICC profile", transfer, to_xyz, to_xyz[1])


def is_srgb_profile(profile: bytes) -> bool:
    """Whether a profile says what sRGB says, so that nothing is to be converted.

    A profile that does not consist of primaries and curves is judged by its name.
    """
    space = color_space_of_icc(profile)
    if space is None:
        return "sRGB" in _description(profile)
    numbers = np.linspace(0, 1, CURVE_SAMPLES)
    light_difference = np.abs(space.transfer.decode(numbers) - SRGB.transfer.decode(numbers)).max()
    primaries_difference = np.abs(space.to_xyz - SRGB.to_xyz).max()
    return bool(max(light_difference, primaries_difference) < SAME_LIGHT)


# Names of HDR profiles, such as "Rec. ITU-R BT.2100 PQ" and "Rec2100HLG".
_HDR_NAME = re.compile(r"2100\W*(PQ|HLG)\b", re.IGNORECASE)
_BT2020_CICP = 9
_CICP_OF_NAME = {"PQ": 16, "HLG": 18}


def hdr_space_of_icc(profile: bytes) -> ColorSpace | None:
    """The colour space of a profile for PQ or HLG; None for any other.

    A profile's curves have no light above white. So a profile for HDR has a tag `cicp`, which says
    what the numbers are; older ones only have a name.
    """
    try:
        tag = _tags(profile).get(b"cicp", b"")
        if len(tag) >= 12:
            # The type (4 bytes), 4 zeros, then the numbers of CICP.
            primaries, transfer, _, full_range = tag[8:12]
            space = color_space_of_cicp(primaries, transfer, is_full_range=bool(full_range))
            return space if space.transfer.is_hdr else None
    except (struct.error, ValueError):
        return None
    name = _HDR_NAME.search(_description(profile))
    if name is None:
        return None
    return color_space_of_cicp(_BT2020_CICP, _CICP_OF_NAME[name[1].upper()])


def convert_by_profile(image: Image.Image, profile: bytes) -> Image.Image | None:
    """The image in sRGB, converted by LittleCMS; None if the profile is broken or does not fit it.

    Args:
        image: in one of the modes RGB, L, CMYK and LAB.
        profile: the ICC profile.
    """
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        target = ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(image, source, target, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return None


def convert_lab(image: Image.Image) -> Image.Image | None:
    """An image in CIE L*a*b* (of D50, as TIFF defines it) in sRGB; None if it cannot be."""
    try:
        source = ImageCms.createProfile("LAB")
        target = ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(image, source, target, outputMode="RGB")
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return None


def _description(profile: bytes) -> str:
    """The name of a profile; empty if it is broken."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        return ImageCms.getProfileDescription(source)
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return ""


def _tags(profile: bytes) -> dict[bytes, bytes]:
    """The tags of a profile with their content; struct.error if it is cut off."""
    # Behind the header of 128 bytes: the count of tags, then the name, place and size of each.
    (count,) = struct.unpack_from(">I", profile, 128)
    tags: dict[bytes, bytes] = {}
    for index in range(min(count, MAX_TAGS)):
        name, place, size = struct.unpack_from(">4sII", profile, 132 + 12 * index)
        tags[name] = profile[place : place + size]
    return tags


def _xyz(tag: bytes) -> Floats:
    """[3]: the X, Y, Z of a tag; ValueError for another kind of tag."""
    if tag[:4] != b"XYZ ":
        raise ValueError("no XYZ")
    return np.array(struct.unpack_from(">3i", tag, 8)) / 65536  # fractions of 2^16


def _curve(tag: bytes) -> Curve:
    """The curve of a tag, from a number to light; ValueError for another kind of tag."""
    kind = tag[:4]
    if kind == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:  # no entry: light is the number itself
            return np.array([0.0, 1.0]), np.array([0.0, 1.0])
        if count == 1:  # one entry: an exponent as a fraction of 2^8
            return _sampled_power(struct.unpack_from(">H", tag, 12)[0] / 256)
        light = np.frombuffer(tag, ">u2", count, 12) / 65535
        return np.linspace(0, 1, count), light
    if kind == b"para":
        return _parametric(tag)
    raise ValueError("no curve")


def _sampled_power(gamma: float) -> Curve:
    """The curve light = number ** gamma at the numbers that a picture of 16 bits can have."""
    numbers = np.linspace(0, 1, 65536)
    return numbers, numbers**gamma


def _parametric(tag: bytes) -> Curve:
    """The curve of a tag `para`: light is (a·x + b)^g + e where x ≥ d, else c·x + f.

    The names are those of ICC's specification.
    """
    (kind,) = struct.unpack_from(">H", tag, 8)
    names = _PARAMETER_NAMES[kind]
    values = np.array(struct.unpack_from(f">{len(names)}i", tag, 12)) / 65536
    given = dict(zip(names, values.tolist(), strict=True))

    # What a kind does not have follows: the line ends where the power begins, and has its offset.
    g = given["g"]
    a = given.get("a", 1.0)
    b = given.get("b", 0.0)
    c = given.get("c", 0.0)
    d = given.get("d", -b / a if a else 0.0)
    e = given.get("e", 0.0)
    f = given.get("f", e)
    numbers = np.linspace(0, 1, 65536)
    power = np.maximum(a * numbers + b, 0) ** g + e
    light = np.where(numbers >= d, power, c * numbers + f)
    if not np.isfinite(light).all():
        raise ValueError("a curve that is not finite")
    return numbers, np.clip(light, 0, 1)
