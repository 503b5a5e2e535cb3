"""The bases that a command line can name: what each is, what it takes and what it does not."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

from spackle.bases.hf_hub import SETTINGS, WEIGHTS
from spackle.bases.lite import base as lite
from spackle.choose import sharp_here
from spackle.downloads import installed, known_weights, read_record
from spackle.errors import InputError
from spackle.jobs.names import check_name

AUTO = "auto"
HF = "hf:"  # what follows is a folder, or a model of the hub
ANY_HF = "hf:NAME_OR_FOLDER"
NOT_SHARP = "not SHARP, so not the paper's base"


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


def title_of(name: str) -> str:
    """What tables call a base."""
    return public_name(name) if name.startswith(HF) else kind_of(name).title


def says_of(name: str, checkpoint: Path | None) -> str:
    """What tables say of a base with these weights: Apple's are those that were downloaded from Apple.

    Raises:
        InputError: there is no such base, or the record of a download cannot be read.
    """
    file = base_files(name, checkpoint).get("checkpoint") if name == "sharp" else None
    record = None if file is None else read_record(file)
    if file is None or (record is not None and record.url == known_weights("sharp").url):
        return kind_of(name).says
    return f"a network of SHARP's shape, from the photo alone, by weights of unknown origin: {file.name}"


def public_name(name: str) -> str:
    """A base's name for results that others read: of a folder its last part, not where it lies."""
    folder = hf_folder(name)
    return name if folder is None else HF + folder.resolve().name


def hf_folder(name: str) -> Path | None:
    """The folder that `hf:…` names; None for a model of the hub and for other bases."""
    folder = os.path.expanduser(name.removeprefix(HF))
    return Path(folder) if name.startswith(HF) and os.path.isdir(folder) else None


def base_files(name: str, checkpoint: Path | None) -> dict[str, Path]:
    """Files with weights that decide what a base predicts, as far as they are here.

    Args:
        name: as --base names it, `auto` too.
        checkpoint: as -c names it, if any.

    Returns:
        what messages call a file, to where it lies.
    """
    if folder := hf_folder(name):
        patterns = (*SETTINGS, *WEIGHTS)
        return {file.name: file for pattern in patterns for file in sorted(folder.glob(pattern)) if file.is_file()}
    found: dict[str, Path | None] = {}
    if name in ("sharp", AUTO):
        found["checkpoint"] = sharp_here() if name == AUTO else checkpoint or installed("sharp")
    if name in ("lite", AUTO):
        found["lite weights"] = (checkpoint if name == "lite" else None) or shipped_lite()
    return {title: file for title, file in found.items() if file is not None}


def shipped_lite() -> Path | None:
    """The weights of lite that come with the package; None where a build has none."""
    return lite.SHIPPED if lite.SHIPPED.is_file() else None
