"""`spackle bench --suite`: what is timed is what the package does; the command, its folder and its options."""

from __future__ import annotations

import contextlib
import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command import names_in, run
from scenes import box_before_wall, same_bits
from sharp_weights import MICRO, gaussians_of, micro_network

from spackle.bases.sharp import SharpBase
from spackle.cli.options import INTERRUPTED
from spackle.errors import InputError
from spackle.evaluation import suite_sections as stages
from spackle.evaluation.naive_renderer import naive_render
from spackle.evaluation.results import KINDS, begin
from spackle.evaluation.suite import TITLES, plain_row, suite_tables
from spackle.evaluation.suite_sections import Row, count_flops, holed_scene, photo_scene
from spackle.evaluation.timing import TOTAL, complete_in_laps, measure
from spackle.image import Photo
from spackle.render import CpuRenderer
from spackle.residual import Completer, ResidualNet, hole_area_ratio

SIDE = 64
PEAKS = {stages.PRODUCT.format("fp32"): 1e6, stages.PRODUCT.format("bf16"): 4e6, stages.COPY: 2e6}


def rows_of(section: stages.Section) -> dict[str, Row]:
    return {row.name: row for row in section[0]}


# --- timing and limits


def test_tasks_take_turns_and_their_laps_add_up() -> None:
    order: list[str] = []

    def task(name: str) -> Any:
        def work(lap: Any) -> None:
            order.append(name)
            lap("one")
            lap("two")
            lap("one")

        return work

    times = measure(2, {"a": task("a"), "b": task("b")})
    assert order == ["a", "b"] * 3
    assert {len(values) for values in times.values()} == {2}
    assert set(times) == {(task, lap) for task in "ab" for lap in ("one", "two", TOTAL)}
    for name in "ab":
        for one, two, total in zip(*(times[name, lap] for lap in ("one", "two", TOTAL)), strict=True):
            assert 0 < one + two <= total
    assert len(measure(2, {"a": task("a")}, warm=True)["a", TOTAL]) == 2
    assert order[6:] == ["a", "a"]


def test_torch_counts_operations() -> None:
    a, b, q = torch.rand(3, 5), torch.rand(5, 7), torch.rand(1, 2, 8, 4)
    assert count_flops(lambda: a @ b) == 2 * 3 * 5 * 7
    assert count_flops(lambda: torch.nn.functional.scaled_dot_product_attention(q, q, q)) == 2 * (2 * 2 * 8 * 8 * 4)


def test_limits_are_rates_and_stand_beside_the_rows_that_they_hold_for() -> None:
    rows = stages.limits_section(2, share=1 / 128)[0]
    assert [row.unit for row in rows] == ["GFLOP/s", "GFLOP/s", "GB/s"]
    assert all(len(row.values) == stages.LIMIT_RUNS and min(row.values) > 0 for row in rows)
    row = plain_row(Row("call", np.array([6.0, 8.0, 10.0]), limit_ms=2.0))
    table, missing = suite_tables({"renderer": {"rows": [row], "facts": {}}}, {"video": "no photo"})
    assert table.lines[0].cells == ("call", "8.00 ms", "7.00 – 9.00", "3", "2.00 ms", "4.0×")
    assert missing.lines[0].cells == ("video", TITLES["video"], "not run: no photo")


# --- sections


def test_the_naive_renderer_draws_what_ours_draws() -> None:
    scene, camera = photo_scene(SIDE)
    difference = (CpuRenderer().render(scene, camera).rgb - naive_render(scene, camera)).abs()
    assert float(difference.mean()) < 1e-5
    assert float(difference.amax()) < 0.02


def test_the_renderers_section_has_all_stages() -> None:
    section = stages.renderer_section(2, SIDE, PEAKS)
    found, facts = rows_of(section), section[1]
    names = [*stages.RENDER_STAGES, *(f"naive: {stage}" for stage in stages.RENDER_STAGES), stages.CALL]
    assert all(len(found[name].values) == 2 and min(found[name].values) > 0 for name in names)
    assert found[stages.NAIVE_RATIO].values == pytest.approx(
        found["naive: whole call"].values / found[stages.CALL].values
    )
    count = SIDE * SIDE // 2
    assert facts["gaussians"] == count
    assert found[stages.CALL].limit_ms == pytest.approx((count * 56 + SIDE * SIDE * 20) / 2e6)


def test_the_disparity_is_found_at_which_a_share_is_holes() -> None:
    base, camera = holed_scene(96)
    disparity, view = stages.find_view(base, camera, CpuRenderer())
    assert hole_area_ratio(CpuRenderer().render(base, view).alpha) == pytest.approx(0.05, rel=0.05)
    assert 0 < disparity < 0.5
    assert hole_area_ratio(CpuRenderer().render(base, camera).alpha) == 0
    with pytest.raises(InputError, match="no view"):
        stages.find_view(base, camera, CpuRenderer(), 0.999)


def test_what_completion_adds_is_the_sum_of_its_stages() -> None:
    torch.manual_seed(0)
    network = ResidualNet().eval().requires_grad_(False)
    base, camera = holed_scene(96)
    section = stages.completion_section(2, base, camera, CpuRenderer(), network)
    found, facts = rows_of(section), section[1]
    added = found[stages.ADDED].values
    assert added == pytest.approx(found[stages.PLACE].values + found[stages.REDRAW].values)
    assert found[stages.IN_RENDERS].values == pytest.approx(added / found[stages.RENDER].values)
    assert facts["holes"] == pytest.approx(0.05, rel=0.05)
    view = stages.find_view(base, camera, CpuRenderer())[1]
    completer = Completer(base, camera, CpuRenderer(), network)
    whole = completer.complete_view(view)
    assert same_bits(complete_in_laps(completer, view, lambda name: None), whole)
    assert facts["added"] == len(whole) > 0


def test_a_video_in_one_scene_and_frame_by_frame() -> None:
    section = stages.video_section(1, box_before_wall(width=64, height=48).lift, CpuRenderer(), None, frames=4)
    found = {name: float(row.values[0]) for name, row in rows_of(section).items()}
    same = found[stages.LIFT] + found[stages.ENCODE] + found[stages.EACH]
    assert found[stages.SCRATCH] == pytest.approx(same + found[stages.SHIELDS])
    assert found[stages.SCENE_RATIO] == pytest.approx(found[stages.SCRATCH] / found[stages.SCENE])
    assert found[stages.KEPT_RATIO] == pytest.approx((same + found[stages.SHIELDS] / 4) / found[stages.SCENE])
    assert section[1]["added"] > 0


def test_sharp_in_its_stages(monkeypatch: pytest.MonkeyPatch) -> None:
    photo = Photo(torch.rand(MICRO.side, MICRO.side, 3), 1.2 * MICRO.side, "", Path("photo.png"))
    section = stages.sharp_section(1, SharpBase(micro_network(), weights="micro"), photo, PEAKS)
    found, facts = rows_of(section), section[1]
    assert facts["gaussians"] == gaussians_of(MICRO)
    assert (found[stages.FORWARD].limit_ms or 0) > 1e3  # 1e9 operations at 1e6 a millisecond
    assert found[stages.WHOLE].values[0] >= found[stages.FORWARD].values[0]

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
    row = next(row for row in found["sections"]["renderer"]["rows"] if row["name"] == stages.CALL)
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
        ((), "--dataset and --root missing: give --dataset NAME --root DIR, or --suite"),
        (("--dataset", "middlebury"), "--root missing"),
        (("--suite", "--dataset", "middlebury"), "--dataset is not for --suite"),
        (("--suite", "--disparity", "0.3"), "--disparity is not for --suite"),
        (("--dataset", "middlebury", "--root", ".", "--only", "limits"), "--only is for --suite alone"),
        (("--suite", "--only", "rendrer"), "did you mean renderer?"),
        (("--suite", "--runs", "0"), "--runs must be between"),
        (("--suite", "--side", "7"), "--side must be an even number"),
        (("--suite", "--side", "0"), "--side must be an even number"),
        (("--suite", "--base", "lite"), "--base lite: the suite times no other base than sharp"),
        (("--suite", "-c", "gone.pt"), "-c gone.pt: no such file"),
        (("--suite", "--precision", "fp8", "--base", "sharp"), "--precision fp8"),
        (("--suite", "--residual", "gone.safetensors"), "--residual gone.safetensors: no such file"),
        (("--suite", "--device", "tpu"), "--device tpu"),
        (("--suite", "--windows", "7"), "--windows is of SHARP, which is not timed"),
        (("--suite", "--base", "sharp", "--windows", "0"), "--windows must be between 1 and 35, got 0"),
        (("--dataset", "middlebury", "--root", ".", "--windows", "7"), "--windows is for --suite alone"),
        (("--suite", "words"), "a word of no option"),
    ],
)
def test_bad_options_are_one_line(words: tuple[str, ...], message: str, tmp_path: Path) -> None:
    done = run("bench", *words, "-o", tmp_path / "out")
    assert (done.code, len(done.lines)) == (2, 1)
    assert message in done.err
    assert not (tmp_path / "out").exists()


def test_operators_that_exist_are_not_declared_again(tmp_path: Path) -> None:
    path = Path(__file__).parents[2] / "benchmarks" / "sharp.py"
    spec = importlib.util.spec_from_file_location("benchmark_of_sharp", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (tmp_path / "_meta_registrations.py").write_text('@register_meta("roi")\n@register_fake("torchvision::nms")\n')
    with torch.library._scoped_library("spackle_test", "DEF") as library:
        library.define("nms(Tensor x) -> Tensor")
        assert module.declare_operators(tmp_path, "spackle_test") == ["roi"]
        assert module.declare_operators(tmp_path, "spackle_test") == []
