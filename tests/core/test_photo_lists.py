"""Folders and lists of photos give each photo a path, a stable name, and what the list says."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from spackle.core.photo_lists import is_photo_list, photos_of
from spackle.runtime.errors import InputError


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with two photos, one of them in a subfolder; the readers look only at names."""
    for name in ("b.jpg", "a/b.jpg"):
        file = tmp_path / "photos" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"photo")
    return tmp_path


def names_of(source: Path, **options: object) -> list[str]:
    return [photo.name for photo in photos_of(source, **options)]  # type: ignore[arg-type]


def test_a_folder_gives_its_photos_with_or_without_subfolders(place: Path) -> None:
    photos = place / "photos"
    assert names_of(photos) == ["b.jpg"]
    assert names_of(photos, recursive=True) == ["a/b.jpg", "b.jpg"]
    (place / "empty").mkdir()
    with pytest.raises(InputError, match="no photos in this folder"):
        names_of(place / "empty")


def test_a_list_has_one_path_a_line(place: Path) -> None:
    photos = place / "photos"
    lists = place / "lists"
    lists.mkdir()
    file = lists / "photos.txt"
    elsewhere = photos / "b.jpg"
    # With a byte order mark, an empty line and the line ends of Windows.
    lines = ["a/b.jpg", "", "./c d.jpg", str(elsewhere)]
    file.write_bytes("\r\n".join(["\ufeff" + lines[0], *lines[1:]]).encode())

    # The order is the list's; an absolute path outside of the folder keeps its whole path.
    whole_path = elsewhere.as_posix().lstrip("/")
    found = list(photos_of(file))
    assert [photo.name for photo in found] == ["a/b.jpg", "c d.jpg", whole_path]
    assert [photo.path for photo in found] == [lists / "a/b.jpg", lists / "c d.jpg", elsewhere]

    # Below the folder that is given, names are relative to it.
    file.write_text(f"{elsewhere}\na/../a/b.jpg\n")
    assert names_of(file, folder=photos) == ["b.jpg", "a/b.jpg"]
    assert [photo.path.is_file() for photo in photos_of(file, folder=photos)] == [True, True]


def test_no_name_leads_out_of_a_folder_for_results(place: Path) -> None:
    file = place / "photos.txt"
    file.write_text("../../../../../../../../../../../../etc/a.jpg\n../b.jpg\n/../c.jpg\n")
    for name in names_of(file):
        assert not name.startswith("/")
        assert ".." not in name.split("/")


def test_a_manifest_adds_depth_and_focal_length(place: Path) -> None:
    file = place / "photos.jsonl"
    lines = [
        {"file_name": "photos/b.jpg", "text": "a caption is passed over"},
        {"file_name": "photos/a/b.jpg", "depth_file_name": "depth/1.npy", "focal_px": 500},
        {"file_name": "c.jpg", "depth_file_name": "/depth/2.npy", "fov": 60.5},
    ]
    file.write_text("\n".join(map(json.dumps, lines)))
    first, second, third = photos_of(file)
    assert (first.name, first.depth, first.lens.stated) == ("photos/b.jpg", None, {})
    assert (second.path, second.depth) == (place / "photos/a/b.jpg", place / "depth/1.npy")
    assert (second.lens.stated, third.lens.stated) == ({"focal_px": 500}, {"fov": 60.5})
    assert third.depth == Path("/depth/2.npy")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.txt", "\n \n", "a.txt: names no photos"),
        ("a.txt", "b.jpg\n./b.jpg\n", "line 2: b.jpg is named twice"),
        ("a.txt", "photos/..\n", "line 1: 'photos/..' is not the file name"),
        ("a.txt", "a\0b.jpg\n", "is not the file name"),
        ("a.jsonl", '{"file_name": "a.jpg"}\n{"file_name"', "line 2: not JSON"),
        ("a.jsonl", '["a.jpg"]', "line 1: input should be"),
        ("a.jsonl", '{"file": "a.jpg"}', "line 1: file_name: field required"),
        ("a.jsonl", '{"file_name": 5}', "file_name: input should be a valid string, not 5"),
        ("a.jsonl", '{"file_name": "a.jpg", "fov": -1}', "fov: input should be greater than 0"),
        ("a.jsonl", '{"file_name": "a.jpg", "focal_px": NaN}', "focal_px: "),
        (
            "a.jsonl",
            '{"file_name": "a.jpg", "focal_px": 5, "fov": 5}',
            "focal_px and fov are given together",
        ),
        ("a.json", '{"images": []}', "names no images"),
        ("a.csv", "a.jpg\n", "neither a folder nor a list of photos"),
    ],
)
def test_what_cannot_be_used_is_named(place: Path, name: str, content: str, said: str) -> None:
    file = place / name
    file.write_text(content)
    with pytest.raises(InputError) as error:
        names_of(file)
    assert str(error.value).startswith(str(file))
    assert said in str(error.value)


def test_lists_are_told_by_their_suffix(place: Path) -> None:
    assert is_photo_list(place / "PHOTOS.TXT")
    assert not is_photo_list(place / "photos" / "b.jpg")
    (place / "folder.json").mkdir()
    assert not is_photo_list(place / "folder.json")
    for missing in ("no.txt", "no.json"):
        with pytest.raises(InputError, match=f"{missing}: no such list of photos"):
            names_of(place / missing)
    (place / "binary.txt").write_bytes(b"\xff\xd8\xff")
    with pytest.raises(InputError, match=r"binary\.txt: cannot be read"):
        names_of(place / "binary.txt")
