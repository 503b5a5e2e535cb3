"""The photos of a dataset: from a folder, or named by COCO annotations."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from spackle.core.image_formats import list_photos
from spackle.core.photo import load_photo
from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.progress import Progress

MIN_SIDE_PX = 32  # no depth can be recognised in smaller images
MAX_SHOWN_CHARACTERS = 60  # of a bad name, in a message


@dataclasses.dataclass(frozen=True)
class PhotoFile:
    """A photo of a dataset."""

    index: int  # the photo's number in the dataset
    path: Path
    name: str  # relative to the folder of photos, with slashes
    sha256: str  # of the file

    @property
    def key(self) -> str:
        """The photo's number as text, with which the names of its files in the dataset begin."""
        return f"{self.index:06d}"


def find_photos(
    source: Path, folder: Path | None, log: Callable[[str], None]
) -> tuple[Path, list[str]]:
    """Find a dataset's photos.

    Args:
        source: a folder, whose subfolders are included, or a COCO file, a list of photos as
            `{"images": [{"file_name": …}, …]}`.
        folder: the folder of the COCO file's photos; None: the file's own folder.
        log: receives a line about files of the folder that are no photos, and one if photos that
            the COCO file names are missing.

    Returns:
        The folder, and the photos' sorted names relative to the folder.

    Raises:
        InputError: there is no photo, or no such file.
    """
    # Whatever is no folder must be a list of photos.
    if not os.path.isdir(source):
        return find_coco_photos(source, folder, log)
    files = list_photos(source, below=True, log=log)
    if not files:
        raise InputError(f"{source}: no photos in this folder: give another one")
    return source, sorted(file.relative_to(source).as_posix() for file in files)


def find_coco_photos(
    source: Path, folder: Path | None, log: Callable[[str], None]
) -> tuple[Path, list[str]]:
    """Find the photos that a COCO file, a list of photos as JSON, names.

    Args:
        source: the COCO file.
        folder: the folder of the photos; None: the file's own folder.
        log: receives a line if some of the photos are missing.

    Returns:
        The folder, and the sorted names of the photos in it.

    Raises:
        InputError: the file is no COCO file, names no photos, or none of them is there.
    """
    names = read_coco_names(source)
    root = source.parent if folder is None else folder
    # Some lists name a photo twice, or by two spellings of its path, such as a.jpg and ./a.jpg.
    unique_names = sorted({Path(name).as_posix() for name in names})
    present = [name for name in unique_names if os.path.isfile(root / name)]
    if not present:
        raise InputError(
            f"{source}: none of the {len(unique_names)} images is in {root}: give their folder "
            "with `images`"
        )

    # COCO's lists are longer than what people download, so a missing photo is no error.
    missing = sorted(set(unique_names) - set(present))
    if missing:
        log(f"{len(missing)} images that {source} names are not in {root}, such as {missing[0]}")
    return root, present


def read_coco_names(source: Path) -> list[str]:
    """The names of the photos that a file of COCO annotations lists.

    Raises:
        InputError: the file has no COCO annotations, or lists no photos; or a name is absolute or
            leads out of the folder of photos, which a stranger's file may try.
    """
    with as_input_error(
        source, 'neither a folder nor COCO annotations {"images": [{"file_name": …}, …]}: {reason}'
    ):
        content: Any = json.loads(source.read_text(encoding="utf-8"))
        names = [image["file_name"] for image in content["images"]]
    if not names:
        raise InputError(f"{source}: names no images")

    for name in names:
        is_name = isinstance(name, str) and name != "" and "\0" not in name
        if not is_name or name.startswith("/") or ".." in Path(name).parts:
            shown = repr(str(name)[:MAX_SHOWN_CHARACTERS])
            raise InputError(f"{source}: {shown} is not the file name of an image")
    return names


def choose_photos(
    root: Path,
    names: Sequence[str],
    count: int | None,
    seed: int,
    warn: Callable[[str], None],
    progress: Progress,
) -> list[PhotoFile]:
    """Choose a dataset's photos, sorted by name: all, or a random subset.

    The subset depends on names, contents and seed alone, not on the order of the names. Unreadable
    photos, small photos and copies are replaced by other photos.

    Args:
        root: the folder of the photos.
        names: their names, relative to the folder.
        count: number of photos; None: all.
        seed: determines the subset.
        warn: receives a line for each photo that cannot be used.
        progress: receives (photos chosen, photos wanted).

    Raises:
        InputError: no photo is usable, or fewer than `count` are.
    """
    wanted_count = len(names) if count is None else count
    order = list(names)
    if count is not None:
        # A random order by a digest of each name: when a photo joins, the others keep their order.
        order.sort(key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest())

    chosen: dict[str, str] = {}  # names by SHA-256 of the files
    for name in order:
        if len(chosen) == wanted_count:
            break
        try:
            # If one copy were in training and another in validation, validation would be worthless.
            sha256 = check_photo_file(root / name)
            if sha256 in chosen:
                raise InputError(f"{root / name}: the same photo as {chosen[sha256]}")
            chosen[sha256] = name
        except InputError as error:
            warn(f"passed over: {error}")
        progress(len(chosen), wanted_count)

    if not chosen:
        raise InputError(
            f"{root}: none of {len(names)} photos can be used (the lines above say why)"
        )
    if count is not None and len(chosen) < count:
        raise InputError(f"{root}: {len(chosen)} photos can be used, and `sample` asks for {count}")
    names_and_digests = sorted((name, sha256) for sha256, name in chosen.items())
    return [
        PhotoFile(index, root / name, name, sha256)
        for index, (name, sha256) in enumerate(names_and_digests)
    ]


def check_photo_file(path: Path) -> str:
    """Read a photo; returns the SHA-256 of its file. InputError if it is damaged or too small."""
    photo = load_photo(path)  # decodes all pixels, to find damage
    if min(photo.width, photo.height) < MIN_SIDE_PX:
        size = f"{photo.width}×{photo.height}"
        raise InputError(f"{path}: {size} pixels are too few (at least {MIN_SIDE_PX} each way)")
    with open(path, "rb") as file:
        return sha256_of(file)
