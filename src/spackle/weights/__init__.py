"""Published weights: what is known of each file, and where the file lies on this machine.

`download.py` fetches files, `checkpoints.py` reads them, and `archives.py` is a part of the reader.
The weights of Spackle's own networks lie beside these files.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import check_name
from spackle.runtime.files import check_file

HUGGING_FACE = "https://huggingface.co"


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
    notice: Sequence[str]  # lines that are printed after the download
    option: str  # which option takes a copy in another folder, in words

    @property
    def address(self) -> str:
        """The address of the file; the variable HF_ENDPOINT names a mirror of Hugging Face."""
        mirror = os.environ.get("HF_ENDPOINT", "").rstrip("/")
        if not mirror:
            return self.url
        return self.url.replace(HUGGING_FACE, mirror)


def _read_published_weights() -> dict[str, PublishedWeights]:
    """Read `published.json`: the published weights by their names."""
    text = Path(__file__).with_name("published.json").read_text(encoding="utf-8")
    return {name: PublishedWeights(name, **facts) for name, facts in json.loads(text).items()}


PUBLISHED_WEIGHTS = _read_published_weights()


def published_weights(name: str) -> PublishedWeights:
    """Return what is known of published weights; InputError for an unknown name."""
    check_name("weights", name, PUBLISHED_WEIGHTS)
    return PUBLISHED_WEIGHTS[name]


def weights_folder() -> Path:
    """Return the folder for downloaded weights.

    This is $SPACKLE_WEIGHTS, or else spackle/weights in $XDG_CACHE_HOME or in ~/.cache.
    """
    own_folder = os.environ.get("SPACKLE_WEIGHTS")
    if own_folder:
        return Path(os.path.expanduser(own_folder))
    cache = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG standard demands that a relative path is ignored.
    if not os.path.isabs(cache):
        cache = os.path.expanduser("~/.cache")
    return Path(cache) / "spackle" / "weights"


def installed_weights(name: str) -> Path | None:
    """Return the downloaded file of published weights; None if it is not on this machine."""
    path = weights_folder() / published_weights(name).file
    return path if os.path.isfile(path) else None


def weights_digests(files: Mapping[str, Path]) -> str | dict[str, str] | None:
    """Return the digests of a network's files, in the form in which reports have them.

    Args:
        files: the files by their names in reports.

    Returns:
        The SHA-256 of the only file; a dict from name to SHA-256 if there are several files; None
        if there are none.
    """
    digests = {name: weights_digest(file) for name, file in files.items()}
    if len(digests) > 1:
        return digests
    return next(iter(digests.values()), None)


def weights_digest(path: Path) -> str:
    """Return the SHA-256 of a file of weights, as 64 hexadecimal digits.

    Raises:
        InputError: the file cannot be read.
    """
    check_file(path, "file of weights")
    with open(path, "rb") as file:
        return sha256_of(file)
