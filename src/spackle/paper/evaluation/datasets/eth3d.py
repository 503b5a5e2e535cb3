"""ETH3D: undistorted DSLR photos of the training scenes, with COLMAP models."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.colmap import read_model
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.multiview import make_cases, posed_photos_of_model

MODEL_FOLDER = "dslr_calibration_undistorted"


def eth3d_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """A case (an input photo with what is known about it) for each photo of each scene.

    All other photos of the scene are second views of the case.

    A scene has the COLMAP model SCENE/dslr_calibration_undistorted/{cameras,images,points3D}.txt
    and the photos SCENE/images/dslr_images_undistorted/*.JPG. The model was aligned to laser
    scans, so its points are metric. The dense ground truth belongs to the distorted photos and is
    not used. The 13 training scenes have the paper's 454 images.

    Args:
        scenes: the folder of each scene, by the scene's name.

    Raises:
        InputError: a model is missing or damaged.
    """
    cases = []
    for folder in scenes.values():
        # The model's names of photos contain their folder.
        model = read_model(folder / MODEL_FOLDER)
        photos = [folder / "images" / view.name for view in model.views]
        cases += make_cases(posed_photos_of_model(folder, model, photos))
    return cases


ETH3D = EvalDataset(
    name="eth3d",
    title="ETH3D",
    terms="CC BY-NC-SA 4.0",
    markers=(MODEL_FOLDER,),
    expected="SCENE/dslr_calibration_undistorted/images.txt",
    read_cases=eth3d_cases,
)
