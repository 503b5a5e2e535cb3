"""Pictures become sRGB: a file's colour statement, its depth, transparency and orientation.

`picture_to_srgb` is for a photo's file, `image_to_srgb` for a picture in memory.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from spackle.core.color_spaces import SRGB, ColorSpace, to_srgb
from spackle.core.deep_pictures import MAX_CODE, Codes, read_deep_codes
from spackle.core.heif_items import STEPS_OF_EXIF_ORIENTATION, HeifItems
from spackle.core.icc_profiles import (
    color_space_of_icc,
    convert_by_profile,
    convert_lab,
    is_srgb_profile,
)
from spackle.core.image_files import MAX_PIXELS, OpenPicture, upright
from spackle.core.image_formats import AVIF, HEIF
from spackle.core.stated_colors import StatedColors, read_stated_colors
from spackle.core.tiff_directories import BITS_PER_SAMPLE, ORIENTATION, PHOTOMETRIC
from spackle.runtime.errors import InputError

StrPath = str | os.PathLike[str]
WHITE_IS_ZERO = 0  # the value of a TIFF's tag PHOTOMETRIC for negatives


@dataclasses.dataclass(frozen=True)
class SrgbPicture:
    """An upright picture in sRGB."""

    rgb: Tensor  # [H, W, 3] float32 in 0..1; transparency has become white
    notes: tuple[str, ...]  # what the user should know about its colours


def picture_to_srgb(
    picture: OpenPicture, path: StrPath, max_side: int | None = None
) -> SrgbPicture:
    """A photo's pixels, decoded from its open file: in sRGB, and upright.

    Args:
        picture: the open file.
        path: its name in messages.
        max_side: if given, the result is smaller than the file's picture: its long side has at most
            so many pixels. For previews, because converting takes more memory than decoding.

    Raises:
        InputError: pixels of 32 bits, whose range is unknown, or a picture of another size than the
            file says.
        Exception: any of a decoder's, for a damaged file.
    """
    image = picture.image
    stated = read_stated_colors(image, picture.exif, picture.kind, picture.file)
    codes, depth_note = _deep_codes(picture, stated)
    if codes is None:
        # Pillow decodes 8 bits.
        image.load()
        _check_decoded_size(picture, path)
        if max_side is not None:
            image.thumbnail((max_side, max_side))
        result = image_to_srgb(image, stated, picture.exif, path)
    else:
        if max_side is not None:
            # Every n-th row and column, as few as it takes.
            step = max(1, math.ceil(max(codes.shape[:2]) / max_side))
            codes = np.ascontiguousarray(codes[::step, ::step])
        rgb = _codes_to_srgb(codes, stated)
        # HEIF is upright already.
        if picture.kind is not HEIF:
            rgb = _turned(rgb, picture.exif.get(ORIENTATION))
        result = SrgbPicture(rgb, _color_notes(stated))
    return dataclasses.replace(result, notes=(*result.notes, *depth_note))


def _deep_codes(picture: OpenPicture, stated: StatedColors) -> tuple[Codes | None, tuple[str, ...]]:
    """The picture with more than 8 bits a channel, and what to say about its depth.

    None if it has 8 bits, or if only 8 bits of it can be used.
    """
    # LittleCMS, which reads all profiles, takes 8 bits from Pillow.
    if stated.icc is not None and color_space_of_icc(stated.icc) is None:
        return None, ()
    try:
        codes = read_deep_codes(picture.image, picture.kind, picture.file, MAX_PIXELS)
    except Exception:  # a damaged file, about which Pillow will say more, or a rare layout
        return None, ("only 8 bits of its colours' depth are used",)
    return codes, ()


def _check_decoded_size(picture: OpenPicture, path: StrPath) -> None:
    """InputError if a HEIF or AVIF was decoded to another size than it states."""
    if picture.kind not in (HEIF, AVIF):
        return
    picture.file.seek(0)
    items = HeifItems.of(picture.file.read())
    stated_size = None if items is None else items.size(items.primary)
    # A picture that is cropped (`clap`) has another size, which is not stated.
    if items is None or stated_size is None or items.property(items.primary, b"clap"):
        return
    size = picture.image.size
    # HEIF is decoded upright, AVIF as stored.
    if size not in (stated_size, stated_size[::-1]):
        raise InputError(
            f"{path}: decoded as {size[0]}×{size[1]}, but the file says "
            f"{stated_size[0]}×{stated_size[1]}: export a JPEG"
        )


def image_to_srgb(
    image: Image.Image, stated: StatedColors, exif: Mapping[int, object], path: StrPath
) -> SrgbPicture:
    """An image of any of Pillow's modes, in sRGB and upright.

    Args:
        image: the image.
        stated: what its file says about its colours.
        exif: its tags, by number.
        path: its name in messages.

    Raises:
        InputError: pixels of 32 bits, whose range is unknown.
    """
    image = upright(image)
    notes = _color_notes(stated)
    is_deep_grey = image.mode in ("F", "I") or image.mode.startswith("I;16")  # over 8 bits
    if is_deep_grey:
        codes, max_code = _deep_grey_codes(image, exif, path)
        space = _space_for_codes(stated)
        return SrgbPicture(to_srgb(np.repeat(codes[..., None], 3, axis=2), max_code, space), notes)

    # Colours that the file states by numbers. An ICC profile is applied below, by LittleCMS.
    if stated.icc is None and not stated.space.is_srgb:
        codes, alpha = _codes_and_alpha(image)
        return SrgbPicture(_over_white(to_srgb(codes, 255, stated.space), alpha), notes)

    if image.has_transparency_data:
        image = image.convert("RGBA")
        white = Image.new("RGBA", image.size, "white")
        image = Image.alpha_composite(white, image).convert("RGB")
    elif image.mode not in ("RGB", "L", "CMYK", "LAB"):
        # Those modes stay until the profile is applied, because it describes them.
        image = image.convert("RGB")
    converted, note = _apply_profile(image, stated.icc)
    rgb = torch.from_numpy(np.array(converted)).float().div_(255)
    return SrgbPicture(rgb, (*notes, *note))


def _color_notes(stated: StatedColors) -> tuple[str, ...]:
    """What to say about a statement that had to be guessed, or about HDR."""
    notes: tuple[str, ...] = (stated.note,) if stated.note else ()
    if stated.icc is None and stated.space.transfer.is_hdr:
        notes += (f"its HDR colours ({stated.space.name}) become sRGB",)
    return notes


def _apply_profile(
    image: Image.Image, profile: bytes | None
) -> tuple[Image.Image, tuple[str, ...]]:
    """The image as RGB in sRGB, and what to say if its profile cannot be used.

    Args:
        image: in one of the modes RGB, L, CMYK and LAB.
        profile: its ICC profile; None without.
    """
    notes: tuple[str, ...] = ()
    converted = None
    if profile is not None and not is_srgb_profile(profile):
        converted = convert_by_profile(image, profile)
        if converted is None:
            notes = ("its ICC profile is damaged or made for other colours, and is not used",)
    elif image.mode == "CMYK":
        notes = ("it is CMYK without an ICC profile, so its colours are approximate",)
    if converted is None and image.mode == "LAB":
        converted = convert_lab(image)
    return (converted or image).convert("RGB"), notes


# --- Codes


def _space_for_codes(stated: StatedColors) -> ColorSpace:
    """The colour space of a deep picture; sRGB if its profile cannot be used by formula."""
    if stated.icc is None:
        return stated.space
    if is_srgb_profile(stated.icc):
        return SRGB
    return color_space_of_icc(stated.icc) or SRGB


def _codes_to_srgb(codes: Codes, stated: StatedColors) -> Tensor:
    """[H, W, 3] sRGB of codes [H, W, 3 or 4]; transparency becomes white."""
    alpha = codes[..., 3].astype(np.float32) / MAX_CODE if codes.shape[2] == 4 else None
    colors = np.ascontiguousarray(codes[..., :3])
    return _over_white(to_srgb(colors, MAX_CODE, _space_for_codes(stated)), alpha)


def _codes_and_alpha(image: Image.Image) -> tuple[np.ndarray, np.ndarray | None]:
    """[H, W, 3] uint8 of an image, and its opacity [H, W] in 0..1; None if it is opaque."""
    alpha = None
    if image.has_transparency_data:
        image = image.convert("RGBA")
        alpha = np.asarray(image.getchannel("A"), np.float32) / 255
    return np.asarray(image.convert("RGB")), alpha


def _over_white(rgb: Tensor, alpha: np.ndarray | None) -> Tensor:
    """Colours [H, W, 3] in sRGB over white, for an opacity [H, W] in 0..1; None: all is opaque."""
    if alpha is None:
        return rgb
    opacity = torch.from_numpy(np.ascontiguousarray(alpha))[..., None]
    return rgb * opacity + (1 - opacity)


def _deep_grey_codes(
    image: Image.Image, exif: Mapping[int, object], path: StrPath
) -> tuple[np.ndarray, int]:
    """[H, W] uint16 of a grey image of over 8 bits, and its highest code.

    InputError for 32 bits.
    """
    values = np.asarray(image)  # [H, W]
    # Pillow opens some images of 16 bits in the mode of 32 bits, so the values decide.
    is_32_bit = image.mode == "F" or values.min() < 0 or values.max() > MAX_CODE
    if is_32_bit:
        raise InputError(f"{path}: pixels of 32 bits: save the photo with 8 or 16 bits per channel")

    # Pillow leaves the codes of a TIFF as they are: of 12 bits, and of a negative.
    max_code = MAX_CODE
    if exif.get(BITS_PER_SAMPLE) in (12, (12,)):
        max_code = 4095
    if exif.get(PHOTOMETRIC) == WHITE_IS_ZERO:
        values = max_code - values
    return values.astype(np.uint16), max_code


def _turned(rgb: Tensor, orientation: object) -> Tensor:
    """A picture [H, W, 3] turned upright for EXIF's number of its orientation."""
    steps = STEPS_OF_EXIF_ORIENTATION.get(orientation, "") if isinstance(orientation, int) else ""
    for step in steps:
        # Axis 0 runs from top to bottom, axis 1 from left to right.
        rgb = rgb.transpose(0, 1) if step == "t" else rgb.flip(1 if step == "x" else 0)
    return rgb.contiguous()
