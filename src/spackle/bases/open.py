"""Open a base by its settings, and turn photos into Gaussians with it.

`auto` tries the depth in the photo's file, then SHARP, MoGe and lite, if their weights are on this machine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import logging
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager

from spackle.bases import Base, BasePrediction
from spackle.bases.depth import RgbdBase
from spackle.bases.lite import LiteBase
from spackle.bases.moge.base import MogeBase
from spackle.bases.settings import (
    AUTO,
    HF_PREFIX,
    NETWORK_BASES,
    RGBD,
    ROUGH_GEOMETRY_ADVICE,
    BaseSettings,
    Depth,
)
from spackle.bases.sharp.base import SharpBase
from spackle.bases.transformers import HfBase
from spackle.core.photo import Photo
from spackle.depth.depth_map import DepthMap
from spackle.depth.in_photo.layouts import load_photo_depth
from spackle.depth.readers import find_depth_file, load_depth
from spackle.runtime.device import NotEnoughMemory
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Progress

LOG = logging.getLogger("spackle")
Log = Callable[[str], None]
Stage = Callable[[str], AbstractContextManager[Progress]]
UNTIMED: Stage = lambda name: contextlib.nullcontext(lambda done, total: None)  # noqa: E731
AUTO_CANDIDATES = {  # candidates of `auto`: the name in reports and the log, and the reason that is given if it is missing
    RGBD: ("the depth in the photo", "no depth in the photo"),
    "sharp": ("SHARP", "no SHARP weights here"),
    "moge": ("MoGe", "no MoGe weights here"),
    "lite": ("lite", ""),
}
NO_DEPTH_ADVICE = "--base rgbd needs depth, and the photo has none inside: give --depth FILE, or FOLDER for many photos"


class BaseError(InputError):
    """The base cannot be used for any photo, so trying another photo is pointless."""


def open_base(settings: BaseSettings) -> OpenedBase:
    """A base by its settings, whose network is loaded for the first photo; InputError for unsuitable settings."""
    settings.check()
    why = (
        f"--base {settings.resolved_name}"
        if settings.name != AUTO
        else "--depth"
        if settings.depth is not None
        else "-c"
    )
    return OpenedBase(
        AUTO_CANDIDATES if settings.resolved_name == AUTO else {settings.resolved_name: (why, "")},
        settings,
        {},
    )


def wrap_loaded_base(base: Base) -> OpenedBase:
    """Wrap a base that the calling program has loaded."""
    return OpenedBase({base.name: ("loaded", "")}, BaseSettings(), {base.name: base})


def _load_network(name: str, settings: BaseSettings) -> Base | None:
    """Load the network of a base; None if its weights are not on this machine."""
    device, precision = None if settings.device == "auto" else settings.device, settings.precision
    if name.startswith(HF_PREFIX):
        return HfBase.load(name.removeprefix(HF_PREFIX), device=device, precision=precision)
    if name == "lite":
        return LiteBase.load(settings.checkpoint, device=device)
    if (file := settings.model_files.get(name)) is None:
        return None
    if name == "moge":
        return MogeBase.load(file, device=device, precision=precision)
    return SharpBase.load(
        file, precision=precision, windows_per_batch=settings.windows_per_batch, device=device
    )


def _lift(settings: BaseSettings, photo: Photo, depth: Depth) -> Base | None:
    """The base that lifts a photo by its depth: `depth`, else the settings' map, else the map in the photo's file.

    None if there is no depth. A focal length that the user gives replaces the map's.
    """
    source = settings.depth if depth is None else depth
    if source is None and photo.path.is_file():  # a photo that a program made has no file
        source = load_photo_depth(photo.path)
    if source is None:
        if settings.resolved_name == RGBD:
            raise InputError(
                f"{photo.path}: {NO_DEPTH_ADVICE}; {', '.join(NETWORK_BASES)} need no depth"
            )
        return None
    if isinstance(source, DepthMap):
        found, read = source, None
    else:
        ends = {
            name: end
            for name, end in (("near", settings.near), ("far", settings.far))
            if end is not None
        }
        file = find_depth_file(source, photo.path)
        read = functools.partial(
            load_depth, file, calib=settings.calib, kind=settings.depth_kind, **ends
        )
        found = read()
    if found.K is None or not photo.focal_source.is_from_user:
        return RgbdBase(found)
    focal = photo.focal_px * (found.depth.shape[1] / photo.framed_size[0])
    return RgbdBase(read(focal_px=focal) if read else found.with_focal(focal), "")


@dataclasses.dataclass(frozen=True)
class ResolvedBase:
    """The base that was used for a photo, and why."""

    base: str
    why: str
    failures: tuple[str, ...] = ()  # name and error of each candidate that failed before
    note: str = ""  # for the user, if `auto` chose this base for the first time
    lasting: bool = (
        True  # False: memory was short for a better base, which may work in the next run
    )


class OpenedBase:
    """Turns photos into Gaussians. A network is loaded when a photo first needs it, and kept for later photos."""

    def __init__(
        self,
        candidates: Mapping[str, tuple[str, str]],
        settings: BaseSettings,
        loaded: dict[str, Base | None],
    ) -> None:
        """`candidates` are tried in their order (see `AUTO_CANDIDATES`); `loaded` maps names to networks already loaded."""
        self.candidates, self._settings, self._loaded = candidates, settings, loaded
        self._times = {
            file: file.stat().st_mtime_ns
            for file in settings.model_files.values()
            if file.is_file()
        }
        # Candidates that no photo can use: the reason, and whether memory was short.
        self._failed: dict[str, tuple[str, bool]] = {}
        self._notes: set[str] = set()  # given for earlier photos

    def predict(
        self, photo: Photo, depth: Depth = None, *, log: Log = LOG.warning, stage: Stage = UNTIMED
    ) -> tuple[BasePrediction, ResolvedBase]:
        """A photo's Gaussians by the first candidate that works.

        InputError if this photo or its depth cannot be used; BaseError if no photo can be used.

        Args:
            photo: at its full size.
            depth: this photo's depth, used instead of the settings' depth; for rgbd only.
            log: gets a line for each candidate that fails.
            stage: times the stages "prepare", in which a base is loaded, and "base", in which it predicts.
        """
        reasons, failures = list[tuple[str, bool]](), list[str]()
        for name, (title, absence) in self.candidates.items():
            base: Base | None = None
            try:
                if name not in self._failed:
                    with stage("prepare"):
                        base = self.load(photo, depth, name)
                if base is None:
                    reasons.append(self._failed.get(name, (absence, False)))
                    continue
                with stage("base") as progress:
                    prediction = base.predict(photo, progress)
                if not prediction.gaussians.finite:
                    problem = "the base's Gaussians leave the range of float32: check depth and focal length"
                    raise InputError(f"{photo.path}: {problem}")
                break
            except InputError as error:
                shared = name != RGBD or name in self._loaded
                for_good = shared and (
                    base is None or isinstance(error, NotEnoughMemory)
                )  # another photo does not help
                if for_good and len(self.candidates) == 1:
                    raise BaseError(str(error)) from error
                if name == list(self.candidates)[-1] or isinstance(error, BaseError):
                    raise
                reasons.append((f"{title} cannot be used", isinstance(error, NotEnoughMemory)))
                failures.append(f"{title}: {error}")
                log(f"{photo.path.name}: going on without {title}: {error}")
                if for_good:
                    self._failed[name] = reasons[-1]
                    self._loaded.pop(name, None)  # frees its memory
        why = ", ".join(reason for reason, _ in reasons) or title
        lasting = not any(short for _, short in reasons)
        note = f"base {name} ({why})" + (f": {ROUGH_GEOMETRY_ADVICE}" if name == "lite" else "")
        new = len(self.candidates) > 1 and note not in self._notes
        self._notes.add(note)
        return prediction, ResolvedBase(name, why, tuple(failures), note if new else "", lasting)

    def load(self, photo: Photo, depth: Depth = None, name: str | None = None) -> Base | None:
        """Load the candidate `name`, or else the first; None without depth or weights, InputError if loading fails."""
        name = name or next(iter(self.candidates))
        if name == RGBD and name not in self._loaded:
            return _lift(self._settings, photo, depth)
        if name not in self._loaded:
            self._loaded[name] = _load_network(name, self._settings)
            if any(
                not file.is_file() or file.stat().st_mtime_ns != time
                for file, time in self._times.items()
            ):
                raise BaseError("a file of weights changed while this was running: start again")
        return self._loaded[name]

    def only_chosen(self, choice: ResolvedBase) -> OpenedBase:
        """The chosen base for all further photos, such as the frames of a clip, without a fallback."""
        return OpenedBase({choice.base: self.candidates[choice.base]}, self._settings, self._loaded)
