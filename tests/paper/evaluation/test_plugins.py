"""A dataset is one file and one line, and a method may lie in another package."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pytest
import torch
from helpers.command import names_in, refuses, run
from helpers.photos import write_photo

from spackle.core.camera import Camera
from spackle.depth.depth_map import DepthMap
from spackle.paper.evaluation import datasets
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.folder import load_run
from spackle.paper.evaluation.methods import MethodView
from spackle.render.protocol import Rendering
from spackle.residual import hole_mask
from spackle.scene_fill import FillContext

WIDTH, HEIGHT = 64, 48


# --- what the file of a new dataset holds


def step_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """A case for each scene: a photo, whose left half is near and whose right half is far."""
    return [_step_case(name, folder / "step.png") for name, folder in scenes.items()]


def _step_case(name: str, photo: Path) -> Case:
    depth = torch.full((HEIGHT, WIDTH), 2.0)
    depth[:, WIDTH // 2 :] = 6.0
    camera = Camera.from_focal(60.0, WIDTH, HEIGHT)
    depth_map = DepthMap(depth, depth > 0, camera.K, None, "depth", photo)
    return Case(name, photo, camera, read_depth=lambda: depth_map)


STEPS = EvalDataset(
    name="steps",
    title="Steps",
    terms="free",
    markers=("step.png",),
    expected="SCENE/step.png",
    read_cases=step_cases,
)


# --- what a module with a new method holds


def grey_holes(
    cameras: Sequence[Camera], context: FillContext
) -> Callable[[Camera, Rendering], MethodView]:
    """A method that paints holes grey."""

    def fill(camera: Camera, before: Rendering) -> MethodView:
        hole = hole_mask(before.alpha)[..., None]
        return MethodView(torch.where(hole, 0.5, before.rgb), None, None)

    return fill


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two scenes of the new dataset; the new method can be imported."""
    # The one line that a new dataset needs.
    monkeypatch.setitem(datasets.DATASETS, "steps", STEPS)
    module = types.ModuleType("my_methods")
    module.grey_holes = grey_holes  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "my_methods", module)
    for scene in ("first", "second"):
        folder = tmp_path / "data" / scene
        folder.mkdir(parents=True)
        write_photo(folder / "step.png", WIDTH, HEIGHT)
    return tmp_path / "data"


def test_a_new_dataset_and_a_new_method_are_evaluated(root: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    words = ("evaluate", root, "--dataset", "steps", "--base", "rgbd", "--metrics", "none")
    choices = ("--methods", "base,my_methods:grey_holes", "--disparity", "0.5", "-o", output)
    done = run(*words, *choices)
    assert done.code == 0, done.err
    found = load_run(output)
    assert found.title == "Steps"
    assert found.measured_images == ["first", "second"]
    assert found.methods == ["base", "my_methods:grey_holes"]
    table = (output / "tables.md").read_text()
    assert "Steps" in table
    assert "grey_holes" in done.out + done.err  # the table of means
    assert "00000-first.my_methods_grey_holes.webp" in names_in(output / "images")


def test_a_method_that_cannot_be_imported_is_refused(root: Path, tmp_path: Path) -> None:
    words = ("evaluate", root, "--dataset", "steps", "--base", "rgbd", "-o", tmp_path / "out")
    refuses(run(*words, "--methods", "my_methods:gone"), "my_methods has no gone")
    refuses(run(*words, "--methods", "no_such_module:fill"), "cannot import no_such_module")
