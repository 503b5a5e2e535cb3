"""Synthetic scenes with exact depth and textures cut from photos, stored with several scenes per
file.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from frames import Frame, Rng
from ray_tracer import Floats, Solid, trace
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from scene_kinds import Scene, heap, room, sheets, shelf, still_life, street, table, yard
from textures import sky, textures
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.core.photo import load_photo
from spackle.paper.training.composites import DrawPhoto
from spackle.runtime.errors import InputError
from spackle.runtime.files import atomic_path

SAMPLES = 2  # rays per pixel in each direction
KINDS: tuple[tuple[Callable[[Rng], Scene], float], ...] = (  # with their relative frequencies
    (room, 0.17),
    (table, 0.09),
    (sheets, 0.05),
    (still_life, 0.25),
    (heap, 0.09),
    (shelf, 0.08),
    (street, 0.07),
    (yard, 0.2),
)


def synthetic_scene(rng: Rng, photos: DrawPhoto, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Render a random scene: [H, W, 3] sRGB, and exact inverse depth [H, W] in 1/m (0 in the sky).

    Args:
        rng: the source of all random choices.
        photos: gives photos, from which textures are cut.
        height, width: in pixels.
    """
    picture = drawn(
        rng,
        photos,
        height,
        width,
        KINDS[int(rng.choice(len(KINDS), p=[share for _, share in KINDS]))][0],
    )
    return picture.rgb, picture.inverse_depth


@dataclasses.dataclass(frozen=True)
class Picture:
    """A rendered scene and its inputs."""

    rgb: Tensor  # [H, W, 3] sRGB
    inverse_depth: Tensor  # [H, W] in 1/m
    solids: list[Solid]
    skins: Floats  # [T, S, S, 4] textures of the solids
    rays: Floats  # [N, 3], `SAMPLES`² per pixel


def drawn(
    rng: Rng, photos: DrawPhoto, height: int, width: int, build: Callable[[Rng], Scene]
) -> Picture:
    """Render a scene made by `build`; see `synthetic_scene`."""
    skins = textures(rng, photos)
    solids, pitch = build(rng)
    focal = width * rng.uniform(0.7, 1.5)
    rays = _rays(height, width, focal, pitch, math.radians(rng.normal(0, 2.5)))
    behind = sky(rng, photos, height, width).repeat(SAMPLES, 0).repeat(SAMPLES, 1).reshape(-1, 3)
    # y points down
    above = rng.normal(size=3) * (1.0, 0.4, 1.0) - (
        0.0,
        rng.uniform(0.5, 1.5),
        0.5,
    )
    light = (above / np.linalg.norm(above)).astype(np.float32)
    colors, distances = trace(solids, skins, rays, light, rng.uniform(0.25, 0.9), behind)
    fine = (height * SAMPLES, width * SAMPLES)
    rgb = _exposed(rng, torch.from_numpy(colors))
    rgb = avg_pool2d(rgb.reshape(*fine, 3).permute(2, 0, 1)[None], SAMPLES)[0]
    # one per pixel: no averages
    inverse = torch.from_numpy(1.0 / distances).reshape(fine)[::SAMPLES, ::SAMPLES]
    return Picture(rgb.permute(1, 2, 0).contiguous(), inverse.contiguous(), solids, skins, rays)


def _exposed(rng: Rng, rgb: Tensor) -> Tensor:
    """Scale to the usual brightness of photos; brighter values become white."""
    return (rgb * (rng.uniform(0.25, 0.6) / float(rgb.mean().clamp_min(0.02)))).clamp(0, 1)


def _rays(height: int, width: int, focal: float, pitch: float, roll: float) -> Floats:
    """[N, 3] directions of depth one, for `SAMPLES`² rays a pixel, rotated by `pitch` (down) and
    `roll`.
    """
    y, x = np.mgrid[: height * SAMPLES, : width * SAMPLES].astype(np.float32)
    x, y = ((x + 0.5) / SAMPLES - width / 2) / focal, ((y + 0.5) / SAMPLES - height / 2) / focal
    x, y = x * math.cos(roll) - y * math.sin(roll), x * math.sin(roll) + y * math.cos(roll)
    c, s = math.cos(pitch), math.sin(pitch)
    return np.stack([x, y * c + s, c - y * s], -1).reshape(-1, 3).astype(np.float32)


PER_FILE = 50
UPRIGHT = 0.25  # share of upright scenes
TRIES = 20  # how many photos in a row may be unreadable
Warn = Callable[[str], None]


class PhotoDraw:
    """Draws random photos; unreadable photos are reported once and skipped."""

    def __init__(self, files: Sequence[Path], warn: Warn) -> None:
        self.files, self.warn, self.bad = files, warn, set[Path]()

    def __call__(self, rng: Rng) -> Tensor:
        """A random photo [H, W, 3] sRGB; InputError if `TRIES` in a row cannot be read."""
        for _ in range(TRIES):
            file = self.files[int(rng.integers(len(self.files)))]
            if file in self.bad:
                continue
            try:
                return load_photo(file).rgb
            except (InputError, ValueError) as error:
                self.bad.add(file)
                self.warn(f"passed over: {error}")
        raise InputError(
            f"{self.files[0].parent}: {TRIES} photos in a row cannot be read: give others as "
            f"data.photos"
        )


@dataclasses.dataclass(frozen=True)
class SyntheticScenes:
    """A folder of synthetic scenes, numbered from 0; number, seed, size and photos determine a
    scene.
    """

    folder: Path
    photos: Sequence[Path]
    size: tuple[int, int]  # height and width; swapped for upright scenes
    seed: int
    count: int

    def fill(self, progress: Callable[[int, int], None], warn: Warn) -> None:
        """Make missing scenes. Damaged files are reported and replaced; too short files are
        replaced silently.

        Args:
            progress: called with the number of scenes that exist.
            warn: called with a message about each skipped photo and replaced file.

        Raises:
            InputError: nothing can be written, or no photo can be read.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        draw = PhotoDraw(self.photos, warn)
        for first in range(0, self.count, PER_FILE):
            last = min(first + PER_FILE, self.count)
            if self._stored(first, warn) < last - first:
                self._write(first, last, draw, progress)
            progress(last, self.count)

    def frame(self, index: int) -> Frame:
        """Read a scene; InputError if its file is missing or damaged."""
        path, row = self._file(index), index % PER_FILE
        try:
            with safe_open(path, framework="pt") as file:
                rgb, inverse_depth = (
                    file.get_slice(name)[row] for name in ("rgb", "inverse_depth")
                )
                upright = bool(file.get_tensor("upright")[row])
        except (OSError, SafetensorError, IndexError) as error:
            raise InputError(
                f"{path}: no synthetic scenes, or damaged: delete it, and it is made anew"
            ) from error
        height, width = self.size[::-1] if upright else self.size
        rgb = rgb.reshape(height, width, 3).permute(2, 0, 1).float() / 255
        inverse_depth = inverse_depth.reshape(height, width).float()
        return Frame(rgb, inverse_depth, torch.ones_like(inverse_depth, dtype=torch.bool))

    def _file(self, index: int) -> Path:
        return self.folder / f"{index // PER_FILE:04d}.safetensors"

    def _stored(self, first: int, warn: Warn) -> int:
        """The number of complete scenes in a scene's file."""
        path = self._file(first)
        pixels = self.size[0] * self.size[1]
        try:
            with safe_open(path, framework="pt") as file:
                shapes = [
                    file.get_slice(name).get_shape() for name in ("rgb", "inverse_depth", "upright")
                ]
            count = int(shapes[2][0])
            if shapes == [[count, 3 * pixels], [count, pixels], [count]]:
                return count
        except FileNotFoundError:
            return 0
        except (OSError, SafetensorError, IndexError):
            pass
        warn(f"{path}: damaged, made anew")
        return 0

    def _write(
        self, first: int, last: int, draw: PhotoDraw, progress: Callable[[int, int], None]
    ) -> None:
        scenes = []
        for index in range(first, last):
            scenes.append(self._scene(index, draw))
            progress(index + 1, self.count)
        names = ("rgb", "inverse_depth", "upright")
        tensors = {
            name: torch.stack(rows)
            for name, rows in zip(names, zip(*scenes, strict=True), strict=True)
        }
        with atomic_path(self._file(first)) as temporary:
            temporary.write_bytes(save(tensors))

    def _scene(self, index: int, draw: PhotoDraw) -> tuple[Tensor, Tensor, Tensor]:
        """A scene as it is stored: flattened, with 8-bit colours and depth in half precision."""
        rng = np.random.default_rng([self.seed, index])
        upright = rng.random() >= 1 - UPRIGHT
        rgb, inverse_depth = synthetic_scene(
            rng, draw, *(self.size[::-1] if upright else self.size)
        )
        return (
            (rgb * 255 + 0.5).to(torch.uint8).flatten(),
            inverse_depth.half().flatten(),
            torch.tensor(upright),
        )
