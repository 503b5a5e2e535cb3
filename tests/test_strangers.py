"""The blind protocol: ends of a move become sheets without names, and ratings become figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import strangers
from PIL import Image

from spackle.bases.settings import BaseSettings
from spackle.pipeline import FillOptions, PipelineOptions
from spackle.runtime.errors import InputError
from spackle.views import PathOptions

HEIGHT = 36
WIDTH = 48  # the smallest photo has 32 pixels a side


def save_picture(file: Path, color: tuple[int, int, int]) -> None:
    """Write a picture of one colour."""
    file.parent.mkdir(exist_ok=True)
    Image.new("RGB", (WIDTH, HEIGHT), color).save(file)


def save_ends(folder: Path, name: str, color: tuple[int, int, int]) -> None:
    """Write both end frames of a photo's video in one colour."""
    for end in strangers.END_NAMES:
        save_picture(folder / f"{name}_{end}.png", color)


def test_photos_are_drawn_evenly_from_all_folders_and_alike_for_one_seed(tmp_path: Path) -> None:
    folders = [tmp_path / "houses", tmp_path / "streets"]
    for folder in folders:
        for number in range(9):
            save_picture(folder / f"{number}.png", (0, 0, 0))
    drawn = strangers.draw(folders, 6, seed=3)
    assert [sum(photo.parent == folder for photo in drawn) for folder in folders] == [3, 3]
    assert len(set(drawn)) == 6
    assert strangers.draw(folders, 6, seed=3) == drawn
    assert strangers.draw(folders, 6, seed=4) != drawn


def test_the_ends_are_two_frames_of_the_video_at_its_size(tmp_path: Path) -> None:
    # A bright square before a gradient, which the camera sees from both sides.
    pixels = np.tile(np.linspace(60, 120, WIDTH), (HEIGHT, 1))
    pixels[8:16, 12:20] = 250
    photo = tmp_path / "square.png"
    Image.fromarray(pixels.astype(np.uint8)).convert("RGB").save(photo)
    options = PipelineOptions(
        base=BaseSettings(name="lite"),
        path=PathOptions(disparity=0.1, frames=4),
        fill=FillOptions(fill="network"),
    )
    strangers.save_ends([photo], options, tmp_path / "ends")
    left = np.asarray(Image.open(tmp_path / "ends" / "square_left.png"))
    right = np.asarray(Image.open(tmp_path / "ends" / "square_right.png"))
    assert left.shape == right.shape == (HEIGHT, WIDTH, 3)
    assert not np.array_equal(left, right)


def test_a_pair_hides_which_version_is_which_and_the_key_tells(tmp_path: Path) -> None:
    red, blue = (255, 0, 0), (0, 0, 255)
    for number in range(8):
        save_ends(tmp_path / "old", f"photo{number}", red)
        save_ends(tmp_path / "new", f"photo{number}", blue)
    save_ends(tmp_path / "old", "same", red)
    save_ends(tmp_path / "new", "same", red)

    key = tmp_path / "key.json"
    sheets = tmp_path / "pairs"
    strangers.write_pairs(tmp_path / "old", tmp_path / "new", sheets, key, seed=1)
    entries = json.loads(key.read_text())

    # The photo that both versions show alike is left out; sides change from photo to photo.
    assert {entry["photo"] for entry in entries.values()} == {f"photo{n}" for n in range(8)}
    assert [entry["A"] for entry in entries.values()].count("new") == 4
    assert sorted(file.name for file in sheets.iterdir()) == [
        *(f"{number:02d}.png" for number in range(1, 9)),
        "README.txt",
    ]
    for number, entry in entries.items():
        picture = np.asarray(Image.open(sheets / f"{number}.png"))
        colors = {"old": red, "new": blue}
        assert tuple(picture[0, 0]) == colors[entry["A"]]
        assert tuple(picture[HEIGHT + strangers.GAP_PX, 0]) == colors[entry["B"]]


def test_swapped_pairs_exchange_the_rows_of_the_same_pictures(tmp_path: Path) -> None:
    for number in range(5):
        save_ends(tmp_path / "old", f"photo{number}", (255, 0, 0))
        save_ends(tmp_path / "new", f"photo{number}", (0, 0, 255))
    folders = [str(tmp_path / "old"), str(tmp_path / "new")]
    entries = []
    for name, options in (("pairs", []), ("swapped", ["--swapped"])):
        key = tmp_path / f"{name}.json"
        output = ["-o", str(tmp_path / name), "--key", str(key)]
        strangers.main(["pairs", *folders, *output, *options])
        entries.append(json.loads(key.read_text()))
    plain, swapped = entries
    assert list(plain) == list(swapped)
    for number, entry in plain.items():
        other = swapped[number]
        assert (entry["photo"], entry["A"], entry["B"]) == (other["photo"], other["B"], other["A"])
        above, below = (
            np.asarray(Image.open(tmp_path / name / f"{number}.png"))
            for name in ("pairs", "swapped")
        )
        assert np.array_equal(above[:HEIGHT], below[HEIGHT + strangers.GAP_PX :][:HEIGHT])


def test_a_reader_who_prefers_a_row_is_seen_and_cancels_with_a_swapped_one() -> None:
    plain = {"01": {"photo": "cat", "A": "new", "B": "old"}}
    swapped = {"01": {"photo": "cat", "A": "old", "B": "new"}}
    rated = {"rating": 4, "border": False, "inside": False, "flaw": ""}
    always_below = {"01": {"A": rated, "B": rated, "better": "B"}}
    report = strangers.collect([always_below, always_below], [plain, swapped])
    assert report.endswith(
        "preferred: old 1, new 1, same 0 (sign test: p = 1.000); upper row 0, lower row 2"
    )
    with pytest.raises(InputError, match="2 keys for 3 readers"):
        strangers.collect([always_below] * 3, [plain, swapped])


def test_ratings_of_pairs_are_collected_by_version() -> None:
    key = {
        "01": {"photo": "cat", "A": "new", "B": "old"},
        "02": {"photo": "dog", "A": "old", "B": "new"},
    }

    def answer(rating: int, border: bool) -> dict[str, object]:
        return {"rating": rating, "border": border, "inside": False, "flaw": ""}

    reading = {
        "01": {"A": answer(5, False), "B": answer(2, True), "better": "A"},
        "02": {"A": answer(1, True), "B": answer(4, True), "better": "same"},
    }
    rows = strangers.collect([reading, reading], [key]).splitlines()
    assert rows[2] == "| old | 1.50 | 0% | 1.0 | 2.0 of 2 | 0.0 of 2 |"
    assert rows[3] == "| new | 4.50 | 100% | 0.0 | 1.0 of 2 | 0.0 of 2 |"
    assert rows[-1] == (
        "preferred: old 0, new 2, same 2 (sign test: p = 0.500); upper row 2, lower row 0"
    )


def test_ratings_of_sheets_are_collected(tmp_path: Path) -> None:
    save_ends(tmp_path / "ends", "cat", (0, 0, 0))
    save_ends(tmp_path / "ends", "dog", (0, 0, 0))
    key = tmp_path / "key.json"
    strangers.main(
        ["sheets", str(tmp_path / "ends"), "-o", str(tmp_path / "sheets"), "--key", str(key)]
    )
    assert (tmp_path / "sheets" / "02.png").is_file()
    reading = {
        "01": {"rating": 3, "border": True, "inside": True, "flaw": ""},
        "02": {"rating": 4, "border": False, "inside": True, "flaw": ""},
    }
    table = strangers.collect([reading], [json.loads(key.read_text())])
    assert "| all | 3.50 | 50% | 0.0 | 1.0 of 2 | 2.0 of 2 |" in table
