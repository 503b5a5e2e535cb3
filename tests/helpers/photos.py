"""Small photos, clips, depth maps, scenes and cameras on disk, and an independent reader of PLY."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from helpers import DATA

WIDTH, HEIGHT = 64, 48
CLIPS = DATA / "clips"  # of 10 frames per second; in each `picture` moves to the right


def picture(width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.uint8]:
    """A reddish box before a bluish wall, [H, W, 3]."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    waves = np.stack([np.sin(0.5 * x + 0.2 * y), np.sin(0.4 * y), np.cos(0.3 * x)], axis=-1)
    color = np.where(box(width, height)[..., None], (0.8, 0.3, 0.2), (0.2, 0.4, 0.7))
    return np.round(255 * (color + 0.1 * waves)).astype(np.uint8)


def box(width: int = WIDTH, height: int = HEIGHT) -> NDArray[np.bool_]:
    """[H, W]: the middle third each way."""
    mask = np.zeros((height, width), np.bool_)
    mask[height // 3 : height - height // 3, width // 3 : width - width // 3] = True
    return mask


def metres(
    width: int = WIDTH, height: int = HEIGHT, near: float = 2.0, far: float = 6.0
) -> NDArray[np.float32]:
    return np.where(box(width, height), near, far).astype(np.float32)


def write_photo(path: Path, width: int = WIDTH, height: int = HEIGHT) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(width, height)).save(path)
    return path


def write_depth(path: Path, depth: NDArray[np.float32] | None = None) -> Path:
    """Write depth in metres as .npy, or in millimetres as .png."""
    depth = metres() if depth is None else depth
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        Image.fromarray(np.round(1000 * depth).astype(np.uint16)).save(path)
    else:
        np.save(path, depth)
    return path


def write_pair(folder: Path) -> tuple[Path, Path]:
    return write_photo(folder / "photo.png"), write_depth(folder / "depth.npy")


@dataclasses.dataclass(frozen=True)
class Ply:
    """A binary little-endian PLY whose only element is `vertex`, all of it float32."""

    comments: list[str]
    names: list[str]
    count: int
    body: bytes

    def row(self, index: int) -> dict[str, float]:
        numbers = np.frombuffer(self.body, "<f4").reshape(self.count, -1)[index]
        return dict(zip(self.names, numbers.tolist(), strict=True))


def read_ply(path: Path) -> Ply:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    comments = [line.removeprefix("comment ") for line in lines[2:] if line.startswith("comment ")]
    rest = [line.split() for line in lines[2:] if not line.startswith("comment ")]
    assert rest[0][:2] == ["element", "vertex"]
    assert all(words[:2] == ["property", "float"] for words in rest[1:])
    ply = Ply(comments, [words[2] for words in rest[1:]], int(rest[0][2]), body)
    assert len(body) == 4 * ply.count * len(ply.names)
    return ply


def camera_file(
    path: Path, rights: list[float], sizes: list[tuple[int, int]] | None = None
) -> Path:
    """Write untilted cameras at these distances to the right of the photo's camera."""
    frames = []
    for right, (width, height) in zip(
        rights, sizes or [(WIDTH, HEIGHT)] * len(rights), strict=True
    ):
        K = [[55.0, 0, width / 2], [0, 55.0, height / 2], [0, 0, 1]]
        pose = [[1, 0, 0, -right], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        frames.append({"K": K, "world_to_camera": pose, "width": width, "height": height})
    path.write_text(json.dumps({"frames": frames}))
    return path
