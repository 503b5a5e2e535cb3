"""Recipes: what the files say, what is refused, and what a step does by them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from spackle.downloads import known_weights
from spackle.errors import InputError
from spackle.training.losses import PAPER_WEIGHTS
from spackle.training.recipe import OptimRecipe, Recipe, RgbdFolder, differences, load_recipe, plain
from spackle.training.trainer import ema_decay, learning_rate, samples_of_step

pytest.importorskip("yaml")
PLAIN = "loss: {features: none}"


def written(folder: Path, text: str = PLAIN) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", ["cpu", "direct_ft", "paper", "reverse_view"])
def test_every_packaged_recipe_can_be_read_and_all_but_the_small_machines_have_the_papers_weights(name: str) -> None:
    recipe = load_recipe(Recipe, name, ["loss.features_path=weights"])
    papers = {**PAPER_WEIGHTS, "color_blur": 0, "gram": 1}
    assert (vars(recipe.loss).items() >= papers.items()) == (name != "cpu")
    assert recipe.data.photos is not None or recipe.data.pseudo is not None
    assert recipe.loss.dilation == 21
    if name == "paper":
        optim, run = recipe.optim, recipe.run
        assert (optim.lr, optim.min_lr, optim.warmup) == (1.6e-4, 1.6e-5, 10_000)
        assert (run.patience, run.min_delta) == (10, 1e-4)
        assert (recipe.loss.features, recipe.loss.feature_size, recipe.data.views) == ("resnet50", 512, 20_000)


def test_resnet50_comes_from_the_folder_of_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    for override in ((), ("loss.features=squeezenet",)):
        with pytest.raises(InputError, match="spackle weights get features"):
            load_recipe(Recipe, "paper", override)
    fetched = tmp_path / known_weights("features").file
    fetched.touch()
    assert load_recipe(Recipe, "paper").loss.features_file == fetched


def test_a_recipe_is_what_its_file_says_and_then_what_the_command_says(tmp_path: Path) -> None:
    text = """
        data:
          photos: some/photos
          rgbd: [{folder: kitchen, focal_px: 585}]
          disparity: [0, 1e-1]
        loss: {features: none, feature_size: null}
        optim:
        init: weights.safetensors
    """
    overrides = ["optim.steps=1e3", "data.rgbd.0.focal_px=600", "optim.lr=2e-4", "init=null", "run.log_every=7"]
    recipe = load_recipe(Recipe, written(tmp_path, text), overrides)
    assert recipe.data.photos == Path("some/photos")
    assert recipe.data.rgbd == (RgbdFolder(Path("kitchen"), 600.0, 0.001),)
    assert recipe.data.disparity == (0.0, 0.1)
    assert recipe.loss.feature_size is None
    assert (recipe.optim.steps, recipe.optim.lr, recipe.optim.batch) == (1000, 2e-4, OptimRecipe().batch)
    assert isinstance(recipe.optim.steps, int)
    assert recipe.init is None
    assert recipe.run.log_every == 7


@pytest.mark.parametrize(
    ("text", "override", "named"),
    [
        ("optim: {stepps: 3}", "", "optim.stepps is unknown; there are lr, min_lr"),
        ("optim: {steps: many}", "", "optim.steps cannot be 'many'; it takes a whole number from 1 to"),
        ("optim: {lr: .nan}", "", "optim.lr cannot be nan; it takes a number above 0, up to 1"),
        ("optim: {precision: fp8}", "", "optim.precision cannot be 'fp8'; it takes auto, fp32, bf16"),
        ("data: {photos: 3}", "", "data.photos cannot be 3; it takes a path, or null"),
        ("data: {disparity: [0.1]}", "", "data.disparity cannot be [0.1]; it takes a list of two numbers, each from"),
        ("data: {rgbd: [{folder: a}]}", "", "data.rgbd.0.focal_px is missing"),
        ("data: {rgbd: kitchen}", "", "data.rgbd cannot be 'kitchen'; it takes a list"),
        ("[1, 2]", "", "the recipe cannot be [1, 2]; it takes keys data, loss, optim, run, init"),
        ("a: [", "", "not YAML"),
        ("a0: &a0 [x]\n" + "".join(f"a{k}: &a{k} [{f'*a{k - 1},' * 9}]\n" for k in range(1, 40)), "", "aliases"),
        ("a0: &a {x: 1}\n" + "".join(f"a{k}: &a {{<<: [*a, *a]}}\n" for k in range(40)), "", "aliases"),
        ("optim: {steps: [" + "[" * 10 + "]" * 10 + "]}", "", "optim.steps cannot be [[[...]]]"),
        ("optim: {steps: " + "[" * 60_000, "", "deeper than 20"),
        (f"{'x' * 1000}: 1", "", f"{'x' * 60} is unknown"),
        ("#" * 100_000, "", "too long for a recipe"),
        (PLAIN, "quick", "'quick': neither an option nor key=value"),
        (PLAIN, "optim.steps.a=1", "optim.steps cannot be"),
        ("data: {rgbd: []}", "data.rgbd.0.folder=a", "data.rgbd has 0 entries"),
        ("{data: {disparity: [0.5, 0.1]}, loss: {features: none}}", "", "data.disparity"),
        (PLAIN, "optim.min_lr=0.5", "optim.min_lr 0.5 is above optim.lr"),
        (PLAIN, "loss.dilation=4", "loss.dilation 4 is even"),
        ("loss: {features: resnet50}", "", "loss.features_path is missing"),
        ("{loss: {features_path: a, feature_size: null}, data: {cells: 16}}", "", "crops of 16 cells are too small"),
    ],
)
def test_what_cannot_be_is_named_with_its_file_or_option(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, override: str, named: str
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    with pytest.raises(InputError) as error:
        load_recipe(Recipe, written(tmp_path, text), [override] if override else [])
    assert named in str(error.value)
    assert str(tmp_path / "recipe.yaml") in str(error.value) or (override and override in str(error.value))
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="cpus: no such recipe"):
        load_recipe(Recipe, "cpus")


def test_runs_differ_by_what_is_learned_and_not_by_how_long_it_takes(tmp_path: Path) -> None:
    path = written(tmp_path)
    one = plain(load_recipe(Recipe, path))
    same = ["optim.steps=9", "run.validate_every=2", "run.save_every=2", "data.cache=elsewhere", "data.photos=moved"]
    assert differences(one, load_recipe(Recipe, path, same)) == []
    other = load_recipe(Recipe, path, ["optim.lr=1e-3", "data.shares.pairs=0", "run.seed=1"])
    assert differences(one, other) == ["data.shares.pairs", "optim.lr", "run.seed"]
    assert differences({**one, "once": 1, "init": "w"}, load_recipe(Recipe, path)) == ["init", "once"]
    assert json.loads(json.dumps(one)) == one


def test_the_rate_warms_up_and_falls_as_a_cosine_and_the_average_forgets_quickly_at_first() -> None:
    optim = OptimRecipe(lr=1.0, min_lr=0.1, warmup=4, steps=14)
    assert [learning_rate(step, optim) for step in range(4)] == pytest.approx([0.25, 0.5, 0.75, 1])
    assert learning_rate(4, optim) == pytest.approx(1)
    assert learning_rate(9, optim) == pytest.approx(0.55)
    assert learning_rate(13, optim) == pytest.approx(0.1 + 0.45 * (1 + math.cos(0.9 * math.pi)))
    assert learning_rate(99, optim) == pytest.approx(0.1)
    assert ema_decay(0, 0.9) == pytest.approx(0.1)
    assert ema_decay(10_000, 0.9) == 0.9
    assert ema_decay(0, 0) == 0


@pytest.mark.parametrize(("count", "batch"), [(10, 4), (3, 5)])
def test_an_epoch_is_a_permutation_whatever_the_batch(count: int, batch: int) -> None:
    picks = [pick for step in range(count) for pick in samples_of_step(step, count, batch, seed=3)]
    epochs = [picks[start : start + count] for start in range(0, len(picks), count)]
    assert all(sorted(epoch) == list(range(count)) for epoch in epochs)
    assert count == 3 or epochs[0] != epochs[1]
    assert picks != [pick for step in range(count) for pick in samples_of_step(step, count, batch, seed=4)]
    # Processes share one batch.
    whole = samples_of_step(5, 100, 8, seed=1)
    parts = [samples_of_step(5, 100, 8, seed=1, rank=rank, ranks=4) for rank in range(4)]
    assert [pick for part in parts for pick in part] == whole
    with pytest.raises(ValueError, match="divided"):
        samples_of_step(0, 100, 8, seed=1, ranks=3)
