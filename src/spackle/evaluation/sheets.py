"""Contact sheets: what the methods make of a photo, side by side, the best and the worst cases one below the other."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import pad

from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.results import ImageResult, Run
from spackle.formats.png import thumbnail

SIDE = 320  # pixels of a thumbnail's longer side
GAP, LINE = 6, 22  # pixels between pictures, and of a line of text
FONT = 14
CASES = 6
TRUTH = "truth"
# A sheet is ordered by the first of these that was measured for the method in question.
ORDER = {"near-view": ("distance", "lpips", "psnr_hole"), "large-view": ("clipiqa", "musiq", "har", "har_before")}
UP = ("psnr_hole", "clipiqa", "musiq")  # higher is better
NAMES = {"psnr_hole": "PSNR in the hole ↑", "har": "HAR ↓", "har_before": "the base's HAR ↓"}


@dataclasses.dataclass(frozen=True)
class Ranking:
    """Images from best to worst."""

    names: list[str]
    criterion: str  # what they were ordered by
    values: dict[str, float]


def strip(pictures: Mapping[str, Tensor]) -> Tensor:
    """Thumbnails of one view by each method, and the truth, in a row with gaps: [h, n · (w + GAP), 3]."""
    return torch.cat([pad(thumbnail(p, SIDE), (0, 0, 0, GAP), value=1.0) for p in pictures.values()], dim=1)


def columns(run: Run) -> list[str]:
    """What a strip shows: the methods, and the truth where there is one."""
    return [*run.methods, *([TRUTH] if run.near else [])]


def rank(run: Run) -> Ranking | None:
    """By the method that matters: Spackle if it was run, else the last one. None where nothing was measured."""
    method = "spackle" if "spackle" in run.methods else run.methods[-1]
    for figure in ORDER[str(run.config["protocol"])]:
        values = {r.name: value for r in run.measured if (value := mean_of(r, figure, method)) is not None}
        if values:
            sign = -1 if figure in UP else 1
            names = sorted(values, key=lambda name: (sign * values[name], name))
            title = METRICS[figure].title if figure in METRICS else NAMES[figure]
            return Ranking(names, f"{title} of {METHODS[method].title}", values)
    return None


def mean_of(record: ImageResult, figure: str, method: str) -> float | None:
    """Over an image's views; None where no view has a number."""
    values = [row.figures.get(figure) for row in record.rows if row.method == method]
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def sheet(run: Run, ranking: Ranking, names: Sequence[str], strips: Mapping[str, Path]) -> Image.Image:
    """A row for each image, captioned; a column for each method, and the truth where there is one."""
    facts = {record.name: record.facts for record in run.measured}
    pictures = {name: Image.open(strips[name]).convert("RGB") for name in names}
    titles = [column_title(run, name) for name in columns(run)]
    width = max(max(picture.width for picture in pictures.values()), SIDE * 2)
    height = sum(picture.height + LINE + GAP for picture in pictures.values()) + LINE
    canvas = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(canvas)
    title = f"{run.title}, {run.config['protocol']}, by {ranking.criterion}"
    title = title.replace("↑", "(higher is better)").replace("↓", "(lower is better)")  # the font has no arrows
    draw.text((4, 3), title, "black", font_size=FONT)
    y = LINE
    for name in names:
        shown = facts[name]["shown"]
        text = f"{name}, {shown['setting']} {shown['view']}: {ranking.values[name]:.4g}"
        draw.text((4, y + 3), text, "black", font_size=FONT)
        canvas.paste(pictures[name], (0, y + LINE))
        for index, title in enumerate(titles):
            at = index * pictures[name].width // len(titles) + 5, y + LINE + 4
            left, top, right, bottom = draw.textbbox(at, title, font_size=FONT)
            draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill="black")
            draw.text(at, title, "white", font_size=FONT)
        y += pictures[name].height + LINE + GAP
    return canvas


def column_title(run: Run, name: str) -> str:
    """What a picture is called."""
    if name == TRUTH:
        return TRUTH
    return f"base ({run.base})" if name == "base" else METHODS[name].title
