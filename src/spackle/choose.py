"""Which base a photo gets where nobody has named one: the best that the photo and this machine have.

That is the depth in the photo's file, else SHARP where its weights are, else lite. What is there but cannot be used
is passed over, and that is said.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from spackle.bases.depth_maps import DepthMap
from spackle.bases.device import MemoryShort
from spackle.bases.lite.base import LiteBase
from spackle.bases.photo_depth import load_photo_depth
from spackle.bases.protocol import Base, BasePrediction, Progress
from spackle.bases.rgbd import RgbdBase
from spackle.bases.sharp import SharpBase
from spackle.downloads import check_recorded, installed
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.image import Photo
from spackle.precision import Precision

ROUGH = (
    "rough geometry; for better: --depth FILE, `spackle weights get sharp` (research only), "
    "or --base hf:depth-anything/Depth-Anything-V2-Small-hf"
)
Say = Callable[[str], None]
Load = Callable[[], Base]


class BaseError(InputError):
    """The base of all photos cannot be used, so there is no point in trying another photo, or another base."""


@dataclasses.dataclass(frozen=True)
class Choice:
    """Which base a photo got, and why."""

    base: str
    why: str
    passed_over: tuple[str, ...] = ()  # what was there but could not be used, and how that showed
    lasting: bool = True  # False: memory was short, so the same files may get another base the next time

    @property
    def line(self) -> str:
        """For people, with what would be better."""
        return f"base {self.base} ({self.why})" + (f": {ROUGH}" if self.base == LiteBase.name else "")


@dataclasses.dataclass
class Way:
    """One way from a photo to Gaussians."""

    what: str  # it goes by
    find: Callable[[Photo], Base | None]  # None: there is no such thing
    lack: str = ""  # what is said then
    shared: bool = True  # by all photos: if it fails for one, it fails for all
    short: bool = False  # of memory, the last time

    def give_up(self, error: InputError) -> None:
        """Let no other photo fail in the same way; this frees what has been loaded, too."""
        if self.shared:
            self.find, self.lack = _nothing, f"{self.what} cannot be used"
            self.short = isinstance(error, MemoryShort)


class Search:
    """The first way that has what a photo takes, and does not fail."""

    def __init__(self, photo: Photo, ways: Sequence[Way], say: Say) -> None:
        """`photo` at its full size; `ways` begin with the best; `say` is told of each that fails, in a line."""
        self._photo, self._ways, self._say = photo, list(ways), say
        self._lacks: list[str] = []
        self._passed: list[str] = []
        self._short = False
        self._base: Base | None = None

    def load(self) -> Base:
        """A base that is ready.

        Raises:
            InputError: not even the last way has one.
        """
        while self._base is None:
            way = self._ways[0]
            try:
                self._base = way.find(self._photo)
            except InputError as error:
                self._pass_over(error, for_good=True)
                continue
            if self._base is None:
                self._next(way.lack, way.short)
        return self._base

    def predict(self, progress: Progress | None = None) -> tuple[BasePrediction, Choice]:
        """The photo's Gaussians by the first way that does not fail.

        Raises:
            InputError: not even the last way gives any.
        """
        while True:
            base = self.load()
            try:
                prediction = finite_prediction(base, self._photo, progress)
            except InputError as error:
                # What is wrong with one photo need not be so with another.
                self._pass_over(error, for_good=isinstance(error, MemoryShort))
                continue
            why = ", ".join(self._lacks) or self._ways[0].what
            return prediction, Choice(base.name, why, tuple(self._passed), not self._short)

    def _pass_over(self, error: InputError, *, for_good: bool) -> None:
        """Go on with the next way, for other photos too where it is for good; raise the error where there is none."""
        if isinstance(error, BaseError) or len(self._ways) == 1:
            raise error
        way = self._ways[0]
        if for_good:
            way.give_up(error)
        self._say(f"{self._photo.path.name}: going on without {way.what}: {error}")
        self._passed.append(f"{way.what}: {error}")
        self._next(f"{way.what} cannot be used", isinstance(error, MemoryShort))

    def _next(self, lack: str, short: bool) -> None:
        self._base = None
        self._lacks.append(lack)
        self._short |= short
        del self._ways[0]


class Auto:
    """The ways of `--base auto`, for any number of photos; networks are loaded with the first photo that needs them."""

    def __init__(self, sharp: Load | None, lite: Load) -> None:
        """How to load the two; `sharp` is None where its weights are not on this machine."""
        self._ways = (
            Way("the depth in the photo", by_own_depth, "no depth in the photo", shared=False),
            Way("SHARP", _nothing if sharp is None else _once(sharp), "no SHARP weights here"),
            Way(LiteBase.name, _once(lite)),
        )
        self._said: set[str] = set()

    def search(self, photo: Photo, say: Say) -> Search:
        """For the best base of a photo."""
        return Search(photo, self._ways, say)

    def news(self, choice: Choice) -> str:
        """What there is to say about a choice; nothing where it has been said of another photo."""
        line = "" if choice.line in self._said else choice.line
        self._said.add(choice.line)
        return line


def auto_here() -> Auto:
    """The ways of this machine, with downloaded weights and no wishes of anybody."""
    path = sharp_here()
    return Auto(None if path is None else functools.partial(load_sharp, path), LiteBase.load)


def sharp_here() -> Path | None:
    """SHARP's downloaded weights; None also on a machine without a place for any."""
    try:
        return installed("sharp")
    except InputError:
        return None


def load_sharp(
    path: str | os.PathLike[str],
    *,
    precision: Precision = "auto",
    low_memory: bool = False,
    windows: int | None = None,
    compiled: bool = False,
    device: str | None = None,
) -> SharpBase:
    """SHARP as `SharpBase.load` has it; a download is held to its record first."""
    check_recorded(path)  # where there is a record
    return SharpBase.load(
        path, precision=precision, low_memory=low_memory, windows=windows, compiled=compiled, device=device
    )


class OwnDepthBase(RgbdBase):
    """Lifts a photo by the depth map in its own file."""

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """As `RgbdBase` does; the report learns what kind of map it was."""
        prediction = super().predict(photo, progress)
        lens = "the photo's depth" if prediction.lens_source else ""
        return dataclasses.replace(prediction, notes={**prediction.notes, "depth": self.depth.note}, lens_source=lens)


def by_own_depth(photo: Photo) -> OwnDepthBase | None:
    """A base for this photo alone, by the depth in its file; None where there is none.

    Raises:
        InputError: a depth map that cannot be used.
    """
    depth = depth_inside(photo)
    return None if depth is None else OwnDepthBase(depth)


def depth_inside(photo: Photo) -> DepthMap | None:
    """The depth that a photo's file carries, with the photo's lens where a person gave that; None where there is none.

    Raises:
        InputError: a depth map that is broken, or of another shape than the photo.
    """
    if not photo.path.is_file():  # made by a program
        return None
    depth = load_photo_depth(photo.path)
    if depth is None:
        return None
    depth.check_shape(photo.height, photo.width, photo.path)
    by_hand = photo.focal_source.startswith("--")  # a person's word beats the file's
    return dataclasses.replace(depth, K=None) if by_hand else depth


def finite_prediction(base: Base, photo: Photo, progress: Progress | None = None) -> BasePrediction:
    """What a base makes of a photo.

    Raises:
        InputError: as the base does, or where its numbers are too large.
    """
    prediction = base.predict(photo, progress)
    if not all_finite(prediction.gaussians):
        raise InputError(f"{photo.path}: the base's Gaussians leave the range of float32: check depth and focal length")
    return prediction


def all_finite(gaussians: Gaussians) -> bool:
    """Whether every number of theirs is one."""
    return all(bool(torch.isfinite(tensor).all()) for tensor in gaussians.tensors)


def _once(load: Load) -> Callable[[Photo], Base]:
    """The same base for each photo."""
    loaded = functools.cache(load)
    return lambda photo: loaded()


def _nothing(photo: Photo) -> None:
    return None
