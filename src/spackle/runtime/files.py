"""Files and folders for results: checks, atomic writing, locks, complete sets of files, and digests."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from spackle.runtime.errors import InputError, as_input_error, reason_in_a_line

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

LEFTOVER = re.compile(
    r"\.(.+)\.[0-9a-f]{12}(\.\w+)"
)  # pattern of the temporary names that `atomic_path` gives
MAX_HASHED_BYTES = (
    200_000_000  # bytes; a larger file is recognised by its size and modification time
)
LOCK_NAME, NEW = ".lock", ".new"  # names of a lock file and of a folder for a new set of files
BLOCK = 1 << 20  # bytes that are hashed at once


def check_file(path: str | os.PathLike[str], kind: str) -> int:
    """Return the size in bytes of a plain, non-empty file; for anything else raise an InputError that names `kind`."""
    with as_input_error(repr(str(path)), "cannot be read: {reason}", OSError, ValueError):
        if re.match(r"(https?|ftp|s3|gs):/", str(path)):  # a Path has lost the second slash
            address = re.sub(":/+", "://", str(path), count=1)
            raise InputError(
                f"{address}: an address, not a file: download it first and give the name of the {kind}"
            )
        if not os.path.exists(path):
            raise InputError(f"{path}: no such {kind}: check the name")
        if not os.path.isfile(path):
            raise InputError(f"{path}: not a plain file: give the name of a {kind}")
        size = os.path.getsize(path)
        with open(path, "rb"):
            pass
    if size == 0:
        raise InputError(f"{path}: the file is empty: give another {kind}")
    return size


@contextlib.contextmanager
def atomic_path(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary name in the same folder; rename the file to `path` if the block succeeds.

    If the block raises, the temporary file is deleted and an older file at `path` is kept. The temporary name has the
    suffix of `path`, because some writers choose a format by the suffix.

    Raises:
        InputError: the file cannot be written, or the disk fills up.
    """
    target = check_writable(path)
    temporary = target.with_name(f".{target.stem[:50]}.{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())  # a power cut must not leave a name without content
        os.replace(temporary, target)
    except OSError as error:
        if error.filename not in (None, str(temporary)):
            raise  # the error concerns another file, such as an input that the block reads
        raise InputError(f"{path}: cannot write: {reason_in_a_line(error)}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


PathOrFile = str | os.PathLike[str] | BinaryIO  # a path, or a file that is open for writing bytes


def write_atomic(target: PathOrFile, content: bytes) -> None:
    """Write to a path, whole or not at all (see `atomic_path`), or to an open file."""
    if not isinstance(target, str | os.PathLike):
        target.write(content)
        return
    with atomic_path(target) as temporary:
        temporary.write_bytes(content)


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


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write a JSON object, whole or not at all."""
    write_atomic(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())


def list_files(folder: Path, endings: tuple[str, ...], *, below: bool = False) -> list[Path]:
    """A sorted list of a folder's visible files whose names end in one of `endings`; `below` includes subfolders."""
    with as_input_error(folder, "cannot read the folder: {reason}", OSError):
        os.scandir(folder).close()
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if below and not name.startswith(".")]
        found += [
            Path(place) / name
            for name in names
            if name.lower().endswith(endings) and not name.startswith(".")
        ]
    return sorted(file for file in found if file.is_file())


def sha256_of(file: BinaryIO) -> str:
    """SHA-256, in hexadecimal digits, of an open file from its current position on."""
    sha256 = hashlib.sha256()
    while block := file.read(BLOCK):
        sha256.update(block)
    return sha256.hexdigest()


def file_fingerprint(file: Path, kind: str) -> str:
    """A text that changes with the file; an InputError that names `kind` if the file is missing."""
    size = check_file(file, kind)
    if size > MAX_HASHED_BYTES:
        return f"{size} bytes of {file.stat().st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()


@contextlib.contextmanager
def file_lock(path: Path) -> Iterator[None]:
    """Lock the file `path` during the block; the lock of a killed process is released.

    Raises:
        InputError: another process has locked the file, the file cannot be created, or the file system has no locks.
    """
    busy = "another run is at work in this folder: wait for its end, end it, or choose another folder with -o"
    with contextlib.ExitStack() as stack:
        is_ours = False
        while not is_ours:
            # The last holder may delete the file, and the empty folder, before we lock the file.
            with (
                as_input_error(path, "cannot lock: {reason}", OSError),
                contextlib.suppress(FileNotFoundError),
            ):
                make_folder(path.parent)
                file = stack.enter_context(open(path, "ab"))
                with as_input_error(
                    path.parent, busy, OSError if sys.platform == "win32" else BlockingIOError
                ):
                    if sys.platform == "win32":
                        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
                    else:
                        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                is_ours = os.path.samestat(os.fstat(file.fileno()), os.stat(path))
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                path.unlink()


@contextlib.contextmanager
def results_folder(
    path: Path, files: Sequence[str] = (), *, locked: bool = False
) -> Iterator[None]:
    """Create a folder for results; remove the folder if the block writes no file into it.

    Temporary files of killed runs are deleted. `locked` locks the folder during the block.

    Raises:
        InputError: `files` cannot be written, or the folder cannot be locked.
    """
    missing = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        with contextlib.ExitStack() as stack:
            make_folder(path)
            if locked:
                stack.enter_context(file_lock(path / LOCK_NAME))
            for name in files:
                check_writable(path / name)
            with contextlib.suppress(OSError):
                remove_half_written(path, files=files)
            yield
    finally:
        for folder in missing:
            with contextlib.suppress(OSError):  # the folder is not empty
                folder.rmdir()


@contextlib.contextmanager
def atomic_files(folder: Path, last: str) -> Iterator[Path]:
    """Yield a new folder for a set of files; if the block succeeds, the files replace an older set in `folder`.

    The file `last` is deleted first and moved last, so that its presence means a complete set. The caller must have
    locked the folder, see `results_folder`.
    """
    new = folder / NEW
    try:
        with as_input_error(new, "cannot write: {reason}", OSError):
            if new.exists():  # from a killed run
                shutil.rmtree(new)
            new.mkdir()
        yield new
        (folder / last).unlink(missing_ok=True)
        files = [file.relative_to(new) for file in sorted(new.rglob("*")) if file.is_file()]
        for name in sorted(files, key=lambda name: name == Path(last)):
            os.replace(new / name, folder / name)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def file_records(folder: Path, files: Iterable[Path]) -> dict[str, dict[str, object]]:
    """Size in bytes and SHA-256 of files in a folder, by name, for a report."""
    records: dict[str, dict[str, object]] = {}
    for path in files:
        with open(path, "rb") as file:
            records[path.relative_to(folder).as_posix()] = {
                "bytes": path.stat().st_size,
                "sha256": sha256_of(file),
            }
    return records


def matches_records(folder: Path, report: str, records: object) -> bool:
    """Whether a folder still holds the files whose `file_records` a report contains.

    Sizes are compared. Contents are compared too if a file is newer than the report, as in a copied folder.
    """
    if not isinstance(records, Mapping) or not records:
        return False
    try:
        written = (folder / report).stat().st_mtime_ns
        for name, record in records.items():
            facts = (folder / name).stat()
            newer = max(facts.st_mtime_ns, facts.st_ctime_ns) > written
            if facts.st_size != record["bytes"] or (
                newer and file_records(folder, [folder / name])[name] != record
            ):
                return False
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return True


def photo_digest(path: Path) -> str:
    """The photo's `file_fingerprint`, or "none" for a missing photo."""
    with contextlib.suppress(InputError):
        return file_fingerprint(path, "photo")
    return "none"


def remove_half_written(*folders: Path, files: Sequence[str] | None = None) -> None:
    """Delete temporary files that killed runs have left for `files`; None deletes all, but needs locked folders."""
    for folder in folders:
        for file in folder.iterdir():
            match = LEFTOVER.fullmatch(file.name)
            if match and (files is None or match[1] + match[2] in files):
                file.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Create a folder for results if it is missing; InputError if the folder cannot be created or written."""
    with as_input_error(
        path,
        "cannot create this output folder: {reason}; choose another with -o",
        OSError,
        ValueError,
    ):
        path.mkdir(parents=True, exist_ok=True)
    if (
        not os.access(path, os.W_OK | os.X_OK) and path.exists()
    ):  # another run may have just removed the folder
        raise InputError(f"{path}: this output folder is not writable; choose another with -o")


def json_digest(value: object) -> str:
    """SHA-256 of a value as JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def config_differences(
    old: Mapping[str, Any], new: Mapping[str, Any], where: str = ""
) -> list[str]:
    """List the differences of two configurations as "key: old -> new"."""

    def short(value: object) -> str:
        text = json.dumps(value)
        return text if len(text) <= 40 else text[:12] + "…"

    found: list[str] = []
    for key in sorted({*old, *new}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            found += config_differences(a, b, f"{where}{key}.")
        elif a != b:
            found.append(f"{where}{key}: {short(a)} -> {short(b)}")
    return found
