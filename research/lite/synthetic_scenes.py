"""Synthetic scenes with exact depth and textures cut from photos, several in a file."""

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

SAMPLES = 2  # a pixel has 2 × 2 rays
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
        photos: gives random photos, from which textures are cut.
        height, width: in pixels.
    """
    shares = [share for _, share in KINDS]
    build_scene, _ = KINDS[int(rng.choice(len(KINDS), p=shares))]
    picture = render_scene(rng, photos, height, width, build_scene)
    return picture.rgb, picture.inverse_depth


@dataclasses.dataclass(frozen=True)
class Picture:
    """A rendered scene, and what it was rendered from."""

    rgb: Tensor  # [H, W, 3] sRGB
    inverse_depth: Tensor  # [H, W] in 1/m, 0 in the sky
    solids: list[Solid]
    skins: Floats  # [T, S, S, 4] textures of the solids: colours 0..1 and coverage
    rays: Floats  # [N, 3] directions with z = 1 along the camera's axis, `SAMPLES`² for each pixel


def render_scene(
    rng: Rng, photos: DrawPhoto, height: int, width: int, build_scene: Callable[[Rng], Scene]
) -> Picture:
    """Render a random scene of one kind, with random textures, light and camera.

    Args:
        rng: the source of all random choices.
        photos: gives random photos, from which textures are cut.
        height, width: of the picture in pixels.
        build_scene: makes the solids, and chooses how far down the camera looks.
    """
    skins = textures(rng, photos)
    solids, pitch = build_scene(rng)
    focal_px = width * rng.uniform(0.7, 1.5)
    roll = math.radians(rng.normal(0, 2.5))
    rays = _rays(height, width, focal_px, pitch, roll)
    sky_pixels = sky(rng, photos, height, width)  # [H, W, 3]
    sky_colors = sky_pixels.repeat(SAMPLES, 0).repeat(SAMPLES, 1).reshape(-1, 3)  # of each ray

    # The light comes from above, where y is negative, and rather from behind the camera.
    to_light = rng.normal(size=3) * (1.0, 0.4, 1.0) - (0.0, rng.uniform(0.5, 1.5), 0.5)
    light = (to_light / np.linalg.norm(to_light)).astype(np.float32)
    ambient = rng.uniform(0.25, 0.9)  # share of light that comes from everywhere
    colors, distances = trace(solids, skins, rays, light, ambient, sky_colors)

    # Colours are means over the rays of a pixel; its depth is that of one ray, because a mean of
    # two surfaces lies on neither.
    fine_size = (height * SAMPLES, width * SAMPLES)
    fine_rgb = _exposed(rng, torch.from_numpy(colors)).reshape(*fine_size, 3)
    rgb = avg_pool2d(fine_rgb.permute(2, 0, 1)[None], SAMPLES)[0].permute(1, 2, 0)
    fine_inverse_depth = torch.from_numpy(1.0 / distances).reshape(fine_size)
    inverse_depth = fine_inverse_depth[::SAMPLES, ::SAMPLES]
    return Picture(rgb.contiguous(), inverse_depth.contiguous(), solids, skins, rays)


def _exposed(rng: Rng, rgb: Tensor) -> Tensor:
    """Colours [N, 3], scaled to the usual brightness of photos; brighter values become white."""
    wanted_mean = rng.uniform(0.25, 0.6)
    factor = wanted_mean / float(rgb.mean().clamp_min(0.02))
    return (rgb * factor).clamp(0, 1)


def _rays(height: int, width: int, focal_px: float, pitch: float, roll: float) -> Floats:
    """[N, 3] directions of `SAMPLES`² rays for each pixel, in a world with y down.

    Along the camera's axis they all have the length 1, so that distances in units of their length
    are depths.

    Args:
        height, width: of the picture in pixels.
        focal_px: focal length.
        pitch: how far the camera looks down, in radians.
        roll: how far it is turned about its axis, in radians.
    """
    row, column = np.mgrid[: height * SAMPLES, : width * SAMPLES].astype(np.float32)
    x = ((column + 0.5) / SAMPLES - width / 2) / focal_px
    y = ((row + 0.5) / SAMPLES - height / 2) / focal_px
    rolled_x = x * math.cos(roll) - y * math.sin(roll)
    rolled_y = x * math.sin(roll) + y * math.cos(roll)
    cosine = math.cos(pitch)
    sine = math.sin(pitch)
    directions = np.stack([rolled_x, rolled_y * cosine + sine, cosine - rolled_y * sine], -1)
    return directions.reshape(-1, 3).astype(np.float32)


PER_FILE = 50  # scenes in a file
UPRIGHT = 0.25  # share of upright scenes
TRIES = 20  # how many photos in a row may be unreadable
Warn = Callable[[str], None]


class PhotoDraw:
    """Draws random photos; unreadable photos are reported once and skipped."""

    def __init__(self, files: Sequence[Path], warn: Warn) -> None:
        """Keep the photos' files; `warn` is called with a line for each unreadable one."""
        self.files = files
        self.warn = warn
        self.bad: set[Path] = set()  # files that were reported

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
    """A folder of synthetic scenes, numbered from 0.

    A scene is determined by its number, and by seed, size and photos.
    """

    folder: Path
    photos: Sequence[Path]  # from which textures are cut
    size: tuple[int, int]  # height and width; swapped for upright scenes
    seed: int
    count: int  # of scenes

    def fill(self, progress: Callable[[int, int], None], warn: Warn) -> None:
        """Make the scenes that are missing.

        Damaged files are reported and replaced; too short files are replaced silently.

        Args:
            progress: called with the number of scenes that exist, and of all.
            warn: called with a message about each skipped photo and replaced file.

        Raises:
            InputError: nothing can be written, or no photo can be read.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        draw = PhotoDraw(self.photos, warn)
        for first in range(0, self.count, PER_FILE):
            end = min(first + PER_FILE, self.count)
            if self._stored(first, warn) < end - first:
                self._write(first, end, draw, progress)
            progress(end, self.count)

    def frame(self, index: int) -> Frame:
        """Read a scene; InputError if its file is missing or damaged."""
        path = self._file(index)
        row = index % PER_FILE
        try:
            with safe_open(path, framework="pt") as file:
                rgb = file.get_slice("rgb")[row]
                inverse_depth = file.get_slice("inverse_depth")[row]
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
        """The file that has the scene with this number."""
        return self.folder / f"{index // PER_FILE:04d}.safetensors"

    def _stored(self, first: int, warn: Warn) -> int:
        """How many scenes the file of scene number `first` holds; 0 if it is missing or damaged."""
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
        self, first: int, end: int, draw: PhotoDraw, progress: Callable[[int, int], None]
    ) -> None:
        """Make the file of the scenes `first` to `end` − 1."""
        scenes = []
        for index in range(first, end):
            scenes.append(self._scene(index, draw))
            progress(index + 1, self.count)
        rgbs, inverse_depths, uprights = zip(*scenes, strict=True)
        tensors = {
            "rgb": torch.stack(rgbs),
            "inverse_depth": torch.stack(inverse_depths),
            "upright": torch.stack(uprights),
        }
        with atomic_path(self._file(first)) as temporary:
            temporary.write_bytes(save(tensors))

    def _scene(self, index: int, draw: PhotoDraw) -> tuple[Tensor, Tensor, Tensor]:
        """A scene as it is stored: colours, inverse depth, and whether it is upright.

        Colours [H · W · 3] have 8 bits, and inverse depths [H · W] half precision.
        """
        rng = np.random.default_rng([self.seed, index])
        upright = rng.random() >= 1 - UPRIGHT
        height, width = self.size[::-1] if upright else self.size
        rgb, inverse_depth = synthetic_scene(rng, draw, height, width)
        return (
            (rgb * 255 + 0.5).to(torch.uint8).flatten(),
            inverse_depth.half().flatten(),
            torch.tensor(upright),
        )
