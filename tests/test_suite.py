"""`spackle bench --suite`: what is counted against counts by hand, what is timed against what the package does."""

from __future__ import annotations

import dataclasses
import itertools
import json
from typing import Any
from xml.etree import ElementTree

import gsplat_stand_in
import numpy as np
import pytest
import torch
from scenes import box_before_wall, same_bits
from sharp_weights import MICRO, gaussians_of, micro_network

from spackle.bases.sharp import SharpBase
from spackle.errors import InputError
from spackle.evaluation.suite import counts, gpu, limits, tables
from spackle.evaluation.suite.arithmetic import operations_of
from spackle.evaluation.suite.clock import CPU, TOTAL, measure
from spackle.evaluation.suite.completion import ADDED, IN_RENDERS, STAGES, completion_section
from spackle.evaluation.suite.fill import RENDER, HoledView, check_fill, fill, find_view
from spackle.evaluation.suite.flops import counted
from spackle.evaluation.suite.limits import Peaks, limits_section
from spackle.evaluation.suite.naive import naive_render
from spackle.evaluation.suite.plot import scaling_svg
from spackle.evaluation.suite.renderer import CALL, band, renderer_section
from spackle.evaluation.suite.scaling import GAUSSIANS, PIXELS, exponent, scaling_section
from spackle.evaluation.suite.scenes import holed_scene, photo_scene
from spackle.evaluation.suite.sharp import COMPILED as SHARP_COMPILED
from spackle.evaluation.suite.sharp import FORWARD, sharp_section
from spackle.evaluation.suite.tables import suite_tables, targets
from spackle.evaluation.suite.training import RATE, STEP, training_section
from spackle.evaluation.suite.values import Found, Need, Row, Target
from spackle.evaluation.suite.video import EACH, LIFT, RATIO, RATIO_KEPT, SCENE, SCRATCH, SHIELDS, video_section
from spackle.evaluation.table import to_markdown
from spackle.gaussians import Gaussians
from spackle.render import CpuRenderer, GsplatRenderer
from spackle.render.blend import STATE, alpha_of, blend_patch, blend_splats, encode_srgb, exp2, is_full, span_of
from spackle.render.pipeline import draw, wanted_tiles
from spackle.render.project import HALF_HEIGHT, HALF_WIDTH, KernelCamera, X, Y, cover, natural_log, pack_block
from spackle.residual import ResidualNet, hole_area_ratio
from spackle.residual.network import IN_CHANNELS, compile_network

SIDE = 64
PEAKS = Peaks({"fp32": 1e9, "fp64": 5e8, "bf16": 4e9}, 1e9)


# --- what is counted


def test_operations_are_those_in_the_source() -> None:
    def sample(a: float, b: Any, i: int) -> float:
        x = a * a - 2.0 * 3.0  # two: the product of constants is the compiler's
        b[i + 1] += max(x, a) if x < 0 else np.float32(i) / a  # four
        k = i + np.uint64(2 * i)  # none
        return x + b[k]  # one

    assert operations_of(sample, frozenset({"i"})) == 2 + 4 + 1


def test_the_blenders_operations_counted_by_hand() -> None:
    # alpha: from the centre 6, power 6, clamps and test 3, 2^x: rounding 3 and a polynomial 10
    # light: 1 - alpha, times light, full?, weight; five planes: four products, five sums
    assert operations_of(exp2) == 3 + 10
    assert operations_of(alpha_of) == 3
    assert operations_of(blend_patch, counts.INTEGERS) == 6 + 6 + 4 + 9
    assert counts.pixel_operations() == 41
    assert operations_of(encode_srgb) == 2 + 2 + 2 + 16 + 3
    assert counts.finish_operations() == 77


def test_the_projections_needs_counted_by_hand() -> None:
    need = counts.project_need(10, 4)
    assert need.bytes == 10 * 56 + 4 * (48 + 8 + 4 + 4)
    behind = counts.project_need(1, 0).operations["fp64"]
    assert behind == 10
    # A side of the box: centre ± extent ± slack, four clamps, is it whole?; the light: three, their sum, the test.
    assert operations_of(cover, counts.INTEGERS) == 4 + 4 + 1
    assert operations_of(pack_block, counts.INTEGERS | counts.EDGES) == 3 + 2 + 1
    assert operations_of(natural_log, counts.INTEGERS) == 3 + 1 + 16 + 1 + 5
    assert 200 < counts.project_need(1, 1).operations["fp64"] < 260
    assert counts.sort_need(5).bytes == 3 * 2 * 8 * 5
    assert counts.bin_need(5, 7, 2).bytes == 5 * 12 + 7 * 4 + 2 * 8
    assert not counts.sort_need(5).operations


def test_patches_that_are_drawn_are_counted_as_a_plain_loop_counts_them() -> None:
    scene, camera = photo_scene(SIDE)
    scene = dataclasses.replace(scene, scales=5 * scene.scales, opacities=0.1 + 0.9 * scene.opacities)  # full tiles
    view = KernelCamera.of(camera, 0.0)
    drawing = draw([scene], view, wanted_tiles(view, None), None)
    found = counts.walked(drawing)
    records, patches, splats = drawing.splats.records, 0, 0
    for tile in range(drawing.wanted.size):
        left, top = (tile % view.tiles[1]) * 16, (tile // view.tiles[1]) * 16
        state = np.zeros(STATE, np.float32)
        state[:256] = 1
        mine = drawing.lists.ids[drawing.lists.starts[tile] : drawing.lists.starts[tile + 1]]
        for number, index in enumerate(mine):
            blend_splats(state, records[index : index + 1], 1, left, top)
            splats += 1
            record = records[index]
            top_row, last_row = span_of(record[Y] - np.float32(top) - np.float32(0.5), record[HALF_HEIGHT])
            left_column, last_column = span_of(record[X] - np.float32(left) - np.float32(0.5), record[HALF_WIDTH])
            pixels = itertools.product(range(top_row, last_row), range(left_column, last_column))
            patches += len({(row // 4, column // 4) for row, column in pixels})
            if number % 16 == 15 and is_full(state):
                break
    assert (found.splats, found.patches) == (splats, patches)
    assert 0 < found.splats < 0.9 * len(drawing.lists.ids)
    need = counts.drawing_needs([scene], view)["blend"]
    assert need.operations["fp32"] == found.patches * 16 * 41 + SIDE * SIDE * 77
    visible = len(np.unique(drawing.lists.ids))
    assert need.bytes == len(drawing.lists.ids) * 4 + visible * 48 + SIDE * SIDE * 20


def test_networks_are_counted_by_torch() -> None:
    a, b = torch.rand(3, 5), torch.rand(5, 7)
    assert counted(lambda: a @ b) == 2 * 3 * 5 * 7
    q = torch.rand(1, 2, 8, 4)
    assert counted(lambda: torch.nn.functional.scaled_dot_product_attention(q, q, q)) == 2 * (2 * 2 * 8 * 8 * 4)


def test_the_larger_of_two_limits_is_the_gap() -> None:
    need = Need(2e6, {"fp32": 1e6, "fp64": 1e6})
    assert PEAKS.least_ms(need) == (pytest.approx(1 + 2), pytest.approx(2))
    double = need + need
    assert (double.bytes, dict(double.operations)) == (4e6, {"fp32": 2e6, "fp64": 2e6})
    found = {
        "limits": Found(
            (
                *(Row(limits.PRODUCT.format(k), (1.0,), "GFLOP/s") for k in limits.KINDS),
                Row(limits.COPY, (1.0,), "GB/s"),
            )
        ),
        "scaling": Found((Row("call", (6.0, 8.0, 10.0), need=Need(2e6, {"fp32": 1e6})),)),
    }
    table = next(t for t in suite_tables(found, {}) if t.label == "scaling")
    assert table.lines[0].cells == ("call", "8.00 ms", "7.00 – 9.00", "3", "", "1.00 ms", "2.00 ms", "4.0×")


def test_peaks_are_the_best_of_several_runs() -> None:
    found = limits_section(2, CPU, side=16, megabytes=0.1)
    assert {len(row.values) for row in found.rows} == {limits.RUNS}
    peaks = Peaks.of(found)
    assert peaks.bytes == 1e9 * max(found.row(limits.COPY).values) > 0
    assert set(peaks.operations) == set(limits.KINDS)


# --- what is timed


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
    assert len(measure(2, {"a": task("a")}, warm=True)["a", TOTAL]) == 2
    assert order[6:] == ["a", "a"]
    assert set(times) == {(task, lap) for task in "ab" for lap in ("one", "two", TOTAL)}
    for name in "ab":
        for one, two, total in zip(*(times[name, lap] for lap in ("one", "two", TOTAL)), strict=True):
            assert 0 < one + two <= total


def test_the_naive_renderer_draws_what_ours_draws() -> None:
    scene, camera = photo_scene(SIDE)
    difference = (CpuRenderer().render(scene, camera).rgb - naive_render(scene, camera)).abs()
    assert float(difference.mean()) < 1e-5
    assert float(difference.amax()) < 0.02


def test_the_renderers_section_has_all_stages_and_a_band_on_top() -> None:
    found = renderer_section(2, SIDE)
    assert found.facts["gaussians"] == SIDE * SIDE // 2
    call = found.row(CALL)
    parts = [found.row(name) for name in ("project", "sort", "bin", "blend")]
    assert all(len(row.values) == 2 and min(row.values) > 0 for row in found.rows)
    assert call.need is not None
    assert call.need.bytes == sum(part.need.bytes for part in parts if part.need)
    scene, camera = photo_scene(SIDE)
    added = band(scene, camera)
    assert sum(map(len, added)) == found.facts["redraw_gaussians"] == pytest.approx(0.05 * len(scene), rel=0.4)
    assert 0 < found.facts["redraw_tiles"] < (SIDE // 16) ** 2


def test_an_exponent_is_a_slope_between_logarithms() -> None:
    assert exponent([1, 2, 4], [3, 12, 48]) == pytest.approx(2)
    found = scaling_section(1, SIDE)
    for what in (GAUSSIANS, PIXELS):
        sizes = found.facts[what]
        assert sizes[-1] / sizes[0] == pytest.approx(32, rel=0.2)
        medians = [found.row(f"{size:,} {what}").median for size in sizes]
        assert found.row(f"exponent of {what}").median == pytest.approx(exponent(sizes, medians))
    pytest.importorskip("matplotlib")
    svg = scaling_svg(found)
    parts = list(ElementTree.fromstring(svg).iter())
    written = [part.text or "" for part in parts if part.tag.endswith("}text")]
    for what in (GAUSSIANS, PIXELS):
        assert any(what in text and f"{found.row(f'exponent of {what}').median:.2f}" in text for text in written)
    assert sum(part.tag.endswith("}use") and "fill: #" in part.get("style", "") for part in parts) == 12 + 2


def test_the_disparity_is_found_at_which_a_share_is_holes() -> None:
    base, camera = holed_scene(96)
    disparity, view = find_view(base, camera, CpuRenderer(), 0.05)
    assert hole_area_ratio(CpuRenderer().render(base, view).alpha) == pytest.approx(0.05, rel=0.05)
    assert 0 < disparity < 0.5
    assert hole_area_ratio(CpuRenderer().render(base, camera).alpha) == 0
    with pytest.raises(InputError, match="no view"):
        find_view(base, camera, CpuRenderer(), 0.999)


@pytest.fixture(scope="module")
def network() -> ResidualNet:
    torch.manual_seed(0)
    return ResidualNet().eval().requires_grad_(False)


@pytest.fixture(scope="module")
def completed(network: ResidualNet) -> Found:
    return completion_section(1, *holed_scene(96), CpuRenderer(), network)


def test_the_stages_are_the_completers(network: ResidualNet, monkeypatch: pytest.MonkeyPatch) -> None:
    base, camera = holed_scene(96)
    renderer = CpuRenderer()
    view = HoledView(base, camera, find_view(base, camera, renderer, 0.05)[1], renderer, network)
    shield = view.completer.photo_guard()
    looks, rendering = check_fill(view, shield)
    aux, expected = view.completer.completed_view(view.camera, [shield])
    assert same_bits(Gaussians.cat([look.new for look in looks]), aux)
    assert same_bits(rendering, expected)
    assert looks[0].rim is not None
    laps: list[str] = []
    fill(view, shield, laps.append)
    assert laps == [RENDER, *STAGES * len(looks)]
    monkeypatch.setattr("spackle.evaluation.suite.fill.PASSES", 0)
    with pytest.raises(RuntimeError, match="not those of the completer"):
        check_fill(view, shield)


def test_what_completion_adds_is_the_sum_of_its_stages(completed: Found) -> None:
    added, stages = completed.row(ADDED), [completed.row(name) for name in STAGES]
    assert added.values[0] == pytest.approx(sum(stage.values[0] for stage in stages))
    assert completed.row(IN_RENDERS).values[0] == pytest.approx(added.values[0] / completed.row(RENDER).values[0])
    assert completed.facts["holes"] == pytest.approx(0.05, rel=0.05)
    assert completed.facts["added"] > 0
    whole, crops = (completed.row(f"network, fp32, {where}").need for where in ("whole picture", "around the holes"))
    assert whole is not None
    assert crops is not None
    assert whole.operations["fp32"] >= crops.operations["fp32"] > 1e9
    assert whole.bytes == 4 * 8_021_376
    assert any("--compile" in note for note in completed.notes)


def test_a_compiled_network_says_the_same() -> None:
    wild = ResidualNet().eval().requires_grad_(False)
    for weight in wild.parameters():
        torch.nn.init.normal_(weight, std=0.05)
    twin = compile_network(wild, backend="eager")
    assert twin.compiled
    assert not wild.compiled
    features = torch.rand(1, IN_CHANNELS, 33, 17)
    with torch.no_grad():
        torch.testing.assert_close(twin(features), wild(features), rtol=1e-4, atol=1e-4)
    assert twin is not wild
    assert all(a is b for a, b in zip(twin.parameters(), wild.parameters(), strict=True))
    assert wild._compiled_call_impl is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # PyTorch's own, of what it uses itself
def test_a_translated_network_says_the_same() -> None:
    wild = ResidualNet().eval().requires_grad_(False)
    for weight in wild.parameters():
        torch.nn.init.normal_(weight, std=0.05)
    twin = compile_network(wild)
    with torch.no_grad():
        for size in ((16, 24), (33, 17), (64, 80)):
            features = torch.rand(1, IN_CHANNELS, *size)
            torch.testing.assert_close(twin(features), wild(features), rtol=1e-3, atol=1e-3)


def test_a_video_in_one_scene_and_frame_by_frame() -> None:
    scene = box_before_wall(width=64, height=48)
    found = video_section(1, scene.lift, CpuRenderer(), None, frames=4)
    names = (LIFT, "video encoded", EACH, SHIELDS, SCENE, SCRATCH)
    lift, encode, each, shields, one_scene, scratch = (found.row(name).values[0] for name in names)
    assert scratch == pytest.approx(lift + encode + each + shields)
    assert found.row(RATIO).values[0] == pytest.approx(scratch / one_scene)
    assert found.row(RATIO_KEPT).values[0] == pytest.approx((lift + encode + each + shields / 4) / one_scene)
    assert found.facts["added"] > 0


def test_sharp_in_its_stages() -> None:
    found = sharp_section(1, SharpBase(micro_network(), weights="micro"))
    assert found.facts["gaussians"] == gaussians_of(MICRO)
    need = found.row(FORWARD).need
    assert need is not None
    assert need.operations["fp32"] > 1e9
    assert found.row("photo to scene").median >= found.row(FORWARD).median
    assert any("--compile" in note for note in found.notes)


def test_sharp_in_other_ways_where_they_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spackle.bases.sharp.base.compile_forward", lambda network: network)
    found = sharp_section(1, SharpBase(micro_network()), compiled=True, windows=(35, 9))
    names = [f"{FORWARD}, 35 windows at once", f"{FORWARD}, 9 windows at once", SHARP_COMPILED]
    assert [row.name for row in found.rows][-3:] == names
    assert all(found.row(name).need == found.row(FORWARD).need for name in names)

    def no_compiler(*arguments: object) -> Any:
        raise RuntimeError("no compiler\nanywhere")

    monkeypatch.setattr("spackle.bases.sharp.base.compile_forward", lambda network: no_compiler)
    found = sharp_section(1, SharpBase(micro_network()), compiled=True)
    assert found.notes[-1] == f"{SHARP_COMPILED}: not run: no compiler anywhere"
    assert SHARP_COMPILED not in [row.name for row in found.rows]


def test_training_steps_a_second() -> None:
    found = training_section(1, CpuRenderer(), batch=1, cells=32, features=False)
    assert found.row(RATE).median == pytest.approx(1000 / found.row(STEP).median)
    need = found.row(STEP).need
    assert need is not None
    assert sum(need.operations.values()) > 1e9


def test_a_gpus_views(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("spackle.render.cuda.load_gsplat", lambda device: gsplat_stand_in)
    found = gpu.gpu_view_section(1, GsplatRenderer("cpu"), 16)
    assert [row.name for row in found.rows][:3] == [gpu.VIEW, gpu.VIEWS, gpu.HOME]


# --- tables


def test_findings_survive_json(completed: Found) -> None:
    again = Found.of(json.loads(json.dumps(completed.plain())))
    assert again == dataclasses.replace(completed, facts=again.facts, rows=again.rows)
    assert again.row(RENDER) == completed.row(RENDER)
    assert dict(again.facts) == dict(completed.facts)


def test_targets_count_at_the_size_they_are_meant_for(completed: Found) -> None:
    whole = dataclasses.replace(completed, facts={**completed.facts, "width": 1536})
    forward = Found((Row(FORWARD, (1000 * whole.row(ADDED).median,)),), {"side": 1536})
    small = dict(targets({"completion": completed, "sharp": forward}))
    assert set(small.values()) == {None}
    found = dict(targets({"completion": whole, "sharp": forward}))
    share = found[tables.OF_SHARP]
    assert share is not None
    assert share.median == pytest.approx(0.1)
    text = to_markdown(suite_tables({"completion": whole, "sharp": forward}, {"video": "no photo"}))
    assert f"| {tables.OF_SHARP} | 0.10 % | ≤ 1.00 % | yes |" in text
    assert "| video | " in text
    assert "not run: no photo" in text
    assert Target(2.0).met(2.0)
    assert not Target(2.0, at_most=False).met(1.9)
