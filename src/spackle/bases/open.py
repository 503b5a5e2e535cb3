"""All bases, their options, and the one path from a base's name, or `auto`, to a photo's Gaussians.

`auto` tries the depth in the photo's file, then SHARP and Depth Anything if their weights are installed, then lite. It
falls back to the next candidate when one fails, and logs why. The focal length comes from the user, else from the depth
map's calibration, else from the photo's file, else it is the default.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from spackle.bases import lite
from spackle.bases.depth_map import DepthMap, find_depth, load_depth
from spackle.bases.hf import SETTINGS, WEIGHTS, HfBase
from spackle.bases.lift import RgbdBase
from spackle.bases.photo_depth.layouts import load_photo_depth
from spackle.bases.protocol import Base, BasePrediction, Progress
from spackle.bases.sharp.base import SharpBase, check_windows
from spackle.device import PRECISIONS, MemoryShort, Precision
from spackle.errors import InputError, check_name
from spackle.files import fingerprint
from spackle.image import Photo
from spackle.weights import check_undamaged, installed, published_as, published_weights

AUTO = "auto"
AUTO_NETWORKS = ("sharp", "depth", "lite")  # in the order that `auto` tries them
HF = "hf:"  # a folder, or owner/name of the hub, follows
ANY_HF = "hf:NAME_OR_FOLDER"
NOT_SHARP = "not SHARP, so not the paper's base"
ROUGH = (
    "rough geometry; for better: --depth FILE, `spackle weights get depth` (99 MB, Apache-2.0), "
    "or `spackle weights get sharp` (2.8 GB, research only)"
)
DOWNLOADS = {  # what to do without the weights of a base
    "sharp": "no weights on this machine: `spackle weights get sharp` downloads them "
    "(2.8 GB, for research only), -c FILE takes a local copy",
    "depth": "not on this machine: `spackle weights get depth` downloads it (99 MB, Apache-2.0)",
}
LOG = logging.getLogger("spackle")
Log = Callable[[str], None]
Depth = Path | DepthMap | None  # of a photo; a path may be a folder of depth maps named as the photos
Find = Callable[[Photo, Depth], Base | None]


class BaseError(InputError):
    """The base of all photos cannot be used: trying another photo or another base is pointless."""


@dataclasses.dataclass(frozen=True)
class BaseKind:
    """One of the bases, or all `hf:…` models."""

    description: str  # below tables
    refuses: Mapping[str, str]  # options that the base cannot use, and why: "the sharp base … "
    network: bool = True  # predicts from the photo alone; otherwise needs the photo's depth
    slow: bool = False  # a benchmark times it once


_OWN_DEPTH = {"--depth": "finds depth itself", "--calib": "finds depth itself"}
_MODELS = {
    **_OWN_DEPTH,
    "--sharp": "is not SHARP, whose speed it is about",
    "-c": "has no checkpoint but the model that --base names",
}
KINDS = {
    "rgbd": BaseKind(
        f"the dataset's own depth, map or points, lifted; {NOT_SHARP}",
        {"-c": "has no checkpoint"} | dict.fromkeys(("--precision", "--sharp"), "has no network"),
        network=False,
    ),
    "sharp": BaseKind("Apple's network, from the photo alone", _OWN_DEPTH, slow=True),
    "depth": BaseKind(f"Depth-Anything-V2-Small, from the photo alone, lifted; {NOT_SHARP}", _MODELS),
    "lite": BaseKind(
        f"Spackle's own small depth networks, from the photo alone, lifted; {NOT_SHARP}",
        _OWN_DEPTH | {"--precision": "always computes in fp32", "--sharp": "is fast as it is"},
    ),
    ANY_HF: BaseKind(f"a depth model of transformers, from the photo alone, lifted; {NOT_SHARP}", _MODELS),
}
NETWORKS = tuple(name for name, kind in KINDS.items() if kind.network)
NO_DEPTH = (
    "--base rgbd needs depth, and there is none in the photo: give --depth FILE, or --depth FOLDER for many photos; "
    f"{', '.join(NETWORKS)} need none"
)


def kind_of(name: str) -> BaseKind:
    """The kind of the base that --base names.

    Raises:
        InputError: an unknown name, or `auto`, which is not one base.
    """
    if name == AUTO:
        raise InputError(f"--base {AUTO}: results must say what they are of: name one of {', '.join(KINDS)}")
    if name == HF:
        raise InputError(f"--base {HF} names no model: give owner/name of the hub, or a folder")
    key = ANY_HF if name.startswith(HF) else name
    check_name("--base", key, KINDS)
    return KINDS[key]


@dataclasses.dataclass(frozen=True)
class BaseSettings:
    """A base's name, and the user's options for it."""

    name: str = AUTO  # or one that `kind_of` knows
    depth: Depth = None
    calib: Path | None = None  # calibration of a disparity map
    checkpoint: Path | None = None  # weights of SHARP or of lite
    precision: Precision = "auto"  # of the network
    windows: int | None = None  # that SHARP computes at once; 1 takes the least memory
    compiled: bool = False
    device: str = "auto"

    @property
    def named(self) -> str:
        """The base's name, where `auto` with a depth map means `rgbd`, and with a checkpoint `sharp`."""
        if self.name != AUTO:
            return self.name
        return "rgbd" if self.depth is not None else AUTO if self.checkpoint is None else "sharp"

    @property
    def kind(self) -> BaseKind:
        """The kind of the named base; InputError for `auto`."""
        return kind_of(self.named)

    @property
    def folder(self) -> Path | None:
        """The folder that `hf:…` names; None for a model of the hub and for other bases."""
        folder = os.path.expanduser(self.name.removeprefix(HF))
        return Path(folder) if self.name.startswith(HF) and os.path.isdir(folder) else None

    @property
    def public_name(self) -> str:
        """The name in published results: of a folder only the last part."""
        return self.named if self.folder is None else HF + self.folder.resolve().name

    @property
    def title(self) -> str:
        """The base's title in tables."""
        return "SHARP" if self.named == "sharp" else self.public_name

    @property
    def description(self) -> str:
        """The base's description below tables; it calls weights Apple's only if they were downloaded from Apple."""
        file = self.files.get("checkpoint") if self.named == "sharp" else None
        if file is None or published_as(file) is published_weights("sharp"):
            return self.kind.description
        return f"a network of SHARP's shape, from the photo alone, by weights of unknown origin: {file.name}"

    @property
    def files(self) -> dict[str, Path]:
        """Existing weight files that decide the predictions, by their titles in messages."""
        if self.folder is not None:
            patterns = (*SETTINGS, *WEIGHTS)
            return {file.name: file for p in patterns for file in sorted(self.folder.glob(p)) if file.is_file()}
        found: dict[str, Path | None] = {}
        try:
            if self.named in ("sharp", AUTO):
                found["checkpoint"] = self.checkpoint or installed("sharp")
            if self.named in ("depth", AUTO):
                found["depth weights"] = installed("depth")
        except InputError:  # the machine has no folder for downloads
            if self.named != AUTO:
                raise
        if self.named in ("lite", AUTO):
            shipped = lite.SHIPPED if lite.SHIPPED.is_file() else None
            found["lite weights"] = (self.checkpoint if self.named == "lite" else None) or shipped
        return {title: file for title, file in found.items() if file is not None}

    def check(self) -> None:
        """InputError for an unknown base, or an option that the base cannot use."""
        if not self.name.startswith(HF):
            check_name("--base", self.name, (AUTO, *KINDS))
        check_name("--precision", self.precision, PRECISIONS)
        options = {
            "--depth": self.depth.path if isinstance(self.depth, DepthMap) else self.depth,
            "--calib": self.calib,
            "-c": self.checkpoint,
            "--precision": None if self.precision == "auto" else self.precision,
            "--sharp": "compile=yes" if self.compiled else self.windows and f"windows={self.windows}",
        }
        refuses = {} if self.named == AUTO else self.kind.refuses
        for option, value in options.items():
            if option in refuses and value is not None:
                given, who = f"{option} {value}".rstrip(), self.named.partition(":")[0]
                raise InputError(f"{given}: the {who} base {refuses[option]}; leave the option out")
        check_windows("--sharp windows", self.windows)
        if self.calib is not None and self.depth is None:
            raise InputError(f"--calib {self.calib}: is for a disparity map: give that with --depth")
        if self.named in DOWNLOADS and not self.files:
            raise InputError(f"--base {self.named}: {DOWNLOADS[self.named]}")


@dataclasses.dataclass(frozen=True)
class ResolvedBase:
    """The base that a photo got, and why."""

    base: str
    why: str
    failures: tuple[str, ...] = ()  # of better candidates: which one, and its error
    lasting: bool = True  # False: memory was short, so the same files may get another base next time
    note: str = ""  # for the user, if `auto` chose and made another choice for earlier photos


@dataclasses.dataclass
class _Candidate:
    """A base that photos may get."""

    name: str
    title: str  # in reports and the log
    find: Find  # loads it; None: this photo or this machine has none
    absence: str = ""  # the reason to go on when there is none
    shared: bool = True  # by all photos: if it cannot be loaded for one, it cannot for any
    short: bool = False  # of memory, the last time


def open_base(settings: BaseSettings, log: Log = LOG.warning) -> OpenedBase:
    """A base by its settings; networks are loaded when the first photo needs them.

    Args:
        settings: its name and options.
        log: gets a line for each candidate that fails.

    Raises:
        InputError: an option that the base cannot use, or a missing file.
    """
    settings.check()
    files, named = settings.files, settings.named
    prints = {title: fingerprint(file, title) for title, file in files.items()}

    def network(name: str) -> Find:
        load = functools.cache(functools.partial(_load, name, settings, files, prints))
        return lambda photo, depth: load()

    lifted = functools.partial(_lift, settings)
    if named == AUTO:
        candidates = [
            _Candidate("rgbd", "the depth in the photo", lifted, "no depth in the photo", shared=False),
            _Candidate("sharp", "SHARP", network("sharp"), "no SHARP weights here"),
            _Candidate("depth", "Depth Anything", network("depth"), "no Depth Anything here"),
            _Candidate("lite", "lite", network("lite")),
        ]
        return OpenedBase(candidates, log, prints)
    why = f"--base {named}" if settings.name != AUTO else "--depth" if settings.depth is not None else "-c"
    find = network(named) if settings.kind.network else lifted
    return OpenedBase([_Candidate(named, why, find, NO_DEPTH, shared=settings.kind.network)], log, prints)


def open_loaded(base: Base) -> OpenedBase:
    """A base that a program has loaded."""
    return OpenedBase([_Candidate(base.name, "loaded", lambda photo, depth: base)], LOG.warning, {})


def _load(name: str, settings: BaseSettings, files: Mapping[str, Path], prints: Mapping[str, str]) -> Base | None:
    """A network, None if it is not installed; BaseError if its files have changed since the base was opened."""
    device, precision = None if settings.device == "auto" else settings.device, settings.precision
    base: Base
    if name == "lite":
        base = lite.LiteBase.load(settings.checkpoint if settings.named == name else None, device=device)
    elif name.startswith(HF):
        base = HfBase.load(name.removeprefix(HF), device=device, precision=precision)
    else:
        file = files.get("checkpoint" if name == "sharp" else "depth weights")
        if file is None:
            return None
        check_undamaged(file)
        if name == "depth":
            base = HfBase.load(str(file.parent), device=device, precision=precision, name=name)
        else:
            windows, compiled = settings.windows, settings.compiled
            base = SharpBase.load(file, precision=precision, windows=windows, compiled=compiled, device=device)
    if {title: fingerprint(file, title) for title, file in settings.files.items()} != prints:
        raise BaseError(f"{', '.join(map(str, files.values()))}: changed while this was running: start again")
    return base


def _lift(settings: BaseSettings, photo: Photo, depth: Depth) -> Base | None:
    """Lifts by the depth of this call, the settings or the photo. The user's focal length replaces the map's."""
    source = settings.depth if depth is None else depth
    if source is None and photo.path.is_file():  # a photo that a program made has no file
        source = load_photo_depth(photo.path)
    if source is None:
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


class OpenedBase:
    """Turns photos into Gaussians. The first photo that needs a network loads it for all others."""

    def __init__(self, candidates: Sequence[_Candidate], log: Log, fingerprints: Mapping[str, str]) -> None:
        self.candidates, self._log, self.fingerprints = candidates, log, fingerprints
        self.notes: set[str] = set()  # on earlier photos' choices

    def predict(self, photo: Photo, depth: Depth = None) -> tuple[BasePrediction, ResolvedBase]:
        """A photo's Gaussians, and the base that made them.

        Args:
            photo: at its full size.
            depth: of this photo, in place of the settings'; for rgbd only.

        Raises:
            InputError: this photo or its depth cannot be used.
            BaseError: no photo can be worked on.
        """
        return self.load(photo, depth).predict()

    def load(self, photo: Photo, depth: Depth = None, log: Log | None = None) -> PhotoBase:
        """The first half of `predict`: loads the base, and the photo's depth if the base takes any."""
        return PhotoBase(self, photo, depth, log or self._log)

    def only(self, choice: ResolvedBase) -> OpenedBase:
        """The chosen base for all further photos, such as the frames of a clip, without a fallback."""
        return OpenedBase([c for c in self.candidates if c.name == choice.base], self._log, self.fingerprints)


class PhotoBase:
    """The candidates for one photo, tried in their order until one works."""

    def __init__(self, opened: OpenedBase, photo: Photo, depth: Depth, log: Log) -> None:
        self._opened, self._photo, self._depth, self._log = opened, photo, depth, log
        self._left = list(opened.candidates)
        self._reasons: list[str] = []  # why earlier candidates were not taken
        self._failures: list[str] = []
        self._short = False
        self._base: Base | None = None
        self.load()

    def load(self) -> Base:
        """The first base that can be loaded; InputError if none can."""
        while self._base is None:
            candidate = self._left[0]
            try:
                self._base = candidate.find(self._photo, self._depth)
                if self._base is None and len(self._left) == 1:
                    raise InputError(f"{self._photo.path}: {candidate.absence}")
                if self._base is None:
                    self._go_on(candidate.absence, candidate.short)
            except InputError as error:
                self._fall_back(error, for_good=True)
        return self._base

    def predict(self, progress: Progress | None = None) -> tuple[BasePrediction, ResolvedBase]:
        """The photo's Gaussians by the first candidate that works; raises as `OpenedBase.predict` does."""
        while True:
            base = self.load()
            try:
                prediction = base.predict(self._photo, progress)
                if not prediction.gaussians.finite:
                    raise InputError(
                        f"{self._photo.path}: the base's Gaussians leave the range of float32: "
                        "check depth and focal length"
                    )
                break
            except InputError as error:  # another photo may work, unless memory is short
                self._fall_back(error, for_good=isinstance(error, MemoryShort))
        why = ", ".join(self._reasons) or self._left[0].title
        note = f"base {base.name} ({why})" + (f": {ROUGH}" if base.name == lite.LiteBase.name else "")
        if len(self._opened.candidates) == 1 or note in self._opened.notes:
            note = ""
        self._opened.notes.add(note)
        return prediction, ResolvedBase(base.name, why, tuple(self._failures), not self._short, note)

    def _fall_back(self, error: InputError, *, for_good: bool) -> None:
        """Log the error and go on with the next candidate, for all photos if for good; raise it at the last one."""
        candidate, last = self._left[0], len(self._left) == 1
        if last and len(self._opened.candidates) == 1 and candidate.shared and for_good:
            raise BaseError(str(error)) from error
        if last or isinstance(error, BaseError):
            raise error
        short, reason = isinstance(error, MemoryShort), f"{candidate.title} cannot be used"
        if for_good and candidate.shared:  # frees a loaded network, too
            candidate.find, candidate.absence, candidate.short = lambda photo, depth: None, reason, short
        self._log(f"{self._photo.path.name}: going on without {candidate.title}: {error}")
        self._failures.append(f"{candidate.title}: {error}")
        self._go_on(reason, short)

    def _go_on(self, reason: str, short: bool) -> None:
        self._base = None
        self._reasons.append(reason)
        self._short |= short
        del self._left[0]
