"""Tanks and Temples: video frames of large scenes, with COLMAP models."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spackle.errors import InputError
from spackle.evaluation.case import Case
from spackle.evaluation.datasets.colmap import Model, model_folder, read_model
from spackle.evaluation.datasets.folders import by_name, scene_folders
from spackle.evaluation.datasets.multiview import Posed, check_two, make_case, near_views, posed_by
from spackle.evaluation.datasets.sampling import frames_of, spread


class Tanks:
    """`SCENE/images` with `SCENE/sparse/0`: what COLMAP, 3D Gaussian splatting and most of the field call a scene.

    `SCENE/sparse` without the 0, and `SCENE/dense/{images,sparse}`, are read too. The lens has to be nearly a pinhole's
    (`colmap image_undistorter` makes it one). The dataset's own archives have no such models, only `.log` poses
    without lenses, which are not read. Lengths are arbitrary.

    512 photos are taken from all scenes by `spread`: evenly, and by names alone; second views come from all photos,
    see `near_views`. The paper's 331,776 cells are those of 1920×1080, the size of most scenes' frames; those of
    2048×1080 give 1536×810, and the 980×545 that came with 3D Gaussian splatting stay as they are.
    """

    name = "tanks"
    title = "Tanks"
    terms = "see its page; research, cite"
    paper_images = 512

    def cases(self, root: Path) -> Sequence[Case]:
        """One case for each photo that is taken; see `EvalDataset`."""
        scenes = by_name(scene_folders(root, self.name))
        read = {name: _read(scene) for name, scene in scenes.items()}
        picked = spread(list(scenes), lambda name: range(len(read[name][1])), self.paper_images)
        return [case for name, (model, views) in read.items() for case in _cases(model, views, frames_of(name, picked))]


def _cases(model: Model, views: list[Posed], wanted: list[int]) -> list[Case]:
    seconds = near_views(views, wanted)
    return [make_case(views, index, others, model=model) for index, others in seconds.items()]


def _read(scene: Path) -> tuple[Model, list[Posed]]:
    folder = model_folder(scene)
    model = read_model(folder)
    check_two(scene, len(model.views))
    top = scene / "dense" if "dense" in folder.relative_to(scene).parts else scene
    photos = [top / "images" / view.name for view in model.views]
    for photo in photos:
        if not photo.is_file():
            raise InputError(f"{photo}: no such photo, but {folder} has it: put the scene's photos there")
    names = [f"{scene.name}/{Path(view.name).with_suffix('').as_posix()}" for view in model.views]
    return model, posed_by(model, names, photos)
