"""Choose the photos of a dataset among those that are there."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

from spackle.core.photo import load_photo
from spackle.core.photo_lists import NO_LENS, Lens, ListedPhoto
from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Progress

MIN_SIDE_PX = 32  # no depth can be recognised in smaller images


@dataclasses.dataclass(frozen=True)
class PhotoFile:
    """A photo of a dataset."""

    index: int  # the photo's number in the dataset
    path: Path
    name: str  # relative to the folder of photos, with slashes
    sha256: str  # of the file
    depth: Path | None = None  # the depth map that a manifest names for it
    lens: Lens = NO_LENS  # the focal length that a manifest states

    @property
    def key(self) -> str:
        """The photo's number as text, with which the names of its files in the dataset begin."""
        return photo_key(self.index)


def photo_key(index: int) -> str:
    """The number of a dataset's photo as text, such as "000012"."""
    return f"{index:06d}"


def choose_photos(
    source: Path,
    photos: Sequence[ListedPhoto],
    count: int | None,
    seed: int,
    warn: Callable[[str], None],
    progress: Progress,
) -> list[PhotoFile]:
    """Choose a dataset's photos, sorted by name: all, or a random subset.

    The subset depends on names, contents and seed alone, not on the order of the photos. Unreadable
    photos, small photos and copies are replaced by other photos.

    Args:
        source: the folder or list of the photos, for messages.
        photos: the photos of this folder or list.
        count: number of photos; None: all.
        seed: determines the subset.
        warn: receives a line for each photo that cannot be used.
        progress: receives (photos chosen, photos wanted).

    Raises:
        InputError: no photo is usable, or fewer than `count` are.
    """
    wanted_count = len(photos) if count is None else count
    order = list(photos)
    if count is not None:
        # A random order by a digest of each name: when a photo joins, the others keep their order.
        order.sort(key=lambda photo: hashlib.sha256(f"{seed}:{photo.name}".encode()).digest())

    chosen: dict[str, ListedPhoto] = {}  # by SHA-256 of the files
    for photo in order:
        if len(chosen) == wanted_count:
            break
        try:
            # If one copy were in training and another in validation, validation would be worthless.
            sha256 = check_photo_file(photo.path)
            if sha256 in chosen:
                raise InputError(f"{photo.path}: the same photo as {chosen[sha256].name}")
            chosen[sha256] = photo
        except InputError as error:
            warn(f"passed over: {error}")
        progress(len(chosen), wanted_count)

    if not chosen:
        raise InputError(
            f"{source}: none of {len(photos)} photos can be used (the lines above say why)"
        )
    if count is not None and len(chosen) < count:
        raise InputError(
            f"{source}: {len(chosen)} photos can be used, and `sample` asks for {count}"
        )
    digests_and_photos = sorted(chosen.items(), key=lambda item: item[1].name)
    return [
        PhotoFile(index, photo.path, photo.name, sha256, photo.depth, photo.lens)
        for index, (sha256, photo) in enumerate(digests_and_photos)
    ]


def check_photo_file(path: Path) -> str:
    """Read a photo; returns the SHA-256 of its file. InputError if it is damaged or too small."""
    photo = load_photo(path)  # decodes all pixels, to find damage
    if min(photo.width, photo.height) < MIN_SIDE_PX:
        size = f"{photo.width}×{photo.height}"
        raise InputError(f"{path}: {size} pixels are too few (at least {MIN_SIDE_PX} each way)")
    with open(path, "rb") as file:
        return sha256_of(file)
