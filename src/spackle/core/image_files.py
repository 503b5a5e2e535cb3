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
_ORIENTATION_TAG = 0x0112  # of EXIF
_SIDEWAYS_ORIENTATIONS = (5, 6, 7, 8)  # with rows and columns swapped
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
            # A bounded file never allocates more than its size, whatever a broken image claims. It
            # has a buffer of its own, so the file below it needs none.
            with _BoundedFile(open(path, "rb", buffering=0)) as file, Image.open(file) as image:
                check_pixel_count(image.width, image.height, file.size, path)
                return read(image)
        except Image.DecompressionBombError:
            raise InputError(f"{path}: more than 100 megapixels: shrink the image first") from None
        except UnidentifiedImageError:
            raise InputError(
                f"{path}: not an image of a known format: give a JPEG, PNG, WebP, HEIC or TIFF"
            ) from None


def check_pixel_count(
    width: int, height: int, file_bytes: int | None, path: str | os.PathLike[str]
) -> None:
    """Raise an InputError if an image has so many pixels that it would need too much memory.

    Args:
        width: of the image in pixels.
        height: of the image in pixels.
        file_bytes: size of the image's file. A tiny file that claims a huge image is broken or
            malicious, so a large image must have a large file. None: the image is in memory.
        path: the file's name, for the message.
    """
    if file_bytes is None:
        max_pixels = MAX_PIXELS
    else:
        # Up to a size that every computer bears, the file may be as small as it likes.
        max_pixels = min(MAX_PIXELS, max(HARMLESS_PIXELS, MAX_PIXELS_PER_BYTE * file_bytes))

    if width * height > max_pixels:
        limit = f"at most {max_pixels // 10**6} megapixels"
        if file_bytes is not None:
            limit += f" in {file_bytes:,} bytes"
        raise InputError(f"{path}: {width}×{height} is too large ({limit}): shrink the image first")


def upright(image: Image.Image) -> Image.Image:
    """The image, turned as its EXIF orientation asks; unchanged if EXIF cannot be read."""
    try:
        return ImageOps.exif_transpose(image)
    except Exception:  # a stranger's EXIF can raise anything
        return image


def upright_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """(width, height) in pixels of an image file, turned as its EXIF orientation asks.

    Only the header is read. InputError if the file is missing, damaged, no image, or too large.
    """

    def read_size(image: Image.Image) -> tuple[int, int]:
        """The size of the turned image."""
        width, height = image.size
        orientation = exif_tags(image).get(_ORIENTATION_TAG)
        return (height, width) if orientation in _SIDEWAYS_ORIENTATIONS else (width, height)

    return read_image(path, read_size)


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

    # The colour profile is fetched now, because converting the mode loses it.
    profile = image.info.get("icc_profile")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        white = Image.new("RGBA", image.size, "white")
        image = Image.alpha_composite(white, image).convert("RGB")
    elif image.mode not in ("RGB", "L", "CMYK"):
        # Those three modes stay until the profile is applied, because it describes them.
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
        converted = ImageCms.profileToProfile(image, source, target, outputMode="RGB")
        return converted or image  # never None here, but Pillow's types allow it
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError):
        return image
