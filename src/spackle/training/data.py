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
from spackle.files import atomic_path
from spackle.image import PHOTO_SUFFIXES
from spackle.render import Renderer
from spackle.training.recipe import DataRecipe, plain
from spackle.training.sample import Sample, random_crops, save_sample
from spackle.training.sources import PseudoViews, View, composite_view, frame_view, right_view, stereo_view

TRAIN, VALIDATION = "train", "validation"
SAMPLES_VERSION = 4  # goes up whenever the same recipe would make other samples
Step = Callable[[int, int], None]  # (done, of how many)


@dataclasses.dataclass(frozen=True)
class SampleFiles:
    """What a run learns from, and what it is validated on."""

    train: Sequence[Path]
    validation: Sequence[Path]
    digest: str  # of everything that decides what is in them, but not of where they lie


@dataclasses.dataclass(frozen=True)
class Supply:
    """Where samples come from: the files that were found for a recipe."""

    data: DataRecipe
    sources: Sequence[View]
    shares: Sequence[float]
    names: Sequence[str]  # of all files, relative to their folders

    @staticmethod
    def of(data: DataRecipe, renderer: Renderer) -> Supply:
        """Look for a recipe's files; InputError for a folder that is missing or without such files, or no data."""
        sources: list[View] = []
        shares: list[float] = []
        names: list[str] = []
        drawn: dict[str, Any] = {"disparity": data.disparity, "renderer": renderer}

        def add(name: str, share: float, folder: Path, files: Sequence[Path], view: View) -> None:
            if share > 0:
                sources.append(view)
                shares.append(share)
                names.extend([name, *(file.relative_to(folder).as_posix() for file in files)])

        if data.photos is not None:
            photos = find_files(data.photos, "data.photos", PHOTO_SUFFIXES, "photos")
            view = partial(composite_view, photos=photos, **drawn)
            add("composites", data.shares.composites, data.photos, photos, view)
        found = [find_files(frames.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg") for frames in data.rgbd]
        for camera, frames in zip(data.rgbd, found, strict=True):
            share = data.shares.rgbd * len(frames) / sum(map(len, found))  # every frame counts alike
            view = partial(frame_view, frames=frames, focal_px=camera.focal_px, unit_m=camera.unit_m, **drawn)
            add("rgbd", share, camera.folder, frames, view)
        if data.stereo is not None:
            scenes = [file.parent for file in find_files(data.stereo, "data.stereo", ("scene.json",), "scene.json")]
            add("stereo", data.shares.stereo, data.stereo, scenes, partial(stereo_view, folders=scenes, **drawn))
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
        facts: dict[str, Any] = plain(self.data)
        for name in ("photos", "stereo", "pseudo", "cache", "views", "validation_views"):
            facts.pop(name)
        for camera in facts["rgbd"]:
            camera.pop("folder")
        return short_digest((SAMPLES_VERSION, facts, list(self.shares), list(self.names)))

    def samples(self, folder: Path, progress: Step, warn: Callable[[str], None]) -> SampleFiles:
        """The samples in a folder, which many recipes may share; what is missing is made.

        Args:
            folder: for a folder of the digest's name, with train/ and validation/ in it.
            progress: called with the views that are there, of how many.
            warn: called with the reason for each view that gives no sample.

        Raises:
            InputError: where nothing can be written, or no view has a hole to learn from.
        """
        data, place = self.data, folder / self.digest
        # Other seeds, other views: no view is in both.
        validated = self.fill(place / VALIDATION, 2 * data.seed + 1, data.validation_views, progress, warn)
        learned = self.fill(place / TRAIN, 2 * data.seed, data.views, progress, warn)
        return SampleFiles(learned, validated, self.digest)

    def fill(self, folder: Path, seed: int, views: int, progress: Step, warn: Callable[[str], None]) -> list[Path]:
        """Make what is missing of a folder's first views; returns the samples' files in order; as `samples`."""
        folder.mkdir(parents=True, exist_ok=True)
        files: list[Path] = []
        for index in range(views):
            files += self._view(folder, seed, index, warn)
            progress(index + 1, views)
        if not files:
            raise InputError(
                f"{folder}: none of {views} views gave a sample: photos must be readable, larger than "
                f"{2 * self.data.cells} pixels each way, and seen from aside (data.disparity)"
            )
        return files

    def _view(self, folder: Path, seed: int, index: int, warn: Callable[[str], None]) -> list[Path]:
        """The files of a view's crops; a marker, written last, holds their number."""
        marker = folder / f"{index:06d}.done"
        with contextlib.suppress(FileNotFoundError, ValueError):
            files = _crop_files(folder, index, int(marker.read_text()))
            if all(file.is_file() for file in files):
                return files
        rng = np.random.default_rng([seed, index])
        source = self.sources[rng.choice(len(self.sources), p=np.array(self.shares) / sum(self.shares))]
        crops: list[Sample] = []
        try:
            crops = random_crops(source(rng), rng, self.data.crops, self.data.cells)
        except (InputError, ValueError) as error:
            warn(str(error))
        files = _crop_files(folder, index, len(crops))
        for crop, file in zip(crops, files, strict=True):
            save_sample(crop, file)
        with atomic_path(marker) as temporary:
            temporary.write_text(f"{len(crops)}\n")
        return files


def _crop_files(folder: Path, index: int, count: int) -> list[Path]:
    return [folder / f"{index:06d}-{number}.safetensors" for number in range(count)]


def find_files(folder: Path, key: str, endings: tuple[str, ...], what: str) -> list[Path]:
    """All files below a folder whose names end so, in order; InputError for no folder, or no such file in it."""
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder, but {key} names it: give {key}=FOLDER")
    found = sorted(file for file in folder.rglob("*") if file.name.lower().endswith(endings) and file.is_file())
    found = [file for file in found if not file.name.startswith(".")]
    if not found:
        raise InputError(f"{folder}: {key} names this folder, but there is nothing in it: looked for {what}")
    return found


def short_digest(value: object) -> str:
    """Twelve hexadecimal digits that tell one recipe's data from another's."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]
