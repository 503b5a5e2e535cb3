"""`spackle evaluate`: metrics as in scikit-image, tables with the paper's numbers, killed runs
that resume."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import shutil
import socket
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.command import Run, names_in, refuses, run
from helpers.evaluation_data import Figures, fake_pyiqa, results
from helpers.holes import random_network
from helpers.scenes import box_before_wall, same_bits, shifted
from safetensors.torch import save_file
from torch import Tensor

from spackle.bases.settings import BaseSettings
from spackle.core.trajectories import disparity_to_offset
from spackle.paper.evaluation.case import load_case
from spackle.paper.evaluation.evaluate import methods_of_case
from spackle.paper.evaluation.evaluation import open_evaluation
from spackle.paper.evaluation.folder import load_run
from spackle.paper.evaluation.measurements import Run as Results
from spackle.paper.evaluation.measurements import mean_of_known
from spackle.paper.evaluation.methods import make_method
from spackle.paper.evaluation.metric_suite import MetricSuite
from spackle.paper.evaluation.metrics import psnr, ssim_average, ssim_map
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.paper.evaluation.protocols import large_views, measure_views
from spackle.paper.evaluation.published_metrics import PUBLISHED_METRICS, open_published_metrics
from spackle.paper.evaluation.table import Table, mark_best, to_latex, to_markdown
from spackle.paper.evaluation.tables import make_tables
from spackle.pipeline import FillOptions
from spackle.render import get_renderer
from spackle.residual import MIN_AUX_GAUSSIANS, hole_mask
from spackle.residual.architectures import ARCHITECTURE_KEY, open_residual
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext
from spackle.weights import PUBLISHED_WEIGHTS, weights_digest

TABLES = ("tables.md", "tables.tex")
FLAT = "inpaint2d," if importlib.util.find_spec("cv2") else ""  # an optional package
OUTPUTS = {"rows.jsonl", "config.json", "worst.png", "best.png", "images", *TABLES}


def test_psnr_and_ssim_are_scikit_images() -> None:
    theirs = pytest.importorskip("skimage.metrics")
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(57, 83, 3, generator=generator, dtype=torch.float64)
    truth = (
        image + 0.1 * torch.randn(image.shape, generator=generator, dtype=torch.float64)
    ).clamp(0, 1)
    options = {
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "data_range": 1,
    }
    whole, full = theirs.structural_similarity(
        image.numpy(), truth.numpy(), channel_axis=-1, full=True, **options
    )
    found = ssim_map(image, truth)
    mask, nothing = torch.zeros(2, *image.shape[:2], dtype=torch.bool)
    mask[:20, -30:] = True  # also at the border, because holes are often there
    assert ssim_average(found) == pytest.approx(whole, abs=1e-6)
    assert ssim_average(found, mask) == pytest.approx(full[:20, -30:].mean(), abs=1e-6)
    for ours, part in (
        (psnr(image, truth), np.s_[:]),
        (psnr(image, truth, mask), np.s_[:20, -30:]),
    ):
        expected = theirs.peak_signal_noise_ratio(
            truth.numpy()[part], image.numpy()[part], data_range=1
        )
        assert ours == pytest.approx(expected, abs=1e-6)
    assert math.isnan(psnr(image, truth, nothing))
    assert math.isnan(ssim_average(found, nothing))
    assert psnr(image, image) == math.inf


def test_variants_are_pinned_and_no_weights_are_downloaded(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: dict[str, Any] = {}
    seen: list[tuple[Tensor, ...]] = []

    def create(name: str, device: torch.device, **options: Any) -> Any:
        asked[name] = options
        if name == "niqe":
            socket.create_connection(("weights.invalid", 443), timeout=1)
        if name == "dists":
            raise KeyError("no such variant")
        return lambda *images: seen.append(images) or images[0].mean()[None]

    fake_pyiqa(monkeypatch, create)
    lookup = socket.getaddrinfo
    metrics, states = open_published_metrics(list(PUBLISHED_METRICS), "cpu", download=False)
    assert socket.getaddrinfo is lookup
    assert "weights are not on this machine (`download_metrics`" in states["niqe"]
    assert "'no such variant'" in states["dists"]
    assert {states[name] for name in metrics} == {"pyiqa 9.9"}
    assert (asked["lpips"], asked["musiq"]) == (
        {"net": "alex", "version": "0.1"},
        {"pretrained": "koniq10k"},
    )
    picture = torch.full((5, 7, 3), 1.5)
    truth = torch.full((5, 7, 3), 0.25)
    picture[0, 1, 2] = 0.0
    assert metrics["lpips"](picture, truth) == pytest.approx(104 / 105)
    first, second = seen[0]
    assert first.shape == second.shape == (1, 3, 5, 7)
    assert (float(first[0, 2, 0, 1]), float(first.max())) == (0, 1)


LARGE: Figures = {
    "base": {
        "har_before": 0.2,
        "har": 0.2,
        "aux": 0,
        "aux_share": 0.0,
        "merged": 1000,
        "niqe": 4.5,
        "musiq": None,
    },
    "spackle": {
        "har_before": 0.2,
        "har": 0.05,
        "aux": 30,
        "aux_share": 0.03,
        "merged": 1030,
        "niqe": 4.25,
    },
}


def cells(table: Table, dataset: str) -> list[Sequence[str]]:
    """The rows of a dataset, without its name."""
    return next([row[1:] for row in rows] for rows in table.bodies if rows[0][0] == dataset)


def test_large_view_tables_have_the_papers_layout_and_numbers() -> None:
    quality, holes, _, gaussians = make_tables([results("Middlebury", False, lambda image: LARGE)])
    base, spackle, sharp, _ = cells(quality, "Middlebury")
    # CLIPIQA was not measured: its columns are left out, and a note says how to get them.
    assert quality.heads[3:] == [
        (f"S{k}: disparity 0.{k + 2}", title) for k in (1, 2, 3) for title in ("NIQE ↓", "MUSIQ ↑")
    ]
    assert "CLIPIQA not run: pyiqa is not installed." in quality.notes
    assert tuple(base[:4]) == ("rgbd alone", "2/23", "4.5000", "(4 NaN)")
    assert tuple(spackle[:3]) == ("Spackle‡ (rgbd)", "2/23", "**4.2500**")
    assert tuple(sharp[:4]) == ("SHARP (paper)", "23", "4.3102", "58.2782")
    ours, theirs = cells(holes, "Middlebury")
    assert tuple(ours[2:5]) == ("0.2000", "0.0500", "75.00%")
    assert tuple(theirs[:5]) == ("Spackle on SHARP (paper)", "23", "0.0121", "0.0011", "90.47%")
    ours, theirs, *_ = cells(gaussians, "Middlebury")
    assert (tuple(ours[2:5]), tuple(theirs[2:5])) == (
        ("30", "3.00", "1,030"),
        ("3,387", "0.29", "1,183,035"),
    )
    assert any(note.startswith("‡ Not the paper's recipe") for note in quality.notes)
    assert tuple(cells(quality, "Tanks")[0]) == ("not run", *[""] * 7)
    # A table may be copied without its notes.
    assert quality.caption.endswith("Base of our rows: rgbd (Middlebury).")
    assert any("1 of 3 images could not be measured: gone." in note for note in quality.notes)


def test_the_near_view_tables_have_the_papers_layout_and_numbers() -> None:
    figures: Figures = {
        "dense": {"aux": 200, "psnr": 21.0, "dists": 0.25},
        "paper": {"aux": 50, "psnr": 22.0, "dists": 0.125, "hole_cells": 51},
    }
    near, ablation, _ = make_tables([results("Booster", True, lambda image: figures)])
    # Ours stand in front of the published metrics; LPIPS and the distance were not measured.
    assert near.heads[1:3] == [("Booster", "PSNR ↑"), ("Booster", "DISTS ↓")]
    assert [tuple(row[:3]) for row in near.bodies[0]] == [
        ("dense grid‡ (rgbd)", "21.00", "0.2500"),
        ("Spackle, eqs. 2 to 9‡ (rgbd)", "22.00", "0.1250"),
    ]
    assert [row[-1] for row in near.bodies[1]] == ["0.4837", "0.6042", "0.4589"]
    (missing,) = [note for note in near.notes if "LPIPS not run" in note or "LPIPS" in note[:20]]
    assert "distance" in missing
    assert near.notes[0].startswith("Views of Booster: from the cameras of all other")
    dense, guided, *papers = cells(ablation, "Booster")
    assert tuple(dense) == (
        "Dense grid init‡ (rgbd)",
        "2/228",
        "50,000",
        "200.00",
        "",
        "21.00",
        "0.2500",
        "",
    )
    assert tuple(guided) == (
        "Mask guided init‡ (rgbd)",
        "2/228",
        "50,000",
        "50.00",
        "75.00%",
        "22.00",
        "0.1250",
        "0.980",
    )
    expected = (
        "Mask guided init (paper)",
        "228",
        "1,179,648",
        "144.17",
        "99.97%",
        "",
        "0.0871",
        "",
    )
    assert tuple(papers[1]) == expected


def test_runs_with_different_disparities_share_no_table() -> None:
    one = results("LLFF", False, lambda image: LARGE)
    other = dataclasses.replace(one, config={**one.config, "title": "Tanks", "disparities": [0.3]})
    with pytest.raises(InputError, match="different disparities"):
        make_tables([one, other])


def test_a_table_as_markdown_and_latex() -> None:
    heads = [("", "A"), ("both", "B"), ("both", "C")]
    bodies = [[("x_1", "**1**", "a|b")], [("", "2", "±<3")]]
    table = Table("tab:x", "X", "Ours & theirs, 5 %.", heads, bodies, notes=("n.",))
    assert "| A | both: B | both: C |\n|---|---|---|\n| x_1 | **1** | a\\|b |" in to_markdown(table)
    assert "\\label{tab:x:one}" in to_latex(table, ":one")
    assert "x\\_1 & \\textbf{1} & a|b \\\\\n\\midrule\n & 2 & $\\pm$$<$3 \\\\" in to_latex(table)
    assert mark_best([1.0, None, 2.0], ["1", "", "2"], lower_is_better=True) == ["**1**", "", "2"]
    assert mark_best([1.0, 1.0001], ["1.0", "1.0"], lower_is_better=False) == ["1.0", "1.0"]
    assert mark_best([1.0, 1.1, 1.1001], ["1.0", "1.1", "1.1"], lower_is_better=False) == [
        "1.0",
        "**1.1**",
        "**1.1**",
    ]


def test_each_method_starts_from_the_same_base() -> None:
    prediction = box_before_wall().lift()
    renderer = get_renderer()
    context = FillContext(prediction.gaussians, prediction.camera, renderer)
    cameras = [shifted(prediction.camera, side) for side in (0.4, -0.4)]
    renderings = [renderer.render(context.base, camera) for camera in cameras]
    names = ("base", "initial", "spackle-scene", "dense", "paper", "spackle")
    fills = [make_method(name, cameras, context) for name in names]
    alone, per_view, scene, dense, paper, spackle = (
        [fill(camera, before) for camera, before in zip(cameras, renderings, strict=True)]
        for fill in fills
    )
    counts = [
        [len(view.aux or ()) for view in views] for views in (per_view, dense, paper, spackle)
    ]
    for index, before in enumerate(renderings):
        covered = ~hole_mask(before.alpha)
        holes = float((~covered).float().mean())
        assert torch.equal(alone[index].rgb, before.rgb)
        assert not alone[index].aux
        for view in (per_view[index], scene[index], dense[index], paper[index]):
            assert view.alpha is not None
            # Cells that are masked by less than half stay as they are, in the paper's method.
            assert float(hole_mask(view.alpha).float().mean()) < 0.12 * holes
            # The dense grid also covers what the base shows; only training could hold it back.
            limit = 0.05 if view is dense[index] else 0.01
            assert float((view.rgb - before.rgb).abs()[covered].mean()) < limit
        whole = before.alpha.numel() / 4
        initial, grid, cells, pixels = (count[index] for count in counts)
        assert grid == whole
        assert initial < 0.5 * whole
        assert cells == pytest.approx(holes * whole, rel=0.05)  # the paper's HAR × grid
        assert cells < pixels <= 6 * cells
    assert scene[0].aux is scene[1].aux  # both views share a set
    double = dataclasses.replace(
        context.base, means=2 * context.base.means, scales=2 * context.base.scales
    )
    fill = make_method("direct-ft", cameras, context, direct_ft=lambda: (double, 2.0))
    for camera, before in zip(cameras, renderings, strict=True):
        difference = (fill(camera, before).rgb - before.rgb).abs()
        assert float(difference.max()) <= 1e-3  # the same viewpoint, in another unit of length


def test_the_initial_gaussians_alone_are_the_papers_pass_without_a_network() -> None:
    prediction = box_before_wall().lift()
    renderer = get_renderer()
    network = FillOptions().load_network()
    context = FillContext(prediction.gaussians, prediction.camera, renderer, network=network)
    camera = shifted(prediction.camera, 0.4)
    before = renderer.render(context.base, camera)
    initial, paper = (
        make_method(name, [camera], context)(camera, before) for name in ("paper-initial", "paper")
    )
    untrained = make_method("paper", [camera], context.without_network)(camera, before)
    assert torch.equal(initial.rgb, untrained.rgb)
    assert len(initial.aux or ()) == len(paper.aux or ()) > 0
    assert not torch.equal(initial.rgb, paper.rgb)
    # Without a network the result depends on no weights, so it has no mark and no residual.
    one = results("Booster", True, lambda image: {"paper-initial": {"psnr": 20.0}})
    assert make_tables([one])[0].bodies[0][0][0] == "Initial Gaussians, eqs. 2 to 9 (rgbd)"


def test_large_views_end_a_swipe_and_a_failed_metric_is_a_remark() -> None:
    prediction = box_before_wall(width=95, height=71).lift()
    views = large_views(prediction, (0.3, 0.5), 1280)
    small = large_views(prediction, (0.3,), 64)[0].camera
    assert (small.width, small.height) == (64, 48)
    assert [(view.setting, view.name) for view in views] == [
        (s, n) for s in ("0.3", "0.5") for n in ("left", "right")
    ]
    reach = prediction.depth_range
    for view, sign in zip(views, (-1, 1, -1, 1), strict=True):
        x = sign * disparity_to_offset(views[0].camera, float(view.setting), reach)
        assert view.camera.position.tolist() == pytest.approx([x, 0, 0], rel=1e-5, abs=1e-6)

    def broken(picture: Tensor, truth: Tensor | None) -> float:
        raise RuntimeError("svd did not converge")

    suite = MetricSuite(("niqe",), {"niqe": broken})
    context = FillContext(prediction.gaussians, prediction.camera, get_renderer())
    methods = {"base": partial(make_method, "base", context=context)}
    rows, pictures = measure_views("Boxes", "box", context, views, methods, suite)
    assert {row.value for row in rows if row.metric == "remark"} == {
        "niqe failed: svd did not converge"
    }
    assert [row.value for row in rows if row.metric == "niqe"] == [None] * 4
    assert {row[:2] for row in rows} == {("Boxes", "box")}
    known = results("Boxes", False, lambda image: LARGE)
    assert make_tables([dataclasses.replace(known, measurements=[*known.measurements, *rows])])
    assert pictures["base"].shape == pictures["hole"].shape == (72, 96, 3)  # both sides even


def evaluate(root: Path, output: Path, *more: object) -> Run:
    return run("evaluate", root, "--dataset", "middlebury", "--base", "rgbd", "-o", output, *more)


def mean_of(run: Results, setting: str, method: str, metric: str) -> float:
    value = mean_of_known(
        [row.value for row in run.measurements if row[2:3] + row[4:6] == (setting, method, metric)]
    ).value
    assert value is not None
    return value


def test_large_views_from_files_to_tables(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def create(name: str, **options: Any) -> Any:
        return lambda image: image.mean() if name == "niqe" else torch.tensor(math.nan)

    fake_pyiqa(monkeypatch, create)
    methods = f"base,{FLAT}initial,paper,spackle,spackle-scene"
    done = evaluate(
        scenes, tmp_path, "--methods", methods, "--metrics", "niqe,musiq", "--disparity", "0.3,0.5"
    )
    assert done.code == 0, done.err
    assert names_in(tmp_path) == OUTPUTS
    found = load_run(tmp_path)
    # A table of means with two settings and a line of heads, and a line with the folder.
    ending = [line.split() for line in done.lines[-2 - 2 * len(found.methods) :]]
    assert ending[0] == ["NIQE", "↓", "MUSIQ", "↑", "HAR", "↓", "added", "GS"]
    niqe, har = (f"{mean_of(found, '0.3', 'base', metric):.4f}" for metric in ("niqe", "har"))
    assert ending[1] == ["S1", "base", "(rgbd)", niqe, har, "0"]
    assert (found.problems, found.settings, len(found.measured_images)) == ({}, ["0.3", "0.5"], 3)
    for setting in ("0.3", "0.5"):
        before = mean_of(found, setting, "base", "har")
        assert before > 0.02
        for method in ("initial", "paper", "spackle", "spackle-scene"):
            most = 0.5 if method == "paper" else 0.05  # one pass, or two passes
            assert mean_of(found, setting, method, "har") < most * before
            assert mean_of(found, setting, method, "merged") > mean_of(
                found, setting, "base", "merged"
            )
        dark, filled = (mean_of(found, setting, method, "niqe") for method in ("base", "spackle"))
        assert filled > dark  # black holes are filled
    assert mean_of(found, "0.5", "base", "har") > mean_of(found, "0.3", "base", "har")
    text = (tmp_path / "tables.md").read_text()
    assert all(word in text for word in ("(6 NaN)", "3/23", "PolyForm Noncommercial"))


def test_the_distance_takes_downloaded_weights_or_says_how_to_get_them(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    options = EvaluateOptions(
        dataset="middlebury",
        root=scenes,
        protocol="near-view",
        base=BaseSettings(name="rgbd"),
        metrics=("distance",),
    )
    state = open_evaluation(options).metric_states["distance"]
    assert state.startswith("not run: no weights of SqueezeNet on this machine")
    assert "`spackle weights get squeezenet` (675.8 kB, BSD)" in state
    (tmp_path / PUBLISHED_WEIGHTS["squeezenet"].file).write_bytes(b"not a network")
    with pytest.raises(InputError, match=r"compressed_SqueezeNet\.net: "):
        open_evaluation(options)


def test_metrics_are_added_to_a_finished_run(
    scenes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("--protocol", "near-view", "--methods", "base,initial", "--limit", 2)
    once = tmp_path / "once"
    later = tmp_path / "later"
    monkeypatch.setitem(sys.modules, "pyiqa", None)
    assert evaluate(scenes, later, *words, "--metrics", "ssim,dists").code == 0
    text = (later / "tables.md").read_text()
    assert "DISTS not run: pyiqa is not installed: pip install 'spackle-nvs[eval]'" in text
    assert "DISTS ↓" not in text
    with monkeypatch.context() as patch:
        fake_pyiqa(patch, lambda name, **options: lambda image, truth: (image - truth).abs().mean())
        assert evaluate(scenes, once, *words, "--metrics", "psnr,ssim,dists").code == 0
        for metrics in ("psnr", "dists"):
            assert evaluate(scenes, later, *words, "--metrics", metrics).code == 0
        for name in ("rows.jsonl", *TABLES):
            assert (once / name).read_bytes() == (later / name).read_bytes(), name
    refuses(
        evaluate(scenes, once, *words, "--metrics", "psnr"),
        f"{once}: holds the metric dists, which cannot be measured",
    )
    hole, outside = (
        [mean_of(load_run(once), "near", m, f"psnr_{w}") for m in ("base", "initial")]
        for w in ("hole", "outside")
    )
    assert hole[1] > hole[0] + 3
    assert abs(outside[1] - outside[0]) < 0.5


def test_a_broken_image_is_named_and_the_others_are_measured(scenes: Path, tmp_path: Path) -> None:
    root = tmp_path / "data"
    output = tmp_path / "out"
    shutil.copytree(scenes, root)
    photo = root / "Chair" / "left.png"
    choices = ("--methods", "base", "--metrics", "none", "--disparity", "0.3")
    near = (*choices[:4], "--protocol", "near-view")
    for content, where, more in (
        (photo.read_bytes()[:900], output, choices),
        (b"", tmp_path / "near", near),
    ):
        photo.write_bytes(content)  # the second content has not even a header
        done = evaluate(root, where, *more)
        assert done.code == 0, done.err
        (line,) = [line for line in done.lines if "passed over:" in line]
        assert "Chair/left.png: " in line
        assert list(load_run(where).problems) == ["Chair"]
        assert str(tmp_path) not in (where / "rows.jsonl").read_text()
    assert "1 of 3 images could not be measured: Chair." in (output / "tables.md").read_text()
    for scene in root.iterdir():
        (scene / "left.png").write_bytes(b"")
    assert (
        "none of 3 images could be measured"
        in evaluate(root, tmp_path / "none", *choices).lines[-1]
    )


def test_a_run_resumes_to_the_same_bytes_and_runs_share_tables(
    scenes: Path, tmp_path: Path
) -> None:
    choices = ("--methods", "base,initial", "--metrics", "none", "--disparity", "0.3,0.5")
    one = tmp_path / "one"
    two = tmp_path / "two"
    both = tmp_path / "both"
    assert evaluate(scenes, one, *choices).code == 0
    stopped = shutil.copytree(one, tmp_path / "stopped")
    for name in ("rows.jsonl", "images/00002-Door.json"):
        (stopped / name).unlink()
    assert "going on, 2 of 3" in evaluate(scenes, stopped, *choices).err
    for name in ("rows.jsonl", "worst.png", "best.png", *TABLES):
        assert (one / name).read_bytes() == (stopped / name).read_bytes(), name
    refuses(evaluate(scenes, stopped, *choices[:-1], "0.4"), "disparities: [0.3, 0.5] -> [0.4]")
    assert evaluate(scenes, two, *choices[:-2], "--protocol", "near-view", "--limit", "1").code == 0
    assert len(load_run(two).images) == 1
    done = run("tables", one, two, "-o", both)
    assert done.code == 0, done.err
    refuses(run("tables", one, one, "-o", both), "two results")
    refuses(run("tables", scenes, "-o", both), "rows.jsonl is missing")
    for file, content in (("rows.jsonl", "[1]\n"), ("config.json", '{"format": 2}')):
        damaged = shutil.copytree(one, tmp_path / f"damaged {file}")
        (damaged / file).write_text(content)
        refuses(run("tables", damaged, "-o", both), file, "run the command again")


@pytest.mark.slow
def test_two_workers_write_the_bytes_of_one_process(scenes: Path, tmp_path: Path) -> None:
    choices = ("--methods", "base,initial", "--metrics", "none", "--disparity", "0.3")
    one = tmp_path / "one"
    two = tmp_path / "two"
    # The last bits depend on the number of threads.
    for output, count in ((one, 1), (two, 2)):
        done = evaluate(scenes, output, *choices, "--workers", count, "--threads", 1)
        assert done.code == 0, done.err
    assert names_in(two) == names_in(one)
    for name in ("rows.jsonl", "worst.png", "best.png", *TABLES):
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--methods", "spakle"), "did you mean spackle?"),
        (("--base", "auto"), "--base auto"),
        (("--metrics", "psnr"), "add --protocol near-view"),
        (("--disparity", "0.3,x"), "not numbers"),
        (("--disparity", "3"), "up to 2"),
        (("--methods", "direct-ft"), "add --base sharp, and --direct-ft FILE"),
        (("--methods", ","), "none is given"),
        (("--residual", "none"), "--residual none"),
        (("--features", "gone.npz", "--protocol", "near-view"), "gone.npz: no such"),
        (("--methods", "inpaint2d", "--metrics", "none"), "pip install 'spackle-nvs[opencv]'"),
    ],
)
def test_bad_input_is_one_line(
    words: tuple[str, ...],
    message: str,
    scenes: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    refuses(evaluate(scenes, tmp_path / "out", *words), message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("network_name", ["unet", "sharp-decoder"])
def test_the_dense_row_differs_from_the_papers_in_nothing_but_the_cells(network_name: str) -> None:
    prediction = box_before_wall().lift()
    network = random_network(name=network_name)
    context = FillContext.of(prediction, get_renderer(), network, precision="fp32")
    camera = shifted(prediction.camera, 0.4)
    before = context.renderer.render(context.base, camera)
    paper, dense = (
        make_method(name, [camera], context)(camera, before).aux for name in ("paper", "dense")
    )
    assert paper is not None
    assert dense is not None
    cells = context.view(before, camera).cells(at_least=MIN_AUX_GAUSSIANS).flatten()
    assert len(dense) == len(cells)
    for one, other in zip(paper.tensors, dense.select(cells).tensors, strict=True):
        # A U-Net runs on the whole grid for the dense row, else on the parts around the holes.
        torch.testing.assert_close(one, other, rtol=1e-2, atol=1e-2)


def test_the_dense_row_may_have_a_network_of_its_own(scenes: Path, tmp_path: Path) -> None:
    # Weights of an untrained network, which changes nothing.
    network = open_residual("unet")
    weights = tmp_path / "dense.safetensors"
    # Files of weights have the usual order in memory, networks that are used may have another.
    tensors = {name: tensor.contiguous() for name, tensor in network.state_dict().items()}
    save_file(tensors, weights, {ARCHITECTURE_KEY: "unet"})
    options = EvaluateOptions(
        dataset="middlebury",
        root=scenes,
        methods=("paper", "dense"),
        base=BaseSettings(name="rgbd"),
        dense_residual=weights,
        limit=1,
    )
    evaluation = open_evaluation(options)
    loaded = load_case(evaluation.cases[0], 64)
    prediction, _ = evaluation.base_of_case(loaded).predict(loaded.full_photo)
    context = evaluation.fill_context(prediction)
    methods = methods_of_case(evaluation, loaded, context, None)
    camera = large_views(prediction, (0.3,), 64)[0].camera
    before = context.renderer.render(context.base, camera)
    untrained = make_method("dense", [camera], dataclasses.replace(context, network=network))
    aux = {name: method([camera])(camera, before).aux for name, method in methods.items()}
    expected = untrained(camera, before).aux
    assert expected is not None
    assert same_bits(aux["dense"], expected)
    shipped = make_method("paper", [camera], context)(camera, before).aux
    assert shipped is not None
    assert same_bits(aux["paper"], shipped)
    assert evaluation.config["dense_residual"] == weights_digest(weights)
    with pytest.raises(InputError, match="which is not among the `methods`"):
        dataclasses.replace(options, methods=("paper",)).check()
