"""Photos about which nothing else is known: large views, by a base that needs the photo alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spackle.core.image_formats import PHOTO_SUFFIXES, list_photos
from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.dataset import EvalDataset


def photo_cases(scenes: Mapping[str, Path]) -> list[Case]:
    """A case (an input photo with what is known about it) for each photo of each folder.

    The focal length comes from the photo's metadata, as in `spackle predict`. There is neither
    depth nor a second photo.

    Args:
        scenes: the folders with photos, by name.

    Raises:
        InputError: a folder cannot be read.
    """
    return [
        Case(name=f"{name}/{file.stem}", photo=file)
        for name, folder in scenes.items()
        for file in list_photos(folder)
    ]


PHOTOS = EvalDataset(
    name="photos",
    title="Photos",
    terms="",
    # Cameras write upper-case endings, too.
    markers=[f"*{end}" for suffix in PHOTO_SUFFIXES for end in (suffix, suffix.upper())],
    expected="photos",
    read_cases=photo_cases,
)
