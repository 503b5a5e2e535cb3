"""From samples to shards, by the workers themselves, so that no sample passes through the command.

A worker writes a photo's sample to a file of its own, the part. Whoever writes the last part of a
shard, a tar file of some photos' samples, also writes the shard, and beside the parts the shard's
entry for the manifest.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from pathlib import Path

from spackle.paper.dataset.photos import photo_key
from spackle.paper.dataset.shards import PARTS_FOLDER, ShardEntry, write_shard
from spackle.runtime.digests import sealed, unsealed
from spackle.runtime.files import write_atomic

PROBLEM_SUFFIX = ".problem"  # of the file that says why a photo has no sample


@dataclasses.dataclass(frozen=True)
class ShardWriter:
    """The samples and shards of a dataset in progress; processes of all machines have one.

    Two of them may do the same at once, for instance if a machine was believed dead: both write
    the same bytes, and each file whole.
    """

    output: Path  # the folder of the dataset
    shard_size: int  # photos per shard
    photo_count: int  # of the dataset

    @property
    def parts(self) -> Path:
        """The folder of the samples that wait for their shard."""
        return self.output / PARTS_FOLDER

    @property
    def shard_count(self) -> int:
        """The number of shards; the last one may be smaller."""
        return math.ceil(self.photo_count / self.shard_size)

    def shard_of(self, photo_index: int) -> int:
        """The number of the shard that gets a photo."""
        return photo_index // self.shard_size

    def is_done(self, photo_index: int) -> bool:
        """Whether a photo has its sample, or the reason why it has none, in a file or a shard."""
        return self._is_waiting(photo_index) or self.entry(self.shard_of(photo_index)) is not None

    def write_sample(self, photo_index: int, sample: bytes) -> None:
        """Write the sample of a photo; the shard follows by `write_shard_if_ready`."""
        write_atomic(self._part_file(photo_index), sealed(sample))

    def write_problem(self, photo_index: int, problem: str) -> None:
        """Write the reason why a photo has no sample, for the manifest."""
        write_atomic(self._problem_file(photo_index), problem.encode())

    def remove_problems(self) -> None:
        """Forget the reasons that an earlier run has left, so that its photos are tried again."""
        for file in self.parts.glob(f"*{PROBLEM_SUFFIX}"):
            file.unlink(missing_ok=True)

    def write_shard_if_ready(self, number: int) -> ShardEntry | None:
        """Write a shard if all its photos are done; returns its entry, or None if they are not.

        First comes the shard, then its entry; then the parts are deleted. A process that is killed
        between these steps leaves what the next one needs to repeat them.
        """
        first = number * self.shard_size
        indices = range(first, min(first + self.shard_size, self.photo_count))
        if not all(self._is_waiting(index) for index in indices):
            return self.entry(number)

        try:
            problems = [self._problem_file(index) for index in indices]
            reasons = [file.read_text("utf-8") for file in problems if file.is_file()]
            # A photo with a problem has no sample.
            samples = [
                (photo_key(index), self._part_file(index))
                for index, problem in zip(indices, problems, strict=True)
                if not problem.is_file()
            ]
            entry = write_shard(samples, self.output / f"shard-{number:06d}.tar", reasons)
        except OSError:
            # Another process was faster, and has deleted the parts already.
            other_entry = self.entry(number)
            if other_entry is None:
                raise
            return other_entry

        write_atomic(self._entry_file(number), sealed(entry.model_dump_json().encode()))
        for index in indices:
            self._part_file(index).unlink(missing_ok=True)
            self._problem_file(index).unlink(missing_ok=True)
        return entry

    def entry(self, number: int) -> ShardEntry | None:
        """The entry of a shard that is written; None if it or its shard is missing or damaged."""
        with contextlib.suppress(OSError, ValueError):
            text = unsealed(self._entry_file(number).read_bytes())
            entry = ShardEntry.model_validate_json(text)
            if (self.output / entry.file).stat().st_size == entry.size:
                return entry
        return None

    def _is_waiting(self, photo_index: int) -> bool:
        """Whether a photo is done, and its shard is not."""
        files = (self._part_file(photo_index), self._problem_file(photo_index))
        return any(file.is_file() for file in files)

    def _part_file(self, photo_index: int) -> Path:
        """The file that holds a photo's sample until its shard is written."""
        return self.parts / f"{photo_key(photo_index)}.tar"

    def _problem_file(self, photo_index: int) -> Path:
        """The file that says why a photo has no sample."""
        return self.parts / f"{photo_key(photo_index)}{PROBLEM_SUFFIX}"

    def _entry_file(self, number: int) -> Path:
        """The file that holds a shard's entry until the manifest lists it."""
        return self.parts / f"shard-{number:06d}.json"
