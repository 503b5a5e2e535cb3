"""What a training run of the lite base is made of: values, and the files that they name."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from depth_loss import DepthLossWeights
from frames import Group, Measured, of_camera, of_scenes
from pydantic import Field

from spackle.bases.lite import STAGES, STRIDE, Size
from spackle.errors import InputError
from spackle.image import PHOTO_SUFFIXES
from spackle.training.recipe import (
    FREE,
    AnyRecipe,
    Count,
    OptimRecipe,
    Place,
    RecipePart,
    RgbdFolder,
    Seed,
    Share,
    Whole,
)
from spackle.training.samples import short_digest
from spackle.training.sources import find_files

RANDOM = Path("random")  # in place of the encoder's file: weights that have seen nothing, for tests and experiments
Side = Annotated[Whole, Field(ge=STRIDE, le=2048, multiple_of=STRIDE)]
Scale = Annotated[float, Field(ge=0.1, le=2)]


class LiteShares(RecipePart):
    """How often a picture comes from each source; they need not add up to 1. One without data counts as 0."""

    made: Share = 0.4
    stereo: Share = 0.28
    rgbd: Share = 0.14
    guessed: Share = 0.18  # where there is a teacher


class LiteData(RecipePart):
    """Where photos with depth come from."""

    photos: Place = None  # a folder, with its subfolders: the surfaces of synthetic scenes are cut from them
    rgbd: Annotated[tuple[RgbdFolder, ...], FREE] = ()  # of these the focal length is not asked for
    stereo: Place = None  # a folder of scenes, each with a scene.json
    made: Count = 4900  # synthetic scenes
    teacher: Path | None = None  # weights of an earlier run: what they guess of `photos` is learned from as well
    guesses: Count = 1500  # of so many photos at most
    shares: LiteShares = LiteShares()
    size: tuple[Side, Side] = (256, 320)  # height and width of what is learned from; a fifth of the steps stand upright
    # Of that, one drawn for each step: the base looks at photos at several sizes.
    scales: Annotated[tuple[Scale, ...], Field(min_length=1)] = (1.0,)
    cache: Place = None  # a folder for synthetic scenes and guesses; inside the output where None
    seed: Seed = 0  # of the synthetic scenes alone, so that runs with other seeds learn from the same ones
    # Share of each folder of `rgbd` that judges, the last frames by name: neighbours look alike.
    validation: Annotated[float, Field(ge=0, le=0.9)] = 0.2
    validation_stereo: Place = None  # scenes to be judged by; those of `stereo` are learned from, all of them


class LiteOptim(OptimRecipe):
    """As for the other methods, and what the encoder, which comes with weights of its own, does otherwise."""

    encoder_rate: Annotated[float, Field(ge=0, le=10)] = 0.2  # factor on the encoder's learning rate
    # The encoder's first stages stay as they are, and its stem with them; 0: all of it learns.
    frozen: Annotated[Whole, Field(ge=0, le=len(STAGES["lite2"]))] = 2


class LiteRecipe(AnyRecipe):
    """All of a training run of the lite base."""

    data: LiteData = LiteData()
    loss: DepthLossWeights = DepthLossWeights()
    optim: LiteOptim = LiteOptim()
    network: Size = "lite2"  # how large the encoder is: EfficientNet-Lite0's or -Lite2's
    encoder: Path | None = None  # its .pth; None: of the installed package; "random": none
    init: Path | None = None  # weights of the whole network to start from


SCENES_VERSION = 5  # goes up whenever the same photos would make other scenes
GUESSES_VERSION = 1  # likewise of guesses by the same weights
STEREO = "stereo"  # the group of data.validation_stereo


@dataclasses.dataclass(frozen=True)
class LiteFiles:
    """Sorted; what has no share is empty."""

    data: LiteData
    photos: Sequence[Path]
    stereo: Sequence[Measured]
    rgbd: Sequence[Measured]
    guessed: Sequence[Path]  # photos that a teacher makes guesses of
    groups: Sequence[Group]

    @staticmethod
    def of(data: LiteData) -> LiteFiles:
        """Look for them.

        Raises:
            InputError: a folder that is missing or without such files; nothing to learn from, or to be judged by.
        """
        shares, groups = data.shares, []
        photos = [] if data.photos is None else find_files(data.photos, "data.photos", PHOTO_SUFFIXES, "photos")
        stereo = [] if data.stereo is None else of_scenes(data.stereo, "data.stereo", right=True)
        rgbd: list[Measured] = []
        for camera in data.rgbd:
            learned, judged = of_camera(camera, data.validation)
            rgbd += learned
            groups.append(Group(camera.folder.resolve().name, judged))
        if data.validation_stereo is not None:
            groups.append(Group(STEREO, of_scenes(data.validation_stereo, "data.validation_stereo")))
            _check_apart(stereo, groups[-1].files, data.validation_stereo)
        if data.teacher is not None and not data.teacher.is_file():
            raise InputError(f"{data.teacher}: no such file, but data.teacher names it")
        files = LiteFiles(
            data,
            photos if shares.made else (),
            stereo if shares.stereo else (),
            rgbd if shares.rgbd else (),
            _spread(photos, data.guesses) if shares.guessed and data.teacher is not None else (),
            _with_own_names([group for group in groups if group.files]),
        )
        if not (files.photos or files.stereo or files.rgbd or files.guessed):
            raise InputError(
                "the recipe has no data: give data.photos=FOLDER, data.rgbd or data.stereo, and a share above 0"
            )
        if not files.groups:
            raise InputError(
                "the recipe has nothing to judge the network by: give data.rgbd with a share in data.validation, "
                "or scenes as data.validation_stereo=FOLDER"
            )
        return files

    @property
    def scenes_digest(self) -> str:
        """Twelve digits: the same for the same scenes, wherever the photos lie and however many are made."""
        return short_digest((SCENES_VERSION, self.data.seed, list(self.data.size), self._below(self.photos)))

    @property
    def guesses_digest(self) -> str:
        """Twelve digits: the same photos and the same teacher, wherever they lie; of no teacher too."""
        teacher = self.data.teacher
        weights = hashlib.sha256(teacher.read_bytes()).hexdigest() if teacher is not None and self.guessed else ""
        return short_digest((GUESSES_VERSION, weights, self._below(self.guessed)))

    def _below(self, files: Sequence[Path]) -> list[str]:
        folder = self.data.photos
        return [] if folder is None else [file.relative_to(folder).as_posix() for file in files]

    @property
    def digest(self) -> str:
        """Twelve digits of all that is learned from and judged by."""
        facts = self.data.model_dump(mode="json")
        for name in ("photos", "stereo", "validation_stereo", "cache", "rgbd", "teacher"):
            facts.pop(name)
        names = [_names(files) for files in (self.stereo, self.rgbd, *(group.files for group in self.groups))]
        return short_digest((self.scenes_digest, self.guesses_digest, facts, names))


def _spread(photos: Sequence[Path], count: int) -> Sequence[Path]:
    """So many of them, from all over the folder; all where there are no more."""
    return [photos[number * len(photos) // count] for number in range(count)] if count < len(photos) else photos


def _check_apart(learned: Sequence[Measured], judged: Sequence[Measured], folder: Path) -> None:
    """InputError where a scene is in both."""
    if both := {file.path.resolve() for file in learned} & {file.path.resolve() for file in judged}:
        raise InputError(f"{folder}: data.validation_stereo has scenes of data.stereo in it, such as {min(both)}")


def _with_own_names(groups: Sequence[Group]) -> list[Group]:
    """The same groups; where two have one name, the later ones are numbered."""
    named: dict[str, Group] = {}
    for group in groups:
        name, number = group.name, 1
        while name in named:
            number += 1
            name = f"{group.name}-{number}"
        named[name] = dataclasses.replace(group, name=name)
    return list(named.values())


def _names(files: Sequence[Measured]) -> list[tuple[str, float | None, bool]]:
    return [(file.path.name, file.unit_m, file.right) for file in files]
