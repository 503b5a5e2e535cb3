"""Samples to tar files and their entries, and whether the tar files are still what they were."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

from spackle.errors import InputError
from spackle.formats import atomic_path
from spackle.pseudo.archive import END
from spackle.pseudo.manifest import Manifest, SampleEntry, ShardEntry
from spackle.pseudo.places import open_in
from spackle.pseudo.sample import PhotoGroup, holes_of

PIECE = 1 << 20  # bytes read at once


def shard_name(number: int) -> str:
    """The file of a shard."""
    return f"shard-{number:06d}.tar"


def write_shard(parts: Sequence[tuple[str, Path]], target: Path, passed_over: Sequence[str] = ()) -> ShardEntry:
    """Put samples one after the other into a tar file, whole or not at all.

    Args:
        parts: key and file of each sample, as `make_sample` made it.
        target: the shard.
        passed_over: photos that are not in it, for its entry.

    Raises:
        InputError: a part that is damaged, or a disk that is full.
    """
    samples: list[SampleEntry] = []
    whole, offset = hashlib.sha256(), 0
    with atomic_path(target) as temporary, open(temporary, "wb") as file:
        for key, path in parts:
            data = path.read_bytes()
            try:
                facts = PhotoGroup.of(key, data, str(path)).facts
            except InputError as error:
                raise InputError(f"{error}: delete it, and the same command makes it again") from error
            digest = hashlib.sha256(data).hexdigest()
            samples.append(SampleEntry(key, facts["photo"]["name"], offset, len(data), digest, tuple(holes_of(facts))))
            file.write(data)
            whole.update(data)
            offset += len(data)
        file.write(END)
        whole.update(END)
    size = offset + len(END)
    return ShardEntry(target.name, size, whole.hexdigest(), tuple(samples), tuple(passed_over))


def read_sample(file: IO[bytes], sample: SampleEntry, where: str) -> PhotoGroup:
    """One photo's files out of an open shard, held to their digest.

    Raises:
        InputError: they are damaged or cut off.
    """
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


def problems(
    location: str | os.PathLike[str], manifest: Manifest, progress: Callable[[int, int], None]
) -> Iterator[str]:
    """Read every byte of a dataset and say in a line each what is wrong.

    Args:
        location: folder or address.
        manifest: of the dataset.
        progress: called with (bytes read, of how many).
    """
    total, done = sum(shard.size for shard in manifest.shards), 0
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
        progress(done, total)


def _shard_problems(file: IO[bytes], shard: ShardEntry) -> Iterator[str]:
    """Each sample is held to its own digest, and the end of the file to what it must be."""
    size = file.seek(0, os.SEEK_END)
    if size != shard.size:
        yield f"{size:,} bytes instead of {shard.size:,}"
    file.seek(0)
    whole, named = hashlib.sha256(), False
    for sample in shard.samples:
        digest = hashlib.sha256()
        for piece in _pieces(file, sample.size):
            digest.update(piece)
            whole.update(piece)
        if digest.hexdigest() != sample.sha256:
            named = True
            yield f"sample {sample.key} ({sample.photo}) is damaged"
    for piece in _pieces(file, len(END)):
        whole.update(piece)
    if whole.hexdigest() != shard.sha256 and not named:
        yield "damaged after its last sample"


def _pieces(file: IO[bytes], size: int) -> Iterator[bytes]:
    while size and (piece := file.read(min(PIECE, size))):
        yield piece
        size -= len(piece)
