"""Big files from the web: gone on with after a break, whole under their name or not there, and recorded."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from spackle.downloads.connect import check_url
from spackle.downloads.locks import hold
from spackle.downloads.partial import Progress, digest, read_json, receive, version_file, write_json
from spackle.errors import InputError

AGAIN = "run `spackle weights get` again"


@dataclasses.dataclass(frozen=True)
class Record:
    """What was downloaded; lies beside the file as NAME.json.

    Nobody tells us what the digest ought to be: it is that of the first download. So it shows damage
    and later change, not a download that was bad from the start.
    """

    url: str
    size: int  # bytes
    sha256: str  # 64 hexadecimal digits


def weights_folder() -> Path:
    """Where downloaded weights lie: $SPACKLE_WEIGHTS, else spackle/weights in $XDG_CACHE_HOME or ~/.cache.

    Raises:
        InputError: none is set, and there is no home.
    """
    try:
        if chosen := os.environ.get("SPACKLE_WEIGHTS"):
            return Path(chosen).expanduser()
        cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
        return (cache if cache.is_absolute() else Path.home() / ".cache") / "spackle" / "weights"
    except RuntimeError as error:
        raise InputError("no home folder for downloaded weights: name a folder in SPACKLE_WEIGHTS") from error


def download(url: str, path: str | os.PathLike[str], progress: Progress | None = None) -> Record:
    """Fetch `url` to `path` and write its record; a file that is there is replaced at the end.

    What has come lies in NAME.part until it is whole. After a break, a kill or Ctrl-C the next call asks
    for the rest only, unless the remote file has changed or the server cannot do that.

    Args:
        url: http:// or https://, without a password; proxies are those of the environment.
        path: the file's name here, in a folder that exists.
        progress: called before the first block (what came in an earlier call is done) and after each.

    Raises:
        InputError: the file cannot be had or not be written, or another process is at it.
    """
    check_url(url)
    target = _real(path)
    if os.path.exists(target) and not os.path.isfile(target):
        raise InputError(f"{path}: cannot write: this is not a plain file; give another name")
    part = _beside(target, ".part")
    try:
        with hold(_beside(target, ".lock")):
            record = Record(url, *receive(url, part, progress or (lambda done, total: None)))
            # The record first: a kill in between leaves a file that its record refuses, not one without.
            write_json(dataclasses.asdict(record), _beside(target, ".json"))
            os.replace(part, target)
            version_file(part).unlink()
            return record
    except BlockingIOError as error:
        raise InputError(f"{path}: another process is downloading this file: wait until it is done") from error
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot write: {reason}: make room or choose another folder") from error


def read_record(path: str | os.PathLike[str]) -> Record | None:
    """The record beside a file; None where none lies there.

    Raises:
        InputError: a record that makes no sense.
    """
    place = _beside(_real(path), ".json")
    try:
        fields = read_json(place)
        if fields is None or "sha256" not in fields:  # somebody's notes on a file of their own
            return None
        return Record(str(fields["url"]), int(fields["size"]), str(fields["sha256"]))
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:  # the last: a size of 1e400
        raise InputError(f"{place}: this record of a download cannot be read: delete it and {AGAIN}") from error


def check_recorded(path: str | os.PathLike[str]) -> Record | None:
    """Hold a file against its record: size first, then every byte. None where it has none.

    Raises:
        InputError: they differ, or one of them cannot be read.
    """
    record = read_record(path)
    if record is None:
        return None
    try:
        size = os.path.getsize(path)
        if size != record.size:
            raise InputError(f"{path}: {size:,} bytes, but {record.size:,} were downloaded: delete it and {AGAIN}")
        with open(path, "rb") as file:
            found = digest(file).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if found != record.sha256:
        raise InputError(f"{path}: its SHA-256 is not that of what was downloaded: delete it and {AGAIN}")
    return record


def _real(path: str | os.PathLike[str]) -> Path:
    """The file itself, links followed: beside it lie its record and its part."""
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError) as error:  # a zero byte in the name
        raise InputError(f"{str(path)!r}: not the name of a file: {error}") from error


def _beside(file: Path, suffix: str) -> Path:
    return file.with_name(file.name + suffix)
