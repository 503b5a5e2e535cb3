"""Which files a command means, and where its results go."""

from __future__ import annotations

import os
from pathlib import Path

from spackle.errors import InputError

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".heic", ".heif", ".tif", ".tiff")
DEPTH_SUFFIXES = (".npy", ".npz", ".png", ".pfm")


def find_photos(path: Path) -> list[tuple[Path, str]]:
    """A photo, or the photos of a folder in order of their names, each with the name of its results.

    Raises:
        InputError: nothing there, or a folder without photos.
    """
    if not path.is_dir():
        return [(path, path.stem)]
    try:
        photos = sorted(p for p in path.iterdir() if p.is_file() and p.suffix.lower() in PHOTO_SUFFIXES)
    except OSError as error:
        raise InputError(f"{path}: cannot read the folder: {error.strerror}") from error
    if not photos:
        raise InputError(f"{path}: no photos in this folder (looked for {', '.join(PHOTO_SUFFIXES)})")
    stems = [photo.stem for photo in photos]
    # a.jpg and a.png must not write over each other.
    return [(photo, photo.stem if stems.count(photo.stem) == 1 else photo.name) for photo in photos]


def find_depth(depth: Path, photo: Path) -> Path:
    """The depth map of a photo: the file itself, or the one of its name in a folder.

    Raises:
        InputError: a folder without such a file.
    """
    if not depth.is_dir():
        return depth
    for suffix in DEPTH_SUFFIXES:
        for candidate in (depth / f"{photo.stem}{suffix}", depth / f"{photo.name}{suffix}"):
            if candidate.is_file() and candidate.resolve() != photo.resolve():
                return candidate
    names = ", ".join(f"{photo.stem}{suffix}" for suffix in DEPTH_SUFFIXES)
    raise InputError(f"{photo}: no depth map in {depth}: looked for {names}")


def make_folder(path: Path) -> None:
    """Create a folder for results, or check that it can be written to.

    Raises:
        InputError: where it cannot.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot create this output folder: {reason}; choose another with -o") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: this output folder is not writable; choose another with -o")
