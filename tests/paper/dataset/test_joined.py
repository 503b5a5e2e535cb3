"""Several datasets are one: parts that were built on several machines teach together."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.command import run
from helpers.dataset_builds import SHORT

from spackle.paper.dataset import DatasetFiles
from spackle.paper.dataset.joined import JoinedDataset
from spackle.paper.dataset.shards import load_manifest
from spackle.paper.training.recipe import Recipe
from spackle.paper.training.residual import ResidualTask
from spackle.runtime.errors import InputError

PHOTOS = {"part-a": ["0.png", "2.png", "3.png"], "part-b": ["4.png", "deep/1.png"]}


@pytest.fixture(scope="module")
def parts(place: Path) -> Path:
    """A folder with two datasets, each of its own list of photos."""
    folder = place / "parts"
    folder.mkdir()
    for name, photos in PHOTOS.items():
        photo_list = place / f"{name}.txt"
        photo_list.write_text("\n".join(photos))
        options = ["--images", place / "photos", "--depth", place / "depth", *SHORT]
        # Shards of another size and another seed do not keep parts from belonging together.
        if name == "part-b":
            options += ["--shard-size", 1, "--seed", 1]
        done = run("dataset", "build", photo_list, *options, "-o", folder / name)
        assert done.code == 0, done.err
    return folder


@pytest.fixture
def two(parts: Path, tmp_path: Path) -> Path:
    """A copy of the folder, in which tests may change datasets."""
    return shutil.copytree(parts, tmp_path / "parts")


def change_config(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Write a manifest with a changed configuration, as another build would have it."""
    manifest = load_manifest(folder)
    config = json.loads(json.dumps(manifest.config))
    change(config)
    manifest.model_copy(update={"config": config}).save(folder)


def test_joined_datasets_hold_the_photos_of_all(parts: Path) -> None:
    joined = JoinedDataset([str(parts / "part-*")])
    assert len(joined) == len(joined.samples) == 5
    read = {group.facts["photo"]["name"]: group for group in map(joined.__getitem__, range(5))}
    assert set(read) == {name for names in PHOTOS.values() for name in names}
    assert [sample.photo for sample in joined.samples] == list(read)
    for name, photos in PHOTOS.items():
        files = DatasetFiles(parts / name)
        for index, photo in enumerate(photos):
            assert read[photo].files == files[index].files
    # A report says which datasets they were, and how they were built.
    assert sorted(facts["photos"] for facts in joined.facts) == [2, 3]
    assert {facts["config"]["views"]["seed"] for facts in joined.facts} == {0, 1}


def test_order_and_digest_depend_on_contents_alone(parts: Path, two: Path) -> None:
    joined = JoinedDataset([str(parts / "part-a"), str(parts / "part-b")])
    (two / "part-a").rename(two / "z")
    moved = JoinedDataset([str(two / "part-b"), str(two / "z")])
    assert moved.digest == joined.digest
    assert [sample.sha256 for sample in moved.samples] == [s.sha256 for s in joined.samples]
    # Of a single dataset it is the dataset's own, so a run that began with it resumes.
    alone = JoinedDataset([str(two / "z")])
    assert alone.digest == load_manifest(two / "z").digest != joined.digest
    # An address keeps both of its slashes.
    assert JoinedDataset([f"file://{two / 'z'}"])[0].files == alone[0].files


def test_datasets_that_do_not_belong_together_are_named(two: Path) -> None:
    locations = [str(two / "part-a"), str(two / "part-b")]

    def refused(said: str) -> None:
        with pytest.raises(InputError, match=said):
            JoinedDataset(locations)

    change_config(two / "part-b", lambda config: config.update(spackle="0.0.1"))
    refused(r"part-b: was not built as .*part-a \(spackle: .* -> \"0\.0\.1\"\)")
    done = run("dataset", "verify", *locations)
    assert (done.code, "part-b: was not built as" in done.lines[-1]) == (1, True)
    version = load_manifest(two / "part-a").config["spackle"]
    change_config(two / "part-b", lambda config: config.update(spackle=version))
    assert "2 datasets make one of 5 photos" in run("dataset", "verify", *locations).lines[-1]

    change_config(two / "part-b", lambda config: config["inpainter"].update(version="0"))
    refused("inpainter.version")
    shutil.rmtree(two / "part-b")
    refused("part-b/manifest.json: no such file")
    locations[:] = [str(two / "set-*")]
    refused(r"set-\*: no dataset has such a name")
    # A copy, also one under another name, would be learned from and judged by.
    shutil.copytree(two / "part-a", two / "copy")
    change_config(two / "copy", lambda config: config.update(threads=7))
    locations[:] = [str(two / "part-a"), str(two / "copy")]
    refused(r"holds the photo 0\.png of .*, too: leave one")


@pytest.mark.parametrize("crops", [None, 1])
def test_training_knows_its_data_by_the_contents_of_all_datasets(
    parts: Path, two: Path, crops: int | None
) -> None:
    def task_of(*locations: Path | str) -> ResidualTask:
        data = {"pseudo": [*locations], "views": 12, "validation_views": 8, "crops": crops}
        recipe = {"data": data, "loss": {"features": "none"}}
        return ResidualTask(Recipe.model_validate(recipe), torch.device("cpu"))

    # A run resumes with data of the same digest: a pattern, or the datasets in another order and
    # at another place, but not with fewer of them.
    task = task_of(f"{parts}/part-*")
    assert task_of(two / "part-b", two / "part-a").digest == task.digest
    assert task_of(two / "part-a").digest != task.digest
    expected = {load_manifest(parts / name).digest for name in PHOTOS}
    assert {facts["sha256"] for facts in task.datasets} == expected
    if crops is None:
        assert len(task.training) + len(task.validation) == 20  # four views of five photos
