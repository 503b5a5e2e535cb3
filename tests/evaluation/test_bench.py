"""`spackle bench`: counts, parameters, layouts, the paper's numbers; of times only that they are there and add up."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from command import Run, names_in, run
from evaluation_data import write_boxes
from scenes import box_before_wall
from sharp_weights import gaussians_of, write_tiny

from spackle.bases.lift import RgbdBase
from spackle.bases.open import BaseError, BaseSettings
from spackle.bases.protocol import BasePrediction
from spackle.bases.sharp.layers import TINY
from spackle.device import MemoryShort
from spackle.errors import InputError
from spackle.evaluation import bench, paper
from spackle.evaluation.case import Points
from spackle.evaluation.efficiency import (
    BASE_PATH,
    EXTRA,
    SIDE,
    STAGES,
    Efficiency,
    Record,
    efficiency_tables,
    view_cost,
)
from spackle.evaluation.protocols import large_views
from spackle.evaluation.setup import EvaluateOptions, open_evaluation
from spackle.evaluation.table import EMPTY
from spackle.render import get_renderer
from spackle.residual import Completer

CPU = torch.device("cpu")
STAGE_MS = {"base": 1000.0, "view": 400.0, "photo": 1.0, "completion": 4.0, "rerender": 9.0}


def cost(setting: str = "0.3", added: int = 20, factor: float = 1.0) -> Record:
    """A view whose base path takes 1,400 ms and Spackle's part 14."""
    runs = {name: [factor * ms / 1000 * late for late in (0.5, 1, 30)] for name, ms in STAGE_MS.items()}
    return view_cost(setting, 1000, added, runs)


def results(disparities: tuple[float, ...] = (0.3, 0.4, 0.5), **facts: Any) -> Efficiency:
    """Three images of Middlebury, the second twice as slow and the third four times, and one that failed."""
    shared = {"facts": {"load": 1.5, "warm": True, "notes": {"precision": "bf16"}, **facts}, "problem": None}
    images: list[Record] = [
        {"name": f"image {k}", "views": [cost(f"{d:g}", 10 * k, 2.0**k) for d in disparities], **shared}
        for k in range(3)
    ]
    config: dict[str, Any] = {"title": "Middlebury", "disparities": list(disparities), "runs": 3, "base_runs": 1}
    config["base"] = {"title": "SHARP", "says": "a network", "device": "cpu"}
    config["residual"] = {"weights": "shipped", "sha256": "0123456789abcdef", "precision": "bfloat16"}
    config["hardware"] = {"cpu": "A Processor", "cores": 2, "threads": 2}
    config["versions"] = {"spackle": "0", "torch": "2"}
    return Efficiency(config, [*images, {"name": "broken", "facts": {}, "views": [], "problem": "no such file"}])


# --- the paper's numbers, figures, tables


def test_the_networks_have_the_papers_parameters() -> None:
    found = bench.count_parameters()
    assert (found["base"], found["residual"]) == (702_305_169, 8_021_376)
    assert round(found["base"] / 1e6, 2) == paper.PARAMETERS_M
    assert round(found["residual"] / 1e6, 2) == paper.ADDED_PARAMETERS_M
    assert round(100 * found["share"], 2) == paper.ADDED_PARAMETERS_PERCENT
    assert (found["base"] + found["residual"]) / 1e6 == pytest.approx(paper.MERGED_PARAMETERS_M, abs=0.01)
    assert 0.9 * found["base"] < found["base_used"] < found["base"]


def test_the_papers_rows_fit_each_other_but_for_one() -> None:
    for index, disparity in enumerate(paper.DISPARITIES):
        rows = {title: paper.at(numbers, disparity) for title, numbers in paper.TIMES.items()}
        for title, (base_ms, spackle_ms, _, base_fps, spackle_fps) in rows.items():
            assert base_ms is not None
            assert spackle_ms is not None
            fits = base_fps == pytest.approx(1000 / base_ms, rel=0.01)
            assert fits == ((title, disparity) != paper.ODD_TIME)
            assert spackle_fps == pytest.approx(1000 / spackle_ms, rel=0.01)
        times = sorted(row[1] or 0 for row in rows.values())
        assert paper.MEDIAN_SPACKLE_MS[index] == pytest.approx((times[2] + times[3]) / 2, abs=0.11)
        added = [numbers[3 * index] for numbers in paper.GAUSSIANS.values()]
        assert paper.at(paper.AVERAGE, disparity)[0] == pytest.approx(sum(added) / 6, abs=1)
    assert paper.at(paper.AVERAGE, 0.6) == (None, None)


def test_times_are_medians_of_runs_that_add_up_and_spread_over_the_measured_images() -> None:
    found = cost()["figures"]
    times = {"base_ms": 1400, "extra_ms": 14, "spackle_ms": 1414, "overhead": 0.01, "overhead_of_view": 14 / 400}
    assert {name: found[name] for name in times} == pytest.approx(times)
    assert found["base_fps"] == pytest.approx(1 / 1.4)
    assert (found["share"], found["merged"]) == (0.02, 1020)
    assert set(BASE_PATH + EXTRA) == set(STAGES)
    assert results().spread("0.4", "base_ms") == pytest.approx((3, 9800 / 3, 2100, 2800, 4200))


def test_the_layouts_are_the_papers() -> None:
    overhead, expanded, stages = efficiency_tables(results(), bench.count_parameters())
    assert overhead.label == "tab:efficiency_gaussian_overhead"
    assert [name for name, _ in overhead.groups] == ["", *(f"S{k}: disparity 0.{k + 2}" for k in (1, 2, 3))]
    rows = {line.cells[:2]: line.cells[2:] for line in overhead.lines}
    assert rows["Middlebury", "SHARP"] == ("10", "1.00") * 3
    assert rows["", "SHARP (paper)"][1::2] == (EMPTY,) * 3
    assert rows["LLFF", "SHARP (paper)"] == ("8,425", "0.71", "15,629", "1.32", "23,397", "1.98")
    assert rows["Average", "SHARP (paper)"] == ("11,532", "0.98", "19,433", "1.65", "27,967", "2.37")
    assert rows["Median time with Spackle (ms)", "SHARP"][::2] == ("2,828.0",) * 3
    assert rows["Median time overhead", "SHARP"][::2] == ("1.00%",) * 3
    assert expanded.label == "tab:expanded_efficiency_gaussian_overhead"
    assert len(expanded.lines) == 3 + 18
    ours, theirs = expanded.lines[0].cells, expanded.lines[1].cells
    assert ours[:6] == ("Middlebury", "S1", "SHARP", "10", "1.00", "1,010")
    assert ours[6:] == ("2,800.0", "2,828.0", "1.00%", "0.357", "0.354", "3/23")
    assert theirs[3:9] == ("3,387", "0.29", "1,183,035", "6,410.3†", "1,449.4", "-3.3%†")
    assert theirs[9:] == ("0.671†", "0.691", "23")
    assert sum("†" in "".join(line.cells) for line in expanded.lines) == 1
    assert stages.lines[0].cells[1] == "2,000.0 [1,500.0, 3,000.0]"
    for table in (overhead, expanded, stages):
        assert "A Processor, 2 cores, 2 threads" in table.caption
        assert any("1 of 4 images" in note and "broken" in note for note in table.notes)


def test_a_disparity_that_the_paper_has_not_stands_alone() -> None:
    tables = efficiency_tables(results((0.6,), warm=False, load=None), bench.count_parameters())
    assert tables[0].groups[1] == ("disparity 0.6", 2)
    assert {line.cells[2:] for line in tables[0].lines if "paper" in line.cells[1]} == {(EMPTY, EMPTY)}
    assert [line.cells[1] for line in tables[1].lines] == ["disparity 0.6"]
    assert any("it was not warm" in note for note in tables[1].notes)
    assert not any("Load" in note or "†" in note for note in tables[1].notes)


# --- timing


def test_a_view_costs_what_a_completion_adds() -> None:
    prediction, renderer = box_before_wall().lift(), get_renderer()
    completer = Completer(prediction.gaussians, prediction.camera, renderer)
    for view in large_views(prediction, (0.3, 0.5)):
        found = bench.time_view([0.25, 0.5, 4.0], completer, view.setting, view.camera, 3, CPU)
        assert found["added"] == len(completer.complete_view(view.camera)) > 0
        assert found["base_gaussians"] == len(prediction.gaussians)
        assert set(found["seconds"]) == set(STAGES)
        assert all(len(seconds) == 3 and min(seconds) > 0 for seconds in found["seconds"].values())
        figures = found["figures"]
        for path, parts in (("base_ms", BASE_PATH), ("extra_ms", EXTRA)):
            assert figures[path] == pytest.approx(sum(figures[f"{name}_stage_ms"] for name in parts))
    opaque = dataclasses.replace(prediction.gaussians, scales=3 * prediction.gaussians.scales)
    closed = Completer(opaque, prediction.camera, renderer)
    whole = bench.time_view([1.0], closed, "0", prediction.camera, 1, CPU)
    assert (whole["added"], whole["seconds"]["rerender"]) == (0, [0.0])  # a view without holes: no second render


# --- one image and the command


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two small scenes in Middlebury's folders."""
    root = tmp_path_factory.mktemp("middlebury")
    for seed, name in enumerate(("Ball", "Chair")):
        write_boxes(root / name, seed)
    return root


def bench_of(root: Path, output: Path, *more: object) -> Run:
    return run("bench", "--dataset", "middlebury", "--root", root, "--base", "rgbd", "-o", output, *more)


def read(output: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((output / "bench.json").read_text())
    return found


def test_points_suffice_infinite_gaussians_fail_an_image_and_a_memory_shortage_the_run(
    scenes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings: dict[str, Any] = {"methods": ("spackle",), "disparities": (0.3,), "metrics": (), "residual": "seeds"}
    tools = open_evaluation(EvaluateOptions("middlebury", scenes, base=BaseSettings("rgbd"), **settings))
    case, predict, once = (
        tools.cases[0],
        RgbdBase.predict,
        ({"base_runs": 1, "runs": 1, "base": {"device": "cpu"}}, True),
    )
    assert case.depth is not None
    known = case.depth()
    rows, columns = torch.nonzero(known.valid, as_tuple=True)
    points = Points(torch.stack([columns, rows], dim=-1) + 0.5, known.depth[rows, columns])
    found = bench.time_image(dataclasses.replace(case, depth=None, points=lambda: points), tools, *once)
    assert found["views"][0]["base_gaussians"] > 0
    with monkeypatch.context() as patch:  # a first prediction in a process does not count
        predictions: list[Any] = []
        patch.setattr(RgbdBase, "predict", lambda *words: predictions.append(words) or predict(*words))
        for warm, calls in ((False, 2), (True, 1)):
            predictions.clear()
            cold = bench.time_image(case, tools, once[0], warm)
            assert (len(predictions), len(cold["views"][0]["seconds"]["base"]), cold["facts"]["warm"]) == (
                calls,
                1,
                True,
            )
    with pytest.raises(InputError, match="no depth map and no points"):
        bench.time_image(dataclasses.replace(case, depth=None), tools, *once)

    def too_large(*arguments: Any) -> BasePrediction:
        found = predict(*arguments)
        endless = dataclasses.replace(found.gaussians, means=found.gaussians.means / 0)
        return dataclasses.replace(found, gaussians=endless)

    def too_little(*arguments: Any) -> BasePrediction:
        raise MemoryShort("not enough memory for the network")

    monkeypatch.setattr(RgbdBase, "predict", too_large)
    with pytest.raises(InputError, match="float32") as failed:
        bench.time_image(case, tools, *once)
    assert not isinstance(failed.value, BaseError)
    monkeypatch.setattr(RgbdBase, "predict", too_little)
    with pytest.raises(BaseError, match="not enough memory"):
        bench.time_image(case, tools, *once)


def test_from_files_to_tables_and_on(scenes: Path, tmp_path: Path) -> None:
    output, words = tmp_path / "out", ("--runs", 2, "--disparity", "0.3,0.5")
    done = bench_of(scenes, output, *words, "-v")
    assert done.code == 0, done.err
    assert names_in(output) == {"bench.json", "bench.md", "bench.tex", "config.json", "images"}
    found = read(output)
    assert found["parameters"]["residual"] == 8_021_376
    assert found["config"]["view"] == SIDE
    assert {"cpu", "cores", "threads"} <= found["config"]["hardware"].keys()
    assert "torch" in found["config"]["versions"]
    for image in found["images"]:
        assert [view["setting"] for view in image["views"]] == ["0.3", "0.5"]
        assert image["facts"]["warm"]
        for view in image["views"]:
            assert {len(runs) for runs in view["seconds"].values()} == {2}
            assert view["figures"]["merged"] == view["base_gaussians"] + view["added"] > view["base_gaussians"]
    text, tex = ((output / name).read_text() for name in ("bench.md", "bench.tex"))
    for label in ("efficiency_gaussian_overhead", "expanded_efficiency_gaussian_overhead", "efficiency_stages"):
        assert label in text
        assert label in tex
    assert "2/23" in text
    before = {path.name: path.stat().st_mtime_ns for path in (output / "images").iterdir()}
    (output / "bench.md").unlink()
    assert bench_of(scenes, output, *words).code == 0
    assert (output / "bench.md").read_text() == text
    assert before == {path.name: path.stat().st_mtime_ns for path in (output / "images").iterdir()}
    refused = bench_of(scenes, output, "--runs", 3, *words[2:])
    assert (refused.code, "runs: 2 -> 3" in refused.err) == (2, True)


def test_sharp_is_timed_once_and_a_broken_image_is_named(scenes: Path, tmp_path: Path) -> None:
    weights = write_tiny(tmp_path / "sharp.safetensors")
    for seed, name in enumerate(("Ball", "Chair")):
        write_boxes(tmp_path / "data" / name, seed)
    cut_off(tmp_path / "data" / "Chair" / "left.png")
    words = ("--runs", 1, "--disparity", "0.3", "--residual", "seeds")
    sharp = ("--base", "sharp", "-c", weights, "--precision", "fp32")
    done = bench_of(tmp_path / "data", tmp_path / "out", *words, *sharp)
    assert done.code == 0, done.err
    assert sum("passed over:" in line for line in done.lines) == 1
    found = read(tmp_path / "out")
    assert list(found["problems"]) == ["Chair"]
    assert str(tmp_path / "data") not in json.dumps(found)
    (view,) = found["images"][0]["views"]
    assert view["base_gaussians"] == gaussians_of(TINY)
    assert len(view["seconds"]["base"]) == 1
    assert not found["images"][0]["facts"]["warm"]  # the first prediction, which counts
    assert math.isfinite(view["figures"]["overhead"])
    assert "network in fp32 on" in (tmp_path / "out" / "bench.md").read_text()
    cut_off(tmp_path / "data" / "Ball" / "left.png")
    done = bench_of(tmp_path / "data", tmp_path / "none", "--runs", 1)
    assert (done.code, "none of 2 images gave figures" in done.err) == (2, True)


def cut_off(picture: Path) -> None:
    """The first half of its bytes."""
    whole = picture.read_bytes()
    picture.write_bytes(whole[: len(whole) // 2])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--dataset", "midlebury"), "did you mean middlebury?"),
        (("--base", "shrap"), "did you mean sharp?"),
        (("--disparity", "0.3,x"), "not numbers"),
        (("--disparity", "0.3,0.30"), "the same number twice"),
        (("--disparity", "0.3,3"), "up to 2"),
        (("--limit", "0"), "--limit must be between"),
        (("--runs", "0"), "--runs must be between"),
        (("--base-runs", "0"), "--base-runs must be between"),
        (("--residual", "gone.safetensors"), "not found"),
        (("-c", "x.pt"), "no checkpoint"),
        (("--precision", "fp8"), "--precision fp8"),
        (("--root", "gone"), "gone: no such folder"),
    ],
)
def test_bad_input_is_one_line(words: tuple[str, ...], message: str, scenes: Path, tmp_path: Path) -> None:
    done = bench_of(scenes, tmp_path / "out", *words)
    assert (done.code, len(done.lines)) == (2, 1)
    assert message in done.err
    assert not (tmp_path / "out").exists()
