"""Uniform frames: found around pictures, and not found in skies, backgrounds and dark rooms."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from spackle.image import load_photo
from spackle.photo_frame import MIXED_PX, PhotoFrame, find_frame

WIDTH, HEIGHT = 181, 120
Picture = NDArray[np.float64]


def scene(width: int = WIDTH, height: int = HEIGHT) -> Picture:
    """A smooth coloured pattern in 0..1, [H, W, 3]."""
    y, x = np.mgrid[:height, :width] / 30.0
    return 0.5 + 0.2 * np.stack((np.sin(x + y), np.cos(2 * x - y), np.sin(3 * y) * np.cos(x)), axis=-1)


def framed(picture: Picture, widths: Sequence[int], color: Sequence[float]) -> Picture:
    """With a frame of so many pixels (left, top, right, bottom) around it."""
    left, top, right, bottom = widths
    sides = [(top, bottom), (left, right)]
    return np.stack([np.pad(picture[..., c], sides, constant_values=color[c]) for c in range(3)], axis=-1)


def found(picture: Picture, quality: int | None = None) -> PhotoFrame | None:
    """In a picture with 8 bits, perhaps saved as a JPEG before."""
    image = Image.fromarray(np.round(255 * picture.clip(0, 1)).astype(np.uint8))
    if quality is not None:
        image.save(file := io.BytesIO(), "JPEG", quality=quality)
        image = Image.open(file)
    return find_frame(torch.from_numpy(np.array(image)).float() / 255)


def cut(shade: str, *widths: int) -> PhotoFrame:
    """What is cut off a frame with a sharp edge."""
    return PhotoFrame(*(n + MIXED_PX * (n > 0) for n in widths), shade)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("widths", "color", "shade"),
    [
        ((9, 9, 9, 9), (0.03, 0.02, 0.02), "dark"),
        ((3, 14, 20, 4), (0.95, 0.92, 0.85), "light"),  # a mount of its own colour, as wide as it likes on each side
        ((0, 25, 0, 25), (0.0, 0.0, 0.0), "dark"),
        ((30, 0, 31, 0), (0.1, 0.15, 0.45), "dark"),
        ((0, 0, 7, 0), (1.0, 1.0, 1.0), "light"),  # a scanner's lid
        ((0, 6, 5, 0), (0.01, 0.0, 0.02), "dark"),
    ],
)
def test_a_frame_is_found_on_the_sides_that_have_it(widths: Sequence[int], color: Sequence[float], shade: str) -> None:
    whole = framed(scene(), widths, color)
    assert found(whole) == cut(shade, *widths)
    frame = found(whole + np.random.default_rng(0).normal(0, 1.5 / 255, whole.shape), quality=75)
    assert frame is not None
    for ours, wanted in zip(frame.widths, widths, strict=True):
        assert (ours == 0) if wanted == 0 else wanted <= ours <= wanted + 4


def test_a_scanners_dark_edge_and_a_line_beside_a_mount_belong_to_the_frame() -> None:
    picture = scene()
    picture[:, -2:] *= 0.6
    picture[:1] *= 0.8
    assert found(picture, 92) == PhotoFrame(0, 1, 2, 0, "dark")
    inner = framed(scene(), (2, 2, 2, 2), (0.0, 0.0, 0.0))
    assert found(framed(inner, (12, 12, 12, 12), (1.0, 1.0, 1.0))) == cut("light", 14, 14, 14, 14)


Y, X = (grid[..., None] for grid in np.mgrid[:HEIGHT, :WIDTH])
DISC = (X - WIDTH / 2) ** 2 + (Y - HEIGHT / 2) ** 2 < (HEIGHT / 3) ** 2
FRAMELESS = {
    "a picture": scene(),
    "blinds that begin at the border": np.where(Y % 6 < 2, 0.6 * scene(), scene()),
    "one colour": np.zeros((HEIGHT, WIDTH, 3)),
    "a sky that fades to its horizon": np.where(Y < 25, (0.3, 0.5, 0.9) + 0.01 * Y, scene()),
    "a blue sky above a wall's straight edge": np.where(Y < 25, (0.3, 0.5, 0.9), scene()),
    "a white sky above roofs": np.where(25 + 8 * np.sin(X / 9) > Y, 1.0, scene()),
    "a disc on white": np.where(DISC, scene(), 1.0),
    "a tilted box on white": np.where((abs(X - 90 + Y / 9) < 70) & (abs(Y - 60 - X / 9) < 40), scene(), 1.0),
    "a long box on white": np.where((Y > 15) & (Y < 105) & (abs(X - 90 + 40 * np.cos(Y / 20)) < 40), scene(), 1.0),
    "a vignette": scene() * np.exp(-(((X - WIDTH / 2) / 60) ** 4) - ((Y - HEIGHT / 2) / 40) ** 4),
    "a dark wall beside a lit door": np.where(X < 30 + Y / 20, 0.05, scene()),
    "bars of two colours": np.where(X < 12, (0.2, 0.3, 0.5), np.where(X > 160, (0.5, 0.2, 0.2), scene())),
    "too wide a bar": np.where(X < 60, 0.0, scene()),
    "a pixel": scene(1, 1),
    "a speck": framed(scene(3, 3), (1, 1, 1, 1), (0.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("kind", FRAMELESS)
def test_what_only_looks_like_a_frame_is_none(kind: str) -> None:
    assert found(FRAMELESS[kind]) is None


def test_a_loaded_photo_is_what_is_inside_and_so_is_its_lens(tmp_path: Path) -> None:
    whole = np.round(255 * framed(scene(), (9, 8, 10, 11), (1.0, 1.0, 1.0))).astype(np.uint8)
    opaque = np.zeros((*whole.shape[:2], 1), np.uint8)
    opaque[8:-11, 9:-10] = 255  # the frame is transparent, hence white
    Image.fromarray(np.concatenate([whole, opaque], axis=-1)).save(path := tmp_path / "a.png")
    as_it_is = load_photo(path)
    assert (as_it_is.frame, (as_it_is.width, as_it_is.height)) == (None, whole.shape[1::-1])
    photo = load_photo(path, fov=90, keep_frame=False)
    assert photo.frame == cut("light", 9, 8, 10, 11)
    assert torch.equal(photo.rgb, as_it_is.rgb[9:-12, 10:-11])
    assert photo.framed_size == as_it_is.framed_size == whole.shape[1::-1]
    assert photo.focal_px == pytest.approx(photo.width / 2)
    assert load_photo(path, focal_px=70, keep_frame=False).focal_px == 70
