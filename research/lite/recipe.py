"""The recipe of a training run of the lite base, and the recipe's files."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from depth_loss import DepthLossWeights
from frames import Group, Measured, Readable, of_camera, of_scenes
from made_rooms import RoomView, judged_rooms, of_rooms
from pydantic import Field

from spackle.bases.lite import SIDE_MULTIPLE, STAGES, EncoderSize
from spackle.paper.training.measured_photos import find_photo_files
from spackle.paper.training.recipe import (
    MAY_CHANGE_ON_RESUME,
    AnyRecipe,
    Count,
    NonNegative,
    OptimRecipe,
    OptionalPath,
    RecipePart,
    RgbdFolder,
    Seed,
)
from spackle.paper.training.sample_factory import short_digest
from spackle.runtime.errors import InputError

RANDOM = Path("random")  # instead of the encoder's file: random weights, for tests and experiments
Side = Annotated[int, Field(ge=SIDE_MULTIPLE, le=2048, multiple_of=SIDE_MULTIPLE)]
Scale = Annotated[float, Field(ge=0.1, le=2)]


class LiteShares(RecipePart):
    """Relative shares of the pictures from each source; a source without data gets no share."""

    made: NonNegative = 0.4
    stereo: NonNegative = 0.28
    rgbd: NonNegative = 0.14
    guessed: NonNegative = 0.18  # only with a teacher
    worlds: NonNegative = 0.3  # only with data.worlds


class LiteData(RecipePart):
    """The sources of photos with depth."""

    photos: OptionalPath = (
        None  # a folder, with its subfolders; textures of synthetic scenes are cut from them
    )
    rgbd: Annotated[
        tuple[RgbdFolder, ...], MAY_CHANGE_ON_RESUME
    ] = ()  # their focal lengths are not used
    stereo: OptionalPath = None  # a folder of scenes, each with a scene.json
    worlds: OptionalPath = None  # a folder of furnished rooms, made by research/worlds
    made: Count = 4900  # number of synthetic scenes
    teacher: Path | None = (
        None  # weights of an earlier run; its predictions for `photos` become training data
    )
    guesses: Count = 1500  # at most this number of photos
    shares: LiteShares = LiteShares()
    # height and width of pictures; swapped in a fifth of the steps
    size: tuple[Side, Side] = (
        256,
        320,
    )
    # Factors on `size`; each step draws one, because the base uses several sizes.
    scales: Annotated[tuple[Scale, ...], Field(min_length=1)] = (1.0,)
    cache: OptionalPath = None  # a folder for synthetic scenes and guesses; None: inside the output
    seed: Seed = 0  # for synthetic scenes alone: runs that differ only in run.seed share them
    # Share of each folder of `rgbd` for validation: the last frames by name, because neighbouring
    # frames are alike.
    validation: Annotated[float, Field(ge=0, le=0.9)] = 0.2
    validation_stereo: OptionalPath = (
        None  # scenes for validation; all scenes of `stereo` are for training
    )
    validation_worlds: OptionalPath = (
        None  # furnished rooms for validation; all rooms of `worlds` are for training
    )


class LiteOptim(OptimRecipe):
    """Settings of the optimiser, and of the pretrained encoder."""

    encoder_rate: Annotated[float, Field(ge=0, le=10)] = (
        0.2  # factor on the encoder's learning rate
    )
    # How many of the encoder's first stages are frozen, with its stem; 0: nothing is frozen.
    frozen: Annotated[int, Field(ge=0, le=len(STAGES["lite2"]))] = 2


class LiteRecipe(AnyRecipe):
    """The recipe of a training run of the lite base."""

    data: LiteData = LiteData()
    loss: DepthLossWeights = DepthLossWeights()
    optim: LiteOptim = LiteOptim()
    network: EncoderSize = "lite2"  # size of the encoder: EfficientNet-Lite0 or -Lite2
    encoder: Path | None = (
        None  # its .pth file; None: from the installed package; "random": random weights
    )
    init: Path | None = None  # initial weights of the whole network


SCENES_VERSION = 5  # increases whenever the same photos would give different scenes
GUESSES_VERSION = 1  # the same for guesses by the same weights
# Keys of LiteData that say where files lie; only the files' names are part of the digest.
PLACES = (
    "photos",
    "stereo",
    "worlds",
    "validation_stereo",
    "validation_worlds",
    "cache",
    "rgbd",
    "teacher",
)
STEREO = "stereo"  # the name of the group of data.validation_stereo


@dataclasses.dataclass(frozen=True)
class LiteFiles:
    """The files of a recipe, sorted; sources without a share are empty."""

    data: LiteData
    photos: Sequence[Path]
    stereo: Sequence[Measured]
    rgbd: Sequence[Measured]
    guessed: Sequence[Path]  # photos for which the teacher makes guesses
    worlds: Sequence[RoomView]
    groups: Sequence[Group]

    @staticmethod
    def of(data: LiteData) -> LiteFiles:
        """Find the files that a recipe names.

        Raises:
            InputError: a folder is missing or has no such files, or there is nothing to train on or
                to validate with.
        """
        shares, groups = data.shares, []
        photos = [] if data.photos is None else find_photo_files(data.photos, "data.photos")
        stereo = [] if data.stereo is None else of_scenes(data.stereo, "data.stereo", right=True)
        rgbd: list[Measured] = []
        for camera in data.rgbd:
            learned, judged = of_camera(camera, data.validation)
            rgbd += learned
            groups.append(Group(camera.folder.resolve().name, judged))
        if data.validation_stereo is not None:
            groups.append(
                Group(STEREO, of_scenes(data.validation_stereo, "data.validation_stereo"))
            )
            _check_apart(
                [file.path for file in stereo],
                [file.path for file in groups[-1].files if isinstance(file, Measured)],
                f"{data.validation_stereo}: data.validation_stereo has scenes of data.stereo",
            )
        rooms: Sequence[RoomView] = ()
        if shares.worlds and data.worlds is not None:
            rooms = of_rooms(data.worlds)
        if data.validation_worlds is not None:
            photos_of_rooms = judged_rooms(data.validation_worlds)
            groups.append(Group("rooms", photos_of_rooms))
            _check_apart(
                [view.archive for view in rooms],
                [room.view.archive for room in photos_of_rooms],
                f"{data.validation_worlds}: data.validation_worlds has rooms of data.worlds",
            )
        if data.teacher is not None and not data.teacher.is_file():
            raise InputError(f"{data.teacher}: no such file, but data.teacher names it")
        files = LiteFiles(
            data,
            photos if shares.made else (),
            stereo if shares.stereo else (),
            rgbd if shares.rgbd else (),
            _spread(photos, data.guesses) if shares.guessed and data.teacher is not None else (),
            rooms,
            _with_own_names([group for group in groups if group.files]),
        )
        if not (files.photos or files.stereo or files.rgbd or files.guessed or files.worlds):
            raise InputError(
                "the recipe has no data: give data.photos=FOLDER, data.rgbd, data.stereo or "
                "data.worlds, and a share above 0"
            )
        if not files.groups:
            raise InputError(
                "the recipe has nothing to judge the network by: give data.rgbd with a share in "
                "data.validation, "
                "scenes as data.validation_stereo=FOLDER, or rooms as data.validation_worlds=FOLDER"
            )
        return files

    @property
    def scenes_digest(self) -> str:
        """Twelve digits that identify the synthetic scenes, whatever the photos' folder and the
        number of scenes.
        """
        return short_digest(
            (SCENES_VERSION, self.data.seed, list(self.data.size), self._below(self.photos))
        )

    @property
    def guesses_digest(self) -> str:
        """Twelve digits that identify the photos and the teacher (or none), wherever the files
        are.
        """
        teacher = self.data.teacher
        weights = (
            hashlib.sha256(teacher.read_bytes()).hexdigest()
            if teacher is not None and self.guessed
            else ""
        )
        return short_digest((GUESSES_VERSION, weights, self._below(self.guessed)))

    def _below(self, files: Sequence[Path]) -> list[str]:
        folder = self.data.photos
        return [] if folder is None else [file.relative_to(folder).as_posix() for file in files]

    @property
    def digest(self) -> str:
        """Twelve digits that identify all training and validation data."""
        facts = self.data.model_dump(mode="json")
        for name in PLACES:
            facts.pop(name)
        names = [
            _names(files)
            for files in (self.stereo, self.rgbd, *(group.files for group in self.groups))
        ]
        rooms = [view.identity for view in self.worlds]
        return short_digest((self.scenes_digest, self.guesses_digest, facts, names, rooms))


def _spread(photos: Sequence[Path], count: int) -> Sequence[Path]:
    """`count` photos, evenly spaced over the folder; all if there are fewer."""
    return (
        [photos[number * len(photos) // count] for number in range(count)]
        if count < len(photos)
        else photos
    )


def _check_apart(learned: Sequence[Path], judged: Sequence[Path], fault: str) -> None:
    """InputError, which begins with `fault`, if a file is used for both training and validation."""
    both = {path.resolve() for path in learned} & {path.resolve() for path in judged}
    if both:
        raise InputError(f"{fault} in it, such as {min(both)}")


def _with_own_names(groups: Sequence[Group]) -> list[Group]:
    """The same groups; if several have one name, the later ones are numbered."""
    named: dict[str, Group] = {}
    for group in groups:
        name, number = group.name, 1
        while name in named:
            number += 1
            name = f"{group.name}-{number}"
        named[name] = dataclasses.replace(group, name=name)
    return list(named.values())


def _names(files: Sequence[Readable]) -> list[tuple[str | float | None, ...]]:
    return [file.identity for file in files]
