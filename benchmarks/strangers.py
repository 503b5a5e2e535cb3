"""Would a stranger post the video? Sheets for readers who rate both ends of the default move.

    python benchmarks/strangers.py draw FOLDER... --count 16 --seed 1 -o photos.txt
    python benchmarks/strangers.py ends photos.txt -o ends
    python benchmarks/strangers.py sheets ends -o SHEETS --key key.json
    python benchmarks/strangers.py pairs old_ends new_ends -o PAIRS --key key.json
    python benchmarks/strangers.py pairs old_ends new_ends -o SWAPPED --key swapped.json --swapped
    python benchmarks/strangers.py ratings READER.json... --key key.json...

`draw` writes the names of photos that are drawn at random, equally many from each folder. `ends`
completes each photo as `spackle predict` does with its default settings and `--base lite`, and
writes the frames at the left and the right end of its video, at the video's own size. A second
version of the code is compared by `ends` in a second checkout; a setting by `--overscan`, `--fill`
or `--disparity`.

`sheets` puts both ends of a photo side by side into one picture without a name, in random order;
`pairs` those of two versions one above the other; each version is A, the upper row, for a random
half of the photos. Readers may prefer a row, whatever it shows: with `--swapped` the rows of all
pictures are exchanged, for every second reader.
README.txt beside the pictures tells a reader what to rate. The key, which says what is what, is
never within the readers' folder. `ratings` collects what readers wrote: the mean of their ratings,
the share of 4 and 5, and the flaws that they saw at first sight, at the picture's border and
inside. It takes one key for all readers, or one for each.
"""

from __future__ import annotations

import argparse
import json
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from scoreboard import markdown, pictures_in, sign_test
from torch import Tensor

from spackle.bases.settings import BaseSettings
from spackle.core.color import to_uint8
from spackle.core.photo import load_photo
from spackle.pipeline import FillOptions, Pipeline, PipelineOptions
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Reporter
from spackle.views import PathOptions

# A looped video of four frames has both ends of the move. The fill begins with the widest views, so
# the ends look nearly as in a video of 60 frames, which takes ten times as long.
FRAMES = 4
END_NAMES = ("left", "right")  # of the video's frames: the camera is farthest to this side
GAP_PX = 6  # of white between the pictures of a sheet
WHITE = 255
VERSIONS = ("old", "new")
SIDES = ("A", "B")
POSTED = 4  # a stranger who gives at least this rating would post the video
PLACES = ("border", "inside")  # where a reader saw a flaw at first sight

RATING_TEXT = """\
You have taken a photo, and a program has made a short video of it in which the camera moves a
little to the left and to the right. Would you post this video?

Rate from 1 to 5: 5 yes, at once; 4 yes, though I see a small flaw; 3 perhaps; 2 rather not;
1 no, it is broken. Look at the pictures at their own size, and do not zoom in. The photo itself
may be blurred, grainy or dull: that is no flaw of the video.

A flaw at first sight is one that you see within two seconds, without searching. Say whether there
is one at the picture's border ("border") and elsewhere ("inside"), and name the worst one.
"""
SHEET_TEXT = """
Each picture NN.png shows the leftmost and the rightmost frame of one video. Write one JSON file:

{"01": {"rating": 3, "border": true, "inside": false, "flaw": "streaks along the left border"}, ...}
"""
PAIR_TEXT = """
Each picture NN.png shows two videos of one photo: A in the upper row, B in the lower row. A row has
the video's leftmost and rightmost frame. Who is A changes from picture to picture. Rate both, and
say which one you would rather post: "A", "B" or "same". Write one JSON file:

{"01": {"A": {"rating": 3, "border": true, "inside": false, "flaw": "streaks at the left border"},
        "B": {"rating": 4, "border": false, "inside": false, "flaw": "a bent pole"},
        "better": "B"}, ...}
"""


# Photos and the ends of their videos --------------------------------------------------------------


def draw(folders: Sequence[Path], count: int, seed: int) -> list[Path]:
    """`count` photos drawn at random, as nearly as possible equally many from each folder.

    The same folders, count and seed give the same photos.
    """
    chance = random.Random(seed)
    photos: list[Path] = []
    for position, folder in enumerate(folders):
        # What is left to draw is shared equally among this folder and those after it.
        share = round((count - len(photos)) / (len(folders) - position))
        all_names = pictures_in(folder, sum(1 for _ in folder.iterdir()))
        photos += chance.sample(all_names, min(share, len(all_names)))
    return photos


def save_ends(photos: Sequence[Path], options: PipelineOptions, folder: Path) -> None:
    """Write the two end frames of each photo's video: NAME_left.png and NAME_right.png.

    Photos whose frames are there already are left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pipeline = Pipeline.open(options)
    for photo in photos:
        files = [folder / f"{photo.stem}_{name}.png" for name in END_NAMES]
        if all(file.is_file() for file in files):
            continue
        for file, frame in zip(files, end_frames(pipeline, photo), strict=True):
            Image.fromarray(to_uint8(frame).numpy()).save(file)
        print(photo.stem, flush=True)


@torch.no_grad()
def end_frames(pipeline: Pipeline, photo: Path) -> list[Tensor]:
    """The frames [H, W, 3] sRGB of a photo's video with the camera farthest left and right."""
    completed = pipeline.complete(load_photo(photo), Reporter())
    views = completed.views
    frame_cameras = [views.cameras[frame[0]] for frame in views.frames]
    positions = [float(camera.position[0]) for camera in frame_cameras]  # x points to the right
    ends = [int(np.argmin(positions)), int(np.argmax(positions))]
    gaussian_set = [completed.scene.base, completed.scene.aux]
    return [
        views.frame_maker.render([gaussian_set], frame_cameras[end], pipeline.renderer)[0]
        for end in ends
    ]


# Sheets -------------------------------------------------------------------------------------------


def photo_names(folder: Path) -> list[str]:
    """The names of all photos whose end frames lie in a folder."""
    ending = f"_{END_NAMES[0]}.png"
    return sorted(file.name.removesuffix(ending) for file in folder.glob(f"*{ending}"))


def both_ends(folder: Path, name: str) -> Image.Image:
    """The left and the right end frame of a photo side by side, at their own size."""
    frames = [Image.open(folder / f"{name}_{end}.png").convert("RGB") for end in END_NAMES]
    return joined(frames, across=True)


def joined(pictures: Sequence[Image.Image], *, across: bool) -> Image.Image:
    """Pictures side by side, or one above the other, with a white gap between them."""
    axis = 1 if across else 0
    other_length = max(picture.height if across else picture.width for picture in pictures)
    padded = []
    for picture in pictures:
        pixels = np.asarray(picture)
        margin = [(0, 0), (0, 0), (0, 0)]
        margin[axis] = (0, GAP_PX)
        margin[1 - axis] = (0, other_length - pixels.shape[1 - axis])
        padded.append(np.pad(pixels, margin, constant_values=WHITE))
    return Image.fromarray(np.concatenate(padded, axis))


def write_sheets(ends: Path, output: Path, key: Path, seed: int) -> None:
    """Write a numbered picture for each photo in random order, the readers' text, and the key."""
    names = photo_names(ends)
    random.Random(seed).shuffle(names)
    output.mkdir(parents=True, exist_ok=True)
    numbers = {f"{number:02d}": name for number, name in enumerate(names, start=1)}
    for number, name in numbers.items():
        both_ends(ends, name).save(output / f"{number}.png")
    (output / "README.txt").write_text(RATING_TEXT + SHEET_TEXT)
    key.write_text(json.dumps({number: {"photo": name} for number, name in numbers.items()}))


def write_pairs(
    old: Path, new: Path, output: Path, key: Path, seed: int, *, swapped: bool = False
) -> None:
    """Write a numbered picture for each photo, with the two versions' ends one above the other.

    A photo whose four frames are the same in both versions is left out. Each version is in the
    upper row for a random half of the other photos; with `swapped`, rows are exchanged in all.
    """
    chance = random.Random(seed)
    names = [name for name in photo_names(old) if name in set(photo_names(new))]
    chance.shuffle(names)
    rows_by_name: dict[str, dict[str, Image.Image]] = {}
    for name in names:
        rows = {"old": both_ends(old, name), "new": both_ends(new, name)}
        if not np.array_equal(np.asarray(rows["old"]), np.asarray(rows["new"])):
            rows_by_name[name] = rows
    is_new_above = [index % 2 == 0 for index in range(len(rows_by_name))]
    chance.shuffle(is_new_above)

    output.mkdir(parents=True, exist_ok=True)
    entries: dict[str, dict[str, str]] = {}
    for (name, rows), new_above in zip(rows_by_name.items(), is_new_above, strict=True):
        order = ("new", "old") if new_above != swapped else ("old", "new")
        number = f"{len(entries) + 1:02d}"
        joined([rows[version] for version in order], across=False).save(output / f"{number}.png")
        entries[number] = {"photo": name, **dict(zip(SIDES, order, strict=True))}
    (output / "README.txt").write_text(RATING_TEXT + PAIR_TEXT)
    key.write_text(json.dumps(entries, indent=1))


# Ratings ------------------------------------------------------------------------------------------


def collect(readings: Sequence[dict[str, Any]], keys: Sequence[dict[str, dict[str, str]]]) -> str:
    """A table of what readers wrote: a row for each version, or one for sheets of one version.

    For pairs, the last line says how often each version was preferred, and how often the upper and
    the lower row of a picture, which is equally often if readers look at what is shown alone.

    Args:
        readings: each reader's file.
        keys: what `sheets` or `pairs` has written for each reader, or one key for all.

    Raises:
        InputError: there are several keys, but not one for each reader.
    """
    if len(keys) not in (1, len(readings)):
        raise InputError(
            f"{len(keys)} keys for {len(readings)} readers: give one for all, or one for each"
        )
    keys = keys if len(keys) == len(readings) else [keys[0]] * len(readings)
    answers: dict[str, list[dict[str, Any]]] = {}  # by version
    preferences = {"old": 0, "new": 0, "same": 0}
    rows_preferred = {"A": 0, "B": 0}
    is_pairs = all("A" in entry for key in keys for entry in key.values())
    for reading, key in zip(readings, keys, strict=True):
        for number, entry in key.items():
            answer = reading[number]
            if not is_pairs:
                answers.setdefault("all", []).append(answer)
                continue
            for side in SIDES:
                answers.setdefault(entry[side], []).append(answer[side])
            better = answer["better"]
            preferences[entry.get(better, "same")] += 1
            if better in rows_preferred:
                rows_preferred[better] += 1

    rows = [
        [version, *summary(answers[version], len(readings))]
        for version in ("all", *VERSIONS)
        if version in answers
    ]
    head = ["", "mean", "4 and 5", "1", *(f"flaws at first sight: {place}" for place in PLACES)]
    table = markdown(head, rows)
    if not is_pairs:
        return table
    chance = sign_test(preferences["new"], preferences["old"])
    counts = ", ".join(f"{version} {count}" for version, count in preferences.items())
    by_row = f"upper row {rows_preferred['A']}, lower row {rows_preferred['B']}"
    return f"{table}\n\npreferred: {counts} (sign test: p = {chance:.3f}); {by_row}"


def summary(answers: Sequence[dict[str, Any]], readers: int) -> list[str]:
    """Mean rating, share of 4 and 5, number of 1, and flaws by place; numbers a reader."""
    ratings = [answer["rating"] for answer in answers]
    posted = sum(rating >= POSTED for rating in ratings) / len(ratings)
    broken = sum(rating == 1 for rating in ratings) / readers
    flaws = [sum(bool(answer[place]) for answer in answers) / readers for place in PLACES]
    return [
        f"{sum(ratings) / len(ratings):.2f}",
        f"{posted:.0%}",
        f"{broken:.1f}",
        *(f"{count:.1f} of {len(answers) // readers}" for count in flaws),
    ]


# Command ------------------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """The program's commands and options."""
    top = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = top.add_subparsers(dest="command", required=True)
    drawing = commands.add_parser("draw")
    drawing.add_argument("folders", type=Path, nargs="+")
    drawing.add_argument("--count", type=int, default=16)

    ends = commands.add_parser("ends")
    ends.add_argument("photos", type=Path, help="a file with a photo's path in each line")
    ends.add_argument("--overscan", type=float)
    ends.add_argument("--fill", default="auto")
    ends.add_argument("--disparity", type=float)
    ends.add_argument("--frames", type=int, default=FRAMES, help="of the video, a multiple of 4")

    sheets = commands.add_parser("sheets")
    sheets.add_argument("ends", type=Path)
    pairs = commands.add_parser("pairs")
    pairs.add_argument("old", type=Path)
    pairs.add_argument("new", type=Path)
    pairs.add_argument("--swapped", action="store_true", help="exchange A and B in all pictures")
    ratings = commands.add_parser("ratings")
    ratings.add_argument("readings", type=Path, nargs="+")
    for command in (drawing, ends, sheets, pairs):
        command.add_argument("-o", "--output", type=Path, required=True)
    for command in (drawing, sheets, pairs):
        command.add_argument("--seed", type=int, default=0)
    for command in (sheets, pairs):
        command.add_argument("--key", type=Path, required=True)
    ratings.add_argument(
        "--key", type=Path, nargs="+", required=True, help="one for all readers, or one for each"
    )
    return top


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of the commands."""
    chosen = parser().parse_args(arguments)
    if chosen.command == "draw":
        photos = draw(chosen.folders, chosen.count, chosen.seed)
        chosen.output.write_text("".join(f"{photo}\n" for photo in photos))
    elif chosen.command == "ends":
        options = PipelineOptions(
            base=BaseSettings(name="lite"),
            path=PathOptions(
                overscan=chosen.overscan, disparity=chosen.disparity, frames=chosen.frames
            ),
            fill=FillOptions(fill=chosen.fill),
        )
        photos = [Path(line) for line in chosen.photos.read_text().splitlines()]
        save_ends(photos, options, chosen.output)
    elif chosen.command == "sheets":
        write_sheets(chosen.ends, chosen.output, chosen.key, chosen.seed)
    elif chosen.command == "pairs":
        write_pairs(
            chosen.old,
            chosen.new,
            chosen.output,
            chosen.key,
            chosen.seed,
            swapped=chosen.swapped,
        )
    else:
        readings = [json.loads(file.read_text()) for file in chosen.readings]
        print(collect(readings, [json.loads(file.read_text()) for file in chosen.key]))


if __name__ == "__main__":
    main()
