"""The command line that the trainings of research/ share: what it passes on, and its exit codes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from spackle.cli.training_command import run_training_command
from spackle.paper.training import train as training
from spackle.paper.training.recipe import AnyRecipe, RecipePart
from spackle.runtime.errors import InputError


class GardenPart(RecipePart):
    """Keys that no recipe of `spackle train` has."""

    flowers: int = 3


class GardenRecipe(AnyRecipe):
    """A recipe with a section of its own."""

    garden: GardenPart = GardenPart()


def open_task(recipe: Any, device: Any) -> Any:
    """Never called, because no test of this file trains."""
    raise AssertionError


@pytest.fixture
def run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, list[tuple[Any, ...]]]]:
    """Runs the command; returns its exit code and the arguments of all trainings that it began.

    `outcome` is why the training ends, or the error that ends it.
    """
    (tmp_path / "garden.yaml").write_text("garden: {flowers: 5}\n")

    def run_command(*words: str, outcome: str | Exception = "steps") -> Any:
        calls: list[tuple[Any, ...]] = []

        def train(recipe: Any, task: Any, output: Path, reporter: Any, overwrite: bool) -> str:
            calls.append((recipe, task, output, overwrite))
            if isinstance(outcome, Exception):
                raise outcome
            return outcome

        monkeypatch.setattr(training, "train", train)
        code = run_training_command(
            GardenRecipe,
            open_task,
            ["--recipe", f"{tmp_path}/garden.yaml", *words],
            description="Grows flowers.",
            recipe_help="a file of flowers",
            overrides_help="other flowers",
        )
        return code, calls

    return run_command


def test_overrides_stand_anywhere_and_replace_values_of_the_recipe(run: Any) -> None:
    code, [(recipe, task, output, overwrite)] = run("optim.steps=7", "-o", "out", "run.seed=4")
    assert (code, output, overwrite) == (0, Path("out"), False)
    assert (recipe.garden.flowers, recipe.optim.steps, recipe.run.seed) == (5, 7, 4)
    assert isinstance(recipe, GardenRecipe)
    assert task is open_task
    _, [(recipe, _, _, overwrite)] = run("-o", "out", "--overwrite", "garden.flowers=8")
    assert (recipe.garden.flowers, overwrite) == (8, True)


def test_the_exit_code_says_how_the_training_ended(
    run: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("-o", "out", outcome="patience")[0] == 0
    assert run("-o", "out", outcome="stopped")[0] == 130
    assert run("-o", "out", outcome=InputError("out: another run is at work"))[0] == 2
    assert capsys.readouterr().err == "error: out: another run is at work\n"
    # Of several processes, all but one raise an error without a message.
    assert run("-o", "out", outcome=InputError(""))[0] == 2
    assert capsys.readouterr().err == ""


def test_an_unknown_key_is_refused_before_any_training(
    run: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("-o", "out", "garden.flower=1") == (2, [])
    error = capsys.readouterr().err
    assert error.startswith(f"error: {tmp_path}/garden.yaml: garden.flower: there is no such key")
    assert error.count("\n") == 1


def test_the_help_has_the_texts_of_its_training(
    run: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="0"):
        run("--help")
    text = capsys.readouterr().out
    for words in ("Grows flowers.", "a file of flowers", "other flowers", "--overwrite"):
        assert words in text
