"""Photos with measured depth: what depth cameras took, and the photos of stereo pairs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.errors import InputError
from spackle.training.data import find_files
from spackle.training.depth.augment import Frame
from spackle.training.depth.right import seen_from_the_right
from spackle.training.recipe import RgbdFolder
from spackle.training.sources import load_frame, load_pair

LEARNED_SIDE = 480  # pixels of the longer side of what is learned from
JUDGED_SIDE = 768  # likewise of what is judged by


@dataclasses.dataclass(frozen=True)
class Measured:
    """A file, and how to read it."""

    path: Path  # of the photo, or of the stereo pair's folder
    unit_m: float | None = None  # of a depth camera's files; None for a stereo pair
    right: bool = False  # of a stereo pair's photos the right one

    @property
    def name(self) -> str:
        """What it is called in messages."""
        return f"{self.path} (right)" if self.right else str(self.path)

    def read(self, side: int) -> Frame:
        """The frame, its longer side no longer than this; InputError where it cannot be read."""
        if self.unit_m is not None:
            rgb, stored = load_frame(self.path, self.unit_m)
            return reduced(rgb, stored.depth, stored.valid, side)
        rgb, other, stored, camera, beside = load_pair(self.path)
        if not self.right:
            return reduced(rgb, stored.depth, stored.valid, side)
        moved = beside.world_to_camera[0, 3] * camera.K[0, 0]
        shift = beside.K[0, 2] - camera.K[0, 2] + moved / stored.depth.clamp_min(1e-6)
        return reduced(other, *seen_from_the_right(stored.depth, stored.valid, shift), side)


@dataclasses.dataclass(frozen=True)
class Group:
    """Frames that look alike: they are judged together, and each group counts as much as another."""

    name: str
    files: Sequence[Measured]


def of_camera(camera: RgbdFolder, held: float) -> tuple[list[Measured], list[Measured]]:
    """The frames of a folder to learn from, and those to be judged by, which are the last ones by name.

    Args:
        camera: the folder and its unit.
        held: the share that is judged by; one frame at least is learned from.

    Raises:
        InputError: no such folder, or nothing in it.
    """
    files = find_files(camera.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg")
    frames = [Measured(file, camera.unit_m) for file in files]
    judged = min(math.ceil(held * len(frames) - 1e-9), len(frames) - 1)
    return frames[: len(frames) - judged], frames[len(frames) - judged :]


def of_scenes(folder: Path, key: str, *, right: bool = False) -> list[Measured]:
    """The left photos of the stereo pairs below a folder, or both; InputError where there are none."""
    folders = [file.parent for file in find_files(folder, key, ("scene.json",), "scene.json")]
    return [Measured(pair, right=side) for side in ((False, True) if right else (False,)) for pair in folders]


def read_all(files: Sequence[Measured], side: int, warn: Callable[[str], None]) -> list[tuple[str, Frame]]:
    """Frames with their names; those that cannot be read are passed over and named.

    Raises:
        InputError: none can be read.
    """
    frames: list[tuple[str, Frame]] = []
    for file in files:
        try:
            frame = file.read(side)
        except (InputError, ValueError) as error:
            warn(f"passed over: {error}")
            continue
        if bool(frame.valid.any()):
            frames.append((file.name, frame))
        else:
            warn(f"passed over: {file.name}: hardly a pixel has a depth")
    if not frames:
        raise InputError(f"{files[0].path}: none of {len(files)} frames can be read: see above")
    return frames


def reduced(rgb: Tensor, depth: Tensor, valid: Tensor, side: int) -> Frame:
    """A frame no larger than it need be; its depth is one of the pixels' that it stands for, no mean.

    Args:
        rgb: [H, W, 3] sRGB.
        depth: [h, w] of nearly the same shape.
        valid: [h, w] bool.
        side: pixels of the longer side.
    """
    height, width = rgb.shape[:2]
    scale = min(1.0, side / max(height, width))
    height, width = max(1, round(height * scale)), max(1, round(width * scale))
    picture = rgb.permute(2, 0, 1)
    if scale < 1:
        picture = interpolate(picture[None], size=(height, width), mode="bicubic", antialias=True)[0].clamp(0, 1)
    inverse_depth = torch.where(valid, 1 / depth.clamp_min(1e-6), 0.0)[None, None]
    inverse_depth = interpolate(inverse_depth, size=(height, width), mode="nearest-exact")[0, 0]
    return Frame(picture.contiguous(), inverse_depth, inverse_depth > 0)
