"""SOG 2, PlayCanvas's format: Gaussians as lossless WebP images, zipped into one file."""

from __future__ import annotations

import io
import json
import math
import zipfile

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.formats.scene_files import (
    SH_C0,
    Floats,
    GaussianColumns,
    SceneFile,
    codes_to_fractions,
    components_to_fractions,
    decode_smallest_three,
    encode_smallest_three,
    fractions_to_components,
)
from spackle.runtime.errors import InputError

LARGEST_SIDE = 16_380  # of a WebP image, a multiple of four
LARGEST_MEMBER = 1 << 28  # largest file in the archive, in bytes
CODES = 256  # entries of a codebook
BINS = 1 << 16  # bins into which values are sorted to build a codebook
EVEN = 0.25  # fraction of the codes that are spaced evenly
EFFORT = {
    "lossless": True,
    "exact": True,
    "quality": 25,
    "method": 1,
}  # exact: keeps colours if opacity is 0
EPOCH = (1980, 1, 1, 0, 0, 0)  # a constant, so that the same scene gives the same bytes


def encode_sog(scene: SceneFile) -> bytes:
    """Encode a scene as a bundled SOG file; the order of the Gaussians and the axes stay the same.

    Positions have 16 bits for each axis, spaced logarithmically from 0; scales and colours are looked up in codebooks.

    Raises:
        InputError: there are no Gaussians, or more than the images can hold.
        ValueError: a Gaussian is not finite.
    """
    count = len(scene.gaussians)
    if count == 0:
        raise InputError("SOG cannot hold a scene without Gaussians: use another format")
    width = math.ceil(math.sqrt(count) / 4) * 4
    if width > LARGEST_SIDE:
        raise InputError(f"{count:,} Gaussians are too many for SOG: use another format")
    columns = GaussianColumns.of(scene.gaussians)
    means, low, high = _means(columns.means)
    scale_book, scales = codebook(columns.log_scales)
    color_book, colors = codebook(columns.harmonics)
    opacities = np.round(columns.opacities * 255).astype(np.uint8)[:, None]
    opaque = np.full_like(opacities, 255)
    largest, others = encode_smallest_three(columns.quats)
    quats = np.concatenate(
        [np.round(components_to_fractions(others) * 255), largest[:, None] + 252], axis=1
    ).astype(np.uint8)
    pictures = {
        "means_l.webp": [(means & 255).astype(np.uint8), opaque],
        "means_u.webp": [(means >> 8).astype(np.uint8), opaque],
        "scales.webp": [scales, opaque],
        "quats.webp": [quats],
        "sh0.webp": [colors, opacities],
    }
    meta = {
        "version": 2,
        "asset": {"generator": "Spackle"},
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
    files = {name: _webp(np.concatenate(parts, axis=1), width) for name, parts in pictures.items()}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:  # WebP is compressed already
        for name, content in {
            "meta.json": json.dumps(meta, allow_nan=False).encode(),
            **files,
        }.items():
            archive.writestr(zipfile.ZipInfo(name, EPOCH), content)
    return buffer.getvalue()


def codebook(values: Floats) -> tuple[Floats, NDArray[np.uint8]]:
    """A codebook [256] for values [N, 3] with small squared error, and each value's code.

    The density of codes follows the cube root of the values' density, which is optimal for many codes. A quarter of the
    codes is evenly spaced, for rare values. Up to 256 different values get a code each.
    """
    low, high = float(values.min()), float(values.max())
    bins = np.minimum((values - low) * (BINS / max(high - low, 1e-30)), BINS - 1).astype(np.int32)
    flat = bins.ravel()
    counts = np.bincount(flat, minlength=BINS)
    different = np.count_nonzero(counts)
    if different <= CODES:
        code_of_bin = np.maximum(np.cumsum(counts > 0) - 1, 0).astype(np.uint8)
    else:
        roots = np.cbrt(counts)
        share = (1 - EVEN) * roots / roots.sum() + EVEN / BINS
        code_of_bin = ((np.cumsum(share) - share) * CODES).astype(np.uint8)
    sums = np.bincount(code_of_bin, np.bincount(flat, values.ravel(), BINS), CODES)
    totals = np.bincount(code_of_bin, counts, CODES)
    book = np.where(totals > 0, sums / np.maximum(totals, 1), high).astype(np.float32)
    return book, code_of_bin[bins]


def _means(means: Floats) -> tuple[NDArray[np.uint16], Floats, Floats]:
    """Quantise the logarithms of positions [N, 3] to 0..65535; also returns their lower and upper bounds, [3] each."""
    logs = np.copysign(np.log1p(np.abs(means)), means)
    low, high = logs.min(axis=0), logs.max(axis=0)
    span = np.maximum(high - low, np.float32(1e-30))
    return np.round((logs - low) / span * np.float32(65535)).astype(np.uint16), low, high


def _webp(rgba: NDArray[np.uint8], width: int) -> bytes:
    """Encode pixels [N, 4], row by row, as an image; unused pixels at the end are black."""
    height = math.ceil(len(rgba) / width / 4) * 4
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(rgba)] = rgba
    buffer = io.BytesIO()
    Image.fromarray(pixels.reshape(height, width, 4)).save(buffer, "WEBP", **EFFORT)
    return buffer.getvalue()


def decode_sog(data: bytes) -> GaussianColumns:
    """Decode a bundled SOG file of version 2; any exception if the file is damaged or of another version."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:

        def member(name: str) -> bytes:
            if archive.getinfo(name).file_size > LARGEST_MEMBER:
                raise ValueError(f"{name} is too large")
            return archive.read(name)

        meta = json.loads(member("meta.json"))
        if meta["version"] != 2:
            raise ValueError(f"version {meta['version']}, not 2")
        count = int(meta["count"])

        def pixels(name: str) -> NDArray[np.uint8]:
            """Pixels [N, 4] of an image, without the padding at its end."""
            with Image.open(io.BytesIO(member(name)), formats=["WEBP"]) as image:
                if max(image.size) > LARGEST_SIDE or not 0 < count <= image.width * image.height:
                    raise ValueError(
                        f"{name} has {image.width}×{image.height} pixels for {count:,} Gaussians"
                    )
                return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:count]

        (lower, upper), (scales,), (quats,), (sh0,) = (
            [pixels(name) for name in meta[key]["files"]]
            for key in ("means", "scales", "quats", "sh0")
        )
    low, high = (np.array(meta["means"][end], np.float32).reshape(3) for end in ("mins", "maxs"))
    logs = low + (high - low) * codes_to_fractions(
        upper[:, :3] * np.uint32(256) + lower[:, :3], 65535
    )
    largest = quats[:, 3].astype(np.int64) - 252
    if largest.min() < 0:
        raise ValueError("a rotation has no largest component")
    log_scales, harmonics = (
        np.array(meta[key]["codebook"], np.float32).reshape(CODES)[codes[:, :3]]
        for key, codes in (("scales", scales), ("sh0", sh0))
    )
    with np.errstate(over="ignore"):  # `GaussianColumns.gaussians` refuses infinite values
        means = np.copysign(np.expm1(np.abs(logs)), logs)
    turns = decode_smallest_three(
        largest, fractions_to_components(codes_to_fractions(quats[:, :3], 255))
    )
    srgb = np.clip(harmonics * np.float32(SH_C0) + np.float32(0.5), 0, 1)
    return GaussianColumns(means, turns, log_scales, codes_to_fractions(sh0[:, 3], 255), srgb)
