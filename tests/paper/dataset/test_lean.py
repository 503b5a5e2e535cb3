"""A dataset of targets alone teaches what a whole one teaches, from a fraction of the pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.command import run
from helpers.dataset_builds import VIEWS, build

from spackle.paper.dataset import DatasetFiles, sample
from spackle.paper.dataset.encoding import decode_mask
from spackle.paper.dataset.sample import DatasetView
from spackle.paper.training.recipe import Recipe
from spackle.paper.training.residual import ResidualTask
from spackle.paper.training.samples import Sample
from spackle.runtime.errors import InputError


@pytest.fixture(scope="module")
def lean(place: Path) -> Path:
    """The dataset `whole`, of which only the targets are kept."""
    done = build(place, place / "lean", "--keep", "targets")
    assert done.code == 0, done.err
    return place / "lean"


def test_only_holes_are_stored(lean: Path, whole: Path) -> None:
    group = DatasetFiles(lean)[0]
    pictures = {f"{view:02d}.{kind}.png" for view in range(VIEWS) for kind in ("mask", "target")}
    names = {"json", "photo.png", "base.safetensors", *pictures}
    assert set(group.files) == {f"{group.key}.{name}" for name in names}
    assert DatasetFiles(lean).manifest.config["keep"] == "targets"

    def picture_bytes(folder: Path) -> int:
        """The size of the pictures of all views."""
        groups = map(DatasetFiles(folder).__getitem__, range(5))
        sizes = [(name, len(data)) for group in groups for name, data in group.files.items()]
        return sum(size for name, size in sizes if name.endswith(".png") and "photo" not in name)

    assert picture_bytes(lean) < 0.3 * picture_bytes(whole)


def test_each_view_has_the_bits_of_a_whole_dataset(lean: Path, whole: Path) -> None:
    for index in range(5):
        full_group = DatasetFiles(whole)[index]
        lean_group = DatasetFiles(lean)[index]
        assert full_group.has_renderings
        assert not lean_group.has_renderings
        for number in range(VIEWS):
            assert_same_view(lean_group.view(number), full_group.view(number))
    done = run("dataset", "preview", lean, "-o", lean.parent / "look", "--photos", 1)
    assert done.code == 0, done.err


def test_a_view_decodes_each_of_its_pictures_once(
    lean: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded: list[bytes] = []

    def counted(content: bytes) -> torch.Tensor:
        decoded.append(content)
        return decode_mask(content)

    monkeypatch.setattr(sample, "decode_mask", counted)
    DatasetFiles(lean)[0].view(1)
    assert len(decoded) == 1


def assert_same_view(one: DatasetView, other: DatasetView) -> None:
    assert torch.equal(one.camera.world_to_camera, other.camera.world_to_camera)
    pairs = [
        (one.photo, other.photo),
        (one.mask, other.mask),
        (one.target, other.target),
        *zip(one.rendering.tensors, other.rendering.tensors, strict=True),
    ]
    for mine, yours in pairs:
        assert torch.equal(mine, yours)


def task_of(dataset: Path, crops: int | None) -> ResidualTask:
    data = {"pseudo": dataset, "views": 12, "validation_views": 8, "crops": crops}
    recipe = Recipe.model_validate({"data": data, "loss": {"features": "none"}})
    return ResidualTask(recipe, torch.device("cpu"))


def assert_same_sample(one: Sample, other: Sample) -> None:
    names = ("rgb", "depth", "alpha", "mask", "initial")
    assert torch.equal(one.target, other.target)
    assert torch.equal(one.network_input(names), other.network_input(names))
    for mine, yours in zip(one.base.tensors, other.base.tensors, strict=True):
        assert torch.equal(mine, yours)


def test_training_reads_the_same_whole_views(lean: Path, whole: Path) -> None:
    from_lean = task_of(lean, crops=None).training
    from_whole = task_of(whole, crops=None).training
    assert len(from_lean) == len(from_whole) == 12
    for item in range(0, 12, 3):
        assert_same_sample(from_lean.load(item), from_whole.load(item))


def test_training_reads_the_same_views_for_crops(lean: Path, whole: Path) -> None:
    rng = np.random.default_rng(0)
    (from_lean,) = task_of(lean, crops=1).training_sources
    (from_whole,) = task_of(whole, crops=1).training_sources
    for number in range(3):
        assert_same_sample(from_lean.view(rng, number), from_whole.view(rng, number))


def test_a_target_of_another_size_than_its_view_is_an_error(lean: Path) -> None:
    group = DatasetFiles(lean)[0]
    with pytest.raises(InputError, match="view 1: cannot be read: the target has another size"):
        group.target(1, torch.zeros(3, 3, 3))


@pytest.mark.slow
def test_trained_weights_are_the_same_bytes(lean: Path, whole: Path, tmp_path: Path) -> None:
    options = "loss.features=none network=unet optim.steps=2 optim.batch=2 optim.precision=fp32 "
    options += "data.views=8 data.validation_views=4 run.device=cpu"
    weights = []
    for dataset in (lean, whole):
        output = tmp_path / dataset.name
        words = ["train", "--recipe", "paper", "-o", output, f"data.pseudo={dataset}"]
        done = run(*words, *options.split())
        assert done.code == 0, done.err
        weights.append((output / "last.safetensors").read_bytes())
    assert weights[0] == weights[1]
