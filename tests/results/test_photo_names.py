"""Each photo of a run has a folder of its own for its results."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spackle.core.photo_lists import ListedPhoto
from spackle.results.photo_names import find_photos, result_names
from spackle.runtime.errors import InputError


def named(*names: str) -> list[str]:
    return result_names([ListedPhoto(Path(name), name) for name in names])


def write(folder: Path, *names: str) -> Path:
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"\xff\xd8\xff")  # as a JPEG begins
    return folder


def test_results_have_the_photos_relative_name_and_keep_a_suffix_that_tells_them_apart() -> None:
    assert named("a/x.jpg", "a_x.jpg", "b/x.jpg") == ["a/x", "a_x", "b/x"]
    assert named("x.jpg", "X.png", "y.png") == ["x.jpg", "X.png", "y"]
    # The short name of one is the whole name, or the folder, of another.
    assert named("x.jpg.png", "x.jpg", "z.webp") == ["x.jpg.png", "x", "z"]
    assert named("x.jpg", "x/1.jpg", "x/views.jpg") == ["x.jpg", "x/1", "x/views"]
    # Files that a run writes itself.
    assert named("results.jsonl.png", ".lock.png") == ["results.jsonl.png", ".lock.png"]


def test_what_cannot_lie_in_one_folder_is_refused() -> None:
    with pytest.raises(InputError, match=r"A\.jpg: a\.jpg has the same name"):
        named("a.jpg", "A.jpg")
    with pytest.raises(InputError, match="a folder of photos has the same name"):
        named("x.jpg", "x.png", "x.jpg/1.png")


PARTS = st.sampled_from(["a", "b", "A", "a.jpg", "a.jpg.png", "b.png"])
PHOTO_NAMES = st.lists(PARTS, min_size=1, max_size=3).map(lambda parts: "/".join(parts) + ".jpg")


@given(st.lists(PHOTO_NAMES, unique_by=str.casefold, max_size=6))
def test_no_result_lies_in_or_at_another(names: list[str]) -> None:
    try:
        folders = [f"{name.casefold()}/" for name in named(*names)]
    except InputError:
        return
    for index, folder in enumerate(folders):
        others = folders[:index] + folders[index + 1 :]
        assert not any(other.startswith(folder) for other in others)


def test_a_tree_gives_all_photos_but_those_of_the_results_hidden_ones_and_links(
    tmp_path: Path,
) -> None:
    photos = write(
        tmp_path / "photos", "b.jpg", "a/b.jpg", ".hidden/c.jpg", "a/.c.jpg", "out/b/views/0.png"
    )
    elsewhere = write(tmp_path / "elsewhere", "d.jpg")
    (photos / "linked").symlink_to(elsewhere)
    (photos / "circle").symlink_to(photos)
    (photos / "e.jpg").symlink_to(elsewhere / "d.jpg")  # the link to a photo is a photo
    said: list[str] = []
    found = find_photos([photos], photos / "out", said.append, recursive=True)
    assert [photo.name for photo in found] == ["a/b", "b", "e"]
    assert [photo.number for photo in found] == [0, 1, 2]
    assert said == [
        f"{photos}: subfolders that are links are left out, circle, linked: "
        "give them as folders of their own"
    ]
    assert [photo.name for photo in find_photos([photos], tmp_path / "out")] == ["b", "e"]
    with pytest.raises(InputError, match="would count as photos"):
        find_photos([photos], photos, recursive=True)
    with pytest.raises(InputError, match="give `recursive` for those of its subfolders"):
        find_photos([tmp_path], tmp_path / "out")


def test_a_list_names_photos_and_a_photo_may_have_a_lists_suffix(tmp_path: Path) -> None:
    write(tmp_path, "a/1.jpg", "photo.txt")
    (tmp_path / "photos.jsonl").write_text(
        '{"file_name": "a/1.jpg", "fov": 60}\n{"file_name": "2.jpg", "depth_file_name": "2.npy"}\n'
    )
    first, second, third = find_photos(
        [tmp_path / "photos.jsonl", tmp_path / "photo.txt"], tmp_path / "out"
    )
    assert (first.name, first.path, first.lens.fov) == ("a/1", tmp_path / "a/1.jpg", 60)
    assert (second.name, second.depth) == ("2", tmp_path / "2.npy")
    assert third.path == tmp_path / "photo.txt"
