"""Sources of views with holes and targets: photos, RGB-D frames, stereo pairs, a pseudo-supervised dataset."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d

from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.focal_length import focal_mm_to_px
from spackle.core.gaussians import Gaussians
from spackle.core.photo import PHOTO_SUFFIXES, load_photo
from spackle.core.trajectories import SHARP_TRAJECTORIES, DepthRange, trajectory_cameras
from spackle.depth.calibration import read_calibration
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.paper.dataset.shards import DatasetFiles
from spackle.paper.training.recipe import DataRecipe
from spackle.paper.training.samples import Sample, Source
from spackle.render import Renderer
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import list_files

VISIBLE_DEPTH_TOLERANCE = 0.02  # a Gaussian up to this far behind the visible surface, relative to the depth, counts as visible
MAX_CORNER_DISTANCE_PX = (
    0.25  # pixels: a centre closer than this to a pixel's corner counts as being at the corner
)
PATH_FRAMES = 24  # frames of a path, one of which becomes the virtual camera
INPAINTERS_WITHOUT_TARGETS = (
    "none",
    "geometry",
)  # inpainters that leave holes empty, or paint what the untrained residual renders

DrawPhotoWithDepth = Callable[
    [np.random.Generator], tuple[Tensor, DepthMap, Camera]
]  # draws a photo [H, W, 3] sRGB with depth


def find_sources(data: DataRecipe, renderer: Renderer, *, validation: bool) -> list[Source]:
    """Find the files of a recipe, for training or for `validation`.

    InputError if the recipe names no data, or a folder is missing or has no suitable files.
    """
    shares, sources = data.shares, list[Source]()

    def add(
        name: str,
        share: float,
        folder: Path,
        files: Sequence[Path],
        draw: DrawPhotoWithDepth | None = None,
    ) -> None:
        """Add a source: reverse views of photos that `draw` makes, or the right views of stereo pairs if it is None."""

        def view(rng: np.random.Generator, index: int) -> Sample:
            return (
                random_reverse_view(rng, draw, data.disparity, renderer)
                if draw
                else random_right_view(rng, files, renderer)
            )

        if share > 0:
            sources.append(
                Source(
                    share, view, [name, *(file.relative_to(folder).as_posix() for file in files)]
                )
            )

    if data.photos is not None:
        photos = find_files(data.photos, "data.photos", PHOTO_SUFFIXES, "photos")
        add(
            "composites",
            shares.composites,
            data.photos,
            photos,
            partial(draw_composite, photos=photos),
        )
    frames = [
        find_files(camera.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg")
        for camera in data.rgbd
    ]
    for camera, files in zip(data.rgbd, frames, strict=True):
        share = shares.rgbd * len(files) / sum(map(len, frames))  # all frames are equally likely
        draw = partial(
            draw_rgbd_frame, frames=files, focal_px=camera.focal_px, unit_m=camera.unit_m
        )
        add("rgbd", share, camera.folder, files, draw)
    if data.stereo is not None:
        scenes = [
            file.parent
            for file in find_files(data.stereo, "data.stereo", ("scene.json",), "scene.json")
        ]
        add("stereo", shares.stereo, data.stereo, scenes, partial(draw_left_photo, folders=scenes))
        add("pairs", shares.pairs, data.stereo, scenes)
    if data.pseudo is not None and shares.pseudo > 0:
        dataset = open_pseudo_dataset(data.pseudo)
        split = split_photos(dataset, data)
        places = [
            (photo, view)
            for photo in split[validation]
            for view in views_with_holes(dataset, photo)
        ]
        photo_at = lru_cache(1)(dataset.__getitem__)  # the views of a photo follow each other

        def stored(rng: np.random.Generator, index: int) -> Sample:
            photo = photo_at(places[index][0])
            view = photo.view(places[index][1])
            return Sample.of(
                photo.base, view.rendering, view.camera, view.photo_camera, view.photo, view.target
            )

        names = ["pseudo", dataset.manifest.digest, *map(str, split[True])]
        sources.append(Source(shares.pseudo, stored, names, views=len(places)))
    if not sources:
        raise InputError(
            "the recipe has no data: set data.photos=FOLDER, data.rgbd, data.stereo or data.pseudo, and a share above 0"
        )
    return sources


def find_files(folder: Path, key: str, endings: tuple[str, ...], what: str) -> list[Path]:
    """All files below a folder with one of these endings, sorted; InputError if there are none."""
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder, but {key} names it: give {key}=FOLDER")
    files = list_files(folder, endings, below=True)
    if not files:
        raise InputError(f"{folder}: contains no {what}: set {key} to another folder")
    return files


# Views --------------------------------------------------------------------------------------------


def reverse_view(
    prediction: BasePrediction, photo: Tensor, viewer: Camera, renderer: Renderer
) -> Sample:
    """Keep the Gaussians that a virtual camera sees, and render them at the photo's own camera.

    Parts of the photo that the virtual camera cannot see become holes, and the photo is the target.

    Args:
        prediction: from `lift_rgbd` with levels=0.
        photo: [H, W, 3] sRGB at the camera's size.
        viewer: the virtual camera, which is the input camera of the sample.
        renderer: renders the views.
    """
    camera, gaussians = prediction.camera, prediction.gaussians
    view = renderer.render(gaussians, viewer)
    kept = gaussians.select(
        add_visible_backing(visible_from(gaussians, viewer, view.depth), gaussians, camera)
    )
    return Sample.of(kept, renderer.render(kept, camera), camera, viewer, view.rgb, photo)


def visible_from(gaussians: Gaussians, viewer: Camera, depth: Tensor) -> Tensor:
    """[N] bool: the Gaussians no farther than the greatest rendered `depth` [H, W] of the 3×3 pixels around them.

    One pixel's depth is not enough: at an outline, the pixel of a farther Gaussian may show the nearer surface.
    """
    around = max_pool2d(depth[None, None], 3, stride=1, padding=1)[0, 0]
    uv, z = viewer.project(gaussians.means)
    column, row = uv.floor().long().unbind(-1)
    inside = (column >= 0) & (column < viewer.width) & (row >= 0) & (row < viewer.height) & (z > 0)
    at = row.clamp(0, viewer.height - 1), column.clamp(0, viewer.width - 1)
    return inside & ((depth[at] == 0) | (z <= around[at] * (1 + VISIBLE_DEPTH_TOLERANCE)))


def add_visible_backing(seen: Tensor, gaussians: Gaussians, camera: Camera) -> Tensor:
    """Extend `seen` [N] to backing Gaussians, which lie behind their surface by design (`spackle.lifting.lift`).

    A backing Gaussian counts as seen if the farthest of the four pixels around the Gaussian is seen. A lifted photo's
    first H · W Gaussians belong to pixels; among the rest, backing Gaussians are those at corners of pixels.
    """
    width, height = camera.width, camera.height
    uv, z = camera.project(gaussians.means)
    corner = uv.round().long()
    x, y = (
        (corner[:, :1] - torch.tensor([1, 0, 1, 0])),
        (corner[:, 1:] - torch.tensor([1, 1, 0, 0])),
    )
    around = y.clamp(0, height - 1) * width + x.clamp(0, width - 1)
    backed = around.gather(1, z[around].argmax(-1, keepdim=True))[:, 0]
    backing = (uv - corner).abs().amax(-1) < MAX_CORNER_DISTANCE_PX
    backing[: width * height] = False
    return torch.where(backing, seen[backed], seen)


def random_reverse_view(
    rng: np.random.Generator,
    draw: DrawPhotoWithDepth,
    disparity: tuple[float, float],
    renderer: Renderer,
) -> Sample:
    """`reverse_view` of a random photo, with a random frame of a random path as the virtual camera."""
    rgb, depth, camera = draw(rng)
    prediction = lift_rgbd(
        rgb, depth, camera, levels=0
    )  # no tiles: a tile would be seen or hidden as a whole
    kind = SHARP_TRAJECTORIES[rng.integers(len(SHARP_TRAJECTORIES))]
    reach = DepthRange.of(prediction.gaussians)
    viewer = trajectory_cameras(kind, camera, rng.uniform(*disparity), reach, PATH_FRAMES)[
        rng.integers(PATH_FRAMES)
    ]
    return reverse_view(prediction, rgb, viewer, renderer)


def random_right_view(
    rng: np.random.Generator, folders: Sequence[Path], renderer: Renderer
) -> Sample:
    """The lifted left photo of a random stereo pair, rendered at the right camera; the right photo is the target."""
    left, right, depth, camera, beside = load_pair(pick_random(rng, folders))
    base = lift_rgbd(left, depth, camera).gaussians
    return Sample.of(base, renderer.render(base, beside), beside, camera, left, right)


def open_pseudo_dataset(location: str | os.PathLike[str]) -> DatasetFiles:
    """Open a pseudo-supervised dataset (appendix, "Dataset"); InputError if no target is useful."""
    files = DatasetFiles(location)
    name = files.manifest.config.get("inpainter", {}).get("name")
    if name in INPAINTERS_WITHOUT_TARGETS:
        raise InputError(
            f"{location}: built with --inpainter {name}, whose targets teach nothing: build another dataset with "
            "--inpainter propainter, exemplar or lama"
        )
    if not any(views_with_holes(files, photo) for photo in range(len(files))):
        raise InputError(
            f"{location}: no view has a hole: build the dataset with a wider --disparity"
        )
    return files


def split_photos(files: DatasetFiles, data: DataRecipe) -> tuple[list[int], list[int]]:
    """Indices of a dataset's photos for training, and of other photos for validation, shuffled by `data.seed`.

    InputError if the dataset has a single photo.
    """
    photos, per_photo = len(files), len(files.samples[0][1].holes)
    if photos < 2:
        raise InputError(
            f"{data.pseudo}: has one photo, but training and validation need two: build a larger one"
        )
    order = [int(place) for place in np.random.default_rng(data.seed).permutation(photos)]
    held = min(max(1, data.validation_views // per_photo), photos // 2)
    return order[held:][: max(1, data.views // per_photo)], order[:held]


def views_with_holes(files: DatasetFiles, photo: int) -> list[int]:
    return [view for view, hole in enumerate(files.samples[photo][1].holes) if hole > 0]


# Photos with depth --------------------------------------------------------------------------------


def draw_rgbd_frame(
    rng: np.random.Generator, frames: Sequence[Path], focal_px: float, unit_m: float
) -> tuple[Tensor, DepthMap, Camera]:
    rgb, depth = load_frame(pick_random(rng, frames), unit_m)
    return rgb, depth, Camera.from_focal(focal_px, rgb.shape[1], rgb.shape[0])


def draw_left_photo(
    rng: np.random.Generator, folders: Sequence[Path]
) -> tuple[Tensor, DepthMap, Camera]:
    left, _, depth, camera, _ = load_pair(pick_random(rng, folders))
    return left, depth, camera


def pick_random(rng: np.random.Generator, files: Sequence[Path]) -> Path:
    return files[int(rng.integers(len(files)))]


def load_frame(color: Path, unit_m: float) -> tuple[Tensor, DepthMap]:
    """Read the photo NAME.color.jpg of a depth camera, [H, W, 3] sRGB, and the depth in NAME.depth.png.

    `unit_m` is one unit of the depth file in metres; 0 and 65535 mean unknown depth. InputError if a file is missing or
    broken.
    """
    rgb = load_photo(color).rgb
    stored = load_depth(
        color.with_name(color.name.replace(".color.", ".depth.")).with_suffix(".png")
    )
    stored.check_aspect_ratio(rgb.shape[0], rgb.shape[1], color)
    return rgb, dataclasses.replace(
        stored, depth=stored.depth * (unit_m / 0.001)
    )  # `load_depth` assumes mm


def load_pair(folder: Path) -> tuple[Tensor, Tensor, DepthMap, Camera, Camera]:
    """Read a stereo pair: left and right photo [H, W, 3] sRGB, depth of the left photo, left and right camera.

    InputError if a file is missing or broken.
    """
    scene = folder / "scene.json"
    with as_input_error(
        folder, "no stereo pair: needs a scene.json that names photos and calibration ({reason})"
    ):
        facts = json.loads(scene.read_text(encoding="utf-8"))
        names = [folder / facts[key] for key in ("left", "right", "disparity")]
        lens = read_calibration(scene)
    left, right = (load_photo(name).rgb for name in names[:2])
    if left.shape != right.shape:
        raise InputError(f"{folder}: the two photos differ in size")
    depth = load_depth(names[2], calib=scene)
    depth.check_aspect_ratio(left.shape[0], left.shape[1], names[0])
    height, width = left.shape[:2]
    return left, right, depth, *lens.cameras(width, height)


# Photos without depth -----------------------------------------------------------------------------

COMPOSITE_SIZE_PX = (336, 448)  # height, width; swapped in half of the composites
FOCAL_MM = (20.0, 50.0)  # range of focal lengths, 35 mm equivalent
BACKGROUND_DEPTH_M = (3.0, 8.0)  # depth of the farthest plane
CUTOUT_NEARNESS = (
    1.15,
    4.0,
)  # ratio of a cut-out's inverse depth to the largest inverse depth behind the cut-out
MIN_DEPTH_M = 0.7
CUTOUT_COUNT = (1, 4)  # number of cut-outs
CUTOUT_AREA = (0.01, 0.35)  # share of the image that a cut-out may cover

DrawPhoto = Callable[[np.random.Generator], Tensor]  # gives a random photo [H, W, 3] sRGB


def draw_composite(
    rng: np.random.Generator, photos: Sequence[Path]
) -> tuple[Tensor, DepthMap, Camera]:
    """A random composite, its depth, and a camera with a random focal length."""
    height, width = COMPOSITE_SIZE_PX if rng.random() < 0.5 else COMPOSITE_SIZE_PX[::-1]
    rgb, inverse_depth = compose_cutouts(
        rng, lambda rng: load_photo(pick_random(rng, photos)).rgb, height, width
    )
    focal = focal_mm_to_px(rng.uniform(*FOCAL_MM), width, height)
    every = torch.ones_like(inverse_depth, dtype=torch.bool)
    depth = DepthMap(1.0 / inverse_depth, every, None, None, "depth", Path("composite"))
    return rgb, depth, Camera.from_focal(focal, width, height)


def compose_cutouts(
    rng: np.random.Generator, photos: DrawPhoto, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """An image [H, W, 3] sRGB of cut-outs of photos in front of another photo, and its inverse depth [H, W] in 1/m."""
    rgb = random_crop(rng, photos(rng), height, width)
    inverse_depth = random_background(rng, height, width)
    for _ in range(rng.integers(CUTOUT_COUNT[0], CUTOUT_COUNT[1] + 1)):
        picture = random_crop(rng, photos(rng), height, width)
        shape = random_outline(rng, picture)
        share = float((shape > 0.5).float().mean())
        if not CUTOUT_AREA[0] < share < CUTOUT_AREA[1]:
            continue
        inside = shape > 0.5
        depth = float(inverse_depth[inside].max()) * rng.uniform(*CUTOUT_NEARNESS)
        if depth > 1 / MIN_DEPTH_M:
            continue
        plane = depth * (1 + random_ramp(rng, height, width, 0.1))
        rgb = torch.lerp(rgb, picture, shape[..., None])
        inverse_depth = torch.where(inside, plane, inverse_depth)
    return rgb, inverse_depth


def random_crop(rng: np.random.Generator, photo: Tensor, height: int, width: int) -> Tensor:
    """[height, width, 3]: a random part of a photo [h, w, 3] at a random scale, mirrored in half of all cases."""
    rows, columns = photo.shape[:2]
    smallest = max(height / rows, width / columns)
    scale = smallest * rng.uniform(1.0, 1.5)
    size = max(height, math.ceil(rows * scale)), max(width, math.ceil(columns * scale))
    resized = interpolate(photo.permute(2, 0, 1)[None], size=size, mode="bicubic", antialias=True)[
        0
    ].clamp(0, 1)
    top, left = (
        int(rng.integers(0, have - want + 1))
        for have, want in zip(size, (height, width), strict=True)
    )
    part = resized[:, top : top + height, left : left + width].permute(1, 2, 0)
    return part.flip(1).contiguous() if rng.random() < 0.5 else part.contiguous()


def random_background(rng: np.random.Generator, height: int, width: int) -> Tensor:
    """Inverse depth [H, W] of a wall, in some cases with the ground or a second wall."""
    far = 1.0 / rng.uniform(*BACKGROUND_DEPTH_M)
    plane = far * (1 + random_ramp(rng, height, width, 0.3))
    if rng.random() < 0.5:  # the ground: inverse depth grows linearly below the horizon
        rows = (torch.arange(height) + 0.5) / height
        ground = far * rng.uniform(1.5, 4.0) * (rows - rng.uniform(0.2, 0.6))[:, None].clamp_min(0)
        plane = torch.maximum(plane, ground.expand(height, width))
    if rng.random() < 0.3:
        plane = torch.maximum(plane, far * (1 + random_ramp(rng, height, width, 1.0)))
    return plane.clamp(0.5 * far, 1 / MIN_DEPTH_M)


def random_ramp(rng: np.random.Generator, height: int, width: int, most: float) -> Tensor:
    """A linear ramp [H, W] of random direction, within ±`most`."""
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij"
    )
    a, b = (rng.uniform(-most, most) / 2 for _ in range(2))
    return a * x + b * y


def random_outline(rng: np.random.Generator, picture: Tensor) -> Tensor:
    """A mask [H, W] in 0..1 of random shape, with an edge about one pixel wide."""
    height, width = picture.shape[:2]
    cloud = smooth_noise(rng, height, width, rng.uniform(0.1, 0.35))
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    cy, cx = rng.uniform(0.1, 1.0) * height, rng.uniform(0.0, 1.0) * width
    kind = rng.random()
    if kind < 0.35:  # pixels similar to a point's colour, so that outlines follow real objects
        smooth = avg_pool2d(
            picture.permute(2, 0, 1)[None], 9, stride=1, padding=4, count_include_pad=False
        )[0]
        color = smooth[:, min(int(cy), height - 1), min(int(cx), width - 1)]
        unlike = ((smooth - color[:, None, None]) ** 2).sum(0) / rng.uniform(0.01, 0.04)
        away = ((x - cx) ** 2 + (y - cy) ** 2) / (rng.uniform(0.15, 0.5) * width) ** 2
        field = 1 - unlike - away + 0.1 * cloud
    elif kind < 0.75:  # a blob
        ry, rx = (rng.uniform(0.08, 0.4) * side for side in (height, width))
        field = 1 - ((x - cx) / rx) ** 2 - ((y - cy) / ry) ** 2 + rng.uniform(0.0, 0.8) * cloud
    else:  # a bar
        angle = rng.uniform(-0.4, 0.4) + (math.pi / 2 if rng.random() < 0.25 else 0.0)
        across = ((x - cx) * math.cos(angle) + (y - cy) * math.sin(angle)).abs()
        field = 1 - across / (rng.uniform(0.008, 0.06) * width) + 0.2 * cloud
    soft = (field > 0).float()[None, None]
    return avg_pool2d(soft, 3, stride=1, padding=1, count_include_pad=False)[0, 0]


def smooth_noise(rng: np.random.Generator, height: int, width: int, size: float) -> Tensor:
    """Smooth noise [H, W] of about ±1, with features of `size` times the width."""
    rows, columns = max(2, round(height / (size * width))), max(2, round(1 / size))
    coarse = torch.from_numpy(rng.standard_normal((1, 1, rows, columns)).astype(np.float32))
    return interpolate(coarse, size=(height, width), mode="bicubic", align_corners=True)[0, 0]
