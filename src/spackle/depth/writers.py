"""Write depth maps as NumPy arrays, 16-bit PNG or OpenEXR; `save_depth` is the entry."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.codeccontext import VideoCodecContext
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.runtime.errors import unknown_suffix
from spackle.runtime.files import write_atomic

Metres = NDArray[np.float32]  # [H, W], 0 where unknown
DepthEncoder = Callable[[Metres], bytes]

MILLIMETRES_PER_METRE = 1000
MAX_MILLIMETRES = 65_535  # the highest number of 16 bits: 65.5 m


def check_depth_name(path: str | os.PathLike[str]) -> DepthEncoder:
    """The encoder of depth maps for a file name's suffix; InputError for an unknown suffix."""
    encoder = DEPTH_ENCODERS.get(Path(path).suffix.lower())
    if encoder is None:
        raise unknown_suffix(path, "not a name for a depth map", [*DEPTH_ENCODERS])
    return encoder


def save_depth(depth: Tensor, path: str | os.PathLike[str]) -> None:
    """Write depth [H, W] in metres, 0 where unknown.

    The suffix decides the format: .npy and .exr hold metres as float32, .png holds millimetres in
    16 bits. InputError for another suffix, and if the file cannot be written.
    """
    # An unknown suffix is refused before anything is written.
    encode = check_depth_name(path)
    write_atomic(path, encode(depth.cpu().numpy().astype(np.float32)))


def _encode_npy(depth: Metres) -> bytes:
    """The bytes of a .npy file."""
    file = io.BytesIO()
    np.save(file, depth)
    return file.getvalue()


def _encode_png(depth: Metres) -> bytes:
    """The bytes of a 16-bit PNG in millimetres; depths beyond 65.5 m become 65.5 m."""
    # Readers take 65535 for unknown, which suits depths that do not fit into 16 bits.
    millimetres = np.clip(np.round(depth * MILLIMETRES_PER_METRE), 0, MAX_MILLIMETRES)
    file = io.BytesIO()
    Image.fromarray(millimetres.astype(np.uint16)).save(file, format="PNG")
    return file.getvalue()


def _encode_exr(depth: Metres) -> bytes:
    """The bytes of an OpenEXR file with one channel, Y, as float32."""
    encoder = av.CodecContext.create("exr", "w")
    assert isinstance(encoder, VideoCodecContext)
    encoder.height, encoder.width = depth.shape
    encoder.pix_fmt = "grayf32le"
    encoder.time_base = Fraction(1)  # a codec needs one, also for a single picture
    picture = av.VideoFrame.from_ndarray(depth, format="grayf32le")
    # The second call, without a picture, says that no more follow.
    packets = [*encoder.encode(picture), *encoder.encode(None)]
    return b"".join(bytes(packet) for packet in packets)


DEPTH_ENCODERS: dict[str, DepthEncoder] = {
    ".npy": _encode_npy,
    ".png": _encode_png,
    ".exr": _encode_exr,
}
