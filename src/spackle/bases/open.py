"""Open a base by its settings, and turn photos into Gaussians with it.

`open_base` is the entry; `OpenedBase.predict` shows how a base is chosen for a photo: `auto` tries
the depth in the photo's file, then SHARP, MoGe and lite, if their weights are on this machine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from spackle.bases import Base, BasePrediction
from spackle.bases.depth import RgbdBase
from spackle.bases.lite import LiteBase
from spackle.bases.moge.base import MogeBase
from spackle.bases.settings import (
    AUTO,
    HF_PREFIX,
    NETWORK_BASES,
    PLUGIN_KIND,
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
from spackle.depth.units import RELATIVE_FAR_M, RELATIVE_NEAR_M
from spackle.runtime.device import NotEnoughMemory
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.plugins import load_plugin
from spackle.runtime.progress import Progress

LOG = logging.getLogger("spackle")
LogLine = Callable[[str], None]
StageTimer = Callable[[str], AbstractContextManager[Progress]]  # from a stage's name


@dataclasses.dataclass(frozen=True)
class BaseCandidate:
    """A base that may be used for a photo, in words for reports and the log."""

    title: str
    absence: str = ""  # why it is not used if there is no depth, or no weights, for it


AUTO_CANDIDATES = {  # by their names, the best first
    RGBD: BaseCandidate("the depth in the photo", "no depth in the photo"),
    "sharp": BaseCandidate("SHARP", "no SHARP weights here"),
    "moge": BaseCandidate("MoGe", "no MoGe weights here"),
    "lite": BaseCandidate("lite"),
}
NO_DEPTH_ADVICE = (
    "`base` rgbd needs depth, and the photo has none inside: "
    "give `depth` FILE, or FOLDER for many photos"
)


class BaseError(InputError):
    """The base cannot be used for any photo, so trying another photo is pointless."""


def open_base(settings: BaseSettings) -> OpenedBase:
    """A base whose network is loaded for the first photo; InputError for unsuitable settings."""
    settings.check()
    # The network is loaded by the first photo that needs it.
    if settings.resolved_name == AUTO:
        return OpenedBase(AUTO_CANDIDATES, settings)

    if settings.name != AUTO:
        reason = "chosen by name"
    else:
        reason = "a checkpoint is given" if settings.depth is None else "a depth map is given"
    return OpenedBase({settings.resolved_name: BaseCandidate(reason)}, settings)


def wrap_loaded_base(base: Base) -> OpenedBase:
    """Wrap a base that the calling program has loaded."""
    return OpenedBase({base.name: BaseCandidate("loaded")}, BaseSettings(), {base.name: base})


@contextlib.contextmanager
def _untimed_stage(name: str) -> Iterator[Progress]:
    """A stage of work that nobody times; what is reported to its progress is dropped."""

    def ignore_progress(done: int, total: int) -> None:
        pass

    yield ignore_progress


def _load_network(name: str, settings: BaseSettings) -> Base | None:
    """Load the network of a base; None if its weights are not on this machine."""
    device = None if settings.device == "auto" else settings.device
    # Code of another package runs here, and only for a name that the user gave.
    if settings.kind == PLUGIN_KIND:
        plugin = load_plugin(name, "base")
        with as_input_error(f"`base` {name}", "cannot be opened: {reason}"):
            opened: Base = plugin()
        return opened
    if name.startswith(HF_PREFIX):
        model = name.removeprefix(HF_PREFIX)
        return HfBase.load(model, device=device, precision=settings.precision)
    if name == "lite":
        return LiteBase.load(settings.checkpoint, device=device)

    # Weights of SHARP and MoGe are downloads, and may be missing.
    weights = settings.model_files.get(name)
    if weights is None:
        return None
    if name == "moge":
        return MogeBase.load(weights, device=device, precision=settings.precision)
    return SharpBase.load(
        weights,
        precision=settings.precision,
        windows_per_batch=settings.windows_per_batch,
        device=device,
    )


def _open_rgbd(settings: BaseSettings, photo: Photo, depth: Depth) -> Base | None:
    """The base that lifts a photo by its depth; None if there is no depth.

    The depth is `depth`, else the settings' map, else the map in the photo's file. A focal length
    that the user gives replaces the map's.
    """
    # Depth of this call, then of all calls, then of the file.
    source = settings.depth if depth is None else depth
    if source is None and photo.path.is_file():  # a photo that a program made has no file
        source = load_photo_depth(photo.path)
    if source is None:
        if settings.resolved_name == RGBD:
            raise InputError(
                f"{photo.path}: {NO_DEPTH_ADVICE}; {', '.join(NETWORK_BASES)} need no depth"
            )
        return None

    depth_map = source if isinstance(source, DepthMap) else _read_depth(settings, source, photo)
    if depth_map.K is None or not photo.focal_source.is_from_user:
        return RgbdBase(depth_map)

    map_width = depth_map.depth.shape[1]
    framed_width, _ = photo.framed_size
    focal_px = photo.focal_px * (map_width / framed_width)  # in pixels of the map
    if isinstance(source, DepthMap):
        return RgbdBase(source.with_focal(focal_px), lens_source="")
    # The file is read again, because its disparities become metres by the focal length.
    return RgbdBase(_read_depth(settings, source, photo, focal_px), lens_source="")


def _read_depth(
    settings: BaseSettings, source: Path, photo: Photo, focal_px: float | None = None
) -> DepthMap:
    """Read a photo's depth map from the file, or folder, `source`, as the settings say.

    `focal_px`, in pixels of the map, replaces the focal length of the map's calibration.
    """
    return load_depth(
        find_depth_file(source, photo.path),
        focal_px=focal_px,
        calib=settings.calib,
        kind=settings.depth_kind,
        near=RELATIVE_NEAR_M if settings.near is None else settings.near,
        far=RELATIVE_FAR_M if settings.far is None else settings.far,
    )


@dataclasses.dataclass(frozen=True)
class ResolvedBase:
    """The base that was used for a photo, and why."""

    name: str
    reason: str
    failures: tuple[str, ...] = ()  # name and error of each candidate that failed before
    note: str = ""  # for the user, if `auto` chose this base for the first time
    # False: memory was short for a better base, which may work in the next run.
    lasting: bool = True


@dataclasses.dataclass(frozen=True)
class SkippedCandidate:
    """A candidate that was not used for a photo."""

    reason: str  # such as "no SHARP weights here"
    failure: str = ""  # name and error, if the candidate failed for this very photo
    lacked_memory: bool = False


class OpenedBase:
    """Turns photos into Gaussians.

    A network is loaded when a photo first needs it, and kept for later photos.
    """

    def __init__(
        self,
        candidates: Mapping[str, BaseCandidate],
        settings: BaseSettings,
        loaded: dict[str, Base | None] | None = None,
    ) -> None:
        """Choose among `candidates`, by their names, in their order.

        `loaded` holds networks that are loaded already, by their names; None stands for a network
        whose weights are missing.
        """
        self.candidates = candidates
        self._settings = settings
        self._loaded = {} if loaded is None else loaded
        self._weight_times_ns = {
            file: file.stat().st_mtime_ns
            for file in settings.model_files.values()
            if file.is_file()
        }
        # Candidates that failed in a way that no other photo changes.
        self._unusable: dict[str, SkippedCandidate] = {}
        self._notes_given: set[str] = set()

    def predict(
        self,
        photo: Photo,
        depth: Depth = None,
        *,
        log: LogLine = LOG.warning,
        stage: StageTimer = _untimed_stage,
    ) -> tuple[BasePrediction, ResolvedBase]:
        """A photo's Gaussians by the first candidate that works, and which one it was.

        The candidates are the bases that may be used, the best first.

        Args:
            photo: at its full size.
            depth: this photo's depth, used instead of the settings' depth; for rgbd only.
            log: gets a line for each candidate that fails.
            stage: times the stages "prepare", in which a base is loaded, and "base", in which it
                predicts.

        Raises:
            BaseError: no photo can be used.
            InputError: this photo or its depth cannot be used.
        """
        skipped: list[SkippedCandidate] = []
        for name, candidate in self.candidates.items():
            # It failed before in a way that this photo does not change.
            if name in self._unusable:
                skipped.append(self._unusable[name])
                continue

            base: Base | None = None
            try:
                with stage("prepare"):
                    base = self.load(photo, depth, name)
                if base is None:
                    skipped.append(SkippedCandidate(candidate.absence))
                    continue
                with stage("base") as progress:
                    prediction = _predict_finite(base, photo, progress)
            # A problem of the code is no InputError, and ends the run.
            except InputError as error:
                is_unusable = self._fails_for_every_photo(name, base, error)
                if is_unusable and len(self.candidates) == 1:
                    raise BaseError(str(error)) from error
                # After the last candidate nothing is left to try.
                if name == list(self.candidates)[-1] or isinstance(error, BaseError):
                    raise
                skipped.append(self._skip(name, error, is_unusable))
                log(f"{photo.path.name}: going on without {candidate.title}: {error}")
                continue
            return prediction, self._resolved(name, skipped)
        raise BaseError(f"`base` {self._settings.resolved_name}: its weights are gone: start again")

    def _fails_for_every_photo(self, name: str, base: Base | None, error: InputError) -> bool:
        """Whether a failure of the candidate `name` means that another photo fails, too.

        It does if loading fails (then `base` is None) or memory is short. But a depth map belongs
        to one photo: if it cannot be used, the next photo's may be usable.
        """
        # A base named rgbd that the program loaded has one depth map for all photos.
        serves_all_photos = name != RGBD or name in self._loaded
        return serves_all_photos and (base is None or isinstance(error, NotEnoughMemory))

    def _skip(self, name: str, error: InputError, is_unusable: bool) -> SkippedCandidate:
        """Describe a candidate that failed; if it `is_unusable`, remember it and free its memory.

        `error` is why it failed.
        """
        title = self.candidates[name].title
        skipped = SkippedCandidate(
            reason=f"{title} cannot be used",
            failure=f"{title}: {error}",
            lacked_memory=isinstance(error, NotEnoughMemory),
        )
        if is_unusable:
            self._unusable[name] = dataclasses.replace(skipped, failure="")
            self._loaded.pop(name, None)
        return skipped

    def _resolved(self, name: str, skipped: Sequence[SkippedCandidate]) -> ResolvedBase:
        """Why the candidate `name` was used: the better ones that were skipped, else its title."""
        reasons = [candidate.reason for candidate in skipped]
        reason = ", ".join(reasons) or self.candidates[name].title
        note = f"base {name} ({reason})"
        if name == "lite":
            note += f": {ROUGH_GEOMETRY_ADVICE}"

        # A base that the user named needs no note, and a note is given once.
        is_news = len(self.candidates) > 1 and note not in self._notes_given
        self._notes_given.add(note)
        return ResolvedBase(
            name=name,
            reason=reason,
            failures=tuple(candidate.failure for candidate in skipped if candidate.failure),
            note=note if is_news else "",
            lasting=not any(candidate.lacked_memory for candidate in skipped),
        )

    def load(self, photo: Photo, depth: Depth = None, name: str | None = None) -> Base | None:
        """Load the candidate `name`, or else the first; None without depth or weights.

        InputError if loading fails; BaseError if a file of weights has changed since the start.
        """
        name = name or next(iter(self.candidates))
        # Each photo has its own depth, which is not kept.
        if name == RGBD and name not in self._loaded:
            return _open_rgbd(self._settings, photo, depth)
        if name not in self._loaded:
            self._loaded[name] = _load_network(name, self._settings)
            self._check_weights_unchanged()
        return self._loaded[name]

    def _check_weights_unchanged(self) -> None:
        """BaseError if a file of weights changed, because results before and after would differ."""
        for file, time_ns in self._weight_times_ns.items():
            if not file.is_file() or file.stat().st_mtime_ns != time_ns:
                raise BaseError("a file of weights changed while this was running: start again")

    def only_chosen(self, choice: ResolvedBase) -> OpenedBase:
        """The chosen base for all further photos, such as the frames of a clip, without others."""
        candidates = {choice.name: self.candidates[choice.name]}
        return OpenedBase(candidates, self._settings, self._loaded)


def _predict_finite(base: Base, photo: Photo, progress: Progress) -> BasePrediction:
    """The base's prediction; InputError if one of its Gaussians is infinite or not a number."""
    # A corrupt depth map or focal length shows only here, and would make an unreadable scene.
    prediction = base.predict(photo, progress)
    if not prediction.gaussians.finite:
        raise InputError(
            f"{photo.path}: the base's Gaussians leave the range of float32: "
            "check depth and focal length"
        )
    return prediction
