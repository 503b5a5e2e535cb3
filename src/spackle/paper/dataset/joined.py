"""Several datasets as one, such as parts of a dataset that were built on several machines.

Read `JoinedDataset` first.
"""

from __future__ import annotations

import bisect
import functools
import glob
import itertools
import os
from collections.abc import Sequence
from typing import Any

from torch.utils.data import Dataset

from spackle.paper.dataset.sample import PhotoGroup
from spackle.paper.dataset.shards import DatasetFiles, SampleEntry
from spackle.runtime.digests import config_differences, json_digest
from spackle.runtime.errors import InputError

# What parts of one dataset may have in their own way: their photos and camera paths, how the
# numbers of their depth maps were read, and everything that changes no picture noticeably.
MAY_DIFFER = (
    "photos",
    "shard_size",
    "threads",
    "keep",
    "base.device",
    "base.depth_kind",
    "base.depth_unit",
    "views.seed",
    "views.trajectory",
    "views.disparity",
)


class JoinedDataset(Dataset[PhotoGroup]):
    """The photos of one or several datasets, numbered from 0 through all of them.

    The order of the parts depends on their contents alone, not on their names or places, so that
    a moved part changes nothing.
    """

    def __init__(self, locations: Sequence[str | os.PathLike[str]]) -> None:
        """Open datasets.

        Args:
            locations: folders, addresses for fsspec, or patterns of folders such as "data/part-*".

        Raises:
            InputError: there is no such dataset, or it is not finished; or two of them do not
                belong together, because they were built in another way or hold the same photo.
        """
        parts = [DatasetFiles(location) for location in find_locations(locations)]
        _check_alike(parts)
        self.parts = sorted(parts, key=lambda part: part.manifest.digest)
        _check_different(self.parts)
        # The index of each part's first photo, and the number of all photos.
        self.starts = [0, *itertools.accumulate(len(part) for part in self.parts)]

    def __len__(self) -> int:
        """The number of photos."""
        return self.starts[-1]

    def __getitem__(self, index: int) -> PhotoGroup:
        """The files of a photo, checked by their digest; InputError for damaged files."""
        part_number = bisect.bisect_right(self.starts, index) - 1
        return self.parts[part_number][index - self.starts[part_number]]

    @functools.cached_property
    def samples(self) -> list[SampleEntry]:
        """What the manifests say of the photos, in the order of their indices."""
        return [sample for part in self.parts for _, sample in part.samples]

    @property
    def where(self) -> str:
        """The places of all parts, for messages."""
        return ", ".join(str(part.location) for part in self.parts)

    @property
    def digest(self) -> str:
        """Identifies the photos and views; for a single dataset, the digest of its manifest."""
        digests = [part.manifest.digest for part in self.parts]
        return digests[0] if len(digests) == 1 else json_digest(digests)

    @property
    def facts(self) -> list[dict[str, Any]]:
        """Place, digest, number of photos and configuration of each part, for a report."""
        return [
            {
                "location": str(part.location),
                "sha256": part.manifest.digest,
                "photos": len(part),
                "config": part.manifest.config,
            }
            for part in self.parts
        ]


def find_locations(locations: Sequence[str | os.PathLike[str]]) -> list[str]:
    """The places of datasets, patterns such as "data/part-*" replaced by what they match.

    InputError if a pattern matches nothing.
    """
    found: list[str] = []
    for place in locations:
        location = os.fspath(place)
        # A folder may have a star in its name, and addresses are no names of folders.
        is_pattern = glob.has_magic(location) and "://" not in location
        if not is_pattern or os.path.exists(location):
            found.append(location)
            continue
        matches = sorted(glob.glob(location))
        if not matches:
            raise InputError(f"{location}: no dataset has such a name: check the pattern")
        found += matches
    return found


def _check_alike(parts: Sequence[DatasetFiles]) -> None:
    """InputError, which names the part, if parts were not built in the same way."""
    if not parts:
        raise InputError("no dataset is named: give a folder of `spackle dataset build`")
    first, *others = parts
    for other in others:
        differences = config_differences(_shared_config(first), _shared_config(other))
        if first.manifest.views_per_photo != other.manifest.views_per_photo:
            differences.append("the number of views")
        if differences:
            raise InputError(
                f"{other.location}: was not built as {first.location} ({'; '.join(differences)}): "
                "build it again with the same options, or leave it out"
            )


def _shared_config(part: DatasetFiles) -> dict[str, Any]:
    """The configuration of a dataset that all parts must share: without `MAY_DIFFER`."""
    shared: dict[str, Any] = {}
    for key, value in part.manifest.config.items():
        if key in MAY_DIFFER:
            continue
        if isinstance(value, dict):
            value = {
                name: inner for name, inner in value.items() if f"{key}.{name}" not in MAY_DIFFER
            }
        shared[key] = value
    return shared


def _check_different(parts: Sequence[DatasetFiles]) -> None:
    """InputError if two parts hold the same photo, because one could be learned, one judged by.

    A photo is known by its name and the holes of its views: two photos of one name, perhaps of two
    folders, do not have holes of the same sizes.
    """
    owners: dict[tuple[str, tuple[float, ...]], DatasetFiles] = {}
    for part in parts:
        for _, sample in part.samples:
            # Views without any hole do not tell two photos apart.
            if not any(sample.holes):
                continue
            owner = owners.setdefault((sample.photo, sample.holes), part)
            if owner is not part:
                raise InputError(
                    f"{part.location}: holds the photo {sample.photo} of {owner.location}, too: "
                    "leave one of them out"
                )
