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
from spackle.bases.depth_order import CLEAR_CORRELATION, depth_order_agreement
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
    load_base_class,
)
from spackle.bases.sharp.base import SharpBase
from spackle.bases.transformers import HfBase
from spackle.core.photo import Photo, resize_rgb
from spackle.depth.depth_map import DepthMap
from spackle.depth.in_photo.layouts import load_photo_depth
from spackle.depth.readers import DepthValue, find_depth_file, load_depth
from spackle.depth.units import (
    RELATIVE_FAR_M,
    RELATIVE_NEAR_M,
    UNIT_ADVICE,
    DepthKind,
    UnclearDepth,
)
from spackle.runtime.errors import InputError, NotEnoughMemory, as_input_error
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
    """Check a base's settings, and wrap the base for predictions.

    Its network is loaded when the first photo needs it. InputError for unsuitable settings.
    """
    settings.check()
    # The settings leave the choice open. So each photo gets the best base that is possible with the
    # depth in its file, if any, and the weights on this machine.
    if settings.resolved_name == AUTO:
        return OpenedBase(AUTO_CANDIDATES, settings)

    # Otherwise the settings leave only one base. The reason goes into the report.
    if settings.name != AUTO:
        reason = "chosen by name"
    elif settings.depth is not None:
        reason = "a depth map is given"
    else:
        reason = "a checkpoint is given"
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
        base_class = load_base_class(name)
        with as_input_error(f"`base` {name}", "cannot be opened: {reason}"):
            return base_class()
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
    that the user gives replaces the map's. InputError if the settings ask for a depth map, and
    there is none.
    """
    # The caller's depth for this photo goes before the settings' depth, which is for all photos.
    source = settings.depth if depth is None else depth
    if source is None and photo.path.is_file():  # a photo that a program made has no file
        source = load_photo_depth(photo.path)
    if source is None:
        if settings.resolved_name == RGBD:
            raise InputError(
                f"{photo.path}: {NO_DEPTH_ADVICE}; {', '.join(NETWORK_BASES)} need no depth"
            )
        return None

    depth_map = source if isinstance(source, DepthMap) else read_depth(settings, source, photo)
    # The map's own intrinsics K, if any, are taken unless the user gave a focal length.
    if depth_map.K is None or not photo.focal_source.is_from_user:
        return RgbdBase(depth_map)

    # The map covers the photo with the border that was cropped from it (its framed size).
    map_width = depth_map.depth.shape[1]
    framed_width, _ = photo.framed_size
    focal_px = photo.focal_px * (map_width / framed_width)  # in pixels of the map
    if isinstance(source, DepthMap):
        return RgbdBase(source.with_focal(focal_px), lens_source="")  # "": the user gave it
    # The file is read again, because the focal length converts its disparities to metres.
    return RgbdBase(read_depth(settings, source, photo, focal_px), lens_source="")


def read_depth(
    settings: BaseSettings,
    source: Path | DepthValue,
    photo: Photo,
    focal_px: float | None = None,
) -> DepthMap:
    """Read a photo's depth map from `source`, with the settings for reading it.

    Where the settings do not say what the numbers mean, the map's order from near to far is
    compared with the photo.

    Args:
        settings: kind, unit and range of the map.
        source: the map's file, a folder with a map named like the photo, or a map in memory.
        photo: the photo that the map belongs to.
        focal_px: in pixels of the map, replaces the focal length in the map's calibration file.

    Raises:
        InputError: the map cannot be read; or it is unclear whether it holds metres.
    """
    if not isinstance(source, DepthValue):
        source = find_depth_file(source, photo.path)

    def load(kind: DepthKind) -> DepthMap:
        """The map, if its numbers mean `kind`, such as metric or inverse depth."""
        return load_depth(
            source,
            focal_px=focal_px,
            calib=settings.calib,
            kind=kind,
            unit=settings.depth_unit,
            near=RELATIVE_NEAR_M if settings.near is None else settings.near,
            far=RELATIVE_FAR_M if settings.far is None else settings.far,
        )

    try:
        depth_map = load(settings.depth_kind)
    except UnclearDepth as error:
        return _decided_by_photo(load, photo, error)
    if depth_map.is_guess and depth_order_agreement(depth_map, photo) < -CLEAR_CORRELATION:
        raise InputError(
            f"{depth_map.path}: read as {depth_map.meaning}, what the photo shows near would be "
            f"far: give `depth_kind` near-white for inverse depth, or {UNIT_ADVICE}"
        )
    return depth_map


def _decided_by_photo(
    load: Callable[[DepthKind], DepthMap], photo: Photo, error: UnclearDepth
) -> DepthMap:
    """The depth map that raised `error`, if the photo shows that it may be metric after all.

    Args:
        load: reads the map as the kind that it is called with.
        photo: the photo that the map belongs to.
        error: what is unclear.

    Raises:
        InputError: `error`, with the kind of relative depth that the photo shows, if it does.
    """
    # As inverse depth, any grey numbers can be read. Their order shows what they are.
    try:
        agreement = depth_order_agreement(load("near-white"), photo)
    except InputError:
        raise error from None
    if abs(agreement) <= CLEAR_CORRELATION:
        raise error
    if agreement < 0 and error.may_be_metres:
        return dataclasses.replace(load("metric"), is_guess=True)
    kind = "near-white" if agreement > 0 else "near-black"
    raise InputError(
        f"{error.problem}, and the photo shows that bright is {'near' if agreement > 0 else 'far'}"
        f": give `depth_kind` {kind}, or {UNIT_ADVICE} for metric depth"
    ) from None


@dataclasses.dataclass(frozen=True)
class ResolvedBase:
    """The base that was used for a photo, and why."""

    name: str
    reason: str
    failures: tuple[str, ...] = ()  # name and error of each candidate that failed before
    note: str = ""  # for the user, if `auto` chose this base for the first time
    # Whether the next run would choose this base, too. False if memory was short for a better base:
    # with more free memory, that base may work.
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
        """Prepare to predict with the first of the `candidates` that works for a photo.

        Args:
            candidates: the bases that may be used, by their names, the best first.
            settings: the options that all candidates are loaded with.
            loaded: bases that are loaded already, by their names; the value None means that a
                base's weights are missing.
        """
        self.candidates = candidates
        self._settings = settings
        self._loaded = {} if loaded is None else loaded
        # Files of weights that change during a run are noticed by their time of modification.
        self._weight_times_ns = {
            file: file.stat().st_mtime_ns
            for file in settings.model_files.values()
            if file.is_file()
        }
        # Candidates that would fail for every other photo, too.
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
        """Predict a photo's Gaussians with the first candidate that works, and say which it was.

        The candidates are the bases that may be used, the best first.

        Args:
            photo: at its full size.
            depth: this photo's depth map, used instead of the settings' map. Only the base rgbd,
                which lifts a photo by a depth map, uses it.
            log: called with a line of text for each candidate that fails.
            stage: called with "prepare" before a base is loaded, and with "base" before it
                predicts; the result is a context manager that times this stage.

        Raises:
            BaseError: the candidates cannot be used for any photo.
            InputError: the candidates cannot be used for this photo or its depth.
        """
        skipped: list[SkippedCandidate] = []
        for name, candidate in self.candidates.items():
            # It failed for an earlier photo, and would fail for this photo, too.
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
            # Other exceptions than InputError are defects of the code: they end the run.
            except InputError as error:
                is_unusable = self._fails_for_every_photo(name, base, error)
                if is_unusable and len(self.candidates) == 1:
                    raise BaseError(str(error)) from error
                # After the last candidate nothing is left to try. A BaseError, such as changed
                # weights, ends the run whatever else could be tried.
                is_last = name == list(self.candidates)[-1]
                if is_last or isinstance(error, BaseError):
                    raise
                skipped.append(self._skip(name, error, is_unusable))
                log(f"{photo.path.name}: going on without {candidate.title}: {error}")
                continue
            return prediction, self._resolved(name, skipped)
        # The last candidate has no weights. The check of the settings found them, so they must have
        # been deleted since.
        raise BaseError(f"`base` {self._settings.resolved_name}: its weights are gone: start again")

    def _fails_for_every_photo(self, name: str, base: Base | None, error: InputError) -> bool:
        """Whether the candidate `name`, which failed with `error`, would fail for every photo.

        A network would fail again if it could not be loaded (then `base` is None), or if memory was
        short. A depth map that belongs to this photo would not, because the next photo has another
        map.
        """
        # rgbd is among the loaded bases only if the calling program passed it, for all photos.
        has_own_depth_map = name == RGBD and name not in self._loaded
        if has_own_depth_map:
            return False
        return base is None or isinstance(error, NotEnoughMemory)

    def _skip(self, name: str, error: InputError, is_unusable: bool) -> SkippedCandidate:
        """Describe why the candidate `name` was skipped: it failed with `error`.

        If it `is_unusable`, that is, would fail for every photo, it is not tried again, and its
        memory is freed.
        """
        title = self.candidates[name].title
        skipped = SkippedCandidate(
            reason=f"{title} cannot be used",
            failure=f"{title}: {error}",
            lacked_memory=isinstance(error, NotEnoughMemory),
        )
        if is_unusable:
            # A later photo's report only gives the reason: the failure belongs to this photo.
            self._unusable[name] = dataclasses.replace(skipped, failure="")
            self._loaded.pop(name, None)
        return skipped

    def _resolved(self, name: str, skipped: Sequence[SkippedCandidate]) -> ResolvedBase:
        """Describe for the report which candidate was used, and why.

        Args:
            name: the candidate that was used.
            skipped: the better candidates, which could not be used.
        """
        # The reason is that the better candidates were skipped; without any, the base's title.
        reasons = [candidate.reason for candidate in skipped]
        reason = ", ".join(reasons) or self.candidates[name].title
        note = f"base {name} ({reason})"
        if name == "lite":
            note += f": {ROUGH_GEOMETRY_ADVICE}"

        # The user gets a note only if there was a choice, and each note only once.
        is_news = len(self.candidates) > 1 and note not in self._notes_given
        self._notes_given.add(note)
        return ResolvedBase(
            name=name,
            reason=reason,
            failures=tuple(candidate.failure for candidate in skipped if candidate.failure),
            note=note if is_news else "",
            # Lasting: the next run would choose the same base. If memory was short, it may choose a
            # better one.
            lasting=not any(candidate.lacked_memory for candidate in skipped),
        )

    def load(self, photo: Photo, depth: Depth = None, name: str | None = None) -> Base | None:
        """Load a base; None if its weights are missing, or if it needs depth that a photo lacks.

        Args:
            photo: the photo for which the base is needed.
            depth: the photo's depth map, for the base rgbd.
            name: the candidate to load; None: the first candidate.

        Raises:
            InputError: loading fails.
            BaseError: a file of weights has changed since the start.
        """
        name = name or next(iter(self.candidates))
        # A base with a depth map is made anew for each photo, because each photo has its own map.
        if name == RGBD and name not in self._loaded:
            return _open_rgbd(self._settings, photo, depth)
        # A network is loaded once, and kept for all photos.
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
        """Wrap only the base that was chosen for one photo, for photos that must use the same base.

        Such photos are the frames of a clip.
        """
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

    # A base of another package need not return the photo; the fill's network may want it.
    if prediction.photo is None:
        camera = prediction.camera
        photo_rgb = resize_rgb(photo.rgb, camera.width, camera.height)
        prediction = dataclasses.replace(prediction, photo=photo_rgb)
    return prediction
