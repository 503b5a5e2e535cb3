"""Contact sheets: what the methods make of a photo, side by side, the best and the worst cases one below the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from PIL import Image, ImageDraw
from torch import Tensor
from torch.nn.functional import pad

from spackle.evaluation.folder import image_file
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.protocols import TRUTH
from spackle.evaluation.rows import Run
from spackle.files import atomic_path
from spackle.formats.png import thumbnail

WORST, BEST = "worst.png", "best.png"
SIDE = 320  # pixels of a thumbnail's longer side
GAP, LINE = 6, 22  # pixels between pictures, and of a line of text
FONT = 14
CASES = 6
# A sheet is ordered by the first of these that was measured for the method in question.
ORDER = {"near-view": ("distance", "lpips", "psnr_hole"), "large-view": ("clipiqa", "musiq", "har", "har_before")}
UP = ("psnr_hole", "clipiqa", "musiq")  # higher is better
NAMES = {"psnr_hole": "PSNR in the hole ↑", "har": "HAR ↓", "har_before": "the base's HAR ↓"}


class Ranking(NamedTuple):
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


def column_title(run: Run, name: str) -> str:
    """What a picture is called."""
    return TRUTH if name == TRUTH else f"base ({run.base})" if name == "base" else METHODS[name][0]


def ranked(values: Mapping[str, float], metric: str) -> list[str]:
    """Images from best to worst."""
    sign = -1 if metric in UP else 1
    return sorted(values, key=lambda name: (sign * values[name], name))


def rank(run: Run) -> Ranking | None:
    """By the method that matters: Spackle if it was run, else the last one. None where nothing was measured."""
    method = "spackle" if "spackle" in run.methods else run.methods[-1]
    for metric in ORDER[str(run.config["protocol"])]:
        if values := run.by_image(metric, method):
            title = METRICS[metric].title if metric in METRICS else NAMES[metric]
            return Ranking(ranked(values, metric), f"{title} of {METHODS[method][0]}", values)
    return None


def write_sheets(run: Run, folder: Path) -> None:
    """best.png and worst.png of the strips in a folder; none where nothing was measured."""
    if ranking := rank(run):
        strips = {name: image_file(folder, k, name, ".png") for k, name in enumerate(run.images)}
        for name, order in ((BEST, ranking.names), (WORST, ranking.names[::-1])):
            with atomic_path(folder / name) as temporary:
                sheet(run, ranking, order[:CASES], strips).save(temporary)


def sheet(run: Run, ranking: Ranking, names: Sequence[str], strips: Mapping[str, Path]) -> Image.Image:
    """A row for each image, captioned; a column for each method, and the truth where there is one."""
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
        text = f"{name}, {' '.join(run.largest_hole(name))}: {ranking.values[name]:.4g}"
        draw.text((4, y + 3), text, "black", font_size=FONT)
        canvas.paste(pictures[name], (0, y + LINE))
        for index, title in enumerate(titles):
            at = index * pictures[name].width // len(titles) + 5, y + LINE + 4
            left, top, right, bottom = draw.textbbox(at, title, font_size=FONT)
            draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill="black")
            draw.text(at, title, "white", font_size=FONT)
        y += pictures[name].height + LINE + GAP
    return canvas
