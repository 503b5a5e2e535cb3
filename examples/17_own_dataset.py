"""Your own dataset in the evaluation, in whatever layout its files have.

python examples/17_own_dataset.py pairs results

pairs/NAME holds photo.png, depth.npy (metres), second.png, and camera.json with the photo's width,
height and focal length in pixels, and the distance in metres by which the second camera stands to
the right. On the command line, in the folder of this file:

spackle evaluate pairs --dataset 17_own_dataset:OWN_PAIRS --protocol near-view --base rgbd
"""

import functools
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import torch

import spackle
from spackle.bases.settings import BaseSettings
from spackle.paper.evaluation.case import Case, SecondView
from spackle.paper.evaluation.datasets import EvalDataset
from spackle.paper.evaluation.evaluate import evaluate
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.runtime.progress import Reporter


def read_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """One case for each folder: the photo, its depth, and the second photo to compare with."""
    cases = []
    for name, folder in scenes.items():
        numbers = json.loads((folder / "camera.json").read_text())
        camera = spackle.Camera.from_focal(numbers["focal_px"], numbers["width"], numbers["height"])
        to_second = torch.eye(4)
        to_second[0, 3] = -numbers["right_m"]
        second_camera = spackle.Camera(camera.K, to_second, camera.width, camera.height)
        second = SecondView("right", folder / "second.png", second_camera)
        read_depth = functools.partial(spackle.load_depth, folder / "depth.npy")
        cases.append(Case(name, folder / "photo.png", camera, read_depth, second_views=(second,)))
    return cases


OWN_PAIRS = EvalDataset(
    name="own-pairs",
    title="My pairs",
    terms="mine",
    markers=("camera.json",),
    expected="NAME/camera.json",
    read_cases=read_cases,
)


def main(pairs: Path, results: Path) -> None:
    name = f"{__name__}:OWN_PAIRS"
    base = BaseSettings(name="rgbd")
    options = EvaluateOptions(dataset=name, root=pairs, protocol="near-view", base=base)
    evaluate(options, results, Reporter())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
