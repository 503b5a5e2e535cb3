"""Open image files that strangers made: limits of memory, orientation, transparency, colours.

`read_image` opens a file; `upright`, `exif_tags` and `to_srgb_tensor` are for its callback.
"""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import pillow_heif
import torch
from PIL import Image, ImageCms, ImageOps, UnidentifiedImageError
from torch import Tensor

from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file

T = TypeVar("T")
pillow_heif.register_heif_opener()

MAX_PIXELS = 100_000_000  # a larger image would take more than a gigabyte as float32

# A tiny file may claim a huge image. Beyond a size that every computer bears, the number of pixels
# must fit the file: a strongly compressed photo has 20 pixels for each byte.
HARMLESS_PIXELS = 32_000_000
MAX_PIXELS_PER_BYTE = 32

MAX_UINT16 = 65535
_EXIF_DIRECTORY = 0x8769  # the tag that points to the directory with the camera's settings


class _BoundedFile(io.BufferedReader):
    """A file that allocates no more than its size, even if a PNG chunk claims 4 GB."""

    def __init__(self, raw: io.FileIO) -> None:
        super().__init__(raw)
        self.size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """Read up to `size` bytes, or the rest of the file if `size` is None or negative."""
        if size is None:
            return super().read()
        remaining = max(0, self.size - self.tell())
        return super().read(min(size, remaining))


def read_image(path: str | os.PathLike[str], read: Callable[[Image.Image], T]) -> T:
    """Open an image file and return `read(image)`; the file is closed afterwards.

    Raises:
        InputError: the file is missing, damaged, no image, or has more than 100 megapixels.
    """
    check_file(path, "photo")
    with (
        as_input_error(path, "cannot be decoded ({reason}): the file is damaged or cut off"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # about broken EXIF
        try:
            with _BoundedFile(open(path, "rb", buffering=0)) as file, Image.open(file) as image:
                check_pixel_count(image.width, image.height, file.size, path)
                return read(image)
        except Image.DecompressionBombError:
            raise InputError(f"{path}: more than 100 megapixels: shrink the image first") from None
        except UnidentifiedImageError:
            raise InputError(
                f"{path}: not an image of a known format: give a JPEG, PNG, WebP, HEIC or TIFF"
            ) from None


def check_pixel_count(width: int, height: int, size: int, path: str | os.PathLike[str]) -> None:
    """Raise an InputError if a width×height image in a file of `size` bytes needs too much memory.

    `path` is the file's name for the message.
    """
    max_pixels = min(MAX_PIXELS, max(HARMLESS_PIXELS, MAX_PIXELS_PER_BYTE * size))
    if width * height > max_pixels:
        limit = f"at most {max_pixels // 10**6} megapixels in {size:,} bytes"
        raise InputError(f"{path}: {width}×{height} is too large ({limit}): shrink the image first")


def upright(image: Image.Image) -> Image.Image:
    """The image, turned as its EXIF orientation asks; unchanged if EXIF cannot be read."""
    try:
        return ImageOps.exif_transpose(image)
    except Exception:  # a stranger's EXIF can raise anything
        return image


def exif_tags(image: Image.Image) -> dict[int, object]:
    """All EXIF tags of an image, by number: of the image and of the camera; empty if broken."""
    try:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(_EXIF_DIRECTORY)}
    except Exception:  # a stranger's EXIF can raise anything
        return {}


def to_srgb_tensor(image: Image.Image, path: str | os.PathLike[str]) -> Tensor:
    """Convert an image of any mode to [H, W, 3] float32 sRGB in 0..1; transparency becomes white.

    Raises:
        InputError: pixels of 32 bits, whose range is unknown; `path` is the name in the message.
    """
    is_deep_grey = image.mode in ("F", "I") or image.mode.startswith("I;16")  # over 8 bits
    if is_deep_grey:
        return _deep_grey_to_tensor(image, path)

    # Conversions of the mode lose the profile, so it is fetched first.
    profile = image.info.get("icc_profile")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        white = Image.new("RGBA", image.size, "white")
        image = Image.alpha_composite(white, image).convert("RGB")
    elif image.mode not in ("RGB", "L", "CMYK"):  # the modes that have colour profiles
        image = image.convert("RGB")
    image = _apply_colour_profile(image, profile).convert("RGB")
    return torch.from_numpy(np.array(image)).float().div_(255)


def _deep_grey_to_tensor(image: Image.Image, path: str | os.PathLike[str]) -> Tensor:
    """Convert a grey image of 16 bits to [H, W, 3] float32 in 0..1; InputError for 32 bits."""
    values = np.asarray(image)  # [H, W]
    # Pillow opens some images of 16 bits in the mode of 32 bits, so the values decide.
    is_32_bit = image.mode == "F" or values.min() < 0 or values.max() > MAX_UINT16
    if is_32_bit:
        raise InputError(f"{path}: pixels of 32 bits: save the photo with 8 or 16 bits per channel")
    grey = torch.from_numpy(values.astype(np.float32)).div_(MAX_UINT16)
    return grey[..., None].expand(-1, -1, 3).contiguous()


def _apply_colour_profile(image: Image.Image, profile: bytes | None) -> Image.Image:
    """Convert an image from its embedded ICC profile to sRGB.

    Without a profile, or with one that is broken or made for another mode, the image is unchanged.
    """
    if not profile:
        return image
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "sRGB" in ImageCms.getProfileDescription(source):
            return image
        target = ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(image, source, target, outputMode="RGB") or image
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return image
