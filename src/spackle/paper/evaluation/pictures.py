"""Pictures of each image, and contact sheets of the best and the worst images."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from PIL import Image, ImageDraw
from torch import Tensor

from spackle.core.color import to_uint8
from spackle.core.image_files import open_image
from spackle.formats.png import thumbnail
from spackle.paper.evaluation.folder import image_file
from spackle.paper.evaluation.measurements import Run
from spackle.paper.evaluation.method_descriptions import describe_method
from spackle.paper.evaluation.metrics import METRICS
from spackle.paper.evaluation.protocols import HOLE_PICTURE, INPUT_PICTURE, TRUE_PICTURE
from spackle.runtime.files import atomic_path

WORST_SHEET_FILE = "worst.png"
BEST_SHEET_FILE = "best.png"
SHEET_PICTURE_PX = 320  # width of a picture in a contact sheet
SHEET_FONT_PX = 14
SHEET_IMAGES = 6  # rows of a contact sheet

MAX_STORED_SIDE_PX = 960  # the most pixels on a stored picture's longer side
STORED_FORMATS = ("WEBP",)  # of stored pictures, by Pillow's names
WEBP_QUALITY = 85
WEBP_EFFORT = 4  # of 0 to 6; higher is slower and smaller

BOX_COLOR = "#e3191c"  # red
OTHER_PICTURES = (TRUE_PICTURE, INPUT_PICTURE, HOLE_PICTURE)  # those that no method made

# Images are ranked by the first metric of a protocol that their method has.
RANKING_METRICS = {
    "near-view": ("distance", "lpips", "psnr_hole"),
    "large-view": ("clipiqa", "musiq", "har", "har_before"),
}
RANKING_METRICS_HIGHER_IS_BETTER = ("psnr_hole", "clipiqa", "musiq")
# Titles of the ranking metrics that are not in `METRICS`.
RANKING_TITLES = {
    "psnr_hole": "PSNR in the hole ↑",
    "har": "HAR ↓",
    "har_before": "the base's HAR ↓",
}

# Left, top, right and bottom of a box, as fractions of a picture's width and height.
Box = tuple[float, float, float, float]


class GridPicture(NamedTuple):
    """A picture in a grid, with what is drawn over it."""

    picture: Image.Image
    tag: str = ""  # text in the top right corner
    boxes: Sequence[Box] = ()  # red boxes around details


class GridRow(NamedTuple):
    """A row of a grid: one picture for each column, below a caption."""

    caption: str  # "": no space is left for it
    pictures: Sequence[GridPicture]


TAG_SCALE = 0.7  # height of a tag's letters over that of the titles'


def draw_grid(
    titles: Sequence[str],
    rows: Sequence[GridRow],
    picture_width: int,
    font_size: int,
    heading: str = "",
) -> Image.Image:
    """Draw rows of pictures below the titles of their columns.

    Args:
        titles: titles of the columns.
        rows: for each row its caption and a picture for each column.
        picture_width: width of each picture, in pixels.
        font_size: height of letters, in pixels.
        heading: a line above everything; "": no space is left for it.
    """
    gap = max(4, font_size // 3)  # between pictures, in pixels
    line_height = round(1.5 * font_size)

    # All pictures have one width. A row is as high as its highest picture.
    resized_rows = [
        [_resized_to_width(grid_picture.picture, picture_width) for grid_picture in row.pictures]
        for row in rows
    ]
    row_heights = [max(picture.height for picture in pictures) for pictures in resized_rows]
    caption_heights = [line_height if row.caption else 0 for row in rows]
    heading_height = line_height if heading else 0

    width = len(titles) * (picture_width + gap) - gap
    height = heading_height + line_height  # the titles' line
    height += sum(row_heights) + sum(caption_heights) + gap * len(rows)
    canvas = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(canvas)

    # `y` is where the next line or row begins. A text's anchor is its left end ("l") or its middle
    # ("m") horizontally, and its middle vertically.
    if heading:
        draw.text((gap, line_height // 2), heading, "black", font_size=font_size, anchor="lm")
    y = heading_height

    for column, title in enumerate(titles):
        middle = (column * (picture_width + gap) + picture_width // 2, y + line_height // 2)
        draw.text(middle, title, "black", font_size=font_size, anchor="mm")
    y += line_height

    for index, row in enumerate(rows):
        caption_height = caption_heights[index]
        if row.caption:
            place = (gap, y + caption_height // 2)
            draw.text(place, row.caption, "black", font_size=font_size, anchor="lm")
        y += caption_height

        _draw_row(canvas, row.pictures, resized_rows[index], y, gap, font_size)
        y += row_heights[index] + gap
    return canvas


def _draw_row(
    canvas: Image.Image,
    pictures: Sequence[GridPicture],
    resized_pictures: Sequence[Image.Image],
    y: int,
    gap: int,
    font_size: int,
) -> None:
    """Draw a row of pictures side by side, with their boxes and tags.

    Args:
        canvas: the image to draw on.
        pictures: the boxes and tags.
        resized_pictures: the same pictures in the size in which they are drawn.
        y: where the row begins, in pixels from the top.
        gap: between pictures, in pixels.
        font_size: height of the titles' letters, in pixels.
    """
    draw = ImageDraw.Draw(canvas)
    box_line_width = max(2, font_size // 10)
    x = 0
    for grid_picture, resized in zip(pictures, resized_pictures, strict=True):
        canvas.paste(resized, (x, y))
        _draw_boxes(draw, grid_picture.boxes, (x, y), resized.size, box_line_width)
        if grid_picture.tag:
            # Smaller than the titles, because a tag covers a part of the picture.
            tag_size = round(TAG_SCALE * font_size)
            _draw_tag(draw, grid_picture.tag, (x + resized.width, y), gap // 2, tag_size)
        x += resized.width + gap


def _draw_boxes(
    draw: ImageDraw.ImageDraw,
    boxes: Sequence[Box],
    corner: tuple[int, int],
    size: tuple[int, int],
    line_width: int,
) -> None:
    """Draw red boxes over a picture.

    Args:
        draw: draws on the canvas.
        boxes: as fractions of the picture's size.
        corner: (x, y) of the picture's upper left corner on the canvas, in pixels.
        size: (width, height) of the picture, in pixels.
        line_width: of the boxes, in pixels.
    """
    x, y = corner
    width, height = size
    for left, top, right, bottom in boxes:
        upper_left = (x + left * width, y + top * height)
        # The last pixels inside the box, because `rectangle` draws them, too.
        lower_right = (x + right * width - 1, y + bottom * height - 1)
        draw.rectangle((upper_left, lower_right), outline=BOX_COLOR, width=line_width)


def _draw_tag(
    draw: ImageDraw.ImageDraw, tag: str, corner: tuple[int, int], gap: int, font_size: int
) -> None:
    """Write a short text on white into a picture's upper right corner.

    Args:
        draw: draws on the canvas.
        tag: the text.
        corner: (x, y) of the picture's upper right corner on the canvas, in pixels.
        gap: white space around the text, in pixels.
        font_size: height of letters, in pixels.
    """
    x, y = corner
    # The anchor "ra" (right, ascender) means that `text_corner` is the text's upper right corner.
    text_corner = (x - gap, y + gap)
    left, top, _, bottom = draw.textbbox(text_corner, tag, font_size=font_size, anchor="ra")
    draw.rectangle((left - gap, top - gap, x, bottom + gap), fill="white")
    draw.text(text_corner, tag, "black", font_size=font_size, anchor="ra")


def _resized_to_width(picture: Image.Image, width: int) -> Image.Image:
    """A picture with this width in pixels, and the same aspect ratio."""
    height = round(width * picture.height / picture.width)
    return picture.resize((width, height), Image.Resampling.LANCZOS)


# --- the pictures of an evaluation


def picture_file(output: Path, index: int, image: str, name: str) -> Path:
    """The path of an image's picture in a folder of results.

    Args:
        output: the folder.
        index: the image's place in the dataset.
        image: the image's name.
        name: the picture's name: a method, "truth", "input" or "hole".
    """
    # A method of another package is named package.module:Name, which not all systems allow.
    safe_name = re.sub(r"[^A-Za-z0-9-]+", "_", name)
    return image_file(output, index, image, f".{safe_name}.webp")


def save_picture(picture: Tensor, path: Path) -> None:
    """Write [H, W, 3] sRGB 0..1 as WebP, with a longer side of at most 960 pixels."""
    image = Image.fromarray(to_uint8(thumbnail(picture, MAX_STORED_SIDE_PX)).numpy())
    with atomic_path(path) as temporary:
        image.save(temporary, format="WEBP", quality=WEBP_QUALITY, method=WEBP_EFFORT)


def stored_pictures(run: Run, folder: Path, image: str) -> dict[str, Path]:
    """The files of an image's pictures, by the picture's name: a method, "truth", "input", "hole".

    Pictures without a file are left out.

    Args:
        run: the results of an evaluation.
        folder: their folder.
        image: the image's name.
    """
    # Files are numbered by the image's place in the dataset.
    index = run.images.index(image)
    # `OTHER_PICTURES` are those that no method made: "truth", "input" and "hole".
    paths = {
        name: picture_file(folder, index, image, name) for name in (*run.methods, *OTHER_PICTURES)
    }
    return {name: path for name, path in paths.items() if path.is_file()}


def picture_title(run: Run, name: str) -> str:
    """The title of a column of pictures: a method's title, or "truth", "input" or "hole"."""
    if name in OTHER_PICTURES:
        return name
    if name == "base":
        return f"base ({run.base_title})"
    return describe_method(name).title


class Ranking(NamedTuple):
    """The images of an evaluation, from best to worst."""

    names: list[str]
    criterion: str  # the titles of the metric and of the method
    values: dict[str, float]  # each image's mean of the metric


def ranking_of_run(run: Run) -> Ranking | None:
    """The images of a run from best to worst; None if nothing was measured.

    They are ranked by the results of one method (a way to render new views of a photo): "spackle",
    or the last one if the run lacks it. The metric is the first of `RANKING_METRICS` that was
    measured.
    """
    method = "spackle" if "spackle" in run.methods else run.methods[-1]
    # A metric may be missing, because it was not chosen or its package is not installed.
    for metric in RANKING_METRICS[str(run.config["protocol"])]:
        values = run.mean_by_image(metric, method)
        if values:
            # Numbers such as the hole area ratio are no image metrics: `METRICS` lacks their title.
            title = METRICS[metric].title if metric in METRICS else RANKING_TITLES[metric]
            criterion = f"{title} of {describe_method(method).title}"
            return Ranking(best_first(values, metric), criterion, values)
    return None


def best_first(values: Mapping[str, float], metric: str) -> list[str]:
    """The names of images from best to worst; images with equal values are in the order of names.

    Args:
        values: for each image's name its value.
        metric: the metric of the values; it says whether higher is better.
    """
    sign = -1 if metric in RANKING_METRICS_HIGHER_IS_BETTER else 1
    return sorted(values, key=lambda name: (sign * values[name], name))


def write_contact_sheets(run: Run, folder: Path) -> None:
    """Write best.png and worst.png: six images each, by all methods, with the true picture.

    If no image could be measured, nothing is written.

    Args:
        run: the results of an evaluation.
        folder: the folder that has their pictures.
    """
    ranking = ranking_of_run(run)
    if ranking is None:
        return

    # Large camera moves have no true picture.
    names = [*run.methods, TRUE_PICTURE] if run.compares_with_photos else run.methods
    titles = [picture_title(run, name) for name in names]
    heading = (
        f"{run.title}, base {run.base_title}, {run.config['protocol']}, by {ranking.criterion}"
    )
    # The font has no arrows.
    heading = heading.replace("↑", "(higher is better)").replace("↓", "(lower is better)")

    # The ranking is best first, so the reversed list begins with the worst image.
    for file, images in (
        (BEST_SHEET_FILE, ranking.names),
        (WORST_SHEET_FILE, ranking.names[::-1]),
    ):
        rows = [
            _contact_sheet_row(run, folder, image, names, ranking.values[image])
            for image in images[:SHEET_IMAGES]
        ]
        sheet = draw_grid(titles, rows, SHEET_PICTURE_PX, SHEET_FONT_PX, heading)
        with atomic_path(folder / file) as temporary:
            sheet.save(temporary)


def _contact_sheet_row(
    run: Run, folder: Path, image: str, names: Sequence[str], value: float
) -> GridRow:
    """An image's row in a contact sheet.

    Args:
        run: the results of an evaluation.
        folder: the folder that has their pictures.
        image: the image's name.
        names: which pictures: names of methods, or "truth".
        value: the image's value of the metric that ranks images, for the caption.
    """
    # The stored pictures are those of this view.
    setting, view = run.view_with_largest_hole(image)
    files = stored_pictures(run, folder, image)
    pictures = [
        GridPicture(open_image(files[name], STORED_FORMATS).convert("RGB")) for name in names
    ]
    return GridRow(f"{image}, {setting} {view}: {value:.4g}", pictures)


def evenly_spaced_indices(count: int, max_count: int) -> list[int]:
    """At most `max_count` of the indices 0 to count - 1, evenly spaced, with both ends."""
    if count <= max_count:
        return list(range(count))
    intervals = max(1, max_count - 1)
    # Half a step is added, so that indices are rounded to the nearest.
    return [math.floor(k * (count - 1) / intervals + 0.5) for k in range(max_count)]
