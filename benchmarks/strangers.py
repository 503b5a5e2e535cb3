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
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import torch
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field
from scoreboard import markdown, sign_test
from torch import Tensor

from spackle.bases.settings import BaseSettings
from spackle.cli.script_command import run_script
from spackle.core.image_files import read_image
from spackle.core.photo import load_photo
from spackle.formats import save_png
from spackle.pipeline import FillOptions, Pipeline, PipelineOptions
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_file, check_writable, list_files, write_atomic, write_json
from spackle.runtime.folders import make_folder
from spackle.runtime.progress import Reporter
from spackle.runtime.validation import validated
from spackle.views import PathOptions

# A looped video of four frames has both ends of the move. The fill begins with the widest views, so
# the ends look nearly as in a video of 60 frames, which takes ten times as long.
FRAMES = 4
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png")  # of the photos that are drawn
END_NAMES = ("left", "right")  # of the video's frames: the camera is farthest to this side
GAP_PX = 6  # of white between the pictures of a sheet
WHITE = 255
VERSIONS = ("old", "new")
SIDES = ("A", "B")
POSTED = 4  # a stranger who gives at least this rating would post the video
PLACES = ("border", "inside")  # where a reader saw a flaw at first sight
Version = Literal["old", "new"]
Entry = TypeVar("Entry", bound=BaseModel)  # what a file of readers or a key says of one picture

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

    Raises:
        InputError: a folder cannot be read or has no photos, or the count is not positive.
    """
    if count < 1:
        raise InputError(f"--count {count}: must be at least 1")
    chance = random.Random(seed)
    photos: list[Path] = []
    for position, folder in enumerate(folders):
        # What is left to draw is shared equally among this folder and those after it.
        share = round((count - len(photos)) / (len(folders) - position))
        files = list_files(folder, PICTURE_SUFFIXES)
        if not files:
            suffixes = ", ".join(PICTURE_SUFFIXES)
            raise InputError(f"{folder}: has no photo ({suffixes}): give a folder of photos")
        photos += chance.sample(files, min(share, len(files)))
    return photos


def read_photo_list(file: Path) -> list[Path]:
    """The photos that a file names, one in each line; empty lines are passed over.

    Raises:
        InputError: the file cannot be read or names no photo, one of the photos is missing, or two
            have the same name, so that their frames would have, too.
    """
    lines = [line for line in read_text(file, "list of photos").splitlines() if line.strip()]
    if not lines:
        raise InputError(f"{file}: names no photo: write the path of a photo into each line")
    photos = [Path(line) for line in lines]
    for photo in photos:
        check_file(photo, "photo")
    name, count = Counter(photo.stem for photo in photos).most_common(1)[0]
    if count > 1:
        raise InputError(
            f"{file}: has {count} photos {name}, whose frames would have the same name: "
            "rename one, or leave it out"
        )
    return photos


def read_text(file: Path, kind: str) -> str:
    """The text of a UTF-8 file; InputError, which names its kind, if it cannot be read."""
    check_file(file, kind)
    problem = f"cannot be read as text ({{reason}}): give a {kind}"
    with as_input_error(file, problem, OSError, UnicodeDecodeError):
        return file.read_text(encoding="utf-8")


def save_ends(photos: Sequence[Path], options: PipelineOptions, folder: Path) -> None:
    """Write the two end frames of each photo's video: NAME_left.png and NAME_right.png.

    Photos whose frames are there already are left out.

    Raises:
        InputError: an option is out of bounds, a photo cannot be decoded, or the folder cannot be
            written.
    """
    make_folder(folder)
    pipeline = Pipeline.open(options)
    for photo in photos:
        files = [folder / f"{photo.stem}_{name}.png" for name in END_NAMES]
        if all(file.is_file() for file in files):
            continue
        for file, frame in zip(files, end_frames(pipeline, photo), strict=True):
            save_png(frame, file)
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
    """The sorted names of all photos whose end frames lie in a folder.

    InputError if the folder cannot be read, or there are none.
    """
    ending = f"_{END_NAMES[0]}.png"
    names = [file.name.removesuffix(ending) for file in list_files(folder, (ending,))]
    if not names:
        raise InputError(f"{folder}: has no NAME{ending}: give a folder that `ends` has written")
    return sorted(names)


def both_ends(folder: Path, name: str) -> Image.Image:
    """The left and the right end frame of a photo side by side, at their own size.

    InputError if one of them is missing or damaged.
    """
    files = [folder / f"{name}_{end}.png" for end in END_NAMES]
    frames = [read_image(file, lambda image: image.convert("RGB")) for file in files]
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


def save_sheet(picture: Image.Image, file: Path) -> None:
    """Write a picture as a PNG, whole or not at all; InputError if it cannot be written."""
    save_png(torch.from_numpy(np.array(picture)), file)


def make_readers_folder(output: Path, key: Path) -> None:
    """Create the readers' folder, and check that the key can be written outside of it.

    Raises:
        InputError: the folder cannot be created, or the key cannot be written or is within it.
    """
    make_folder(output)
    if output.resolve() in key.resolve().parents:
        raise InputError(
            f"{key}: the key would be in the readers' folder {output}, where they would see it: "
            "name a file elsewhere"
        )
    check_writable(key)


def write_sheets(ends: Path, output: Path, key: Path, seed: int) -> None:
    """Write a numbered picture for each photo in random order, the readers' text, and the key.

    Raises:
        InputError: there are no ends, one cannot be read, or the results cannot be written.
    """
    names = photo_names(ends)
    random.Random(seed).shuffle(names)
    make_readers_folder(output, key)
    numbers = {f"{number:02d}": name for number, name in enumerate(names, start=1)}
    for number, name in numbers.items():
        save_sheet(both_ends(ends, name), output / f"{number}.png")
    write_atomic(output / "README.txt", (RATING_TEXT + SHEET_TEXT).encode())
    write_json({number: {"photo": name} for number, name in numbers.items()}, key)


def write_pairs(
    old: Path, new: Path, output: Path, key: Path, seed: int, *, swapped: bool = False
) -> None:
    """Write a numbered picture for each photo, with the two versions' ends one above the other.

    A photo whose four frames are the same in both versions is left out. Each version is in the
    upper row for a random half of the other photos; with `swapped`, rows are exchanged in all.

    Raises:
        InputError: the versions have no photo in common, or none that they show differently; one
            of the frames cannot be read, or the results cannot be written.
    """
    chance = random.Random(seed)
    new_names = set(photo_names(new))
    names = [name for name in photo_names(old) if name in new_names]
    if not names:
        raise InputError(f"{new}: has none of the photos of {old}: give ends of the same photos")
    make_readers_folder(output, key)
    chance.shuffle(names)
    rows_by_name: dict[str, dict[str, Image.Image]] = {}
    for name in names:
        rows = {"old": both_ends(old, name), "new": both_ends(new, name)}
        if not np.array_equal(np.asarray(rows["old"]), np.asarray(rows["new"])):
            rows_by_name[name] = rows
    if not rows_by_name:
        raise InputError(f"{new}: shows each photo as {old} does: give ends of another version")
    is_new_above = [index % 2 == 0 for index in range(len(rows_by_name))]
    chance.shuffle(is_new_above)

    entries: dict[str, dict[str, str]] = {}
    for (name, rows), new_above in zip(rows_by_name.items(), is_new_above, strict=True):
        order = ("new", "old") if new_above != swapped else ("old", "new")
        number = f"{len(entries) + 1:02d}"
        sheet = joined([rows[version] for version in order], across=False)
        save_sheet(sheet, output / f"{number}.png")
        entries[number] = {"photo": name, **dict(zip(SIDES, order, strict=True))}
    write_atomic(output / "README.txt", (RATING_TEXT + PAIR_TEXT).encode())
    write_json(entries, key)


# Ratings ------------------------------------------------------------------------------------------


class Rating(BaseModel):
    """What a reader wrote of one video; further keys are ignored."""

    rating: Annotated[int, Field(ge=1, le=5)]
    border: bool  # a flaw at first sight at the picture's border
    inside: bool  # a flaw at first sight elsewhere
    flaw: str = ""  # the worst one


class PairRating(BaseModel):
    """What a reader wrote of a picture with two videos; further keys are ignored."""

    A: Rating
    B: Rating
    better: Literal["A", "B", "same"]


class SheetEntry(BaseModel):
    """What the key of `sheets` says of a picture."""

    model_config = ConfigDict(extra="forbid")

    photo: str


class PairEntry(SheetEntry):
    """What the key of `pairs` says of a picture: which version is in which row."""

    A: Version
    B: Version

    def version(self, side: str) -> Version:
        """The version in the row "A" or "B"."""
        return self.A if side == "A" else self.B


def read_entries(file: Path, kind: str) -> dict[str, Any]:
    """A file's JSON object with an entry for each picture, which is not checked yet.

    InputError, which names the file's kind, if it is no JSON object, or an empty one.
    """
    text = read_text(file, kind)
    # Python's reader of JSON reports too many brackets within each other by a RecursionError.
    with as_input_error(file, "not JSON ({reason}): mend it", ValueError, RecursionError):
        content = json.loads(text)
    if not isinstance(content, dict) or not content:
        raise InputError(f'{file}: must be {{"01": ..., ...}}, with an entry for each picture')
    return content


def checked_entries(file: Path, content: Mapping[str, Any], model: type[Entry]) -> dict[str, Entry]:
    """The entries of a file as objects of `model`; InputError for the first that is none."""
    return {
        number: validated(model, entry, f"{file}: picture {number}")
        for number, entry in content.items()
    }


def read_key(file: Path) -> dict[str, SheetEntry] | dict[str, PairEntry]:
    """What `sheets` or `pairs` has written of each picture, by its number.

    InputError if the file cannot be read or says something else.
    """
    content = read_entries(file, "key")
    if not any("A" in entry for entry in content.values() if isinstance(entry, dict)):
        return checked_entries(file, content, SheetEntry)
    entries = checked_entries(file, content, PairEntry)
    for number, entry in entries.items():
        if entry.A == entry.B:
            raise InputError(
                f"{file}: picture {number}: A and B are both {entry.A}: give a key of `pairs`"
            )
    return entries


def read_ratings(
    file: Path, key_file: Path, key: Mapping[str, SheetEntry]
) -> dict[str, Rating] | dict[str, PairRating]:
    """What a reader wrote of each picture of a key, by its number.

    Args:
        file: the reader's file.
        key_file: the key's file, for messages.
        key: what the key says of each picture.

    Raises:
        InputError: the file cannot be read, has ratings of other pictures than the key, or an
            entry that is not as the readers' text demands.
    """
    content = read_entries(file, "reader's file")
    for number in key:
        if number not in content:
            raise InputError(
                f"{file}: has no rating of picture {number}, which is in the key {key_file}: "
                "rate it, or give the key of this reader's pictures"
            )
    for number in content:
        if number not in key:
            raise InputError(
                f"{file}: rates picture {number}, which is not in the key {key_file}: "
                "give the key of this reader's pictures"
            )
    if is_of_pairs(key):
        return checked_entries(file, content, PairRating)
    return checked_entries(file, content, Rating)


def is_of_pairs(key: Mapping[str, SheetEntry]) -> bool:
    """Whether a key was written by `pairs`."""
    return all(isinstance(entry, PairEntry) for entry in key.values())


def table_of_files(files: Sequence[Path], key_files: Sequence[Path]) -> str:
    """The table of `collect` for the files of readers and of keys.

    Raises:
        InputError: a file cannot be read or used, there are several keys but not one for each
            reader, or keys of sheets and of pairs.
    """
    if len(key_files) not in (1, len(files)):
        raise InputError(
            f"--key: {len(key_files)} keys for {len(files)} readers: give one for all, or one for "
            "each"
        )
    keys = [read_key(file) for file in key_files]
    for key_file, key in zip(key_files, keys, strict=True):
        if is_of_pairs(key) != is_of_pairs(keys[0]):
            raise InputError(
                f"{key_file}: of the keys, some are of `sheets` and some of `pairs`, as this and "
                f"{key_files[0]}: give those of one kind"
            )

    # One key is that of all readers.
    repetitions = len(files) // len(keys)
    key_files = [*key_files] * repetitions
    keys = keys * repetitions
    readings = [
        read_ratings(file, key_file, key)
        for file, key_file, key in zip(files, key_files, keys, strict=True)
    ]
    return collect(readings, keys)


def collect(
    readings: Sequence[Mapping[str, Rating | PairRating]],
    keys: Sequence[Mapping[str, SheetEntry]],
) -> str:
    """A table of what readers wrote: a row for each version, or one for sheets of one version.

    For pairs, the last line says how often each version was preferred, and how often the upper and
    the lower row of a picture, which is equally often if readers look at what is shown alone.

    Args:
        readings: what each reader wrote of each picture, by its number.
        keys: each reader's key, with the same numbers; all of sheets, or all of pairs.
    """
    answers: dict[str, list[Rating]] = {}  # by version
    preferences = {"old": 0, "new": 0, "same": 0}
    rows_preferred = {"A": 0, "B": 0}
    is_pairs = all(is_of_pairs(key) for key in keys)
    for reading, key in zip(readings, keys, strict=True):
        for number, entry in key.items():
            answer = reading[number]
            if isinstance(answer, Rating):
                answers.setdefault("all", []).append(answer)
                continue
            assert isinstance(entry, PairEntry)
            for side, rating in zip(SIDES, (answer.A, answer.B), strict=True):
                answers.setdefault(entry.version(side), []).append(rating)
            if answer.better == "same":
                preferences["same"] += 1
            else:
                preferences[entry.version(answer.better)] += 1
                rows_preferred[answer.better] += 1

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


def summary(answers: Sequence[Rating], readers: int) -> list[str]:
    """Mean rating, share of 4 and 5, number of 1, and flaws by place; numbers a reader."""
    ratings = [answer.rating for answer in answers]
    posted = sum(rating >= POSTED for rating in ratings) / len(ratings)
    broken = sum(rating == 1 for rating in ratings) / readers
    flaws = [sum(getattr(answer, place) for answer in answers) / readers for place in PLACES]
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


def run(chosen: argparse.Namespace) -> None:
    """Run the command that the options name; InputError if its input or output cannot be used."""
    if chosen.command == "draw":
        photos = draw(chosen.folders, chosen.count, chosen.seed)
        write_atomic(chosen.output, "".join(f"{photo}\n" for photo in photos).encode())
    elif chosen.command == "ends":
        if chosen.frames % FRAMES:
            raise InputError(f"--frames {chosen.frames}: must be a multiple of {FRAMES}")
        options = PipelineOptions(
            base=BaseSettings(name="lite"),
            path=PathOptions(
                overscan=chosen.overscan, disparity=chosen.disparity, frames=chosen.frames
            ),
            fill=FillOptions(fill=chosen.fill),
        )
        save_ends(read_photo_list(chosen.photos), options, chosen.output)
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
        print(table_of_files(chosen.readings, chosen.key))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one of the commands; InputError if its input or output cannot be used."""
    run(parser().parse_args(arguments))


if __name__ == "__main__":
    sys.exit(run_script(main))
