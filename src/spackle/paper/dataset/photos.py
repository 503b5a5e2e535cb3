"""The photos of a dataset: from a folder, or named by COCO annotations."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from spackle.core.photo import PHOTO_SUFFIXES, load_photo
from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import list_files
from spackle.runtime.progress import Progress

DATASET_PHOTO_SUFFIXES = (*PHOTO_SUFFIXES, ".gif", ".bmp")
MIN_SIDE_PX = 32  # pixels: no depth can be recognised in smaller images


@dataclasses.dataclass(frozen=True)
class PhotoFile:
    """A photo of a dataset."""

    index: int  # the photo's number in the dataset
    path: Path
    name: str  # relative to the folder of photos, with slashes
    sha256: str  # of the file

    @property
    def key(self) -> str:
        """The photo's number as text; the names of the photo's files in the dataset begin with this key."""
        return f"{self.index:06d}"


def find_photos(
    source: Path, folder: Path | None, log: Callable[[str], None]
) -> tuple[Path, list[str]]:
    """Find a dataset's photos; returns the folder, and the photos' sorted names relative to the folder.

    Args:
        source: a folder, whose subfolders are included, or a COCO file `{"images": [{"file_name": …}, …]}`.
        folder: the folder of the COCO file's photos; None: the file's own folder.
        log: receives a line if photos that the COCO file names are missing.

    Raises:
        InputError: there is no photo, or no such file.
    """
    if not os.path.isdir(source):
        return _named_by_coco(source, folder, log)
    names = [
        file.relative_to(source).as_posix()
        for file in list_files(source, DATASET_PHOTO_SUFFIXES, below=True)
    ]
    if not names:
        raise InputError(
            f"{source}: no photos in this folder (looked for {', '.join(DATASET_PHOTO_SUFFIXES)})"
        )
    return source, sorted(names)


def _named_by_coco(
    source: Path, folder: Path | None, log: Callable[[str], None]
) -> tuple[Path, list[str]]:
    with as_input_error(
        source, 'neither a folder nor COCO annotations {"images": [{"file_name": …}, …]}: {reason}'
    ):
        content: Any = json.loads(source.read_text(encoding="utf-8"))
        names = [image["file_name"] for image in content["images"]]
    if not names:
        raise InputError(f"{source}: names no images")
    root = source.parent if folder is None else folder
    for name in names:  # names must not lead out of the folder
        if (
            not isinstance(name, str)
            or not name
            or "\0" in name
            or name.startswith("/")
            or ".." in Path(name).parts
        ):
            raise InputError(f"{source}: {str(name)[:60]!r} is not the file name of an image")
    unique = sorted({Path(name).as_posix() for name in names})
    present = [name for name in unique if os.path.isfile(root / name)]
    if not present:
        raise InputError(
            f"{source}: none of the {len(unique)} images is in {root}: give their folder with --images"
        )
    if missing := sorted(set(unique) - set(present)):
        log(f"{len(missing)} images that {source} names are not in {root}, such as {missing[0]}")
    return root, present


def choose_photos(
    root: Path,
    names: Sequence[str],
    count: int | None,
    seed: int,
    warn: Callable[[str], None],
    progress: Progress,
) -> list[PhotoFile]:
    """Choose a dataset's photos, sorted by name: all, or a random subset of `count`.

    The subset depends on names, contents and seed alone. Unreadable photos, small photos and copies are reported to
    `warn` and replaced by other photos. InputError if fewer than `count` photos are usable.
    """
    wanted = len(names) if count is None else count
    order = (
        names
        if count is None
        else sorted(names, key=lambda n: hashlib.sha256(f"{seed}:{n}".encode()).digest())
    )
    chosen: dict[str, str] = {}  # names by SHA-256 of the files
    for name in order:
        if len(chosen) == wanted:
            break
        path = root / name
        try:
            photo = load_photo(path)  # decodes all pixels, to find damage
            if min(photo.width, photo.height) < MIN_SIDE_PX:
                size = f"{photo.width}×{photo.height}"
                raise InputError(
                    f"{path}: {size} pixels are too few (at least {MIN_SIDE_PX} each way)"
                )
            with open(path, "rb") as file:
                sha256 = sha256_of(file)
            if chosen.setdefault(sha256, name) != name:
                raise InputError(f"{path}: the same photo as {chosen[sha256]}")
        except InputError as error:
            warn(f"passed over: {error}")
        progress(len(chosen), wanted)
    if not chosen:
        raise InputError(
            f"{root}: none of {len(names)} photos can be used (the lines above say why)"
        )
    if count is not None and len(chosen) < count:
        raise InputError(f"{root}: {len(chosen)} photos can be used, and --sample asks for {count}")
    by_name = sorted((name, sha256) for sha256, name in chosen.items())
    return [
        PhotoFile(index, root / name, name, sha256) for index, (name, sha256) in enumerate(by_name)
    ]
