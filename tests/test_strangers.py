"""The blind protocol: ends of a move become sheets without names, and ratings become figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import strangers
from PIL import Image

from spackle.bases.settings import BaseSettings
from spackle.cli.script_command import run_script
from spackle.pipeline import FillOptions, PipelineOptions
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


def write_json(file: Path, content: object) -> Path:
    """Write a reader's file or a key."""
    file.write_text(json.dumps(content))
    return file


RATED = {"rating": 4, "border": False, "inside": False, "flaw": ""}


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


def test_a_reader_who_prefers_a_row_is_seen_and_cancels_with_a_swapped_one(
    tmp_path: Path,
) -> None:
    plain = write_json(tmp_path / "key.json", {"01": {"photo": "cat", "A": "new", "B": "old"}})
    swapped = write_json(tmp_path / "swap.json", {"01": {"photo": "cat", "A": "old", "B": "new"}})
    always_below = write_json(
        tmp_path / "reader.json", {"01": {"A": RATED, "B": RATED, "better": "B"}}
    )
    report = strangers.table_of_files([always_below, always_below], [plain, swapped])
    assert report.endswith(
        "preferred: old 1, new 1, same 0 (sign test: p = 1.000); upper row 0, lower row 2"
    )


def test_ratings_of_pairs_are_collected_by_version(tmp_path: Path) -> None:
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
    reader_file = write_json(tmp_path / "reader.json", reading)
    key_file = write_json(tmp_path / "key.json", key)
    rows = strangers.table_of_files([reader_file, reader_file], [key_file]).splitlines()
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
    table = strangers.table_of_files([write_json(tmp_path / "reader.json", reading)], [key])
    assert "| all | 3.50 | 50% | 0.0 | 1.0 of 2 | 2.0 of 2 |" in table


def test_a_flaw_that_a_reader_denies_in_words_is_none(tmp_path: Path) -> None:
    key = write_json(tmp_path / "key.json", {"01": {"photo": "cat"}})
    reader = write_json(tmp_path / "r.json", {"01": {**RATED, "border": "no", "inside": "yes"}})
    assert "| 0.0 of 1 | 1.0 of 1 |" in strangers.table_of_files([reader], [key])


# Input that cannot be used ------------------------------------------------------------------------


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with folders of photos and of ends, some of them not as they should.

    `key.json` and `pairs.json` are keys; `r.json` and `rp.json` are ratings that fit them.
    """
    monkeypatch.chdir(tmp_path)
    for folder in ("photos", "others"):
        save_picture(tmp_path / folder / "0.png", (0, 0, 0))
    save_ends(tmp_path / "old", "cat", (255, 0, 0))
    save_ends(tmp_path / "new", "cat", (0, 0, 255))
    save_ends(tmp_path / "dogs", "dog", (0, 0, 0))
    save_ends(tmp_path / "damaged", "cat", (0, 0, 0))
    (tmp_path / "damaged" / "cat_right.png").write_bytes(b"no picture")
    save_ends(tmp_path / "half", "cat", (0, 0, 0))
    (tmp_path / "half" / "cat_right.png").unlink()
    (tmp_path / "empty").mkdir()
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00\x80")
    (tmp_path / "list.txt").write_text("photos/0.png\n")
    (tmp_path / "blank.txt").write_text("\n")
    (tmp_path / "twice.txt").write_text("photos/0.png\nothers/0.png\n")
    (tmp_path / "missing.txt").write_text("photos/7.png\n")
    (tmp_path / "text.txt").write_text("list.txt\n")
    write_json(tmp_path / "key.json", {"01": {"photo": "cat"}})
    write_json(tmp_path / "pairs.json", {"01": {"photo": "cat", "A": "new", "B": "old"}})
    write_json(tmp_path / "r.json", {"01": RATED})
    write_json(tmp_path / "rp.json", {"01": {"A": RATED, "B": RATED, "better": "A"}})
    return tmp_path


def assert_refused(
    command: str, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """The command prints one line, which has these words, and ends with exit code 2."""
    assert run_script(lambda: strangers.main(command.split())) == 2
    output, error = capsys.readouterr()
    assert output == ""
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("draw nowhere -o p.txt", ("nowhere: cannot read the folder",)),
        ("draw list.txt -o p.txt", ("list.txt: cannot read the folder",)),
        ("draw empty -o p.txt", ("empty: has no photo", "give a folder of photos")),
        ("draw photos empty -o p.txt", ("empty: has no photo",)),
        ("draw photos --count -1 -o p.txt", ("--count -1", "at least 1")),
        ("draw photos --count 0 -o p.txt", ("--count 0", "at least 1")),
        ("draw photos -o nowhere/p.txt", ("nowhere/p.txt", "create it first")),
        ("draw photos -o empty", ("empty: cannot write", "give a file name")),
        ("ends nowhere.txt -o e", ("nowhere.txt: no such list of photos",)),
        ("ends photos -o e", ("photos: not a plain file",)),
        ("ends binary -o e", ("binary: cannot be read as text", "give a list of photos")),
        ("ends blank.txt -o e", ("blank.txt: names no photo",)),
        ("ends missing.txt -o e", ("photos/7.png: no such photo",)),
        ("ends twice.txt -o e", ("twice.txt: has 2 photos 0", "rename one")),
        ("ends text.txt -o e", ("list.txt: not an image",)),
        ("ends list.txt -o list.txt", ("list.txt: cannot create this output folder",)),
        ("ends list.txt -o list.txt/e", ("list.txt/e: cannot create this output folder",)),
        ("ends list.txt -o e --frames 3", ("--frames 3: must be a multiple of 4",)),
        ("ends list.txt -o e --overscan -1", ("--overscan must be between", "-1")),
        ("ends list.txt -o e --fill wood", ("--fill wood is unknown",)),
        ("sheets nowhere -o s --key k.json", ("nowhere: cannot read the folder",)),
        ("sheets list.txt -o s --key k.json", ("list.txt: cannot read the folder",)),
        ("sheets empty -o s --key k.json", ("empty: has no NAME_left.png", "`ends`")),
        ("sheets damaged -o s --key k.json", ("damaged/cat_right.png: not an image",)),
        ("sheets half -o s --key k.json", ("half/cat_right.png: no such photo",)),
        ("sheets old -o list.txt --key k.json", ("list.txt: cannot create",)),
        ("sheets old -o s --key nowhere/k.json", ("nowhere/k.json", "create it first")),
        ("sheets old -o s --key empty", ("empty: cannot write", "give a file name")),
        ("sheets old -o s --key s/k.json", ("s/k.json", "readers' folder s")),
        ("pairs nowhere new -o p --key k.json", ("nowhere: cannot read the folder",)),
        ("pairs old empty -o p --key k.json", ("empty: has no NAME_left.png",)),
        ("pairs old dogs -o p --key k.json", ("dogs: has none of the photos of old",)),
        ("pairs old old -o p --key k.json", ("old: shows each photo as old does",)),
        ("pairs old damaged -o p --key k.json", ("damaged/cat_right.png: not an image",)),
        ("pairs old half -o p --key k.json", ("half/cat_right.png: no such photo",)),
        ("pairs old new -o list.txt --key k.json", ("list.txt: cannot create",)),
        ("pairs old new -o p --key nowhere/k.json", ("nowhere/k.json", "create it first")),
        ("pairs old new -o p --key p/deep/k.json", ("p/deep/k.json", "readers' folder p")),
        ("ratings r.json r.json r.json --key key.json key.json", ("2 keys for 3 readers",)),
        ("ratings nowhere.json --key key.json", ("nowhere.json: no such reader's file",)),
        ("ratings r.json --key nowhere.json", ("nowhere.json: no such key",)),
        ("ratings empty --key key.json", ("empty: not a plain file",)),
        ("ratings binary --key key.json", ("binary: cannot be read as text",)),
        ("ratings r.json --key pairs.json", ("r.json: picture 01: A: field required",)),
        ("ratings rp.json --key key.json", ("rp.json: picture 01: rating: field required",)),
        ("ratings r.json rp.json --key key.json pairs.json", ("pairs.json", "and key.json")),
    ],
)
def test_input_that_cannot_be_used_ends_with_a_line_that_names_it(
    command: str, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert_refused(command, words, capsys)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"01": ', ("not JSON", "mend it")),
        ("[" * 100_000, ("not JSON",)),
        ("[1, 2]", ('must be {"01": ..., ...}',)),
        ("{}", ("with an entry for each picture",)),
        ('{"02": {}}', ("has no rating of picture 01", "key.json")),
        ('{"01": {}, "02": {}}', ("rates picture 02", "key.json")),
        ('{"01": 3}', ("picture 01",)),
        ('{"01": {"border": true, "inside": true}}', ("picture 01: rating: field required",)),
        ('{"01": {"rating": 3, "inside": true}}', ("picture 01: border: field required",)),
        ('{"01": {"rating": "good", "border": true, "inside": true}}', ("rating", "'good'")),
        ('{"01": {"rating": 7, "border": true, "inside": true}}', ("rating", "not 7")),
        ('{"01": {"rating": NaN, "border": true, "inside": true}}', ("rating", "not nan")),
        ('{"01": {"rating": 3, "border": "perhaps", "inside": true}}', ("border", "'perhaps'")),
    ],
)
def test_ratings_that_are_damaged_or_do_not_fit_the_key_are_refused(
    place: Path, text: str, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "bad.json").write_text(text)
    assert_refused("ratings bad.json --key key.json", ("bad.json: ", *words), capsys)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"better": "C"}, ("better", "'C'")),
        ({"better": None}, ("better", "None")),
        ({"B": None}, ("picture 01: B",)),
        ({"A": {**RATED, "rating": 0}}, ("A.rating", "not 0")),
    ],
)
def test_a_wrong_rating_of_a_pair_is_refused(
    place: Path, change: object, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert isinstance(change, dict)
    pair = {"A": RATED, "B": RATED, "better": "A", **change}
    write_json(place / "bad.json", {"01": pair})
    assert_refused("ratings bad.json --key pairs.json", ("bad.json: ", *words), capsys)


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({}, ("with an entry for each picture",)),
        ([1], ('must be {"01": ..., ...}',)),
        ({"01": 3}, ("picture 01",)),
        ({"01": {"photo": "cat", "A": "newest", "B": "old"}}, ("picture 01: A", "'newest'")),
        ({"01": {"photo": "cat", "A": "new"}}, ("picture 01: B: field required",)),
        ({"01": {"photo": "cat", "A": "new", "B": "new"}}, ("A and B are both new",)),
        # One entry of `sheets`, and one of `pairs`.
        ({"01": {"photo": "a"}, "02": {"photo": "b", "A": "new", "B": "old"}}, ("picture 01: A",)),
        # Ratings that are given as the key.
        ({"01": RATED}, ("picture 01",)),
    ],
)
def test_a_damaged_key_is_refused(
    place: Path, entries: object, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    write_json(place / "bad.json", entries)
    assert_refused("ratings rp.json --key bad.json", ("bad.json: ", *words), capsys)


def test_a_photo_list_may_have_empty_lines(place: Path) -> None:
    (place / "list.txt").write_text("\nphotos/0.png\n\n")
    assert strangers.read_photo_list(place / "list.txt") == [Path("photos/0.png")]
