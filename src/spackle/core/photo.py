"""Photos: an upright sRGB image with its focal length.

`load_photo` reads a file, `photo_from_picture` takes an image in memory, and `resize_photo` brings
a photo to the size at which Spackle works.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.core.array_values import PlainArray, plain_array, without_unit_axes
from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource, resolve_focal_length
from spackle.core.image_files import OpenPicture, check_pixel_count, exif_tags, read_picture
from spackle.core.photo_frame import PhotoFrame, find_frame
from spackle.core.projections import looks_like_360, refuse_other_projections, xmp_of_image
from spackle.core.srgb_pictures import SrgbPicture, image_to_srgb, picture_to_srgb
from spackle.core.stated_colors import read_colors_of_open_image, read_stated_colors
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.errors import InputError, as_input_error, short_repr

MIN_SIDE_PX = 32  # a smaller photo shows no scene
MAX_ASPECT_RATIO = 8  # long to short side; a narrower photo shows no scene
MAX_WORKING_SIDE_PX = 1536  # long side of a photo at the size at which Spackle works
MAYBE_360_NOTE = "looks like a 360° panorama, whose scene would be bent: cut a flat view out of it"
LARGEST_BY_TYPE = {"uint8": 255, "uint16": 65535}  # the number of white in an array of colours
CHANNELS_WITH_OPACITY = 4
CHANNEL_COUNTS = (1, 3, CHANNELS_WITH_OPACITY)  # grey, colour, colour with opacity
REPLACED_BORDER_RATIO = 0.005  # width of the border that `replace_border` replaces, per long side


@dataclasses.dataclass(frozen=True)
class Photo:
    """An upright image and its focal length."""

    rgb: Tensor = dataclasses.field(repr=False)  # [H, W, 3] float32 sRGB in 0..1
    focal_px: float  # in pixels of `rgb`
    focal_source: FocalSource
    path: Path
    frame: PhotoFrame | None = None  # the border that was cropped, in pixels of `rgb`
    # What the user should know: which of several pictures it is, what was guessed of its colours.
    notes: tuple[str, ...] = ()

    @property
    def height(self) -> int:
        """Height in pixels."""
        return int(self.rgb.shape[0])

    @property
    def width(self) -> int:
        """Width in pixels."""
        return int(self.rgb.shape[1])

    @property
    def framed_size(self) -> tuple[int, int]:
        """Width and height in pixels before the border was cropped."""
        left, top, right, bottom = self.frame or (0, 0, 0, 0)
        return round(self.width + left + right), round(self.height + top + bottom)

    @property
    def camera(self) -> Camera:
        """The photo's camera, at the world's origin.

        The optical axis met the middle of the photo before its border was cropped, so a border that
        is wider on one side shifts the principal point away from the middle.
        """
        left, top, right, bottom = self.frame or (0, 0, 0, 0)  # widths of the cropped border
        # A border of equal width on both sides shifts nothing. Otherwise the middle is half the
        # difference away, as if the photo had been cropped by that much at the left and the top.
        camera = Camera.from_focal(self.focal_px, self.width, self.height)
        return camera.cropped((left - right) / 2, (top - bottom) / 2, self.width, self.height)


def load_photo(
    path: str | os.PathLike[str],
    *,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    fov: float | None = None,
    keep_frame: bool = True,
) -> Photo:
    """Read a JPEG, PNG, WebP, HEIC, AVIF, TIFF, GIF, BMP or PNM, or the preview of a raw file.

    The photo is turned upright as EXIF asks, and converted to sRGB from the colours that the file
    states; HDR is mapped to the range of sRGB. Transparent pixels become white. Of several
    pictures, the main one is read, and of an animation the first; `notes` of the result says so.
    Without `focal_px`, `focal_mm` and `fov`, the focal length comes from EXIF; a photo without EXIF
    gets a 35 mm equivalent of 30 mm.

    Args:
        path: the file.
        focal_px: focal length in pixels of the upright photo.
        focal_mm: 35 mm equivalent: the focal length with the same diagonal angle of view on film of
            36 mm × 24 mm.
        fov: horizontal field of view in degrees.
        keep_frame: keep a uniform border, such as a scan's margin. Otherwise the border is cropped,
            unless a focal length is given, because that holds for the whole photo.

    Raises:
        InputError: the file is missing, broken or too large, the picture is a panorama or a
            fisheye, or the focal length is invalid.
    """

    def read(picture: OpenPicture) -> Photo:
        """The photo of an open file."""
        refuse_if_not_flat(picture, path)
        colors = picture_to_srgb(picture, path)
        return _make_photo(
            dataclasses.replace(colors, notes=(*picture.notes, *colors.notes)),
            picture.exif,
            Path(path),
            keep_frame,
            focal_px=focal_px,
            focal_mm=focal_mm,
            fov=fov,
        )

    return read_picture(path, read)


def refuse_if_not_flat(picture: OpenPicture, path: str | os.PathLike[str]) -> None:
    """Raise an InputError for a 360° photo, a panorama or a fisheye; `path` is its file."""
    image = picture.image
    xmp = xmp_of_image(image, picture.exif)
    refuse_other_projections(path, picture.exif, xmp, image.width, image.height)


def photo_from_picture(
    picture: Any,
    *,
    keep_frame: bool = True,
    **focal_options: float | None,
) -> Photo:
    """Make a photo from a picture in memory.

    Args:
        picture: a PIL image; or sRGB as an array or tensor [H, W, 3], [3, H, W], with a fourth
            channel for opacity, or [H, W] for grey: uint8, uint16 (up to 65535), or floats in 0..1.
            Further axes of length 1 are left out. Masked pixels become white, as transparent ones.
        keep_frame: keep a uniform border, such as a scan's margin.
        focal_options: at most one of `focal_px`, `focal_mm` and `fov`, as in `load_photo`.

    Raises:
        InputError: the picture has another shape, type or range, is a panorama or a fisheye, or the
            focal length is invalid.
    """
    name = Path("photo")  # for messages, because a picture has no file
    exif: Mapping[int, object] = {}
    if isinstance(picture, Image.Image):
        check_pixel_count(picture.width, picture.height, file_bytes=None, path=name)
        stated = read_colors_of_open_image(picture)
        exif = exif_tags(picture)
        xmp = xmp_of_image(picture, exif)
        refuse_other_projections(name, exif, xmp, picture.width, picture.height)
        with as_input_error(name, "the picture cannot be used: {reason}"):
            stated = stated or read_stated_colors(picture, exif)
            colors = image_to_srgb(picture, stated, exif, name)
    else:
        colors = SrgbPicture(_array_to_rgb(plain_array(picture, name), name), ())
    return _make_photo(colors, exif, name, keep_frame, **focal_options)


def _array_to_rgb(picture: PlainArray, name: Path) -> Tensor:
    """Convert sRGB of uint8, uint16 or floats in 0..1 to float32 [H, W, 3] in 0..1.

    The shape is [H, W, C] or [C, H, W] for 1 (grey), 3 or 4 channels (the last one is opacity), or
    [H, W]. What is transparent or masked becomes white.

    Raises:
        InputError: another shape, type or range; `name` stands at the beginning of the message.
    """
    numbers = _channels_last(picture.numbers, name)  # [H, W, C]
    height, width, channel_count = numbers.shape
    check_pixel_count(width, height, file_bytes=None, path=name)

    largest = LARGEST_BY_TYPE.get(numbers.dtype.name)
    if numbers.dtype.kind != "f" and largest is None:
        raise InputError(
            f"{name}: colours as {numbers.dtype}: give uint8, uint16, or floats from 0 to 1"
        )
    values = numbers.astype(np.float32) / np.float32(largest or 1)
    if picture.known is not None:
        is_known = _channels_last(picture.known, name).all(axis=-1)  # [H, W]
        values[~is_known] = 1
    is_in_range = np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1
    if not is_in_range:
        raise InputError(
            f"{name}: colours from {values.min():g} to {values.max():g}: "
            "give floats from 0 to 1, uint8 or uint16"
        )

    rgb = values if channel_count > 1 else np.repeat(values, 3, axis=-1)
    if channel_count == CHANNELS_WITH_OPACITY:
        opacity = values[..., 3:]
        rgb = opacity * values[..., :3] + (1 - opacity)  # over white
    return torch.from_numpy(np.ascontiguousarray(rgb, np.float32))


def _channels_last(numbers: NDArray[Any], name: Path) -> NDArray[Any]:
    """A picture as [H, W, C], from [H, W], [H, W, C] or [C, H, W] with 1, 3 or 4 channels.

    Further axes of length 1 are left out. InputError for another shape.
    """
    shape = tuple(numbers.shape)
    numbers = without_unit_axes(numbers, 3)
    if numbers.ndim == 2:
        numbers = numbers[..., None]
    if numbers.ndim == 3 and numbers.shape[2] not in CHANNEL_COUNTS:
        numbers = np.moveaxis(numbers, 0, 2)  # [C, H, W] to [H, W, C]
    if numbers.ndim != 3 or numbers.shape[2] not in CHANNEL_COUNTS or not numbers.size:
        raise InputError(
            f"{name}: a picture of shape {short_repr(shape)}: give [H, W, 3] or [3, H, W]"
        )
    return numbers


def _make_photo(
    picture: SrgbPicture,
    exif: Mapping[int, object],
    path: Path,
    keep_frame: bool,
    **focal_options: float | None,
) -> Photo:
    """A photo of an upright image, without its uniform border unless `keep_frame`.

    Args:
        picture: the upright image.
        exif: the image's EXIF tags, by number.
        path: the image's file.
        keep_frame: keep a uniform border.
        focal_options: at most one of `focal_px`, `focal_mm` and `fov`; InputError for an
            impossible one.
    """
    rgb = picture.rgb
    height, width = rgb.shape[:2]
    focal, source = resolve_focal_length(path, width, height, exif, **focal_options)
    notes = picture.notes
    if looks_like_360(rgb):
        notes += (MAYBE_360_NOTE,)

    # A user's focal length or field of view holds for the whole image, so it is not cropped.
    frame = None
    if not keep_frame and not source.is_from_user:
        frame = find_frame(rgb)
    if frame is not None:
        rgb = frame.inside(rgb, width, height)
    return Photo(rgb, focal, source, path, frame, notes)


def check_photo_size(width: int, height: int, path: str | os.PathLike[str]) -> None:
    """Raise an InputError for a photo that is too small or too narrow to show a scene."""
    short, long = sorted((width, height))
    if short < MIN_SIDE_PX or long > MAX_ASPECT_RATIO * short:
        demand = (
            f"at least {MIN_SIDE_PX} pixels a side, and at most {MAX_ASPECT_RATIO} times "
            "as long as wide"
        )
        raise InputError(
            f"{path}: {width}×{height} is too small or too narrow: give a photo with {demand}"
        )


def working_size(width: int, height: int, max_side: int = MAX_WORKING_SIDE_PX) -> tuple[int, int]:
    """Width and height in pixels, scaled down so that the long side is at most `max_side`."""
    scale = min(1.0, max_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def resize_photo(photo: Photo, max_side: int = MAX_WORKING_SIDE_PX) -> Photo:
    """Shrink a photo, by Lanczos, so that its long side is at most `max_side` pixels.

    Focal length and cropped border are scaled, too. A photo that is small enough is returned as is.
    """
    width, height = working_size(photo.width, photo.height, max_side)
    if (width, height) == (photo.width, photo.height):
        return photo
    rgb = resize_rgb(photo.rgb, width, height)
    frame = photo.frame
    if frame is not None:
        frame = frame.scaled(width / photo.width, height / photo.height)
    focal_px = photo.focal_px * width / photo.width
    return dataclasses.replace(photo, rgb=rgb, focal_px=focal_px, frame=frame)


def resize_rgb(rgb: Tensor, width: int, height: int) -> Tensor:
    """An image [H, W, 3] in 0..1 resized by Lanczos, [height, width, 3]; itself if it fits."""
    if (height, width) == tuple(rgb.shape[:2]):
        return rgb
    resized = rgb.new_empty(height, width, 3)

    def resize_channel(channel: int, _: int) -> None:
        """Resize one colour channel; Pillow resizes floats only channel by channel.

        `_` is the end of the chunk of channels, which has only this one.
        """
        image = Image.fromarray(rgb[..., channel].contiguous().numpy())
        pixels = np.array(image.resize((width, height), Image.Resampling.LANCZOS))
        # Lanczos overshoots at edges, so values can leave the range of colours.
        resized[..., channel] = torch.from_numpy(pixels).clamp_(0, 1)

    parallel_for_chunks(resize_channel, 3, 1)  # three channels, each a chunk of its own
    return resized


def replace_border(rgb: Tensor) -> Tensor:
    """Replace the outermost pixels of a photo [H, W, 3] by the pixels just inside.

    The outermost pixels often show a scan's edge, or colours mixed by resizing. Holes beyond the
    photo's border are filled by extending its outermost colours, which would make streaks of these.
    """
    height, width = rgb.shape[:2]
    border = round(REPLACED_BORDER_RATIO * max(height, width))
    border = min(border, (min(height, width) - 1) // 2)  # at least one line must stay
    rows = torch.arange(height).clamp(border, height - 1 - border)
    columns = torch.arange(width).clamp(border, width - 1 - border)
    return rgb[rows][:, columns]
