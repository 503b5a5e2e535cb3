"""NIQE beside direct loops, beside distributions of known parameters, and on a photo that gets worse."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from niqe import NiqeModel, block_features, fit_aggd, halved, load_niqe, mscn, niqe, picture_features

from spackle.errors import InputError

WINDOW = np.outer(*2 * [np.exp(-0.5 * (np.arange(-3, 4) / (7 / 6)) ** 2)])
WINDOW /= WINDOW.sum()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_features_are_those_of_loops_over_pixels(rng: np.random.Generator) -> None:
    luma = rng.uniform(16, 235, (20, 24))
    ours = mscn(luma, WINDOW)
    for y, x in ((0, 0), (9, 11), (19, 23), (2, 22)):
        near = np.array(
            [[luma[np.clip(y + j, 0, 19), np.clip(x + i, 0, 23)] for i in range(-3, 4)] for j in range(-3, 4)]
        )
        mean = (WINDOW * near).sum()
        assert ours[y, x] == pytest.approx((luma[y, x] - mean) / (math.sqrt((WINDOW * (near - mean) ** 2).sum()) + 1))
    height, width = ours.shape
    diagonal = [[ours[y, x] * ours[y - 1, (x + 1) % width] for x in range(width)] for y in range(height)]
    shape, left, right = (float(part[0]) for part in fit_aggd(np.array([diagonal])))
    expected = [shape, (right - left) * math.gamma(2 / shape) / math.gamma(1 / shape), left, right]
    np.testing.assert_allclose(block_features(ours[None])[0, 14:], expected)
    theirs = F.interpolate(torch.from_numpy(luma)[None, None], scale_factor=0.5, mode="bicubic", antialias=True)
    np.testing.assert_allclose(halved(luma)[2:-2, 2:-2], theirs[0, 0, 2:-2, 2:-2].numpy(), rtol=1e-5)  # edges: mirrored


def test_a_photo_that_gets_worse_is_farther_from_photos(rng: np.random.Generator) -> None:
    data = pytest.importorskip("skimage.data")
    left, right = (torch.from_numpy(photo / 255.0) for photo in data.stereo_motorcycle()[:2])
    pristine = picture_features(left, WINDOW)
    model = NiqeModel(pristine.mean(0), np.cov(pristine, rowvar=False), WINDOW)
    assert niqe(left, model) == pytest.approx(0, abs=1e-9)
    noisy = right + torch.from_numpy(rng.normal(0, 0.05, right.shape))
    blurred = F.avg_pool2d(right.movedim(-1, 0), 5, 1, 2).movedim(0, -1)
    scores = [niqe(picture, model) for picture in (right, noisy, blurred)]
    assert 0.1 < scores[0] < 0.5 * min(scores[1:]), scores


def test_what_cannot_be_measured(tmp_path: Path) -> None:
    model = NiqeModel(np.zeros(36), np.eye(36), WINDOW)
    for picture in (torch.rand(96, 96, 3), torch.rand(50, 300, 3), torch.full((192, 192, 3), 0.5)):
        with pytest.raises(ValueError, match="two blocks"):
            niqe(picture, model)
    path = tmp_path / "pristine.npz"
    good = {"mu_pris_param": np.ones((1, 36)), "cov_pris_param": np.eye(36), "gaussian_window": WINDOW}
    np.savez(path, **good)
    assert load_niqe(path).mean.shape == (36,)
    for spoiled in ({"gaussian_window": np.ones(3)}, {"mu_pris_param": np.full(36, np.nan)}):
        np.savez(path, **good | spoiled)
        with pytest.raises(InputError, match=r"pristine\.npz"):
            load_niqe(path)
