"""Open image files that strangers made: which decoder is tried, which picture, limits of memory.

`read_picture` opens a photo; `read_image` gives Pillow's image of it alone. `srgb_pictures.py`
turns it into colours.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import os
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO, TypeVar

import pillow_heif
from PIL import Image, ImageOps, UnidentifiedImageError

from spackle.core.heif_items import HeifItems
from spackle.core.image_formats import (
    AVIF,
    EXPORT_ADVICE,
    HEAD_BYTES,
    HEIF,
    JPEG,
    RAW,
    TIFF,
    FileKind,
    kind_of_bytes,
    not_a_photo,
)
from spackle.core.raw_previews import RawFile, orientation_of, read_raw_file
from spackle.core.tiff_directories import (
    EXIF_DIRECTORY,
    INTEROPERABILITY_DIRECTORY,
    ORIENTATION,
    SIDEWAYS_ORIENTATIONS,
    read_directories,
    tiff_from_directory,
)
from spackle.runtime.errors import InputError, as_input_error, with_detached_errors
from spackle.runtime.files import check_file

T = TypeVar("T")
pillow_heif.register_heif_opener()

MAX_PIXELS = 100_000_000  # a larger image would take more than a gigabyte as float32

# A tiny file may claim a huge image. Beyond a size that every computer bears, the number of pixels
# must fit the file: a strongly compressed photo has 20 pixels for each byte.
HARMLESS_PIXELS = 32_000_000
MAX_PIXELS_PER_BYTE = 32

# A progressive JPEG goes over its pixels again with each scan, and a scan may be a few bytes: a
# megabyte of them takes a minute. Photos have ten, so the largest ones have a billion pixels to go
# over. Twice as many take two seconds.
MAX_SCANNED_PIXELS = 2_000_000_000
# A marker of a JPEG: any byte after 0xFF but those that stand for a 0xFF among a picture's bits,
# and those that only divide these bits.
JPEG_MARKER = re.compile(rb"\xff([^\x00\xd0-\xd7\xff])")
START_OF_JPEG = 0xD8
START_OF_SCAN = 0xDA
END_OF_JPEG = 0xD9


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


def open_image(file: BinaryIO | Path, formats: tuple[str, ...]) -> Image.Image:
    """The image of a file, with only its header read; all image files are opened here.

    Pillow tries a decoder only if it is named. Of the others, some start programs: that of EPS runs
    Ghostscript.

    Args:
        file: the open file, or its path.
        formats: Pillow's names of the formats that the file may have.

    Raises:
        Exception: any of a decoder's; Pillow's UnidentifiedImageError for another format.
    """
    if not isinstance(file, Path):
        file.seek(0)
    return Image.open(file, formats=formats)


@dataclasses.dataclass(frozen=True)
class OpenPicture:
    """A photo's file that is open, with what it says about itself."""

    image: Image.Image  # only the header is read
    kind: FileKind  # of the picture; a raw file's is that of its preview
    file: BinaryIO  # with the picture; a raw file's preview is a file of its own
    exif: Mapping[int, object]  # by number
    notes: tuple[str, ...]  # what the user should know, such as which of several pictures it is


def read_image(path: str | os.PathLike[str], read: Callable[[Image.Image], T]) -> T:
    """Open an image file and return `read(image)`; the file is closed afterwards.

    Of a raw file, the image is the preview inside.

    Raises:
        InputError: the file is missing, damaged, no image, or has more than 100 megapixels.
    """
    return read_picture(path, lambda picture: read(picture.image))


def read_picture(path: str | os.PathLike[str], read: Callable[[OpenPicture], T]) -> T:
    """Open a photo's file and return `read(picture)`; the file is closed afterwards.

    The content decides which decoder is tried, and no other is.

    Raises:
        InputError: the file is missing, damaged, no photo, or has more than 100 megapixels; or it
            is a raw file without a large preview.
    """
    check_file(path, "photo")
    return with_detached_errors(lambda: _read_picture(path, read))


def _read_picture(path: str | os.PathLike[str], read: Callable[[OpenPicture], T]) -> T:
    """`read(picture)` of a photo's file; InputError as in `read_picture`."""
    with (
        as_input_error(path, "cannot be decoded ({reason}): the file is damaged or cut off"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # about broken EXIF
        try:
            # A bounded file never allocates more than its size, whatever a broken image claims. It
            # has a buffer of its own, so the file below it needs none.
            with _BoundedFile(open(path, "rb", buffering=0)) as file:
                kind = kind_of_bytes(file.read(HEAD_BYTES))
                if not kind.is_photo:
                    raise not_a_photo(path, kind)
                raw_file = read_raw_file(file, kind) if kind in (TIFF, RAW) else None
                if raw_file is not None:
                    return _read_preview(path, raw_file, read)
                with _open_picture(file, kind) as picture:
                    check_pixel_count(picture.image.width, picture.image.height, file.size, path)
                    return read(picture)
        except Image.DecompressionBombError:
            raise InputError(f"{path}: more than 100 megapixels: shrink the image first") from None
        except UnidentifiedImageError:
            if kind is TIFF:
                raise InputError(
                    f"{path}: a TIFF of a layout that is not read, such as 32 bits per channel, or "
                    "damaged: save it as RGB with 8 or 16 bits per channel"
                ) from None
            raise InputError(
                f"{path}: not an image of a known format, or damaged at its beginning: "
                f"{EXPORT_ADVICE}"
            ) from None


@contextlib.contextmanager
def _open_picture(file: BinaryIO, kind: FileKind) -> Iterator[OpenPicture]:
    """The photo in an open file, which is closed after the block."""
    assert kind.pillow is not None  # the caller has refused all others
    source = file
    notes: tuple[str, ...] = ()
    if kind is TIFF:
        source, notes = _main_picture_of_tiff(file)
    with open_image(source, (kind.pillow,)) as image:
        if kind is JPEG:
            _check_scans(image, source)
        exif = exif_tags(image)  # now: a TIFF loses its tags when its pixels are loaded
        notes = notes or _notes_about_pictures(image, kind, source)
        yield OpenPicture(image, kind, source, exif, notes)


def _check_scans(image: Image.Image, file: BinaryIO) -> None:
    """ValueError for a JPEG that would be gone over too often; the file's position is kept."""
    position = file.tell()
    file.seek(0)
    count = count_scans(file.read())
    file.seek(position)
    if count * image.width * image.height > MAX_SCANNED_PIXELS:
        raise ValueError(f"it has {count} scans, as no camera and no program writes them")


def count_scans(content: bytes) -> int:
    """The number of scans of the first picture in a JPEG's bytes."""
    count = 0
    marker = JPEG_MARKER.search(content)
    while marker is not None and marker[1][0] != END_OF_JPEG:
        end = marker.end()
        if marker[1][0] != START_OF_JPEG:
            # Other markers begin a segment, which may hold a preview with markers of its own. Its
            # length counts the two bytes of the length.
            end += max(2, int.from_bytes(content[end : end + 2], "big"))
        count += marker[1][0] == START_OF_SCAN
        marker = JPEG_MARKER.search(content, end)
    return count


def _main_picture_of_tiff(file: BinaryIO) -> tuple[BinaryIO, tuple[str, ...]]:
    """A TIFF whose first directory is the main picture, and what to say about others in the file.

    It is the file itself, unless its first picture is marked as a thumbnail of a larger one.
    """
    directories = read_directories(file)
    pages = [directory for directory in directories if directory.is_page]
    notes: tuple[str, ...] = ()
    if len(pages) > 1:
        notes = (f"the file has {len(pages)} pictures, and the first one is used",)
    if not pages or not directories[0].is_reduced:
        return file, notes
    return tiff_from_directory(file, pages[0]), notes


def _notes_about_pictures(image: Image.Image, kind: FileKind, file: BinaryIO) -> tuple[str, ...]:
    """A line that says which picture is used, if a file has several that are meant to be seen."""
    if kind in (HEIF, AVIF):
        file.seek(0)
        items = HeifItems.of(file.read())
        count = 1 if items is None else len(items.shown_pictures())
        if count > 1:
            return (f"the file has {count} pictures, and the main one is used",)
        # A sequence has its frames elsewhere, and one picture that stands for them.
        is_sequence = items is not None and items.has_movie
        return ("the file is animated, and its still picture is used",) if is_sequence else ()
    # The pictures behind the first one of a JPEG are previews, gain maps, or of a second lens.
    if kind is not JPEG and getattr(image, "is_animated", False):
        return ("the file is animated, and its first picture is used",)
    return ()


def _read_preview(
    path: str | os.PathLike[str], raw_file: RawFile, read: Callable[[OpenPicture], T]
) -> T:
    """`read(picture)` of the largest preview of a raw file that can be decoded.

    Raises:
        InputError: there is no large one, or all of them are damaged.
    """
    problem: Exception | None = None
    for preview in raw_file.usable_previews:
        check_pixel_count(preview.width, preview.height, None, path)
        note = (
            "a raw file, of which the camera's preview of "
            f"{preview.width}×{preview.height} pixels is used"
        )
        try:
            with _open_picture(preview.open(), preview.kind) as picture:
                _add_outer_tags(picture.image, raw_file.exif)
                exif = {**raw_file.exif, **picture.exif}
                return read(dataclasses.replace(picture, exif=exif, notes=(note,)))
        except InputError:
            raise
        except Exception as error:  # damaged, or no preview but the sensor's data
            problem = error

    if problem is not None:
        raise problem
    what = "without a preview"
    if raw_file.previews:
        largest = raw_file.previews[0]
        what = f"with a preview of {largest.width}×{largest.height} pixels only"
    raise InputError(f"{path}: a raw file {what}: develop it, and export a JPEG")


def _add_outer_tags(image: Image.Image, exif: Mapping[int, object]) -> None:
    """Give a preview the orientation of its raw file, unless it has one of its own."""
    tags = image.getexif()
    if ORIENTATION not in tags:
        tags[ORIENTATION] = orientation_of(exif)


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
        size = f"{width * height / 1e6:.0f} megapixels ({width}×{height})"
        # Even a large file may not have more than `MAX_PIXELS`, so its size does not matter then.
        if width * height > MAX_PIXELS:
            limit = f"at most {MAX_PIXELS // 10**6}"
        else:
            limit = f"at most {max_pixels // 10**6} in a file of {file_bytes:,} bytes"
        raise InputError(f"{path}: {size} are too large ({limit}): shrink the image first")


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
        is_sideways = exif_tags(image).get(ORIENTATION) in SIDEWAYS_ORIENTATIONS
        # Pillow gives the size of a TIFF as it will be turned.
        return (height, width) if is_sideways and image.format != "TIFF" else (width, height)

    return read_image(path, read_size)


def exif_tags(image: Image.Image) -> dict[int, object]:
    """All EXIF tags of an image, by number; empty if broken.

    They are those of the image, of the camera, and of interoperability.
    """
    try:
        exif = image.getexif()
        camera = exif.get_ifd(EXIF_DIRECTORY)
        return {**exif, **camera, **exif.get_ifd(INTEROPERABILITY_DIRECTORY)}
    except Exception:  # a stranger's EXIF can raise anything
        return {}
