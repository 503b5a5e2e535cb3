"""Sources of training views with holes and targets; read `find_sources` first.

A hole is what a photo does not show when the camera moves. Photos with depth give views by
`reverse_view`: parts of the photo become holes, and the photo is the target. A stereo pair gives
the right photo as the target, a dataset of `spackle dataset build` the pictures of an inpainter.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import SHARP_TRAJECTORIES, trajectory_cameras
from spackle.depth.depth_map import DepthMap
from spackle.paper.dataset.joined import JoinedDataset
from spackle.paper.dataset.shards import SampleEntry
from spackle.paper.training.composites import draw_composite
from spackle.paper.training.measured_photos import (
    draw_left_photo,
    draw_rgbd_frame,
    find_files,
    find_photo_files,
    load_pair,
    pick_random,
)
from spackle.paper.training.recipe import DataRecipe
from spackle.paper.training.sample_factory import Source
from spackle.paper.training.samples import Sample
from spackle.render import Renderer
from spackle.runtime.errors import InputError

# A Gaussian up to this far behind the visible surface, relative to the depth, counts as visible.
VISIBLE_DEPTH_TOLERANCE = 0.02
# A centre closer than this to a pixel's corner, in pixels, counts as being at the corner.
MAX_CORNER_DISTANCE_PX = 0.25
PATH_FRAMES = 24  # frames of a camera path, one of which becomes the virtual camera
# Ways of completion that leave holes empty, or paint what the untrained network renders anyway.
INPAINTERS_WITHOUT_TARGETS = ("none", "geometry")

# Draws a random photo [H, W, 3] sRGB with its depth and camera.
DrawPhotoWithDepth = Callable[[np.random.Generator], tuple[Tensor, DepthMap, Camera]]


def find_sources(data: DataRecipe, renderer: Renderer, *, validation: bool) -> list[Source]:
    """Find the files of a recipe; returns the sources of training views that are to be used.

    A source makes views with holes, and knows what the holes should show. Its share is the part of
    all views that it gives; sources whose share is 0 are left out.

    Args:
        data: names the folders, and the share of each source.
        renderer: renders the views.
        validation: whether the views are for validation, for which a dataset keeps some photos
            back; the other sources are the same as for training.

    Raises:
        InputError: the recipe names no data, or a folder is missing or has no suitable files.
    """
    sources: list[Source] = []
    if data.photos is not None:
        sources.append(composite_source(data, data.photos, renderer))
    sources += rgbd_sources(data, renderer)
    if data.stereo is not None:
        sources += stereo_sources(data, data.stereo, renderer)
    sources = [source for source in sources if source.share > 0]

    # A dataset is large, so it is only opened if it is used.
    if data.pseudo and data.shares.pseudo > 0:
        sources.append(dataset_source(data, validation=validation))
    if not sources:
        raise InputError(
            "the recipe has no data: set data.photos=FOLDER, data.rgbd, data.stereo or "
            "data.pseudo, and a share above 0"
        )
    return sources


def composite_source(data: DataRecipe, folder: Path, renderer: Renderer) -> Source:
    """A source of training views from photos without depth, in the folder `data.photos`.

    Cut-outs of photos stand in front of other photos, at random depths. Of such a composite, the
    holes are what a virtual camera does not see, and the composite itself is the target.
    """
    photos = find_photo_files(folder, "data.photos")
    draw = partial(draw_composite, photos=photos)
    return Source(
        share=data.shares.composites,
        view=partial(reverse_view_by_number, draw=draw, data=data, renderer=renderer),
        names=["composites", *relative_names(photos, folder)],  # identify the samples
    )


def rgbd_sources(data: DataRecipe, renderer: Renderer) -> list[Source]:
    """A source of training views for each depth camera in `data.rgbd`, which gives photo and depth.

    The holes are what a virtual camera does not see of a photo, and the photo is the target.
    """
    frames_of_cameras = []
    for camera in data.rgbd:
        frames = find_files(camera.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg")
        frames_of_cameras.append(frames)
    frame_count = sum(len(frames) for frames in frames_of_cameras)

    sources = []
    for camera, frames in zip(data.rgbd, frames_of_cameras, strict=True):
        draw = partial(
            draw_rgbd_frame, frames=frames, focal_px=camera.focal_px, unit_m=camera.unit_m
        )
        source = Source(
            # All frames are equally likely, so a camera's share grows with its frames.
            share=data.shares.rgbd * len(frames) / frame_count,
            view=partial(reverse_view_by_number, draw=draw, data=data, renderer=renderer),
            names=["rgbd", *relative_names(frames, camera.folder)],  # identify the samples
        )
        sources.append(source)
    return sources


def stereo_sources(data: DataRecipe, folder: Path, renderer: Renderer) -> list[Source]:
    """Two sources of training views from stereo pairs, in the folder `data.stereo`.

    In the first, the holes are what a virtual camera does not see of a left photo, and this photo
    is the target. In the second, the left photo is rendered at the right camera; its holes are
    real, and the right photo is the target.
    """
    scene_files = find_files(folder, "data.stereo", ("scene.json",), "scene.json")
    scene_folders = [file.parent for file in scene_files]
    scene_names = relative_names(scene_folders, folder)  # identify the samples

    def right_view_by_number(rng: np.random.Generator, index: int) -> Sample:
        """A random view; its number `index` is not used, because `rng` alone determines it."""
        return random_right_view(rng, scene_folders, renderer)

    draw = partial(draw_left_photo, folders=scene_folders)
    reverse_views = Source(
        share=data.shares.stereo,
        view=partial(reverse_view_by_number, draw=draw, data=data, renderer=renderer),
        names=["stereo", *scene_names],
    )
    right_views = Source(
        share=data.shares.pairs, view=right_view_by_number, names=["pairs", *scene_names]
    )
    return [reverse_views, right_views]


def dataset_source(data: DataRecipe, *, validation: bool) -> Source:
    """A source of the views with holes of the recipe's datasets: of their training or of their
    validation photos.

    The datasets were built with an inpainter, whose pictures are the targets. InputError if they
    cannot be used.
    """
    dataset = open_pseudo_dataset(data.pseudo)
    training_photos, validation_photos = split_photos(dataset, data)
    photos = validation_photos if validation else training_photos
    samples = dataset.samples
    views = [(photo, view) for photo in photos for view in views_with_holes(samples[photo])]

    # The views of a photo follow each other, so the last photo is kept in memory.
    read_photo = lru_cache(maxsize=1)(dataset.__getitem__)

    def stored_view(rng: np.random.Generator, index: int) -> Sample:
        """The dataset's view of this number; `rng` is not used, because nothing is random."""
        photo_number, view_number = views[index]
        photo = read_photo(photo_number)
        view = photo.view(view_number)
        return Sample.of(
            base=photo.base,
            rendering=view.rendering,
            camera=view.camera,
            photo_camera=view.photo_camera,
            photo=view.photo,
            target=view.target,
        )

    # These texts identify the training samples. The numbers of the validation photos are among
    # them, because a dataset that is divided differently gives other samples.
    names = ["pseudo", dataset.digest, *map(str, validation_photos)]
    return Source(
        share=data.shares.pseudo,
        view=stored_view,
        names=names,
        views=len(views),
        datasets=dataset.facts,
    )


def relative_names(files: Sequence[Path], folder: Path) -> list[str]:
    """The names of files relative to a folder, with slashes on every system."""
    return [file.relative_to(folder).as_posix() for file in files]


# Views --------------------------------------------------------------------------------------------


def reverse_view(
    prediction: BasePrediction, photo: Tensor, viewer: Camera, renderer: Renderer
) -> Sample:
    """Keep the Gaussians that a virtual camera sees, and render them at the photo's own camera.

    Parts of the photo that the virtual camera cannot see become holes, and the photo is the target.

    Args:
        prediction: the Gaussians of the photo and its camera, from `lift_rgbd` with levels=0, that
            is, with one Gaussian for each pixel.
        photo: [H, W, 3] sRGB at the camera's size.
        viewer: the virtual camera.
        renderer: renders the views.
    """
    camera = prediction.camera
    gaussians = prediction.gaussians
    virtual_photo = renderer.render(gaussians, viewer)
    is_visible = visible_from(gaussians, viewer, virtual_photo.depth)
    # Gaussians that close gaps behind a visible surface belong to it, although they are hidden.
    visible = gaussians.select(add_visible_backing(is_visible, gaussians, camera))
    rendering = renderer.render(visible, camera)

    # The roles are exchanged: the virtual camera's picture is the sample's photo, and the real
    # photo is the target.
    return Sample.of(
        base=visible,
        rendering=rendering,
        camera=camera,
        photo_camera=viewer,
        photo=virtual_photo.rgb,
        target=photo,
    )


def visible_from(gaussians: Gaussians, viewer: Camera, depth: Tensor) -> Tensor:
    """[N] bool: which Gaussians a camera sees, by their centres and the rendered depth.

    A Gaussian is visible if it is no farther than the greatest depth of the 3×3 pixels around it.
    One pixel is not enough: at an outline, the pixel of a farther Gaussian may show the nearer
    surface.

    Args:
        gaussians: N Gaussians.
        viewer: the camera.
        depth: [H, W] rendered depth of these Gaussians at the camera; 0 where nothing is drawn.
    """
    greatest_depth = max_pool2d(depth[None, None], 3, stride=1, padding=1)[0, 0]  # [H, W]
    uv, z = viewer.project(gaussians.means)  # [N, 2] pixels, [N] depth
    column, row = uv.floor().long().unbind(-1)
    is_in_frame = (column >= 0) & (column < viewer.width) & (row >= 0) & (row < viewer.height)

    # Centres outside of the frame read some pixel at its edge, but do not count.
    pixel = (row.clamp(0, viewer.height - 1), column.clamp(0, viewer.width - 1))
    is_near_enough = z <= greatest_depth[pixel] * (1 + VISIBLE_DEPTH_TOLERANCE)
    # Where nothing is drawn, nothing can hide the Gaussian.
    is_unhidden = is_near_enough | (depth[pixel] == 0)
    return is_in_frame & (z > 0) & is_unhidden


def add_visible_backing(is_visible: Tensor, gaussians: Gaussians, camera: Camera) -> Tensor:
    """Which Gaussians of a lifted photo count as visible, [N] bool, backing Gaussians included.

    Backing Gaussians lie a little behind a surface, at corners of pixels, so that no gap between
    its own Gaussians shows what is behind. By their depth they are hidden. They count as visible if
    the surface is: if the farthest of the four pixels around them is.

    Args:
        is_visible: [N] bool, whether a Gaussian is visible by its depth.
        gaussians: N Gaussians of a lifted photo, of which the first H · W belong to the pixels, row
            by row.
        camera: the photo's camera, of H × W pixels.
    """
    width, height = camera.width, camera.height
    uv, z = camera.project(gaussians.means)
    corner = uv.round().long()  # [N, 2] column and row of the nearest corner of a pixel

    # The four pixels that meet at the corner: left or right of it, above or below.
    columns = corner[:, :1] - torch.tensor([1, 0, 1, 0])  # [N, 4]
    rows = corner[:, 1:] - torch.tensor([1, 1, 0, 0])  # [N, 4]
    pixels = rows.clamp(0, height - 1) * width + columns.clamp(0, width - 1)
    farthest = z[pixels].argmax(-1, keepdim=True)
    backed_pixel = pixels.gather(1, farthest)[:, 0]  # [N]

    is_backing = (uv - corner).abs().amax(-1) < MAX_CORNER_DISTANCE_PX
    is_backing[: width * height] = False  # these belong to pixels
    return torch.where(is_backing, is_visible[backed_pixel], is_visible)


def reverse_view_by_number(
    rng: np.random.Generator,
    index: int,
    draw: DrawPhotoWithDepth,
    data: DataRecipe,
    renderer: Renderer,
) -> Sample:
    """A random training view with holes whose true content is known.

    Its holes are the parts of a photo that a camera at another place, drawn at random, could not
    see. The view is that of the photo itself, so the photo shows what belongs in the holes.

    A `Source` of training views calls this with a random generator and the view's number `index`.
    The number is not used, because `rng` alone determines the view.
    """
    return random_reverse_view(rng, draw, data.disparity, renderer)


def random_reverse_view(
    rng: np.random.Generator,
    draw: DrawPhotoWithDepth,
    disparity_range: tuple[float, float],
    renderer: Renderer,
) -> Sample:
    """A training view with holes whose true content is known, from a random photo.

    Its holes are the parts of the photo that a virtual camera, a random frame of a random camera
    path, does not see. The photo is the target, because it shows what belongs in the holes.

    Args:
        rng: source of all random choices.
        draw: draws the photo with its depth.
        disparity_range: least and greatest disparity of the path, which says how far the camera
            moves.
        renderer: renders the views.
    """
    rgb, depth, camera = draw(rng)
    # levels=0 gives one Gaussian for each pixel. Larger Gaussians, which join pixels of flat parts,
    # could not be visible in one part and hidden in another.
    prediction = lift_rgbd(rgb, depth, camera, levels=0)
    depth_range = prediction.depth_range
    kind = SHARP_TRAJECTORIES[rng.integers(len(SHARP_TRAJECTORIES))]
    disparity = rng.uniform(*disparity_range)
    path = trajectory_cameras(kind, camera, disparity, depth_range, PATH_FRAMES)
    viewer = path[rng.integers(PATH_FRAMES)]
    return reverse_view(prediction, rgb, viewer, renderer)


def random_right_view(
    rng: np.random.Generator, folders: Sequence[Path], renderer: Renderer
) -> Sample:
    """A training view from a random stereo pair, with the right photo as the target.

    The left photo and its depth become Gaussians, which are rendered at the right camera.
    """
    pair = load_pair(pick_random(rng, folders))
    base = lift_rgbd(pair.left, pair.depth, pair.left_camera).gaussians
    rendering = renderer.render(base, pair.right_camera)
    return Sample.of(
        base=base,
        rendering=rendering,
        camera=pair.right_camera,
        photo_camera=pair.left_camera,
        photo=pair.left,
        target=pair.right,
    )


# Datasets -----------------------------------------------------------------------------------------


def open_pseudo_dataset(locations: Sequence[str]) -> JoinedDataset:
    """Open pseudo-supervised datasets as one: views whose targets an inpainter has painted.

    InputError if one is no finished dataset, they do not belong together, they were built without
    an inpainter, or no view has a hole.
    """
    dataset = JoinedDataset(locations)
    for part in dataset.parts:
        inpainter = part.manifest.config.get("inpainter", {}).get("name")
        # Holes that were left empty, or completed without an inpainter, hold nothing new to learn.
        if inpainter in INPAINTERS_WITHOUT_TARGETS:
            raise InputError(
                f"{part.location}: built with `inpainter` {inpainter}, whose targets teach "
                "nothing: build another dataset with `inpainter` propainter, exemplar or lama"
            )
    if not any(any(sample.holes) for sample in dataset.samples):
        raise InputError(
            f"{dataset.where}: no view has a hole: build the dataset with a wider `disparity`"
        )
    return dataset


def split_photos(dataset: JoinedDataset, data: DataRecipe) -> tuple[list[int], list[int]]:
    """Divide a dataset's photos; returns the indices of those for training, then for validation.

    The recipe `data` says how many views each of the two needs: `views` and `validation_views`.
    Validation gets at most half of the photos. InputError if the dataset has a single photo.
    """
    photo_count = len(dataset)
    views_per_photo = len(dataset.samples[0].holes)  # the same number for all photos
    if photo_count < 2:
        raise InputError(
            f"{dataset.where}: has one photo, but training and validation need two: build a larger "
            "one"
        )

    order = [int(index) for index in np.random.default_rng(data.seed).permutation(photo_count)]
    needed_for_validation = max(1, data.validation_views // views_per_photo)
    validation_count = min(needed_for_validation, photo_count // 2)
    training_count = max(1, data.views // views_per_photo)

    # Validation photos come first in the random order, training photos directly after them.
    validation_photos = order[:validation_count]
    training_photos = order[validation_count : validation_count + training_count]
    return training_photos, validation_photos


def views_with_holes(sample: SampleEntry) -> list[int]:
    """Numbers of the views of a dataset's photo, of which `sample` is the entry, with a hole."""
    return [view for view, hole_ratio in enumerate(sample.holes) if hole_ratio > 0]
