"""The naive decoupled baseline, which trains SHARP's decoder."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from pathlib import Path

import pytest
import torch
from helpers.command import Run, refuses, report_of, run
from helpers.photos import picture, read_ply, write_photo
from helpers.training_runs import losses_of, one_thread, run_two, state
from PIL import Image
from random_weights import deterministic_weights
from safetensors.torch import save_file
from torch import Tensor

from spackle.bases.sharp.base import expected_shapes
from spackle.bases.sharp.encoder import MICRO_SIZE
from spackle.paper.dataset import DatasetFiles
from spackle.paper.dataset.shards import load_manifest
from spackle.paper.training.direct_ft import (
    VIEWS_PER_PHOTO,
    DirectFt,
    TunableSharp,
    draw_view_numbers,
    render_views_of_photo,
    target_of,
)
from spackle.paper.training.recipe import Recipe, load_recipe
from spackle.render import get_renderer
from spackle.runtime.digests import DIGEST_KEY

__all__ = ["one_thread"]  # a fixture

CPU = torch.device("cpu")
PARTS = ("feature_model.", "prediction_head.")  # of SHARP, which direct-ft trains
WIDTH, HEIGHT, VIEWS = 64, 48, 5
RECIPE = """
data: {pseudo: %s, validation_views: 5}
loss: {features: none}
optim: {steps: 4, batch: 4, warmup: 0, lr: 1.0e-3, ema: 0.5, precision: fp32}
run: {validate_every: 4, save_every: 2, log_every: 1}
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of SHARP, a dataset built with these weights, and a recipe."""
    place = tmp_path_factory.mktemp("direct")
    weights = deterministic_weights(expected_shapes(MICRO_SIZE))
    weights["prediction_head.texture_prediction_head.bias"][-2:] = (
        6.0  # opaque: the photo's own view has no holes
    )
    save_file(weights, place / "sharp.safetensors")
    (place / "photos").mkdir()
    for number, pixels in enumerate((picture(), picture()[::-1], picture() // 2)):
        Image.fromarray(pixels).save(place / "photos" / f"{number}.png")
    words = (
        place / "photos",
        "-o",
        place / "data",
        "--base",
        "sharp",
        "-c",
        place / "sharp.safetensors",
    )
    options = f"--views {VIEWS} --threads 1 --trajectory swipe --disparity 0.4 0.4 --precision fp32"
    done = run("dataset", "build", *words, *options.split())
    assert done.code == 0, done.err
    (place / "recipe.yaml").write_text(RECIPE % (place / "data"))
    return place


@pytest.fixture(scope="module")
def whole(place: Path) -> Path:
    """The folder of an uninterrupted run of four steps."""
    done = train(place, place / "whole")
    assert done.code == 0, done.err
    return place / "whole"


def arguments(place: Path, output: Path, *more: object) -> list[str]:
    words = (
        "--recipe",
        place / "recipe.yaml",
        "-o",
        output,
        "-c",
        place / "sharp.safetensors",
        *more,
    )
    return ["train", "--method", "direct-ft", *map(str, words)]


def train(place: Path, output: Path, *more: object) -> Run:
    return run(*arguments(place, output, *more))


def weights_of(file: Path) -> dict[str, Tensor]:
    """The weights of the whole network, from a checkpoint or a trained decoder."""
    return TunableSharp.load(file, torch.float32, CPU).network.state_dict()


def test_untrained_views_equal_the_datasets_views(place: Path) -> None:
    base = TunableSharp.load(place / "sharp.safetensors", torch.float32, CPU)
    group = DatasetFiles(place / "data")[0]
    views = [group.view(index) for index in range(group.views)]
    holes = [float(view.mask.float().mean()) for view in views]
    assert holes[0] < 0.02 < min(holes[1:])
    with torch.no_grad():
        batch = render_views_of_photo(base.network.gaussian_decoder(), base, views, get_renderer())
    assert batch.rgb.shape == (VIEWS, HEIGHT, WIDTH, 3)
    # A dataset rounds Gaussians, and then its pictures to 8 bits.
    difference = (batch.rgb - batch.base_rgb).abs()
    assert float(difference.max()) < 2.5 / 510
    assert float(difference.mean()) < 0.5 / 510
    assert torch.equal(batch.alpha < 0.95, batch.hole)


def test_the_target_of_the_photos_own_view_is_the_photo(place: Path) -> None:
    base = TunableSharp.load(place / "sharp.safetensors", torch.float32, CPU)
    group = DatasetFiles(place / "data")[0]
    views = [group.view(index) for index in (0, 2, 4)]
    # The base with random weights does not show the photo.
    assert float((views[0].photo - views[0].target).abs().mean()) > 0.005
    with torch.no_grad():
        batch = render_views_of_photo(base.network.gaussian_decoder(), base, views, get_renderer())
    assert torch.equal(batch.target[0], views[0].photo)
    assert torch.equal(batch.target[1:], torch.stack([view.target for view in views[1:]]))
    assert bool(batch.supervised[0].all())
    assert torch.equal(batch.supervised[1:], batch.hole[1:])

    # A photo of odd size is stretched to its view, which has even sides.
    odd = dataclasses.replace(views[0], photo=views[0].photo[1:, 1:])
    assert target_of(odd).shape == (HEIGHT, WIDTH, 3)
    assert float((target_of(odd)[1:, 1:] - odd.photo).abs().mean()) < 0.05


def test_without_preservation_the_photo_and_the_holes_alone_teach(place: Path) -> None:
    recipe = load_recipe(Recipe, place / "recipe.yaml", ["loss.preserve=0", "loss.alpha=0"])
    task = DirectFt(recipe, CPU, place / "sharp.safetensors")
    task.base = TunableSharp.load(place / "sharp.safetensors", torch.float32, CPU)
    decoder = task.base.network.gaussian_decoder()
    batch = task.load_batch(0, [0])
    assert batch[0].index == 0
    with torch.no_grad():
        views = task.complete(decoder, batch)
        loss, terms = task.loss(decoder, batch)

    # Mean absolute differences: from the photo everywhere, from other targets in the hole.
    differences = [float((views.rgb[0] - batch[0].photo).abs().mean())]
    for rgb, view in zip(views.rgb[1:], batch[1:], strict=True):
        differences.append(float((rgb - view.target).abs()[view.mask].mean()))
    assert float(terms["color"]) == pytest.approx(sum(differences) / len(batch), rel=1e-5)
    assert float(loss) == pytest.approx(10 * float(terms["color"]), rel=1e-6)
    assert float(terms["preserve"]) > 0  # is reported, but does not count


def test_the_loss_falls_and_only_the_decoder_changes(place: Path, tmp_path: Path) -> None:
    options = ("data.views=1", "optim.steps=6", "optim.lr=2e-3", "optim.min_lr=2e-3", "optim.ema=0")
    losses = losses_of(train(place, tmp_path / "out", *options))
    assert sum(losses[-2:]) < 0.7 * sum(losses[:2])
    before, unused = (
        weights_of(place / "sharp.safetensors"),
        "feature_model.decoder.fusions.4.resnet1.",
    )
    for name, tensor in weights_of(tmp_path / "out" / "last.safetensors").items():
        stays = not name.startswith(PARTS) or name.startswith(unused)
        assert torch.equal(tensor, before[name]) == stays, name
    assert sum(not name.startswith(PARTS) for name in before) > 100


def test_results_of_a_run(place: Path, whole: Path, tmp_path: Path) -> None:
    report = json.loads((whole / "run.json").read_text())
    assert (report["method"], report["ended"], report["step"]) == ("direct-ft", "steps", 4)
    assert (
        report["checkpoint"]["sha256"]
        == hashlib.sha256((place / "sharp.safetensors").read_bytes()).hexdigest()
    )
    assert report["history"][0].keys() >= {
        "loss",
        "color",
        "preserve",
        "hole_psnr",
        "seen_psnr",
        "har_after",
    }
    with Image.open(whole / "pictures" / "0000004.png") as sheet:
        assert sheet.size == (3 * WIDTH, HEIGHT)
    write_photo(tmp_path / "photo.png")
    options = (
        tmp_path / "photo.png",
        "--base",
        "sharp",
        "--no-render",
        "--residual",
        "none",
        "--focal-px",
        60,
    )
    done = run("predict", *options, "-o", tmp_path, "-c", whole / "best.safetensors")
    assert done.code == 0, done.err
    assert report_of(tmp_path / "photo")["base"]["weights"] == "best.safetensors"
    assert read_ply(tmp_path / "photo" / "scene.ply").count > 0


@pytest.mark.slow
def test_two_processes_compute_the_gradient_of_one(place: Path, tmp_path: Path) -> None:
    options = ["optim.steps=1", "optim.batch=16", "run.validate_every=1"]
    run_two(arguments(place, tmp_path / "two", *options))
    assert train(place, tmp_path / "one", *options).code == 0
    one, two = (state(tmp_path / name).optimizer["state"] for name in ("one", "two"))
    assert one.keys() == two.keys()
    # Weights cannot be compared: the optimiser's first step amplifies a gradient's noise.
    mine, yours = (
        torch.cat([part["exp_avg"].flatten() for part in found.values()]) for found in (one, two)
    )
    assert float((mine - yours).norm()) < 1e-3 * float(mine.norm())


def test_views_of_a_step_and_division_of_photos(place: Path) -> None:
    drawn = [draw_view_numbers([0, step], VIEWS) for step in range(20)]
    assert all(views[0] == 0 and len(set(views)) == VIEWS_PER_PHOTO for views in drawn)
    assert {view for views in drawn for view in views} == set(range(VIEWS))
    assert draw_view_numbers([0, 0], 2) == [0, 1]
    recipe = load_recipe(Recipe, place / "recipe.yaml", ["data.validation_views=1"])
    task = DirectFt(recipe, CPU, place / "sharp.safetensors")
    assert sorted([*task.training_photos, *task.validation_photos]) == [0, 1, 2]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["data.pseudo=null"], "--method direct-ft learns only from data.pseudo"),
        (["data.photos={place}/photos"], "leave out init and other data"),
        (["data.pseudo={place}/rgbd"], "rgbd: built with the base rgbd"),
        (
            ["data.pseudo={place}/geometry"],
            "built with --inpainter geometry, whose targets teach nothing",
        ),
        (["-c", "{place}/other.safetensors"], "other.safetensors"),
        (
            ["-c", "{place}/whole/best.safetensors"],
            "best.safetensors: holds an already trained decoder",
        ),
        (["optim.batch=6"], "optim.batch=6: give a multiple of 4 views"),
        (["init=weights.safetensors"], "leave out init and other data"),
        (["--method", "residual"], "sharp.safetensors: --method residual learns without a base"),
    ],
)
def test_unusable_input_is_refused(
    place: Path, whole: Path, tmp_path: Path, options: list[str], said: str
) -> None:
    for key, name in (("base", "rgbd"), ("inpainter", "geometry")):
        if f"{{place}}/{name}" in str(options):
            manifest = load_manifest(shutil.copytree(place / "data", place / name))
            manifest.model_copy(update={"config": {**manifest.config, key: {"name": name}}}).save(
                place / name
            )
    if "{place}/other.safetensors" in options:
        save_file(deterministic_weights(expected_shapes(MICRO_SIZE)), place / "other.safetensors")
    done = train(place, tmp_path / "out", *(option.format(place=place) for option in options))
    assert (done.code, said in done.lines[-1]) == (2, True), done.err
    assert not (tmp_path / "out").exists()


def test_the_default_checkpoint_is_the_downloaded_one(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    words = (
        "train",
        "--method",
        "direct-ft",
        "--recipe",
        place / "recipe.yaml",
        "-o",
        tmp_path / "out",
    )
    refuses(run(*words), "spackle weights get sharp")
    (tmp_path / "weights").mkdir()
    shutil.copy(place / "sharp.safetensors", tmp_path / "weights" / "sharp_2572gikvuh.pt")
    assert run(*words, "optim.steps=1").code == 0


def test_a_folder_with_another_network_is_refused(place: Path, whole: Path, tmp_path: Path) -> None:
    out = shutil.copytree(whole, tmp_path / "out")
    saved = torch.load(out / "checkpoint.pt", weights_only=True)
    name = "prediction_head.geometry_prediction_head.weight"
    saved["network"][name] = saved["network"][name][:2].clone()
    del saved[DIGEST_KEY]  # of the weights as they were
    torch.save(saved, out / "checkpoint.pt")
    done = train(place, out, "optim.steps=5")
    assert (done.code, "the checkpoint has another network " in done.err, name in done.err) == (
        2,
        True,
        True,
    )
