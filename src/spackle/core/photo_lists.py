"""Which photos a command takes: those of a folder, or those that a file lists.

A list is COCO annotations (.json), a file with one path a line (.txt), or a manifest (.jsonl),
which may also name a depth map and a focal length for each photo. Read `photos_of` first.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import BaseModel, Field

from spackle.core.image_formats import list_photos
from spackle.runtime.errors import InputError, as_input_error, short_repr
from spackle.runtime.files import check_file
from spackle.runtime.validation import validated

COCO_SUFFIX = ".json"
MANIFEST_SUFFIX = ".jsonl"
LIST_SUFFIXES = (COCO_SUFFIX, ".txt", MANIFEST_SUFFIX)  # of files that list photos
Log = Callable[[str], None]  # takes a line for the user
PositiveNumber = Annotated[float, Field(gt=0)]


class Lens(NamedTuple):
    """The focal length that a list states for a photo, by one of three options of `load_photo`."""

    focal_px: float | None = None
    focal_mm: float | None = None
    fov: float | None = None

    @property
    def stated(self) -> dict[str, float]:
        """The option that is stated, by its name; none if the list says nothing."""
        return {option: value for option, value in self._asdict().items() if value is not None}


NO_LENS = Lens()  # the list says nothing


class ListedPhoto(NamedTuple):
    """A photo of a folder or list, and what the list says about it."""

    path: Path
    # The photo's path relative to the folder, with slashes: no two photos of a list have the same
    # name, and the name stays when the folder moves or the list grows. It never leads out of a
    # folder for results.
    name: str
    depth: Path | None = None  # its depth map
    lens: Lens = NO_LENS


class ManifestLine(BaseModel, frozen=True, extra="ignore", strict=True, allow_inf_nan=False):
    """What a line of a .jsonl manifest may say; names are those of Hugging Face's metadata.jsonl.

    Other keys are ignored, because such files often hold captions and the like.
    """

    file_name: str  # the photo
    depth_file_name: str | None = None  # its depth map
    # At most one of the next three; their senses are those of `load_photo`.
    focal_px: PositiveNumber | None = None
    focal_mm: PositiveNumber | None = None
    fov: PositiveNumber | None = None


def is_photo_list(path: str | os.PathLike[str]) -> bool:
    """Whether a path names a file that lists photos, by its suffix; a folder is none."""
    return os.fspath(path).lower().endswith(LIST_SUFFIXES) and not os.path.isdir(path)


def photos_of(
    source: Path,
    *,
    folder: Path | None = None,
    recursive: bool = False,
    without: Path | None = None,
    log: Log | None = None,
) -> Iterator[ListedPhoto]:
    """Yield the photos of a folder, sorted by name, or those of a list, in its order.

    COCO annotations come sorted, too, and without the photos that are missing. Whether the photos
    of other lists exist is not checked: their reader says it.

    Args:
        source: a folder, or a file whose suffix is one of `LIST_SUFFIXES`.
        folder: where the relative paths of a list begin; None: in the list's own folder.
        recursive: also the photos of a folder's visible subfolders.
        without: a subfolder that is passed over, such as that of the results.
        log: receives a line about files of a folder that are no photos, and one if photos that
            COCO annotations name are missing.

    Raises:
        InputError: there is no photo, no such file, or a line of a list cannot be used.
    """
    if os.path.isdir(source):
        yield from _photos_of_folder(source, recursive, without, log)
        return
    if not is_photo_list(source):
        raise InputError(
            f"{source}: neither a folder nor a list of photos: give a folder, COCO annotations "
            "(.json), one path a line (.txt) or a manifest (.jsonl)"
        )

    check_file(source, "list of photos")
    root = source.parent if folder is None else folder
    suffix = source.suffix.lower()
    if suffix == COCO_SUFFIX:
        yield from _photos_of_coco(source, root, log)
    elif suffix == MANIFEST_SUFFIX:
        yield from _photos_of_lines(source, root, _photo_of_manifest_line)
    else:
        yield from _photos_of_lines(source, root, _photo_of_path_line)


def _photos_of_folder(
    folder: Path, recursive: bool, without: Path | None, log: Log | None
) -> Iterator[ListedPhoto]:
    """Yield the photos of a folder; InputError if there are none."""
    files = list_photos(folder, below=recursive, without=without, log=log)
    if not files:
        has_subfolders = not recursive and any(path.is_dir() for path in folder.iterdir())
        advice = "give `recursive` for those of its subfolders, or" if has_subfolders else "give"
        raise InputError(f"{folder}: no photos in this folder: {advice} another one")
    # By name, that is, with slashes, so that the order is the same on every system.
    names = sorted(file.relative_to(folder).as_posix() for file in files)
    for name in names:
        yield ListedPhoto(folder / name, name)


# Lists with one photo a line ----------------------------------------------------------------------


def _photos_of_lines(
    source: Path, root: Path, read_line: Callable[[str, Path, str], ListedPhoto]
) -> Iterator[ListedPhoto]:
    """Yield the photos of a file with one photo a line; empty lines are passed over.

    Args:
        source: the file.
        root: where relative paths begin.
        read_line: turns a line, `root`, and what messages call the line into a photo.

    Raises:
        InputError: the file cannot be read or lists no photo, or two lines name the same photo.
    """
    names: set[str] = set()
    with (
        as_input_error(source, "cannot be read: {reason}", OSError, UnicodeDecodeError),
        open(source, encoding="utf-8-sig") as file,  # some editors of Windows write this mark
    ):
        for number, line in enumerate(file, 1):
            text = line.rstrip("\n")
            if not text.strip():
                continue
            where = f"{source}: line {number}"
            photo = read_line(text, root, where)
            # Their results would overwrite each other.
            if photo.name in names:
                raise InputError(f"{where}: {photo.name} is named twice: leave one line out")
            names.add(photo.name)
            yield photo
    if not names:
        raise InputError(f"{source}: names no photos")


def _photo_of_path_line(line: str, root: Path, where: str) -> ListedPhoto:
    """The photo of a line that holds its path."""
    return ListedPhoto(_listed_path(line, root, where), _stable_name(line, root))


def _photo_of_manifest_line(line: str, root: Path, where: str) -> ListedPhoto:
    """The photo of a line that holds a JSON object; InputError if it is no `ManifestLine`."""
    with as_input_error(where, "not JSON ({reason}): write one object a line"):
        content: Any = json.loads(line)
    entry = validated(ManifestLine, content, where)
    lens = Lens(entry.focal_px, entry.focal_mm, entry.fov)
    if len(lens.stated) > 1:
        options = " and ".join(lens.stated)
        raise InputError(f"{where}: {options} are given together: give one of them")

    depth = None
    if entry.depth_file_name is not None:
        depth = _listed_path(entry.depth_file_name, root, where)
    return ListedPhoto(
        path=_listed_path(entry.file_name, root, where),
        name=_stable_name(entry.file_name, root),
        depth=depth,
        lens=lens,
    )


def _listed_path(text: str, root: Path, where: str) -> Path:
    """The file that a list names, relative to `root` or absolute; InputError if it is no name."""
    is_name = text != "" and "\0" not in text and Path(text).name not in ("", "..")
    if not is_name:
        raise InputError(f"{where}: {short_repr(text)} is not the file name of an image")
    return root / text


def _stable_name(text: str, root: Path) -> str:
    """A photo's name in its list: its path below `root`, or else its whole path without the root.

    For example "a/b.jpg" for "./a/b.jpg", and "data/a/b.jpg" for "/data/a/b.jpg", which lies
    elsewhere.
    """
    # Most names need no look at where `root` is.
    path = Path(text)
    if path.is_absolute() or ".." in path.parts:
        path = Path(os.path.abspath(root / path))
        absolute_root = os.path.abspath(root)
        is_below = path.is_relative_to(absolute_root)
        path = path.relative_to(absolute_root if is_below else path.anchor)
    return path.as_posix()


# COCO annotations ---------------------------------------------------------------------------------


def _photos_of_coco(source: Path, root: Path, log: Log | None) -> Iterator[ListedPhoto]:
    """Yield the photos of a COCO file, `{"images": [{"file_name": …}, …]}`, sorted by name.

    InputError if the file is no COCO file, names no photos, or none of them is in `root`.
    """
    names = _read_coco_names(source)
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
    if missing and log is not None:
        log(f"{len(missing)} images that {source} names are not in {root}, such as {missing[0]}")
    for name in present:
        yield ListedPhoto(root / name, name)


def _read_coco_names(source: Path) -> list[str]:
    """The names of the photos that a file of COCO annotations lists.

    Raises:
        InputError: the file has no COCO annotations, or lists no photos; or a name is absolute or
            leads out of the folder of photos, which a stranger's file may try.
    """
    with as_input_error(source, 'no COCO annotations {"images": [{"file_name": …}, …]}: {reason}'):
        content: Any = json.loads(source.read_text(encoding="utf-8"))
        names = [image["file_name"] for image in content["images"]]
    if not names:
        raise InputError(f"{source}: names no images")

    for name in names:
        is_name = isinstance(name, str) and name != "" and "\0" not in name
        if not is_name or name.startswith("/") or ".." in Path(name).parts:
            raise InputError(f"{source}: {short_repr(name)} is not the file name of an image")
    return names
