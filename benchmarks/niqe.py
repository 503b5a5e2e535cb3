"""NIQE (Mittal, Soundararajan, Bovik 2013), how unlike pristine photos a picture's statistics are, without a reference.

The picture's luma is divided by its local contrast; 36 parameters of generalised Gaussians describe each block of
96×96 pixels, at full and at half size. NIQE is the distance of the blocks' mean and covariance from those of pristine
photos: about 3 for a good photo, more for blur, noise and seams. Numbers depend on the size of the picture.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from spackle.errors import InputError, reading
from spackle.files import check_file

Array = NDArray[np.float64]

BLOCK = 96  # pixels; half as many at half size
FEATURES = 36
LUMA = (65.481 / 255, 128.553 / 255, 24.966 / 255)  # BT.601 in 16..235, of RGB 0..255
NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # whose products with a pixel count, (down, right)
HALVING = (-0.01171875, -0.03515625, 0.11328125, 0.43359375)  # outer to inner, half of the bicubic (a −0.5) over 8 taps


@dataclasses.dataclass(frozen=True)
class NiqeModel:
    """The features of pristine photos."""

    mean: Array  # [36]
    covariance: Array  # [36, 36]
    window: Array  # [7, 7] Gaussian, of sum 1


def load_niqe(path: Path) -> NiqeModel:
    """Read `mu_pris_param`, `cov_pris_param` and `gaussian_window` from an .npz file; InputError for any other."""
    check_file(path, "NIQE model")
    problem = "no NIQE model ({reason}): give niqe_pris_params.npz as BasicSR has it"
    with reading(path, problem), open(path, "rb") as file, np.load(file, allow_pickle=False) as arrays:
        mean, covariance, window = (
            arrays[name].astype(np.float64) for name in ("mu_pris_param", "cov_pris_param", "gaussian_window")
        )
        model = NiqeModel(mean.reshape(FEATURES), covariance.reshape(FEATURES, FEATURES), window.reshape(7, 7))
    if not all(np.isfinite(part).all() for part in (model.mean, model.covariance, model.window)):
        raise InputError(f"{path}: no NIQE model (numbers that are not finite): get the file again")
    return model


def niqe(rgb: Tensor, model: NiqeModel) -> float:
    """NIQE of a picture [H, W, 3], sRGB 0..1; lower is better.

    Raises:
        ValueError: fewer than two blocks have contrast.
    """
    features = picture_features(rgb, model.window)
    if len(features) < 2:
        raise ValueError(f"NIQE needs two blocks of {BLOCK}×{BLOCK} pixels with contrast")
    apart = model.mean - features.mean(axis=0)
    together = (model.covariance + np.cov(features, rowvar=False)) / 2
    return math.sqrt(float(apart @ np.linalg.pinv(together) @ apart))


def picture_features(rgb: Tensor, window: Array) -> Array:
    """Features [n, 36] of a picture's blocks that have contrast; `rgb` [H, W, 3] sRGB 0..1.

    Luma is rounded to whole numbers. Rows and columns that fill no block are left out at the bottom and the right.
    """
    luma = np.rint(255 * (rgb.detach().cpu().double().clamp(0, 1).numpy() @ np.array(LUMA)) + 16)
    rows, columns = luma.shape[0] // BLOCK, luma.shape[1] // BLOCK
    if not rows * columns:
        return np.empty((0, FEATURES))
    luma = luma[: rows * BLOCK, : columns * BLOCK]
    parts = []
    for picture, side in ((luma, BLOCK), (halved(luma), BLOCK // 2)):
        blocks = mscn(picture, window).reshape(rows, side, columns, side).swapaxes(1, 2)
        parts.append(block_features(blocks.reshape(-1, side, side)))
    features = np.concatenate(parts, axis=1)
    return features[np.isfinite(features).all(axis=1)]


def mscn(luma: Array, window: Array) -> Array:
    """Luma [H, W] less its local mean, over its local standard deviation + 1; edge pixels are repeated outwards."""
    mean, square = _windowed(luma, window), _windowed(luma * luma, window)
    deviation: Array = np.sqrt(np.abs(square - mean * mean))
    return (luma - mean) / (deviation + 1)


def _windowed(picture: Array, window: Array) -> Array:
    """Mean under a square window [n, n] at each pixel, [H, W]."""
    reach = len(window) // 2
    wide = np.pad(picture, reach, mode="edge")
    total = np.zeros_like(picture)
    for (y, x), weight in np.ndenumerate(window):
        total += weight * wide[y : y + picture.shape[0], x : x + picture.shape[1]]
    return total


def halved(picture: Array) -> Array:
    """Half the size by an antialiased bicubic, [H/2, W/2] of even sides; mirrored at the edges."""
    for _ in range(2):  # along the rows, then along the columns
        wide = np.pad(picture, ((3, 3), (0, 0)), mode="symmetric")
        rows = picture.shape[0] - 1
        taps = [tap * (wide[k : k + rows : 2] + wide[7 - k : 7 - k + rows : 2]) for k, tap in enumerate(HALVING)]
        picture = np.array(np.sum(taps, axis=0).T, np.float64)
    return picture


def block_features(blocks: Array) -> Array:
    """[n, h, w] of `mscn` to [n, 18]: (shape, mean width) of the pixels; four times (shape, mean, left, right width).

    The four are of products with neighbours; a block goes on at its other side.
    """
    shape, left, right = fit_aggd(blocks)
    features = [shape, (left + right) / 2]
    for offset in NEIGHBOURS:
        shape, left, right = fit_aggd(blocks * np.roll(blocks, offset, axis=(1, 2)))
        features += [shape, (right - left) * _gamma(2 / shape) / _gamma(1 / shape), left, right]
    return np.stack(features, axis=1)


def fit_aggd(blocks: Array) -> tuple[Array, Array, Array]:
    """Asymmetric generalised Gaussians by moments: shape, left and right width, [n] each of [n, h, w].

    The density is in proportion to exp(−(−x / left)^shape) for x < 0, and to exp(−(x / right)^shape) beyond. NaN where
    one side is empty.
    """
    x = blocks.reshape(len(blocks), -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = x * x
        left, right = (np.sqrt((square * side).sum(1) / side.sum(1)) for side in (x < 0, x > 0))
        skew = left / right
        ratio = np.abs(x).mean(1) ** 2 / square.mean(1)
        wanted = ratio * (skew**3 + 1) * (skew + 1) / (skew**2 + 1) ** 2
    shapes, ratios = _shape_table()
    nearest = np.abs(ratios - wanted[:, None]).argmin(1)
    shape = np.where(np.isfinite(wanted), shapes[nearest], np.nan)
    width = np.sqrt(_gamma(1 / shape) / _gamma(3 / shape))
    return shape, left * width, right * width


@functools.lru_cache(maxsize=1)
def _shape_table() -> tuple[Array, Array]:
    """Shapes from 0.2 to 10, and E[|x|]² / E[x²] of a symmetric generalised Gaussian of each."""
    shapes = np.arange(200, 10001) / 1000
    return shapes, _gamma(2 / shapes) ** 2 / (_gamma(1 / shapes) * _gamma(3 / shapes))


def _gamma(values: Array) -> Array:
    """The gamma function of each value; NaN of NaN."""
    return np.array([math.gamma(value) for value in values.tolist()])
