"""ETH3D: high-resolution photos with COLMAP models in metres, and rectified grey pairs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spackle.errors import InputError
from spackle.evaluation.case import Case
from spackle.evaluation.datasets.colmap import read_model
from spackle.evaluation.datasets.folders import by_name, is_two_view, scene_folders
from spackle.evaluation.datasets.multiview import check_two, make_case, near_views, posed_by
from spackle.evaluation.datasets.stereo import TRUTHS_2014, pair_of_2014

CALIBRATION = "dslr_calibration_undistorted"


class Eth3d:
    """The undistorted DSLR photos of the training scenes, or the two-view scenes.

    Multi-view: `SCENE/dslr_calibration_undistorted/{cameras,images,points3D}.txt` and
    `SCENE/images/dslr_images_undistorted/*.JPG`. The model is metric (it was aligned to laser scans); its sparse points
    give the scale. The dense truth is of the distorted photos, and not used. Second views: see `near_views`. The
    paper's 454 images are the 13 training scenes'.

    Two-view: `SCENE_1l/im0.png`, `im1.png`, `calib.txt`, and the truth beside them or, as it is unpacked, in
    `two_view_training_gt/SCENE_1l`. A root with both kinds gives both; give the folder of one of them alone.
    """

    name = "eth3d"
    title = "ETH3D"
    terms = "CC BY-NC-SA 4.0"
    paper_images = 454

    def cases(self, root: Path) -> Sequence[Case]:
        """One case for each photo, or each pair; see `EvalDataset`."""
        scenes = by_name(scene_folders(root, self.name)).values()
        multi = [case for scene in scenes if not is_two_view(scene) for case in _photos_of(scene)]
        return multi + [_pair_of(scene) for scene in scenes if is_two_view(scene)]


def _photos_of(scene: Path) -> list[Case]:
    folder = scene / CALIBRATION
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder: unpack the scene's dslr_undistorted archive")
    model = read_model(folder)
    check_two(scene, len(model.views))
    photos = [_photo(scene, view.name) for view in model.views]
    names = [f"{scene.name}/{Path(view.name).stem}" for view in model.views]
    views = posed_by(model, names, photos)
    seconds = near_views(views, range(len(views)))
    return [make_case(views, index, others, model=model, metric=True) for index, others in seconds.items()]


def _photo(scene: Path, name: str) -> Path:
    """The model names a photo by its folder: dslr_images_undistorted/DSC_0286.JPG."""
    places = [scene / "images" / name, scene / name, scene / "images" / Path(name).name]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise InputError(
            f"{places[0]}: no such photo, but the model has it: unpack the scene's dslr_undistorted archive"
        )
    return found


def _pair_of(scene: Path) -> Case:
    """The truth lies beside the photos, or in the folder that its own archive makes."""
    apart = scene.parent.parent / "two_view_training_gt" / scene.name
    truth = next((at / name for at in (scene, apart) for name in TRUTHS_2014 if (at / name).is_file()), None)
    return pair_of_2014(scene, truth)
