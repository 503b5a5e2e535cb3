"""Recognise files and settings: checksums, records of files in reports, differences of settings."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from spackle.runtime.errors import InputError
from spackle.runtime.files import check_file

HASH_BLOCK_BYTES = 1 << 20  # read at once, so that a large file needs little memory
MAX_HASHED_BYTES = 200_000_000  # hashing takes a second; a larger file is known by size and time
DIGEST_KEY = "sha256"  # of the digest of a mapping, beside its other values
SEAL = b"spackle sha256 "  # begins a file with a digest of all that follows the first line

DigestOf = Callable[[Any], str]  # such as `json_digest`


def sha256_of(file: BinaryIO) -> str:
    """SHA-256, in hexadecimal digits, of an open file from its current position on."""
    sha256 = hashlib.sha256()
    while block := file.read(HASH_BLOCK_BYTES):
        sha256.update(block)
    return sha256.hexdigest()


def json_digest(value: object) -> str:
    """SHA-256, in hexadecimal digits, of a value as JSON; the order of keys does not matter."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def signed(content: Mapping[str, Any], digest_of: DigestOf = json_digest) -> dict[str, Any]:
    """The content and its digest, for a file that a later run trusts; `unsigned` checks it."""
    return {**content, DIGEST_KEY: digest_of(content)}


def unsigned(content: Mapping[str, Any], digest_of: DigestOf = json_digest) -> dict[str, Any]:
    """The content that `signed` was given; content without a digest, of older versions, as it is.

    Raises:
        ValueError: the content is not the one that was signed.
    """
    plain = dict(content)
    stated_digest = plain.pop(DIGEST_KEY, None)
    if stated_digest is not None and stated_digest != digest_of(plain):
        raise ValueError("damaged: its digest is another one")
    return plain


def sealed(content: bytes) -> bytes:
    """The content after a line with its SHA-256, for a file that a later run trusts."""
    return SEAL + hashlib.sha256(content).hexdigest().encode() + b"\n" + content


def unsealed(data: bytes) -> bytes:
    """The content that `sealed` was given; data without a seal, of older versions, as it is.

    Raises:
        ValueError: the content is not the one that was sealed.
    """
    # Of a damaged seal at least one of the three parts of its first line is left.
    line, _, content = data.partition(b"\n")
    seal_bytes = len(SEAL) + 2 * hashlib.sha256().digest_size
    if not line.startswith(SEAL[:7]) and len(line) != seal_bytes:
        return data
    if line != sealed(content).partition(b"\n")[0]:
        raise ValueError("its digest is another one")
    return content


def file_fingerprint(file: Path, kind: str) -> str:
    """A text that changes whenever the file changes.

    It is the SHA-256 of the content. A large file would take too long to hash, so for it the text
    is its size and the time of its last change.

    Raises:
        InputError: the file is missing or empty; the message names `kind`, such as "photo".
    """
    size = check_file(file, kind)
    if size > MAX_HASHED_BYTES:
        return f"{size} bytes of {file.stat().st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()


def photo_digest(path: Path) -> str:
    """A text that changes whenever the photo changes, or "none" for a missing photo."""
    with contextlib.suppress(InputError):
        return file_fingerprint(path, "photo")
    return "none"


def file_records(folder: Path, files: Iterable[Path]) -> dict[str, dict[str, object]]:
    """Size in bytes and SHA-256 of files in a folder, by their names in the folder, for a report.

    For example {"scene.ply": {"bytes": 1234, "sha256": "9f86…"}}.
    """
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

    Sizes are always compared, but contents only if a file is newer than the report, as the files of
    a copied folder are: hashing every file of every finished photo would take minutes.

    Args:
        folder: the folder of the files.
        report: name of the report's file in the folder.
        records: what the report contains; anything, because somebody may have edited it.
    """
    if not isinstance(records, Mapping) or not records:
        return False
    try:
        report_time = (folder / report).stat().st_mtime_ns
        return all(
            _matches_record(folder, name, record, report_time) for name, record in records.items()
        )
    except (OSError, ValueError, KeyError, TypeError):  # a file is missing, a record is no record
        return False


def _matches_record(folder: Path, name: str, record: Any, report_time: int) -> bool:
    """Whether a file has the recorded size and, if it is newer than the report, SHA-256.

    Args:
        folder: the folder of the file.
        name: of the file in the folder.
        record: as `file_records` makes it: {"bytes": …, "sha256": …}.
        report_time: when the report was written, in nanoseconds.
    """
    facts = (folder / name).stat()
    if facts.st_size != record["bytes"]:
        return False
    # A copied file may keep the time of its content (mtime), but not that of its entry (ctime).
    is_newer = max(facts.st_mtime_ns, facts.st_ctime_ns) > report_time
    if not is_newer:
        return True
    return bool(file_records(folder, [folder / name])[name] == record)


def config_differences(
    old: Mapping[str, Any], new: Mapping[str, Any], prefix: str = ""
) -> list[str]:
    """List the differences of two nested configurations as lines "key: old -> new".

    `prefix` stands before each key; the keys of nested configurations are joined by dots.
    """
    lines: list[str] = []
    for key in sorted({*old, *new}):
        old_value, new_value = old.get(key), new.get(key)
        if isinstance(old_value, Mapping) and isinstance(new_value, Mapping):
            lines += config_differences(old_value, new_value, f"{prefix}{key}.")
        elif old_value != new_value:
            lines.append(f"{prefix}{key}: {_short_json(old_value)} -> {_short_json(new_value)}")
    return lines


def _short_json(value: object) -> str:
    """A value as JSON; a long one, such as a digest, is cut to 12 characters."""
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:12] + "…"
