"""Reads a dataset as a stream: from the tar files, in a random order, each view once between all readers."""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from typing import IO, Literal

import numpy as np
import torch.distributed
from torch.utils.data import IterableDataset, get_worker_info

from spackle.dataset.sample import DatasetView, PhotoGroup
from spackle.dataset.shards import Place, load_manifest, open_in, read_sample
from spackle.errors import InputError, one_line


class DatasetFiles:
    """Any view of a dataset by its place, for readers that choose themselves."""

    def __init__(self, location: str | os.PathLike[str]) -> None:
        """Read the manifest in a folder or at an fsspec address; InputError without a finished dataset."""
        self.location = location
        self.manifest = load_manifest(location)
        if not self.manifest.complete:
            raise InputError(f"{location}: not finished: the command that builds it goes on")
        self.samples = self.manifest.samples

    def __len__(self) -> int:
        """Photos."""
        return len(self.samples)

    def group(self, index: int) -> PhotoGroup:
        """The files of a photo, held to their digest; InputError where they are damaged."""
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
                        group = read_sample(file, sample, f"{self.location}/{shard.file}")
                    except InputError as error:
                        if skip is None:
                            raise
                        skip(error)
                    else:
                        yield group


class ViewDataset(IterableDataset[DatasetView]):
    """The views of a dataset, decoded one after the other; nothing is unpacked on the disk.

    Photos are divided between ranks and, in a DataLoader, between its workers: each view comes once in all, and no
    two readers differ by more than a photo. Samples are values of different sizes, so a
    DataLoader takes `batch_size=None`.
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
            shuffle: views held back to choose from at random, as they are stored (1 to 2 MB each at 640×480,
                and the Gaussians once for each photo); the order of the shards is random too. 0: as they lie.
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
        here = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else torch.distributed.get_rank() if here else 0
        self.ranks = ranks if ranks is not None else torch.distributed.get_world_size() if here else 1
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
