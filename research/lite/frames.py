"""Photos with measured depth, from depth cameras and stereo pairs.

They are augmented by turned cameras and other light.
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
FOCAL = 1.1  # focal length in widths of a photo, assumed of all to turn their cameras


@dataclasses.dataclass(frozen=True)
class Frame:
    """A photo with depth."""

    rgb: Tensor  # [3, H, W] sRGB in 0..1
    inverse_depth: Tensor  # [H, W] in any unit, 0 for infinitely far
    valid: Tensor  # [H, W] bool, where inverse_depth is known


@dataclasses.dataclass(frozen=True)
class Turning:
    """How far the camera of a frame is turned and zoomed."""

    zoom: tuple[float, float]  # least and greatest; at 1, as much of the frame shows as fits
    degrees: tuple[float, float, float]  # standard deviations of yaw, pitch and roll


MEASURED = Turning(zoom=(1.0, 1.6), degrees=(4.0, 4.0, 4.0))  # strong: such scenes are few
# Weak: synthetic scenes vary in their cameras already, and photos are many.
MADE = Turning(zoom=(1.0, 1.4), degrees=(2.0, 2.0, 3.0))
GUESSED = Turning(zoom=(1.0, 1.4), degrees=(3.0, 3.0, 4.0))
# Least and greatest logarithm of the front frame's median inverse depth over the back frame's.
MINGLED_SCALE = (-0.2, 0.8)


def turned(rng: Rng, frame: Frame, height: int, width: int, turning: Turning) -> Frame:
    """The frame seen by a camera that is turned and zoomed at the same place.

    It is mirrored in half of all cases. The colour in a direction stays the same; inverse depth
    changes by the known ratio of z in both cameras.

    Args:
        rng: for all random choices.
        frame: the photo with depth.
        height, width: of the result in pixels.
        turning: how far the camera is turned and zoomed.
    """
    rows, columns = frame.inverse_depth.shape
    focal = FOCAL * columns
    # A pixel of the frame becomes `scale` pixels of the result.
    zoom = math.exp(rng.uniform(*np.log(turning.zoom)))
    scale = max(width / columns, height / rows) * zoom
    stretch = math.exp(rng.normal(0, 0.06))  # of the width alone, by a few percent
    angles = np.radians(rng.normal(0, 1, 3) * turning.degrees)  # yaw, pitch, roll
    rotation = torch.from_numpy(_rotation(angles)).float()

    # The principal point is shifted at random, as far as the enlarged frame still fills the result
    # if the camera is not turned.
    slack_x = max(0.0, columns * scale - width) / 2
    slack_y = max(0.0, rows * scale - height) / 2
    cx = width / 2 + rng.uniform(-slack_x, slack_x)
    cy = height / 2 + rng.uniform(-slack_y, slack_y)

    # [H, W, 3] the rays of the result's pixels, with z = 1; then in the axes of the frame's camera.
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    ray = torch.stack(
        [(x - cx) / (focal * scale * stretch), (y - cy) / (focal * scale), torch.ones_like(x)], -1
    )
    ray = ray @ rotation
    # Where they meet the frame: pixels from its middle, and from −1 to 1 as `grid_sample` wants.
    u = ray[..., 0] / ray[..., 2] * focal
    v = ray[..., 1] / ray[..., 2] * focal
    grid = torch.stack([2 * u / columns, 2 * v / rows], -1)[None]

    rgb = grid_sample(frame.rgb[None], grid, padding_mode="reflection", align_corners=False)[0]
    depth = torch.stack([frame.inverse_depth, frame.valid.float()])[None]
    inverse_depth, valid = grid_sample(
        depth, grid, mode="nearest", padding_mode="zeros", align_corners=False
    )[0]
    result = Frame(rgb, inverse_depth * ray[..., 2], valid > 0.5)
    is_mirrored = rng.random() < 0.5
    if is_mirrored:
        return Frame(result.rgb.flip(-1), result.inverse_depth.flip(-1), result.valid.flip(-1))
    return result


def _rotation(angles: NDArray[Any]) -> NDArray[Any]:
    """The rotation [3, 3] by yaw, then pitch, then roll: three angles in radians."""
    cy, cp, cr = np.cos(angles)
    sy, sp, sr = np.sin(angles)
    yaw = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    pitch = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    roll = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]])
    return np.asarray(roll @ pitch @ yaw)


def mingled(rng: Rng, back: Frame, front: Frame) -> Frame:
    """Merge two frames of one size at a random relative scale: each pixel shows the nearer frame.

    Outlines, textures and depth are real; only the combination is not. Where the depth of one is
    not known, the back frame shows.

    Args:
        rng: for the scale.
        back: keeps its depth.
        front: its depth is scaled so that, by the medians, it is usually the nearer one.
    """
    both_known = back.valid & front.valid
    if not bool(both_known.any()):
        return back
    back_median = back.inverse_depth[both_known].median()
    front_median = front.inverse_depth[both_known].median()
    equal_scale = float(back_median / front_median.clamp_min(1e-9))  # both get one median
    scale = equal_scale * math.exp(rng.uniform(*MINGLED_SCALE))
    front_inverse_depth = front.inverse_depth * scale
    front_is_nearer = both_known & (front_inverse_depth > back.inverse_depth)
    return Frame(
        torch.where(front_is_nearer, front.rgb, back.rgb),
        torch.where(front_is_nearer, front_inverse_depth, back.inverse_depth),
        back.valid,
    )


def relit(rng: Rng, rgb: Tensor) -> Tensor:
    """A photo [3, H, W] sRGB in other light: the same shape, in 0..1.

    Brightness, tint, contrast, saturation and gamma are random; some photos get glare, become grey
    or blurred, or get noise.
    """
    # Tint of each channel, and brightness.
    factors = np.exp(rng.normal(0, 0.12, (3, 1, 1)) + rng.normal(0, 0.2)).astype(np.float32)
    rgb = rgb * torch.from_numpy(factors)

    # Contrast. In 12 % it is harsh: shadows become black and highlights white, and glare is added.
    mean = rgb.mean((1, 2), keepdim=True)
    harshness = rng.uniform(0.3, 1.0) if rng.random() < 0.12 else 0.0
    contrast = math.exp(rng.normal(harshness, 0.25))
    glare = harshness * rng.uniform(-0.1, 0.3)
    rgb = mean + (rgb - mean) * contrast + glare

    # Saturation; a fifth become grey.
    grey = rgb.mean(0, keepdim=True)
    saturation = 0.0 if rng.random() < 0.2 else math.exp(rng.normal(0, 0.3))
    rgb = grey + (rgb - grey) * saturation

    gamma = math.exp(rng.normal(0, 0.2))
    rgb = rgb.clamp(1e-4, 1) ** gamma
    if rng.random() < 0.2:  # blur over 3×3 pixels
        rgb = avg_pool2d(rgb[None], 3, stride=1, padding=1, count_include_pad=False)[0]
    if rng.random() < 0.3:
        noise = torch.from_numpy(rng.standard_normal(rgb.shape).astype(np.float32))
        rgb = rgb + float(rng.uniform(0, 0.04)) * noise
    return rgb.clamp(0, 1)


SAME_SURFACE_RATIO = 1.05  # neighbours whose depths differ by a smaller factor are one surface


def warp_to_right(depth: Tensor, valid: Tensor, shift: Tensor) -> tuple[Tensor, Tensor]:
    """Move each pixel's depth of a left photo to its place in the right photo.

    Of several depths at a place, the nearest is kept.

    Args:
        depth: [H, W] in the left photo. The cameras have parallel axes, so that a point has one
            depth in both.
        valid: [H, W] bool: pixels with known depth.
        shift: [H, W] in pixels, positive to the right; usually negative.

    Returns:
        Depth [H, W] in the right photo, and [H, W] bool where it is known: not where the right
        photo shows what the left one does not. Surfaces that are wider in the right photo get
        cracks, which are closed if they are one pixel wide.
    """
    rows, columns = (indices.numpy() for indices in valid.nonzero(as_tuple=True))
    z = depth[valid].numpy()
    right_columns = np.rint(columns + shift[valid].numpy()).astype(np.int64)
    # If several values go to one pixel, NumPy keeps the last one; so the nearest come last.
    order = np.argsort(-z, kind="stable")
    is_inside = (right_columns[order] >= 0) & (right_columns[order] < depth.shape[1])
    order = order[is_inside]
    right_depth = np.full(tuple(depth.shape), np.inf, depth.numpy().dtype)
    right_depth[rows[order], right_columns[order]] = z[order]
    _close_cracks(right_depth)
    known = torch.from_numpy(np.isfinite(right_depth))
    return torch.from_numpy(right_depth).where(known, 0.0), known


def _close_cracks(depth: NDArray[np.float32]) -> None:
    """Fill single pixels between two pixels of one surface that are empty or lie behind it.

    `depth` [H, W] is changed in place; it is infinite where it is empty.
    """
    left = depth[:, :-2]
    middle = depth[:, 1:-1]  # a view: writing to it changes `depth`
    right = depth[:, 2:]
    nearer = np.minimum(left, right)
    farther = np.maximum(left, right)
    is_one_surface = farther < SAME_SURFACE_RATIO * nearer
    is_crack = is_one_surface & (middle > SAME_SURFACE_RATIO * farther)
    middle[is_crack] = farther[is_crack]


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
        """What the digest of a run's data says of the frame: not where it lies."""
        return self.path.name, self.unit_m, self.right

    def read(self, side: int) -> Frame:
        """Read the frame, with at most `side` pixels on the longer side.

        InputError if it cannot be read.
        """
        if self.unit_m is not None:
            rgb, stored = load_frame(self.path, self.unit_m)
            return reduced(rgb, stored.depth, stored.valid, side)
        pair = load_pair(self.path)
        stored = pair.depth  # of the left photo
        if not self.right:
            return reduced(pair.left, stored.depth, stored.valid, side)

        # How many pixels farther to the right the right photo shows each point of the left one: a
        # constant for the principal points, and focal length · x / z, where x is the offset of the
        # left camera as the right one sees it. That is to the left, hence negative.
        left, right = pair.left_camera, pair.right_camera
        focal_times_offset = right.world_to_camera[0, 3] * left.K[0, 0]
        between_principal_points = right.K[0, 2] - left.K[0, 2]
        shift = between_principal_points + focal_times_offset / stored.depth.clamp_min(1e-6)
        right_depth, right_valid = warp_to_right(stored.depth, stored.valid, shift)
        return reduced(pair.right, right_depth, right_valid, side)


class Readable(Protocol):
    """A frame on disk."""

    @property
    def name(self) -> str:
        """The frame's name in messages."""

    @property
    def identity(self) -> tuple[str | float | None, ...]:
        """What the digest of a run's data says of the frame."""

    def read(self, side: int) -> Frame:
        """Read the frame, with at most `side` pixels on the longer side.

        InputError if it cannot be read.
        """


@dataclasses.dataclass(frozen=True)
class Group:
    """Similar validation frames.

    A score is a mean over groups, so that each group counts the same, however many frames it has.
    """

    name: str
    files: Sequence[Readable]


def of_camera(camera: RgbdFolder, validation: float) -> tuple[list[Measured], list[Measured]]:
    """A depth camera's frames for training, and those for validation: the last ones by name.

    Args:
        camera: the folder of its frames, and their unit.
        validation: the share for validation; at least one frame is left for training.

    Raises:
        InputError: there is no such folder, or it has no frames.
    """
    files = find_files(camera.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg")
    frames = [Measured(file, camera.unit_m) for file in files]
    # Rounded up, but a share such as 0.2 of 5 frames is 1, in spite of rounding errors.
    validation_count = min(math.ceil(validation * len(frames) - 1e-9), len(frames) - 1)
    training_count = len(frames) - validation_count
    return frames[:training_count], frames[training_count:]


def of_scenes(folder: Path, key: str, *, right: bool = False) -> list[Measured]:
    """The left photos of all stereo pairs below a folder; then, if asked for, their right photos.

    Args:
        folder: where to look, its subfolders included; a pair is a folder with a scene.json.
        key: the recipe's key or the option that names the folder, such as "data.stereo", for
            messages.
        right: whether the right photos follow.

    Raises:
        InputError: there is no such folder, or it has no pairs.
    """
    pairs = [file.parent for file in find_files(folder, key, ("scene.json",), "scene.json")]
    frames = [Measured(pair, right=False) for pair in pairs]
    if right:
        frames += [Measured(pair, right=True) for pair in pairs]
    return frames


def read_all(
    files: Sequence[Readable], side: int, warn: Callable[[str], None]
) -> list[tuple[str, Frame]]:
    """Read frames; returns them with their names.

    Args:
        files: at least one.
        side: the most pixels on the longer side of a frame.
        warn: called with a line for each frame that cannot be read or has no depth, and is skipped.

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
            warn(f"passed over: {file.name}: no pixel has a depth")
    if not frames:
        raise InputError(f"{files[0].name}: none of {len(files)} frames can be read: see above")
    return frames


def reduced(rgb: Tensor, depth: Tensor, valid: Tensor, side: int) -> Frame:
    """A frame of at most `side` pixels on the longer side, from a photo and its depth.

    Depth is sampled at the nearest pixel, not averaged.

    Args:
        rgb: [H, W, 3] sRGB.
        depth: [h, w] of nearly the same shape.
        valid: [h, w] bool, where depth is known.
        side: the most pixels on the longer side; a smaller photo keeps its size.
    """
    scale = min(1.0, side / max(rgb.shape[:2]))
    size = [max(1, round(length * scale)) for length in rgb.shape[:2]]  # height and width
    picture = rgb.permute(2, 0, 1)
    if scale < 1:
        smaller = interpolate(picture[None], size=size, mode="bicubic", antialias=True)
        picture = smaller[0].clamp(0, 1)  # bicubic values may exceed 0..1
    inverse_depth = torch.where(valid, 1 / depth.clamp_min(1e-6), 0.0)
    sampled = interpolate(inverse_depth[None, None], size=size, mode="nearest-exact")[0, 0]
    return Frame(picture.contiguous(), sampled, sampled > 0)
