"""`spackle bench`, of a dataset and `--suite`: counts, sums, layouts, the paper's numbers, folders, bad options."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import Run, names_in, run
from evaluation_data import write_boxes
from scenes import box_before_wall, same_bits
from sharp_weights import MICRO, gaussians_of, micro_network, write_tiny

from spackle.bases.lift import RgbdBase
from spackle.bases.open import BaseError, BaseSettings
from spackle.bases.protocol import BasePrediction
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.layers import TINY
from spackle.cli.options import INTERRUPTED
from spackle.device import MemoryShort
from spackle.errors import InputError
from spackle.evaluation import bench, paper
from spackle.evaluation import suite_sections as stages
from spackle.evaluation.case import Points
from spackle.evaluation.efficiency import BASE_PATH, EXTRA, STAGES, Efficiency, Record, efficiency_tables, view_cost
from spackle.evaluation.naive_renderer import naive_render
from spackle.evaluation.protocols import large_views
from spackle.evaluation.results import KINDS, begin
from spackle.evaluation.setup import EvaluateOptions, open_evaluation
from spackle.evaluation.suite import TITLES
from spackle.evaluation.suite_sections import SuiteRow, holed_scene, photo_scene
from spackle.evaluation.timing import complete_in_laps
from spackle.image import Photo
from spackle.render import CpuRenderer, get_renderer
from spackle.residual import ResidualNet, hole_area_ratio
from spackle.scene_fill import FillContext, fill_view

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
    assert (found["base"], found["residual"]) == (702_305_169, 8_023_153)
    assert round(found["base"] / 1e6, 2) == paper.PARAMETERS_M
    assert round(found["residual"] / 1e6, 2) == paper.ADDED_PARAMETERS_M
    assert round(100 * found["share"], 2) == paper.ADDED_PARAMETERS_PERCENT
    assert (found["base"] + found["residual"]) / 1e6 == pytest.approx(paper.MERGED_PARAMETERS_M, abs=0.01)
    assert 0.9 * found["base"] < found["base_used"] < found["base"]


def test_times_are_medians_of_runs_that_add_up_and_spread_over_the_measured_images() -> None:
    found = cost()["figures"]
    times = {"base_ms": 1400, "extra_ms": 14, "spackle_ms": 1414, "overhead": 0.01, "overhead_of_view": 14 / 400}
    assert {name: found[name] for name in times} == pytest.approx(times)
    assert found["base_fps"] == pytest.approx(1 / 1.4)
    assert (found["share"], found["merged"]) == (0.02, 1020)
    assert results().spread("0.4", "base_ms") == pytest.approx((3, 9800 / 3, 2100, 2800, 4200))


def test_the_layouts_are_the_papers() -> None:
    overhead, expanded, stages = efficiency_tables(results(), bench.count_parameters())
    assert [name for name, _ in overhead.groups] == ["", *(f"S{k}: disparity 0.{k + 2}" for k in (1, 2, 3))]
    rows = {line.cells[:2]: line.cells[2:] for line in overhead.lines}
    assert rows["Middlebury", "SHARP"] == ("10", "1.00") * 3
    assert rows["LLFF", "SHARP (paper)"] == ("8,425", "0.71", "15,629", "1.32", "23,397", "1.98")
    assert rows["Median time with Spackle (ms)", "SHARP"][::2] == ("2,828.0",) * 3
    assert rows["Median time overhead", "SHARP"][::2] == ("1.00%",) * 3
    assert len(expanded.lines) == 3 + 18
    ours, theirs = expanded.lines[0].cells, expanded.lines[1].cells
    assert ours[:6] == ("Middlebury", "S1", "SHARP", "10", "1.00", "1,010")
    assert ours[6:] == ("2,800.0", "2,828.0", "1.00%", "0.357", "0.354", "3/23")
    assert theirs[3:9] == ("3,387", "0.29", "1,183,035", "6,410.3†", "1,449.4", "-3.3%†")
    assert sum("†" in "".join(line.cells) for line in expanded.lines) == 1
    for table in (overhead, expanded, stages):
        assert "A Processor, 2 cores, 2 threads" in table.caption
        assert any("1 of 4 images" in note and "broken" in note for note in table.notes)


# --- timing


def test_a_view_costs_what_a_completion_adds() -> None:
    prediction, renderer = box_before_wall().lift(), get_renderer()
    context = FillContext(prediction.gaussians, prediction.camera, renderer)
    for view in large_views(prediction, (0.3, 0.5)):
        found = bench.time_view([0.25, 0.5, 4.0], context, view.setting, view.camera, 3, CPU)
        assert found["added"] == len(fill_view(context, view.camera).aux) > 0
        assert found["base_gaussians"] == len(prediction.gaussians)
        assert set(found["seconds"]) == set(STAGES)
        assert all(len(seconds) == 3 and min(seconds) > 0 for seconds in found["seconds"].values())
        figures = found["figures"]
        for path, parts in (("base_ms", BASE_PATH), ("extra_ms", EXTRA)):
            assert figures[path] == pytest.approx(sum(figures[f"{name}_stage_ms"] for name in parts))
    opaque = dataclasses.replace(prediction.gaussians, scales=3 * prediction.gaussians.scales)
    closed = FillContext(opaque, prediction.camera, renderer)
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
    return run("bench", root, "--dataset", "middlebury", "--base", "rgbd", "-o", output, *more)


def read(output: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((output / "bench.json").read_text())
    return found


def test_points_suffice_infinite_gaussians_fail_an_image_and_a_memory_shortage_the_run(
    scenes: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings: dict[str, Any] = {"methods": ("spackle",), "disparities": (0.3,), "metrics": (), "residual": "seeds"}
    tools = open_evaluation(EvaluateOptions("middlebury", scenes, base=BaseSettings("rgbd"), **settings))
    case, predict = tools.cases[0], RgbdBase.predict
    config = {"base_runs": 1, "runs": 1, "base": {"device": "cpu"}}
    assert case.depth is not None
    known = case.depth()
    rows, columns = torch.nonzero(known.valid, as_tuple=True)
    points = Points(torch.stack([columns, rows], dim=-1) + 0.5, known.depth[rows, columns])
    found = bench.time_image(dataclasses.replace(case, depth=None, points=lambda: points), tools, config, True)
    assert found["views"][0]["base_gaussians"] > 0
    with monkeypatch.context() as patch:  # a first prediction in a process does not count
        predictions: list[Any] = []
        patch.setattr(RgbdBase, "predict", lambda *words: predictions.append(words) or predict(*words))
        for warm, calls in ((False, 2), (True, 1)):
            predictions.clear()
            found = bench.time_image(case, tools, config, warm)
            assert (len(predictions), len(found["views"][0]["seconds"]["base"])) == (calls, 1)
            assert found["facts"]["warm"]
    with pytest.raises(InputError, match="no depth map and no points"):
        bench.time_image(dataclasses.replace(case, depth=None), tools, config, True)

    def too_large(*arguments: Any) -> BasePrediction:
        found = predict(*arguments)
        endless = dataclasses.replace(found.gaussians, means=found.gaussians.means / 0)
        return dataclasses.replace(found, gaussians=endless)

    def too_little(*arguments: Any) -> BasePrediction:
        raise MemoryShort("not enough memory for the network")

    monkeypatch.setattr(RgbdBase, "predict", too_large)
    with pytest.raises(InputError, match="float32") as failed:
        bench.time_image(case, tools, config, True)
    assert not isinstance(failed.value, BaseError)
    monkeypatch.setattr(RgbdBase, "predict", too_little)
    with pytest.raises(BaseError, match="not enough memory"):
        bench.time_image(case, tools, config, True)


def test_from_files_to_tables_and_on(scenes: Path, tmp_path: Path) -> None:
    output, words = tmp_path / "out", ("--runs", 2, "--disparity", "0.3,0.5")
    done = bench_of(scenes, output, *words, "-v")
    assert done.code == 0, done.err
    assert names_in(output) == {"bench.json", "bench.md", "bench.tex", "config.json", "images"}
    found = read(output)
    assert found["parameters"]["residual"] == 8_023_153
    for image in found["images"]:
        assert [view["setting"] for view in image["views"]] == ["0.3", "0.5"]
        assert image["facts"]["warm"]
        for view in image["views"]:
            assert {len(runs) for runs in view["seconds"].values()} == {2}
            assert view["figures"]["merged"] == view["base_gaussians"] + view["added"] > view["base_gaussians"]
    text = (output / "bench.md").read_text()
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
    (tmp_path / "data" / "Chair" / "left.png").write_bytes(b"no picture")
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
    (tmp_path / "data" / "Ball" / "left.png").write_bytes(b"no picture")
    done = bench_of(tmp_path / "data", tmp_path / "none", "--runs", 1)
    assert (done.code, "none of 2 images gave figures" in done.err) == (2, True)


SIDE = 64
PEAKS = {stages.PRODUCT.format("fp32"): 1e6, stages.PRODUCT.format("bf16"): 4e6, stages.COPY: 2e6}


def rows_of(section: stages.Section) -> dict[str, SuiteRow]:
    return {row.name: row for row in section[0]}


# --- sections


def test_the_renderers_section_has_all_stages_and_the_naive_renderer_draws_what_ours_draws() -> None:
    section = stages.renderer_section(2, SIDE, PEAKS)
    found, facts = rows_of(section), section[1]
    whole, naive = "whole call: RGB, depth, alpha", "naive: whole call"
    names = [*stages.RENDER_STAGES, *(f"naive: {stage}" for stage in stages.RENDER_STAGES), whole, naive]
    assert all(len(found[name].values) == 2 and min(found[name].values) > 0 for name in names)
    assert found["naive over ours"].values == pytest.approx(found[naive].values / found[whole].values)
    scene, camera = photo_scene(SIDE)
    difference = (CpuRenderer().render(scene, camera).rgb - naive_render(scene, camera)).abs()
    assert float(difference.mean()) < 1e-5
    assert float(difference.amax()) < 0.02
    assert facts["gaussians"] == (count := len(scene)) == SIDE * SIDE // 2
    assert found[whole].limit_ms == pytest.approx((count * 56 + SIDE * SIDE * 20) / 2e6)


def test_what_completion_adds_to_a_view_with_holes_is_the_sum_of_its_stages() -> None:
    torch.manual_seed(0)
    network = ResidualNet().eval().requires_grad_(False)
    base, camera = holed_scene(96)
    assert hole_area_ratio(CpuRenderer().render(base, camera).alpha) == 0
    disparity, view = stages.find_view(base, camera, CpuRenderer())
    assert 0 < disparity < 0.5
    assert hole_area_ratio(CpuRenderer().render(base, view).alpha) == pytest.approx(0.05, rel=0.05)
    with pytest.raises(InputError, match="no view"):
        stages.find_view(base, camera, CpuRenderer(), 0.999)
    section = stages.completion_section(2, base, camera, CpuRenderer(), network)
    found, facts = rows_of(section), section[1]
    added = found["added time"].values
    assert added == pytest.approx(found["mask, seeds, network, placing"].values + found["redraw"].values)
    assert found["added time over base render"].values == pytest.approx(added / found["base render of the view"].values)
    assert (facts["disparity"], facts["holes"]) == (disparity, pytest.approx(0.05, rel=0.05))
    context = FillContext(base, camera, CpuRenderer(), network)
    whole = fill_view(context, view).aux
    assert same_bits(complete_in_laps(context, view, lambda name: None), whole)
    assert facts["added"] == len(whole) > 0


def test_a_video_in_one_scene_and_frame_by_frame() -> None:
    section = stages.video_section(1, box_before_wall(width=64, height=48).lift, CpuRenderer(), None, frames=4)
    found = {name: float(row.values[0]) for name, row in rows_of(section).items()}
    same = found[stages.LIFT] + found[stages.ENCODE] + found[stages.EACH]
    anew, whole = found["frame by frame: photo to video"], found["one scene: photo to video"]
    assert anew == pytest.approx(same + found[stages.GUARDS])
    assert found["frame by frame over one scene"] == pytest.approx(anew / whole)
    once = (same + found[stages.GUARDS] / 4) / whole
    assert found["the same, the photo's occlusion guard made once"] == pytest.approx(once)
    assert section[1]["added"] > 0


def test_sharp_in_its_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    photo = Photo(torch.rand(MICRO.side, MICRO.side, 3), 1.2 * MICRO.side, "", Path("photo.png"))
    section = stages.sharp_section(1, SharpBase(micro_network(), weights="micro"), photo, PEAKS)
    found, facts = rows_of(section), section[1]
    assert facts["gaussians"] == gaussians_of(MICRO)
    assert (found[stages.FORWARD].limit_ms or 0) > 1e3  # 1e9 operations at 1e6 a millisecond
    assert found["photo to scene"].values[0] >= found[stages.FORWARD].values[0]

    def no_compiler(*arguments: object) -> Any:
        raise RuntimeError("no compiler\nanywhere")

    monkeypatch.setattr("spackle.bases.sharp.base.compile_forward", lambda network: no_compiler)
    _, facts = stages.sharp_section(1, SharpBase(micro_network(), compiled=True, windows=9), photo, PEAKS)
    assert (facts["windows"], facts["compile_problem"]) == (9, "no compiler anywhere")


# --- the command


def test_sections_are_measured_once_and_gathered(tmp_path: Path) -> None:
    output, answers = tmp_path / "out", iter([False, True])
    words = ("bench", "--suite", "--side", SIDE, "--runs", 1, "--device", "cpu", "-o", output)

    @contextlib.contextmanager
    def stopping(alone: bool) -> Iterator[Any]:
        yield lambda: next(answers)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spackle.evaluation.suite.asked_to_stop", stopping)
        done = run(*words, "--only", "renderer,sharp")
    assert (done.code, "the same command goes on" in done.err) == (INTERRUPTED, True)
    assert names_in(output) == {"config.json", "sections"}
    first = (output / "sections" / "limits.json").read_bytes()
    done = run(*words, "--only", "renderer,sharp")
    assert done.code == 0, done.err
    assert names_in(output) == {"config.json", "sections", "suite.json", "suite.md"}
    assert names_in(output / "sections") == {"limits.json", "renderer.json"}
    assert (output / "sections" / "limits.json").read_bytes() == first
    found = json.loads((output / "suite.json").read_text())
    assert set(found["sections"]) == {"limits", "renderer"}
    assert "no weights" in found["not_run"]["sharp"]
    assert found["not_run"]["video"] == "not asked for (--only)"
    assert {"commit", "hardware", "versions"} <= found["config"].keys()
    row = next(row for row in found["sections"]["renderer"]["rows"] if row["name"] == "whole call: RGB, depth, alpha")
    assert row["limit_ms"] > 0
    assert row["median"] == pytest.approx(np.median(row["values"]))
    text = (output / "suite.md").read_text()
    assert all(f"**{name}.**" in text or f"| {name} | " in text for name in TITLES)
    other = json.loads((output / "sections" / "renderer.json").read_text()) | {"inputs": {"weights": "others"}}
    (output / "sections" / "sharp.json").write_text(json.dumps(other))
    assert run(*words, "--only", "renderer").code == 0
    kept = json.loads((output / "suite.json").read_text())["sections"]
    assert kept.keys() == {"limits", "renderer", "sharp"}  # what is not asked for stays, whatever its weights were
    refused = run(*words[:3], 32 + SIDE, *words[4:])
    assert (refused.code, f"side: {SIDE} -> {32 + SIDE}" in refused.err) == (2, True)


@pytest.mark.parametrize("kind", KINDS)
def test_a_folder_belongs_to_one_configuration_of_one_command(tmp_path: Path, kind: str | None) -> None:
    def config(runs: int, of: str | None = kind) -> dict[str, Any]:
        return {"runs": runs} | ({} if of is None else {"kind": of})

    for _ in range(2):  # the second one goes on
        begin(tmp_path, config(1), "parts")
    assert names_in(tmp_path) == {"config.json", "parts"}
    with pytest.raises(InputError, match=rf"holds {KINDS[kind][1]} of another kind \(runs: 1 -> 2\)"):
        begin(tmp_path, config(2), "parts")
    for other in KINDS.keys() - {kind}:
        with pytest.raises(InputError, match=rf"config\.json: not of `spackle {KINDS[other][0]}`"):
            begin(tmp_path, config(1, other), "parts")
    (tmp_path / "config.json").write_text("[]")
    with pytest.raises(InputError, match=r"config\.json: not of"):
        begin(tmp_path, config(1), "parts")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "FOLDER or --dataset missing: give FOLDER --dataset NAME, or --suite"),
        (("--suite", "--dataset", "middlebury"), "--dataset is not for --suite"),
        (("--dataset", "middlebury", "--root", ".", "--only", "limits"), "--only is for --suite alone"),
        (("--suite", "--only", "rendrer"), "did you mean renderer?"),
        (("--suite", "--runs", "0"), "--runs must be between"),
        (("--suite", "--side", "7"), "--side must be an even number"),
        (("--suite", "--base", "lite"), "--base lite: the suite times no other base than sharp"),
        (("--suite", "--precision", "fp8", "--base", "sharp"), "--precision"),
        (("--suite", "--residual", "gone.safetensors"), "--residual gone.safetensors: no such file"),
        (("--suite", "--sharp", "windows=7"), "--sharp is of SHARP, which is not timed"),
        (("--suite", "--base", "sharp", "--sharp", "windows=0"), "--sharp windows must be between 1 and 35, got 0"),
        (("--suite", "words"), "words: a folder is not for --suite"),
        (("one", "two", "--dataset", "middlebury"), "two: a word of no option"),
        (("one", "--dataset", "middlebury", "--root", "two"), "one: a word of no option"),
        (("--dataset", "middlebury", "--base", "rgbd", "--root", "gone"), "gone: no such folder"),
    ],
)
def test_bad_options_are_one_line(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    done = run("bench", *words, "-o", tmp_path / "out")
    assert (done.code, len(done.lines)) == (2, 1)
    assert message in done.err
    assert not (tmp_path / "out").exists()
