"""Recipes, schedules, and the order of samples."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest

from spackle.paper.training.recipe import (
    OptimRecipe,
    Recipe,
    RgbdFolder,
    changed_keys,
    load_recipe,
    set_nested,
)
from spackle.paper.training.schedule import ema_decay, learning_rate, samples_of_step
from spackle.runtime.errors import InputError
from spackle.weights import published_weights

PLAIN = "loss: {features: none}"


@pytest.mark.parametrize("name", ["cpu", "direct_ft", "paper", "reverse_view"])
def test_packaged_recipes(name: str) -> None:
    recipe = load_recipe(Recipe, name, ["loss.features_path=weights"])
    papers = {"color": 10, "alpha": 0.5, "perceptual": 1, "preserve": 5, "color_blur": 0, "gram": 1}
    assert (vars(recipe.loss).items() >= papers.items()) == (name != "cpu")
    assert recipe.data.photos is not None or recipe.data.pseudo is not None
    assert recipe.loss.dilation == 21
    if name == "paper":
        assert (recipe.optim.lr, recipe.optim.min_lr, recipe.optim.warmup) == (
            1.6e-4,
            1.6e-5,
            10_000,
        )
        assert (recipe.run.patience, recipe.run.min_delta) == (10, 1e-4)
        assert recipe.data.crops is None  # whole views
        assert (recipe.loss.features, recipe.loss.feature_size, recipe.data.views) == (
            "resnet50",
            512,
            20_000,
        )


def test_resnet50_is_found_in_the_folder_of_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    assert load_recipe(Recipe, "paper").loss.features_file is None
    fetched = tmp_path / published_weights("features").file
    fetched.touch()
    assert load_recipe(Recipe, "paper").loss.features_file == fetched


def test_overrides(tmp_path: Path) -> None:
    text = """
        data:
          photos: some/photos
          rgbd: [{folder: kitchen, focal_px: 585}]
          disparity: [0, 1e-1]
        loss: {features: none, feature_size: null}
        run:
        init: weights.safetensors
    """
    overrides = [
        "optim.steps=1e3",
        "data.rgbd.0.focal_px=600",
        "optim.lr=2e-4",
        "init=null",
        "run.log_every=7",
    ]
    (tmp_path / "recipe.yaml").write_text(text)
    recipe = load_recipe(Recipe, tmp_path / "recipe.yaml", overrides)
    assert recipe.data.photos == Path("some/photos")
    assert recipe.data.rgbd == (RgbdFolder(folder=Path("kitchen"), focal_px=600.0, unit_m=0.001),)
    assert (recipe.data.disparity, recipe.loss.feature_size, recipe.init) == (
        (0.0, 0.1),
        None,
        None,
    )
    assert (recipe.optim.steps, recipe.optim.lr, recipe.run.log_every) == (1000, 2e-4, 7)


@pytest.mark.parametrize(
    ("text", "override", "named"),
    [
        ("optim: {stepps: 3}", "", "recipe.yaml: optim.stepps: there is no such key"),
        ("optim: {steps: many}", "", "recipe.yaml: optim.steps: input should be a valid integer"),
        ("optim: {lr: .nan}", "", "optim.lr: input should be a finite number, not nan"),
        (
            "data: {rgbd: [{folder: a, focal_px: 1, focal: 1}]}",
            "",
            "data.rgbd.0.focal: there is no such key",
        ),
        (
            "[1, 2]",
            "",
            "recipe.yaml: input should be a valid dictionary or instance of Recipe, not [1, 2]",
        ),
        ("optim: {steps: " + "[" * 60_000, "", "recipe.yaml: not YAML"),
        (f"{'x' * 1000}: 1", "", f"recipe.yaml: {'x' * 60}: there is no such key"),
        ("data: {disparity: [0.5, 0.1]}", "", "data.disparity: must ascend, not [0.5, 0.1]"),
        (PLAIN, "optim.min_lr=0.5", "optim: min_lr must be <= lr, not {'min_lr': 0.5}"),
        (PLAIN, "loss.dilation=4", "loss.dilation: must be odd, not 4"),
        (PLAIN, "quick", "'quick': neither an option nor key=value"),
        ("data: {rgbd: []}", "data.rgbd.0.folder=a", "data.rgbd.0.folder=a: "),
    ],
)
def test_bad_values_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, override: str, named: str
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    (tmp_path / "recipe.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        load_recipe(Recipe, tmp_path / "recipe.yaml", [override] if override else [])
    assert named in str(error.value)
    assert str(tmp_path / "recipe.yaml") in str(error.value) or (
        override and override in str(error.value)
    )
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="cpus: no such recipe"):
        load_recipe(Recipe, "cpus")


@pytest.mark.parametrize(
    ("key", "meant"),
    [
        ("optim.learning_rate", "did you mean optim.lr?"),
        ("lr", "did you mean optim.lr?"),
        ("train.lr", "did you mean optim.lr?"),
        ("optim.stepps", "did you mean optim.steps?"),
        ("optim.batch_size", "did you mean optim.batch?"),
        ("optim.warmup_steps", "did you mean optim.warmup?"),
        ("opt.weight_decay", "did you mean optim.weight_decay?"),
        ("run.sed", "did you mean run.seed?"),
        ("dat.seed", "did you mean data.seed?"),
        ("data.share.pairs", "did you mean data.shares.pairs?"),
        ("data.rgbd.1.focal", "did you mean data.rgbd.1.focal_px?"),
        ("netwrk", "did you mean network?"),
        ("data.rgbd.1.zzz", "there are folder, focal_px, unit_m"),
        ("loss.zzz", "there are color, alpha, perceptual, preserve, features, features_path"),
    ],
)
def test_an_unknown_key_is_answered_with_the_key_that_was_meant(
    tmp_path: Path, key: str, meant: str
) -> None:
    camera = "{folder: a, focal_px: 1}"
    text = f"data: {{rgbd: [{camera}, {camera}]}}\n"
    (tmp_path / "recipe.yaml").write_text(text)
    with pytest.raises(InputError) as by_override:
        load_recipe(Recipe, tmp_path / "recipe.yaml", [f"{key}=3"])
    assert f"{key}: there is no such key: {meant}" in str(by_override.value)

    # The same key in the file is answered in the same words.
    content = load_recipe(Recipe, tmp_path / "recipe.yaml").model_dump(mode="json")
    set_nested(content, key.split("."), 3)
    (tmp_path / "recipe.yaml").write_text(json.dumps(content))
    with pytest.raises(InputError) as by_file:
        load_recipe(Recipe, tmp_path / "recipe.yaml")
    assert str(by_file.value) == str(by_override.value)


@pytest.mark.parametrize(
    ("override", "meant"),
    [
        ("loss.features=resnet", "did you mean resnet50?"),
        ("run.device=gpu", "input should be 'auto', 'cpu' or 'cuda', not 'gpu'"),
        ("run.device=cuda0", "did you mean cuda?"),
        ("optim.precision=bfloat16", "did you mean bf16?"),
        ("network=u-net", "did you mean unet?"),
        ("network=sharp_decoder", "did you mean sharp-decoder?"),
    ],
)
def test_an_unknown_value_is_answered_with_the_value_that_was_meant(
    override: str, meant: str
) -> None:
    with pytest.raises(InputError, match=re.escape(meant)):
        load_recipe(Recipe, "paper", [override])


def test_an_unknown_recipe_is_answered_with_the_name_that_was_meant() -> None:
    with pytest.raises(InputError, match=r"revers_view: no such recipe .did you mean reverse_view"):
        load_recipe(Recipe, "revers_view")


def test_differences_ignore_the_length_of_a_run(tmp_path: Path) -> None:
    path = tmp_path / "recipe.yaml"
    path.write_text(PLAIN)
    one = load_recipe(Recipe, path).model_dump(mode="json")
    same = [
        "optim.steps=9",
        "run.validate_every=2",
        "run.save_every=2",
        "data.cache=elsewhere",
        "data.photos=moved",
    ]
    assert changed_keys(one, load_recipe(Recipe, path, same)) == []
    other = load_recipe(Recipe, path, ["optim.lr=1e-3", "data.shares.pairs=0", "run.seed=1"])
    assert changed_keys(one, other) == ["data.shares.pairs", "optim.lr", "run.seed"]
    assert changed_keys({**one, "once": 1, "init": "w"}, load_recipe(Recipe, path)) == [
        "init",
        "once",
    ]
    assert json.loads(json.dumps(one)) == one


def test_schedules() -> None:
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
def test_an_epoch_is_a_permutation(count: int, batch: int) -> None:
    picks = [pick for step in range(count) for pick in samples_of_step(step, count, batch, seed=3)]
    epochs = [picks[start : start + count] for start in range(0, len(picks), count)]
    assert all(sorted(epoch) == list(range(count)) for epoch in epochs)
    assert count == 3 or epochs[0] != epochs[1]
    assert picks != [
        pick for step in range(count) for pick in samples_of_step(step, count, batch, seed=4)
    ]
    # Processes share one batch.
    whole = samples_of_step(5, 100, 8, seed=1)
    parts = [samples_of_step(5, 100, 8, seed=1, rank=rank, ranks=4) for rank in range(4)]
    assert [pick for part in parts for pick in part] == whole
