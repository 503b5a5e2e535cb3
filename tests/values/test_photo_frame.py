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
    waves = (np.sin(x + y), np.cos(2 * x - y), np.sin(3 * y) * np.cos(x))
    return 0.5 + 0.2 * np.stack(waves, axis=-1)


def framed(picture: Picture, widths: Sequence[int], color: Sequence[float]) -> Picture:
    """With a frame of so many pixels (left, top, right, bottom) around it."""
    left, top, right, bottom = widths
    height, width = picture.shape[:2]
    whole = np.ones((height + top + bottom, width + left + right, 3)) * color
    whole[top : top + height, left : left + width] = picture
    return whole


def found(picture: Picture, quality: int | None = None) -> PhotoFrame | None:
    """In a picture with 8 bits, perhaps saved as a JPEG before."""
    image = Image.fromarray(np.round(255 * picture.clip(0, 1)).astype(np.uint8))
    if quality is not None:
        file = io.BytesIO()
        image.save(file, "JPEG", quality=quality)
        image = Image.open(file)
    return find_frame(torch.from_numpy(np.array(image)).float() / 255)


def cut(*widths: int) -> tuple[int, ...]:
    """What is cut off a frame with a sharp edge."""
    return tuple(n + MIXED_PX * (n > 0) for n in widths)


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
    frame = found(framed(scene(), widths, color))
    assert frame is not None
    assert (frame.widths, frame.shade) == (cut(*widths), shade)
    whole = framed(scene(), widths, color)
    frame = found(whole + np.random.default_rng(0).normal(0, 1.5 / 255, whole.shape), quality=75)
    assert frame is not None
    for ours, wanted in zip(frame.widths, widths, strict=True):
        assert (ours == 0) if wanted == 0 else wanted <= ours <= wanted + 4


def test_an_edge_that_a_scanner_darkened_is_cut_off_and_lines_of_the_picture_are_not() -> None:
    picture = scene()
    picture[:, -2:] *= 0.6
    picture[:1] *= 0.8
    frame = found(picture, 92)
    assert frame is not None
    assert (frame.widths, frame.shade) == ((0, 1, 2, 0), "dark")
    picture = scene()
    picture[np.arange(HEIGHT) % 6 < 2] *= 0.6  # blinds begin at the border, and go on
    assert found(picture) is None


def test_a_line_between_mount_and_picture_belongs_to_the_frame() -> None:
    inner = framed(scene(), (2, 2, 2, 2), (0.0, 0.0, 0.0))
    frame = found(framed(inner, (12, 12, 12, 12), (1.0, 1.0, 1.0)))
    assert frame is not None
    assert (frame.widths, frame.shade) == (cut(14, 14, 14, 14), "light")


def with_box(background: Picture) -> Picture:
    """A box in the middle that leaves an eighth of the picture to each side."""
    height, width = background.shape[:2]
    rows, columns = slice(height // 8, -(height // 8)), slice(width // 8, -(width // 8))
    picture = background.copy()
    picture[rows, columns] = scene()[rows, columns]
    return picture


PLAIN = np.ones((HEIGHT, WIDTH, 3))
Y, X = (grid[..., None] for grid in np.mgrid[:HEIGHT, :WIDTH])
DISC = (X - WIDTH / 2) ** 2 + (Y - HEIGHT / 2) ** 2 < (HEIGHT / 3) ** 2
FRAMELESS = {
    "a picture": scene(),
    "one colour": 0 * PLAIN,
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
    opaque = np.full((*whole.shape[:2], 1), 255, np.uint8)
    opaque[:8] = opaque[-11:] = opaque[:, :9] = opaque[:, -10:] = 0  # transparent, hence white
    Image.fromarray(np.concatenate([whole, opaque], axis=-1)).save(path := tmp_path / "a.png")
    as_it_is = load_photo(path)
    assert as_it_is.frame is None
    assert (as_it_is.width, as_it_is.height) == as_it_is.framed_size == whole.shape[1::-1]
    photo = load_photo(path, fov=90, keep_frame=False)
    assert photo.frame == PhotoFrame(*cut(9, 8, 10, 11), "light")
    assert torch.equal(photo.rgb, as_it_is.rgb[9:-12, 10:-11])
    assert photo.framed_size == whole.shape[1::-1]
    assert photo.focal_px == pytest.approx(photo.width / 2)
    assert load_photo(path, focal_px=70, keep_frame=False).focal_px == 70
