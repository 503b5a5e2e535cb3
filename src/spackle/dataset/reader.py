"""Reads a dataset as a stream: from the tar files, in a random order, each view once between all readers."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

import numpy as np
import torch.distributed
from torch.utils.data import IterableDataset, get_worker_info

from spackle.dataset.sample import DatasetView, PhotoGroup
from spackle.dataset.shards import Place, load_manifest, open_in, read_sample
from spackle.errors import InputError


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

    def groups(self, places: Sequence[Place]) -> Iterator[PhotoGroup]:
        """Likewise of several photos, with one shard open at a time."""
        start = 0
        while start < len(places):
            shard = places[start][0]
            with open_in(self.location, shard.file) as file:
                while start < len(places) and places[start][0] is shard:
                    yield read_sample(file, places[start][1], f"{self.location}/{shard.file}")
                    start += 1


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

        Raises InputError without a finished dataset, and ValueError for a rank outside 0..ranks - 1.
        """
        super().__init__()
        self.files = DatasetFiles(location)
        self.shuffle, self.seed, self.with_base, self.epoch = shuffle, seed, with_base, 0
        here = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else torch.distributed.get_rank() if here else 0
        self.ranks = ranks if ranks is not None else torch.distributed.get_world_size() if here else 1
        if not 0 <= self.rank < self.ranks:
            raise ValueError(f"rank {self.rank} of {self.ranks}: ranks are counted from 0")

    def set_epoch(self, epoch: int) -> None:
        """Another order, the same for all ranks; to be called before a DataLoader's workers start."""
        self.epoch = epoch

    def __iter__(self) -> Iterator[DatasetView]:
        """Views of this rank and worker; InputError for a shard that is missing or damaged."""
        worker = get_worker_info()
        part, parts = (0, 1) if worker is None else (worker.id, worker.num_workers)
        shards = list(self.files.manifest.shards)  # the same order for everybody
        if self.shuffle:
            np.random.default_rng([self.seed, self.epoch]).shuffle(shards)
        order = [(shard, sample) for shard in shards for sample in shard.samples]
        mine = order[self.rank * parts + part :: self.ranks * parts]
        views = (
            (group.only(index, with_base=self.with_base), index)
            for group in self.files.groups(mine)
            for index in range(group.views)
        )
        for group, index in self._shuffled(views, self.rank * parts + part) if self.shuffle else views:
            yield group.view(index, with_base=self.with_base)

    def _shuffled(self, views: Iterator[tuple[PhotoGroup, int]], reader: int) -> Iterator[tuple[PhotoGroup, int]]:
        """A random one of those held back makes room for the next."""
        rng = np.random.default_rng([self.seed, self.epoch, reader])
        held: list[tuple[PhotoGroup, int]] = []
        for view in views:
            if len(held) < self.shuffle:
                held.append(view)
                continue
            place = int(rng.integers(len(held)))
            yield held[place]
            held[place] = view
        for place in rng.permutation(len(held)):
            yield held[place]
