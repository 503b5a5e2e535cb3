"""What a run of `benchmarks/reproduce.py` says about two claims of the paper, as Markdown.

    python benchmarks/reproduced_claims.py reproduction

1. The paper's method adds one Gaussian for each masked cell (2×2 pixels).
2. Direct FT, the base trained on the residual's targets, fills holes but spoils the rest of a view.

Numbers come out as the run has them, whether a claim holds or not.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from spackle.cli.script_command import run_script
from spackle.paper.evaluation.folder import load_run
from spackle.paper.evaluation.measurements import Run, mean_of_known
from spackle.paper.evaluation.pictures import picture_title
from spackle.runtime.errors import InputError

EXPECTED_RATIO = (0.95, 1.05)  # of added Gaussians over masked cells
FILE = "claims.md"


def mean_of(run: Run, method: str, metric: str) -> float:
    """The mean of a metric over all views of a run."""
    values = [
        measurement.value
        for measurement in run.measurements
        if (measurement.method, measurement.metric) == (method, metric)
    ]
    return mean_of_known(values).value or 0.0


def gaussians_per_masked_cell(run: Run) -> float:
    """Added Gaussians of the paper's method over masked cells, the HAR times the grid's cells."""
    return mean_of(run, "paper", "aux") / mean_of(run, "paper", "hole_cells")


def claims(large_runs: Sequence[Run], fine_tuned_runs: Sequence[Run]) -> str:
    """Two tables in Markdown, each below the claim that it is about.

    Args:
        large_runs: evaluations of large views with the method `paper`.
        fine_tuned_runs: evaluations at true second photos with the method `direct-ft`.
    """
    lines = [
        "# Two claims of the paper, in this run",
        "",
        "The paper's method adds one Gaussian for each masked cell (2×2 pixels). Means over the "
        f"large views; the ratio is expected within {EXPECTED_RATIO[0]} and {EXPECTED_RATIO[1]}.",
        "",
        "| scenes | base | HAR before | HAR after | added Gaussians | added / (HAR × grid) |",
        "|---|---|---|---|---|---|",
    ]
    for run in large_runs:
        before = mean_of(run, "paper", "har_before")
        after = mean_of(run, "paper", "har")
        added = mean_of(run, "paper", "aux")
        ratio = gaussians_per_masked_cell(run)
        lines.append(
            f"| {run.title} | {run.base_title} | {before:.4f} | {after:.4f} | {added:,.0f} | "
            f"{ratio:.3f} |"
        )

    lines += [
        "",
        "Direct FT fills holes but spoils the rest of the view; the residual does not. PSNR in dB "
        "against true second photos, in the holes of the base and outside of them.",
        "",
        "| scenes | base | method | in the hole | outside |",
        "|---|---|---|---|---|",
    ]
    for run in fine_tuned_runs:
        for method in run.methods:
            title = picture_title(run, method)
            hole = mean_of(run, method, "psnr_hole")
            outside = mean_of(run, method, "psnr_outside")
            lines.append(
                f"| {run.title} | {run.base_title} | {title} | {hole:.2f} | {outside:.2f} |"
            )
    return "\n".join(lines) + "\n"


def claims_of_folder(folder: Path) -> str:
    """The claims by the evaluations in the folder of `benchmarks/reproduce.py`.

    The bases that need no weights come first, then the stand-in of SHARP.

    Raises:
        InputError: an evaluation cannot be read, or there are none of large or of near views.
    """
    large = [load_run(path) for path in sorted((folder / "runs").glob("*-large"))]
    near = [load_run(path) for path in sorted((folder / "runs").glob("*-near"))]
    if not large or not near:
        raise InputError(
            f"{folder}: has no evaluations runs/*-large or runs/*-near: give a folder that "
            "benchmarks/reproduce.py has made"
        )
    large.sort(key=lambda run: "direct-ft" in run.methods)
    return claims(large, [run for run in near if "direct-ft" in run.methods])


def main() -> None:
    """Print the claims."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="which benchmarks/reproduce.py has made")
    print(claims_of_folder(parser.parse_args().folder), end="")


if __name__ == "__main__":
    sys.exit(run_script(main))
