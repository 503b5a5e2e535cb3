"""Tanks and Temples, or other scenes in the usual layout for COLMAP and 3D Gaussian splatting."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from spackle.formats.colmap import model_folder
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.colmap import read_model
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.multiview import (
    PosedPhoto,
    make_cases,
    posed_photos_of_model,
    spread_over_scenes,
)
from spackle.paper.evaluation.paper_numbers import PAPER_IMAGE_COUNTS


def tanks_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """Cases (input photos with what is known about them) of scenes with COLMAP models.

    A scene has SCENE/images and SCENE/sparse/0, or SCENE/sparse, or SCENE/dense/{images,sparse}.
    The camera must be close to a pinhole; `colmap image_undistorter` makes such cameras. The
    dataset's archives have no such models, only .log poses without intrinsics, which are not
    read. The unit of length is arbitrary.

    512 photos, the paper's number, are chosen evenly from all scenes; second views come from all
    photos of a scene. Most scenes have frames of 1920×1080, which are evaluated at 1536×864: 768
    · 432 = 331,776 cells of 2×2 pixels, the paper's number. Frames of 2048×1080 become 1536×810;
    the 980×545 photos that were published with 3D Gaussian splatting keep their size.

    Args:
        scenes: the folder of each scene, by the scene's name.

    Raises:
        InputError: a model is missing or damaged, or a lens is too far from a pinhole.
    """
    photos = {name: _photos_of_scene(folder) for name, folder in scenes.items()}
    chosen_indices = spread_over_scenes(
        list(scenes), lambda name: range(len(photos[name])), PAPER_IMAGE_COUNTS["Tanks"]
    )
    cases = []
    for name, indices in chosen_indices.items():
        cases += make_cases(photos[name], indices)
    return cases


def _photos_of_scene(folder: Path) -> list[PosedPhoto]:
    """The photos of a scene with their poses, sorted by name; InputError for bad files."""
    folder_of_model = model_folder(folder)
    model = read_model(folder_of_model)

    # COLMAP's undistorter writes model and photos into the folder dense/.
    is_in_dense = "dense" in folder_of_model.relative_to(folder).parts
    images_folder = folder / "dense" / "images" if is_in_dense else folder / "images"
    files = [images_folder / view.name for view in model.views]

    photos = []
    for photo, view in zip(posed_photos_of_model(folder, model, files), model.views, strict=True):
        # The name keeps the photo's subfolder, because photos in two subfolders may be named alike.
        name_in_model = Path(view.name).with_suffix("").as_posix()
        photos.append(dataclasses.replace(photo, name=f"{folder.name}/{name_in_model}"))
    return photos


TANKS = EvalDataset(
    name="tanks",
    title="Tanks",
    terms="see its page; research, cite",
    markers=("sparse", "dense/sparse"),
    expected="SCENE/sparse/0 beside SCENE/images",
    read_cases=tanks_cases,
)
