"""Writes `hdr PQ.mp4` and `hdr HLG.mp4` beside this file: `python make_hdr_clips.py`.

Each holds one frame of five squares, in PQ or HLG of BT.2020, 10 bits, narrow range, without loss.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

HERE = Path(__file__).resolve().parent
TESTS = HERE.parents[1]
sys.path[:0] = [str(TESTS), str(TESTS.parent / "src")]

from helpers.photo_files import HDR_CLIP_COLORS, as_hlg, as_pq, squares  # noqa: E402

RED_WEIGHT = 0.2627  # of luma in BT.2020
GREEN_WEIGHT = 0.6780
BLUE_WEIGHT = 0.0593
BT2020_CICP = 9
NARROW_RANGE = 1  # FFmpeg's number
# Without B frames, because with them x265 gives a stream of one frame a decoding time from memory
# that it has never written. Then the file cannot be written now and then.
X265_OPTIONS = "lossless=1:bframes=0:log-level=none"


def write_hdr_clip(
    path: Path, encode: Callable[[NDArray[Any]], NDArray[Any]], transfer: int
) -> None:
    """Write a clip of one frame; `encode` turns sRGB 0..255 into codes 0..1 of that transfer."""
    code = squares(encode(HDR_CLIP_COLORS))
    luma = code @ np.array([RED_WEIGHT, GREEN_WEIGHT, BLUE_WEIGHT])
    blue_difference = (code[..., 2] - luma) / (2 * (1 - BLUE_WEIGHT))
    red_difference = (code[..., 0] - luma) / (2 * (1 - RED_WEIGHT))
    # Narrow range of 10 bits: 64 to 940 for luma, 64 to 960 for the differences.
    planes = [luma * 876 + 64, blue_difference * 896 + 512, red_difference * 896 + 512]

    height, width = luma.shape
    with av.open(str(path), "w", options={"fflags": "+bitexact"}) as container:
        stream = container.add_stream("libx265", rate=10)
        stream.width = width
        stream.height = height
        stream.pix_fmt = "yuv444p10le"
        stream.options = {"x265-params": X265_OPTIONS, "preset": "ultrafast"}
        context = stream.codec_context
        context.color_primaries = BT2020_CICP
        context.color_trc = transfer
        context.colorspace = BT2020_CICP
        context.color_range = NARROW_RANGE
        frame = av.VideoFrame(width, height, "yuv444p10le")
        for plane, values in zip(frame.planes, planes, strict=True):
            rows = np.zeros((plane.height, plane.line_size // 2), "<u2")
            rows[:, : plane.width] = values.round()
            plane.update(rows.tobytes())
        for packet in [*stream.encode(frame), *stream.encode(None)]:
            container.mux(packet)


if __name__ == "__main__":
    write_hdr_clip(HERE / "hdr PQ.mp4", as_pq, transfer=16)
    write_hdr_clip(HERE / "hdr HLG.mp4", as_hlg, transfer=18)
