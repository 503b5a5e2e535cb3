"""Your own dataset in the evaluation: pairs of photos with a depth map and the second camera.

python examples/17_own_dataset.py pairs results

pairs/NAME holds photo.png, depth.npy (metres), second.png, and camera.json with the focal length
in pixels and the distance in metres by which the second camera stands to the right.
"""

import functools
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import torch
from PIL import Image

import spackle
from spackle.bases.settings import BaseSettings
from spackle.paper.evaluation.case import Case, SecondView
from spackle.paper.evaluation.datasets import DATASETS, EvalDataset
from spackle.paper.evaluation.evaluate import evaluate
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.runtime.progress import Reporter


def read_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """One case for each folder: the first photo, its depth, and the second photo to compare
    with.
    """
    cases = []
    for name, folder in scenes.items():
        numbers = json.loads((folder / "camera.json").read_text())
        with Image.open(folder / "photo.png") as photo:
            width, height = photo.size
        focal = numbers["focal_px"]
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
        to_second = torch.eye(4)
        to_second[0, 3] = -numbers["right_m"]
        second_camera = spackle.Camera(K, to_second, width, height)
        cases.append(
            Case(
                name,
                folder / "photo.png",
                spackle.Camera(K, torch.eye(4), width, height),
                functools.partial(spackle.load_depth, folder / "depth.npy"),
                second_views=(SecondView("right", folder / "second.png", second_camera),),
            )
        )
    return cases


def main(pairs: Path, results: Path) -> None:
    DATASETS["pairs"] = EvalDataset(
        name="pairs",
        title="My pairs",
        terms="mine",
        markers=("camera.json",),
        expected="NAME/camera.json",
        read_cases=read_cases,
    )
    options = EvaluateOptions(
        dataset="pairs",
        root=pairs,
        protocol="near-view",
        methods=("base", "spackle"),
        metrics=("psnr", "ssim"),
        base=BaseSettings(name="rgbd"),
    )
    evaluate(options, results, Reporter())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
