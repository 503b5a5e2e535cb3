"""The bases that can be named, and the options that each of them takes.

To add a base, write a class that follows `spackle.bases.Base`. Outside of this package it is named
`package.module:Class`; inside, it needs a line in `BASE_KINDS` and one in `open`.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from rich.filesize import decimal

from spackle.bases import Base, lite
from spackle.bases.sharp.base import check_window_batch
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import DepthValue
from spackle.depth.units import DEPTH_KINDS, RELATIVE_KINDS, DepthKind, parse_depth_unit
from spackle.runtime.device import PRECISIONS, Precision
from spackle.runtime.errors import InputError, check_name
from spackle.runtime.plugins import check_name_or_plugin, is_plugin, load_plugin, plugin_file
from spackle.weights import PUBLISHED_WEIGHTS, installed_weights

AUTO = "auto"  # the best base that a photo and this machine allow
RGBD = "rgbd"  # lifts a depth map that comes with the photo
HF_PREFIX = "hf:"  # before a folder, or a Hugging Face model's owner/name
AUTO_NETWORKS = ("sharp", "moge", "lite")  # in the order that `auto` tries them
NETWORK_BASES = (*AUTO_NETWORKS, "hf:NAME_OR_FOLDER")
PLUGIN_KIND = "package.module:Class"
# How to read a depth map.
DEPTH_READING_OPTIONS = ("depth_kind", "depth_unit", "near", "far")

# What a model's folder may hold that predictions depend on.
HF_FILE_PATTERNS: tuple[str, ...] = (
    "config.json",
    "preprocessor_config.json",
    "processor_config.json",
    "model.safetensors",
    "model-*.safetensors",
    "model.safetensors.index.json",
)

# A photo's depth; a path may be a folder of depth maps that are named like the photos.
Depth = Path | DepthMap | DepthValue | None


@dataclasses.dataclass(frozen=True)
class BaseKind:
    """What all bases of a kind have in common."""

    description: str  # below tables of results
    options: tuple[str, ...]  # the options of `BaseSettings` that only some bases take


_NOT_SHARP = "lifted; not SHARP, so not the paper's base"
BASE_KINDS = {
    RGBD: BaseKind(
        f"the dataset's own depth, map or points, {_NOT_SHARP}",
        ("depth", "calib", *DEPTH_READING_OPTIONS),
    ),
    "sharp": BaseKind(
        "SHARP's network, from the photo alone", ("checkpoint", "precision", "windows_per_batch")
    ),
    "moge": BaseKind(f"MoGe-2, from the photo alone, {_NOT_SHARP}", ("checkpoint", "precision")),
    "lite": BaseKind(
        f"Spackle's own small depth networks, from the photo alone, {_NOT_SHARP}", ("checkpoint",)
    ),
    "hf": BaseKind(
        f"a depth model of transformers, from the photo alone, {_NOT_SHARP}", ("precision",)
    ),
    PLUGIN_KIND: BaseKind("a base of another package, not the paper's base", ()),
    # The options are for the base that `auto` chooses.
    AUTO: BaseKind("", ("calib", *DEPTH_READING_OPTIONS, "precision", "windows_per_batch")),
}


def _download_command(name: str) -> str:
    """The command that downloads weights, with their size and licence, for a message."""
    weights = PUBLISHED_WEIGHTS[name]
    return f"`spackle weights get {name}` ({decimal(weights.bytes)}, {weights.licence})"


ROUGH_GEOMETRY_ADVICE = (
    "rough geometry; give `depth` FILE for better geometry, or run "
    f"{_download_command('depth')}, or {_download_command('sharp')}"
)
# What to do if a base's weights are missing, by the base's name.
MISSING_WEIGHTS_ADVICE = {
    "sharp": (
        f"no weights of SHARP on this machine: {_download_command('sharp')} downloads them, "
        "`checkpoint` FILE takes a local copy"
    ),
    "moge": (
        f"no weights of MoGe on this machine: {_download_command('depth')} downloads them, "
        "`checkpoint` FILE takes a local copy"
    ),
}
_PUBLISHED_NAMES = {"sharp": "sharp", "moge": "depth"}  # of weights, by the base's name
_TITLES = {"sharp": "SHARP"}  # of bases in tables, where they differ from the base's name


def has_other_weights(name: str, digest: object) -> bool:
    """Whether a base that is named after a published network has other weights than the published.

    Args:
        name: the base's name.
        digest: the SHA-256 of its file of weights, as `weights_digests` returns it.
    """
    return name in _PUBLISHED_NAMES and digest != PUBLISHED_WEIGHTS[_PUBLISHED_NAMES[name]].sha256


def title_of_base(name: str, digest: object) -> str:
    """A base's name in tables and figures, such as "SHARP", "SHARP stand-in" or "lite".

    A published network's plain name is for its published weights alone: numbers of a small or
    retrained network below the name SHARP would be taken for SHARP's.

    Args:
        name: the base's name.
        digest: the SHA-256 of its file of weights, as `weights_digests` returns it.
    """
    title = _TITLES.get(name, name)
    return f"{title} stand-in" if has_other_weights(name, digest) else title


def describe_base(name: str, digest: object, description: str) -> str:
    """Half a sentence about a base; of a stand-in it says what the base is not.

    Args:
        name: the base's name.
        digest: the SHA-256 of its file of weights, as `weights_digests` returns it.
        description: the sentence for a base with the published weights, or without such weights.
    """
    if not has_other_weights(name, digest):
        return description
    title = _TITLES.get(name, name)
    # A few digits tell files of weights apart.
    return (
        f"a network built like {title}, with weights that are not the published ones "
        f"({str(digest)[:8]}): not {title}"
    )


def _installed_weights(base_name: str) -> Path | None:
    """The file with a base's weights on this machine; None if it is missing, or there is none."""
    if base_name == "lite":
        return lite.SHIPPED_WEIGHTS if lite.SHIPPED_WEIGHTS.is_file() else None
    if base_name in _PUBLISHED_NAMES:
        return installed_weights(_PUBLISHED_NAMES[base_name])
    return None


def load_base_class(name: str) -> type[Base]:
    """The class of another package's base, `package.module:Class`; InputError if there is none."""
    base_class: type[Base] = load_plugin(
        name, "base", needs=("predict",), like="spackle.bases.Base"
    )
    return base_class


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseSettings:
    """A base's name and options."""

    # "auto", "rgbd", "sharp", "moge", "lite", "hf:…" or package.module:Class
    name: str = AUTO
    depth: Depth = None
    calib: Path | None = None  # calibration of a disparity map
    depth_kind: DepthKind = "auto"  # what the numbers of a depth map are
    # Unit of a metric depth map, see `parse_depth_unit`; None: that of its format.
    depth_unit: str | float | None = None
    near: float | None = None  # nearest depth of a relative map in metres; None: 1.5
    far: float | None = None  # farthest depth of a relative map in metres; None: 15
    checkpoint: Path | None = None  # weights of SHARP, MoGe or lite
    precision: Precision = "auto"  # of the network's arithmetic
    # How many of a photo's 35 windows SHARP's transformer processes at once; 1 takes least memory.
    windows_per_batch: int | None = None
    device: str = "auto"  # "auto", "cpu" or a CUDA device

    @property
    def resolved_name(self) -> str:
        """The base's name; for `auto` it is the base that the other options ask for.

        `auto` stands for `rgbd` if a depth map is given, else for `sharp` if a checkpoint is given.
        If neither is given, the name stays `auto`, and each photo decides.
        """
        # A name that the user gives is never changed.
        if self.name != AUTO:
            return self.name
        if self.depth is not None:
            return RGBD
        # A checkpoint without a base's name is taken for SHARP's.
        if self.checkpoint is not None:
            return "sharp"
        return AUTO

    @property
    def kind(self) -> str:
        """The base's key in `BASE_KINDS`: its name, "hf", or the kind of other packages' bases."""
        if self.name.startswith(HF_PREFIX):
            return "hf"
        return PLUGIN_KIND if is_plugin(self.name) else self.resolved_name

    @property
    def uses_network(self) -> bool:
        """Whether the base predicts from the photo alone; otherwise it needs the photo's depth."""
        return self.resolved_name != RGBD

    @property
    def model_folder(self) -> Path | None:
        """The folder that `hf:…` names; None for a model on the hub and for other bases."""
        folder = os.path.expanduser(self.name.removeprefix(HF_PREFIX))
        is_folder = self.name.startswith(HF_PREFIX) and os.path.isdir(folder)
        return Path(folder) if is_folder else None

    @property
    def public_name(self) -> str:
        """The base's name in published results; of a folder's path only the last part."""
        folder = self.model_folder
        return self.resolved_name if folder is None else HF_PREFIX + folder.resolve().name

    @property
    def description(self) -> str:
        """The base's description below tables of results."""
        return BASE_KINDS[self.kind].description

    @property
    def model_files(self) -> dict[str, Path]:
        """The files on this machine that predictions depend on: weights and their configuration.

        The key of a file of weights is the name of its base. If the base is a folder of a Hugging
        Face model, the key is the file's own name. A class of another package is its module's file.
        """
        if self.kind == PLUGIN_KIND:
            file = plugin_file(self.name, "base")
            return {} if file is None else {self.name: file}

        # transformers reads several files of a model's folder.
        if self.model_folder is not None:
            matches = [
                file
                for pattern in HF_FILE_PATTERNS
                for file in sorted(self.model_folder.glob(pattern))
            ]
            return {file.name: file for file in matches if file.is_file()}

        # With `auto`, the next photo may need any of the networks, so all their files count.
        names = AUTO_NETWORKS if self.resolved_name == AUTO else (self.resolved_name,)
        files: dict[str, Path] = {}
        for name in names:
            file = self.checkpoint or _installed_weights(name)
            if file is not None:
                files[name] = file
        return files

    def check(self, *, allow_auto: bool = True) -> None:
        """InputError for an unknown base, an option that it does not take, or missing weights.

        A base is a method that predicts a photo's Gaussians. Without `allow_auto`, the name `auto`
        is an error, too, where the results must say which base made them.
        """
        self._check_base_name(allow_auto)
        check_name("precision", self.precision, PRECISIONS)
        self._check_option_of_other_bases()
        check_window_batch(self.windows_per_batch)
        check_name("depth_kind", self.depth_kind, DEPTH_KINDS)
        self._check_depth_options()
        # Missing weights are reported here, and not first when a photo needs them, because the work
        # until then would be lost.
        if self.resolved_name in MISSING_WEIGHTS_ADVICE and not self.model_files:
            advice = MISSING_WEIGHTS_ADVICE[self.resolved_name]
            raise InputError(f"`base` {self.resolved_name}: {advice}")

    def _check_base_name(self, allow_auto: bool) -> None:
        """InputError for an unknown base, for `hf:` without a model, or for a forbidden `auto`."""
        if self.name == AUTO and not allow_auto:
            raise InputError(
                f"`base` {AUTO} is not allowed here, because the results name their base: "
                f"give {', '.join((RGBD, *NETWORK_BASES))}"
            )
        if self.name == HF_PREFIX:
            raise InputError(
                f"`base` {HF_PREFIX} names no model: "
                "give a Hugging Face model as owner/name, or a folder"
            )
        # Loading shows whether a Hugging Face model exists.
        if self.name.startswith(HF_PREFIX):
            return
        check_name_or_plugin("base", self.name, (AUTO, RGBD, *NETWORK_BASES))
        if is_plugin(self.name):
            load_base_class(self.name)

    def _given_options(self) -> dict[str, object]:
        """The options that only some bases take and that the user has set, with their values."""
        # A depth map in memory is named instead of printed.
        depth: object = self.depth
        if isinstance(self.depth, DepthMap | DepthValue):
            depth = self.depth.path
        # An option counts as set if its value is not the default, which is "auto" or None.
        options = {
            "depth": depth,
            "calib": self.calib,
            "depth_kind": None if self.depth_kind == "auto" else self.depth_kind,
            "depth_unit": self.depth_unit,
            "near": self.near,
            "far": self.far,
            "checkpoint": self.checkpoint,
            "precision": None if self.precision == "auto" else self.precision,
            "windows_per_batch": self.windows_per_batch,
        }
        return {option: value for option, value in options.items() if value is not None}

    def _check_option_of_other_bases(self) -> None:
        """InputError if an option is set that this base does not take."""
        # An option that is silently ignored would make the user believe that it has an effect.
        for option, value in self._given_options().items():
            if option not in BASE_KINDS[self.kind].options:
                raise InputError(
                    f"`{option}` {value}: the {self.kind} base does not take this option: "
                    "leave it out"
                )

    def _check_depth_options(self) -> None:
        """InputError for options that tell how to read a depth map, but do not fit the map.

        None of them may be set without a depth map. `near` and `far` are only for a relative map,
        whose values have no unit.
        """
        options = self._given_options()  # those that are set
        for option in ("calib", *DEPTH_READING_OPTIONS):
            if option not in options:
                continue
            if self.depth is None:
                raise InputError(
                    f"`{option}` {options[option]}: there is no depth map to read: "
                    "give the map with `depth`"
                )
            if isinstance(self.depth, DepthMap):
                raise InputError(
                    f"`{option}` {options[option]}: the depth map is loaded already: "
                    f"give `{option}` where it is loaded"
                )
            if option in ("near", "far") and self.depth_kind not in RELATIVE_KINDS:
                # They say at which depths the map's nearest and farthest points are placed.
                raise InputError(
                    f"`{option}` {options[option]}: only for relative maps: "
                    f"add `depth_kind` {' or '.join(RELATIVE_KINDS)}"
                )
        # A unit or a kind that cannot be is reported before the first photo is read.
        if self.depth_unit is not None:
            parse_depth_unit(self.depth_unit)
            if self.depth_kind not in ("auto", "metric"):
                raise InputError(
                    f"`depth_unit` {self.depth_unit}: only for metric depth: "
                    f"leave out `depth_kind` {self.depth_kind}"
                )
