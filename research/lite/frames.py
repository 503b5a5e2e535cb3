"""Photos with measured depth, from depth cameras and stereo pairs, and their augmentation: camera
and light.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, interpolate

from spackle.paper.training.measured_photos import find_files, load_frame, load_pair
from spackle.paper.training.recipe import RgbdFolder
from spackle.runtime.errors import InputError

Rng = np.random.Generator
FOCAL = 1.1  # in widths: assumed for photos with unknown lens, to turn the camera


@dataclasses.dataclass(frozen=True)
class Frame:
    """A photo with depth."""

    rgb: Tensor  # [3, H, W] sRGB in 0..1
    inverse_depth: Tensor  # [H, W] in any unit, 0 for infinitely far
    valid: Tensor  # [H, W] bool, where inverse_depth is known


@dataclasses.dataclass(frozen=True)
class Turning:
    """How far the camera of a frame is turned and zoomed."""

    zoom: tuple[float, float]  # a range; 1 shows as much of the frame as fits
    degrees: tuple[float, float, float]  # standard deviations of yaw, pitch and roll


MEASURED = Turning((1.0, 1.6), (4.0, 4.0, 4.0))  # strong, because scenes are few
MADE = Turning((1.0, 1.4), (2.0, 2.0, 3.0))  # synthetic scenes vary in their cameras already
GUESSED = Turning((1.0, 1.4), (3.0, 3.0, 4.0))  # weak, because photos are many
# range of the logarithm of the front frame's median inverse depth over the back frame's
MINGLED_SCALE = (
    -0.2,
    0.8,
)


def turned(rng: Rng, frame: Frame, height: int, width: int, turning: Turning) -> Frame:
    """The frame seen by a camera at the same position with another direction; mirrored in half of
    all cases.

    The image depends on the direction alone; inverse depth changes by the known ratio of z in both
    cameras.
    """
    rows, columns = frame.inverse_depth.shape
    focal = FOCAL * columns
    scale = max(width / columns, height / rows) * math.exp(rng.uniform(*np.log(turning.zoom)))
    stretch = math.exp(rng.normal(0, 0.06))
    rotation = torch.from_numpy(
        _rotation(np.radians(rng.normal(0, 1, 3) * turning.degrees))
    ).float()
    slack = [max(0.0, have * scale - want) / 2 for have, want in ((columns, width), (rows, height))]
    cx, cy = (want / 2 + rng.uniform(-s, s) for want, s in zip((width, height), slack, strict=True))
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    ray = torch.stack(
        [(x - cx) / (focal * scale * stretch), (y - cy) / (focal * scale), torch.ones_like(x)], -1
    )
    ray = ray @ rotation  # in the frame's own camera
    u, v = (ray[..., k] / ray[..., 2] * focal for k in (0, 1))
    grid = torch.stack([2 * u / columns, 2 * v / rows], -1)[None]
    rgb = grid_sample(frame.rgb[None], grid, padding_mode="reflection", align_corners=False)[0]
    depth = torch.stack([frame.inverse_depth, frame.valid.float()])[None]
    inverse_depth, valid = grid_sample(
        depth, grid, mode="nearest", padding_mode="zeros", align_corners=False
    )[0]
    result = Frame(rgb, inverse_depth * ray[..., 2], valid > 0.5)
    if rng.random() < 0.5:
        return Frame(
            *(tensor.flip(-1) for tensor in (result.rgb, result.inverse_depth, result.valid))
        )
    return result


def _rotation(angles: NDArray[Any]) -> NDArray[Any]:
    """[3, 3] from yaw, pitch and roll in radians."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
    yaw = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    pitch = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return np.asarray(roll @ pitch @ yaw)


def mingled(rng: Rng, back: Frame, front: Frame) -> Frame:
    """Merge two frames of one size at a random relative scale: each pixel shows the nearer frame.

    Outlines, textures and depth are real; only the combination is not.
    """
    both = back.valid & front.valid
    if not bool(both.any()):
        return back
    medians = [frame.inverse_depth[both].median() for frame in (back, front)]
    scale = float(medians[0] / medians[1].clamp_min(1e-9)) * math.exp(rng.uniform(*MINGLED_SCALE))
    nearer = both & (front.inverse_depth * scale > back.inverse_depth)
    return Frame(
        torch.where(nearer, front.rgb, back.rgb),
        torch.where(nearer, front.inverse_depth * scale, back.inverse_depth),
        back.valid,
    )


def relit(rng: Rng, rgb: Tensor) -> Tensor:
    """[3, H, W] with random brightness, tint, contrast, glare, grey, blur and noise."""
    tint = np.exp(rng.normal(0, 0.12, (3, 1, 1)) + rng.normal(0, 0.2)).astype(np.float32)
    rgb = rgb * torch.from_numpy(tint)
    mean = rgb.mean((1, 2), keepdim=True)
    # black shadows and white highlights
    harsh = rng.uniform(0.3, 1.0) if rng.random() < 0.12 else 0.0
    rgb = mean + (rgb - mean) * math.exp(rng.normal(harsh, 0.25)) + harsh * rng.uniform(-0.1, 0.3)
    grey = rgb.mean(0, keepdim=True)
    rgb = grey + (rgb - grey) * (0.0 if rng.random() < 0.2 else math.exp(rng.normal(0, 0.3)))
    rgb = rgb.clamp(1e-4, 1) ** math.exp(rng.normal(0, 0.2))
    if rng.random() < 0.2:
        rgb = avg_pool2d(rgb[None], 3, 1, 1, count_include_pad=False)[0]
    if rng.random() < 0.3:
        noise = torch.from_numpy(rng.standard_normal(rgb.shape).astype(np.float32))
        rgb = rgb + float(rng.uniform(0, 0.04)) * noise
    return rgb.clamp(0, 1)


SAME = 1.05  # neighbours belong to one surface if their depths differ by a smaller factor


def warp_to_right(depth: Tensor, valid: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Move each pixel's depth to its position in the right photo; the nearest of several depths at
    a position is kept.

    Args:
        depth: [H, W] in the left photo; both cameras have parallel axes and the same depth.
        valid: [H, W] bool: pixels with known depth.
        shift: [H, W] in pixels, positive to the right; usually negative.

    Returns:
        Depth [H, W], and [H, W] bool where it is known: not where the left photo is occluded.
        Surfaces that are wider in the right photo get cracks, which are closed if they are one
        pixel wide.
    """
    rows, columns = (place.numpy() for place in valid.nonzero(as_tuple=True))
    z = depth[valid].numpy()
    places = np.rint(columns + shift[valid].numpy()).astype(np.int64)
    order = np.argsort(-z, kind="stable")  # if several values go to one pixel, NumPy keeps the last
    order = order[(places[order] >= 0) & (places[order] < depth.shape[1])]
    carried = np.full(tuple(depth.shape), np.inf, depth.numpy().dtype)
    carried[rows[order], places[order]] = z[order]
    _close_cracks(carried)
    known = torch.from_numpy(np.isfinite(carried))
    return torch.from_numpy(carried).where(known, 0.0), known


def _close_cracks(depth: NDArray[np.float32]) -> None:
    """Fill an empty or farther pixel between two pixels of one surface with this surface."""
    left, middle, right = depth[:, :-2], depth[:, 1:-1], depth[:, 2:]
    nearer, farther = np.minimum(left, right), np.maximum(left, right)
    crack = (farther < SAME * nearer) & (middle > SAME * farther)
    middle[crack] = farther[crack]


LEARNED_SIDE = 480  # pixels of a training frame's longer side, at most
JUDGED_SIDE = 768  # the same for validation frames


@dataclasses.dataclass(frozen=True)
class Measured:
    """A frame on disk, and how to read it."""

    path: Path  # the photo, or the stereo pair's folder
    unit_m: float | None = None  # metres per unit of a depth camera's file; None for a stereo pair
    right: bool = False  # whether the frame is a stereo pair's right photo

    @property
    def name(self) -> str:
        """The frame's name in messages."""
        return f"{self.path} (right)" if self.right else str(self.path)

    @property
    def identity(self) -> tuple[str | float | None, ...]:
        """What the digest of a run's data says of the frame."""
        return self.path.name, self.unit_m, self.right

    def read(self, side: int) -> Frame:
        """Read the frame, with at most `side` pixels on the longer side; InputError if that
        fails.
        """
        if self.unit_m is not None:
            rgb, stored = load_frame(self.path, self.unit_m)
            return reduced(rgb, stored.depth, stored.valid, side)
        pair = load_pair(self.path)
        stored, camera, beside = pair.depth, pair.left_camera, pair.right_camera
        if not self.right:
            return reduced(pair.left, stored.depth, stored.valid, side)
        moved = beside.world_to_camera[0, 3] * camera.K[0, 0]
        shift = beside.K[0, 2] - camera.K[0, 2] + moved / stored.depth.clamp_min(1e-6)
        return reduced(pair.right, *warp_to_right(stored.depth, stored.valid, shift), side)


class Readable(Protocol):
    """A frame on disk."""

    @property
    def name(self) -> str:
        """The frame's name in messages."""

    @property
    def identity(self) -> tuple[str | float | None, ...]:
        """What the digest of a run's data says of the frame."""

    def read(self, side: int) -> Frame:
        """Read the frame, with at most `side` pixels on the longer side; InputError if that
        fails.
        """


@dataclasses.dataclass(frozen=True)
class Group:
    """Similar validation frames; the score is a mean over groups, so that each group counts the
    same.
    """

    name: str
    files: Sequence[Readable]


def of_camera(camera: RgbdFolder, held: float) -> tuple[list[Measured], list[Measured]]:
    """A folder's frames for training, and its last frames by name for validation.

    Args:
        camera: the folder and its unit.
        held: the share for validation; at least one frame is left for training.

    Raises:
        InputError: there is no such folder, or it has no frames.
    """
    files = find_files(camera.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg")
    frames = [Measured(file, camera.unit_m) for file in files]
    judged = min(math.ceil(held * len(frames) - 1e-9), len(frames) - 1)
    return frames[: len(frames) - judged], frames[len(frames) - judged :]


def of_scenes(folder: Path, key: str, *, right: bool = False) -> list[Measured]:
    """The left photos of all stereo pairs below a folder, with `right` both photos; InputError if
    there are none.
    """
    folders = [file.parent for file in find_files(folder, key, ("scene.json",), "scene.json")]
    return [
        Measured(pair, right=side)
        for side in ((False, True) if right else (False,))
        for pair in folders
    ]


def read_all(
    files: Sequence[Readable], side: int, warn: Callable[[str], None]
) -> list[tuple[str, Frame]]:
    """Read frames; returns them with their names. Unreadable ones are skipped and reported to
    `warn`.

    Raises:
        InputError: no frame can be read.
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
        raise InputError(f"{files[0].name}: none of {len(files)} frames can be read: see above")
    return frames


def reduced(rgb: Tensor, depth: Tensor, valid: Tensor, side: int) -> Frame:
    """Reduce a frame to the size `side`; depth is sampled at the nearest pixel, not averaged.

    Args:
        rgb: [H, W, 3] sRGB.
        depth: [h, w] of nearly the same shape.
        valid: [h, w] bool, where depth is known.
        side: the most pixels on the longer side.
    """
    height, width = rgb.shape[:2]
    scale = min(1.0, side / max(height, width))
    height, width = max(1, round(height * scale)), max(1, round(width * scale))
    picture = rgb.permute(2, 0, 1)
    if scale < 1:
        picture = interpolate(picture[None], size=(height, width), mode="bicubic", antialias=True)[
            0
        ].clamp(0, 1)
    inverse_depth = torch.where(valid, 1 / depth.clamp_min(1e-6), 0.0)[None, None]
    inverse_depth = interpolate(inverse_depth, size=(height, width), mode="nearest-exact")[0, 0]
    return Frame(picture.contiguous(), inverse_depth, inverse_depth > 0)
