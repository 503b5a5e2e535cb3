"""`spackle figures` from an evaluation's pictures, and the LaTeX of tables and figures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from helpers.command import names_in, refuses, run
from helpers.evaluation_data import write_boxes
from helpers.sharp_weights import MICRO_SIZE, write_tiny
from PIL import Image

from spackle.paper.evaluation import figures
from spackle.paper.evaluation.pictures import GridRow, draw_grid


def check_latex(*files: Path) -> None:
    """Braces and environments are closed, labels are unique, and all rows of a table have the
    same columns."""
    text = "\n".join(file.read_text(encoding="utf-8") for file in files)
    bare = re.sub(r"\\[\\{}%]", "", text)
    depths = np.cumsum([(sign == "{") - (sign == "}") for sign in bare])
    assert depths.min() >= 0
    assert depths[-1] == 0
    begun, ended = (sorted(re.findall(rf"\\{word}\{{(.*?)\}}", text)) for word in ("begin", "end"))
    assert begun == ended
    labels = re.findall(r"\\label\{(.*?)\}", text)
    assert len(labels) == len(set(labels)) > 0
    assert max(map(len, re.findall(r"\\caption\{(.*)\}", text))) < 500
    for rows in re.findall(r"\\begin\{tabular\}\{(\w+)\}(.*?)\\end\{tabular\}", text, re.DOTALL):
        lines = [
            line
            for line in rows[1].splitlines()
            if line.endswith(r"\\") and "multicolumn" not in line
        ]
        assert {len(re.findall(r"(?<!\\)&", line)) for line in lines} == {len(rows[0]) - 1}


def test_each_row_of_a_figure_names_scene_base_and_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_boxes(tmp_path / "data" / "Ball_1", 0)
    words = ("evaluate", tmp_path / "data", "--dataset", "middlebury", "--metrics", "none")
    choices = ("--disparity", "0.6", "--methods", "base,paper", "-o", tmp_path / "out")
    tiny = write_tiny(tmp_path / "sharp.safetensors", MICRO_SIZE)
    assert run(*words, *choices, "--base", "sharp", "-c", tiny, "--precision", "fp32").code == 0
    drawn: list[tuple[Sequence[str], Sequence[GridRow]]] = []

    def draw(titles: Sequence[str], rows: Sequence[GridRow], **sizes: int) -> Image.Image:
        drawn.append((titles, rows))
        return draw_grid(titles, rows, **sizes)

    monkeypatch.setattr(figures, "draw_grid", draw)
    assert run("figures", tmp_path / "out", "-o", tmp_path / "figures").code == 0
    ((titles, (row,)),) = drawn
    assert titles == ["Input", "Base alone", "Eqs. 2 to 9"]
    assert re.fullmatch(
        r"Middlebury, Ball_1\. Base: SHARP stand-in\. Disparity 0\.6, (left|right)\. "
        r"Residual: Spackle's own weights\.",
        row.caption,
    )
    # The label is in the figure's own pixels.
    with Image.open(tmp_path / "figures" / "comparison.png") as picture:
        unlabelled = draw_grid(titles, [row._replace(caption="")], 100, 39)
        labelled = draw_grid(titles, [row], 100, 39)
        assert labelled.height > unlabelled.height
        assert picture.height > labelled.height


def test_rows_are_shared_among_evaluations() -> None:
    assert figures._share_rows([1, 4, 1], 6) == [1, 4, 1]
    assert figures._share_rows([5, 5, 0], 4) == [2, 2, 0]
    assert figures._share_rows([1, 1, 1], 2) == [1, 1, 1]


def test_both_figures_and_all_tables_are_latex(tmp_path: Path) -> None:
    data, large, near, bench = (tmp_path / name for name in ("data", "large", "near", "bench"))
    write_boxes(data / "Ball_1", 0)
    tiny = write_tiny(tmp_path / "sharp.safetensors", MICRO_SIZE)
    words = (data, "--dataset", "middlebury")
    sharp = ("--base", "sharp", "-c", tiny, "--precision", "fp32", "--metrics", "none")
    choices = ("--methods", "base,paper,direct-ft", "--direct-ft", tiny, "--disparity", "0.6")
    done = run("evaluate", *words, *sharp, *choices, "-o", large)
    assert done.code == 0, done.err
    rgbd = ("--base", "rgbd")
    near_choices = ("--protocol", "near-view", "--metrics", "psnr")
    assert run("evaluate", *words, *rgbd, *near_choices, "-o", near).code == 0
    bench_choices = ("--runs", 1, "--disparity", "0.6")
    assert run("bench", *words, *rgbd, *bench_choices, "-o", bench).code == 0
    done = run("figures", large, near, "-o", tmp_path / "figures")
    assert done.code == 0, done.err
    kinds = {f"{name}.{end}" for name in ("comparison", "direct_ft") for end in ("pdf", "png")}
    assert names_in(tmp_path / "figures") == {*kinds, "figures.tex"}
    assert (tmp_path / "figures" / "comparison.pdf").read_bytes().startswith(b"%PDF")
    sizes = []
    for name in ("comparison", "direct_ft"):
        with Image.open(tmp_path / "figures" / f"{name}.png") as picture:
            sizes.append(picture.size)
    # Three columns and five have the same width together.
    assert sizes[0][0] == pytest.approx(sizes[1][0], rel=0.03)
    assert sizes[0][1] > sizes[1][1]
    done = run("tables", large, near, bench, "-o", tmp_path / "tables")
    assert done.code == 0, done.err
    folders = large, near, tmp_path / "tables"
    files = [
        bench / "bench.tex",
        *(folder / "tables.tex" for folder in folders),
        tmp_path / "figures" / "figures.tex",
    ]
    check_latex(*files)  # one document can include all files
    refuses(run("figures", near, "-o", tmp_path / "none"), "nothing to draw", "--disparity 0.6")
    assert not (tmp_path / "none").exists()
