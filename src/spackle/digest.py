"""Digests of what results depend on, and what differs: so a folder that was interrupted goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spackle.downloads import read_record
from spackle.downloads.transfer import digest
from spackle.image import check_file

MAX_HASHED = 200_000_000  # bytes of a file that is read to tell whether it has changed


def fingerprint(file: Path, kind: str) -> str:
    """The digest of a file, or of gigabytes size and time of change; InputError (naming `kind`) if it is missing."""
    size = check_file(file, kind)
    if size > MAX_HASHED:
        return f"{size} bytes of {file.stat().st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()


def weights_digest(path: Path) -> str:
    """SHA-256 of a checkpoint: the recorded one of a download, else of the file."""
    record = read_record(path)
    if record is not None:
        return record.sha256
    with open(path, "rb") as file:
        return digest(file).hexdigest()


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
