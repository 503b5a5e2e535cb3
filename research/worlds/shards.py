"""Worlds in files: tar archives of a few worlds each, written whole or not at all.

A world KEY has these files in its archive:

    KEY.json             cameras, ranges of depth, kind of room, models, seed
    KEY.photo.jpg        what the camera made of view 0, with noise and blur
    KEY.00.rgb.jpg       view 0 without them; 01 to 06 are the second views
    KEY.00.depth.png     16 bits, logarithmic; `spackle.paper.dataset.encoding` decodes it
    KEY.00.valid.png     1: a surface, 2: the sky, 0: seen through glass
    KEY.00.normal.png    of view 0 only: 128 + 127 · (x, y, z) in the camera's axes
"""

from __future__ import annotations

import dataclasses
import io
import json
import tarfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from spackle.core.camera import Camera
from spackle.formats.camera_files import camera_from_json
from spackle.paper.dataset.encoding import decode_depth, decode_png, encode_depth, encode_png
from spackle.paper.dataset.sample import END_OF_ARCHIVE, camera_facts, tar_member
from spackle.runtime.errors import as_input_error
from spackle.runtime.files import write_atomic
from worlds.photo_camera import Development, developed
from worlds.views import VALID, View

VIEW_QUALITY = 95  # of JPEGs without a camera's faults
WORLDS_PER_SHARD = 8
ROOMS_PREFIX = "worlds"  # of the names of archives with rooms


@dataclasses.dataclass(frozen=True)
class StoredView:
    """A view of a stored world."""

    camera: Camera
    rgb: NDArray[np.uint8]  # [H, W, 3]
    depth: NDArray[np.float32]  # [H, W] metres, 0 where unknown or the sky
    valid: NDArray[np.uint8]  # [H, W] 1: a surface, 2: the sky, 0: seen through glass


def shard_file(folder: Path, number: int, prefix: str = ROOMS_PREFIX) -> Path:
    """The file of the shard with this number, of rooms or of what another prefix says."""
    return folder / f"{prefix}-{number:05d}.tar"


def pack_world(
    key: str,
    photo: bytes,
    views: Sequence[View],
    settings: Development,
    facts: Mapping[str, Any],
) -> bytes:
    """A world's part of an archive.

    Args:
        key: begins the names of its files.
        photo: the JPEG of view 0.
        views: all views; the first is the photo's.
        settings: the camera's, which all views share.
        facts: what else the JSON says.
    """
    files: list[tuple[str, bytes]] = [(f"{key}.photo.jpg", photo)]
    view_facts = []
    for number, view in enumerate(views):
        srgb = developed(view.radiance, settings)
        depth = torch.from_numpy(view.depth)
        depth_png, depth_range = encode_depth(depth, torch.isfinite(depth))
        name = f"{key}.{number:02d}"
        files += [
            (f"{name}.rgb.jpg", _jpeg(srgb)),
            (f"{name}.depth.png", depth_png),
            (f"{name}.valid.png", encode_png(view.valid)),
        ]
        if number == 0:
            normal = (128 + 127 * view.normal).round().astype(np.uint8)
            files.append((f"{name}.normal.png", encode_png(normal)))
        known = float((view.valid == VALID).mean())
        view_facts.append(
            camera_facts(view.camera) | {"depth_range": list(depth_range), "known": known}
        )
    content = {**facts, "key": key, "views": view_facts, "camera": _plain(settings)}
    text = json.dumps(content, indent=1, sort_keys=True, allow_nan=False) + "\n"
    files.insert(0, (f"{key}.json", text.encode()))
    return b"".join(tar_member(name, data) for name, data in files)


def write_shard(path: Path, worlds: Sequence[bytes]) -> None:
    """Write an archive of packed worlds."""
    write_atomic(path, b"".join(worlds) + END_OF_ARCHIVE)


def world_keys(path: Path) -> list[str]:
    """The keys of the worlds in an archive; InputError if it is damaged."""
    with as_input_error(str(path), "no worlds, or damaged: {reason}"), tarfile.open(path) as tar:
        names = tar.getnames()
    return [name.removesuffix(".json") for name in names if name.endswith(".json")]


def read_view(path: Path, key: str, number: int, *, photo: bool = False) -> StoredView:
    """A view of a world; InputError if the archive is damaged.

    Args:
        path: the archive.
        key: the world's.
        number: the view's; 0 is the photo's camera.
        photo: colours as the camera made them, for view 0.
    """
    name = f"{key}.{number:02d}"
    with as_input_error(str(path), "no worlds, or damaged: {reason}"), tarfile.open(path) as tar:
        facts = json.loads(_member(tar, f"{key}.json"))["views"][number]
        near, far = facts["depth_range"]
        color = _member(tar, f"{key}.photo.jpg" if photo else f"{name}.rgb.jpg")
        with Image.open(io.BytesIO(color), formats=["JPEG"]) as picture:
            rgb = np.array(picture.convert("RGB"))
        depth = decode_depth(_member(tar, f"{name}.depth.png"), near, far).numpy()
        valid = decode_png(_member(tar, f"{name}.valid.png"), axis_count=2)
    return StoredView(camera_from_json(facts, str(path)), rgb, depth, valid)


def world_facts(path: Path, key: str) -> dict[str, Any]:
    """What a world's JSON says; InputError if the archive is damaged."""
    with as_input_error(str(path), "no worlds, or damaged: {reason}"), tarfile.open(path) as tar:
        return dict(json.loads(_member(tar, f"{key}.json")))


def _member(tar: tarfile.TarFile, name: str) -> bytes:
    """A file's content; KeyError if it is missing."""
    file = tar.extractfile(name)
    if file is None:
        raise KeyError(name)
    return file.read()


def _jpeg(srgb: NDArray[np.float32]) -> bytes:
    """A JPEG without chroma subsampling of a picture [H, W, 3] in 0..1."""
    stream = io.BytesIO()
    pixels = (srgb * 255 + 0.5).astype(np.uint8)
    Image.fromarray(pixels).save(stream, "JPEG", quality=VIEW_QUALITY, subsampling=0)
    return stream.getvalue()


def _plain(settings: Development) -> dict[str, Any]:
    """The settings as numbers and lists."""
    facts = dataclasses.asdict(settings)
    facts["white_balance"] = [float(value) for value in settings.white_balance]
    return facts
