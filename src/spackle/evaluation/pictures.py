"""Pictures of an evaluation: those that it keeps of each image, and a grid of them with titles, captions and tags."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image, ImageDraw
from torch import Tensor

from spackle.color import to_bytes
from spackle.evaluation.folder import image_file
from spackle.evaluation.methods import METHODS
from spackle.evaluation.metrics import METRICS
from spackle.evaluation.plots import ranked
from spackle.evaluation.protocols import HOLE, INPUT, TRUTH
from spackle.evaluation.rows import Run
from spackle.files import atomic_path
from spackle.formats.png import thumbnail

WORST, BEST = "worst.png", "best.png"
SHEET_CELL, SHEET_FONT, CASES = 320, 14, 6  # pixels, pixels, rows of a contact sheet
# Images are ordered by the first of these that was measured for the method in question.
ORDER = {"near-view": ("distance", "lpips", "psnr_hole"), "large-view": ("clipiqa", "musiq", "har", "har_before")}
NAMES = {"psnr_hole": "PSNR in the hole ↑", "har": "HAR ↓", "har_before": "the base's HAR ↓"}
LARGE_SIDE = 960  # pixels of a kept picture's longer side at most
QUALITY = 85  # of WebP
RED = "#e3191c"
OTHERS = (TRUTH, INPUT, HOLE)

Boxes = Sequence[tuple[float, float, float, float]]  # left, top, right, bottom, as shares of the picture


class Cell(NamedTuple):
    """A picture of a grid."""

    picture: Image.Image
    tag: str = ""  # in its top right corner
    boxes: Boxes = ()  # drawn around what is to be looked at


def draw_grid(
    titles: Sequence[str], rows: Sequence[tuple[str, Sequence[Cell]]], cell: int, font: int, heading: str = ""
) -> Image.Image:
    """Rows of pictures below the titles of their columns; a row's caption stands above it.

    Args:
        titles: of the columns.
        rows: captions, and as many pictures as there are columns.
        cell: width of a picture in pixels.
        font: height of letters in pixels.
        heading: a line above all.
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
        draw.text((column * (cell + gap) + cell // 2, y + line // 2), title, "black", font_size=font, anchor="mm")
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
                draw.rectangle((edges[0] - gap, edges[1] - gap, x + cell, edges[3] + gap), fill="white")
                draw.text(at, one.tag, "black", font_size=font, anchor="ra")
        y += tall + gap
    return canvas


def _as_wide(picture: Image.Image, width: int) -> Image.Image:
    return picture.resize((width, round(width * picture.height / picture.width)), Image.Resampling.LANCZOS)


# --- what an evaluation keeps


def save_picture(picture: Tensor, path: Path) -> None:
    """[H, W, 3] sRGB 0..1 as WebP, smaller where it is large."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode(Image.fromarray(to_bytes(thumbnail(picture, LARGE_SIDE)).numpy())))


def encode(image: Image.Image) -> bytes:
    """As WebP; the same picture gives the same bytes."""
    file = io.BytesIO()
    image.save(file, format="WEBP", quality=QUALITY, method=4)
    return file.getvalue()


def kept_pictures(run: Run, folder: Path, image: str) -> dict[str, Path]:
    """The files of an image's pictures that are there, by what they show: methods in their order, the truth, others."""
    files = {name: image_file(folder, run.images.index(image), image, f".{name}.webp") for name in (*METHODS, *OTHERS)}
    return {name: path for name, path in files.items() if path.is_file()}


def column_title(run: Run, name: str) -> str:
    """What a picture is called."""
    return name if name in OTHERS else f"base ({run.base})" if name == "base" else METHODS[name].title


class Ranking(NamedTuple):
    """Images from best to worst."""

    names: list[str]
    criterion: str  # what they were ordered by
    values: dict[str, float]


def rank(run: Run) -> Ranking | None:
    """By the method that matters: Spackle if it was run, else the last one. None where nothing was measured."""
    method = "spackle" if "spackle" in run.methods else run.methods[-1]
    for metric in ORDER[str(run.config["protocol"])]:
        if values := run.by_image(metric, method):
            title = METRICS[metric].title if metric in METRICS else NAMES[metric]
            return Ranking(ranked(values, metric), f"{title} of {METHODS[method].title}", values)
    return None


def write_sheets(run: Run, folder: Path) -> None:
    """best.png and worst.png: six images by each method, and the truth; none where nothing was measured."""
    ranking = rank(run)
    if ranking is None:
        return
    columns = [*run.methods, *([TRUTH] if run.near else [])]
    heading = f"{run.title}, {run.config['protocol']}, by {ranking.criterion}"
    heading = heading.replace("↑", "(higher is better)").replace("↓", "(lower is better)")  # the font has no arrows
    for file, order in ((BEST, ranking.names), (WORST, ranking.names[::-1])):
        rows = []
        for name in order[:CASES]:
            pictures = kept_pictures(run, folder, name)
            caption = f"{name}, {' '.join(run.largest_hole(name))}: {ranking.values[name]:.4g}"
            rows.append((caption, [Cell(Image.open(pictures[column]).convert("RGB")) for column in columns]))
        titles = [column_title(run, column) for column in columns]
        with atomic_path(folder / file) as temporary:
            draw_grid(titles, rows, SHEET_CELL, SHEET_FONT, heading).save(temporary)
