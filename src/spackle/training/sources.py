"""Where views with holes and their truth come from: photos, RGB-D frames, stereo pairs, a pseudo-supervised dataset.

`reverse_view` needs no inpainter: what a virtual camera cannot see of a photo is a hole in it, and it is the truth.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.bases.depth_map import DepthMap, load_depth, read_calibration
from spackle.bases.lift import lift
from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange, trajectory
from spackle.dataset.shards import DatasetFiles
from spackle.errors import InputError, reading
from spackle.gaussians import Gaussians
from spackle.image import film_to_pixels, load_photo
from spackle.render import Renderer
from spackle.training.composites import composite
from spackle.training.sample import Sample

TOLERANCE = 0.02  # how far behind what the virtual camera sees a Gaussian may lie and still count as seen, relative
CORNER = 0.25  # pixels; centres of pixels are half of one from their corners


def reverse_view(prediction: BasePrediction, photo: Tensor, viewer: Camera, renderer: Renderer) -> Sample:
    """Keep the Gaussians that a virtual camera sees, and look at them from the photo's own camera.

    The virtual camera plays the part of the photo's, and the photo that of the novel view.

    Args:
        prediction: what `lift` makes of a photo without tiles: a Gaussian a pixel, the rest of mixed ones, the backing.
        photo: [H, W, 3] sRGB at the camera's size.
        viewer: the virtual camera.
        renderer: draws the views.
    """
    camera, gaussians = prediction.camera, prediction.gaussians
    seen = with_backing(seen_from(gaussians, viewer, renderer), gaussians, camera)
    kept = gaussians.select(seen)
    return Sample.of(kept, renderer.render(kept, camera), camera, viewer, photo)


def seen_from(gaussians: Gaussians, viewer: Camera, renderer: Renderer) -> Tensor:
    """[N] bool: which Gaussians a camera sees, by the depth that it renders around their centres.

    Around, because a blob is wider than a pixel: at an outline the nearer surface's depth bleeds over
    the farther one, and on steep ground a pixel's depth is behind half of what lies in it.
    """
    depth = renderer.render(gaussians, viewer).depth
    around = max_pool2d(depth[None, None], 3, stride=1, padding=1)[0, 0]
    uv, z = viewer.project(gaussians.means)
    column, row = uv.floor().long().unbind(-1)
    inside = (column >= 0) & (column < viewer.width) & (row >= 0) & (row < viewer.height) & (z > 0)
    at = row.clamp(0, viewer.height - 1), column.clamp(0, viewer.width - 1)
    return inside & ((depth[at] == 0) | (z <= around[at] * (1 + TOLERANCE)))


def with_backing(seen: Tensor, gaussians: Gaussians, camera: Camera) -> Tensor:
    """`seen` [N] of a lifted photo's Gaussians, a backing one counting as the farthest of the pixels around it.

    A backing Gaussian lies behind its surface on purpose, so its own depth says nothing. The photo's pixels come first;
    of all others those backing ones stand at the corners of pixels (see `spackle.bases.lift.lift`).
    """
    width, height = camera.width, camera.height
    uv, z = camera.project(gaussians.means)
    corner = uv.round().long()
    x, y = (corner[:, :1] - torch.tensor([1, 0, 1, 0])), (corner[:, 1:] - torch.tensor([1, 1, 0, 0]))
    around = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
    backed = around.gather(1, z[around].argmax(-1, keepdim=True))[:, 0]
    backing = (uv - corner).abs().amax(-1) < CORNER
    backing[: width * height] = False
    return torch.where(backing, seen[backed], seen)


COMPOSITE_SIZE = (336, 448)  # height, width; half of them stand upright
FOCAL_MM = (20.0, 50.0)  # lenses of photos that do not tell theirs
FRAMES = 24  # of a path, one of which is the virtual camera
UNCOMPLETED = "none"  # the inpainter that leaves its holes open

View = Callable[[np.random.Generator], Sample]  # one of a source's views; InputError for a file that cannot be used
Draw = Callable[[np.random.Generator], tuple[Tensor, DepthMap, Camera]]  # likewise a photo [H, W, 3] sRGB with depth


def random_reverse_view(
    rng: np.random.Generator, draw: Draw, disparity: tuple[float, float], renderer: Renderer
) -> Sample:
    """`reverse_view` of a photo from a random frame of a random path."""
    rgb, depth, camera = draw(rng)
    prediction = lift(rgb, depth, camera, levels=0)  # a tile is seen as a whole, and a hole's outline is not a tile's
    kind = TRAJECTORIES[rng.integers(len(TRAJECTORIES))]
    reach = DepthRange.of(prediction.gaussians)
    viewer = trajectory(kind, camera, rng.uniform(*disparity), reach, FRAMES)[rng.integers(FRAMES)]
    return reverse_view(prediction, rgb, viewer, renderer)


def composite_photo(rng: np.random.Generator, photos: Sequence[Path]) -> tuple[Tensor, DepthMap, Camera]:
    """Photos without depth, cut-outs of some in front of others."""
    height, width = COMPOSITE_SIZE if rng.random() < 0.5 else COMPOSITE_SIZE[::-1]
    rgb, inverse_depth = composite(rng, lambda rng: load_photo(_chosen(rng, photos)).rgb, height, width)
    focal = film_to_pixels(rng.uniform(*FOCAL_MM), width, height)
    every = torch.ones_like(inverse_depth, dtype=torch.bool)
    depth = DepthMap(1.0 / inverse_depth, every, None, None, "depth", Path("composite"))
    return rgb, depth, Camera.from_focal(focal, width, height)


def frame_photo(
    rng: np.random.Generator, frames: Sequence[Path], focal_px: float, unit_m: float
) -> tuple[Tensor, DepthMap, Camera]:
    """One of a depth camera's photos: see `load_frame`."""
    rgb, depth = load_frame(_chosen(rng, frames), unit_m)
    return rgb, depth, Camera.from_focal(focal_px, rgb.shape[1], rgb.shape[0])


def left_photo(rng: np.random.Generator, folders: Sequence[Path]) -> tuple[Tensor, DepthMap, Camera]:
    """The left photo of a stereo pair: see `load_pair`."""
    left, _, depth, camera, _ = load_pair(_chosen(rng, folders))
    return left, depth, camera


def right_view(rng: np.random.Generator, folders: Sequence[Path], renderer: Renderer) -> Sample:
    """The left photo of a stereo pair seen from the right camera, whose photo is the truth."""
    left, right, depth, camera, beside = load_pair(_chosen(rng, folders))
    base = lift(left, depth, camera).gaussians
    return Sample.of(base, renderer.render(base, beside), beside, camera, right)


def _chosen(rng: np.random.Generator, files: Sequence[Path]) -> Path:
    return files[int(rng.integers(len(files)))]


class PseudoViews:
    """Random views with holes and their completed targets of a pseudo-supervised dataset (appendix, "Dataset")."""

    def __init__(self, location: str | os.PathLike[str]) -> None:
        """Read the manifest; InputError for no finished dataset, or one without holes or without completed targets."""
        self.files = DatasetFiles(location)
        config = self.files.manifest.config
        if config.get("inpainter", {}).get("name") == UNCOMPLETED:
            raise InputError(f"{location}: built with --inpainter none, so its targets teach nothing: build another")
        self._open = [
            (photo, view)
            for photo, (_, sample) in enumerate(self.files.samples)
            for view, hole in enumerate(sample.holes)
            if hole > 0
        ]
        if not self._open:
            raise InputError(f"{location}: no view in it has a hole: build it with a wider --disparity")

    @property
    def digest(self) -> str:
        """The same for the same dataset, wherever it lies."""
        return self.files.manifest.digest

    def view(self, rng: np.random.Generator) -> Sample:
        """A view as it is stored, rendering and all; InputError for a file that cannot be used."""
        photo, index = self._open[int(rng.integers(len(self._open)))]
        found = self.files.group(photo).view(index, with_base=True)
        assert found.base is not None
        return Sample.of(found.base, found.rendering, found.camera, found.photo_camera, found.target)


def load_frame(color: Path, unit_m: float) -> tuple[Tensor, DepthMap]:
    """A depth camera's photo NAME.color.jpg [H, W, 3] sRGB and its depth, which lies beside it.

    `unit_m` is of the depth map's numbers, of which 0 and 65535 are unknown. InputError for a missing or broken file.
    """
    rgb = load_photo(color).rgb
    stored = load_depth(color.with_name(color.name.replace(".color.", ".depth.")).with_suffix(".png"))
    stored.check_shape(rgb.shape[0], rgb.shape[1], color)
    return rgb, dataclasses.replace(stored, depth=stored.depth * (unit_m / 0.001))  # it was read as millimetres


def load_pair(folder: Path) -> tuple[Tensor, Tensor, DepthMap, Camera, Camera]:
    """A stereo pair: left and right photo [H, W, 3] sRGB, the left one's depth, both cameras.

    InputError for a file that is missing or broken.
    """
    scene = folder / "scene.json"
    with reading(folder, "no stereo pair: needs a scene.json that names the photos and the lens ({reason})"):
        facts = json.loads(scene.read_text(encoding="utf-8"))
        names = [folder / facts[key] for key in ("left", "right", "disparity")]
        lens = read_calibration(scene)
    left, right = (load_photo(name).rgb for name in names[:2])
    if left.shape != right.shape:
        raise InputError(f"{folder}: the two photos differ in size")
    depth = load_depth(names[2], calib=scene)
    depth.check_shape(left.shape[0], left.shape[1], names[0])
    K, right_K, moved = lens.K, lens.K, torch.eye(4)
    right_K[0, 2] += lens.doffs_px
    moved[0, 3] = -lens.baseline_m
    height, width = left.shape[:2]
    cameras = Camera(K, torch.eye(4), width, height), Camera(right_K, moved, width, height)
    return left, right, depth, *cameras
