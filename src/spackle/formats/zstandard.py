"""Zstandard, a compression like zlib: Python's own module, or its backport for older Pythons."""

from __future__ import annotations

import sys
from typing import Any

from spackle.runtime.errors import InputError

LEVEL = 12  # as Niantic's own library compresses

# A frame may not ask for a window of more than 2^27 bytes (128 MiB), which Zstandard's own program
# does not accept either.
MAX_WINDOW_BITS = 27


def compress(data: bytes) -> bytes:
    """Return a Zstandard frame that holds `data`."""
    frame: bytes = _zstd_module().compress(data, level=LEVEL)
    return frame


def decompress(frame: bytes, max_bytes: int) -> bytes:
    """Return what a Zstandard frame holds, but at most the first `max_bytes` bytes.

    Raises:
        Exception: any exception, if the frame is damaged or cut off.
    """
    zstd = _zstd_module()
    options = {zstd.DecompressionParameter.window_log_max: MAX_WINDOW_BITS}
    # A call may return less than it is allowed to, so it is repeated until nothing more comes.
    decompressor = zstd.ZstdDecompressor(options=options)
    parts = [decompressor.decompress(frame, max_length=max_bytes)]
    byte_count = len(parts[0])
    while byte_count < max_bytes and not decompressor.eof and not decompressor.needs_input:
        part = decompressor.decompress(b"", max_length=max_bytes - byte_count)
        parts.append(part)
        byte_count += len(part)
    return b"".join(parts)


def _zstd_module() -> Any:
    """Return the module; InputError that says what to install if there is none."""
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError as error:  # an environment that was made before SPZ 4 was read
        raise InputError(
            "SPZ version 4 needs the package backports.zstd: pip install backports.zstd"
        ) from error
    return zstd
