"""Read the depth channel of an OpenEXR file, by the package OpenEXR of the extra `exr`."""

from __future__ import annotations

import contextlib
import io
from typing import IO, Any

import numpy as np

from spackle.core.image_files import check_pixel_count
from spackle.depth.depth_map import Array, StrPath
from spackle.runtime.errors import InputError

EXR_MAGIC = b"\x76\x2f\x31\x01"  # the first bytes of every OpenEXR file
# Compressions that change numbers; depth edges suffer most.
LOSSY_COMPRESSIONS = (
    "PXR24_COMPRESSION",
    "B44_COMPRESSION",
    "B44A_COMPRESSION",
    "DWAA_COMPRESSION",
    "DWAB_COMPRESSION",
)
# Last letters of channels that may hold depth, worst first: red, luminance, and names of depth.
CHANNEL_LETTERS = "RYVZ"
MAX_NUMBERS = 400_000_000  # in all channels of a file, which the library reads together: 1.6 GB


def read_exr_depth(file: IO[bytes], path: StrPath) -> Array:
    """The depth channel [H, W] of an open EXR file, as half or float; `path` is for messages.

    A file states the frame of the whole picture (display window) and the part of which it has
    pixels (data window). The result is the whole picture, with 0 where there are none. InputError
    for a file with several parts, lossy compression or integers, a damaged or too large file, and
    if the package OpenEXR is missing.
    """
    OpenEXR = _import_openexr(path)
    # The header is read and checked first, because a damaged one may announce gigabytes. With 0
    # threads the library works in this one.
    header_file = OpenEXR.File(file, separate_channels=True, header_only=True, num_threads=0)
    header = header_file.header()
    _check_kind(OpenEXR, header_file, path)
    _check_size(header, file.seek(0, io.SEEK_END), path)

    names = [channel.name for channel in header["channels"]]
    pixels = _read_channel(OpenEXR, file, _depth_channel(names))
    if pixels.dtype.kind != "f":
        raise InputError(f"{path}: an EXR of integers: give metres as half or float")
    if pixels.shape != _window_size(header["dataWindow"]):
        raise InputError(f"{path}: a depth channel at another resolution: save it at full size")
    return _in_display_window(pixels, header["dataWindow"], header["displayWindow"])


def _import_openexr(path: StrPath) -> Any:
    """The module OpenEXR; InputError that says what to install if it is missing."""
    try:
        import OpenEXR
    except ImportError as error:
        raise InputError(
            f"{path}: EXR files need the package OpenEXR: pip install 'spackle-nvs[exr]'"
        ) from error
    return OpenEXR


def _check_kind(OpenEXR: Any, header_file: Any, path: StrPath) -> None:
    """InputError unless a file, of which the header was read, is one lossless flat picture.

    `OpenEXR` is the module, and `header_file` its view of the file.
    """
    # A deep picture has a list of depths for each pixel.
    flat_kinds = (OpenEXR.scanlineimage, OpenEXR.tiledimage)
    parts = header_file.parts
    if len(parts) != 1 or parts[0].type() not in flat_kinds:
        raise InputError(f"{path}: a deep EXR, or one with several parts: give one plain picture")
    if parts[0].compression().name in LOSSY_COMPRESSIONS:
        raise InputError(
            f"{path}: an EXR with lossy compression: save it with ZIP or PIZ, or uncompressed"
        )


def _check_size(header: dict[str, Any], file_bytes: int, path: StrPath) -> None:
    """InputError if a picture has no pixels, or would take too much memory for its file's size."""
    height, width = _window_size(header["displayWindow"])
    data_height, data_width = _window_size(header["dataWindow"])
    if min(height, width, data_height, data_width) < 1:
        raise InputError(f"{path}: an EXR without pixels: give another file")
    check_pixel_count(width, height, file_bytes, path)
    check_pixel_count(data_width, data_height, file_bytes, path)
    channel_count = len(header["channels"])
    if data_width * data_height * channel_count > MAX_NUMBERS:
        raise InputError(
            f"{path}: {data_width}×{data_height} pixels in {channel_count} channels are too many: "
            "save the depth alone"
        )


def _depth_channel(names: list[str]) -> str:
    """The channel that holds depth: one that is called depth, else one that ends in Z, V, Y or R.

    The shortest of several such names wins: Z, not Normal.Z, which is part of a direction.
    """

    def preference(name: str) -> tuple[bool, int, int]:
        # CHANNEL_LETTERS is "RYVZ". The later the name's last letter stands in it, the surer it is
        # that the channel holds depth.
        return "depth" in name.lower(), CHANNEL_LETTERS.find(name[-1]), -len(name)

    # Renderers add layers in front: ViewLayer.Depth.Z.
    return max(names, key=preference)


def _read_channel(OpenEXR: Any, file: IO[bytes], name: str) -> Array:
    """The pixels [H, W] of a channel; EOFError if some of the file's rows cannot be read."""
    file.seek(0)
    # The library prints a warning for a damaged file, and returns a file without parts. It computes
    # in this thread alone: threads of its own would outlive an error.
    with contextlib.redirect_stdout(io.StringIO()):
        picture = OpenEXR.File(file, separate_channels=True, num_threads=0)
    if not picture.parts:
        raise EOFError("rows are missing")
    pixels: Array = picture.channels()[name].pixels
    return pixels


def _window_size(window: tuple[Array, Array]) -> tuple[int, int]:
    """(height, width) of a window, which EXR states as the first and the last pixel (x, y)."""
    # Both corners belong to the window.
    first, last = window
    return int(last[1]) - int(first[1]) + 1, int(last[0]) - int(first[0]) + 1


def _in_display_window(
    pixels: Array, data_window: tuple[Array, Array], display_window: tuple[Array, Array]
) -> Array:
    """Pixels [h, w] of the data window, moved into the display window [H, W]; 0 where none are.

    A renderer may store only the part of a picture that is not empty, or more than the picture.
    A window is the (x, y) of its first and of its last pixel.
    """
    height, width = _window_size(display_window)
    # Where the stored part begins in the picture; negative if it begins outside.
    data_first_pixel, _ = data_window
    picture_first_pixel, _ = display_window
    left = int(data_first_pixel[0]) - int(picture_first_pixel[0])
    top = int(data_first_pixel[1]) - int(picture_first_pixel[1])
    if (top, left) == (0, 0) and pixels.shape == (height, width):
        return pixels

    data_height, data_width = pixels.shape
    picture = np.zeros((height, width), pixels.dtype)
    # What of the stored part lies in the picture.
    rows = slice(max(top, 0), min(top + data_height, height))
    columns = slice(max(left, 0), min(left + data_width, width))
    if rows.start < rows.stop and columns.start < columns.stop:
        picture[rows, columns] = pixels[
            rows.start - top : rows.stop - top, columns.start - left : columns.stop - left
        ]
    return picture
