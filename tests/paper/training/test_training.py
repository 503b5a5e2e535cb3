"""Training runs of the residual network."""

from __future__ import annotations

import importlib.util
import json
import math
import shutil
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.command import Run, names_in, refuses, run
from helpers.holes import random_network
from helpers.photos import picture
from helpers.scenes import box_before_wall, shifted, tensors_of
from helpers.systems import needs_posix_signals
from helpers.training_runs import (
    assert_same_weights,
    killed_at,
    losses_of,
    one_thread,
    run_two,
    started,
    state,
)
from PIL import Image

from spackle.core.gaussians import Gaussians
from spackle.paper.training import train as training
from spackle.paper.training.losses import total_loss
from spackle.paper.training.recipe import LossRecipe, OptimRecipe
from spackle.paper.training.residual import complete_samples
from spackle.paper.training.samples import Sample, load_sample, save_sample
from spackle.paper.training.schedule import prefetch
from spackle.render import get_renderer
from spackle.residual.architectures import load_residual
from spackle.runtime.folders import file_lock

__all__ = ["one_thread"]  # a fixture

RECIPE = """
data: {photos: %s, views: 5, validation_views: 2, crops: 2, cells: 16}
loss: {features: none}
optim: {steps: 6, batch: 2, warmup: 2, lr: 1.0e-3, ema: 0.9, precision: fp32}
run: {validate_every: 6, save_every: 3, log_every: 1}
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recipe, photos and, after the first run, samples."""
    place = tmp_path_factory.mktemp("training")
    (place / "photos").mkdir()
    for number in range(3):
        Image.fromarray(np.rot90(picture(400, 360), number)).save(
            place / "photos" / f"{number}.png"
        )
    (place / "photos" / "broken.jpg").write_bytes(b"\xff\xd8 no more")
    (place / "recipe.yaml").write_text(RECIPE % (place / "photos"))
    return place


@pytest.fixture(scope="module")
def done(place: Path) -> Run:
    return train(place, place / "whole")


@pytest.fixture(scope="module")
def whole(place: Path, done: Run) -> Path:
    """The folder of an uninterrupted run of six steps."""
    assert done.code == 0, done.err
    return place / "whole"


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    """A copy of the folder `whole`."""
    return shutil.copytree(whole, tmp_path / "out")


def arguments(place: Path, output: Path, *more: str) -> list[str]:
    return [
        "train",
        "--recipe",
        f"{place}/recipe.yaml",
        "-o",
        str(output),
        f"data.cache={place}/cache",
        *more,
    ]


def train(place: Path, output: Path, *more: str) -> Run:
    return run(*arguments(place, output, *more))


def test_results_of_a_run(whole: Path, done: Run) -> None:
    assert names_in(whole) >= {
        "checkpoint.pt",
        "best.safetensors",
        "last.safetensors",
        "run.json",
        "pictures",
    }
    report = json.loads((whole / "run.json").read_text())
    assert (report["ended"], report["step"]) == ("steps", 6)
    assert report["history"][0].keys() >= {
        "loss",
        "color",
        "alpha",
        "preserve",
        "hole_psnr",
        "har_before",
        "har_after",
    }
    with Image.open(whole / "pictures" / "0000006.png") as sheet:
        assert sheet.width == 3 * 32
    average = state(whole).average
    for name in ("best", "last"):
        weights = load_residual(whole / f"{name}.safetensors").state_dict()
        assert all(torch.equal(weights[key], average[key].half().float()) for key in average)
    assert sum("broken.jpg" in line for line in done.lines) == 1
    if importlib.util.find_spec("tensorboard"):
        (events,) = (whole / "logs").iterdir()
        assert all(
            name in events.read_bytes()
            for name in (b"train/color", b"train/lr", b"validation/har_after")
        )


def test_the_papers_network_starts_from_sharp_and_predicts(
    place: Path, made: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    done = train(place, out, "network=sharp-decoder", f"init={made['sharp']}", "optim.steps=2")
    assert done.code == 0, done.err
    network = load_residual(out / "best.safetensors")
    assert network.name == "sharp-decoder"
    assert all(bool(head.weight.any()) for head in (network.geometry, network.texture))
    Image.open(place / "photos" / "0.png").resize((96, 72)).save(tmp_path / "photo.png")
    Image.new("I;16", (96, 72), 2000).save(tmp_path / "photo.depth.png")
    predict = (
        "predict",
        f"{tmp_path}/photo.png",
        "--depth",
        f"{tmp_path}/photo.depth.png",
        "-o",
        f"{tmp_path}/scene",
    )
    assert run(*predict, "--residual", f"{out}/best.safetensors").code == 0
    refuses(
        train(place, tmp_path / "other", f"init={out}/best.safetensors"),
        "set network=sharp-decoder",
    )


def test_a_run_resumes_after_ctrl_c_with_the_same_result(
    place: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, rate = tmp_path / "out", training.learning_rate

    def interrupted(step: int, optim: OptimRecipe) -> float:
        if step == 0:
            signal.raise_signal(signal.SIGINT)
        return rate(step, optim)

    with monkeypatch.context() as patch:
        patch.setattr(training, "learning_rate", interrupted)
        assert train(place, out).code == 130
    assert (state(out).progress.step, json.loads((out / "run.json").read_text())["ended"]) == (
        2,
        "stopped",
    )
    assert train(place, out).code == 0
    assert_same_weights(out, whole)
    assert (out / "best.safetensors").read_bytes() == (whole / "best.safetensors").read_bytes()


def metrics_of(folder: Path) -> list[dict[str, float]]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def timeless(lines: list[dict[str, float]]) -> list[dict[str, float]]:
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def test_each_logged_step_is_a_line_of_json(place: Path, whole: Path, tmp_path: Path) -> None:
    lines = metrics_of(whole)
    assert [line["step"] for line in lines] == [1, 2, 3, 4, 5, 6]
    terms = {f"train/{name}" for name in ("loss", "color", "alpha", "preserve", "gradient", "lr")}
    assert all(line.keys() >= terms | {"seconds"} for line in lines)
    assert lines[1]["train/lr"] == 1e-3  # the end of the warm-up
    assert sorted(lines, key=lambda line: line["seconds"]) == lines

    # The last step is also that of the only validation, which run.json has, too.
    (measures,) = json.loads((whole / "run.json").read_text())["history"]
    validation = {name for name in lines[5] if name.startswith("validation/")}
    assert validation == {f"validation/{name}" for name in measures if name != "step"}
    assert all(lines[5][name] == measures[name.removeprefix("validation/")] for name in validation)
    assert not any(name.startswith("validation/") for line in lines[:5] for name in line)

    # With a longer interval a line has the means of its steps; a step of validation has a line.
    out = tmp_path / "out"
    assert train(place, out, "run.log_every=4", "run.validate_every=3").code == 0
    third, fourth, last = metrics_of(out)
    assert (third["step"], fourth["step"], last["step"]) == (3, 4, 6)
    assert not any(name.startswith("train/") for name in third)
    for name in terms:
        assert fourth[name] == pytest.approx(sum(line[name] for line in lines[:4]) / 4)
        assert last[name] == pytest.approx(sum(line[name] for line in lines[4:]) / 2)


@needs_posix_signals
def test_a_killed_run_resumes_its_lines(place: Path, whole: Path, tmp_path: Path) -> None:
    # It is killed after five steps; the last checkpoint is that of step 3, between two lines.
    options = ("run.log_every=2", "run.save_every=3")
    reference, out = tmp_path / "reference", tmp_path / "out"
    assert train(place, reference, *options).code == 0
    killed = started(arguments(place, out, *options), killed_at(5))
    killed.communicate()
    assert killed.returncode == -signal.SIGKILL
    assert [line["step"] for line in metrics_of(out)] == [2, 4]
    with open(out / "metrics.jsonl", "a") as file:
        file.write('{"step": 5, "secon')  # a line that was not written to its end
    assert train(place, out, *options).code == 0
    assert_same_weights(out, whole)
    assert timeless(metrics_of(out)) == timeless(metrics_of(reference))
    assert [line["step"] for line in metrics_of(out)] == [2, 4, 6]

    # A run that begins anew has no lines of the old one.
    assert train(place, out, "optim.steps=1", "--overwrite").code == 0
    assert [line["step"] for line in metrics_of(out)] == [1]
    (out / "metrics.jsonl").write_text("step,loss\n")
    done = train(place, out, "optim.steps=2")
    assert (done.code, "metrics.jsonl: not the metrics of a run" in done.lines[-1]) == (2, True)


def test_a_function_of_the_user_gets_the_lines(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_log.py").write_text(
        "lines = []\ndef log(step, values):\n    lines.append((step, dict(values)))\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    done = train(place, tmp_path / "out", "optim.steps=2", "--logger", "my_log:log")
    assert done.code == 0, done.err
    lines = sys.modules.pop("my_log").lines
    assert [{"step": step, **values} for step, values in lines] == timeless(
        metrics_of(tmp_path / "out")
    )
    refuses(train(place, tmp_path / "no", "--logger", "my_log:lgo"), "did you mean log?")
    refuses(train(place, tmp_path / "no", "--logger", "my_logs:log"), "did you mean my_log?")
    refuses(train(place, tmp_path / "no", "--logger", "my_log:lines"), "is no function")
    sys.modules.pop("my_log")


def test_a_folder_with_another_recipe_is_refused(place: Path, out: Path) -> None:
    with file_lock(out / ".lock"):
        assert "another run is at work" in train(place, out, "optim.steps=7").err
    refuses(train(place, out, "optim.lr=2e-3"), "holds a run with other settings (optim.lr)")
    half_picture = out / "pictures" / ".0000009.0123456789ab.png"  # of a run that was killed
    half_picture.touch()
    assert (
        train(place, out, "run.validate_every=2", "optim.steps=7").code,
        state(out).progress.step,
    ) == (0, 7)
    assert not half_picture.exists()
    done = train(place, out, "optim.lr=2e-3", "optim.steps=1", "--overwrite")
    assert (done.code, state(out).progress.step) == (0, 1)
    assert names_in(out / "pictures") == {"0000001.png"}
    (out / "checkpoint.pt").write_bytes((out / "checkpoint.pt").read_bytes()[:1000])
    refuses(train(place, out), "checkpoint.pt: cannot be read", "--overwrite starts a new run")


def test_a_run_without_improvement_ends(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    done = train(
        place, tmp_path / "out", "run.validate_every=1", "run.patience=2", "run.min_delta=100"
    )
    assert (done.code, "pip install 'spackle-nvs[train]'" in done.err) == (0, True), done.err
    report = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (report["ended"], report["best_step"], report["stale"]) == ("patience", 1, 2)


def test_two_processes_give_the_result_of_one(place: Path, tmp_path: Path) -> None:
    options = ["optim.steps=2", "optim.batch=4", "run.validate_every=2"]
    run_two(arguments(place, tmp_path / "two", *options))
    assert train(place, tmp_path / "one", *options).code == 0
    assert_same_weights(tmp_path / "two", tmp_path / "one", 1e-5)
    one, two = (state(tmp_path / name).progress.history[0] for name in ("one", "two"))
    assert two == pytest.approx(one, rel=1e-4)  # Gaussians of nearly equal depth may swap


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["data.photos=null"], "the recipe has no data"),
        (["data.photos=/nowhere"], "/nowhere: no such folder, but data.photos names it"),
        (["data.photos={broken}", "data.views=1"], "none of 2 views gave a sample"),
        (["data.stereo={empty}"], "contains no scene.json"),
        (
            ["loss.features=squeezenet", "loss.features_path=/no", "loss.feature_size=64"],
            "/no: no such weight",
        ),
        (["run.device=cuda"], "device 'cuda': torch finds no CUDA device"),
    ],
)
def test_unusable_input_is_refused(
    place: Path, tmp_path: Path, options: list[str], said: str
) -> None:
    if options == ["run.device=cuda"] and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    folders = {name: tmp_path / name for name in ("empty", "broken")}
    for folder in folders.values():
        folder.mkdir()
    shutil.copy(place / "photos" / "broken.jpg", folders["broken"])
    done = train(
        place,
        tmp_path / "out",
        *(each.format(**folders) for each in options),
        f"data.cache={tmp_path}/cache",
    )
    assert (done.code, said in done.lines[-1]) == (2, True), done.err
    assert not (tmp_path / "out" / "checkpoint.pt").exists()


def test_batches_of_several_threads_keep_their_order() -> None:
    def slow_if_early(number: int) -> int:
        time.sleep(0.01 * (3 - number % 4))  # of four batches, the first one takes longest
        return number

    assert list(prefetch(slow_if_early, range(12), 4)) == [*range(12)]


def test_a_gradient_that_is_not_finite_ends_the_run(
    place: Path, whole: Path, tmp_path: Path
) -> None:
    cache = shutil.copytree(place / "cache", tmp_path / "cache")
    for path in cache.glob("*/train/*.safetensors"):
        sample = load_sample(path)
        sample.initial.slope.fill_(math.nan)
        save_sample(sample, path)
    done = train(place, tmp_path / "out", f"data.cache={cache}")
    assert (done.code, "out: step 0: gradient not finite" in done.lines[-1]) == (2, True)
    assert not (tmp_path / "out" / "checkpoint.pt").exists()


@pytest.mark.parametrize("name", ["unet", "sharp-decoder"])
def test_gradients_reach_the_whole_network_but_not_the_base(name: str) -> None:
    scene = box_before_wall(width=96, height=80)
    base = Gaussians(*(t.clone().requires_grad_() for t in scene.base().tensors))
    view = shifted(scene.camera, 0.3)
    rendering = get_renderer().render(base, view)
    sample = Sample.of(
        base, rendering, view, scene.camera, scene.rgb, torch.full_like(rendering.rgb, 0.5).detach()
    )
    assert not any(tensor.requires_grad for tensor in tensors_of(sample))
    assert not any(tensor.requires_grad for tensor in tensors_of(sample.crop(2, 3, 24, 24)))
    network = random_network(name=name)
    views = complete_samples(network, network.inputs, [sample], get_renderer())
    assert torch.equal(views.supervised, views.hole)
    images = {name: image for name, image in vars(views).items() if name != "supervised"}
    loss, _ = total_loss(**images, recipe=LossRecipe())
    loss.backward()
    assert all(tensor.grad is None for tensor in base.tensors)
    assert all(p.grad is not None and bool(p.grad.any()) for p in network.parameters())


def test_the_loss_falls_on_samples_that_are_seen_again(place: Path, tmp_path: Path) -> None:
    options = (
        "data.views=2",
        "optim.steps=12",
        "optim.warmup=0",
        "optim.min_lr=1e-4",
        "optim.ema=0.5",
    )
    losses = losses_of(train(place, tmp_path / "out", *options))
    assert sum(losses[-3:]) < 0.7 * sum(losses[:3])
