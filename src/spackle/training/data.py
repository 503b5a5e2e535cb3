"""A recipe's data as files of samples: each view is made once and read many times."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from spackle.errors import InputError
from spackle.files import files_in, write_whole
from spackle.image import PHOTO_SUFFIXES
from spackle.progress import Step
from spackle.render import Renderer
from spackle.training.ranks import rank, rank_count, wait_for_ranks
from spackle.training.recipe import DataRecipe
from spackle.training.sample import Sample, random_crops, save_sample
from spackle.training.sources import (
    Draw,
    PseudoViews,
    View,
    composite_photo,
    frame_photo,
    left_photo,
    random_reverse_view,
    right_view,
)

CACHE = "cache"  # in the output, where the recipe names no other folder
SAMPLES_VERSION = 4  # goes up whenever the same recipe would make other samples


@dataclasses.dataclass(frozen=True)
class Supply:
    """Where samples come from: the files that were found for a recipe."""

    data: DataRecipe
    sources: Sequence[View]
    shares: Sequence[float]  # of the views, one for each source
    names: Sequence[str]  # of all files, relative to their folders

    @staticmethod
    def of(data: DataRecipe, renderer: Renderer) -> Supply:
        """Look for a recipe's files; InputError for a folder that is missing or without such files, or no data."""
        sources: list[View] = []
        shares: list[float] = []
        names: list[str] = []

        def add(name: str, share: float, folder: Path, files: Sequence[Path], view: View) -> None:
            if share > 0:
                sources.append(view)
                shares.append(share)
                names.extend([name, *(file.relative_to(folder).as_posix() for file in files)])

        def reverse(draw: Draw) -> View:
            return partial(random_reverse_view, draw=draw, disparity=data.disparity, renderer=renderer)

        if data.photos is not None:
            photos = find_files(data.photos, "data.photos", PHOTO_SUFFIXES, "photos")
            view = reverse(partial(composite_photo, photos=photos))
            add("composites", data.shares.composites, data.photos, photos, view)
        found = [find_files(frames.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg") for frames in data.rgbd]
        for camera, frames in zip(data.rgbd, found, strict=True):
            share = data.shares.rgbd * len(frames) / sum(map(len, found))  # every frame counts alike
            view = reverse(partial(frame_photo, frames=frames, focal_px=camera.focal_px, unit_m=camera.unit_m))
            add("rgbd", share, camera.folder, frames, view)
        if data.stereo is not None:
            scenes = [file.parent for file in find_files(data.stereo, "data.stereo", ("scene.json",), "scene.json")]
            add("stereo", data.shares.stereo, data.stereo, scenes, reverse(partial(left_photo, folders=scenes)))
            view = partial(right_view, folders=scenes, renderer=renderer)
            add("pairs", data.shares.pairs, data.stereo, scenes, view)
        if data.pseudo is not None and data.shares.pseudo > 0:
            views = PseudoViews(data.pseudo)
            add("pseudo", data.shares.pseudo, data.pseudo, (), views.view)
            names.append(views.digest)
        if not sources:
            raise InputError(
                "the recipe has no data: give data.photos=FOLDER, data.rgbd, data.stereo or data.pseudo, "
                "and a share above 0"
            )
        return Supply(data, sources, shares, names)

    @property
    def digest(self) -> str:
        """Twelve digits: the same samples have the same ones, wherever the files lie and however many are made."""
        facts = self.data.model_dump(mode="json")
        for name in ("photos", "stereo", "pseudo", "cache", "views", "validation_views"):
            facts.pop(name)
        for camera in facts["rgbd"]:
            camera.pop("folder")
        return short_digest((SAMPLES_VERSION, facts, list(self.shares), list(self.names)))

    def samples(self, folder: Path, progress: Step, warn: Callable[[str], None]) -> tuple[list[Path], list[Path]]:
        """The samples in a folder, which many recipes may share: to learn from, and for validation.

        What is missing is made, by each process a part.

        Args:
            folder: for a folder of the digest's name, with train/ and validation/ in it.
            progress: called with this process's views that are there, of how many.
            warn: called with the reason for each view that gives no sample.

        Raises:
            InputError: where nothing can be written, or no view has a hole to learn from.
        """
        data, place = self.data, folder / self.digest
        # Other seeds, other views: no view is in both.
        validation = self.fill(place / "validation", 2 * data.seed + 1, data.validation_views, progress, warn)
        return self.fill(place / "train", 2 * data.seed, data.views, progress, warn), validation

    def fill(self, folder: Path, seed: int, views: int, progress: Step, warn: Callable[[str], None]) -> list[Path]:
        """Make what is missing of a folder's first views; returns all samples' files in order; as `samples`."""
        folder.mkdir(parents=True, exist_ok=True)
        own = range(rank(), views, rank_count())
        for done, index in enumerate(own, 1):
            if _crop_files(folder, index) is None:
                self._make(folder, seed, index, warn)
            progress(done, len(own))
        wait_for_ranks()
        files = [file for index in range(views) for file in _crop_files(folder, index) or ()]
        if not files:
            raise InputError(
                f"{folder}: none of {views} views gave a sample: photos must be readable, larger than "
                f"{2 * self.data.cells} pixels each way, and seen from aside (data.disparity)"
            )
        return files

    def _make(self, folder: Path, seed: int, index: int, warn: Callable[[str], None]) -> None:
        """Write a view's crops and then a marker, which holds their number."""
        rng = np.random.default_rng([seed, index])
        source = self.sources[rng.choice(len(self.sources), p=np.array(self.shares) / sum(self.shares))]
        crops: list[Sample] = []
        try:
            crops = random_crops(source(rng), rng, self.data.crops, self.data.cells)
        except (InputError, ValueError) as error:
            warn(str(error))
        for number, crop in enumerate(crops):
            save_sample(crop, folder / f"{index:06d}-{number}.safetensors")
        write_whole(folder / f"{index:06d}.done", f"{len(crops)}\n".encode())


def _crop_files(folder: Path, index: int) -> list[Path] | None:
    """The files of a view's crops; None where they are still to be made."""
    with contextlib.suppress(FileNotFoundError, ValueError):
        count = int((folder / f"{index:06d}.done").read_text())
        files = [folder / f"{index:06d}-{number}.safetensors" for number in range(count)]
        if all(file.is_file() for file in files):
            return files
    return None


def find_files(folder: Path, key: str, endings: tuple[str, ...], what: str) -> list[Path]:
    """All files below a folder whose names end so, in order; InputError for no folder, or no such file in it."""
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder, but {key} names it: give {key}=FOLDER")
    found = files_in(folder, endings, below=True)
    if not found:
        raise InputError(f"{folder}: {key} names this folder, but there is nothing in it: looked for {what}")
    return found


def short_digest(value: Any) -> str:
    """Twelve hexadecimal digits that tell one recipe's data from another's."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]
