"""The focal length of a photo, in pixels, and where it comes from.

`resolve_focal_length` decides: the user's number, else EXIF, else an assumed lens.
"""

from __future__ import annotations

import enum
import math
import numbers
import os
from collections.abc import Mapping

from spackle.runtime.errors import InputError

# A "35 mm equivalent" is the focal length that gives the same view on film of 36 mm × 24 mm.
FILM_DIAGONAL_MM = math.hypot(36, 24)
ASSUMED_FOCAL_MM = 30.0  # 35 mm equivalent for a photo of unknown focal length; SHARP's choice

# Limits for a focal length, in long sides of the photo: views of 178° and of 0.006°.
MIN_FOCAL_PER_LONG_SIDE = 0.01
MAX_FOCAL_PER_LONG_SIDE = 10_000.0

# EXIF often holds nonsense; 35 mm equivalents outside of this range are ignored.
MIN_PLAUSIBLE_MM = 3.0
MAX_PLAUSIBLE_MM = 3000.0

# SHARP's rule for EXIF that has the lens, but not the sensor: a lens under 10 mm belongs to a
# phone, whose sensor is 8.4 times smaller than film.
MAX_PHONE_LENS_MM = 10.0
PHONE_CROP_FACTOR = 8.4

# Numbers of EXIF's tags.
_TAG_LENS_MM = 0x920A
_TAG_FILM_EQUIVALENT_MM = 0xA405
_TAG_RECORDED_WIDTH = 0xA002
_TAG_RECORDED_HEIGHT = 0xA003
_TAG_SENSOR_PIXELS_PER_UNIT = 0xA20E
_TAG_SENSOR_UNIT = 0xA210
_EXIF_INCH = 2
_MM_PER_EXIF_UNIT = {_EXIF_INCH: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # inch, cm, mm, µm


class FocalSource(enum.Enum):
    """Where the focal length of a photo comes from; the value is the text in reports."""

    FOCAL_PX = "focal_px"  # given by the user, like the next two
    FOCAL_MM = "focal_mm"
    FOV = "fov"
    CAMERAS = "cameras"  # of a file of cameras that names the photo
    EXIF = "EXIF"  # read from the photo's file
    CALIBRATION = "calibration"  # measured, in a file beside the photo
    DATASET = "dataset"  # the camera of a dataset for evaluation
    FIRST_FRAME = "first frame"  # of a clip; all frames keep the first frame's focal length
    ASSUMED = "default 30 mm"  # nothing is known

    @property
    def is_from_user(self) -> bool:
        """Whether the user gave the focal length, so that nothing may change it."""
        given = (FocalSource.FOCAL_PX, FocalSource.FOCAL_MM, FocalSource.FOV, FocalSource.CAMERAS)
        return self in given

    @property
    def is_assumed(self) -> bool:
        """Whether the focal length is unknown, so that an estimate of a network is better."""
        return self is FocalSource.ASSUMED


def resolve_focal_length(
    path: str | os.PathLike[str],
    width: int,
    height: int,
    exif: Mapping[int, object],
    *,
    focal_px: float | None = None,
    focal_mm: float | None = None,
    fov: float | None = None,
) -> tuple[float, FocalSource]:
    """Find the focal length of a width×height photo: the user's, else EXIF's, else an assumed one.

    Args:
        path: the photo's file, for messages.
        width: of the photo in pixels.
        height: of the photo in pixels.
        exif: EXIF tags of the photo, by number.
        focal_px: the user's focal length in pixels.
        focal_mm: the user's 35 mm equivalent of the focal length: the focal length that gives the
            same view on film of 36 mm × 24 mm.
        fov: the user's horizontal field of view in degrees.

    Returns:
        The focal length in pixels and its source.

    Raises:
        InputError: the user gives two focal lengths or none that is possible, or the focal length
            is absurd for a photo of this size.
    """
    _check_user_focal(focal_px, focal_mm, fov)

    if focal_px is not None:
        focal, source = focal_px, FocalSource.FOCAL_PX
    elif focal_mm is not None:
        focal, source = focal_mm_to_px(focal_mm, width, height), FocalSource.FOCAL_MM
    elif fov is not None:
        # Half the width is seen under half the angle.
        focal, source = width / 2 / math.tan(math.radians(fov) / 2), FocalSource.FOV
    else:
        exif_focal = focal_from_exif(exif, width, height)
        if exif_focal is not None:
            focal, source = exif_focal, FocalSource.EXIF
        else:
            focal, source = focal_mm_to_px(ASSUMED_FOCAL_MM, width, height), FocalSource.ASSUMED

    # Beyond these limits a number is a typing error or nonsense in EXIF, not a lens.
    shortest = MIN_FOCAL_PER_LONG_SIDE * max(width, height)
    longest = MAX_FOCAL_PER_LONG_SIDE * max(width, height)
    if not shortest <= focal <= longest:
        origin = f"`{source.value}`" if source.is_from_user else source.value
        raise InputError(
            f"{path}: {origin} gives a focal length of {focal:g} px, "
            f"but it must lie between {shortest:g} and {longest:g} px: check the value"
        )
    return float(focal), source


def _check_user_focal(focal_px: float | None, focal_mm: float | None, fov: float | None) -> None:
    """Raise an InputError unless the user gave at most one focal length, and a positive number.

    A field of view must also be below 180 degrees, where a pinhole camera's focal length is 0.
    """
    options = {"`focal_px`": focal_px, "`focal_mm`": focal_mm, "`fov`": fov}
    given_options = {name: value for name, value in options.items() if value is not None}
    if len(given_options) > 1:
        raise InputError(f"{' and '.join(given_options)} are given together: give one of them")

    for name, value in given_options.items():
        is_number = isinstance(value, numbers.Real) and math.isfinite(value)
        if not (is_number and value > 0):
            raise InputError(f"{name} must be a positive number, got {value!r}")
        if name == "`fov`" and value >= 180:
            raise InputError(f"{name} must lie between 0 and 180 degrees, got {value}")


def focal_mm_to_px(focal_mm: float, width: int, height: int) -> float:
    """Convert a 35 mm equivalent to a focal length in pixels of a width×height photo.

    Camera makers compare the diagonals of film and sensor, so the diagonals decide here, too.
    """
    return focal_mm * math.hypot(width, height) / FILM_DIAGONAL_MM


def focal_from_exif(tags: Mapping[int, object], width: int, height: int) -> float | None:
    """Focal length in pixels of a width×height photo from EXIF tags, or None if they hold none.

    Sources, best first: the 35 mm equivalent; the lens's focal length with the density of the
    sensor's pixels; the lens's focal length alone.

    Args:
        tags: values of EXIF tags, by number.
        width: of the photo in pixels.
        height: of the photo in pixels.
    """
    film_mm = _finite_number(tags.get(_TAG_FILM_EQUIVALENT_MM))
    # A 0, which means "unknown" in EXIF, is not plausible.
    if film_mm is not None and _is_plausible_mm(film_mm):
        return focal_mm_to_px(film_mm, width, height)

    lens_mm = _finite_number(tags.get(_TAG_LENS_MM))
    if lens_mm is None or lens_mm <= 0:
        return None

    # EXIF's density is often wrong, so the result must be plausible as a 35 mm equivalent.
    focal_px = _focal_from_pixel_density(tags, lens_mm, max(width, height))
    px_per_film_mm = focal_mm_to_px(1.0, width, height)
    if focal_px is not None and _is_plausible_mm(focal_px / px_per_film_mm):
        return focal_px

    # The sensor is unknown: a short lens belongs to a phone, any other to a full-frame camera.
    film_mm = lens_mm * PHONE_CROP_FACTOR if lens_mm < MAX_PHONE_LENS_MM else lens_mm
    if _is_plausible_mm(film_mm):
        return focal_mm_to_px(film_mm, width, height)
    return None


def _focal_from_pixel_density(
    tags: Mapping[int, object], lens_mm: float, long_side: int
) -> float | None:
    """Focal length in pixels from the density of the sensor's pixels; None if EXIF has no density.

    Args:
        tags: values of EXIF tags, by number.
        lens_mm: focal length of the lens.
        long_side: of the photo, in pixels. A resized photo has another long side than the picture
            that the camera recorded, whose size EXIF holds.
    """
    pixels_per_unit = _finite_number(tags.get(_TAG_SENSOR_PIXELS_PER_UNIT))
    if pixels_per_unit is None or pixels_per_unit <= 0:
        return None
    # The unit is a code; an inch (25.4 mm) is EXIF's default, and serves for unknown codes, too.
    unit = int(_finite_number(tags.get(_TAG_SENSOR_UNIT)) or _EXIF_INCH)
    unit_mm = _MM_PER_EXIF_UNIT.get(unit, 25.4)

    recorded_width = _finite_number(tags.get(_TAG_RECORDED_WIDTH)) or 0
    recorded_height = _finite_number(tags.get(_TAG_RECORDED_HEIGHT)) or 0
    recorded_side = max(recorded_width, recorded_height)
    resize_factor = long_side / recorded_side if recorded_side > 0 else 1.0
    return lens_mm * pixels_per_unit / unit_mm * resize_factor


def _is_plausible_mm(focal_mm: float) -> bool:
    """Whether a 35 mm equivalent from EXIF can be true."""
    return MIN_PLAUSIBLE_MM <= focal_mm <= MAX_PLAUSIBLE_MM


def _finite_number(value: object) -> float | None:
    """A value of an EXIF tag as a number; None if it is missing, no number, infinite or NaN."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) else None
