"""The command of the suite: a folder that is gone on with, what is said of what was not run, bad options."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import names_in, run

from spackle.cli.options import INTERRUPTED
from spackle.errors import InputError
from spackle.evaluation.results import KINDS, begin
from spackle.evaluation.suite.tables import TITLES

SIDE = 64


def test_sections_are_measured_once_and_gathered(tmp_path: Path) -> None:
    output = tmp_path / "out"
    words = ("bench", "--suite", "--side", SIDE, "--runs", 1, "--device", "cpu", "-o", output)
    done = run(*words, "--only", "scaling")
    assert done.code == 0, done.err
    assert names_in(output) == {"config.json", "sections", "suite.json", "suite.md", "scaling.svg"}
    assert names_in(output / "sections") == {"limits.json", "scaling.json"}
    first = (output / "sections" / "scaling.json").stat().st_mtime_ns
    done = run(*words, "--only", "renderer,sharp,gpu-view")
    assert done.code == 0, done.err
    assert (output / "sections" / "scaling.json").stat().st_mtime_ns == first
    found = json.loads((output / "suite.json").read_text())
    assert set(found["sections"]) == {"limits", "scaling", "renderer"}
    assert found["not_run"]["gpu-view"] == "--device cpu"
    assert "no weights" in found["not_run"]["sharp"]
    assert found["not_run"]["video"] == "not asked for (--only)"
    assert {"commit", "hardware", "versions"} <= found["config"].keys()
    blend = next(row for row in found["sections"]["renderer"]["rows"] if row["name"] == "blend")
    assert blend["limits_ms"]["operations"] > 0
    assert math.isclose(blend["median"], np.median(blend["values"]))
    text = (output / "suite.md").read_text()
    assert all(f"**{name}.**" in text or f"| {name} | " in text for name in TITLES)
    assert "![" in text
    refused = run(*words[:3], 32 + SIDE, *words[4:])
    assert (refused.code, f"side: {SIDE} -> {32 + SIDE}" in refused.err) == (2, True)


def test_a_stopped_run_goes_on(tmp_path: Path) -> None:
    output, answers = tmp_path / "out", iter([False, True])
    words = ("bench", "--suite", "--side", SIDE, "--runs", 1, "--only", "limits,scaling", "-o", output)

    @contextlib.contextmanager
    def stopping(alone: bool) -> Iterator[Any]:
        yield lambda: next(answers)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spackle.jobs.bench.suite.asked_to_stop", stopping)
        done = run(*words)
    assert (done.code, "the same command goes on" in done.err) == (INTERRUPTED, True)
    assert names_in(output) == {"config.json", "sections"}
    first = (output / "sections" / "limits.json").read_text()
    assert run(*words).code == 0
    assert (output / "sections" / "limits.json").read_text() == first
    assert "suite.md" in names_in(output)


def config_of(kind: str | None, runs: int = 1) -> dict[str, Any]:
    return {"runs": runs} | ({} if kind is None else {"kind": kind})


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_belongs_to_one_configuration_of_one_command(tmp_path: Path, kind: str | None) -> None:
    command, results = KINDS[kind]
    for _ in range(2):  # the second one goes on
        begin(tmp_path, config_of(kind), "parts")
    assert names_in(tmp_path) == {"config.json", "parts"}
    with pytest.raises(InputError, match=rf"holds {results} of another kind \(runs: 1 -> 2\): choose another -o"):
        begin(tmp_path, config_of(kind, runs=2), "parts")
    for other in KINDS.keys() - {kind}:
        with pytest.raises(InputError, match=rf"config\.json: not of `spackle {KINDS[other][0]}`: choose another -o"):
            begin(tmp_path, config_of(other), "parts")
    (tmp_path / "config.json").write_text("[]")
    with pytest.raises(InputError, match=f"not of `spackle {command}`"):
        begin(tmp_path, config_of(kind), "parts")


def test_no_gpu_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    done = run("bench", "--suite", "--side", SIDE, "--runs", 1, "--only", "gpu-view", "-o", tmp_path / "out")
    assert done.code == 0, done.err
    assert "not run: no GPU" in (tmp_path / "out" / "suite.md").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "--dataset and --root missing: give --dataset NAME --root DIR, or --suite"),
        (("--dataset", "middlebury"), "--root missing"),
        (("--suite", "--dataset", "middlebury"), "--dataset is not for --suite"),
        (("--suite", "--disparity", "0.3"), "--disparity is not for --suite"),
        (("--dataset", "middlebury", "--root", ".", "--only", "limits"), "--only is for --suite alone"),
        (("--suite", "--only", "rendrer"), "did you mean renderer?"),
        (("--suite", "--runs", "0"), "--runs must be between"),
        (("--suite", "--side", "7"), "--side must be an even number"),
        (("--suite", "--base", "lite"), "--base lite: the suite times no other base than sharp"),
        (("--suite", "-c", "gone.pt"), "-c gone.pt: no such file"),
        (("--suite", "--precision", "fp8", "--base", "sharp"), "--precision fp8"),
        (("--suite", "--residual", "gone.safetensors"), "--residual gone.safetensors: no such file"),
        (("--suite", "--device", "tpu"), "--device tpu"),
        (("--suite", "--windows", "5,all"), "--windows 5,all: give whole numbers"),
        (("--suite", "--windows", "7"), "--windows is of SHARP, which is not timed"),
        (("--suite", "--base", "sharp", "--windows", "1,0"), "--windows must be between 1 and 35, got 0"),
        (("--dataset", "middlebury", "--root", ".", "--windows", "7"), "--windows is for --suite alone"),
        (("--suite", "words"), "a word of no option"),
    ],
)
def test_bad_options_are_one_line(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    done = run("bench", *words, "-o", tmp_path / "out")
    assert (done.code, len(done.lines)) == (2, 1)
    assert message in done.err
    assert not (tmp_path / "out").exists()
