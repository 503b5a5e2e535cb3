"""Read photos from files of many formats, upright, in sRGB, with their focal length."""

from __future__ import annotations

import dataclasses
import io
import math
import numbers
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pillow_heif
import torch
from numpy.typing import NDArray
from PIL import Image, ImageCms, ImageOps, UnidentifiedImageError
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.photo_frame import PhotoFrame, find_frame
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.errors import InputError, as_input_error, short_repr
from spackle.runtime.files import check_file

T = TypeVar("T")
pillow_heif.register_heif_opener()

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif", ".tif", ".tiff")
MAX_PIXELS = 100_000_000  # a larger image would take more than a gigabyte as float32
SMALL_PIXELS, PIXELS_A_BYTE = (
    32_000_000,
    32,
)  # a strongly compressed photo has 20 pixels for each byte
LEAST_SIDE, MOST_ASPECT = 32, 8  # pixels of the short side; largest ratio of long to short side
MAX_WORKING_SIDE_PX = 1536  # long side of the working size
EDGE = 0.005  # width of the border that `replace_border` replaces, as a share of the long side
DEFAULT_FOCAL_MM = 30.0  # 35 mm equivalent for a photo of unknown focal length; SHARP's choice
FILM_DIAGONAL_MM = math.hypot(36, 24)
PHONE_FOCAL_MM, PHONE_FACTOR = (
    10.0,
    8.4,
)  # SHARP's rule: a shorter focal length means a sensor 8.4 times smaller
LENSES = (
    0.01,
    10_000.0,
)  # range of accepted focal lengths, in long sides of the photo: 178° to 0.006°
PLAUSIBLE_MM = (3.0, 3000.0)  # range of plausible 35 mm equivalents in EXIF

_EXIF_IFD = 0x8769
_FOCAL_LENGTH, _FOCAL_35MM = 0x920A, 0xA405
_PIXEL_X, _PIXEL_Y, _PLANE_X_RESOLUTION, _PLANE_UNIT = 0xA002, 0xA003, 0xA20E, 0xA210
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # inch, cm, mm, µm


@dataclasses.dataclass(frozen=True)
class Photo:
    """An upright image and its focal length."""

    rgb: Tensor = dataclasses.field(repr=False)  # [H, W, 3] float32 sRGB in 0..1
    focal_px: float  # in pixels of `rgb`
    focal_source: str  # "--focal-px", "--focal-mm", "--fov", "EXIF" or "default 30 mm"
    path: Path
    frame: PhotoFrame | None = None  # the border that was cropped, in pixels of `rgb`

    @property
    def height(self) -> int:
        return int(self.rgb.shape[0])

    @property
    def width(self) -> int:
        return int(self.rgb.shape[1])

    @property
    def framed_size(self) -> tuple[int, int]:
        """Width and height before the border was cropped."""
        left, top, right, bottom = self.frame or (0, 0, 0, 0)
        return round(self.width + left + right), round(self.height + top + bottom)

    @property
    def camera(self) -> Camera:
        """The photo's camera, at the world's origin; cropping a border shifts the principal point."""
        left, top, right, bottom = self.frame or (0, 0, 0, 0)
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
    """Read a JPEG, PNG, WebP, HEIC, TIFF or any other image that Pillow opens.

    The photo is rotated as EXIF asks, and converted to sRGB from an embedded profile. Transparent pixels become white.
    Only the first frame of an animation is read. Without `focal_px`, `focal_mm` and `fov`, the focal length comes from
    EXIF; a photo without EXIF gets a 35 mm equivalent of 30 mm.

    Args:
        path: the file.
        focal_px: focal length in pixels of the upright photo.
        focal_mm: 35 mm equivalent of the focal length, computed from the diagonal.
        fov: horizontal field of view in degrees.
        keep_frame: keep a uniform border. Otherwise the border is cropped, unless a focal length is given.

    Raises:
        InputError: the file is missing, broken or too large, or the focal length is invalid.
    """

    def read(image: Image.Image) -> tuple[Tensor, dict[int, object]]:
        tags = _exif(image)  # a TIFF loses its tags when its pixels are loaded
        image.load()
        return _to_rgb(_upright(image), path), tags

    rgb, exif = read_image(path, read)
    return _photo(rgb, exif, Path(path), keep_frame, focal_px=focal_px, focal_mm=focal_mm, fov=fov)


def photo_from_picture(
    picture: Image.Image | NDArray[Any] | Tensor, *, keep_frame: bool = True, **lens: float | None
) -> Photo:
    """A photo from a PIL image, or sRGB [H, W, 3] or [3, H, W] (uint8, floats in 0..1); for `lens` see `load_photo`."""
    path, exif = Path("photo"), dict[int, object]()
    if isinstance(picture, Image.Image):
        check_pixel_count(picture.width, picture.height, MAX_PIXELS, path)
        exif = _exif(picture)
        with as_input_error(path, "the picture cannot be used: {reason}"):
            rgb = _to_rgb(_upright(picture), path)
    else:
        values = (
            picture.detach().cpu()
            if isinstance(picture, Tensor)
            else torch.from_numpy(np.array(picture))
        )
        if values.ndim != 3 or 3 not in (values.shape[0], values.shape[2]) or not values.numel():
            raise InputError(
                f"{path}: a picture of shape {short_repr(tuple(values.shape))}: give [H, W, 3] or [3, H, W]"
            )
        values = values if values.shape[2] == 3 else values.movedim(0, 2)
        check_pixel_count(values.shape[1], values.shape[0], MAX_PIXELS, path)
        if values.dtype != torch.uint8 and not values.is_floating_point():
            raise InputError(
                f"{path}: colours as {values.dtype}: give uint8, or floats from 0 to 1"
            )
        rgb = values.float() / 255 if values.dtype == torch.uint8 else values.float().clone()
        if not (torch.isfinite(rgb).all() and rgb.min() >= 0 and rgb.max() <= 1):
            raise InputError(
                f"{path}: colours from {rgb.min():g} to {rgb.max():g}: give floats from 0 to 1, or uint8"
            )
    return _photo(rgb, exif, path, keep_frame, **lens)


def _photo(
    rgb: Tensor, exif: dict[int, object], path: Path, keep_frame: bool, **lens: float | None
) -> Photo:
    height, width = rgb.shape[:2]
    focal, source = resolve_focal_length(path, width, height, exif, **lens)
    frame = None if keep_frame or source.startswith("--") else find_frame(rgb)
    return Photo(frame.inside(rgb, width, height) if frame else rgb, focal, source, path, frame)


def resolve_focal_length(
    path: str | os.PathLike[str],
    width: int,
    height: int,
    exif: dict[int, object],
    *,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    fov: float | None = None,
) -> tuple[float, str]:
    """The focal length in pixels and its source; see `load_photo`.

    Raises:
        InputError: the focal length is invalid.
    """
    given = {"--focal-px": focal_px, "--focal-mm": focal_mm, "--fov": fov}
    named = {name: value for name, value in given.items() if value is not None}
    if len(named) > 1:
        raise InputError(f"{' and '.join(named)} are given together: give one of them")
    for name, value in named.items():
        if not (isinstance(value, numbers.Real) and math.isfinite(value) and value > 0):
            raise InputError(f"{name} must be a positive number, got {value!r}")
        if name == "--fov" and value >= 180:
            raise InputError(f"--fov must lie between 0 and 180 degrees, got {value}")
    if focal_px is not None:
        focal, source = focal_px, "--focal-px"
    elif focal_mm is not None:
        focal, source = focal_mm_to_px(focal_mm, width, height), "--focal-mm"
    elif fov is not None:
        focal, source = width / 2 / math.tan(math.radians(fov) / 2), "--fov"
    else:
        found = focal_from_exif(exif, width, height)
        focal = found or focal_mm_to_px(DEFAULT_FOCAL_MM, width, height)
        source = "EXIF" if found else "default 30 mm"
    shortest, longest = (lens * max(width, height) for lens in LENSES)
    if not shortest <= focal <= longest:
        raise InputError(
            f"{path}: {source} gives a focal length of {focal:g} px, "
            f"but it must lie between {shortest:g} and {longest:g} px: check the value"
        )
    return float(focal), source


def resize_photo(photo: Photo, max_side: int = MAX_WORKING_SIDE_PX) -> Photo:
    """Resize a photo and its focal length to its `working_size`, by Lanczos."""
    width, height = working_size(photo.width, photo.height, max_side)
    if (width, height) == (photo.width, photo.height):
        return photo
    rgb = photo.rgb.new_empty(height, width, 3)

    def resize(channel: int, _: int) -> None:
        full = Image.fromarray(photo.rgb[..., channel].contiguous().numpy())
        resized = np.array(full.resize((width, height), Image.Resampling.LANCZOS))
        rgb[..., channel] = torch.from_numpy(resized).clamp_(0, 1)

    parallel_for_chunks(resize, 3, 1)
    frame = photo.frame and photo.frame.scaled(width / photo.width, height / photo.height)
    return dataclasses.replace(
        photo, rgb=rgb, focal_px=photo.focal_px * width / photo.width, frame=frame
    )


def replace_border(rgb: Tensor) -> Tensor:
    """Replace the outermost pixels of a photo [H, W, 3] by the pixels just inside.

    The outermost pixels often show a scan's edge, or colours mixed by resizing; the fill would extend them as streaks.
    """
    height, width = rgb.shape[:2]
    edge = min(round(EDGE * max(height, width)), (min(height, width) - 1) // 2)
    rows, columns = (torch.arange(side).clamp(edge, side - 1 - edge) for side in (height, width))
    return rgb[rows][:, columns]


def working_size(width: int, height: int, max_side: int = MAX_WORKING_SIDE_PX) -> tuple[int, int]:
    """Width and height scaled down so that the long side is at most `max_side`."""
    scale = min(1.0, max_side / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def focal_mm_to_px(focal_mm: float, width: int, height: int) -> float:
    """Convert a 35 mm equivalent focal length to pixels, by the diagonals of film and photo."""
    return focal_mm * math.hypot(width, height) / FILM_DIAGONAL_MM


def focal_from_exif(tags: dict[int, object], width: int, height: int) -> float | None:
    """Focal length in pixels of a width×height photo from EXIF tags (number → value), or None.

    Sources, best first: the 35 mm equivalent; the focal length and the sensor's pixel pitch; the focal length alone.
    """

    def plausible(mm: float) -> bool:
        return PLAUSIBLE_MM[0] <= mm <= PLAUSIBLE_MM[1]

    film = _number(tags.get(_FOCAL_35MM)) or 0.0  # 0 means "unknown" in EXIF
    if plausible(film):
        return focal_mm_to_px(film, width, height)
    lens = _number(tags.get(_FOCAL_LENGTH))
    if lens is None or lens <= 0:
        return None
    density, unit = _number(tags.get(_PLANE_X_RESOLUTION)), _number(tags.get(_PLANE_UNIT))
    if density is not None and density > 0:
        recorded = max(_number(tags.get(_PIXEL_X)) or 0, _number(tags.get(_PIXEL_Y)) or 0)
        shrunk = max(width, height) / recorded if recorded > 0 else 1.0  # if the photo was resized
        pixels = lens * density / _UNIT_MM.get(int(unit or 2), 25.4) * shrunk
        if plausible(pixels / focal_mm_to_px(1.0, width, height)):
            return pixels
    film = lens * PHONE_FACTOR if lens < PHONE_FOCAL_MM else lens
    return focal_mm_to_px(film, width, height) if plausible(film) else None


class _BoundedFile(io.BufferedReader):
    """A file that allocates no more than its size, even if a PNG chunk claims 4 GB."""

    def __init__(self, raw: io.FileIO) -> None:
        super().__init__(raw)
        self.size = os.fstat(raw.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        return super().read(size if size is None else min(size, max(0, self.size - self.tell())))


def read_image(path: str | os.PathLike[str], read: Callable[[Image.Image], T]) -> T:
    """Open an image of at most 100 megapixels, and return `read(image)`; InputError if decoding fails."""
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


def check_photo_size(width: int, height: int, path: str | os.PathLike[str]) -> None:
    """Raise an InputError for a photo that is too small or too narrow to show a scene."""
    short, long = sorted((width, height))
    if short < LEAST_SIDE or long > MOST_ASPECT * short:
        wanted = (
            f"at least {LEAST_SIDE} pixels a side, and at most {MOST_ASPECT} times as long as wide"
        )
        raise InputError(
            f"{path}: {width}×{height} is too small or too narrow: give a photo with {wanted}"
        )


def check_pixel_count(width: int, height: int, size: int, path: str | os.PathLike[str]) -> None:
    """Raise an InputError if an image in a file of `size` bytes would take too much memory."""
    most = min(MAX_PIXELS, max(SMALL_PIXELS, PIXELS_A_BYTE * size))
    if width * height > most:
        limit = f"at most {most // 10**6} megapixels in {size:,} bytes"
        raise InputError(f"{path}: {width}×{height} is too large ({limit}): shrink the image first")


def _upright(image: Image.Image) -> Image.Image:
    try:
        return ImageOps.exif_transpose(image)
    except Exception:  # unreadable EXIF gives no orientation
        return image


def _exif(image: Image.Image) -> dict[int, object]:
    """The tags of the main directory and of the EXIF directory; empty if broken."""
    try:
        exif = image.getexif()
        return {**exif, **exif.get_ifd(_EXIF_IFD)}
    except Exception:
        return {}


def _number(value: object) -> float | None:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def _to_rgb(image: Image.Image, path: str | os.PathLike[str]) -> Tensor:
    """Convert an image of any mode to [H, W, 3] float32 sRGB in 0..1."""
    if image.mode in ("F", "I") or image.mode.startswith(
        "I;16"
    ):  # one channel with more than 8 bits
        values = np.asarray(image)
        if image.mode == "F" or values.min() < 0 or values.max() > 65535:
            raise InputError(
                f"{path}: pixels of 32 bits: save the photo with 8 or 16 bits per channel"
            )
        grey = torch.from_numpy(values.astype(np.float32)).div_(65535)
        return grey[..., None].expand(-1, -1, 3).contiguous()
    profile = image.info.get("icc_profile")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB")
    elif image.mode not in ("RGB", "L", "CMYK"):
        image = image.convert("RGB")
    image = _to_srgb(image, profile).convert("RGB")
    return torch.from_numpy(np.array(image)).float().div_(255)


def _to_srgb(image: Image.Image, profile: bytes | None) -> Image.Image:
    if not profile:
        return image
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "sRGB" in ImageCms.getProfileDescription(source):
            return image
        target = ImageCms.createProfile("sRGB")
        return ImageCms.profileToProfile(image, source, target, outputMode="RGB") or image
    except (
        ImageCms.PyCMSError,
        OSError,
        ValueError,
        TypeError,
    ):  # the profile is broken or of another mode
        return image
