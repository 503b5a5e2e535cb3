"""Published weights: the facts in `published.json` about each file, and the file's place on this machine."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import check_name
from spackle.runtime.files import check_file

HUB = "https://huggingface.co"


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
        """The file's address; HF_ENDPOINT names a mirror of Hugging Face."""
        return self.url.replace(HUB, os.environ.get("HF_ENDPOINT", "").rstrip("/") or HUB)


_FACTS = json.loads(Path(__file__).with_name("published.json").read_text(encoding="utf-8"))
PUBLISHED_WEIGHTS = {name: PublishedWeights(name, **facts) for name, facts in _FACTS.items()}


def published_weights(name: str) -> PublishedWeights:
    """The entry of this name; InputError for an unknown name."""
    check_name("weights", name, PUBLISHED_WEIGHTS)
    return PUBLISHED_WEIGHTS[name]


def weights_folder() -> Path:
    """The folder for downloaded weights: $SPACKLE_WEIGHTS, else spackle/weights in $XDG_CACHE_HOME or ~/.cache."""
    if chosen := os.environ.get("SPACKLE_WEIGHTS"):
        return Path(os.path.expanduser(chosen))
    cache = os.environ.get("XDG_CACHE_HOME", "")
    return (
        Path(cache if os.path.isabs(cache) else os.path.expanduser("~/.cache"))
        / "spackle"
        / "weights"
    )


def installed_weights(name: str) -> Path | None:
    """The file of published weights in `weights_folder`; None if it is missing."""
    path = weights_folder() / published_weights(name).file
    return path if os.path.isfile(path) else None


def weights_digests(files: Mapping[str, Path]) -> str | dict[str, str] | None:
    """The digest of a network's file; a dict from name to digest if it has several files, None if it has none."""
    digests = {name: weights_digest(file) for name, file in files.items()}
    return digests if len(digests) > 1 else next(iter(digests.values()), None)


def weights_digest(path: Path) -> str:
    """SHA-256 of a file of weights, as 64 hexadecimal digits; InputError if it cannot be read."""
    check_file(path, "file of weights")
    with open(path, "rb") as file:
        return sha256_of(file)
