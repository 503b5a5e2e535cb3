"""Furnished rooms, streets and gardens of `research/worlds` as a source of frames.

The archives are described in research/worlds/shards.py; reading them needs nothing of that folder.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import tarfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from frames import MADE, Frame, Rng, Turning
from PIL import Image

from spackle.paper.dataset.encoding import decode_depth, decode_png
from spackle.paper.training.measured_photos import find_files
from spackle.runtime.errors import as_input_error

# How the names of archives begin: rooms and streets. Those of tracks, `tracks-`, are passed over,
# because the terms of their models ask that what is made of them is shared alike.
ARCHIVES = ("worlds-", "closeups-", "streets-")
SURFACE, SKY = 1, 2  # values of the validity picture; 0: seen through glass


@dataclasses.dataclass(frozen=True)
class RoomView:
    """A view of a room in an archive; view 0 is the photo."""

    archive: Path
    key: str
    number: int

    @property
    def name(self) -> str:
        """The view's name in messages."""
        return f"{self.archive} {self.key}.{self.number:02d}"

    @property
    def identity(self) -> tuple[str, str, int]:
        """What the digest of a run's data says of the view."""
        return self.archive.name, self.key, self.number

    def read(self) -> Frame:
        """Read the view; the photo as a camera made it. InputError if the archive is damaged."""
        name = f"{self.key}.{self.number:02d}"
        color_name = f"{self.key}.photo.jpg" if self.number == 0 else f"{name}.rgb.jpg"
        with (
            as_input_error(self.name, "no made room, or damaged: {reason}"),
            tarfile.open(self.archive) as tar,
        ):
            facts = json.loads(_content(tar, f"{self.key}.json"))["views"][self.number]
            with Image.open(io.BytesIO(_content(tar, color_name)), formats=["JPEG"]) as picture:
                pixels = np.array(picture.convert("RGB"))
            depth = decode_depth(_content(tar, f"{name}.depth.png"), *facts["depth_range"])
            valid = torch.from_numpy(decode_png(_content(tar, f"{name}.valid.png"), axis_count=2))

        # The sky is infinitely far; what stands behind glass has two depths, so it has none.
        inverse_depth = torch.where(valid == SURFACE, 1 / depth.clamp_min(1e-6), 0.0)
        known = (valid == SKY) | ((valid == SURFACE) & (depth > 0))
        rgb = torch.from_numpy(pixels).permute(2, 0, 1).float() / 255
        return Frame(rgb.contiguous(), inverse_depth, known)


@dataclasses.dataclass(frozen=True)
class Rooms:
    """Views of made rooms as a source; they are read when they are drawn.

    All rooms are equally frequent, however many views they have: views of one room are alike.
    """

    views: Sequence[RoomView]
    turning: Turning = MADE
    mingles: float = 0.2

    @functools.cached_property
    def views_by_room(self) -> list[list[RoomView]]:
        """The views of each room."""
        found: dict[tuple[Path, str], list[RoomView]] = {}
        for view in self.views:
            found.setdefault((view.archive, view.key), []).append(view)
        return list(found.values())

    def draw(self, rng: Rng) -> tuple[str, Frame]:
        """As `mixture.Source` has it."""
        room = self.views_by_room[int(rng.integers(len(self.views_by_room)))]
        view = room[int(rng.integers(len(room)))]
        return f"room {view.name}", view.read()


@dataclasses.dataclass(frozen=True)
class JudgedRoom:
    """A room's photo for validation."""

    view: RoomView

    @property
    def name(self) -> str:
        """The photo's name in messages."""
        return self.view.name

    @property
    def identity(self) -> tuple[str | int, ...]:
        """What the digest of a run's data says of the photo."""
        return self.view.identity

    def read(self, side: int) -> Frame:
        """Read the photo, whose longer side has less than `side` pixels; the sky counts as unknown,
        because the score compares depths.
        """
        frame = self.view.read()
        return dataclasses.replace(frame, valid=frame.valid & (frame.inverse_depth > 0))


def judged_rooms(folder: Path) -> list[JudgedRoom]:
    """The photos of all rooms below a folder for validation; InputError as from `of_rooms`."""
    views = of_rooms(folder, "data.validation_worlds")
    return [JudgedRoom(view) for view in views if view.number == 0]


def of_rooms(folder: Path, key: str = "data.worlds") -> list[RoomView]:
    """All views of all rooms below a folder; InputError if there are none, or one is damaged.

    `key` names the folder in messages.
    """
    views = []
    for archive in find_files(folder, key, (".tar",), "archives worlds-NNNNN.tar"):
        if not archive.name.startswith(ARCHIVES):
            continue
        with (
            as_input_error(str(archive), "no made rooms, or damaged: {reason}"),
            tarfile.open(archive) as tar,
        ):
            names = tar.getnames()
        for name in names:
            if name.endswith(".depth.png"):
                key, number = name.removesuffix(".depth.png").split(".")
                views.append(RoomView(archive, key, int(number)))
    return views


def _content(tar: tarfile.TarFile, name: str) -> bytes:
    """A file's content; KeyError if it is missing."""
    file = tar.extractfile(name)
    if file is None:
        raise KeyError(name)
    return file.read()
