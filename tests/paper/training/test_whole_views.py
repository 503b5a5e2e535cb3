"""Training on whole views: the recipe `paper` trains what `spackle evaluate` measures."""

from __future__ import annotations

import json
import math
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.command import Run, names_in, refuses, run
from helpers.dataset_builds import build, write_inputs
from helpers.holes import random_network
from helpers.photos import metres, picture, write_depth
from helpers.systems import needs_posix_signals
from helpers.training_runs import (
    assert_same_weights,
    killed_at,
    one_thread,
    run_two,
    started,
    state,
)
from PIL import Image
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.open import open_base
from spackle.bases.settings import BaseSettings
from spackle.core.photo import load_photo
from spackle.paper.dataset import DatasetFiles
from spackle.paper.dataset.encoding import decode_gaussians, encode_gaussians
from spackle.paper.evaluation.methods import make_method
from spackle.paper.training.recipe import Recipe
from spackle.paper.training.residual import ResidualTask, complete_samples
from spackle.residual import MIN_AUX_GAUSSIANS, completion, hole_mask
from spackle.residual.architectures import ARCHITECTURES
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext

__all__ = ["one_thread"]  # a fixture

RECIPE = """
data: {pseudo: %s, views: 8, validation_views: 4, crops: null}
network: unet
loss: {features: none}
optim: {steps: 4, batch: 2, warmup: 2, lr: 1.0e-3, ema: 0.9, precision: fp32}
run: {validate_every: 4, save_every: 2, log_every: 1}
"""
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photos of two sizes, a dataset of four views of each, and a recipe."""
    place = tmp_path_factory.mktemp("whole")
    write_inputs(place, count=2)
    tall = picture(48, 80)  # all photos are smaller than a crop of the other recipes
    Image.fromarray(np.ascontiguousarray(tall)).save(place / "photos" / "tall.png")
    write_depth(place / "depth" / "tall.npy", metres(48, 80))
    done = build(place, place / "pseudo")
    assert done.code == 0, done.err
    (place / "recipe.yaml").write_text(RECIPE % (place / "pseudo"))
    return place


def open_task(place: Path, network: str = "unet", **more: Any) -> ResidualTask:
    recipe = Recipe.model_validate(
        {
            "data": {"pseudo": place / "pseudo", "views": 8, "validation_views": 4, "crops": None},
            "network": network,
            "loss": {"features": "none"},
            "optim": {"precision": "fp32"},
            **more,
        }
    )
    return ResidualTask(recipe, CPU)


def arguments(place: Path, output: Path, *more: str) -> list[str]:
    return ["train", "--recipe", f"{place}/recipe.yaml", "-o", str(output), *more]


def train(place: Path, output: Path, *more: str) -> Run:
    return run(*arguments(place, output, *more))


def evaluated_photo(place: Path, name: str) -> BasePrediction:
    """The base's prediction for a photo, as `spackle evaluate` makes it, with the precision of a
    dataset.
    """
    base = open_base(BaseSettings(name="rgbd", depth=place / "depth" / Path(name).parent))
    prediction, _ = base.predict(load_photo(place / "photos" / name))
    stored = decode_gaussians(encode_gaussians(prediction.gaussians))
    return BasePrediction(stored, prediction.camera, {}, photo=prediction.photo)


@pytest.mark.parametrize("name", list(ARCHITECTURES))
def test_training_gives_the_network_what_evaluation_gives_it(
    name: str, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = open_task(place, name)
    network = random_network(name=name)
    files = DatasetFiles(place / "pseudo")
    inputs: list[tuple[Tensor, Tensor]] = []
    predict = completion.predict_deltas

    def noted(network: Any, features: Tensor, cells: Tensor, precision: Any) -> Tensor:
        inputs.append((features, cells))
        return predict(network, features, cells, precision)

    monkeypatch.setattr(completion, "predict_deltas", noted)
    sizes, few_holes, all_holes = set(), 0, 0
    for source in (task.training, task.validation):
        for item, (photo, number) in enumerate(source.views):
            sample = source.load(item)
            prediction = evaluated_photo(place, files.samples[photo][1].photo)
            camera = files[photo].view(number).camera
            context = FillContext.of(prediction, task.renderer, network, precision="fp32")
            rendering = task.renderer.render(context.base, camera)
            filled = make_method("paper", [camera], context)(camera, rendering)

            # The photo, the cells and the network's inputs, array by array.
            features, cells = inputs.pop()
            assert torch.equal(sample.view._get_photo(), prediction.photo)
            assert torch.equal(sample.view.chosen_cells("masked"), cells)
            assert torch.equal(sample.network_input(network.inputs), features)
            # So the pictures are equal, too. Evaluation runs the U-Net on parts of a view, which
            # gives nearly the same Gaussians.
            views = complete_samples(network, network.inputs, [sample], task.renderer)
            difference = (views.rgb[0] - filled.rgb).detach().abs()
            assert float(difference.max()) < (0.02 if network.local else 1e-4)
            assert float(difference.mean()) < (1e-4 if network.local else 1e-6)
            assert int(cells.sum()) >= MIN_AUX_GAUSSIANS
            sizes.add(tuple(cells.shape))
            hole = hole_mask(rendering.alpha)
            few_holes += int(hole[::2, ::2].sum()) < MIN_AUX_GAUSSIANS
            all_holes += int(hole.sum()) > 0
    assert sizes == {(27, 36), (40, 24)}
    assert few_holes >= 3  # each photo's own view
    assert all_holes >= 6


def test_all_views_are_items_and_nothing_is_written_for_them(place: Path, tmp_path: Path) -> None:
    done = train(place, tmp_path / "out")
    assert done.code == 0, done.err
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert report["samples"]["kind"] == "whole views"
    assert (report["samples"]["train"], report["samples"]["validation"]) == (8, 4)
    assert 5 < report["hole_psnr"]["untrained"] < report["hole_psnr"]["colours of the targets"]
    assert math.isfinite(report["history"][0]["hole_psnr"])
    assert not names_in(tmp_path / "out") & {"cache"}
    # Views of the photo's own camera have no hole, and no PSNR.
    task = open_task(place)
    assert {view for _, view in task.training.views} == {0, 1, 2, 3}


@pytest.mark.parametrize("name", list(ARCHITECTURES))
def test_a_view_without_holes_teaches_by_its_64_least_opaque_cells(name: str, place: Path) -> None:
    task = open_task(place, name)
    own_view = next(k for k, (_, view) in enumerate(task.training.views) if view == 0)
    batch = task.load_batch(0, [own_view])
    assert not batch[0].hole.any()
    assert int(batch[0].view.chosen_cells("masked").sum()) == MIN_AUX_GAUSSIANS
    network = random_network(name=name)
    loss, terms = task.loss(network, batch)
    loss.backward()
    assert float(terms["preserve"]) > 0
    assert all(weight.grad is not None for weight in network.parameters())
    assert any(bool(weight.grad.any()) for weight in network.parameters())


def test_inputs_that_the_papers_network_does_not_name_are_not_computed(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []
    for name in ("match_patches", "trace_epipolar_lines"):
        monkeypatch.setattr(
            f"spackle.scene_fill.view_completion.{name}", lambda *_, name=name: calls.append(name)
        )
    task = open_task(place, "sharp-decoder")
    for item in range(4):
        task.loss(task.network, task.load_batch(0, [item]))
    assert not calls


def test_all_cells_get_gaussians_in_training_but_only_masked_ones_are_validated(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    masked, dense = open_task(place), open_task(place, cells="all")
    wide = max(range(len(dense.training)), key=lambda k: float(dense.training.load(k).hole.sum()))
    counts: list[int] = []
    render = dense.renderer.render_batch

    def noted(scenes: Any, cameras: Any, **more: Any) -> Any:
        counts.append(len(scenes[0][1]))  # aux Gaussians; the first set is the base
        return render(scenes, cameras, **more)

    for task in (masked, dense):
        monkeypatch.setattr(task.renderer, "render_batch", noted)
    network = random_network()
    batch = dense.load_batch(0, [wide])
    losses = [float(task.loss(network, batch)[0].detach()) for task in (masked, dense)]
    with torch.no_grad():
        measures = [task.measure(network, batch) for task in (masked, dense)]
    chosen = int(batch[0].view.cells().sum())
    assert counts == [chosen, batch[0].features.mask.numel(), chosen, chosen]
    assert losses[0] != losses[1]
    assert measures[0] == measures[1]
    with pytest.raises(InputError, match="cells=all: needs whole views"):
        ResidualTask(
            Recipe.model_validate(
                {
                    "cells": "all",
                    "data": {"pseudo": place / "pseudo"},
                    "loss": {"features": "none"},
                }
            ),
            CPU,
        )


@needs_posix_signals
@pytest.mark.slow  # test_training.py does the same with crops
def test_a_killed_run_resumes_with_the_same_result(place: Path, tmp_path: Path) -> None:
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert train(place, whole).code == 0
    killed = started(arguments(place, out), killed_at(3))
    killed.communicate()
    assert killed.returncode == -signal.SIGKILL
    assert state(out).progress.step == 2
    assert train(place, out).code == 0
    assert_same_weights(out, whole)
    assert (out / "best.safetensors").read_bytes() == (whole / "best.safetensors").read_bytes()


@pytest.mark.slow  # test_training.py does the same with crops
def test_two_processes_give_the_result_of_one(place: Path, tmp_path: Path) -> None:
    # Each process accumulates two views of different sizes and holes at each step.
    options = ["optim.steps=3", "optim.batch=4", "run.validate_every=3"]
    run_two(arguments(place, tmp_path / "two", *options))
    assert train(place, tmp_path / "one", *options).code == 0
    assert_same_weights(tmp_path / "two", tmp_path / "one", 1e-5)


def test_whole_views_of_other_data_are_refused(place: Path, tmp_path: Path) -> None:
    said = "data.crops=null: whole views come from data.pseudo alone"
    refuses(train(place, tmp_path / "out", f"data.photos={place}/photos"), said)
    refuses(train(place, tmp_path / "out", "data.pseudo=null"), said)


def test_a_damaged_photo_ends_the_run_with_its_name(place: Path, tmp_path: Path) -> None:
    copy = shutil.copytree(place / "pseudo", tmp_path / "pseudo")
    shard = copy / "shard-000000.tar"
    data = bytearray(shard.read_bytes())
    data[len(data) // 4] ^= 255
    shard.write_bytes(data)
    done = train(place, tmp_path / "out", f"data.pseudo={copy}", "data.validation_views=1")
    assert (done.code, "sample 000000 (0.png) is damaged" in done.lines[-1]) == (2, True), done.err
