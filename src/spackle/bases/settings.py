"""The bases that `--base` can name, and the options for each base."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from rich.filesize import decimal

from spackle.bases import lite
from spackle.bases.sharp.base import check_window_batch
from spackle.depth.depth_map import DepthMap
from spackle.depth.units import DEPTH_KINDS, RELATIVE_KINDS, DepthKind
from spackle.runtime.device import PRECISIONS, Precision
from spackle.runtime.errors import InputError, check_name
from spackle.weights import PUBLISHED_WEIGHTS, installed_weights

AUTO, RGBD = "auto", "rgbd"
HF_PREFIX = "hf:"  # before a folder, or a Hugging Face model's owner/name
AUTO_NETWORKS = ("sharp", "moge", "lite")  # in the order that `auto` tries them
NETWORK_BASES = (*AUTO_NETWORKS, "hf:NAME_OR_FOLDER")
READING = ("--depth-kind", "--near", "--far")  # how to read a depth map
NOT_SHARP = "lifted; not SHARP, so not the paper's base"
KINDS = {  # each base's description below tables, and the options that only some bases take
    RGBD: (
        f"the dataset's own depth, map or points, {NOT_SHARP}",
        ("--depth", "--calib", *READING),
    ),
    "sharp": ("SHARP's network, from the photo alone", ("-c", "--precision", "--sharp")),
    "moge": (f"MoGe-2, from the photo alone, {NOT_SHARP}", ("-c", "--precision")),
    "lite": (f"Spackle's own small depth networks, from the photo alone, {NOT_SHARP}", ("-c",)),
    "hf": (f"a depth model of transformers, from the photo alone, {NOT_SHARP}", ("--precision",)),
    AUTO: ("", ("--calib", *READING, "--precision", "--sharp")),  # for the base that it chooses
}
HF_FILE_PATTERNS: tuple[str, ...] = (
    "config.json",
    "preprocessor_config.json",
    "processor_config.json",
)
HF_FILE_PATTERNS += ("model.safetensors", "model-*.safetensors", "model.safetensors.index.json")
Depth = (
    Path | DepthMap | None
)  # a photo's depth; a path may be a folder of depth maps named like the photos


def _download(name: str) -> str:
    return f"`spackle weights get {name}` ({decimal(PUBLISHED_WEIGHTS[name].bytes)}, {PUBLISHED_WEIGHTS[name].licence})"


ROUGH_GEOMETRY_ADVICE = f"rough geometry; give --depth FILE for better geometry, or run {_download('depth')}, or {_download('sharp')}"
MISSING_WEIGHTS_ADVICE = {  # what to do if a base's weights are missing
    "sharp": f"no weights of SHARP on this machine: {_download('sharp')} downloads them, -c FILE takes a local copy",
    "moge": f"no weights of MoGe on this machine: {_download('depth')} downloads them, -c FILE takes a local copy",
}


def _weights_here(name: str) -> Path | None:
    """The file with a base's weights on this machine; None if it is missing."""
    if name == "lite":
        return lite.SHIPPED_WEIGHTS if lite.SHIPPED_WEIGHTS.is_file() else None
    return (
        installed_weights({"sharp": "sharp", "moge": "depth"}[name])
        if name in MISSING_WEIGHTS_ADVICE
        else None
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class BaseSettings:
    """A base's name and options."""

    name: str = AUTO  # or another name in `KINDS`, or `hf:…`
    depth: Depth = None
    calib: Path | None = None  # calibration of a disparity map
    depth_kind: DepthKind = "auto"  # what the numbers of a depth map are
    near: float | None = (
        None  # nearest depth of a relative map in metres; None: `load_depth`'s default
    )
    far: float | None = None  # farthest depth of a relative map in metres
    checkpoint: Path | None = None  # weights of SHARP, MoGe or lite
    precision: Precision = "auto"  # of the network
    windows_per_batch: int | None = (
        None  # number of windows that SHARP computes at once; 1 takes the least memory
    )
    device: str = "auto"

    @property
    def resolved_name(self) -> str:
        """The base's name; `auto` becomes `rgbd` if a depth map is given, else `sharp` if a checkpoint is given."""
        if self.name != AUTO:
            return self.name
        return RGBD if self.depth is not None else AUTO if self.checkpoint is None else "sharp"

    @property
    def uses_network(self) -> bool:
        """Whether the base predicts from the photo alone; otherwise it needs the photo's depth."""
        return self.resolved_name != RGBD

    @property
    def model_folder(self) -> Path | None:
        """The folder that `hf:…` names; None for a model on the hub and for other bases."""
        folder = os.path.expanduser(self.name.removeprefix(HF_PREFIX))
        return Path(folder) if self.name.startswith(HF_PREFIX) and os.path.isdir(folder) else None

    @property
    def public_name(self) -> str:
        """The base's name in published results; only the last part of a folder's path."""
        return (
            self.resolved_name
            if self.model_folder is None
            else HF_PREFIX + self.model_folder.resolve().name
        )

    @property
    def description(self) -> str:
        """The base's description below tables."""
        return KINDS[self.resolved_name.partition(":")[0]][0]

    @property
    def model_files(self) -> dict[str, Path]:
        """The files that predictions depend on: weights by the base's name, or a folder's files by their own names."""
        if self.model_folder is not None:
            return {
                file.name: file
                for p in HF_FILE_PATTERNS
                for file in sorted(self.model_folder.glob(p))
                if file.is_file()
            }
        names = AUTO_NETWORKS if self.resolved_name == AUTO else (self.resolved_name,)
        found = {name: self.checkpoint or _weights_here(name) for name in names}
        return {name: file for name, file in found.items() if file is not None}

    def check(self, *, one: bool = False) -> None:
        """InputError for an unknown base or an option that the base cannot use; if `one`, also for the base `auto`."""
        if one and self.name == AUTO:
            known = ", ".join((RGBD, *NETWORK_BASES))
            raise InputError(
                f"--base {AUTO} is not allowed here, because the results name their base: give {known}"
            )
        if self.name == HF_PREFIX:
            raise InputError(
                f"--base {HF_PREFIX} names no model: give a Hugging Face model as owner/name, or a folder"
            )
        if not self.name.startswith(HF_PREFIX):
            check_name("base", self.name, (AUTO, RGBD, *NETWORK_BASES))
        check_name("precision", self.precision, PRECISIONS)
        options = {
            "--depth": self.depth.path if isinstance(self.depth, DepthMap) else self.depth,
            "--calib": self.calib,
            "--depth-kind": None if self.depth_kind == "auto" else self.depth_kind,
            "--near": self.near,
            "--far": self.far,
            "-c": self.checkpoint,
            "--precision": None if self.precision == "auto" else self.precision,
            "--sharp": self.windows_per_batch and f"windows={self.windows_per_batch}",
        }
        kind = self.resolved_name.partition(":")[0]
        for option, value in options.items():
            if value is not None and option not in KINDS[kind][1]:
                raise InputError(
                    f"{option} {value}: the {kind} base does not take this option: leave it out"
                )
        check_window_batch("--sharp windows", self.windows_per_batch)
        check_name("depth_kind", self.depth_kind, DEPTH_KINDS)
        for option in ("--calib", *READING):
            if (value := options[option]) is not None and self.depth is None:
                raise InputError(
                    f"{option} {value}: there is no depth map to read: give the map with --depth"
                )
            if (
                value is not None
                and option in ("--near", "--far")
                and self.depth_kind not in RELATIVE_KINDS
            ):
                raise InputError(
                    f"{option} {value}: only for relative maps: add --depth-kind {' or '.join(RELATIVE_KINDS)}"
                )
        if self.resolved_name in MISSING_WEIGHTS_ADVICE and not self.model_files:
            raise InputError(
                f"--base {self.resolved_name}: {MISSING_WEIGHTS_ADVICE[self.resolved_name]}"
            )
