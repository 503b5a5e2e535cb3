"""`spackle figures`: the paper's figures of views, from the pictures of evaluations."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch.nn.functional import avg_pool2d

from spackle.core.image_files import open_image
from spackle.paper.evaluation.folder import load_run
from spackle.paper.evaluation.measurements import Run
from spackle.paper.evaluation.method_descriptions import METHODS
from spackle.paper.evaluation.pictures import (
    STORED_FORMATS,
    Box,
    GridPicture,
    GridRow,
    draw_grid,
    evenly_spaced_indices,
    stored_pictures,
)
from spackle.paper.evaluation.protocols import HOLE_PICTURE, INPUT_PICTURE
from spackle.paper.evaluation.table import escape_latex
from spackle.runtime.errors import InputError
from spackle.runtime.files import atomic_path, write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter

CAPTIONS_FILE = "figures.tex"
DOTS_PER_INCH = 400
POINTS_PER_INCH = 72
TEXT_WIDTH_INCHES = 5.5  # of the paper
FONT_POINTS = 7
PDF_QUALITY = 95  # of the JPEG images inside

MAX_BOXES = 2  # in a picture
BOX_SIDE_RATIO = 0.22  # over the picture's longer side
# A box is drawn only if share of hole pixels × share of other pixels in it is above this.
MIN_BOX_SCORE = 0.02


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperFigure:
    """A figure of views in the paper's layout: a row for each image."""

    name: str
    # Names of pictures: "input", "hole" or a method; methods that no run has are left out.
    columns: tuple[str, ...]
    needed_method: str  # the figure shows evaluations with this method
    preferred_method: str = ""  # if some of them have this method, only they are shown
    caption: str  # with {views}, {bases}, {methods} and {weights} to be filled in


COMPARISON = PaperFigure(
    name="comparison",
    columns=("input", "base", "paper-initial", "paper", "spackle"),
    needed_method="base",
    preferred_method="spackle",
    caption=(
        "Qualitative comparison under large viewpoint changes ({views}). From left to right: the "
        "input image, the view rendered from the base ({bases}) with holes in red boxes, and the "
        "views by: {methods}. The tag is the number of added Gaussians in percent of the base's. "
        "{weights}"
    ),
)

DIRECT_FINE_TUNING = PaperFigure(
    name="direct_ft",
    columns=("input", "base", "paper", "direct-ft", "hole"),
    needed_method="direct-ft",
    caption=(
        "Generated supervision applied directly to the base ({views}). From left to right: the "
        "input image, the view rendered from the base ({bases}), the view by {methods}, by the "
        "naive decoupled framework (direct FT), and the occluded regions (white). {weights}"
    ),
)

OWN_METHODS = ("paper-initial", "paper", "spackle")  # a caption names those that are shown
FIGURES = (COMPARISON, DIRECT_FINE_TUNING)
# Titles of columns where they differ from the method's: short, because columns are narrow.
COLUMN_TITLES = {
    "input": "Input",
    "base": "Base alone",
    "paper-initial": "Initial Gaussians",
    "paper": "Eqs. 2 to 9",
    "spackle": "Spackle",
    "direct-ft": "Direct FT",
    "hole": "Occluded regions",
}

# Where the residual network's weights came from, in the words of a row's label.
WEIGHTS_WORDS = {
    "shipped": "Spackle's own weights",
    "given": "given weights ({digest})",
    "initial": "no weights",
}
# Sentences of a caption about the residual network's weights, by where they came from.
WEIGHTS_SENTENCES = {
    "shipped": (
        "The residual has the weights that ship with Spackle, which the paper's recipe did not "
        "train."
    ),
    "initial": "The residual has no weights: its deltas are 0.",
}


class RunWithFolder(NamedTuple):
    """The results of an evaluation, and the folder that has their pictures."""

    run: Run
    folder: Path


class DrawnFigure(NamedTuple):
    """A figure's picture, and the LaTeX that includes it."""

    picture: Image.Image
    latex: str


def make_figures(folders: Sequence[Path], max_rows: int, output: Path, reporter: Reporter) -> None:
    """Draw the paper's figures as PDF and PNG, and write their captions for LaTeX.

    Each image is shown in its view with the largest hole, the area that the base leaves open.

    Args:
        folders: results of `spackle evaluate`; those of large camera moves are shown.
        max_rows: the most images in a figure; but there is at least one of each evaluation.
        output: the folder for the files.
        reporter: gets a line about what was written, and about figures that could not be drawn.

    Raises:
        InputError: a folder has no results, or no evaluation of large camera moves has pictures.
    """
    all_runs = [RunWithFolder(load_run(folder), folder) for folder in folders]
    large_runs = [
        source
        for source in all_runs
        if not source.run.is_benchmark and not source.run.compares_with_photos
    ]

    # A figure that needs a method which no evaluation has is left out.
    drawn_figures = {}
    for figure in FIGURES:
        shown_runs = _runs_of_figure(figure, large_runs)
        drawn = _draw_figure(figure, shown_runs, max_rows)
        if drawn is not None:
            drawn_figures[figure.name] = drawn

    if not drawn_figures:
        raise InputError(
            f"{folders[0]}: nothing to draw: give folders of `spackle evaluate` with "
            "`disparity` 0.6"
        )
    for figure in FIGURES:
        if figure.name not in drawn_figures:
            reporter.log(
                f"no figure {figure.name}: no large-view run has the pictures of its methods"
            )

    files = [f"{name}.{suffix}" for name in drawn_figures for suffix in ("pdf", "png")]
    files.append(CAPTIONS_FILE)
    with results_folder(output, files, locked=True):
        _write_figures(drawn_figures, output)
    reporter.log(f"{', '.join(files)} -> {output}")


def _runs_of_figure(figure: PaperFigure, runs: Sequence[RunWithFolder]) -> list[RunWithFolder]:
    """The evaluations that a figure shows: those with the methods that it needs or prefers."""
    possible = [source for source in runs if figure.needed_method in source.run.methods]
    preferred = [source for source in possible if figure.preferred_method in source.run.methods]
    return preferred or possible


def _write_figures(drawn_figures: Mapping[str, DrawnFigure], output: Path) -> None:
    """Write each figure as NAME.pdf and NAME.png, and the LaTeX of all as figures.tex."""
    for name, drawn in drawn_figures.items():
        with atomic_path(output / f"{name}.pdf") as temporary:
            drawn.picture.save(
                temporary, format="pdf", resolution=DOTS_PER_INCH, quality=PDF_QUALITY
            )
        with atomic_path(output / f"{name}.png") as temporary:
            drawn.picture.save(temporary, format="png", dpi=(DOTS_PER_INCH, DOTS_PER_INCH))

    latex = "\n".join(drawn.latex for drawn in drawn_figures.values())
    write_atomic(output / CAPTIONS_FILE, latex.encode())


def _draw_figure(
    figure: PaperFigure, runs: Sequence[RunWithFolder], max_rows: int
) -> DrawnFigure | None:
    """Draw a figure with images of these evaluations; None if no image has all pictures.

    `max_rows` is the most images in the figure; but there is at least one of each evaluation.
    """
    columns = _drawn_columns(figure, runs)

    # Boxes are drawn around holes, so the picture of the hole is needed even if it is not shown.
    needed_pictures = [*columns, HOLE_PICTURE]
    images_of_runs = []
    for run, folder in runs:
        complete_images = []
        for image in run.measured_images:
            files = stored_pictures(run, folder, image)
            if all(name in files for name in needed_pictures):
                complete_images.append(image)
        images_of_runs.append(complete_images)

    rows = []
    row_counts = _share_rows([len(images) for images in images_of_runs], max_rows)
    for (run, folder), images, count in zip(runs, images_of_runs, row_counts, strict=True):
        for index in evenly_spaced_indices(len(images), count):
            rows.append(_figure_row(figure, columns, run, folder, images[index]))
    if not rows:
        return None

    # Each base is named once, because evaluations usually have the same.
    bases = ", ".join(dict.fromkeys(run.base_title for run, _ in runs))
    picture = draw_grid(
        [COLUMN_TITLES.get(column) or METHODS[column].title for column in columns],
        rows,
        picture_width=round(TEXT_WIDTH_INCHES * DOTS_PER_INCH / len(columns)),
        font_size=round(FONT_POINTS / POINTS_PER_INCH * DOTS_PER_INCH),
    )

    # The caption says which of our own methods the figure shows.
    own_titles = [METHODS[name].title for name in columns if name in OWN_METHODS]
    latex = _figure_latex(figure, [run for run, _ in runs], bases, "; ".join(own_titles))
    return DrawnFigure(picture, latex)


def _share_rows(image_counts: Sequence[int], max_rows: int) -> list[int]:
    """How many rows of a figure each evaluation gets; a row shows one image.

    Each evaluation that has images gets at least one row. Then evaluations take turns to get one
    row more, until the figure has `max_rows` or all images are shown.

    Args:
        image_counts: the number of images that each evaluation has.
        max_rows: the most rows of all evaluations together, if this leaves one for each.
    """
    row_counts = [min(1, count) for count in image_counts]
    while sum(row_counts) < max_rows:
        open_indices = [
            index for index, count in enumerate(image_counts) if row_counts[index] < count
        ]
        if not open_indices:
            break
        # It is the turn of the evaluation with the fewest rows.
        row_counts[min(open_indices, key=lambda index: row_counts[index])] += 1
    return row_counts


def _drawn_columns(figure: PaperFigure, runs: Sequence[RunWithFolder]) -> list[str]:
    """The columns of a figure for which any of these evaluations has pictures."""
    methods = {method for run, _ in runs for method in run.methods}
    return [
        column
        for column in figure.columns
        if column in (INPUT_PICTURE, HOLE_PICTURE) or column in methods
    ]


def _figure_row(
    figure: PaperFigure, columns: Sequence[str], run: Run, folder: Path, image: str
) -> GridRow:
    """An image's pictures for a figure, with boxes, tags or a frame.

    Args:
        figure: the figure.
        columns: the names of the pictures: "input", "hole" or a method.
        run: the results of an evaluation.
        folder: the folder that has their pictures.
        image: the image's name.
    """
    files = stored_pictures(run, folder, image)
    pictures = {
        name: open_image(path, STORED_FORMATS).convert("RGB") for name, path in files.items()
    }
    shows_hole = HOLE_PICTURE in figure.columns

    row = []
    for name in columns:
        picture = pictures[name]
        boxes: list[Box] = []
        tag = ""
        if name == HOLE_PICTURE:
            _draw_frame(picture)
        # A figure with a picture of the hole itself needs no boxes and no tags.
        elif not shows_hole:
            if name == "base":
                boxes = find_hole_boxes(pictures[HOLE_PICTURE])
            else:
                tag = _added_share_tag(run, image, name)
        row.append(GridPicture(picture, tag, boxes))
    return GridRow(_row_label(run, image), row)


def _row_label(run: Run, image: str) -> str:
    """The line above an image's pictures: scene, base, view and the residual network's weights.

    It is drawn into the figure, which may be copied without its caption.
    """
    setting, view = run.view_with_largest_hole(image)
    residual = run.config["residual"]
    weights = WEIGHTS_WORDS[str(residual["weights"])].format(digest=str(residual["sha256"])[:8])
    return (
        f"{run.title}, {image}. Base: {run.base_title}. Disparity {setting}, {view}. "
        f"Residual: {weights}."
    )


def _draw_frame(picture: Image.Image) -> None:
    """Draw a grey line around a picture, in place: a hole may be white on a white page."""
    width, height = picture.size
    ImageDraw.Draw(picture).rectangle((0, 0, width - 1, height - 1), outline="grey")


def _added_share_tag(run: Run, image: str, method: str) -> str:
    """How many Gaussians a method added, in percent of the base's, such as "+1.25 %".

    Empty if none were counted, as for the input photo.

    Args:
        run: the results of an evaluation.
        image: the image's name.
        method: the method's name, or that of another picture.
    """
    # Numbers differ from view to view; pictures show the view with the largest hole.
    setting, view = run.view_with_largest_hole(image)
    for measurement in run.measurements:
        is_shown = (
            measurement.image == image
            and measurement.setting == setting
            and measurement.view == view
            and measurement.method == method
        )
        if is_shown and measurement.metric == "aux_share" and measurement.value is not None:
            return f"+{100 * float(measurement.value):.2f} %"
    return ""


def find_hole_boxes(hole: Image.Image) -> list[Box]:
    """At most two boxes, apart from each other, in which about half of the pixels are a hole.

    A hole is white in `hole`. In such a box the reader sees what was filled, and the surroundings
    to which it has to fit. A box's score is the share of hole pixels times the share of other
    pixels, which is largest (1/4) if both are one half.
    """
    # WebP blurs edges a little, so all pixels above half of white (255) count as white.
    is_hole = torch.from_numpy(np.asarray(hole.convert("L")) > 127).float()  # [H, W]
    height, width = is_hole.shape
    side = min(round(BOX_SIDE_RATIO * max(height, width)), height, width)

    # For each position of a square's upper left corner: [H - side + 1, W - side + 1].
    hole_share = avg_pool2d(is_hole[None], side, stride=1)[0]
    score = hole_share * (1 - hole_share)

    boxes: list[Box] = []
    while len(boxes) < MAX_BOXES and float(score.max()) > MIN_BOX_SCORE:
        # `argmax` counts positions row by row.
        y, x = divmod(int(score.argmax()), score.shape[1])
        boxes.append((x / width, y / height, (x + side) / width, (y + side) / height))

        # No later box may overlap this one.
        score[max(0, y - side) : y + side, max(0, x - side) : x + side] = 0
    return boxes


def _figure_latex(figure: PaperFigure, runs: Sequence[Run], bases: str, methods: str) -> str:
    """LaTeX for a figure across both columns of a page, with its caption.

    Args:
        figure: the figure.
        runs: the evaluations that it shows.
        bases: the names of the bases, such as "SHARP, MoGe", for the caption.
        methods: the names of our methods in the figure, such as "Spackle", for the caption.
    """
    # The figure shows views with the largest hole, which are those of the largest disparity (size
    # of the camera move). Settings are disparities as text.
    largest_disparities = dict.fromkeys(max(run.settings, key=float) for run in runs)

    # The caption says so if the residual network was not trained by the paper's recipe. There is
    # no sentence on weights that the user gave.
    weights = dict.fromkeys(run.config["residual"]["weights"] for run in runs)
    weights_sentences = [WEIGHTS_SENTENCES[name] for name in weights if name in WEIGHTS_SENTENCES]

    caption = figure.caption.format(
        views=f"disparity {', '.join(largest_disparities)}",
        bases=bases,
        methods=methods,
        weights=" ".join(weights_sentences),
    )
    lines = [
        r"\begin{figure*}[t]",
        r"\centering",
        rf"\includegraphics[width=\textwidth]{{{figure.name}}}",
        rf"\caption{{{escape_latex(caption.strip())}}}",
        rf"\label{{fig:{figure.name}}}",
        r"\end{figure*}",
    ]
    return "\n".join(lines) + "\n"
