"""The photo shows whether a map holds depth or inverse depth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import spackle
from spackle.bases.depth_order import (
    CLEAR_CORRELATION,
    depth_order_agreement,
    rank_correlation,
)
from spackle.bases.open import open_base, read_depth
from spackle.bases.settings import BaseSettings
from spackle.core.photo import Photo, photo_from_picture
from spackle.depth.readers import DepthValue, load_depth
from spackle.runtime.errors import InputError

Floats = NDArray[np.float32]


@pytest.fixture(scope="module")
def disc() -> tuple[Photo, Floats]:
    """A photo of an orange disc, 1.5 m away, before a striped wall at 4 m; and its depth."""
    rows, columns = np.mgrid[0:120, 0:160]
    stripes = [90 + 60 * np.sin(columns / 9), 120 + 60 * np.cos(rows / 7), 40 + columns]
    rgb = np.stack(stripes, -1).astype(np.uint8)
    is_disc = (columns - 80) ** 2 + (rows - 60) ** 2 < 30**2
    rgb[is_disc] = [220, 120, 60]
    return photo_from_picture(rgb), np.where(is_disc, 1.5, 4).astype(np.float32)


@pytest.mark.parametrize("levels", [2, 7, 1000])
def test_rank_correlation_is_scipys(levels: int) -> None:
    from scipy.stats import spearmanr  # only here: every process that collects tests would wait

    rng = np.random.default_rng(levels)
    first = rng.integers(0, levels, 300)
    second = first + rng.integers(0, levels, 300)
    assert rank_correlation(first, second) == pytest.approx(spearmanr(first, second).statistic)
    assert rank_correlation(first, np.zeros(300)) == 0


def test_depth_and_its_inverse_have_opposite_orders(disc: tuple[Photo, Floats]) -> None:
    photo, depth = disc
    agreement = depth_order_agreement(load_depth(DepthValue(depth)), photo)
    assert agreement > 2 * CLEAR_CORRELATION
    inverse = load_depth(DepthValue(1 / depth))
    assert depth_order_agreement(inverse, photo) == pytest.approx(-agreement)
    # Nearly everything is unknown: nothing can be said.
    sparse = np.where(np.arange(160) == 80, depth, 0)
    assert depth_order_agreement(load_depth(DepthValue(sparse)), photo) == 0


def read(photo: Photo, numbers: Floats, **options: object) -> spackle.DepthMap:
    settings = BaseSettings(depth=DepthValue(numbers), **options)  # type: ignore[arg-type]
    return read_depth(settings, DepthValue(numbers), photo)


def test_inverse_depth_is_not_taken_for_metres(disc: tuple[Photo, Floats]) -> None:
    photo, depth = disc
    inside_out = 9 / depth + 1  # plausible metres, as raw Depth Anything
    with pytest.raises(InputError, match="shows near would be far: give `depth_kind` near-white"):
        read(photo, inside_out)
    # The numbers of MiDaS are no metres, and the photo shows which kind they are.
    with pytest.raises(InputError, match="bright is near: give `depth_kind` near-white"):
        read(photo, 9000 / depth + 400)
    with pytest.raises(InputError, match="bright is far: give `depth_kind` near-black"):
        read(photo, (depth - 1.5) / 2.503 + np.linspace(0, 1e-3, 160, dtype=np.float32))
    # What the user says is believed.
    assert torch.equal(read(photo, inside_out, depth_unit="m").depth, torch.from_numpy(inside_out))
    assert read(photo, inside_out, depth_kind="metric").meaning == "metres"
    relative = read(photo, inside_out, depth_kind="near-white").depth
    assert float(relative[60, 80]) == pytest.approx(1.5)


def test_depth_in_the_photos_order_is_read_and_marked_as_a_guess(
    disc: tuple[Photo, Floats],
) -> None:
    photo, depth = disc
    for size in (1e-3, 1, 100, 1000):  # 4 km: far, but in the right order
        found = read(photo, depth * np.float32(size))
        assert found.is_guess
        np.testing.assert_allclose(found.depth.numpy(), depth * np.float32(size), rtol=1e-6)
    assert not read(photo, depth, depth_unit="m").is_guess


def test_a_loaded_map_takes_no_reading_options(disc: tuple[Photo, Floats]) -> None:
    _, depth = disc
    loaded = load_depth(DepthValue(depth))
    with pytest.raises(InputError, match="`depth_unit` mm: the depth map is loaded already"):
        open_base(BaseSettings(depth=loaded, depth_unit="mm"))
    with pytest.raises(InputError, match="`depth_unit` 'feet': give m, cm"):
        open_base(BaseSettings(depth=DepthValue(depth), depth_unit="feet"))
    with pytest.raises(InputError, match="leave out `depth_kind` near-white"):
        open_base(BaseSettings(depth=DepthValue(depth), depth_unit="m", depth_kind="near-white"))
