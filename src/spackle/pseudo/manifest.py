"""What a dataset holds and how it was made: manifest.json."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spackle.errors import InputError
from spackle.formats import atomic_path
from spackle.pseudo.places import open_in

NAME = "manifest.json"
FORMAT = 1  # of shards and manifest; a reader of another one refuses


@dataclasses.dataclass(frozen=True)
class SampleEntry:
    """A photo in a shard."""

    key: str
    photo: str  # its name in its folder
    offset: int  # of its first byte in the shard
    size: int
    sha256: str  # of those bytes
    holes: tuple[float, ...]  # HAR of each view


@dataclasses.dataclass(frozen=True)
class ShardEntry:
    """One tar file."""

    file: str
    size: int
    sha256: str
    samples: tuple[SampleEntry, ...]
    passed_over: tuple[str, ...] = ()  # photos that gave no sample, and why


@dataclasses.dataclass(frozen=True)
class Manifest:
    """A dataset, finished or not."""

    config: Mapping[str, Any]  # everything that decides what is in it
    shards: tuple[ShardEntry, ...]
    complete: bool

    @property
    def samples(self) -> list[tuple[ShardEntry, SampleEntry]]:
        """All photos in their order."""
        return [(shard, sample) for shard in self.shards for sample in shard.samples]

    @property
    def views(self) -> int:
        """Views of all photos."""
        return sum(len(sample.holes) for _, sample in self.samples)

    @property
    def digest(self) -> str:
        """SHA-256 over everything that is in it."""
        return _digest(self._plain())

    def save(self, folder: Path) -> None:
        """Write manifest.json, whole or not at all."""
        text = json.dumps(self._plain() | {"sha256": self.digest}, indent=1, sort_keys=True, allow_nan=False)
        with atomic_path(folder / NAME) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    def _plain(self) -> dict[str, Any]:
        counts = {"photos": len(self.samples), "views": self.views, "bytes": sum(shard.size for shard in self.shards)}
        shards = [dataclasses.asdict(shard) for shard in self.shards]
        content = {"format": FORMAT, "config": dict(self.config), "counts": counts, "shards": shards}
        plain: dict[str, Any] = json.loads(json.dumps(content | {"complete": self.complete}))  # no tuples
        return plain


def load_manifest(location: str | os.PathLike[str]) -> Manifest:
    """Read the manifest of a dataset in a folder or at an address.

    Raises:
        InputError: it is missing, damaged, or of another format.
    """
    where = f"{str(location).rstrip('/')}/{NAME}"
    with open_in(location, NAME) as file:
        text = file.read()
    try:
        content = json.loads(text)
        if content["format"] != FORMAT:
            raise InputError(f"{where}: format {content['format']!r} is not known here, which reads {FORMAT}")
        recorded = content.pop("sha256")
        shards = tuple(_shard(shard) for shard in content["shards"])
        manifest = Manifest(dict(content["config"]), shards, bool(content["complete"]))
        if _digest(content) != recorded or manifest.digest != recorded:
            raise ValueError("its digest does not fit")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where}: damaged, or no manifest of a dataset: {error}") from error
    return manifest


def differences(old: Mapping[str, Any], new: Mapping[str, Any], where: str = "") -> list[str]:
    """What two configurations disagree on, as "key: old -> new"."""
    found: list[str] = []
    for key in sorted({*old, *new}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            found += differences(a, b, f"{where}{key}.")
        elif a != b:
            found.append(f"{where}{key}: {_short(a)} -> {_short(b)}")
    return found


def _shard(content: Mapping[str, Any]) -> ShardEntry:
    samples = [SampleEntry(**{**sample, "holes": tuple(sample["holes"])}) for sample in content["samples"]]
    return ShardEntry(**{**content, "samples": tuple(samples), "passed_over": tuple(content["passed_over"])})


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:12] + "…"
