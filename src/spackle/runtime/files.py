"""Files for results: checks before long work, atomic writing, lists of files.

A file is written under a temporary name and then renamed, so that a killed run leaves whole files
or none. Folders and their locks are in `folders.py`, checksums in `digests.py`.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from spackle.runtime.errors import InputError, as_input_error, reason_in_a_line

# A temporary name as `atomic_path` makes it: ".scene.0123456789ab.ply" for "scene.ply".
TEMPORARY_NAME = re.compile(r"\.(.+)\.[0-9a-f]{12}(\.\w+)")
MAX_STEM_LENGTH = 50  # characters of a temporary name that repeat the file's own name

PathOrFile = str | os.PathLike[str] | BinaryIO  # a path, or a file that is open for writing bytes


def check_file(path: str | os.PathLike[str], kind: str) -> int:
    """Return the size in bytes of a plain, readable, non-empty file.

    Raises:
        InputError: anything else, also an address; the message names `kind`, such as "photo".
    """
    with as_input_error(repr(str(path)), "cannot be read: {reason}", OSError, ValueError):
        # An address that became a pathlib.Path has lost its second slash, so one slash is enough to
        # know it, and the message puts the second one back.
        if re.match(r"(https?|ftp|s3|gs):/", str(path)):
            address = re.sub(":/+", "://", str(path), count=1)
            raise InputError(
                f"{address}: an address, not a file: "
                f"download it first and give the name of the {kind}"
            )
        if not os.path.exists(path):
            raise InputError(f"{path}: no such {kind}: check the name")
        if not os.path.isfile(path):
            raise InputError(f"{path}: not a plain file: give the name of a {kind}")
        size = os.path.getsize(path)
        open(path, "rb").close()  # raises an OSError if it may not be read
    if size == 0:
        raise InputError(f"{path}: the file is empty: give another {kind}")
    return size


def check_writable(path: str | os.PathLike[str]) -> Path:
    """Check, before long work, that a file can be written; return its path with links resolved.

    Raises:
        InputError: the folder is missing or not writable, or `path` exists and is not a plain file.
    """
    with as_input_error(repr(str(path)), "cannot write: {reason}", OSError, ValueError):
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file():
            kind = "a folder" if target.is_dir() else "not a plain file"
            raise InputError(f"{path}: cannot write, because this is {kind}: give a file name")
        if not target.parent.is_dir():
            raise InputError(
                f"{path}: cannot write: the folder {target.parent} does not exist; create it first"
            )
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise InputError(f"{path}: cannot write: the folder {target.parent} is not writable")
    return target


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name in the same folder; rename the file to `path` if the block succeeds.

    If the block raises, the temporary file is deleted and an older file at `path` is kept. The
    temporary name has the suffix of `path`, because some writers choose a format by the suffix.

    Raises:
        InputError: the file cannot be written, or the disk fills up.
    """
    target = check_writable(path)
    # The name starts with a dot, so that lists of files leave it out. The random digits keep two
    # writers of one file apart.
    stem = target.stem[:MAX_STEM_LENGTH]
    temporary = target.with_name(f".{stem}.{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())  # a power cut must not leave a name without content
        os.replace(temporary, target)
    except OSError as error:
        # The error may concern another file, such as an input that the block reads.
        if error.filename not in (None, str(temporary)):
            raise
        raise InputError(f"{path}: cannot write: {reason_in_a_line(error)}") from error
    finally:
        # After a success, the temporary name is gone already.
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_atomic(target: PathOrFile, content: bytes) -> None:
    """Write bytes to a path, whole or not at all, or to an open file.

    Raises:
        InputError: the file at the path cannot be written.
    """
    if not isinstance(target, str | os.PathLike):
        target.write(content)
        return
    with atomic_path(target) as temporary:
        temporary.write_bytes(content)


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write a JSON object to a path, whole or not at all; InputError if it cannot be written."""
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_atomic(path, text.encode())


def remove_half_written(*folders: Path, files: Sequence[str] | None = None) -> None:
    """Delete temporary files that killed runs have left for `files` in some folders.

    Args:
        folders: where to look; subfolders are left alone.
        files: final names of the files. None deletes the temporary files of all names; then the
            caller must have locked the folders, because another run may be writing such a file.
    """
    for folder in folders:
        for file in folder.iterdir():
            match = TEMPORARY_NAME.fullmatch(file.name)
            if match is None:
                continue
            final_name = match[1] + match[2]  # stem and suffix
            if files is None or final_name in files:
                file.unlink(missing_ok=True)


def list_files(
    folder: Path,
    endings: tuple[str, ...],
    *,
    below: bool = False,
    without: Path | None = None,
    links: list[Path] | None = None,
) -> list[Path]:
    """A sorted list of a folder's visible files whose names end in one of `endings`.

    Args:
        folder: the folder; InputError if it cannot be read.
        endings: lower-case ends of names, such as ".jpg"; upper case is found, too.
        below: also list files of the visible subfolders, but not of those that are links.
        without: a folder that is passed over, such as that of the results.
        links: receives the visible subfolders that are links.
    """
    with as_input_error(folder, "cannot read the folder: {reason}", OSError):
        os.scandir(folder).close()  # `os.walk` says nothing about a folder that it cannot read
    passed_over = None if without is None else os.path.realpath(without)

    files = []
    for place, subfolders, names in os.walk(folder):
        # `os.walk` goes on with the subfolders that are left in its own list, so the list itself is
        # changed. It does not follow links, which may lead in a circle.
        subfolders[:] = [name for name in subfolders if below and not name.startswith(".")]
        for name in list(subfolders):
            path = Path(place) / name
            if passed_over is not None and os.path.realpath(path) == passed_over:
                subfolders.remove(name)
            elif links is not None and path.is_symlink():
                links.append(path)
        for name in names:
            file = Path(place) / name
            is_wanted = name.lower().endswith(endings) and not name.startswith(".")
            if is_wanted and file.is_file():
                files.append(file)
    return sorted(files)
