"""Published weights: the facts in `published.json` about each file, and the file's place on this machine."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from spackle.errors import InputError, check_name
from spackle.files import check_file, sha256_of

HUB = "https://huggingface.co"  # HF_ENDPOINT names a mirror


@dataclasses.dataclass(frozen=True)
class PublishedWeights:
    """One published file of weights."""

    name: str
    purpose: str
    url: str
    file: str  # name in the folder of weights
    bytes: int
    sha256: str  # 64 hexadecimal digits
    licence: str  # in a few words
    notice: Sequence[str]  # lines that are printed before the download
    option: str  # the option that takes a copy in another folder

    @property
    def address(self) -> str:
        """The file's address, on a mirror of Hugging Face if HF_ENDPOINT names a mirror."""
        mirror = os.environ.get("HF_ENDPOINT", "").rstrip("/")
        return mirror + self.url.removeprefix(HUB) if mirror and self.url.startswith(f"{HUB}/") else self.url


_FACTS = json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))
PUBLISHED = {name: PublishedWeights(name, **facts) for name, facts in _FACTS.items()}


def published_weights(name: str) -> PublishedWeights:
    """The entry of this name; InputError for an unknown name."""
    check_name("weights", name, PUBLISHED)
    return PUBLISHED[name]


def weights_folder() -> Path:
    """The folder for downloaded weights: $SPACKLE_WEIGHTS, else spackle/weights in $XDG_CACHE_HOME or ~/.cache."""
    if chosen := os.environ.get("SPACKLE_WEIGHTS"):
        return Path(os.path.expanduser(chosen))
    cache = os.environ.get("XDG_CACHE_HOME", "")
    return Path(cache if os.path.isabs(cache) else os.path.expanduser("~/.cache")) / "spackle" / "weights"


def installed(name: str) -> Path | None:
    """The file of published weights in `weights_folder`; None if it is missing."""
    path = weights_folder() / published_weights(name).file
    return path if os.path.isfile(path) else None


def published_as(path: Path) -> PublishedWeights | None:
    """The entry of published weights that matches a file's name and size; None for other files."""
    for entry in PUBLISHED.values():
        if f"/{path.as_posix()}".endswith(f"/{entry.file}") and path.is_file() and path.stat().st_size == entry.bytes:
            return entry
    return None


def check_undamaged(path: Path) -> None:
    """InputError if a file has the name and size of published weights but not their digest."""
    entry = published_as(path)
    if entry is not None and file_digest(path) != entry.sha256:
        again = f"delete the file and run `spackle weights get {entry.name}`"
        raise InputError(f"{path}: damaged: its SHA-256 is not the published one: {again}")


def weights_digest(path: Path) -> str:
    """SHA-256 of a weight file: the published one if name and size match, which `check_undamaged` verifies."""
    entry = published_as(path)
    return file_digest(path) if entry is None else entry.sha256


def weights_digests(files: Mapping[str, Path]) -> str | dict[str, str] | None:
    """`weights_digest` of a network's files: a digest of one file, a dict by name of several, None without files."""
    digests = {name: weights_digest(file) for name, file in files.items()}
    return digests if len(digests) > 1 else next(iter(digests.values()), None)


def file_digest(path: Path) -> str:
    """SHA-256 of a file of weights, as 64 hexadecimal digits; InputError if it cannot be read."""
    check_file(path, "file of weights")
    with open(path, "rb") as file:
        return sha256_of(file)
