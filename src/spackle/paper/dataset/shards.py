"""Write and read a dataset: shards, which are tar files of some photos each, and a manifest.

A dataset lies in a folder or at a URL (optional: pip install fsspec). Read `DatasetFiles` first.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Annotated, Any

from pydantic import BaseModel, Field, model_validator
from torch.utils.data import Dataset

from spackle.paper.dataset.sample import END_OF_ARCHIVE, PhotoGroup
from spackle.runtime.digests import json_digest, signed, unsealed
from spackle.runtime.errors import InputError, as_input_error, reason_in_a_line
from spackle.runtime.files import atomic_path

MANIFEST_NAME = "manifest.json"
PARTS_FOLDER = "parts"  # folder in a dataset for samples that are not in a shard yet
FORMAT_VERSION = 1  # version of shards and manifest; other versions are refused
DELETE_PART = "delete this file, and the same command makes it again"
ByteCount = Annotated[int, Field(ge=0, le=1 << 40)]  # at most a terabyte
Fraction = Annotated[float, Field(ge=0, le=1)]


class SampleEntry(BaseModel, frozen=True, extra="forbid", strict=True):
    """A photo in a shard."""

    key: str = Field(pattern="^[0-9A-Za-z]+$")
    photo: str  # the photo's name, relative to the folder of photos
    offset: ByteCount  # position of the sample's first byte in the shard
    size: ByteCount
    sha256: str  # of the sample's bytes
    holes: tuple[Fraction, ...]  # share of uncovered pixels of each view (HAR)


class ShardEntry(BaseModel, frozen=True, extra="forbid", strict=True):
    """A shard: one tar file."""

    file: str = Field(pattern=r"^shard-[0-9]{6}\.tar$")
    size: ByteCount
    sha256: str
    samples: tuple[SampleEntry, ...]
    passed_over: tuple[str, ...] = ()  # messages about photos without a sample


class Manifest(BaseModel, frozen=True, extra="ignore", strict=True):
    """A dataset, finished or not."""

    config: dict[str, Any]  # everything that determines the contents
    shards: tuple[ShardEntry, ...]
    complete: bool

    @model_validator(mode="after")
    def _check_equal_view_counts(self) -> Manifest:
        """ValueError if photos have different numbers of views."""
        if len({len(sample.holes) for _, sample in self.samples}) > 1:
            raise ValueError("photos with different numbers of views")
        return self

    @property
    def samples(self) -> list[tuple[ShardEntry, SampleEntry]]:
        """All samples in order, each with its shard."""
        return [(shard, sample) for shard in self.shards for sample in shard.samples]

    @property
    def views(self) -> int:
        """The number of views of all photos together."""
        return sum(len(sample.holes) for _, sample in self.samples)

    @property
    def views_per_photo(self) -> int:
        """The number of views of each photo; 0 without photos."""
        return next((len(sample.holes) for _, sample in self.samples), 0)

    @property
    def size(self) -> int:
        """The size of all shards in bytes."""
        return sum(shard.size for shard in self.shards)

    @property
    def digest(self) -> str:
        """SHA-256 of the manifest, which identifies the dataset."""
        return json_digest(self._content())

    def save(self, folder: Path) -> None:
        """Write manifest.json into a folder, whole or not at all.

        The digest of its content is part of the file.
        """
        text = json.dumps(signed(self._content()), indent=1, sort_keys=True, allow_nan=False)
        with atomic_path(folder / MANIFEST_NAME) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")

    def _content(self) -> dict[str, Any]:
        """The manifest as JSON, without its digest; the counts are for people who read the file."""
        counts = {"photos": len(self.samples), "views": self.views, "bytes": self.size}
        return self.model_dump(mode="json") | {"format": FORMAT_VERSION, "counts": counts}


def open_dataset_file(location: str | os.PathLike[str], name: str) -> IO[bytes]:
    """Open a file of a dataset, with random access.

    Args:
        location: the dataset: a folder, or an address for fsspec, such as s3://bucket/dataset.
        name: the file in it.

    Raises:
        InputError: there is no such file, it cannot be read, or a package for the address is
            missing.
    """
    address = f"{str(location).rstrip('/')}/{name}"
    try:
        # Most datasets lie in a folder, and need no further package.
        if "://" not in address:
            return open(os.path.join(location, name), "rb")
        import fsspec

        file: IO[bytes] = fsspec.open(address, "rb").open()
        return file
    except FileNotFoundError as error:
        raise InputError(
            f"{address}: no such file: is {location} a dataset of `spackle dataset build`?"
        ) from error
    except OSError as error:
        raise InputError(f"{address}: cannot be read: {reason_in_a_line(error)}") from error
    except (ImportError, ValueError) as error:
        raise InputError(
            f"{address}: cannot be opened ({reason_in_a_line(error)}): an address needs fsspec "
            "(pip install fsspec), and perhaps a package for its protocol"
        ) from error


def load_manifest(location: str | os.PathLike[str]) -> Manifest:
    """Read the manifest of a dataset; InputError for a missing or damaged file, or another format.

    `location` is a folder, or an address for fsspec.
    """
    address = f"{str(location).rstrip('/')}/{MANIFEST_NAME}"
    with (
        open_dataset_file(location, MANIFEST_NAME) as file,
        as_input_error(address, "damaged, or no manifest of a dataset: {reason}"),
    ):
        text = file.read()
        content = json.loads(text)
        if content["format"] != FORMAT_VERSION:
            raise InputError(
                f"{address}: format {content['format']!r} is unknown: this Spackle reads format "
                f"{FORMAT_VERSION}"
            )

        # The recorded digest must be that of the file's content. It must also be that of the parsed
        # manifest: otherwise parsing has dropped or changed something.
        recorded_digest = content.pop("sha256")
        manifest = Manifest.model_validate_json(text)
        if not json_digest(content) == manifest.digest == recorded_digest:
            raise ValueError("the digest is wrong")
        return manifest


def write_shard(
    parts: Sequence[tuple[str, Path]], target: Path, passed_over: Sequence[str] = ()
) -> ShardEntry:
    """Write samples to a tar file, whole or not at all; returns its entry in the manifest.

    Args:
        parts: key and file of each sample; the files hold the bytes of `pack_sample`, sealed.
        target: the tar file.
        passed_over: messages about photos without a sample, for the manifest.

    Raises:
        InputError: a part is damaged, or the disk is full.
    """
    samples: list[SampleEntry] = []
    shard_sha256 = hashlib.sha256()
    size = 0
    with atomic_path(target) as temporary, open(temporary, "wb") as file:
        for key, path in parts:
            # Each part is checked now, because a damaged one would make the whole shard useless.
            data = read_part(path)
            try:
                group = PhotoGroup.from_tar(key, data, str(path))
            except InputError as error:
                raise InputError(f"{error}: {DELETE_PART}") from error
            sample = SampleEntry(
                key=key,
                photo=group.facts["photo"]["name"],
                offset=size,
                size=len(data),
                sha256=hashlib.sha256(data).hexdigest(),
                holes=group.holes,
            )
            samples.append(sample)
            file.write(data)
            shard_sha256.update(data)
            size += len(data)
        file.write(END_OF_ARCHIVE)
        shard_sha256.update(END_OF_ARCHIVE)
        size += len(END_OF_ARCHIVE)
    return ShardEntry(
        file=target.name,
        size=size,
        sha256=shard_sha256.hexdigest(),
        samples=tuple(samples),
        passed_over=tuple(passed_over),
    )


def read_part(path: Path) -> bytes:
    """The sample in the file of a part, as `pack_sample` has made it.

    InputError if its digest shows damage; parts of older versions have no digest.
    """
    with as_input_error(path, f"damaged: {{reason}}: {DELETE_PART}", ValueError):
        return unsealed(path.read_bytes())


class DatasetFiles(Dataset[PhotoGroup]):
    """The encoded photos of a dataset as a torch `Dataset` with random access.

    A DataLoader with `batch_size=None` can shuffle and prefetch photos; a DistributedSampler can
    divide photos between ranks.
    """

    def __init__(self, location: str | os.PathLike[str]) -> None:
        """Open a dataset in a folder or at a URL for fsspec.

        InputError if there is none, or it is not finished.
        """
        self.location = location
        self.manifest = load_manifest(location)
        if not self.manifest.complete:
            raise InputError(
                f"{location}: not finished: run the same `spackle dataset build` again"
            )
        self.samples = self.manifest.samples

    def __len__(self) -> int:
        """The number of photos."""
        return len(self.samples)

    def __getitem__(self, index: int) -> PhotoGroup:
        """The files of a photo, checked by their digest; InputError for damaged files."""
        shard, sample = self.samples[index]
        address = f"{self.location}/{shard.file}"
        with (
            open_dataset_file(self.location, shard.file) as file,
            as_input_error(address, "cannot be read: {reason}", OSError),
        ):
            # Only the photo's part of the shard is read: shards may lie in another country.
            file.seek(sample.offset)
            data = file.read(sample.size)
        # A training run of days should not learn from damaged pictures.
        if hashlib.sha256(data).hexdigest() != sample.sha256:
            raise InputError(
                f"{address}: sample {sample.key} ({sample.photo}) is damaged: see `spackle "
                "dataset verify`"
            )
        return PhotoGroup.from_tar(sample.key, data, f"{address}: sample {sample.key}")
