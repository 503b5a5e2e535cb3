"""The one path from a base's settings to a photo's Gaussians.

`auto` tries the depth in the photo's file, then SHARP and Depth Anything if their weights are installed, then lite. It
falls back to the next candidate when one fails, and logs why. The focal length comes from the user, else from the depth
map's calibration, else from the photo's file, else it is the default.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from spackle.bases import lite
from spackle.bases.depth_map import DepthMap, find_depth, load_depth
from spackle.bases.hf import HfBase
from spackle.bases.lift import RgbdBase
from spackle.bases.photo_depth.layouts import load_photo_depth
from spackle.bases.protocol import Base, BasePrediction, Progress
from spackle.bases.settings import AUTO, HF, MISSING, NETWORKS, RGBD, ROUGH, BaseSettings, Depth
from spackle.bases.sharp.base import SharpBase
from spackle.device import MemoryShort
from spackle.errors import InputError
from spackle.files import fingerprint
from spackle.image import Photo
from spackle.weights import check_undamaged

LOG = logging.getLogger("spackle")
Log = Callable[[str], None]
Load = Callable[[Photo, Depth], Base | None]  # None: this photo or this machine has none
Stage = Callable[[str], AbstractContextManager[Progress]]
NO_DEPTH = (
    "--base rgbd needs depth, and there is none in the photo: give --depth FILE, or --depth FOLDER for many photos"
)
ORDER = {  # of `auto`: the candidate's title, and the reason to go on without it
    RGBD: ("the depth in the photo", "no depth in the photo"),
    "sharp": ("SHARP", "no SHARP weights here"),
    "depth": ("Depth Anything", "no Depth Anything here"),
    "lite": ("lite", ""),
}


class BaseError(InputError):
    """The base of all photos cannot be used: trying another photo or another base is pointless."""


@dataclasses.dataclass
class Candidate:
    """A base that photos may get."""

    name: str
    title: str  # in reports and the log
    load: Load
    absence: str = ""  # the reason to go on when there is none
    shared: bool = True  # by all photos: if it cannot be loaded for one, it cannot for any
    short: bool = False  # of memory, the last time


def open_base(settings: BaseSettings) -> OpenedBase:
    """A base by its settings; networks are loaded when the first photo needs them.

    InputError for an option that the base cannot use, or a missing file.
    """
    settings.check()
    files, named = settings.files, settings.named
    prints = {name: fingerprint(file, "file of weights") for name, file in files.items()}

    def candidate(name: str, title: str, absence: str = "") -> Candidate:
        if name == RGBD:
            return Candidate(name, title, functools.partial(_lift, settings), absence, shared=False)
        load = functools.cache(functools.partial(_load_network, name, settings, files, prints))
        return Candidate(name, title, lambda photo, depth: load(), absence)

    if named == AUTO:
        return OpenedBase([candidate(name, *words) for name, words in ORDER.items()], prints)
    why = f"--base {named}" if settings.name != AUTO else "--depth" if settings.depth is not None else "-c"
    return OpenedBase([candidate(named, why)], prints)


def open_loaded(base: Base) -> OpenedBase:
    """A base that a program has loaded."""
    return OpenedBase([Candidate(base.name, "loaded", lambda photo, depth: base)], {})


def _load_network(
    name: str, settings: BaseSettings, files: Mapping[str, Path], prints: Mapping[str, str]
) -> Base | None:
    """A network, None if it is not installed; BaseError if its files have changed since the base was opened."""
    device, precision = None if settings.device == "auto" else settings.device, settings.precision
    file = files.get(name)
    if name in MISSING and file is not None:
        check_undamaged(file)
    base: Base
    if name.startswith(HF):
        base = HfBase.load(name.removeprefix(HF), device=device, precision=precision)
    elif name == "lite":
        base = lite.LiteBase.load(settings.checkpoint, device=device)
    elif file is None:
        return None
    elif name == "depth":
        base = HfBase.load(str(file.parent), device=device, precision=precision, name=name)
    else:
        speed: dict[str, Any] = {"windows": settings.windows, "compiled": settings.compiled}
        base = SharpBase.load(file, precision=precision, device=device, **speed)
    if {name: fingerprint(file, "file of weights") for name, file in settings.files.items()} != prints:
        raise BaseError(f"{', '.join(map(str, files.values()))}: changed while this was running: start again")
    return base


def _lift(settings: BaseSettings, photo: Photo, depth: Depth) -> Base | None:
    """Lifts by the depth of this call, the settings or the photo. The user's focal length replaces the map's."""
    source = settings.depth if depth is None else depth
    if source is None and photo.path.is_file():  # a photo that a program made has no file
        source = load_photo_depth(photo.path)
    if source is None:
        if settings.named == RGBD:
            raise InputError(f"{photo.path}: {NO_DEPTH}; {', '.join(NETWORKS)} need none")
        return None
    if isinstance(source, DepthMap):
        found, read = source, None
    else:
        read = functools.partial(load_depth, find_depth(source, photo.path), calib=settings.calib)
        found = read()
    width, height = photo.framed_size
    found.check_shape(height, width, photo.path)
    if found.K is None or not photo.focal_source.startswith("--"):  # an option of the command line
        return RgbdBase(found, "the photo's depth" if found.note else "calibration")
    focal = photo.focal_px * (found.depth.shape[1] / width)
    return RgbdBase(read(focal_px=focal) if read else found.with_focal(focal), "")


@dataclasses.dataclass(frozen=True)
class ResolvedBase:
    """The base that a photo got, and why."""

    base: str
    why: str
    failures: tuple[str, ...] = ()  # of better candidates: which one, and its error
    lasting: bool = True  # False: memory was short, so the same files may get another base next time
    note: str = ""  # for the user, if `auto` chose and made another choice for earlier photos


@contextlib.contextmanager
def _untimed(stage: str) -> Iterator[Progress]:
    yield lambda done, total: None


class OpenedBase:
    """Turns photos into Gaussians. The first photo that needs a network loads it for all others."""

    def __init__(self, candidates: list[Candidate], fingerprints: Mapping[str, str]) -> None:
        self.candidates, self.fingerprints = candidates, fingerprints
        self.notes: set[str] = set()  # on earlier photos' choices

    def predict(
        self, photo: Photo, depth: Depth = None, *, log: Log = LOG.warning, stage: Stage = _untimed
    ) -> tuple[BasePrediction, ResolvedBase]:
        """A photo's Gaussians by the first candidate that works.

        Args:
            photo: at its full size.
            depth: of this photo, in place of the settings'; for rgbd only.
            log: gets a line for each candidate that fails.
            stage: times the stages "prepare", in which a base is loaded, and "base", in which it predicts.

        Raises:
            InputError: this photo or its depth cannot be used.
            BaseError: no photo can be worked on.
        """
        reasons, failures, lasting = list[str](), list[str](), True
        with contextlib.ExitStack() as stages:
            stages.enter_context(stage("prepare"))
            for candidate in self.candidates:
                base = None
                try:
                    if (base := candidate.load(photo, depth)) is None:
                        reasons.append(candidate.absence)
                        lasting &= not candidate.short
                        continue
                    stages.close()
                    prediction = base.predict(photo, stages.enter_context(stage("base")))
                    if not prediction.gaussians.finite:
                        problem = "the base's Gaussians leave the range of float32: check depth and focal length"
                        raise InputError(f"{photo.path}: {problem}")
                    break
                except InputError as error:
                    short = isinstance(error, MemoryShort)
                    for_good = candidate.shared and (base is None or short)  # another photo does not help
                    if for_good and len(self.candidates) == 1:
                        raise BaseError(str(error)) from error
                    if candidate is self.candidates[-1] or isinstance(error, BaseError):
                        raise
                    reasons.append(f"{candidate.title} cannot be used")
                    failures.append(f"{candidate.title}: {error}")
                    lasting &= not short
                    log(f"{photo.path.name}: going on without {candidate.title}: {error}")
                    if for_good:  # frees a loaded network, too
                        candidate.load, candidate.absence, candidate.short = (
                            lambda photo, depth: None,
                            reasons[-1],
                            short,
                        )
        why = ", ".join(reasons) or candidate.title
        note = f"base {candidate.name} ({why})" + (f": {ROUGH}" if candidate.name == "lite" else "")
        new = len(self.candidates) > 1 and note not in self.notes
        self.notes.add(note)
        return prediction, ResolvedBase(candidate.name, why, tuple(failures), lasting, note if new else "")

    def load(self, photo: Photo) -> Base:
        """The base that a person named, before its first prediction; raises as `predict` does."""
        (candidate,) = self.candidates
        try:
            base = candidate.load(photo, None)
        except InputError as error:
            raise (BaseError(str(error)) if candidate.shared else error) from error
        assert base is not None
        return base

    def only(self, choice: ResolvedBase) -> OpenedBase:
        """The chosen base for all further photos, such as the frames of a clip, without a fallback."""
        return OpenedBase([c for c in self.candidates if c.name == choice.base], self.fingerprints)
