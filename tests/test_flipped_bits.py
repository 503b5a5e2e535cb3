"""One flipped bit in any file that a later run trusts: it is refused in one line, or redone."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.scenes import random_scene, tensors_of, turned_camera
from helpers.training_runs import state
from safetensors.torch import load_file, save

from spackle.bases import BasePrediction
from spackle.paper.dataset.inspect import find_problems
from spackle.paper.dataset.shards import (
    MANIFEST_NAME,
    PARTS_FOLDER,
    Manifest,
    load_manifest,
    read_part,
)
from spackle.paper.evaluation.folder import _load_image_results
from spackle.paper.evaluation.measurements import image_measurement
from spackle.paper.training import sample_factory, samples
from spackle.paper.training.checkpoint import (
    CHECKPOINT_FILE,
    Checkpoint,
    TrainingProgress,
    load_checkpoint,
    save_checkpoint,
)
from spackle.paper.training.samples import Sample, load_sample, save_sample
from spackle.posed.kept_predictions import KeptPredictions
from spackle.render import CpuRenderer
from spackle.runtime.digests import sealed, signed, unsealed
from spackle.runtime.errors import InputError
from spackle.runtime.tensor_digests import tree_digest

FLIPS = 40  # of each file, at random places; one alone may hit a byte without meaning
CAMERA = turned_camera(64, 48, 60.0)


def flips(path: Path) -> list[bytes]:
    """The file's content, each time with another bit flipped: anywhere, and at its beginning."""
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    places = [int(place) for place in rng.integers(0, 8 * len(content), FLIPS)]
    # The heads of files are short, but say what all else means.
    places += [int(place) for place in rng.integers(0, 8 * min(256, len(content)), FLIPS)]
    damaged = []
    for place in places:
        changed = bytearray(content)
        changed[place // 8] ^= 1 << (place % 8)
        damaged.append(bytes(changed))
    return damaged


def a_checkpoint() -> Checkpoint:
    layer = torch.nn.Linear(40, 30)
    optimizer = torch.optim.AdamW(layer.parameters())
    layer(torch.rand(2, 40)).sum().backward()
    optimizer.step()
    return Checkpoint(
        progress=TrainingProgress(step=7, history=[{"step": 7, "loss": 0.25}]),
        network=layer.state_dict(),
        average=layer.state_dict(),
        optimizer=optimizer.state_dict(),
        recipe={"optim": {"lr": 1e-4}},
        digest="abc",
    )


def a_sample() -> Sample:
    scene = random_scene(3, 300, CAMERA, solidity=0.5)
    rendering = CpuRenderer().render(scene, CAMERA)
    photo = torch.rand(48, 64, 3)
    whole = Sample.of(scene, rendering, CAMERA, turned_camera(64, 48, 60.0), photo, photo)
    return whole.crop(4, 4, 16, 16)


def checkpoint(folder: Path) -> tuple[Path, Callable[[], Any]]:
    save_checkpoint(a_checkpoint(), folder)
    return folder / CHECKPOINT_FILE, lambda: vars(state(folder)) | {"progress": None}


def sample(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path = folder / "000000-0.safetensors"
    save_sample(a_sample(), path)

    def read() -> Any:
        found = load_sample(path)
        return [found.target, *found.base.tensors, *tensors_of(found.rendering)]

    return path, read


def crop_count(folder: Path) -> tuple[Path, Callable[[], Any]]:
    for number in range(2):
        (folder / f"000000-{number}.safetensors").touch()
    path = folder / "000000.done"
    path.write_bytes(sealed(b"2\n"))
    return (
        path,
        lambda: (
            None
            if (files := sample_factory._crop_files(folder, 0)) is None
            else [file.name for file in files]
        ),
    )


def dataset_part(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path = folder / "a.tar"
    path.write_bytes(sealed(np.random.default_rng(0).bytes(5000)))
    return path, lambda: read_part(path)


def kept_prediction(folder: Path) -> tuple[Path, Callable[[], Any]]:
    kept = KeptPredictions(folder)
    prediction = BasePrediction(
        random_scene(1, 50, CAMERA), CAMERA, notes={}, max_disparity=0.5, is_metric=True
    )
    kept.save("a", prediction, "lite")

    def read() -> Any:
        found = kept.load("a")
        if found is None:
            return None
        facts = [found[0].max_disparity, found[0].is_metric, found[0].camera.width, found[1]]
        return [*facts, *found[0].gaussians.tensors, found[0].camera.K]

    return folder / "a.safetensors", read


def image_numbers(folder: Path) -> tuple[Path, Callable[[], Any]]:
    path = folder / "00000-a.json"
    rows = [image_measurement("data", "a", f"metric {k}", 0.125 * k) for k in range(20)]
    content: dict[str, Any] = {"inputs": "digest", "files": {}, "rows": rows}
    path.write_text(json.dumps(signed(content)) + "\n")

    def read() -> Any:
        found = _load_image_results(path, "digest")
        return None if found is None else [list(row) for row in found]

    return path, read


KINDS = [checkpoint, sample, crop_count, dataset_part, kept_prediction, image_numbers]


@pytest.mark.parametrize("kind", KINDS)
def test_a_flipped_bit_is_refused_or_redone(
    tmp_path: Path, kind: Callable[[Path], tuple[Path, Callable[[], Any]]]
) -> None:
    path, read = kind(tmp_path)
    whole = tree_digest(read())
    refusals: list[str] = []
    redone = 0
    for damaged in flips(path):
        path.write_bytes(damaged)
        try:
            found = read()
        except InputError as error:
            refusals.append(str(error))
            continue
        # What is None is made anew; else the bit had no meaning, such as the date in an archive.
        redone += found is None
        assert found is None or tree_digest(found) == whole
    assert all(path.name in line and "\n" not in line for line in refusals)
    assert redone + len(refusals) > FLIPS


def test_files_of_older_versions_without_a_digest_are_still_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    checkpoint(tmp_path)
    content = torch.load(tmp_path / CHECKPOINT_FILE, weights_only=True)
    del content["sha256"]
    torch.save(content, tmp_path / CHECKPOINT_FILE)
    lines: list[str] = []
    loaded = load_checkpoint(tmp_path, lines.append)
    assert loaded is not None
    assert loaded.progress.step == 7
    assert [line.split(": ")[1].split(",")[0] for line in lines] == ["of an older version"]

    with monkeypatch.context() as patch:
        patch.setattr(samples, "signed_tensors", save)
        path, _ = sample(tmp_path)
    assert torch.equal(load_sample(path).target, a_sample_target(path))
    sample_factory._warn_of_old_files(tmp_path, lines.append)
    assert "samples of an older version" in lines[-1]
    sample(tmp_path)
    sample_factory._warn_of_old_files(tmp_path, lines.append)
    assert len(lines) == 2

    (tmp_path / "000000.done").write_text("1\n")
    assert sample_factory._crop_files(tmp_path, 0) == [tmp_path / "000000-0.safetensors"]
    assert unsealed(b"an old part\nof a dataset") == b"an old part\nof a dataset"


def a_sample_target(path: Path) -> torch.Tensor:
    """The target as the file's format rounds it."""
    return load_file(path)["target"].float() / 255


def test_verify_finds_a_flipped_bit_in_a_part_of_an_unfinished_dataset(tmp_path: Path) -> None:
    Manifest(config={}, shards=(), complete=False).save(tmp_path)
    assert (tmp_path / MANIFEST_NAME).is_file()
    part = tmp_path / PARTS_FOLDER / "a.tar"
    part.parent.mkdir()
    content = sealed(bytes(1000))
    part.write_bytes(content)

    def problems() -> list[str]:
        manifest = load_manifest(tmp_path)
        return list(find_problems(tmp_path, manifest, lambda done, total: None))

    assert problems() == ["the dataset is not finished: run the same `spackle dataset build` again"]
    part.write_bytes(content[:-1] + b"\1")
    assert len(problems()) == 2
    assert problems()[1].startswith(f"{part}: damaged: its digest is another one: delete this file")
