"""`spackle figures`: the paper's figures of views, from the pictures that evaluations keep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch.nn.functional import avg_pool2d

from spackle.errors import InputError
from spackle.evaluation.folder import load_run
from spackle.evaluation.methods import METHODS
from spackle.evaluation.pictures import Boxes, Cell, draw_grid, kept_pictures
from spackle.evaluation.plots import evenly
from spackle.evaluation.protocols import HOLE, INPUT
from spackle.evaluation.rows import Run, load_data
from spackle.evaluation.table import tex
from spackle.files import atomic_path, write_whole
from spackle.folders import results_folder
from spackle.progress import Reporter

CAPTIONS = "figures.tex"
DPI, WIDTH = 400, 5.5  # inches: the text of the paper's pages
POINTS = 7  # height of letters
MOST_BOXES, BOX = 2, 0.22  # in a picture; side of one, of the picture's longer side
LEAST_SCORE = 0.02  # share of holes in a box, times that of the rest


class PaperFigure(NamedTuple):
    """What the paper has a figure of."""

    name: str
    columns: Sequence[str]  # pictures; methods that no run has are left out, but for the needed one
    needs: str
    caption: str


FIGURES = [PaperFigure(name, **facts) for name, facts in load_data("figures.json").items()]
TITLES = {INPUT: "Input", HOLE: "Occluded regions", "direct-ft": "Direct FT"}


def make_figures(folders: Sequence[Path], rows: int, output: Path, reporter: Reporter) -> None:
    """Draw figures of the images of large-view evaluations, as PDF and PNG, and their captions for LaTeX.

    Of each image the view with its largest hole is shown, at most `rows` images in all and at least one of each run.

    Raises:
        InputError: a folder without results, or with none of large views whose pictures are there.
    """
    runs = [(run, folder) for run, folder in ((load_run(folder), folder) for folder in folders) if not run.timed]
    runs = [(run, folder) for run, folder in runs if not run.near]
    made = {}
    for figure in FIGURES:
        having = [(run, folder) for run, folder in runs if figure.needs in run.methods]
        if drawn := _draw(figure, having, rows):
            made[figure.name] = drawn
    if not made:
        raise InputError(f"{folders[0]}: nothing to draw: give folders of `spackle evaluate` with --disparity 0.6")
    for figure in FIGURES:
        if figure.name not in made:
            reporter.log(f"no figure {figure.name}: no large-view run has pictures of {figure.needs}")
    files = [f"{name}.{end}" for name in made for end in ("pdf", "png")]
    with results_folder(output, (*files, CAPTIONS), alone=True):
        for name, (image, _) in made.items():
            for form, more in (("pdf", {"resolution": DPI, "quality": 95}), ("png", {"dpi": (DPI, DPI)})):
                with atomic_path(output / f"{name}.{form}") as temporary:
                    image.save(temporary, format=form, **more)
        write_whole(output / CAPTIONS, "\n".join(text for _, text in made.values()).encode())
    reporter.log(f"{', '.join((*files, CAPTIONS))} -> {output}")


def _draw(figure: PaperFigure, runs: Sequence[tuple[Run, Path]], most: int) -> tuple[Image.Image, str] | None:
    """The figure and its LaTeX; None where no image has all pictures."""
    columns = [name for name in figure.columns if name in (INPUT, HOLE) or any(name in run.methods for run, _ in runs)]
    rows = []
    for run, folder in runs:
        kept = {image: kept_pictures(run, folder, image) for image in run.measured}
        whole = [image for image, pictures in kept.items() if pictures.keys() >= {*columns, HOLE}]
        for place in evenly(len(whole), max(1, most // len(runs))):
            pictures = {name: Image.open(path).convert("RGB") for name, path in kept[whole[place]].items()}
            rows.append(("", [_cell(run, whole[place], name, pictures, figure) for name in columns]))
    if not rows:
        return None
    bases = ", ".join(dict.fromkeys(run.base for run, _ in runs))
    titles = [bases if name == "base" else TITLES.get(name) or METHODS[name].title for name in columns]
    font = round(POINTS / 72 * DPI)
    image = draw_grid(titles, rows, round(WIDTH * DPI / len(columns)), font)
    ours = " and by ".join(title for name, title in zip(columns, titles, strict=True) if name in ("paper", "spackle"))
    return image, _latex(figure, [run for run, _ in runs], bases, ours)


def _cell(run: Run, image: str, name: str, pictures: dict[str, Image.Image], figure: PaperFigure) -> Cell:
    """A picture; where holes have no picture of their own, they are boxed, and shares of Gaussians are tags."""
    if HOLE in figure.columns:
        return Cell(pictures[name])
    if name == "base":
        return Cell(pictures[name], boxes=hole_boxes(pictures[HOLE]))
    view = (image, *run.largest_hole(image), name, "aux_share")
    share = next((row.value for row in run.rows if row[1:6] == view), None)
    return Cell(pictures[name], "" if share is None else f"+{100 * float(share):.2f} %")


def hole_boxes(hole: Image.Image) -> Boxes:
    """Squares, apart from each other, where holes and what is seen beside them share the place; from a white hole."""
    mask = torch.from_numpy(np.asarray(hole.convert("L")) > 127).float()
    height, width = mask.shape
    side = min(round(BOX * max(mask.shape)), *mask.shape)
    share = avg_pool2d(mask[None], side, stride=1)[0]  # by the upper left corners of squares
    score, boxes = share * (1 - share), list[tuple[float, float, float, float]]()
    while len(boxes) < MOST_BOXES and float(score.max()) > LEAST_SCORE:
        y, x = divmod(int(score.argmax()), score.shape[1])
        boxes.append((x / width, y / height, (x + side) / width, (y + side) / height))
        score[max(0, y - side) : y + side, max(0, x - side) : x + side] = 0
    return boxes


def _latex(figure: PaperFigure, runs: Sequence[Run], bases: str, ours: str) -> str:
    """A figure over both columns, with its caption."""
    settings = dict.fromkeys(max(run.settings, key=float) for run in runs)
    weights = dict.fromkeys(run.config["residual"]["weights"] for run in runs)
    says = {"shipped": "The residual has the weights that ship with Spackle, which the paper's recipe did not make."}
    says["seeds"] = "The residual has no weights: its deltas are 0."
    caption = figure.caption.format(
        views=f"disparity {', '.join(settings)}",
        bases=bases,
        ours=ours,
        weights=" ".join(says[name] for name in weights if name in says),
    )
    lines = [r"\begin{figure*}[t]", r"\centering", rf"\includegraphics[width=\textwidth]{{{figure.name}}}"]
    lines += [rf"\caption{{{tex(caption.strip())}}}", rf"\label{{fig:{figure.name}}}", r"\end{figure*}"]
    return "\n".join(lines) + "\n"
