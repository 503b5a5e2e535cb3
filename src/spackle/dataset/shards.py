"""The manifest and the shards of a dataset, in a folder or at an address (optional: pip install fsspec)."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import IO, Any

from spackle.dataset.sample import END, PhotoGroup
from spackle.errors import InputError, reason_in_a_line
from spackle.files import atomic_path, digest_of
from spackle.progress import Step

NAME = "manifest.json"
FORMAT = 1  # of shards and manifest; a reader of another one refuses
MAX_BYTES = 1 << 40  # of a shard


def open_in(location: str | os.PathLike[str], name: str) -> IO[bytes]:
    """Open a seekable file in a folder or at an fsspec address (s3://bucket/dataset); InputError if it cannot."""
    place = f"{str(location).rstrip('/')}/{name}"
    try:
        if "://" not in place:
            return open(os.path.join(location, name), "rb")
        import fsspec

        file: IO[bytes] = fsspec.open(place, "rb").open()
        return file
    except FileNotFoundError as error:
        raise InputError(f"{place}: not there: is {location} a dataset of `spackle dataset build`?") from error
    except OSError as error:
        raise InputError(f"{place}: cannot be read: {error.strerror or reason_in_a_line(error)}") from error
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{place}: cannot be opened ({reason_in_a_line(error)}): an address needs a package (pip install fsspec), "
            "and its protocol perhaps another"
        ) from error


def _check(name: str, good: bool) -> None:
    if not good:
        raise ValueError(f"{name} makes no sense")


@dataclasses.dataclass(frozen=True)
class SampleEntry:
    """A photo in a shard."""

    key: str
    photo: str  # its name in its folder
    offset: int  # of its first byte in the shard
    size: int
    sha256: str  # of those bytes
    holes: tuple[float, ...]  # HAR of each view

    def __post_init__(self) -> None:
        """TypeError or ValueError for what no sample can have."""
        _check("photo", isinstance(self.photo, str))
        _check("key", isinstance(self.key, str) and self.key.isascii() and self.key.isalnum())
        _check("size", all(type(n) is int and 0 <= n <= MAX_BYTES for n in (self.offset, self.size)))
        _check("sha256", isinstance(self.sha256, str))
        _check("holes", all(type(hole) in (int, float) and 0 <= hole <= 1 for hole in self.holes))


@dataclasses.dataclass(frozen=True)
class ShardEntry:
    """One tar file."""

    file: str
    size: int
    sha256: str
    samples: tuple[SampleEntry, ...]
    passed_over: tuple[str, ...] = ()  # photos that gave no sample, and why

    def __post_init__(self) -> None:
        """TypeError or ValueError for what no shard can have, such as a file elsewhere."""
        _check("file", isinstance(self.file, str) and re.fullmatch(r"shard-[0-9]{6}\.tar", self.file) is not None)
        ends = list(accumulate((sample.size for sample in self.samples), initial=0))
        _check("offset", [sample.offset for sample in self.samples] == ends[:-1])
        _check("size of a shard", type(self.size) is int and self.size == ends[-1] + len(END))
        _check("sha256", isinstance(self.sha256, str))
        _check("passed_over", all(isinstance(line, str) for line in self.passed_over))


Place = tuple[ShardEntry, SampleEntry]


@dataclasses.dataclass(frozen=True)
class Manifest:
    """A dataset, finished or not."""

    config: Mapping[str, Any]  # everything that decides what is in it
    shards: tuple[ShardEntry, ...]
    complete: bool

    @property
    def samples(self) -> list[Place]:
        """All photos in their order."""
        return [(shard, sample) for shard in self.shards for sample in shard.samples]

    @property
    def views(self) -> int:
        """Views of all photos."""
        return sum(len(sample.holes) for _, sample in self.samples)

    @property
    def size(self) -> int:
        """Bytes of all shards."""
        return sum(shard.size for shard in self.shards)

    @property
    def digest(self) -> str:
        """SHA-256 over everything that is in it."""
        return digest_of(self._plain())

    def save(self, folder: Path) -> None:
        """Write manifest.json, whole or not at all."""
        text = json.dumps(self._plain() | {"sha256": self.digest}, indent=1, sort_keys=True, allow_nan=False)
        with atomic_path(folder / NAME, durable=True) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    def _plain(self) -> dict[str, Any]:
        counts = {"photos": len(self.samples), "views": self.views, "bytes": self.size}
        content = dataclasses.asdict(self) | {"format": FORMAT, "counts": counts}
        plain: dict[str, Any] = json.loads(json.dumps(content))  # no tuples
        return plain


def load_manifest(location: str | os.PathLike[str]) -> Manifest:
    """Read the manifest of a dataset; InputError where it is missing, damaged, or of another format."""
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
        _check("holes", len({len(sample.holes) for _, sample in manifest.samples}) <= 1)
        if digest_of(content) != recorded or manifest.digest != recorded:
            raise ValueError("its digest does not fit")
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"{where}: damaged, or no manifest of a dataset: {error}") from error
    return manifest


def _shard(content: Mapping[str, Any]) -> ShardEntry:
    samples = [SampleEntry(**{**sample, "holes": tuple(sample["holes"])}) for sample in content["samples"]]
    return ShardEntry(**{**content, "samples": tuple(samples), "passed_over": tuple(content["passed_over"])})


def shard_name(number: int) -> str:
    """The file of a shard."""
    return f"shard-{number:06d}.tar"


def write_shard(parts: Sequence[tuple[str, Path]], target: Path, passed_over: Sequence[str] = ()) -> ShardEntry:
    """Write a tar file of (key, file) samples to the disk, whole or not at all.

    InputError for a damaged part or a full disk.
    """
    samples: list[SampleEntry] = []
    whole, offset = hashlib.sha256(), 0
    with atomic_path(target, durable=True) as temporary, open(temporary, "wb") as file:
        for key, path in parts:
            data = path.read_bytes()
            try:
                group = PhotoGroup.of(key, data, str(path))
            except InputError as error:
                raise InputError(f"{error}: delete it, and the same command makes it again") from error
            digest = hashlib.sha256(data).hexdigest()
            samples.append(SampleEntry(key, group.facts["photo"]["name"], offset, len(data), digest, group.holes))
            file.write(data)
            whole.update(data)
            offset += len(data)
        file.write(END)
        whole.update(END)
    return ShardEntry(target.name, offset + len(END), whole.hexdigest(), tuple(samples), tuple(passed_over))


def read_sample(file: IO[bytes], sample: SampleEntry, where: str) -> PhotoGroup:
    """One photo's files out of an open shard; InputError where they differ from their digest."""
    try:
        file.seek(sample.offset)
        data = file.read(sample.size)
    except OSError as error:
        raise InputError(f"{where}: cannot be read: {error.strerror or error}") from error
    if hashlib.sha256(data).hexdigest() != sample.sha256:
        raise InputError(
            f"{where}: sample {sample.key} ({sample.photo}) is damaged: `spackle dataset verify` says more"
        )
    return PhotoGroup.of(sample.key, data, f"{where}: sample {sample.key}")


def problems(location: str | os.PathLike[str], manifest: Manifest, progress: Step) -> Iterator[str]:
    """Read every byte of a dataset: a line for each thing that is wrong. `progress` counts bytes."""
    done = 0
    if not manifest.complete:
        yield "the dataset is not finished: the command that builds it goes on"
    for shard in manifest.shards:
        try:
            with open_in(location, shard.file) as file:
                yield from (f"{shard.file}: {line}" for line in _shard_problems(file, shard))
        except InputError as error:
            yield str(error)
        except OSError as error:
            yield f"{shard.file}: cannot be read: {error.strerror or error}"
        done += shard.size
        progress(done, manifest.size)


def _shard_problems(file: IO[bytes], shard: ShardEntry) -> Iterator[str]:
    """Compare each sample with its digest, and the rest with the end of an archive."""
    size = file.seek(0, os.SEEK_END)
    if size != shard.size:
        yield f"{size:,} bytes instead of {shard.size:,}"
    file.seek(0)
    damaged = False
    for sample in shard.samples:
        if hashlib.sha256(file.read(sample.size)).hexdigest() != sample.sha256:
            damaged = True
            yield f"sample {sample.key} ({sample.photo}) is damaged"
    if not damaged and file.read(len(END)) != END:
        yield "damaged after its last sample"
