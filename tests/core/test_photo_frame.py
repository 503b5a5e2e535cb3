"""Uniform frames and thin rims: found around pictures, not in skies, backgrounds and dark rooms."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from PIL import Image

from spackle.core.photo import load_photo, resize_photo
from spackle.core.photo_frame import PhotoFrame, find_frame

WIDTH, HEIGHT = 181, 120
Picture = NDArray[np.float64]


def scene(width: int = WIDTH, height: int = HEIGHT) -> Picture:
    """A smooth coloured pattern in 0..1, [H, W, 3]."""
    y, x = np.mgrid[:height, :width] / 30.0
    return 0.5 + 0.2 * np.stack(
        (np.sin(x + y), np.cos(2 * x - y), np.sin(3 * y) * np.cos(x)), axis=-1
    )


def framed(picture: Picture, widths: Sequence[int], color: Sequence[float]) -> Picture:
    """Add a frame of these widths (left, top, right, bottom)."""
    left, top, right, bottom = widths
    sides = [(top, bottom), (left, right)]
    return np.stack(
        [np.pad(picture[..., c], sides, constant_values=color[c]) for c in range(3)], axis=-1
    )


def found(picture: Picture, quality: int | None = None) -> PhotoFrame | None:
    """Find the frame after rounding to 8 bits and, with `quality`, JPEG compression."""
    image = Image.fromarray(np.round(255 * picture.clip(0, 1)).astype(np.uint8))
    if quality is not None:
        image.save(file := io.BytesIO(), "JPEG", quality=quality)
        image = Image.open(file)
    return find_frame(torch.from_numpy(np.array(image)).float() / 255)


FRAMES = [
    ((9, 9, 9, 9), (0.03, 0.02, 0.02)),
    ((3, 14, 20, 4), (0.95, 0.92, 0.85)),  # a mount of different widths
    ((0, 25, 0, 25), (0.0, 0.0, 0.0)),
    ((30, 0, 31, 0), (0.1, 0.15, 0.45)),
    ((8, 12, 9, 0), (1.0, 1.0, 1.0)),  # the fourth side has a caption
]


@pytest.mark.parametrize(("widths", "color"), FRAMES)
def test_frames_are_found_on_their_sides(widths: Sequence[int], color: Sequence[float]) -> None:
    whole = framed(scene(), widths, color)
    noise = np.random.default_rng(0).normal(0, 1.5 / 255, whole.shape)
    for frame in (found(whole), found(whole + noise, quality=75)):
        assert frame is not None
        for ours, wanted in zip(frame, widths, strict=True):
            assert (ours == 0) if wanted == 0 else wanted <= ours <= wanted + 4


def test_a_line_between_mount_and_picture_belongs_to_the_frame() -> None:
    inner = framed(scene(), (3, 3, 3, 3), (0.0, 0.0, 0.0))
    frame = found(framed(inner, (12, 12, 12, 12), (1.0, 1.0, 1.0)))
    assert frame is not None
    assert min(frame) >= 15


Y, X = (grid[..., None] for grid in np.mgrid[:HEIGHT, :WIDTH])
DISC = (X - WIDTH / 2) ** 2 + (Y - HEIGHT / 2) ** 2 < (HEIGHT / 3) ** 2
FRAMELESS = {
    "a picture": scene(),
    "blinds that begin at the border": np.where(Y % 6 < 2, 0.6 * scene(), scene()),
    "one colour": np.zeros((HEIGHT, WIDTH, 3)),
    "a blue sky above a wall's straight edge": np.where(Y < 25, (0.3, 0.5, 0.9), scene()),
    "a white sky above roofs": np.where(25 + 8 * np.sin(X / 9) > Y, 1.0, scene()),
    "a disc on white": np.where(DISC, scene(), 1.0),
    "a long box on white": np.where(
        (Y > 15) & (Y < 105) & (abs(X - 90 + 40 * np.cos(Y / 20)) < 40), scene(), 1.0
    ),
    "a vignette": scene() * np.exp(-(((X - WIDTH / 2) / 60) ** 4) - ((Y - HEIGHT / 2) / 40) ** 4),
    "a dark wall beside a lit door": np.where(X < 30 + Y / 20, 0.05, scene()),
    "bars of two colours": np.where(
        X < 12, (0.2, 0.3, 0.5), np.where(X > 160, (0.5, 0.2, 0.2), scene())
    ),
    "too wide a bar": np.where(X < 60, 0.0, scene()),
    "a floor that darkens towards the border": scene() * np.minimum(1, 0.4 + (HEIGHT - Y) / 25),
    "a bar on one side": framed(scene(), (0, 0, 7, 0), (1.0, 1.0, 1.0)),
    "a pixel": scene(1, 1),
}


@pytest.mark.parametrize("blurred", [False, True])
@pytest.mark.parametrize(
    ("widths", "color"),
    [
        ((0, 0, 3, 0), (0.02, 0.03, 0.02)),  # one side of a scan
        ((1, 1, 1, 1), (0.0, 0.0, 0.0)),
        ((0, 2, 0, 0), (1.0, 1.0, 1.0)),
    ],
)
def test_thin_rims_are_found_at_single_sides(
    widths: Sequence[int], color: Sequence[float], blurred: bool
) -> None:
    whole = framed(scene(), widths, color)
    if blurred:
        # Each pixel is the mean of itself and its neighbours in the row, and then in the column.
        for axis in (0, 1):
            padded = np.pad(whole, [(int(i == axis), int(i == axis)) for i in range(3)], "edge")
            size = whole.shape[axis]
            whole = sum(padded.take(range(k, k + size), axis) for k in range(3)) / 3
    frame = found(whole)
    assert frame is not None
    for ours, wanted in zip(frame, widths, strict=True):
        assert (ours == 0) if wanted == 0 else wanted <= ours <= wanted + blurred


@pytest.mark.parametrize("kind", FRAMELESS)
def test_other_borders_are_no_frame(kind: str) -> None:
    assert found(FRAMELESS[kind]) is None


def test_a_crop_keeps_the_camera(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    Image.fromarray(
        np.round(255 * framed(scene(), (9, 9, 10, 11), (1.0, 1.0, 1.0))).astype(np.uint8)
    ).save(path)
    whole, photo = load_photo(path), load_photo(path, keep_frame=False)
    assert whole.frame is None
    assert photo.frame is not None
    left, top, *_ = (round(width) for width in photo.frame)
    assert (whole.width, whole.height) == whole.framed_size == photo.framed_size
    inside = whole.camera.cropped(left, top, photo.width, photo.height)
    assert torch.equal(photo.rgb, whole.rgb[top : top + photo.height, left : left + photo.width])
    assert torch.equal(photo.camera.K, inside.K)
    small, full = resize_photo(photo, 90), photo.camera
    torch.testing.assert_close(
        small.camera.K, full.resized(small.width, small.height).K, rtol=0.01, atol=0.01
    )
    assert (
        load_photo(path, fov=60, keep_frame=False).frame is None
    )  # a field of view is that of the uncropped photo
