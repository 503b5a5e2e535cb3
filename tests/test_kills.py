"""Commands that are killed ten times at random moments and resumed write the files of an
uninterrupted run.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.dataset_builds import SHORT, write_inputs
from helpers.evaluation_data import write_boxes
from helpers.photos import write_depth, write_photo
from helpers.systems import needs_posix_signals
from helpers.training_runs import assert_same_weights

Words = list[object]
TIMES = {"seconds", "total"}


def predict(place: Path) -> Words:
    for name in "abcd":
        write_photo(place / "photos" / f"{name}.png")
    return [
        "predict",
        place / "photos",
        "--depth",
        write_depth(place / "depth.npy"),
        "--frames",
        20,
        "-o",
    ]


def dataset(place: Path) -> Words:
    write_inputs(place, 6)
    return ["dataset", "build", place / "photos", "--depth", place / "depth", *SHORT, "-o"]


def evaluate(place: Path) -> Words:
    for seed in range(4):
        write_boxes(place / "scenes" / str(seed), seed)
    return ["evaluate", place / "scenes", "--dataset", "middlebury", "--base", "rgbd", "-o"]


def train(place: Path) -> Words:
    write_photo(place / "photos" / "a.png", 128, 96)
    (place / "recipe.yaml").write_text("run: {device: cpu}\n")
    data = [
        f"data.photos={place / 'photos'}",
        "data.views=4",
        "data.validation_views=2",
        "data.cells=16",
    ]
    steps = [
        "optim.steps=8",
        "optim.batch=2",
        "run.save_every=2",
        "run.log_every=3",
        "run.validate_every=4",
        "loss.features=none",
    ]
    return ["train", "--recipe", place / "recipe.yaml", "data.crops=1", *data, *steps, "-o"]


def same_files(one: Path, other: Path) -> None:
    """Compare all files, except for the times in JSON."""

    def timeless(content: Any) -> Any:
        if isinstance(content, dict):
            return {name: timeless(value) for name, value in content.items() if name not in TIMES}
        return content

    def files(folder: Path) -> dict[str, Any]:
        found = {
            path.relative_to(folder).as_posix(): path
            for path in folder.rglob("*")
            if path.is_file()
        }
        return {
            name: timeless(json.loads(path.read_text()))
            if path.suffix == ".json"
            else path.read_bytes()
            for name, path in found.items()
        }

    mine, yours = files(one), files(other)
    assert mine.keys() == yours.keys()
    assert [name for name in mine if mine[name] != yours[name]] == []


def same_training(one: Path, other: Path) -> None:
    """Compare the weights and, except for the times, the lines of metrics.jsonl."""
    assert_same_weights(one, other)
    mine, yours = (
        [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
        for folder in (one, other)
    )
    for line in (*mine, *yours):
        del line["seconds"]
    assert [line["step"] for line in mine] == [3, 4, 6, 8]
    assert mine == yours


@needs_posix_signals
@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "same"),
    [
        (predict, same_files),
        (dataset, same_files),
        (evaluate, same_files),
        (train, same_training),
    ],
)
def test_ten_kills_change_nothing(
    tmp_path: Path, command: Callable[[Path], Words], same: Callable[[Path, Path], None]
) -> None:
    whole, killed, rng, kills, runs = (
        tmp_path / "whole",
        tmp_path / "killed",
        random.Random(0),
        0,
        0,
    )
    words = [sys.executable, "-m", "spackle", *map(str, command(tmp_path))]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}  # a fixed order of sums

    def started(folder: Path) -> subprocess.Popen[bytes]:
        return subprocess.Popen([*words, folder], env=environment, stderr=subprocess.DEVNULL)

    assert started(whole).wait() == 0  # the first run also compiles kernels
    start, process = time.monotonic(), started(killed)
    while not killed.exists() and process.poll() is None:
        time.sleep(0.01)
    begins = time.monotonic() - start  # after the imports
    assert process.wait() == 0
    lasts = time.monotonic() - start
    while kills < 10:
        if process.returncode == 0:  # the run is complete: begin again
            same(whole, killed)
            shutil.rmtree(killed)
        assert (runs := runs + 1) < 100, f"only {kills} kills: a run lasts {begins} to {lasts} s"
        process = started(killed)
        try:
            process.wait(rng.uniform(begins, (begins + lasts) / 2))  # a resumed run is shorter
        except subprocess.TimeoutExpired:
            process.kill()
        assert process.wait() in (0, -signal.SIGKILL)
        kills += process.returncode != 0
    assert started(killed).wait() == 0
    same(whole, killed)
