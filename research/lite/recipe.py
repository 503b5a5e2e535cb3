"""The recipe of a training run of the lite base, and the recipe's files."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from depth_loss import DepthLossWeights
from frames import Group, Measured, of_camera, of_scenes
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

    # A folder of photos, with its subfolders. Textures of synthetic scenes are cut from them.
    photos: OptionalPath = None
    # Folders of depth cameras; their focal lengths are not used.
    rgbd: Annotated[tuple[RgbdFolder, ...], MAY_CHANGE_ON_RESUME] = ()
    stereo: OptionalPath = None  # a folder of scenes, each with a scene.json
    worlds: OptionalPath = None  # a folder of furnished rooms, made by research/worlds
    made: Count = 4900  # number of synthetic scenes
    # Weights of an earlier run; what this network guesses of `photos` becomes training data.
    teacher: Path | None = None
    guesses: Count = 1500  # at most so many photos get guesses
    shares: LiteShares = LiteShares()
    # Height and width of pictures; swapped in a fifth of the steps.
    size: tuple[Side, Side] = (256, 320)
    # Factors on `size`; each step draws one, because the base uses several sizes.
    scales: Annotated[tuple[Scale, ...], Field(min_length=1)] = (1.0,)
    cache: OptionalPath = None  # a folder for synthetic scenes and guesses; None: inside the output
    seed: Seed = 0  # for synthetic scenes alone: runs that differ only in run.seed share them
    # Share of each folder of `rgbd` for validation: the last frames by name, because neighbouring
    # frames are alike.
    validation: Annotated[float, Field(ge=0, le=0.9)] = 0.2
    # Scenes for validation; all scenes of `stereo` are for training.
    validation_stereo: OptionalPath = None
    # Furnished rooms for validation; all rooms of `worlds` are for training.
    validation_worlds: OptionalPath = None


class LiteOptim(OptimRecipe):
    """Settings of the optimiser, and of the pretrained encoder."""

    # Factor on the encoder's learning rate.
    encoder_rate: Annotated[float, Field(ge=0, le=10)] = 0.2
    # How many of the encoder's first stages are frozen, with its stem; 0: nothing is frozen.
    frozen: Annotated[int, Field(ge=0, le=len(STAGES["lite2"]))] = 2


class LiteRecipe(AnyRecipe):
    """The recipe of a training run of the lite base."""

    data: LiteData = LiteData()
    loss: DepthLossWeights = DepthLossWeights()
    optim: LiteOptim = LiteOptim()
    network: EncoderSize = "lite2"  # size of the encoder: EfficientNet-Lite0 or -Lite2
    # The encoder's .pth file. None: from the installed package; "random": random weights.
    encoder: Path | None = None
    init: Path | None = None  # initial weights of the whole network


SCENES_VERSION = 5  # increases whenever the same photos would give different scenes
GUESSES_VERSION = 1  # increases whenever the same photos and weights would give different guesses
# Keys of LiteData that say where files lie. They are no part of the digest; the files' names are.
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
    photos: Sequence[Path]  # from which textures of synthetic scenes are cut
    stereo: Sequence[Measured]
    rgbd: Sequence[Measured]
    photos_to_guess: Sequence[Path]  # photos whose depth the teacher guesses
    worlds: Sequence[RoomView]
    groups: Sequence[Group]  # for validation

    @staticmethod
    def of(data: LiteData) -> LiteFiles:
        """Find the files that a recipe names.

        Raises:
            InputError: a folder is missing or has no such files, or there is nothing to train on or
                to validate with.
        """
        shares = data.shares
        groups: list[Group] = []
        photos = [] if data.photos is None else find_photo_files(data.photos, "data.photos")
        stereo = [] if data.stereo is None else of_scenes(data.stereo, "data.stereo", right=True)
        rgbd: list[Measured] = []
        for camera in data.rgbd:
            training_frames, validation_frames = of_camera(camera, data.validation)
            rgbd += training_frames
            groups.append(Group(camera.folder.resolve().name, validation_frames))
        if data.validation_stereo is not None:
            validation_photos = of_scenes(data.validation_stereo, "data.validation_stereo")
            groups.append(Group(STEREO, validation_photos))
            _check_apart(
                [photo.path for photo in stereo],
                [photo.path for photo in validation_photos],
                f"{data.validation_stereo}: data.validation_stereo has scenes of data.stereo",
            )
        rooms: Sequence[RoomView] = ()
        if shares.worlds and data.worlds is not None:
            rooms = of_rooms(data.worlds)
        if data.validation_worlds is not None:
            validation_rooms = judged_rooms(data.validation_worlds)
            groups.append(Group("rooms", validation_rooms))
            _check_apart(
                [view.archive for view in rooms],
                [room.view.archive for room in validation_rooms],
                f"{data.validation_worlds}: data.validation_worlds has rooms of data.worlds",
            )
        if data.teacher is not None and not data.teacher.is_file():
            raise InputError(f"{data.teacher}: no such file, but data.teacher names it")
        photos_to_guess: Sequence[Path] = ()
        if shares.guessed and data.teacher is not None:
            photos_to_guess = _spread(photos, data.guesses)
        files = LiteFiles(
            data=data,
            photos=photos if shares.made else (),
            stereo=stereo if shares.stereo else (),
            rgbd=rgbd if shares.rgbd else (),
            photos_to_guess=photos_to_guess,
            worlds=rooms,
            groups=_with_own_names([group for group in groups if group.files]),
        )
        sources = (files.photos, files.stereo, files.rgbd, files.photos_to_guess, files.worlds)
        if not any(sources):
            raise InputError(
                "the recipe has no data: give data.photos=FOLDER, data.rgbd, data.stereo or "
                "data.worlds, and a share above 0"
            )
        if not files.groups:
            raise InputError(
                "the recipe has nothing to judge the network by: give data.rgbd with a share in "
                "data.validation, scenes as data.validation_stereo=FOLDER, or rooms as "
                "data.validation_worlds=FOLDER"
            )
        return files

    @property
    def scenes_digest(self) -> str:
        """Twelve digits that identify the synthetic scenes.

        They depend neither on where the photos' folder lies nor on the number of scenes.
        """
        photo_names = self._names_in_photos_folder(self.photos)
        return short_digest((SCENES_VERSION, self.data.seed, list(self.data.size), photo_names))

    @property
    def guesses_digest(self) -> str:
        """Twelve digits that identify what the teacher guesses: its weights, and the photos.

        They do not depend on where these files lie.
        """
        weights_digest = ""  # without guesses
        if self.data.teacher is not None and self.photos_to_guess:
            weights_digest = hashlib.sha256(self.data.teacher.read_bytes()).hexdigest()
        photo_names = self._names_in_photos_folder(self.photos_to_guess)
        return short_digest((GUESSES_VERSION, weights_digest, photo_names))

    def _names_in_photos_folder(self, photos: Sequence[Path]) -> list[str]:
        """The photos' paths relative to the folder `data.photos`, which holds them all."""
        folder = self.data.photos
        return [] if folder is None else [photo.relative_to(folder).as_posix() for photo in photos]

    @property
    def digest(self) -> str:
        """Twelve digits that identify all training and validation data."""
        settings = self.data.model_dump(mode="json")
        for name in PLACES:
            settings.pop(name)
        frame_lists = (self.stereo, self.rgbd, *(group.files for group in self.groups))
        frames = [[frame.identity for frame in frame_list] for frame_list in frame_lists]
        rooms = [view.identity for view in self.worlds]
        return short_digest((self.scenes_digest, self.guesses_digest, settings, frames, rooms))


def _spread(photos: Sequence[Path], count: int) -> Sequence[Path]:
    """`count` photos, evenly spaced over the folder; all if there are fewer."""
    if count >= len(photos):
        return photos
    return [photos[number * len(photos) // count] for number in range(count)]


def _check_apart(training: Sequence[Path], validation: Sequence[Path], fault: str) -> None:
    """InputError, which begins with `fault`, if a file is used for both training and validation."""
    shared = {path.resolve() for path in training} & {path.resolve() for path in validation}
    if shared:
        raise InputError(f"{fault} in it, such as {min(shared)}")


def _with_own_names(groups: Sequence[Group]) -> list[Group]:
    """The same groups; if several have one name, the later ones are numbered from 2 on."""
    named: dict[str, Group] = {}
    for group in groups:
        name = group.name
        number = 1
        while name in named:
            number += 1
            name = f"{group.name}-{number}"
        named[name] = dataclasses.replace(group, name=name)
    return list(named.values())
