"""A picture of many worlds, to look at: photos alone, or each with its depth and second views.

PYTHONPATH=src:research python -m worlds.world_sheet FOLDER -o sheet.png --count 48
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.cli.script_command import check_picture_file, run_script
from spackle.runtime.errors import InputError
from worlds.shards import ROOMS_PREFIX, StoredView, read_view, world_keys

Bytes = NDArray[np.uint8]
TILE = (252, 336)  # height and width of a picture on the sheet
COLUMNS = 6
SECOND_SHOWN = (1, 3, 5)  # second views beside a photo


def depth_picture(view: StoredView) -> Bytes:
    """[H, W, 3] inverse depth from dark (far) to light (near); red: seen through glass."""
    known = view.depth > 0
    inverse = np.where(known, 1 / np.maximum(view.depth, 1e-6), 0.0)
    high = float(np.quantile(inverse[known], 0.98)) if known.any() else 1.0
    grey = np.clip(inverse / high, 0, 1) ** 0.7
    picture = np.repeat((grey * 255).astype(np.uint8)[..., None], 3, -1)
    picture[view.valid == 0] = (120, 20, 20)
    picture[view.valid == 2] = (20, 30, 90)  # the sky
    return picture


def _tile(picture: Bytes) -> Bytes:
    """The picture on a tile of its shape, with dark borders."""
    height, width = TILE
    small = Image.fromarray(picture)
    small.thumbnail((width, height), Image.Resampling.LANCZOS)
    tile = Image.new("RGB", (width, height), (24, 24, 24))
    tile.paste(small, ((width - small.width) // 2, (height - small.height) // 2))
    return np.asarray(tile)


def sheet(
    folder: Path, count: int, with_views: bool, first: int = 0, prefix: str = ROOMS_PREFIX
) -> Bytes:
    """[H, W, 3] the photos of `count` worlds; `with_views`: a row each with depth and views.

    Args:
        folder: of archives.
        count: at most this many worlds.
        with_views: whether each world gets a row.
        first: how many worlds are passed over.
        prefix: how the archives' names begin.

    Raises:
        InputError: there is no world to show.
    """
    tiles: list[list[Bytes]] = []
    for path in sorted(folder.glob(f"{prefix}-*.tar")):
        for key in world_keys(path):
            if first > 0:
                first -= 1
                continue
            if len(tiles) == count:
                break
            photo = read_view(path, key, 0, photo=True)
            row = [_tile(photo.rgb)]
            if with_views:
                row.append(_tile(depth_picture(photo)))
                row += [_tile(read_view(path, key, number).rgb) for number in SECOND_SHOWN]
            tiles.append(row)
    if not tiles:
        raise InputError(
            f"{folder}: no world to show in archives {prefix}-NNNNN.tar: give another folder, "
            "another --prefix, or a smaller --first"
        )
    if not with_views:
        flat = [row[0] for row in tiles]
        empty = np.full((*TILE, 3), 24, np.uint8)
        flat += [empty] * (-len(flat) % COLUMNS)
        tiles = [flat[start : start + COLUMNS] for start in range(0, len(flat), COLUMNS)]
    return np.concatenate([np.concatenate(row, 1) for row in tiles])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="a folder of `worlds.make`")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a PNG file")
    parser.add_argument("--count", type=int, default=48)
    parser.add_argument("--first", type=int, default=0, help="how many to pass over")
    parser.add_argument("--views", action="store_true", help="with depth and second views")
    parser.add_argument(
        "--prefix", default=ROOMS_PREFIX, help="how archives' names begin: worlds, streets, tracks"
    )
    options = parser.parse_args(arguments)
    check_picture_file(options.output)
    picture = sheet(options.folder, options.count, options.views, options.first, options.prefix)
    Image.fromarray(picture).save(options.output)


if __name__ == "__main__":
    sys.exit(run_script(main))
