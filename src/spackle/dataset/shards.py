"""A dataset's shards and manifest in a folder or at an address (optional: pip install fsspec), written and read.

`ViewDataset` streams the views from the tar files in a random order, each view once between all readers.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import numpy as np
import torch.distributed
from pydantic import BaseModel, Field, model_validator
from torch.utils.data import IterableDataset, get_worker_info

from spackle.dataset.sample import END, DatasetView, PhotoGroup
from spackle.errors import InputError, one_line, reading
from spackle.files import atomic_path
from spackle.folders import digest_of

NAME = "manifest.json"
FORMAT = 1  # of shards and manifest; a reader of another one refuses
Bytes = Annotated[int, Field(ge=0, le=1 << 40)]
Share = Annotated[float, Field(ge=0, le=1)]


class SampleEntry(BaseModel, frozen=True, extra="forbid", strict=True):
    """A photo in a shard."""

    key: str = Field(pattern="^[0-9A-Za-z]+$")
    photo: str  # its name in its folder
    offset: Bytes  # of its first byte in the shard
    size: Bytes
    sha256: str  # of those bytes
    holes: tuple[Share, ...]  # HAR of each view


class ShardEntry(BaseModel, frozen=True, extra="forbid", strict=True):
    """One tar file."""

    file: str = Field(pattern=r"^shard-[0-9]{6}\.tar$")
    size: Bytes
    sha256: str
    samples: tuple[SampleEntry, ...]
    passed_over: tuple[str, ...] = ()  # photos that gave no sample, and why


Place = tuple[ShardEntry, SampleEntry]


class Manifest(BaseModel, frozen=True, extra="ignore", strict=True):
    """A dataset, finished or not."""

    config: dict[str, Any]  # everything that decides what is in it
    shards: tuple[ShardEntry, ...]
    complete: bool

    @model_validator(mode="after")
    def _even(self) -> Manifest:
        if len({len(sample.holes) for _, sample in self.samples}) > 1:
            raise ValueError("photos with different numbers of views")
        return self

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
        return digest_of(self._content())

    def save(self, folder: Path) -> None:
        """Write manifest.json, whole or not at all."""
        text = json.dumps(self._content() | {"sha256": self.digest}, indent=1, sort_keys=True, allow_nan=False)
        with atomic_path(folder / NAME, durable=True) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    def _content(self) -> dict[str, Any]:
        counts = {"photos": len(self.samples), "views": self.views, "bytes": self.size}
        return self.model_dump(mode="json") | {"format": FORMAT, "counts": counts}


def open_in(location: str | os.PathLike[str], name: str) -> IO[bytes]:
    """Open a seekable file in a folder or at an fsspec address (s3://bucket/dataset); InputError if it cannot."""
    place = f"{str(location).rstrip('/')}/{name}"
    package = "an address needs a package (pip install fsspec), and its protocol perhaps another"
    with (
        reading(place, f"cannot be opened ({{reason}}): {package}", ImportError, ValueError),
        reading(place, "cannot be read: {reason}", OSError),
        reading(place, f"not there: is {location} a dataset of `spackle dataset build`?", FileNotFoundError),
    ):
        if "://" not in place:
            return open(os.path.join(location, name), "rb")
        import fsspec

        file: IO[bytes] = fsspec.open(place, "rb").open()
        return file


def load_manifest(location: str | os.PathLike[str]) -> Manifest:
    """Read the manifest of a dataset; InputError where it is missing, damaged, or of another format."""
    where = f"{str(location).rstrip('/')}/{NAME}"
    with open_in(location, NAME) as file, reading(where, "damaged, or no manifest of a dataset: {reason}"):
        text = file.read()
        content = json.loads(text)
        if content["format"] != FORMAT:
            raise InputError(f"{where}: format {content['format']!r} is not known here, which reads {FORMAT}")
        recorded = content.pop("sha256")
        manifest = Manifest.model_validate_json(text)
        if not digest_of(content) == manifest.digest == recorded:
            raise ValueError("its digest does not fit")
        return manifest


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
            entry = {"key": key, "photo": group.facts["photo"]["name"], "offset": offset, "size": len(data)}
            samples.append(SampleEntry(**entry, sha256=hashlib.sha256(data).hexdigest(), holes=group.holes))
            file.write(data)
            whole.update(data)
            offset += len(data)
        file.write(END)
        whole.update(END)
    size, sha256 = offset + len(END), whole.hexdigest()
    return ShardEntry(
        file=target.name, size=size, sha256=sha256, samples=tuple(samples), passed_over=tuple(passed_over)
    )


class DatasetFiles:
    """The photos of a dataset in any order, for readers that choose themselves."""

    def __init__(self, location: str | os.PathLike[str]) -> None:
        """Read the manifest in a folder or at an fsspec address; InputError without a finished dataset."""
        self.location = location
        self.manifest = load_manifest(location)
        if not self.manifest.complete:
            raise InputError(f"{location}: not finished: the command that builds it goes on")
        self.samples = self.manifest.samples

    def __len__(self) -> int:
        """The number of photos."""
        return len(self.samples)

    def group(self, index: int) -> PhotoGroup:
        """The files of a photo, checked by their digest; InputError where they are damaged."""
        (group,) = self.groups([self.samples[index]])
        return group

    def groups(self, places: Sequence[Place], skip: Callable[[InputError], None] | None = None) -> Iterator[PhotoGroup]:
        """Likewise of several photos, with one shard open at a time; `skip` gets what is damaged, if given."""
        for shard, pairs in itertools.groupby(places, key=lambda place: place[0]):
            with contextlib.ExitStack() as stack:
                file: IO[bytes] | None = None
                for _, sample in pairs:
                    try:
                        file = file or stack.enter_context(open_in(self.location, shard.file))
                        group = _read_sample(file, sample, f"{self.location}/{shard.file}")
                    except InputError as error:
                        if skip is None:
                            raise
                        skip(error)
                    else:
                        yield group


def _read_sample(file: IO[bytes], sample: SampleEntry, where: str) -> PhotoGroup:
    """One photo's files out of an open shard; InputError where they differ from their digest."""
    with reading(where, "cannot be read: {reason}", OSError):
        file.seek(sample.offset)
        data = file.read(sample.size)
    if hashlib.sha256(data).hexdigest() != sample.sha256:
        raise InputError(
            f"{where}: sample {sample.key} ({sample.photo}) is damaged: `spackle dataset verify` says more"
        )
    return PhotoGroup.of(sample.key, data, f"{where}: sample {sample.key}")


class ViewDataset(IterableDataset[DatasetView]):
    """The views of a dataset, decoded one after the other; nothing is unpacked on the disk.

    Photos are divided between ranks and, in a DataLoader, between its workers: each view comes once in all, and no two
    readers differ by more than a photo. Samples differ in size, so a DataLoader takes `batch_size=None`.
    """

    def __init__(
        self,
        location: str | os.PathLike[str],
        *,
        shuffle: int = 0,
        seed: int = 0,
        with_base: bool = False,
        rank: int | None = None,
        ranks: int | None = None,
        on_error: Literal["raise", "skip"] = "raise",
    ) -> None:
        """Read the manifest.

        Args:
            location: see `DatasetFiles`.
            shuffle: views held back to choose from at random, as they are stored (1 to 2 MB each at 640×480, and the
                Gaussians once for each photo); the order of the shards is random too. 0: as they lie.
            seed: of that order, together with the epoch.
            with_base: decode the photo's Gaussians with each view.
            rank: of this process, from 0; torch.distributed's where None.
            ranks: how many there are; likewise.
            on_error: "skip" leaves out what is damaged, logs a warning for it and counts it in `skipped`.

        Raises InputError without a finished dataset, and ValueError for a rank outside 0..ranks - 1.
        """
        super().__init__()
        self.files = DatasetFiles(location)
        self.shuffle, self.seed, self.with_base, self.epoch = shuffle, seed, with_base, 0
        self.on_error, self.skipped = on_error, 0  # photos and views, in this process
        distributed = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else torch.distributed.get_rank() if distributed else 0
        self.ranks = ranks if ranks is not None else torch.distributed.get_world_size() if distributed else 1
        if not 0 <= self.rank < self.ranks:
            raise ValueError(f"rank {self.rank} of {self.ranks}: ranks are counted from 0")

    def set_epoch(self, epoch: int) -> None:
        """Another order, the same for all ranks; to be called before a DataLoader's workers start."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[DatasetView]:
        """Views of this rank and worker; InputError for a shard that is missing or damaged, unless `on_error` skips."""
        worker = get_worker_info()
        part, parts = (0, 1) if worker is None else (worker.id, worker.num_workers)
        shards = list(self.files.manifest.shards)  # the same order for everybody
        if self.shuffle:
            np.random.default_rng([self.seed, self.epoch]).shuffle(shards)
        order = [(shard, sample) for shard in shards for sample in shard.samples]
        reader = self.rank * parts + part
        skip = self._skip if self.on_error == "skip" else None
        views = (
            (group.only(index, with_base=self.with_base), index)
            for group in self.files.groups(order[reader :: self.ranks * parts], skip)
            for index in range(group.views)
        )
        for group, index in self._shuffled(views, reader) if self.shuffle else views:
            try:
                view = group.view(index, with_base=self.with_base)
            except InputError as error:
                if skip is None:
                    raise
                skip(error)
            else:
                yield view

    def _skip(self, error: InputError) -> None:
        self.skipped += 1
        logging.getLogger(__name__).warning("left out: %s", one_line(str(error)))

    def _shuffled(self, views: Iterator[tuple[PhotoGroup, int]], reader: int) -> Iterator[tuple[PhotoGroup, int]]:
        """A random one of the views held back makes room for the next."""
        rng = np.random.default_rng([self.seed, self.epoch, reader])
        held = list(itertools.islice(views, self.shuffle))
        for view in views:
            place = int(rng.integers(len(held)))
            yield held[place]
            held[place] = view
        yield from (held[place] for place in rng.permutation(len(held)))
