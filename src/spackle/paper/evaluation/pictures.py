"""Pictures of an evaluation: pictures of each image, contact sheets, and the paper's figures (`spackle figures`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.core.color import to_uint8
from spackle.formats.png import thumbnail
from spackle.paper.evaluation.folder import image_file, load_run
from spackle.paper.evaluation.measurements import Run, load_data
from spackle.paper.evaluation.method_descriptions import METHODS
from spackle.paper.evaluation.metrics import METRICS
from spackle.paper.evaluation.protocols import HOLE, INPUT, TRUTH
from spackle.paper.evaluation.table import tex
from spackle.runtime.errors import InputError
from spackle.runtime.files import atomic_path, write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter

WORST, BEST = "worst.png", "best.png"
SHEET_CELL, SHEET_FONT, CASES = 320, 14, 6  # pixels, pixels, rows of a contact sheet
# Images are ranked by the first metric of a protocol that the method has.
ORDER = {
    "near-view": ("distance", "lpips", "psnr_hole"),
    "large-view": ("clipiqa", "musiq", "har", "har_before"),
}
NAMES = {"psnr_hole": "PSNR in the hole ↑", "har": "HAR ↓", "har_before": "the base's HAR ↓"}
LARGE_SIDE = 960  # the most pixels on a stored picture's longer side
QUALITY = 85  # WebP quality
RED = "#e3191c"
OTHERS = (TRUTH, INPUT, HOLE)
UP = ("psnr_hole", "clipiqa", "musiq")  # metrics of `ORDER` for which higher is better
CAPTIONS = "figures.tex"
DPI, WIDTH = 400, 5.5  # dots per inch, and the paper's text width in inches
POINTS = 7  # font size
MOST_BOXES, BOX = (
    2,
    0.22,
)  # the most boxes in a picture; side of a box over the picture's longer side
LEAST_SCORE = 0.02  # the least product of the shares of hole pixels and other pixels in a box

Boxes = Sequence[
    tuple[float, float, float, float]
]  # left, top, right, bottom, as fractions of the picture


class Cell(NamedTuple):
    """A picture in a grid."""

    picture: Image.Image
    tag: str = ""  # text in the top right corner
    boxes: Boxes = ()  # red boxes around details


def draw_grid(
    titles: Sequence[str],
    rows: Sequence[tuple[str, Sequence[Cell]]],
    cell: int,
    font: int,
    heading: str = "",
) -> Image.Image:
    """Draw rows of pictures below the titles of their columns; each row is below its caption.

    Args:
        titles: titles of the columns.
        rows: for each row its caption and a picture for each column.
        cell: width of a picture in pixels.
        font: height of letters in pixels.
        heading: a line above everything.
    """
    gap, line = max(4, font // 3), round(1.5 * font)
    shown = [[_as_wide(one.picture, cell) for one in cells] for _, cells in rows]
    heights = [max(picture.height for picture in pictures) for pictures in shown]
    captions = [line if caption else 0 for caption, _ in rows]
    height = line * (1 + bool(heading)) + sum(heights) + sum(captions) + gap * len(rows)
    canvas = Image.new("RGB", (len(titles) * (cell + gap) - gap, height), "white")
    draw = ImageDraw.Draw(canvas)
    if heading:
        draw.text((gap, line // 2), heading, "black", font_size=font, anchor="lm")
    y = line * bool(heading)
    for column, title in enumerate(titles):
        draw.text(
            (column * (cell + gap) + cell // 2, y + line // 2),
            title,
            "black",
            font_size=font,
            anchor="mm",
        )
    y += line
    for (caption, cells), pictures, tall, above in zip(rows, shown, heights, captions, strict=True):
        if caption:
            draw.text((gap, y + above // 2), caption, "black", font_size=font, anchor="lm")
        y += above
        for column, (one, picture) in enumerate(zip(cells, pictures, strict=True)):
            x = column * (cell + gap)
            canvas.paste(picture, (x, y))
            for left, top, right, bottom in one.boxes:
                near = x + left * cell, y + top * picture.height
                far = x + right * cell - 1, y + bottom * picture.height - 1
                draw.rectangle((near, far), outline=RED, width=max(2, font // 10))
            if one.tag:
                at = x + cell - gap, y + gap
                edges = draw.textbbox(at, one.tag, font_size=font, anchor="ra")
                draw.rectangle(
                    (edges[0] - gap, edges[1] - gap, x + cell, edges[3] + gap), fill="white"
                )
                draw.text(at, one.tag, "black", font_size=font, anchor="ra")
        y += tall + gap
    return canvas


def _as_wide(picture: Image.Image, width: int) -> Image.Image:
    return picture.resize(
        (width, round(width * picture.height / picture.width)), Image.Resampling.LANCZOS
    )


# --- the pictures of an evaluation


def save_picture(picture: Tensor, path: Path) -> None:
    """Write [H, W, 3] sRGB 0..1 as WebP, with a longer side of at most `LARGE_SIDE` pixels."""
    image = Image.fromarray(to_uint8(thumbnail(picture, LARGE_SIDE)).numpy())
    with atomic_path(path) as temporary:
        image.save(temporary, format="WEBP", quality=QUALITY, method=4)


def kept_pictures(run: Run, folder: Path, image: str) -> dict[str, Path]:
    """The stored pictures of an image: by each method, then "truth", "input" and "hole"."""
    index = run.images.index(image)
    files = {
        name: image_file(folder, index, image, f".{name}.webp") for name in (*METHODS, *OTHERS)
    }
    return {name: path for name, path in files.items() if path.is_file()}


def column_title(run: Run, name: str) -> str:
    """The title of a column of pictures."""
    return (
        name if name in OTHERS else f"base ({run.base})" if name == "base" else METHODS[name].title
    )


class Ranking(NamedTuple):
    """Images from best to worst."""

    names: list[str]
    criterion: str  # the metric and method of the ranking
    values: dict[str, float]


def rank(run: Run) -> Ranking | None:
    """Rank a run's images by the method spackle, or else the last method; None if nothing was measured."""
    method = "spackle" if "spackle" in run.methods else run.methods[-1]
    for metric in ORDER[str(run.config["protocol"])]:
        if values := run.by_image(metric, method):
            title = METRICS[metric].title if metric in METRICS else NAMES[metric]
            return Ranking(ranked(values, metric), f"{title} of {METHODS[method].title}", values)
    return None


def write_sheets(run: Run, folder: Path) -> None:
    """Write best.png and worst.png: six images, each by all methods, with the truth. Without a ranking, do nothing."""
    ranking = rank(run)
    if ranking is None:
        return
    columns = [*run.methods, *([TRUTH] if run.near else [])]
    heading = f"{run.title}, {run.config['protocol']}, by {ranking.criterion}"
    heading = heading.replace("↑", "(higher is better)").replace(
        "↓", "(lower is better)"
    )  # the font has no arrows
    for file, order in ((BEST, ranking.names), (WORST, ranking.names[::-1])):
        rows = []
        for name in order[:CASES]:
            pictures = kept_pictures(run, folder, name)
            caption = f"{name}, {' '.join(run.largest_hole(name))}: {ranking.values[name]:.4g}"
            rows.append(
                (caption, [Cell(Image.open(pictures[column]).convert("RGB")) for column in columns])
            )
        titles = [column_title(run, column) for column in columns]
        with atomic_path(folder / file) as temporary:
            draw_grid(titles, rows, SHEET_CELL, SHEET_FONT, heading).save(temporary)


def ranked(values: Mapping[str, float], metric: str) -> list[str]:
    """Names of images from best to worst."""
    sign = -1 if metric in UP else 1
    return sorted(values, key=lambda name: (sign * values[name], name))


def evenly(count: int, most: int) -> list[int]:
    """At most `most` of `count` indices, evenly spaced, including the first and the last."""
    if count <= most:
        return list(range(count))
    return [math.floor(k * (count - 1) / max(1, most - 1) + 0.5) for k in range(most)]


# --- the paper's figures


class PaperFigure(NamedTuple):
    """A figure in the paper's layout."""

    name: str
    columns: Sequence[str]  # names of pictures; methods that no run has are left out
    needs: str
    caption: str


FIGURES = [PaperFigure(name, **facts) for name, facts in load_data("figures.json").items()]
TITLES = {INPUT: "Input", HOLE: "Occluded regions", "direct-ft": "Direct FT"}


def make_figures(folders: Sequence[Path], rows: int, output: Path, reporter: Reporter) -> None:
    """Draw figures from large-view evaluations as PDF and PNG, and write their captions for LaTeX.

    Each image is shown in its view with the largest hole. A figure has at most `rows` images, but at least one per run.

    Raises:
        InputError: a folder has no results, or no large-view evaluation has pictures.
    """
    runs = [(load_run(folder), folder) for folder in folders]
    runs = [(run, folder) for run, folder in runs if not run.timed and not run.near]
    made = {}
    for figure in FIGURES:
        having = [(run, folder) for run, folder in runs if figure.needs in run.methods]
        if drawn := _draw(figure, having, rows):
            made[figure.name] = drawn
    if not made:
        raise InputError(
            f"{folders[0]}: nothing to draw: give folders of `spackle evaluate` with --disparity 0.6"
        )
    for name in [figure.name for figure in FIGURES if figure.name not in made]:
        reporter.log(f"no figure {name}: no large-view run has the pictures of its methods")
    files = [f"{name}.{end}" for name in made for end in ("pdf", "png")]
    with results_folder(output, (*files, CAPTIONS), locked=True):
        for name, (image, _) in made.items():
            for form, more in (
                ("pdf", {"resolution": DPI, "quality": 95}),
                ("png", {"dpi": (DPI, DPI)}),
            ):
                with atomic_path(output / f"{name}.{form}") as temporary:
                    image.save(temporary, format=form, **more)
        write_atomic(output / CAPTIONS, "\n".join(text for _, text in made.values()).encode())
    reporter.log(f"{', '.join((*files, CAPTIONS))} -> {output}")


def _draw(
    figure: PaperFigure, runs: Sequence[tuple[Run, Path]], most: int
) -> tuple[Image.Image, str] | None:
    """Draw a figure; returns the picture and its LaTeX, or None if no image has all pictures."""
    columns = [
        name
        for name in figure.columns
        if name in (INPUT, HOLE) or any(name in run.methods for run, _ in runs)
    ]
    rows = []
    for run, folder in runs:
        kept = {image: kept_pictures(run, folder, image) for image in run.measured}
        whole = [image for image, pictures in kept.items() if pictures.keys() >= {*columns, HOLE}]
        for place in evenly(len(whole), max(1, most // len(runs))):
            pictures = {
                name: Image.open(path).convert("RGB") for name, path in kept[whole[place]].items()
            }
            rows.append(
                ("", [_cell(run, whole[place], name, pictures, figure) for name in columns])
            )
    if not rows:
        return None
    bases = ", ".join(dict.fromkeys(run.base for run, _ in runs))
    titles = [
        bases if name == "base" else TITLES.get(name) or METHODS[name].title for name in columns
    ]
    font = round(POINTS / 72 * DPI)
    image = draw_grid(titles, rows, round(WIDTH * DPI / len(columns)), font)
    ours = " and by ".join(
        title for name, title in zip(columns, titles, strict=True) if name in ("paper", "spackle")
    )
    return image, _latex(figure, [run for run, _ in runs], bases, ours)


def _cell(
    run: Run, image: str, name: str, pictures: dict[str, Image.Image], figure: PaperFigure
) -> Cell:
    """A picture with marks: the base's holes get boxes, a method's picture the share of added Gaussians."""
    if name == HOLE:  # framed, because a hole may be white on a white page
        width, height = pictures[name].size
        ImageDraw.Draw(pictures[name]).rectangle((0, 0, width - 1, height - 1), outline="grey")
    if HOLE in figure.columns:
        return Cell(pictures[name])
    if name == "base":
        return Cell(pictures[name], boxes=hole_boxes(pictures[HOLE]))
    view = (image, *run.largest_hole(image), name, "aux_share")
    share = next((row.value for row in run.rows if row[1:6] == view), None)
    return Cell(pictures[name], "" if share is None else f"+{100 * float(share):.2f} %")


def hole_boxes(hole: Image.Image) -> Boxes:
    """Disjoint boxes in which hole pixels (white) and other pixels mix most evenly."""
    mask = torch.from_numpy(np.asarray(hole.convert("L")) > 127).float()
    height, width = mask.shape
    side = min(round(BOX * max(mask.shape)), *mask.shape)
    share = avg_pool2d(mask[None], side, stride=1)[
        0
    ]  # for each position of a square's upper left corner
    score, boxes = share * (1 - share), list[tuple[float, float, float, float]]()
    while len(boxes) < MOST_BOXES and float(score.max()) > LEAST_SCORE:
        y, x = divmod(int(score.argmax()), score.shape[1])
        boxes.append((x / width, y / height, (x + side) / width, (y + side) / height))
        score[max(0, y - side) : y + side, max(0, x - side) : x + side] = 0
    return boxes


def _latex(figure: PaperFigure, runs: Sequence[Run], bases: str, ours: str) -> str:
    """LaTeX for a figure across both columns, with its caption."""
    settings = dict.fromkeys(max(run.settings, key=float) for run in runs)
    weights = dict.fromkeys(run.config["residual"]["weights"] for run in runs)
    says = {
        "shipped": "The residual has the weights that ship with Spackle, which the paper's recipe did not train."
    }
    says["seeds"] = "The residual has no weights: its deltas are 0."
    caption = figure.caption.format(
        views=f"disparity {', '.join(settings)}",
        bases=bases,
        ours=ours,
        weights=" ".join(says[name] for name in weights if name in says),
    )
    lines = [
        r"\begin{figure*}[t]",
        r"\centering",
        rf"\includegraphics[width=\textwidth]{{{figure.name}}}",
    ]
    lines += [
        rf"\caption{{{tex(caption.strip())}}}",
        rf"\label{{fig:{figure.name}}}",
        r"\end{figure*}",
    ]
    return "\n".join(lines) + "\n"
