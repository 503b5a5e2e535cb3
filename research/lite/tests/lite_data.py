"""A small example of each kind of training data of the lite base."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from helpers.photos import metres, picture, write_depth, write_photo
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor


def f32(values: object) -> NDArray[np.float32]:
    return np.asarray(values, np.float32)


def photo(rng: np.random.Generator) -> Tensor:
    """[H, W, 3] a photo, always the same one."""
    return torch.from_numpy(picture(96, 80)).float() / 255


def write_data(place: Path) -> None:
    """Write photos (one is broken), kitchen/ with six depth camera frames, pairs/ and others/ with
    a stereo pair.
    """
    write_photo(place / "photos" / "sub" / "a.png", 120, 90)
    Image.fromarray(255 - picture(90, 120)).save(place / "photos" / "b.png")
    (place / "photos" / "broken.jpg").write_bytes(b"\xff\xd8 no more")
    for number in range(6):
        write_photo(place / "kitchen" / f"{number}.color.jpg")
        write_depth(place / "kitchen" / f"{number}.depth.png", metres(near=1.0 + number))
    _write_stereo(place / "pairs" / "one", 3.0)
    _write_stereo(place / "others" / "two", 2.0)


def _write_stereo(folder: Path, near: float) -> None:
    """Write two photos and the left one's disparity d: depth = 0.1 · 60 / d."""
    for name in ("left", "right"):
        write_photo(folder / f"{name}.png")
    np.save(folder / "disparity.npy", 6.0 / metres(near=near))
    names = {"left": "left.png", "right": "right.png", "disparity": "disparity.npy"}
    lens = {"focal_px": 60, "cx": 32, "cy": 24, "doffs_px": 0, "baseline_m": 0.1}
    (folder / "scene.json").write_text(json.dumps({**names, **lens}))
