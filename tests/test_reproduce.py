"""`make reproduce`: the paper's experiment in miniature gives every table and figure within eight
minutes, and calls nothing by a name that is not its own.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from reproduced_claims import EXPECTED_RATIO, gaussians_per_masked_cell, mean_of

from spackle.paper.evaluation.folder import load_run
from spackle.residual.architectures import load_residual

ROOT = Path(__file__).parents[1]
MAX_CPU_SECONDS = 2 * 480  # eight minutes of two cores
TABLES = (  # the paper's labels, but of no-reference quality, whose metrics need a download
    "controlled_disocclusion",
    "efficiency_gaussian_overhead",
    "near_view",
    "mask_guided_init",
    "expanded_efficiency_gaussian_overhead",
)
# Scenes that were made for the reproduction, so that nothing in Spackle was tuned on them.
RENDERED = ("still_life", "toy_truck", "yard", "hall", "fern")
FINE_TUNED = ("motorcycle", "still_life", "toy_truck")


@pytest.mark.slow
def test_the_papers_chain_gives_its_tables_and_figures(tmp_path: Path) -> None:
    out, before = tmp_path / "out", os.times()
    done = subprocess.run(
        [sys.executable, ROOT / "benchmarks/reproduce.py", "-o", out],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert sum(os.times()[2:4]) - sum(before[2:4]) < MAX_CPU_SECONDS
    check_trainings(out)
    check_tables(out)
    check_claims(out)
    check_figures(out)


def check_trainings(out: Path) -> None:
    """Residual and direct FT have learned on two processes, to their last step."""
    for name in ("residual", "direct-ft"):
        report = json.loads((out / name / "run.json").read_text())
        assert (report["ended"], report["processes"]) == ("steps", 2)
    assert load_residual(out / "residual" / "best.safetensors").name == "sharp-decoder"


def check_tables(out: Path) -> None:
    """Each table shows what was run under its own name; "SHARP" alone is the paper's."""
    text = (out / "tables" / "tables.md").read_text()
    tables = {label: text.partition(f"`tab:{label}`")[2].partition("\n**")[0] for label in TABLES}
    assert all("Middlebury" in table for table in tables.values())
    assert "Photos of scikit-image" in tables["controlled_disocclusion"]
    for label in ("controlled_disocclusion", "near_view", "mask_guided_init"):
        for name in RENDERED:
            assert f"Rendered {name.replace('_', ' ')}" in tables[label], (label, name)
    # Metrics that are not installed have no columns; a line says how to get them.
    assert "| DISTS" not in text
    assert re.search(r"DISTS, LPIPS not run: .{20,}", text)
    assert re.search(r"CLIPIQA, NIQE, MUSIQ not run: .{20,}", text)

    page = (out / "tables" / "report.html").read_text()
    assert "SHARP stand-in" in page
    for run in (load_run(folder) for folder in sorted((out / "runs").iterdir())):
        assert run.base_title in ("rgbd", "lite", "SHARP stand-in")


def check_claims(out: Path) -> None:
    """The paper's claims that docs/reproduction.md repeats hold in this run."""
    low, high = EXPECTED_RATIO
    for name in (*RENDERED, "motorcycle", "photos"):
        run = load_run(out / "runs" / f"{name}-large")
        assert low < gaussians_per_masked_cell(run) < high, name
        # The shipped weights are trained for Spackle's own two passes: in the paper's single pass
        # they leave more open, a half of the yard's holes and 11 to 28 % of the others'.
        hole_ratio = mean_of(run, "paper", "har_before")
        assert mean_of(run, "paper", "har") < 0.6 * hole_ratio, name
        assert mean_of(run, "spackle", "har") < 0.01 * hole_ratio, name

    # As in the paper's table 4, direct FT damages what lies outside of holes, and the residual
    # does not.
    for name in FINE_TUNED:
        large = load_run(out / "runs" / f"{name}-stand-in-large")
        assert low < gaussians_per_masked_cell(large) < high, name
        # Weights that were trained in this run, for this base, close the holes.
        assert mean_of(large, "paper", "har") < 0.05 * mean_of(large, "paper", "har_before"), name
        near = load_run(out / "runs" / f"{name}-stand-in-near")
        base_outside = mean_of(near, "base", "psnr_outside")
        assert mean_of(near, "direct-ft", "psnr_outside") < base_outside - 0.5, name
        assert mean_of(near, "paper", "psnr_outside") == pytest.approx(base_outside, rel=2e-3)
        base_hole = mean_of(near, "base", "psnr_hole")
        assert mean_of(near, "direct-ft", "psnr_hole") > base_hole, name
        assert mean_of(near, "paper", "psnr_hole") > base_hole, name
    assert (out / "claims.md").read_text().count("SHARP stand-in") >= 3 * len(FINE_TUNED)


def check_figures(out: Path) -> None:
    """Both figures are large enough to look at, and their captions name bases and stand-in."""
    latex = (out / "figures" / "figures.tex").read_text()
    comparison, direct_ft = re.findall(r"\\caption\{.*", latex)
    assert "rgbd, lite" in comparison
    assert "SHARP" not in comparison
    assert "SHARP stand-in" in direct_ft
    for name in ("comparison", "direct_ft"):
        assert (out / "figures" / f"{name}.pdf").stat().st_size > 10_000
        with Image.open(out / "figures" / f"{name}.png") as figure:
            assert min(figure.size) > 500
