"""Files and folders for results: written whole or not at all, held by one run, known again by their digests."""

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

from spackle.errors import InputError, reading, reason_in_a_line

LOCK, NEW = ".lock", ".new"
LEFTOVER = re.compile(r"\.(.+)\.[0-9a-f]{12}(\.\w+)")  # how `atomic_path` calls its temporary files
MAX_HASHED = 200_000_000  # bytes of a file that is read to tell whether it has changed
BLOCK = 1 << 20  # bytes of a file that are hashed at once


def check_file(path: str | os.PathLike[str], kind: str) -> int:
    """The size in bytes of a plain, non-empty file; InputError otherwise. `kind` names it in messages."""
    with reading(repr(str(path)), "cannot be read: {reason}", OSError, ValueError):
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
def atomic_path(path: str | os.PathLike[str], *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary name in the same folder; rename it to `path` where the block succeeds.

    Where the block raises, the temporary file goes and an older file at `path` stays as it was. The
    temporary name keeps the suffix, because some writers choose a format by it. Only a
    `durable` file is synced to the disk: a killed process leaves whole files, a power cut need not.

    Raises:
        InputError: where nothing can be written there, or the disk fills up.
    """
    target = check_writable(path)
    stem = os.fsdecode(os.fsencode(target.stem)[:100]) if len(os.fsencode(target.stem)) > 100 else target.stem
    temporary = target.with_name(f".{stem}.{secrets.token_hex(6)}{target.suffix}")
    try:
        yield temporary
        if durable:
            _sync(temporary)
        os.replace(temporary, target)
        if durable and os.name == "posix":
            _sync(target.parent)  # its name, too
    except OSError as error:
        if error.filename not in (None, str(temporary)):
            raise  # about another file, such as an input that the block reads
        raise InputError(f"{path}: cannot write: {reason_in_a_line(error)}") from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_whole(path: str | os.PathLike[str], content: bytes) -> None:
    """Write a file whole or not at all; see `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def check_writable(path: str | os.PathLike[str]) -> Path:
    """The file that a write to `path` would replace, links followed.

    Worth calling before long work whose result goes there.

    Raises:
        InputError: where the folder is missing or closed to us, or the name is taken by something
            that is not a plain file (replacing /dev/null would be a surprise).
    """
    # A name too long, a zero byte in it, a loop of links.
    with reading(repr(str(path)), "cannot write: {reason}", OSError, ValueError):
        target = Path(os.path.realpath(path))
        if target.exists() and not target.is_file():
            kind = "a folder" if target.is_dir() else "not a plain file"
            raise InputError(f"{path}: cannot write: this is {kind}; give a file name")
        if not target.parent.is_dir():
            raise InputError(f"{path}: cannot write: the folder {target.parent} does not exist; create it first")
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise InputError(f"{path}: cannot write: the folder {target.parent} is not writable")
    return target


def write_json(content: Mapping[str, Any], path: Path, *, durable: bool = False) -> None:
    """Write a JSON object, whole or not at all; see `atomic_path`."""
    with atomic_path(path, durable=durable) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


if sys.platform == "win32":
    import msvcrt

    def _lock(file: BinaryIO) -> None:
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError as error:
            raise BlockingIOError(*error.args) from error
else:
    import fcntl

    def _lock(file: BinaryIO) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextlib.contextmanager
def hold(path: Path) -> Iterator[None]:
    """Hold the lock file `path` during the block; a killed process's lock is free.

    Raises:
        BlockingIOError: somebody else holds it.
        OSError: the file cannot be created, or the file system has no locks.
    """
    file = _acquire(path)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows deletes no open file, and it may stay
            path.unlink()
        file.close()


def _acquire(path: Path) -> BinaryIO:
    while True:
        with contextlib.ExitStack() as stack:
            file = stack.enter_context(open(path, "ab"))
            _lock(file)
            # Its last holder may have removed it between these two steps: then what we hold has no name.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
                    stack.pop_all()
                    return file


@contextlib.contextmanager
def results_folder(path: Path, files: Sequence[str] = (), *, alone: bool = False) -> Iterator[None]:
    """Create a folder for results; where the block puts nothing into it, it goes again.

    The block writes `files`: InputError before long work if it cannot. Deletes what a killed run left of them. With
    `alone` nobody else works in the folder during the block: InputError if somebody does.
    """
    missing = [folder for folder in (path, *path.parents) if not os.path.exists(folder)]
    try:
        with contextlib.ExitStack() as stack:
            make_folder(path)
            if alone:
                stack.enter_context(_alone_in(path))
            for name in files:
                check_writable(path / name)
            with contextlib.suppress(OSError):
                remove_half_written(path, files=files)
            yield
    finally:
        for folder in missing:
            with contextlib.suppress(OSError):  # it holds something
                folder.rmdir()


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the kernel takes from a killed run."""
    with contextlib.ExitStack() as stack:
        try:
            while True:
                with contextlib.suppress(FileNotFoundError):  # another run has just removed the empty folder
                    stack.enter_context(hold(folder / LOCK))
                    break
                make_folder(folder)
        except BlockingIOError as error:
            raise InputError(
                f"{folder}: another run is at work in this folder: wait for it, end it, or choose another with -o"
            ) from error
        except OSError as error:
            raise InputError(f"{folder / LOCK}: cannot write: {reason_in_a_line(error)}") from error
        yield


def mark(folder: Path) -> str:
    """Mark a folder that the caller is `alone` in, until then; `check_mark` knows it again on another machine."""
    word = secrets.token_hex(8)
    (folder / LOCK).write_text(word)
    return word


def check_mark(folder: Path, word: str) -> None:
    """InputError where `folder` is not the one that was given this mark."""
    try:
        if (folder / LOCK).read_text() == word:
            return
    except (OSError, ValueError):
        pass
    raise InputError(f"{folder}: not this command's folder for results: it must lie on a disk that all nodes share")


@contextlib.contextmanager
def whole_set(folder: Path, last: str) -> Iterator[Path]:
    """Yield a new folder for a set of files; where the block succeeds, they take their places in `folder`.

    Where it raises, an older set stays as it was. The file `last` vouches for the others, so that it leaves first and
    comes last. The caller is `alone` there (`results_folder`).
    """
    new = folder / NEW
    try:
        with reading(new, "cannot write: {reason}", OSError):
            if os.path.lexists(new):  # of a killed run
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
    """Bytes and SHA-256 of files in a folder, by name, for a report that vouches for them."""
    records: dict[str, dict[str, object]] = {}
    for path in files:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            records[path.relative_to(folder).as_posix()] = {"bytes": size, "sha256": sha256_of(file)}
    return records


def as_recorded(folder: Path, report: str, records: object) -> bool:
    """Whether a folder still holds the files that a report in it vouches for by `file_records`.

    Size and times tell; a file that is newer than the report, as in a copied folder, is read.
    """
    if not isinstance(records, Mapping) or not records:
        return False
    try:
        written = (folder / report).stat().st_mtime_ns
        for name, record in records.items():
            facts = (folder / name).stat()
            newer = max(facts.st_mtime_ns, facts.st_ctime_ns) > written
            if facts.st_size != record["bytes"] or (newer and file_records(folder, [folder / name])[name] != record):
                return False
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return True


def remove_half_written(*folders: Path, files: Sequence[str] | None = None) -> None:
    """Delete what killed runs left of `files`; of any file if None, where the caller is `alone`."""
    for folder in folders:
        for file in folder.iterdir():
            match = LEFTOVER.fullmatch(file.name)
            if match and (files is None or match[1] + match[2] in files):
                file.unlink(missing_ok=True)


def make_folder(path: Path) -> None:
    """Create a folder for results, or check that it can be written to; InputError where it cannot."""
    with reading(path, "cannot create this output folder: {reason}; choose another with -o", OSError, ValueError):
        path.mkdir(parents=True, exist_ok=True)
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: this output folder is not writable; choose another with -o")


def files_in(folder: Path, endings: tuple[str, ...], *, below: bool = False) -> list[Path]:
    """The files in a folder whose names end so, in any case; with `below` those in folders below it, too.

    Sorted; what is hidden is left out. InputError where the folder cannot be read.
    """
    with reading(folder, "cannot read the folder: {reason}", OSError):
        os.scandir(folder).close()
    found = []
    for place, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if below and not name.startswith(".")]
        found += [Path(place) / name for name in names if name.lower().endswith(endings) and not name.startswith(".")]
    return sorted(file for file in found if file.is_file())


def sha256_of(file: BinaryIO) -> str:
    """SHA-256 of the rest of an open file, as 64 hexadecimal digits."""
    sha256 = hashlib.sha256()
    while block := file.read(BLOCK):
        sha256.update(block)
    return sha256.hexdigest()


def fingerprint(file: Path, kind: str) -> str:
    """The digest of a file, or of gigabytes size and time of change; InputError (naming `kind`) if it is missing."""
    size = check_file(file, kind)
    if size > MAX_HASHED:
        return f"{size} bytes of {file.stat().st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()


def digest_of(value: object) -> str:
    """SHA-256 of a value as JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def differences(old: Mapping[str, Any], new: Mapping[str, Any], where: str = "") -> list[str]:
    """What two configurations disagree on, as "key: old -> new"."""

    def short(value: object) -> str:
        text = json.dumps(value)
        return text if len(text) <= 40 else text[:12] + "…"

    found: list[str] = []
    for key in sorted({*old, *new}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            found += differences(a, b, f"{where}{key}.")
        elif a != b:
            found.append(f"{where}{key}: {short(a)} -> {short(b)}")
    return found
