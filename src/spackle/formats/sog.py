"""SOG, PlayCanvas's format: Gaussians as lossless WebP images, in a folder or zipped into one file.

A pixel is a Gaussian. In version 2, scales and colours are indices into codebooks of 256 values; in
version 1, fractions between two bounds. `encode_sog` writes version 2; `sog_reader.py` reads both.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.formats.gaussian_columns import Floats, GaussianColumns
from spackle.formats.palette import palette_labels
from spackle.formats.quantization import (
    MAX_DISTANCE_RATIO,
    components_to_fractions,
    encode_smallest_three,
    near_distance,
    ordinary_length_factor,
    shrink_distant,
)
from spackle.formats.scene_content import SceneFile
from spackle.runtime.errors import InputError

MAX_IMAGE_SIDE_PX = 16_380  # pixels; the largest multiple of four that a WebP image can have

CODEBOOK_SIZE = 256
# Values are counted in this many bins to find a codebook for them.
BIN_COUNT = 1 << 16
# The part of the codes that is spaced evenly; the others follow the values' density.
EVEN_CODES_SHARE = 0.25

LENGTH_FACTOR_KEY = "spackleLengthFactor"  # of the number by which all lengths were multiplied
MAX_POSITION_CODE = 65_535  # a coordinate has 16 bits

# A range of equal values counts as this wide, so that no fraction divides by zero.
MIN_SPAN = 1e-30

# A pixel's alpha holds the index 0..3 of a quaternion's largest component, plus this number.
FIRST_LARGEST_COMPONENT_CODE = 252

# `exact` keeps the colours of pixels whose alpha is 0. A slower method saves little.
WEBP_OPTIONS: dict[str, Any] = {"lossless": True, "exact": True, "quality": 25, "method": 1}

MAX_PALETTE_ENTRIES = 1 << 16  # of harmonics; an entry's number has 16 bits
PALETTE_COLUMNS = 64  # entries of harmonics in a row of the image of their palette

META_NAME = "meta.json"  # the file that describes the images

# A constant time for files in the archive, so that the same scene gives the same bytes.
ARCHIVE_TIME = (1980, 1, 1, 0, 0, 0)


def encode_sog(scene: SceneFile) -> bytes:
    """Encode a scene as a bundled SOG file: a zip archive of images, one Gaussian a pixel.

    The order of the Gaussians and the axes stay the same. A coordinate has 16 bits on a
    logarithmic scale, whose steps are small near 0. A scale or colour is a byte, the index of a
    value in a codebook. Gaussians with similar harmonics share them: a palette has at most 65,536.

    Raises:
        InputError: there are no Gaussians, or more than the images can hold.
        ValueError: a Gaussian is not finite.
    """
    count = len(scene.gaussians)
    if count == 0:
        raise InputError("SOG cannot hold a scene without Gaussians: use another format")
    # The images are about square. Both sides are multiples of four, as in the files of
    # splat-transform, the format's program.
    width = math.ceil(math.sqrt(count) / 4) * 4
    if width > MAX_IMAGE_SIDE_PX:
        raise InputError(f"{count:,} Gaussians are too many for SOG: use another format")

    columns = GaussianColumns.from_gaussians(scene.gaussians)
    # The logarithmic scale is fine for lengths around 1. A scene that is not in metres is stored in
    # another unit; other readers pass over the number that says which.
    length_factor = ordinary_length_factor(columns.means)
    columns = columns.scaled(length_factor)
    farthest = MAX_DISTANCE_RATIO * near_distance(columns.means)
    if np.abs(columns.means).max() > farthest > 0:
        columns = shrink_distant(columns, farthest)
    positions, low, high = _quantize_positions(columns.means)
    scale_book, scale_codes = codebook(columns.log_scales)
    color_book, color_codes = codebook(columns.constant_harmonics)
    asset: dict[str, Any] = {"generator": "Spackle"}
    if length_factor != 1:
        asset[LENGTH_FACTOR_KEY] = length_factor
    meta = {
        "version": 2,
        "asset": asset,
        "count": count,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scale_book.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_book.tolist(), "files": ["sh0.webp"]},
    }

    opacities = np.round(columns.opacities * 255).astype(np.uint8)[:, None]  # [N, 1]
    opaque = np.full_like(opacities, 255)
    low_bytes = (positions & 255).astype(np.uint8)
    high_bytes = (positions >> 8).astype(np.uint8)
    # The pixels [N, 4] of each image.
    pixels = {
        "means_l.webp": np.concatenate([low_bytes, opaque], axis=1),
        "means_u.webp": np.concatenate([high_bytes, opaque], axis=1),
        "scales.webp": np.concatenate([scale_codes, opaque], axis=1),
        "quats.webp": _encode_rotations(columns.quats),
        "sh0.webp": np.concatenate([color_codes, opacities], axis=1),
    }
    images = {name: _encode_webp(rgba, width) for name, rgba in pixels.items()}
    if columns.harmonics is not None:
        palette, palette_images = _encode_harmonics(columns.harmonics, width)
        palette["bands"] = columns.harmonics_degree
        meta["shN"] = palette
        images |= palette_images
    members = {META_NAME: json.dumps(meta, allow_nan=False).encode(), **images}
    return _zip_members(members)


def _encode_harmonics(harmonics: Floats, width: int) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Encode coefficients [N, K, 3] by a palette: its description, and two images by name.

    `width` is that of the image with the Gaussians' numbers in the palette.
    """
    count, harmonics_count, _ = harmonics.shape
    labels = palette_labels(harmonics.reshape(count, -1), MAX_PALETTE_ENTRIES)  # [N]
    entry_count = int(labels.max()) + 1
    order = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[order], np.arange(entry_count))
    sizes = np.diff(np.append(starts, count))[:, None]
    sums = np.add.reduceat(harmonics.reshape(count, -1)[order], starts, axis=0, dtype=np.float64)
    entries = (sums / sizes).astype(np.float32)  # [P, 3·K], the mean of those that share an entry

    book, codes = codebook(entries.reshape(-1, 3))
    centroids = np.full((len(codes), 4), 255, np.uint8)
    centroids[:, :3] = codes
    label_pixels = np.zeros((count, 4), np.uint8)
    label_pixels[:, 0] = labels & 255
    label_pixels[:, 1] = labels >> 8
    label_pixels[:, 3] = 255
    description = {
        "count": entry_count,
        "codebook": book.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    images = {
        "shN_centroids.webp": _encode_webp(centroids, PALETTE_COLUMNS * harmonics_count, 1),
        "shN_labels.webp": _encode_webp(label_pixels, width),
    }
    return description, images


def codebook(values: Floats) -> tuple[Floats, NDArray[np.uint8]]:
    """Find 256 values with which given values can be stored with a small squared error.

    Values are counted in bins. Where many values lie, many codes lie: the density of the codes is
    the cube root of the values' density, which gives the smallest error for many codes. A quarter
    of the codes is evenly spaced instead, so that rare values have codes nearby. If at most 256
    bins are in use, each gets a code of its own.

    Args:
        values: [N, 3].

    Returns:
        The codebook [256], and the code [N, 3] of each value: its index in the codebook. Codes
        that no value has stand for the largest value.
    """
    low = float(values.min())
    high = float(values.max())
    bin_per_value = BIN_COUNT / max(high - low, MIN_SPAN)
    bins = np.minimum((values - low) * bin_per_value, BIN_COUNT - 1).astype(np.int32)
    bin_counts = np.bincount(bins.ravel(), minlength=BIN_COUNT)  # [BIN_COUNT]

    used_bin_count = np.count_nonzero(bin_counts)
    if used_bin_count <= CODEBOOK_SIZE:
        # The bins in use get the codes 0, 1, 2, …; bin 0 is in use, because it has the smallest
        # value. The codes of empty bins do not matter.
        code_of_bin = (np.cumsum(bin_counts > 0) - 1).astype(np.uint8)
    else:
        # The codes are laid out along the bins, and each bin takes its share of them. A bin has
        # the code at which its share begins; a code may thus have many bins with small shares.
        roots = np.cbrt(bin_counts)
        share = (1 - EVEN_CODES_SHARE) * roots / roots.sum() + EVEN_CODES_SHARE / BIN_COUNT
        share_before = np.cumsum(share) - share
        code_of_bin = (share_before * CODEBOOK_SIZE).astype(np.uint8)

    # A code stands for the mean of the values that have it.
    sum_of_bin = np.bincount(bins.ravel(), values.ravel(), BIN_COUNT)
    sum_of_code = np.bincount(code_of_bin, sum_of_bin, CODEBOOK_SIZE)
    count_of_code = np.bincount(code_of_bin, bin_counts, CODEBOOK_SIZE)
    mean_of_code = sum_of_code / np.maximum(count_of_code, 1)
    book = np.where(count_of_code > 0, mean_of_code, high).astype(np.float32)
    return book, code_of_bin[bins]


def _quantize_positions(means: Floats) -> tuple[NDArray[np.uint16], Floats, Floats]:
    """Quantise positions [N, 3] on a logarithmic scale, whose steps are small near the origin.

    Returns:
        The codes [N, 3] in 0..65535 of sign(x) · ln(1 + |x|), and the lower and upper bound [3]
        of these logarithms, to which the codes 0 and 65535 belong.
    """
    log_positions = np.copysign(np.log1p(np.abs(means)), means)
    low = log_positions.min(axis=0)
    high = log_positions.max(axis=0)
    span = np.maximum(high - low, np.float32(MIN_SPAN))
    fractions = (log_positions - low) / span
    codes = np.round(fractions * np.float32(MAX_POSITION_CODE)).astype(np.uint16)
    return codes, low, high


def _encode_rotations(quats: Floats) -> NDArray[np.uint8]:
    """Encode unit quaternions [N, 4] (w, x, y, z) as pixels [N, 4].

    Red, green and blue hold the three smaller components, with 0 for -√½ and 255 for √½. Alpha is
    252 plus the index of the largest component.
    """
    largest, others = encode_smallest_three(quats)
    other_codes = np.round(components_to_fractions(others) * 255)  # [N, 3]
    largest_codes = largest[:, None] + FIRST_LARGEST_COMPONENT_CODE  # [N, 1]
    return np.concatenate([other_codes, largest_codes], axis=1).astype(np.uint8)


def _encode_webp(rgba: NDArray[np.uint8], width: int, row_unit: int = 4) -> bytes:
    """Encode pixels [N, 4], row by row, as an image; unused pixels at the end are black.

    The number of rows is a multiple of `row_unit`: of four for Gaussians, as in the files of
    splat-transform, the format's program.
    """
    height = math.ceil(len(rgba) / width / row_unit) * row_unit
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255  # opaque
    pixels[: len(rgba)] = rgba
    buffer = io.BytesIO()
    Image.fromarray(pixels.reshape(height, width, 4)).save(buffer, "WEBP", **WEBP_OPTIONS)
    return buffer.getvalue()


def _zip_members(members: Mapping[str, bytes]) -> bytes:
    """Return a zip archive of files by name, not compressed, because WebP already is."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(name, ARCHIVE_TIME), content)
    return buffer.getvalue()
