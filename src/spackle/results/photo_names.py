"""The photos of a run of `spackle predict`, each with the name of its results.

`find_photos` finds them; `result_names` names them so that no two results meet.
"""

from __future__ import annotations

import glob
import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from spackle.core.image_formats import kind_of_file
from spackle.core.photo_lists import NO_LENS, Lens, ListedPhoto, is_photo_list, photos_of
from spackle.results.results_file import RESULTS_NAME
from spackle.runtime.errors import InputError
from spackle.runtime.folders import LOCK_NAME

# What lies beside the folders of the photos' results; no photo's folder has such a name.
RESERVED_NAMES = {RESULTS_NAME, LOCK_NAME}


class NamedPhoto(NamedTuple):
    """A photo, and the name of the folder with its results."""

    path: Path
    name: str  # with slashes, if the photos are those of a tree of folders, or of a list
    number: int  # its place among the photos of the run, from 0
    depth: Path | None = None  # the depth map that a list names for it
    lens: Lens = NO_LENS  # the focal length that a list states


def find_photos(
    sources: Sequence[Path],
    output: Path,
    log: Callable[[str], None] | None = None,
    *,
    recursive: bool = False,
) -> list[NamedPhoto]:
    """The photos that are given by name, by a pattern such as "*.png", by folder, or by a list.

    Args:
        sources: names, patterns, folders, and files that list photos.
        output: the folder of results; what lies in it is no photo.
        log: receives a line that names and counts the files of a folder that are no photos.
        recursive: also the photos of subfolders.

    Raises:
        InputError: a folder without photos, or two photos whose results would have the same name.
    """
    listed: list[ListedPhoto] = []
    for source in sources:
        listed += _photos_of(source, output, log, recursive)
    names = result_names(listed)
    return [
        NamedPhoto(photo.path, name, number, photo.depth, photo.lens)
        for number, (photo, name) in enumerate(zip(listed, names, strict=True))
    ]


def result_names(photos: Sequence[ListedPhoto]) -> list[str]:
    """The name of each photo's folder of results, relative to the folder of all results.

    It is the photo's own name, relative to its folder, without the suffix: "a/x" for "a/x.jpg". The
    suffix stays where "a/x" would also be the folder of another photo ("a/x.png"), a folder of
    photos ("a/x/1.jpg"), or a file that the run writes. InputError if two photos have one name.
    """
    # Names that differ only in upper and lower case count as equal, because the file systems of
    # Windows and macOS do not distinguish them.
    whole_names = [photo.name.casefold() for photo in photos]
    short_names = [os.path.splitext(photo.name)[0] for photo in photos]
    folders = _folders_of(whole_names)
    taken = {*whole_names, *folders, *RESERVED_NAMES}
    counts = Counter(name.casefold() for name in short_names)

    names: list[str] = []
    photo_of: dict[str, ListedPhoto] = {}
    for photo, short_name in zip(photos, short_names, strict=True):
        key = short_name.casefold()
        name = short_name if counts[key] == 1 and key not in taken else photo.name
        other = photo_of.get(name.casefold())
        if other is not None:
            raise InputError(
                f"{photo.path}: {other.path} has the same name: "
                "predict them in two runs, each with its own `output`"
            )
        if name.casefold() in folders:
            raise InputError(
                f"{photo.path}: a folder of photos has the same name: "
                "predict them in two runs, each with its own `output`"
            )
        photo_of[name.casefold()] = photo
        names.append(name)
    return names


def _folders_of(names: Sequence[str]) -> set[str]:
    """All folders in names with slashes: "a" and "a/b" for "a/b/x.jpg"."""
    folders: set[str] = set()
    for folder in {name.rpartition("/")[0] for name in names}:
        while folder and folder not in folders:
            folders.add(folder)
            folder = folder.rpartition("/")[0]
    return folders


def _photos_of(
    source: Path, output: Path, log: Callable[[str], None] | None, recursive: bool
) -> list[ListedPhoto]:
    """The photos in a folder, of a list, or that match a pattern, or the file itself.

    `log` receives a line about other files of the folder. InputError for a folder without photos.
    """
    if os.path.isdir(source):
        if recursive and os.path.realpath(source) == os.path.realpath(output):
            raise InputError(
                f"{source}: with `recursive` the results in it would count as photos: "
                "choose another `output`"
            )
        return list(photos_of(source, recursive=recursive, without=output, log=log))
    # A photo with a list's suffix is a photo all the same.
    if is_photo_list(source) and not _is_photo(source):
        return list(photos_of(source, log=log))

    return [ListedPhoto(file, file.name) for file in files_of_pattern(source)]


def files_of_pattern(source: Path) -> list[Path]:
    """The files that match a pattern such as "*.png", sorted; or `source` itself if none does."""
    # Not every shell replaces a pattern by names. If a file has just this name, such as "a[1].png",
    # the file is meant.
    matches = [] if os.path.lexists(source) else sorted(glob.glob(str(source)))
    # Whether the file exists is checked when it is read, where the message can say more.
    return [Path(match) for match in matches] or [source]


def _is_photo(path: Path) -> bool:
    """Whether a file exists and is a photo by its first bytes."""
    return os.path.isfile(path) and os.path.getsize(path) > 0 and kind_of_file(path).is_photo
