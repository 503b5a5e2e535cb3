"""Middlebury's rectified pairs of photos, and other pairs that a scene.json describes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path

from spackle.depth.calibration import read_calibration, read_short_text
from spackle.depth.readers import load_depth
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.stereo import pair_of_2014, rectified_pair, size_of_photos
from spackle.runtime.errors import as_input_error


def middlebury_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """A case (an input photo with what is known about it) for each scene.

    The left photo is the input, the right photo its second view. A scene's folder has one of

    - im0.png and calib.txt: the dataset of 2014 at full size; MiddEval3 at full, half or quarter
        size;
    - scene.json, which can describe any rectified pair.

    X-imperfect is skipped if there is X-perfect, because the two show the same photos. Test
    scenes are not searched, because they have no ground truth. The paper's 23 scenes are those of
    2014.

    Args:
        scenes: the folder of each scene, by the scene's name.

    Raises:
        InputError: a calibration or disparity map is missing or damaged.
    """
    cases = []
    for name, folder in scenes.items():
        # Names without "-imperfect" stay as they are.
        perfect_name = name.replace("-imperfect", "-perfect")
        has_perfect_twin = perfect_name != name and perfect_name in scenes
        if not has_perfect_twin:
            cases.append(_middlebury_case(folder))
    return cases


def _middlebury_case(folder: Path) -> Case:
    """The case of a folder with scene.json, or else of a folder with the files of 2014.

    scene.json has the calibration, and the names of the files "left", "right" (photos) and
    "disparity". Its principal point counts from the corner of the first pixel. Its baseline need
    not be in true metres, because an evaluation compares only ratios of lengths.

    Raises:
        InputError: a calibration or disparity map is missing or damaged.
    """
    path = folder / "scene.json"
    if not path.exists():
        return pair_of_2014(folder)

    calibration = read_calibration(path)
    with as_input_error(path, "not a scene description: needs the photos and the disparity map"):
        facts = json.loads(read_short_text(path))
        left = folder / str(facts["left"])
        right = folder / str(facts["right"])
        disparity = folder / str(facts["disparity"])

    # The same file has the calibration that turns disparities into depth.
    read_depth = partial(load_depth, disparity, calib=path)
    size = size_of_photos([left])
    return rectified_pair(
        name=folder.name,
        left=left,
        right=right,
        calibration=calibration,
        size=size,
        read_depth=read_depth,
    )


MIDDLEBURY = EvalDataset(
    name="middlebury",
    title="Middlebury",
    terms="free to use, cite",
    markers=("scene.json", "im0.png"),
    expected="SCENE/im0.png with calib.txt, or SCENE/scene.json",
    read_cases=middlebury_cases,
    skipped_folders=("test", "testF", "testH", "testQ"),
)
