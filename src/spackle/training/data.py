"""A recipe's data as files of samples: each view is made once and read many times."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spackle.errors import InputError
from spackle.formats import atomic_path
from spackle.image import PHOTO_SUFFIXES
from spackle.render import Renderer
from spackle.training.recipe import DataRecipe, plain
from spackle.training.sample import Sample, random_crops, save_sample
from spackle.training.sources import Composites, PseudoViews, RgbdFrames, Source, StereoPairs

TRAIN, VALIDATION = "train", "validation"
SAMPLES_VERSION = 2  # goes up whenever the same recipe would make other samples
Step = Callable[[int, int], None]  # (done, of how many)


@dataclasses.dataclass(frozen=True)
class Cache:
    """A folder of samples, numbered by the view that they are crops of."""

    folder: Path
    sources: Sequence[Source]
    shares: Sequence[float]  # of each source
    seed: int
    crops: int  # of a view, at most
    cells: int  # along a crop's side

    def fill(self, views: int, progress: Step, warn: Callable[[str], None]) -> list[Path]:
        """Make what is missing of the first views, warning of bad photos; returns the samples' files in order."""
        self.folder.mkdir(parents=True, exist_ok=True)
        files: list[Path] = []
        for index in range(views):
            files += self._view(index, warn)
            progress(index + 1, views)
        return files

    def _view(self, index: int, warn: Callable[[str], None]) -> list[Path]:
        marker = self.folder / f"{index:06d}.done"
        try:
            files = [self._file(index, number) for number in range(int(marker.read_text()))]
            if all(file.is_file() for file in files):
                return files
        except (FileNotFoundError, ValueError):
            pass
        rng = np.random.default_rng([self.seed, index])
        source = self.sources[rng.choice(len(self.sources), p=np.array(self.shares) / sum(self.shares))]
        crops: list[Sample] = []
        try:
            crops = random_crops(source.view(rng), rng, self.crops, self.cells)
        except (InputError, ValueError) as error:
            warn(f"view {index} ({source.name}) passed over: {error}")
        files = [self._file(index, number) for number in range(len(crops))]
        for crop, file in zip(crops, files, strict=True):
            save_sample(crop, file)
        with atomic_path(marker) as temporary:
            temporary.write_text(f"{len(crops)}\n")
        return files

    def _file(self, index: int, number: int) -> Path:
        return self.folder / f"{index:06d}-{number}.safetensors"


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
    sources: Sequence[Source]
    shares: Sequence[float]
    names: Sequence[str]  # of all files, relative to their folders

    @staticmethod
    def of(data: DataRecipe, renderer: Renderer) -> Supply:
        """Look for a recipe's files.

        Raises:
            InputError: a folder that is missing or without such files, or no data at all.
        """
        sources: list[Source] = []
        shares: list[float] = []
        names: list[str] = []

        def add(source: Source, share: float, folder: Path, files: Sequence[Path]) -> None:
            if share > 0:
                sources.append(source)
                shares.append(share)
                names.extend([source.name, *(file.relative_to(folder).as_posix() for file in files)])

        if data.photos is not None:
            photos = find_files(data.photos, "data.photos", PHOTO_SUFFIXES, "photos")
            add(Composites(photos, renderer, data.disparity), data.shares.composites, data.photos, photos)
        found = [find_files(frames.folder, "data.rgbd", (".color.jpg",), "NAME.color.jpg") for frames in data.rgbd]
        for camera, frames in zip(data.rgbd, found, strict=True):
            share = data.shares.rgbd * len(frames) / sum(map(len, found))  # every frame counts alike
            source = RgbdFrames(frames, renderer, data.disparity, camera.focal_px, camera.unit_m)
            add(source, share, camera.folder, frames)
        if data.stereo is not None:
            scenes = [file.parent for file in find_files(data.stereo, "data.stereo", ("scene.json",), "scene.json")]
            for reverse, share, name in ((True, data.shares.stereo, "stereo"), (False, data.shares.pairs, "pairs")):
                add(StereoPairs(scenes, renderer, data.disparity, reverse, name), share, data.stereo, scenes)
        if data.pseudo is not None and data.shares.pseudo > 0:
            views = PseudoViews(data.pseudo)
            add(views, data.shares.pseudo, data.pseudo, ())
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
        return digest_of((SAMPLES_VERSION, facts, list(self.shares), list(self.names)))

    def samples(self, folder: Path, progress: Step, warn: Callable[[str], None]) -> SampleFiles:
        """The samples in a folder, which many recipes may share; what is missing is made.

        Args:
            folder: for a folder of the digest's name, with train/ and validation/ in it.
            progress: called with the views that are there, of how many.
            warn: called with each view that was passed over, and why.

        Raises:
            InputError: where nothing can be written, or no view has a hole to learn from.
        """
        data, digest = self.data, self.digest

        def fill(name: str, seed: int, views: int) -> list[Path]:
            place = folder / digest / name
            # Other seeds, other views: no view is in both.
            files = Cache(place, self.sources, self.shares, seed, data.crops, data.cells).fill(views, progress, warn)
            if not files:
                raise InputError(
                    f"{place}: none of {views} views gave a sample: photos must be readable, larger than "
                    f"{2 * data.cells} pixels each way, and seen from aside (data.disparity)"
                )
            return files

        validated = fill(VALIDATION, 2 * data.seed + 1, data.validation_views)
        learned = fill(TRAIN, 2 * data.seed, data.views)
        return SampleFiles(learned, validated, digest)


def find_files(folder: Path, key: str, endings: tuple[str, ...], what: str) -> list[Path]:
    """All files below a folder whose names end so, in order.

    Raises:
        InputError: no folder, or no such file in it.
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: no such folder, but {key} names it: give {key}=FOLDER")
    found = sorted(file for file in folder.rglob("*") if file.name.lower().endswith(endings) and file.is_file())
    found = [file for file in found if not file.name.startswith(".")]
    if not found:
        raise InputError(f"{folder}: {key} names this folder, but there is nothing in it: looked for {what}")
    return found


def digest_of(value: object) -> str:
    """Twelve hexadecimal digits that tell one recipe's data from another's."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]
