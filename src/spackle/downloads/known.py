"""Weights that others publish and Spackle can use: where from, and under what terms."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from spackle.downloads.fetch import weights_folder
from spackle.errors import InputError


@dataclasses.dataclass(frozen=True)
class KnownWeights:
    """One published file."""

    name: str
    url: str
    file: str  # its name in the folder of weights
    licence: str  # in a few words
    notice: tuple[str, ...]  # lines that a person sees before the download


WEIGHTS = {
    known.name: known
    for known in (
        KnownWeights(
            name="sharp",
            url="https://ml-site.cdn-apple.com/models/sharp/sharp_2572gikvuh.pt",
            file="sharp_2572gikvuh.pt",
            licence="Apple, research only",
            notice=(
                "SHARP's weights are Apple's, under the Apple Machine Learning Research Model licence:",
                "for non-commercial scientific research only. Spackle's own licence does not cover them.",
                "Read its terms: https://github.com/apple/ml-sharp/blob/main/LICENSE_MODEL",
            ),
        ),
    )
}


def known_weights(name: str) -> KnownWeights:
    """The entry of that name.

    Raises:
        InputError: no such name.
    """
    if name not in WEIGHTS:
        raise InputError(f"{name}: no weights of that name are known: choose from {', '.join(WEIGHTS)}")
    return WEIGHTS[name]


def installed(name: str) -> Path | None:
    """The file of known weights in the folder of weights; None where it is not there.

    Raises:
        InputError: no such name.
    """
    path = weights_folder() / known_weights(name).file
    return path if os.path.isfile(path) else None
