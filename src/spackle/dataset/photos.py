"""The photos of a dataset: those of a folder, or those that COCO's annotations name."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spackle.bases.open import Log
from spackle.downloads.transfer import digest
from spackle.errors import InputError
from spackle.files import check_file
from spackle.image import PHOTO_SUFFIXES, load_photo
from spackle.progress import Step

SUFFIXES = (*PHOTO_SUFFIXES, ".gif", ".bmp")
MIN_SIDE = 32  # pixels: a smaller picture has no depth that anybody could see
MAX_JSON_BYTES = 1 << 30


@dataclasses.dataclass(frozen=True)
class PhotoFile:
    """A photo and its digest."""

    path: Path
    name: str  # relative to its folder, with slashes
    sha256: str  # of the file


@dataclasses.dataclass(frozen=True)
class Found:
    """The files that a source names, in the order of their names."""

    root: Path
    names: Sequence[str]
    missing: Sequence[str] = ()  # named, but not there


def find_photos(source: Path, folder: Path | None = None) -> Found:
    """The photos below a folder, or those that a COCO file `{"images": [{"file_name": …}, …]}` names.

    `folder` is where the COCO file's photos lie (None: beside it). InputError without a photo or such a file.
    """
    if not os.path.isdir(source):
        return _named_by_coco(source, folder)
    if folder is not None:
        raise InputError(f"{folder}: only a COCO JSON needs a folder beside it, and {source} is a folder itself")
    names = []
    for place, folders, files in os.walk(source):
        folders[:] = [name for name in folders if not name.startswith(".")]
        photos = [name for name in files if name.lower().endswith(SUFFIXES) and not name.startswith(".")]
        names += [(Path(place) / name).relative_to(source).as_posix() for name in photos]
    if not names:
        raise InputError(f"{source}: no photos in this folder (looked for {', '.join(SUFFIXES)})")
    return Found(source, sorted(names))


def _named_by_coco(source: Path, folder: Path | None) -> Found:
    if check_file(source, "folder of photos or COCO JSON") > MAX_JSON_BYTES:
        raise InputError(f'{source}: too long for COCO annotations (at most 1 GiB): take out what is not "images"')
    try:
        content: Any = json.loads(source.read_text(encoding="utf-8"))
        names = [image["file_name"] for image in content["images"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(
            f'{source}: neither a folder nor COCO annotations: needs {{"images": [{{"file_name": …}}, …]}}'
        ) from error
    if not names:
        raise InputError(f"{source}: names no images")
    root = source.parent if folder is None else folder
    if not os.path.isdir(root):
        raise InputError(f"{root}: no such folder, and the photos of {source.name} should be in it")
    for name in names:  # stays in its folder
        if not isinstance(name, str) or not name or "\0" in name or name.startswith("/") or ".." in Path(name).parts:
            raise InputError(f"{source}: {str(name)[:60]!r} is no file name of an image")
    unique = sorted({Path(name).as_posix() for name in names})
    there = {name for name in unique if os.path.isfile(root / name)}
    if not there:
        raise InputError(f"{source}: none of its {len(unique)} images is in {root}: name their folder")
    return Found(root, sorted(there), [name for name in unique if name not in there])


def choose(found: Found, count: int | None, seed: int, warn: Log, progress: Step) -> list[PhotoFile]:
    """The photos of a dataset, in the order of their names: all, or a random subset of `count`.

    The subset depends on the names, the contents and the seed alone. `warn` names each photo that cannot be read, is
    too small, or is a copy of another; the next one takes its place. InputError for fewer good photos than `count`.
    """
    repeated = _repeated(found, warn)
    names = [name for name in found.names if name not in repeated]
    wanted = len(names) if count is None else count
    if count is not None:
        names.sort(key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest())
    chosen: list[PhotoFile] = []
    for name in names:
        if len(chosen) == wanted:
            break
        path = found.root / name
        try:
            photo = load_photo(path)  # from its first to its last pixel
            width, height = photo.width, photo.height
            if min(width, height) < MIN_SIDE:
                raise InputError(f"{path}: {width}×{height} pixels are too few (at least {MIN_SIDE} each way)")
            chosen.append(PhotoFile(path, name, _sha256(path)))
        except InputError as error:
            warn(f"passed over: {error}")
        progress(len(chosen), wanted)
    if not chosen:
        raise InputError(f"{found.root}: none of {len(found.names)} photos can be used (the lines above say why)")
    if count is not None and len(chosen) < count:
        raise InputError(f"{found.root}: {len(chosen)} photos can be used, and --sample asks for {count}")
    return sorted(chosen, key=lambda photo: photo.name)


def _repeated(found: Found, warn: Log) -> set[str]:
    """Names whose file holds the same bytes as one of an earlier name. Only files of one size are read."""
    by_size: dict[int, list[str]] = defaultdict(list)
    for name in found.names:
        with contextlib.suppress(OSError):  # `choose` names what cannot be read
            by_size[(found.root / name).stat().st_size].append(name)
    repeated: set[str] = set()
    first: dict[str, str] = {}
    for name in (name for size, names in by_size.items() if size and len(names) > 1 for name in names):
        sha256 = _sha256(found.root / name)
        if sha256 and first.setdefault(sha256, name) != name:
            warn(f"passed over: {found.root / name}: the same photo as {first[sha256]}")
            repeated.add(name)
    return repeated


def _sha256(path: Path) -> str:
    """Hexadecimal digest of a file; "" of one that cannot be read."""
    try:
        with open(path, "rb") as file:
            return digest(file).hexdigest()
    except OSError:
        return ""
