"""`spackle bench`: counts, sums, tables, the paper's numbers, folders."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import evaluation_data
from helpers.command import names_in, refuses, run
from helpers.scenes import box_before_wall

from spackle.bases.depth import RgbdBase
from spackle.bases.settings import BaseSettings
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.patch_matching import Patches, match_patches
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
from spackle.render import CpuRenderer, get_renderer
from spackle.render.protocol import Rendering, as_sets
from spackle.residual import ResidualNet
from spackle.residual.architectures import open_residual
from spackle.residual.composer import DELTA_CHANNELS
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext, SceneViewCompletion, fill_view
from spackle.weights import PUBLISHED_WEIGHTS

EXPANDED = "tab:expanded_efficiency_gaussian_overhead"
PAPER_LABELS = {table.label for table in PAPER_TABLES}  # the paper's six tables
STAGE_MS = {"base": 1000.0, "view": 400.0, "photo": 1.0, "completion": 13.0}


def results(
    title: str = "Middlebury", factor: float = 1.0, base_parameters: int | None = 2_000_000
) -> Results:
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
        rows.append(image._replace(metric="base_parameters", value=base_parameters))
        rows.append(image._replace(metric="residual_parameters", value=8_000_000))
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
    return Results(config, rows)


@pytest.mark.parametrize(("name", "count"), [("unet", 8_023_153), ("sharp-decoder", 8_022_894)])
def test_the_networks_have_the_papers_parameters(name: str, count: int) -> None:
    found = bench.count_parameters(open_residual(name))
    assert found == count
    assert round(count / 1e6, 2) == PAPER_PARAMETERS.residual_m


@pytest.mark.parametrize(
    ("base_parameters", "text"),
    [
        (2_000_000, "base SHARP 2.00; residual 8.00 (400.00 %), together 10.00. The paper: 702.31"),
        (0, "base SHARP –; residual 8.00. The paper: 702.31"),
        (None, "base SHARP not counted; residual 8.00. The paper: 702.31"),
    ],
)
def test_the_notes_count_the_networks_that_ran(base_parameters: int | None, text: str) -> None:
    (_, table) = make_tables([results(base_parameters=base_parameters)])
    (note,) = (note for note in table.notes if note.startswith("Parameters"))
    assert text in note


class SharedNetworks:
    """A base with two networks, one of them twice, as in a list of its parts."""

    def __init__(self) -> None:
        part = torch.nn.Linear(3, 2)  # 8 numbers
        self.networks = [part, torch.nn.Linear(1, 1, bias=False)]
        self.head = part
        self.name = "own"


def test_parameters_are_counted_once_and_only_in_networks() -> None:
    assert bench.count_parameters(SharedNetworks()) == 9
    depth_map = box_before_wall().depth_map
    assert bench.count_parameters(RgbdBase(depth_map)) is None


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


class CountingRenderer(CpuRenderer):
    """Notes each rendering, and whether it could use what was prepared for the same tensors."""

    def __init__(self, events: list[str], photo_camera: Camera) -> None:
        self.events = events
        self.photo_camera = photo_camera
        self.prepared: list[torch.Tensor] = []  # kept, so that no identity is used twice

    def render(  # type: ignore[override]
        self, gaussians: Gaussians | list[Gaussians], camera: Camera, **options: Any
    ) -> Rendering:
        sets = as_sets(gaussians)
        is_prepared = any(sets[0].means is means for means in self.prepared)
        self.prepared.append(sets[0].means)
        place = "photo" if camera is self.photo_camera else "view"
        self.events.append(f"{place} with {len(sets)} {'prepared' if is_prepared else 'new'}")
        return super().render(gaussians, camera, **options)


FIRST = ["view with 1 new", "end of view"]
SECOND = ["view with 2 prepared", "end of completion"]


@pytest.mark.parametrize(
    ("inputs", "method", "expected", "searches"),
    [
        (("alpha", "mask"), "paper", [*FIRST, "end of photo", *SECOND], 0),
        (
            ("mask", "photo"),
            "paper",
            [*FIRST, "end of photo", "photo with 1 prepared", *SECOND],
            0,
        ),
        (("mask", "patches"), "paper", [*FIRST, "end of photo", *SECOND], 1),
        (
            ("mask",),
            "spackle",
            # The photo's guard; and two passes, of which only the first has a texture.
            [
                *FIRST,
                "photo with 1 prepared",
                "end of photo",
                SECOND[0],
                "view with 3 prepared",
                SECOND[1],
            ],
            1,
        ),
    ],
)
def test_each_run_renders_and_computes_what_its_method_needs_and_nothing_else(
    inputs: tuple[str, ...],
    method: str,
    expected: list[str],
    searches: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Network(ResidualNet):
        name = "few-inputs"
        local = False
        view_type = SceneViewCompletion

        def __init__(self) -> None:
            super().__init__()
            self.unused = torch.nn.Parameter(torch.zeros(1))

        def forward(self, features: torch.Tensor) -> torch.Tensor:
            return features.new_zeros(1, DELTA_CHANNELS, *features.shape[-2:])

    Network.inputs = inputs
    events: list[str] = []
    found_searches: list[int] = []

    def counted_search(*arguments: Any) -> Patches:
        found_searches.append(1)
        return match_patches(*arguments)

    monkeypatch.setattr("spackle.scene_fill.view_completion.match_patches", counted_search)
    prediction = box_before_wall().lift()
    renderer = CountingRenderer(events, prediction.camera)
    context = FillContext(prediction.gaussians, prediction.camera, renderer, Network())
    camera = large_views(prediction, (0.3,), 1280)[0].camera
    for _ in range(2):  # the second run may not use what the first has left
        events.clear()
        found_searches.clear()
        bench.complete_view_in_stages(
            context, camera, lambda stage: events.append(f"end of {stage}"), method
        )
        assert events == expected
        assert len(found_searches) == searches


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
    parameters = {
        row.metric: row.value for row in found.measurements if row.metric.endswith("parameters")
    }
    assert parameters == {"base_parameters": 0, "residual_parameters": 8_023_153}
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
