"""The scoreboard measures and compares pairs, and finds every mechanism in the package."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scoreboard
import torch
from helpers.evaluation_data import HEIGHT, WIDTH, write_boxes

from spackle.paper.training.losses import SqueezeNet


@pytest.fixture
def pairs(tmp_path: Path) -> Path:
    """A folder with one stereo pair, and random weights of SqueezeNet."""
    write_boxes(tmp_path / "pair", 0)
    torch.manual_seed(0)
    state = {key: value.numpy() for key, value in SqueezeNet().state_dict().items()}
    for ours, theirs in {".conv": "/conv", ".weight": ".w", ".bias": ".b"}.items():
        state = {key.replace(ours, theirs): value for key, value in state.items()}
    np.savez(tmp_path / "squeezenet.npz", **state)
    return tmp_path


def run(pairs: Path, *words: str) -> dict[str, Any]:
    scoreboard.main(
        [
            str(pairs),
            "--features",
            str(pairs / "squeezenet.npz"),
            "-o",
            str(pairs / "now.json"),
            *words,
        ]
    )
    runs: dict[str, Any] = json.loads((pairs / "now.json").read_text())["runs"]
    return runs


def test_a_pair_is_measured_and_compared(pairs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    row = run(pairs)["default"]["pair"]
    assert 0 < row["distance"] < 2
    assert 10 < row["PSNR"] < min(row["band"], row["elsewhere"])
    assert row["photo"] > 30
    assert row["agreement"] >= 45
    assert 0 <= row["HAR"] < 0.5
    assert 0 < row["aux"] < row["base"] < 1.5 * WIDTH * HEIGHT / 1000
    (pairs / "now.json").rename(pairs / "before.json")
    without = run(pairs, "--against", str(pairs / "before.json"), "--without", "network+texture")
    changed = without["network+texture"]["pair"]
    assert changed["aux"] < row["aux"]
    assert changed["base"] == row["base"]
    output = capsys.readouterr().out
    assert "1 scenes; but for the seconds nothing changed." in output
    assert "| network+texture |" in output
    with pytest.raises(SystemExit):
        run(pairs, "--small", "4", "--against", str(pairs / "before.json"))


def test_sign_test() -> None:
    assert scoreboard.sign_test(5, 5) == 1
    assert scoreboard.sign_test(9, 1) == pytest.approx(22 / 1024)  # 2 · (1 + 10) / 2¹⁰
    assert scoreboard.sign_test(0, 11) == pytest.approx(2 / 2048)
    before, now = (
        {"a": {"x": 1.0}, "b": {"x": 2.0}, "c": {"x": 7.0}},
        {"a": {"x": 2.0}, "b": {"x": 1.5}},
    )
    assert scoreboard.change("x", before, now) == (1.5, 1.75, 1, 1)


@pytest.mark.parametrize("name", scoreboard.MECHANISMS)
def test_each_mechanism_is_in_the_package(name: str) -> None:
    for stage in (scoreboard.LIFT, scoreboard.FILL):
        for target in stage.get(name, {}):
            own = [vars(module)[target.rpartition(".")[2]] for module in scoreboard.holders(target)]
            with scoreboard.switched_off(name, stage):
                there = [
                    vars(module)[target.rpartition(".")[2]] for module in scoreboard.holders(target)
                ]
                assert there[0] is not own[0]
            assert own == [
                vars(module)[target.rpartition(".")[2]] for module in scoreboard.holders(target)
            ]
