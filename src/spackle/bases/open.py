"""Which bases there are, what each takes, and the one way from a name or `auto` to a photo's Gaussians.

`auto` takes the depth in the photo's file, else SHARP where its weights are, else lite. It falls back to the next of
them where one cannot be used, and logs why. The lens is what a person says, else what the depth map's calibration
says, else what the photo's file says, else the default.
"""

from __future__ import annotations

import dataclasses
import functools
import logging
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch

from spackle.bases.depth_map import DepthMap, load_depth
from spackle.bases.hf import SETTINGS, WEIGHTS, HfBase
from spackle.bases.lift import RgbdBase
from spackle.bases.lite import base as lite
from spackle.bases.lite.base import LiteBase
from spackle.bases.photo_depth import load_photo_depth
from spackle.bases.protocol import Base, BasePrediction, Progress
from spackle.bases.sharp.base import SharpBase, check_windows
from spackle.device import PRECISIONS, MemoryShort, Precision
from spackle.digest import fingerprint
from spackle.downloads import check_recorded, installed, known_weights, read_record
from spackle.errors import InputError, check_name
from spackle.gaussians import Gaussians
from spackle.image import Photo

AUTO = "auto"
HF = "hf:"  # a folder, or owner/name of the hub, follows
ANY_HF = "hf:NAME_OR_FOLDER"
NOT_SHARP = "not SHARP, so not the paper's base"
ROUGH = (
    "rough geometry; for better: --depth FILE, `spackle weights get sharp` (research only), "
    "or --base hf:depth-anything/Depth-Anything-V2-Small-hf"
)
DEPTH_SUFFIXES = (".npy", ".npz", ".png", ".pfm")
LOG = logging.getLogger("spackle")
Log = Callable[[str], None]


class BaseError(InputError):
    """The base of all photos cannot be used, so there is no point in trying another photo, or another base."""


@dataclasses.dataclass(frozen=True)
class BaseKind:
    """One of the bases, or one of the kinds of `hf:…`."""

    title: str  # in tables; of hf the model's name stands there
    says: str  # below them
    refuses: Mapping[str, str]  # options that it has no use for, and why: "the sharp base … "
    network: bool = True  # looks at the photo alone; else it takes the photo's depth
    slow: bool = False  # so slow that a benchmark asks it once


_OWN_DEPTH = {"--depth": "finds depth itself", "--calib": "finds depth itself"}
_SHARPS_SPEED = ("--windows", "--compile")
KINDS = {
    "rgbd": BaseKind(
        "rgbd",
        f"the dataset's own depth, map or points, lifted; {NOT_SHARP}",
        {"-c": "has no checkpoint"} | dict.fromkeys(("--precision", "--low-memory", *_SHARPS_SPEED), "has no network"),
        network=False,
    ),
    "sharp": BaseKind("SHARP", "Apple's network, from the photo alone", _OWN_DEPTH, slow=True),
    "lite": BaseKind(
        "lite",
        f"Spackle's own small depth networks, from the photo alone, lifted; {NOT_SHARP}",
        _OWN_DEPTH
        | {"--precision": "always computes in fp32", "--low-memory": "takes little as it is"}
        | dict.fromkeys(_SHARPS_SPEED, "is fast as it is"),
    ),
    ANY_HF: BaseKind(
        "hf",
        f"a depth model of transformers, from the photo alone, lifted; {NOT_SHARP}",
        {
            **_OWN_DEPTH,
            **dict.fromkeys(_SHARPS_SPEED, "is not SHARP, whose speed it is about"),
            "-c": "has no checkpoint but the model that --base names",
            "--low-memory": "cannot do with less: name a smaller model",
        },
    ),
}
NETWORKS = tuple(name for name, kind in KINDS.items() if kind.network)


def kind_of(name: str) -> BaseKind:
    """What a base is that --base names.

    Raises:
        InputError: there is none of that name, or it is `auto`, which is none yet.
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
    """A base by its name, and what a person chose for it."""

    name: str = AUTO  # or as `kind_of` has it
    depth: Path | DepthMap | None = None  # of the photo; or a folder of depth maps named as the photos
    calib: Path | None = None  # calibration of a disparity map
    checkpoint: Path | None = None  # weights of SHARP, or of lite
    precision: Precision = "auto"  # of the network
    low_memory: bool = False
    windows: int | None = None  # of SHARP, at once
    compiled: bool = False
    device: str = "auto"

    @property
    def named(self) -> str:
        """The base that is named: with a depth map `auto` is `rgbd`, and with a checkpoint it is `sharp`."""
        if self.name != AUTO:
            return self.name
        return "rgbd" if self.depth is not None else AUTO if self.checkpoint is None else "sharp"

    @property
    def kind(self) -> BaseKind:
        """What the named base is; InputError where it is `auto` still."""
        return kind_of(self.named)

    @property
    def folder(self) -> Path | None:
        """The folder that `hf:…` names; None for a model of the hub and for other bases."""
        folder = os.path.expanduser(self.name.removeprefix(HF))
        return Path(folder) if self.name.startswith(HF) and os.path.isdir(folder) else None

    @property
    def public_name(self) -> str:
        """The name for results that others read: of a folder its last part, not where it lies."""
        return self.named if self.folder is None else HF + self.folder.resolve().name

    @property
    def title(self) -> str:
        """What tables call the base."""
        return self.public_name if self.name.startswith(HF) else self.kind.title

    @property
    def says(self) -> str:
        """What tables say of the base with these weights: Apple's are those that were downloaded from Apple."""
        file = self.files.get("checkpoint") if self.named == "sharp" else None
        record = None if file is None else read_record(file)
        if file is None or (record is not None and record.url == known_weights("sharp").url):
            return self.kind.says
        return f"a network of SHARP's shape, from the photo alone, by weights of unknown origin: {file.name}"

    @property
    def files(self) -> dict[str, Path]:
        """Files with weights that decide the predictions, as far as they are here, by what messages call them."""
        if self.folder is not None:
            patterns = (*SETTINGS, *WEIGHTS)
            return {file.name: file for p in patterns for file in sorted(self.folder.glob(p)) if file.is_file()}
        found: dict[str, Path | None] = {}
        if self.named in ("sharp", AUTO):
            try:
                found["checkpoint"] = self.checkpoint or installed("sharp")
            except InputError:  # a machine without a place for any
                if self.named != AUTO:
                    raise
        if self.named in ("lite", AUTO):
            shipped = lite.SHIPPED if lite.SHIPPED.is_file() else None
            found["lite weights"] = (self.checkpoint if self.named == "lite" else None) or shipped
        return {title: file for title, file in found.items() if file is not None}

    def check(self) -> None:
        """InputError for a base that there is not, or that has no use for an option that is given."""
        if not self.name.startswith(HF):
            check_name("--base", self.name, (AUTO, *KINDS))
        if self.precision not in PRECISIONS:
            raise InputError(f"--precision {self.precision}: unknown: there are {', '.join(PRECISIONS)}")
        refuses = {} if self.named == AUTO else self.kind.refuses
        for option, value in self._given().items():
            if option in refuses:
                who = self.named.partition(":")[0]
                raise InputError(f"{option}{value}: the {who} base {refuses[option]}; leave the option out")
        check_windows("--windows", self.windows, self.low_memory)
        if self.calib is not None and self.depth is None:
            raise InputError(f"--calib {self.calib}: is for a disparity map: give that with --depth")
        if self.named == "sharp" and not self.files:
            raise InputError(
                "--base sharp: no weights on this machine: `spackle weights get sharp` downloads them "
                "(2.8 GB, for research only), -c FILE takes a local copy"
            )

    def check_has_depth(self) -> None:
        """InputError where the base takes depth and none is given."""
        if not self.kind.network and self.depth is None:
            raise InputError(
                f"--base {self.name} needs the photos' depth: give --depth FOLDER; {', '.join(NETWORKS)} need none"
            )

    def _given(self) -> dict[str, str]:
        """What was given of the options that not every base has a use for, by their names."""
        depth = self.depth.path if isinstance(self.depth, DepthMap) else self.depth
        values = {"--depth": depth, "--calib": self.calib, "-c": self.checkpoint, "--windows": self.windows}
        given = {name: f" {value}" for name, value in values.items() if value is not None}
        if self.precision != "auto":
            given["--precision"] = f" {self.precision}"
        flags = {"--low-memory": self.low_memory, "--compile": self.compiled}
        return given | {name: "" for name, value in flags.items() if value}


@dataclasses.dataclass(frozen=True)
class Choice:
    """Which base a photo got, and why."""

    base: str
    why: str
    passed_over: tuple[str, ...] = ()  # what was there but could not be used, and how that showed
    lasting: bool = True  # False: memory was short, so the same files may get another base the next time
    news: str = ""  # for people, of a base that nobody named; empty where an earlier photo had the same

    @property
    def line(self) -> str:
        """For people, with what would be better."""
        return f"base {self.base} ({self.why})" + (f": {ROUGH}" if self.base == LiteBase.name else "")


Find = Callable[[Photo, "Path | DepthMap | None"], "Base | None"]


@dataclasses.dataclass
class _Candidate:
    """A base that may be the photo's."""

    name: str
    what: str  # reports and the log call it so
    find: Find  # None: there is no such thing for this photo
    lack: str = ""  # the reason for the next candidate then
    shared: bool = True  # by all photos: what fails for one for good fails for all
    short: bool = False  # of memory, the last time


def open_base(settings: BaseSettings, log: Log = LOG.warning) -> OpenedBase:
    """A base by its settings; nothing is loaded before a photo needs it.

    Args:
        settings: its name and options.
        log: is told in a line of each candidate that cannot be used.

    Raises:
        InputError: an option that the base has no use for, or a file that is missing.
    """
    settings.check()
    files = settings.files
    prints = {title: fingerprint(file, title) for title, file in files.items()}
    named = settings.named

    def network(name: str) -> Find:
        load = functools.cache(functools.partial(_load, name, settings, files, prints))
        return lambda photo, depth: load()

    if named == AUTO:
        sharp = network("sharp") if "checkpoint" in files else _nothing
        candidates = [
            _Candidate("rgbd", "the depth in the photo", _by_own_depth, "no depth in the photo", shared=False),
            _Candidate("sharp", "SHARP", sharp, "no SHARP weights here"),
            _Candidate("lite", "lite", network("lite")),
        ]
        return OpenedBase(candidates, log, prints, by_name=False)
    why = f"--base {named}" if settings.name != AUTO else "--depth" if settings.depth is not None else "-c"
    if settings.kind.network:
        return OpenedBase([_Candidate(named, why, network(named))], log, prints)
    find = functools.partial(_by_given_depth, settings)
    return OpenedBase([_Candidate(named, why, find, shared=False)], log, prints)


def open_loaded(base: Base) -> OpenedBase:
    """A base that a program has loaded."""
    return OpenedBase([_Candidate(base.name, "loaded", lambda photo, depth: base)], LOG.warning)


class OpenedBase:
    """Turns photos into Gaussians. A network is loaded with the first photo that needs it and serves all others."""

    def __init__(
        self, candidates: Sequence[_Candidate], log: Log, prints: Mapping[str, str] = {}, by_name: bool = True
    ) -> None:
        self.fingerprints = dict(prints)  # of the files with weights, see `BaseSettings.files`
        self._candidates, self._log, self._by_name = candidates, log, by_name
        self._told: set[str] = set()

    def predict(
        self, photo: Photo, depth: Path | DepthMap | None = None, progress: Progress | None = None
    ) -> tuple[BasePrediction, Choice]:
        """A photo's Gaussians, and which base they are of.

        Args:
            photo: at its full size.
            depth: of this photo, in place of the settings'; for rgbd alone.
            progress: called as the work advances, where it takes long.

        Raises:
            InputError: this photo or its depth cannot be used.
            BaseError: no photo can be worked on.
        """
        return self.load(photo, depth).predict(progress)

    def load(self, photo: Photo, depth: Path | DepthMap | None = None, log: Log | None = None) -> PhotoBase:
        """The first half of `predict`: the base is loaded, and the photo's depth is read where that takes any."""
        found = PhotoBase(photo, depth, self._candidates, log or self._log, None if self._by_name else self._told)
        found.load()
        return found

    @property
    def takes_depth(self) -> bool:
        """Whether the base that is named is no network, but takes the photo's depth."""
        return self._by_name and not any(candidate.shared for candidate in self._candidates)

    def only(self, choice: Choice) -> OpenedBase:
        """The base of a choice for all further photos, as the frames of a clip need it: nothing to fall back to."""
        return OpenedBase([c for c in self._candidates if c.name == choice.base], self._log, self.fingerprints)


class PhotoBase:
    """The bases that one photo may get; the first of them that has what it takes and does not fail."""

    def __init__(
        self,
        photo: Photo,
        depth: Path | DepthMap | None,
        candidates: Sequence[_Candidate],
        log: Log,
        told: set[str] | None,  # the news so far; None where there are none
    ) -> None:
        self._photo, self._depth, self._left, self._log, self._told = photo, depth, list(candidates), log, told
        self._alone = len(candidates) == 1
        self._lacks: list[str] = []
        self._passed: list[str] = []
        self._short = False
        self._base: Base | None = None

    def load(self) -> Base:
        """A base that is ready; InputError where not even the last candidate is."""
        while self._base is None:
            candidate = self._left[0]
            try:
                self._base = candidate.find(self._photo, self._depth)
            except InputError as error:
                self._fall_back(error, for_good=True)
                continue
            if self._base is None:
                self._next(candidate.lack, candidate.short)
        return self._base

    def predict(self, progress: Progress | None = None) -> tuple[BasePrediction, Choice]:
        """The photo's Gaussians by the first candidate that does not fail; raises as `OpenedBase.predict` does."""
        while True:
            base = self.load()
            try:
                prediction = base.predict(self._photo, progress)
                if not all_finite(prediction.gaussians):
                    raise InputError(
                        f"{self._photo.path}: the base's Gaussians leave the range of float32: "
                        "check depth and focal length"
                    )
            except InputError as error:
                # What is wrong with one photo need not be so with another.
                self._fall_back(error, for_good=isinstance(error, MemoryShort))
                continue
            why = ", ".join(self._lacks) or self._left[0].what
            choice = Choice(base.name, why, tuple(self._passed), not self._short)
            if self._told is None or choice.line in self._told:
                return prediction, choice
            self._told.add(choice.line)
            return prediction, dataclasses.replace(choice, news=choice.line)

    def _fall_back(self, error: InputError, *, for_good: bool) -> None:
        """Go on with the next candidate, for other photos too where it is for good; raise the error at the last."""
        candidate = self._left[0]
        if self._alone and candidate.shared and for_good and not isinstance(error, BaseError):
            raise BaseError(str(error)) from error
        if isinstance(error, BaseError) or len(self._left) == 1:
            raise error
        short = isinstance(error, MemoryShort)
        if for_good and candidate.shared:  # no other photo fails in the same way; this frees what was loaded, too
            candidate.find, candidate.lack, candidate.short = _nothing, f"{candidate.what} cannot be used", short
        self._log(f"{self._photo.path.name}: going on without {candidate.what}: {error}")
        self._passed.append(f"{candidate.what}: {error}")
        self._next(f"{candidate.what} cannot be used", short)

    def _next(self, lack: str, short: bool) -> None:
        self._base = None
        self._lacks.append(lack)
        self._short |= short
        del self._left[0]


class _DepthBase(RgbdBase):
    """Lifts a photo by a depth map; says whose lens it was and what kind of map."""

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        prediction, note = super().predict(photo, progress), self.depth.note
        lens = prediction.lens_source
        lens = "" if not lens or given_focal(photo) else "the photo's depth" if note else lens
        return dataclasses.replace(
            prediction, notes=prediction.notes | ({"depth": note} if note else {}), lens_source=lens
        )


def _by_given_depth(settings: BaseSettings, photo: Photo, depth: Path | DepthMap | None) -> Base:
    """By the photo's depth: that of this call, else the settings', else the depth in its file."""
    source = settings.depth if depth is None else depth
    if source is not None:
        return _DepthBase(_depth_map(photo, source, settings.calib))
    base = _by_own_depth(photo, None)
    if base is None:
        raise InputError(
            f"{photo.path}: --base rgbd needs depth, and there is none in the photo: give --depth FILE, or --depth "
            f"FOLDER for many photos; {', '.join(NETWORKS)} need none"
        )
    return base


def _by_own_depth(photo: Photo, depth: Path | DepthMap | None) -> Base | None:
    """By the depth in the photo's file; None where there is none, or no file: a program may have made the photo."""
    own = load_photo_depth(photo.path) if photo.path.is_file() else None
    return None if own is None else _DepthBase(_depth_map(photo, own, None))


def _depth_map(photo: Photo, source: Path | DepthMap, calib: Path | None) -> DepthMap:
    """A photo's depth map, as far as the lens decides it by the lens that counts: a person's word beats the map's."""
    path = source if isinstance(source, DepthMap) else find_depth(source, photo.path)
    depth = path if isinstance(path, DepthMap) else load_depth(path, calib=calib)
    depth.check_shape(photo.height, photo.width, photo.path)
    if depth.K is None or not given_focal(photo):
        return depth
    focal = photo.focal_px * (depth.depth.shape[1] / photo.width)
    if not isinstance(path, DepthMap):
        return load_depth(path, calib=calib, focal_px=focal)
    if depth.quantity == "depth" or depth.note:  # metres that depend on no lens
        return dataclasses.replace(depth, K=None)
    # depth = baseline · focal / disparity
    K, ratio = depth.K.clone(), focal / float(depth.K[0, 0])
    K[0, 0] = K[1, 1] = focal
    quantum = depth.quantum and depth.quantum / ratio
    return dataclasses.replace(depth, depth=depth.depth * ratio, K=K, quantum=quantum)


def given_focal(photo: Photo) -> bool:
    """Whether a person said what the photo's focal length is."""
    return photo.focal_source.startswith("--")


def find_depth(depth: Path, photo: Path) -> Path:
    """The depth map of a photo: the file itself, or the one of its name in a folder.

    Raises:
        InputError: a folder without such a file.
    """
    if not os.path.isdir(depth):
        return depth
    for name in (photo.name, photo.stem):  # a.jpg.npy before a.npy, which a.png may mean too
        for suffix in DEPTH_SUFFIXES:
            candidate = depth / f"{name}{suffix}"
            if os.path.isfile(candidate) and candidate.resolve() != photo.resolve():
                return candidate
    names = ", ".join(f"{photo.stem}{suffix}" for suffix in DEPTH_SUFFIXES)
    raise InputError(f"{photo}: no depth map in {depth}: looked for {names}")


def _load(name: str, settings: BaseSettings, files: Mapping[str, Path], prints: Mapping[str, str]) -> Base:
    """A network, by files that have not changed since the base was opened.

    Raises:
        InputError: it cannot be loaded.
        BaseError: its files are others now.
    """
    device = None if settings.device == "auto" else settings.device
    base: Base
    if name == "lite":
        base = LiteBase.load(settings.checkpoint if settings.named == name else None, device=device)
    elif name.startswith(HF):
        base = HfBase.load(name.removeprefix(HF), device=device, precision=settings.precision)
    else:
        path = files["checkpoint"]
        check_recorded(path)  # where there is a record of the download
        base = SharpBase.load(
            path,
            precision=settings.precision,
            low_memory=settings.low_memory,
            windows=settings.windows,
            compiled=settings.compiled,
            device=device,
        )
    if {title: fingerprint(file, title) for title, file in settings.files.items()} != prints:
        raise BaseError(f"{', '.join(map(str, files.values()))}: changed while this was running: start again")
    return base


def _nothing(photo: Photo, depth: Path | DepthMap | None) -> None:
    return None


def all_finite(gaussians: Gaussians) -> bool:
    """Whether every number of theirs is one."""
    return all(bool(torch.isfinite(tensor).all()) for tensor in gaussians.tensors)
