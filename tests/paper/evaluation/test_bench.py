"""`spackle bench`: counts, sums, tables, the paper's numbers, folders."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import evaluation_data
from helpers.command import names_in, refuses, run
from helpers.scenes import box_before_wall

from spackle.bases.settings import BaseSettings
from spackle.paper.evaluation import bench
from spackle.paper.evaluation.case import Points
from spackle.paper.evaluation.evaluation import open_evaluation
from spackle.paper.evaluation.folder import load_run
from spackle.paper.evaluation.measurements import (
    Measurement,
    group_values,
)
from spackle.paper.evaluation.measurements import Run as Results
from spackle.paper.evaluation.options import TIMED_METHODS, BenchOptions
from spackle.paper.evaluation.paper_numbers import PAPER_PARAMETERS, PAPER_TABLES
from spackle.paper.evaluation.protocols import large_views
from spackle.paper.evaluation.tables import make_tables
from spackle.render import get_renderer
from spackle.residual.architectures import open_residual
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext, fill_view
from spackle.scene_fill.unet import UNet
from spackle.weights import PUBLISHED_WEIGHTS

EXPANDED = "tab:expanded_efficiency_gaussian_overhead"
PAPER_LABELS = {table.label for table in PAPER_TABLES}  # the paper's six tables
STAGE_MS = {"base": 1000.0, "view": 400.0, "photo": 1.0, "completion": 13.0}


def results(title: str = "Middlebury", factor: float = 1.0) -> Results:
    """A run of three images, the second twice as slow and the third four times as slow, and one
    failed image."""
    config: dict[str, Any] = {
        "kind": "bench",
        "protocol": "bench",
        "methods": list(TIMED_METHODS),
        "title": title,
    }
    config |= {
        "disparities": [0.3, 0.4, 0.5],
        "runs": 3,
        "base_runs": 1,
        "side": 1280,
        "device": "cuda",
    }
    config["base"] = {
        "name": "sharp",
        "says": "a network",
        "device": "cpu",
        "weights": PUBLISHED_WEIGHTS["sharp"].sha256,
    }
    config["residual"] = {
        "weights": "shipped",
        "sha256": "0123456789abcdef",
        "precision": "bfloat16",
    }
    config["hardware"] = {"cpu": "A Processor", "cores": 2, "threads": 2}
    config["versions"] = {"spackle": "0", "torch": "2"}
    rows = []
    for k in range(3):
        image = Measurement(title, f"image {k}", "", "", "", "", None)
        rows.append(image._replace(metric="note.precision", value="bf16"))
        for disparity in config["disparities"]:
            view = image._replace(setting=f"{disparity:g}", view="right")
            for method, count in (("paper", 10 * k), ("spackle", 40 * k)):
                times = {
                    name: np.array([0.5, 1, 30]) * factor * 2.0**k * ms / 1000
                    for name, ms in STAGE_MS.items()
                }
                numbers = bench.view_numbers(1000, count, times).items()
                rows += [
                    view._replace(method=method, metric=name, value=value)
                    for name, value in numbers
                ]
    rows.append(Measurement(title, "broken", "", "", "", "problem", "no such file"))
    return Results(config, rows, {"parameters": bench.count_parameters(UNet())})


@pytest.mark.parametrize(("name", "count"), [("unet", 8_023_153), ("sharp-decoder", 8_022_894)])
def test_the_networks_have_the_papers_parameters(name: str, count: int) -> None:
    found = bench.count_parameters(open_residual(name))
    paper = PAPER_PARAMETERS
    assert (found["base"], found["residual"]) == (702_305_169, count)
    assert round(found["base"] / 1e6, 2) == paper.base_m
    assert round(found["residual"] / 1e6, 2) == paper.residual_m
    assert round(100 * found["share"], 2) == paper.share_percent
    assert (found["base"] + found["residual"]) / 1e6 == pytest.approx(paper.merged_m, abs=0.01)
    assert 0.9 * found["base"] < found["base_used"] < found["base"]


def test_costs_are_joined_over_datasets_and_with_large_views() -> None:
    counted = evaluation_data.results(
        "LLFF", False, lambda image: {"spackle": {"aux": 30, "aux_share": 0.5}}
    )
    runs = [results(), results("Booster", 4.0), counted]
    tables = {table.label: table for table in make_tables(runs)}
    assert [*tables][-2:] == ["tab:efficiency_gaussian_overhead", EXPANDED]
    overhead, expanded = [*tables.values()][-2:]
    groups = dict.fromkeys(group for group, _ in overhead.heads)
    assert [*groups] == ["", *(f"S{k}: disparity 0.{k + 2}" for k in (1, 2, 3))]
    lines = [cells for rows in overhead.bodies for cells in rows]
    at = {cells[0]: k for k, cells in enumerate(lines) if cells[0]}
    paper = ("Spackle, eqs. 2 to 9‡ (SHARP)", "10", "1.00")
    spackle = ("Spackle‡ (SHARP)", "40", "4.00")
    large = ("Spackle‡ (rgbd)", "30", "50.00")
    for name, *found in (
        ("Middlebury", paper, spackle),
        ("LLFF", large, ("Spackle on SHARP (paper)", "8,425", "0.71")),
        ("Average", paper, spackle, large),
        ("Tanks", ("not run", "", "")),
        ("Median Spackle time (ms)", (paper[0], "7,070.0", "")),  # of 2,828 and 11,312
        ("Median time overhead", (paper[0], "1.00%", "")),
    ):
        assert [tuple(line[1:4]) for line in lines[at[name] :][: len(found)]] == found
    lines = [cells for rows in expanded.bodies for cells in rows]
    assert tuple(lines[0][:6]) == ("Middlebury", "S1", *paper, "1,010")
    assert tuple(lines[0][6:]) == ("2,800.0", "2,828.0", "1.00%", "0.357", "0.354", "3/23")
    assert tuple(lines[2][3:9]) == ("3,387", "0.29", "1,183,035", "6,410.3", "1,449.4", "-3.3%")
    for table in (overhead, expanded):
        assert any(
            "renderer and residual on cuda. Machine: A Processor, 2 cores, 2 threads" in note
            for note in table.notes
        )
        assert any("1 of 4 images" in note and "broken" in note for note in table.notes)
    assert {table.label for table in make_tables([counted], with_unmeasured=True)} == {
        *PAPER_LABELS
    }


def test_a_view_costs_what_a_completion_adds() -> None:
    prediction = box_before_wall().lift()
    context = FillContext(prediction.gaussians, prediction.camera, get_renderer())
    stages: list[str] = []
    camera = large_views(prediction, (0.3,), 1280)[0].camera
    paper, spackle = (
        len(bench.complete_view_in_stages(context, camera, stages.append, name))
        for name in TIMED_METHODS
    )
    assert spackle == len(fill_view(context, camera).aux) > paper > 64
    assert stages == [*bench.BASE_STAGES[1:], *bench.COMPLETION_STAGES] * 2


def test_points_suffice_and_without_depth_a_case_is_refused(scenes: Path) -> None:
    options = BenchOptions(
        dataset="middlebury",
        root=scenes,
        base=BaseSettings(name="rgbd"),
        disparities=(0.3,),
        residual="initial",
    )
    evaluation = open_evaluation(options.as_evaluation)
    case = evaluation.cases[0]
    assert case.read_depth is not None
    known = case.read_depth()
    points = Points(known.valid.nonzero().flip(-1) + 0.5, known.depth[known.valid])
    case_with_points = dataclasses.replace(case, read_depth=None, read_points=lambda: points)
    found = bench.time_case(case_with_points, evaluation, runs=1, base_runs=1)
    assert next(row.value for row in found if row.metric == "base_gaussians")
    case_without_depth = dataclasses.replace(case, read_depth=None)
    with pytest.raises(InputError, match="neither a depth map nor points"):
        bench.time_case(case_without_depth, evaluation, runs=1, base_runs=1)


def test_from_files_to_tables(scenes: Path, tmp_path: Path) -> None:
    output = tmp_path / "out"
    words = (
        "bench",
        scenes,
        "--dataset",
        "middlebury",
        "--base",
        "rgbd",
        "-o",
        output,
        "--disparity",
        "0.3,0.5",
    )
    done = run(*words, "--runs", 2, "--limit", 2)
    assert done.code == 0, done.err
    assert names_in(output) == {"rows.jsonl", "bench.md", "bench.tex", "config.json", "images"}
    found = load_run(output)
    assert found.about["parameters"]["residual"] == 8_023_153
    assert (found.settings, found.measured_images) == (["0.3", "0.5"], ["Ball", "Door"])
    values = group_values(found.measurements, "metric", "setting", "method")
    for setting in found.settings:
        for method in TIMED_METHODS:  # at both ends of the swipe
            bases = [base for base in values["base_gaussians", "", ""] for _ in range(2)]
            added = zip(bases, values["aux", setting, method], strict=True)
            assert values["merged", setting, method] == [base + aux for base, aux in added]
    refuses(
        run(*words, "--runs", 3, "--limit", 2),
        "with other options (base_runs: 2 -> 3; runs: 2 -> 3)",
    )
    refuses(
        run("evaluate", *words[1:], "--metrics", "none"),
        "config.json: not written by `spackle evaluate`",
    )
