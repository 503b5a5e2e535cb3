"""Big files that others publish: fetched once, continued after a break, whole or not there, and recorded."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from pathlib import Path

from spackle.downloads.transfer import BLOCK, Progress, check_url, digest, read_json, receive, version_file, write_json
from spackle.errors import InputError
from spackle.files import hold

AGAIN = "run `spackle weights get` again"


@dataclasses.dataclass(frozen=True)
class DownloadRecord:
    """What was downloaded; lies beside the file as NAME.json.

    The digest is that of the first download: it shows damage and later change, not a download that was bad at once.
    """

    url: str
    size: int  # bytes
    sha256: str  # 64 hexadecimal digits


def weights_folder() -> Path:
    """Where downloaded weights lie: $SPACKLE_WEIGHTS, else spackle/weights in $XDG_CACHE_HOME or ~/.cache.

    InputError where none is set, and there is no home.
    """
    try:
        if chosen := os.environ.get("SPACKLE_WEIGHTS"):
            return Path(chosen).expanduser()
        cache = Path(os.environ.get("XDG_CACHE_HOME", ""))
        return (cache if cache.is_absolute() else Path.home() / ".cache") / "spackle" / "weights"
    except RuntimeError as error:
        raise InputError("no home folder for downloaded weights: name a folder in SPACKLE_WEIGHTS") from error


def download(
    url: str, path: str | os.PathLike[str], progress: Progress | None = None, published: str | None = None
) -> DownloadRecord:
    """Fetch `url` (http or https, without a password) to `path` in a folder that exists, and write its record.

    A file that is there is replaced at the end; until then what has come lies in NAME.part. After a break, a kill or
    Ctrl-C the next call asks for the rest only, unless the remote file has changed or the server cannot do that.
    `progress` gets the bytes done, those of earlier calls among them, and their number; `published` is a digest as in
    `KnownWeights`.

    Raises:
        InputError: the file cannot be had or not be written, is another one, or another process is at it.
    """
    check_url(url)
    target = _real(path)
    if os.path.exists(target) and not os.path.isfile(target):
        raise InputError(f"{path}: cannot write: this is not a plain file; give another name")
    part = _beside(target, ".part")
    try:
        with hold(_beside(target, ".lock")):
            record = DownloadRecord(url, *receive(url, part, progress or (lambda done, total: None)))
            if published is not None and not _has_digest(part, published):
                part.unlink()
                version_file(part).unlink()
                raise InputError(f"{url}: what came has not the digest {published}: take another address")
            # The record first: a kill in between leaves a file that its record refuses, not one without.
            write_json(dataclasses.asdict(record), _beside(target, ".json"))
            os.replace(part, target)
            version_file(part).unlink()
            return record
    except BlockingIOError as error:
        raise InputError(f"{path}: another process is downloading this file: wait until it is done") from error
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{path}: cannot write: {reason}: make room or choose another folder") from error


def read_record(path: str | os.PathLike[str]) -> DownloadRecord | None:
    """The record beside a file; None where none lies there, InputError for one that makes no sense."""
    place = _beside(_real(path), ".json")
    try:
        fields = read_json(place)
        if fields is None or "sha256" not in fields:  # somebody's notes on a file of their own
            return None
        return DownloadRecord(str(fields["url"]), int(fields["size"]), str(fields["sha256"]))
    except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:  # the last: a size of 1e400
        raise InputError(f"{place}: this record of a download cannot be read: delete it and {AGAIN}") from error


def check_recorded(path: str | os.PathLike[str]) -> DownloadRecord | None:
    """Hold a file against its record: size first, then every byte. None where it has none.

    InputError where they differ, or one of them cannot be read.
    """
    record = read_record(path)
    if record is None:
        return None
    try:
        size = os.path.getsize(path)
        if size != record.size:
            raise InputError(f"{path}: {size:,} bytes, but {record.size:,} were downloaded: delete it and {AGAIN}")
        with open(path, "rb") as file:
            found = digest(file).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
    if found != record.sha256:
        raise InputError(f"{path}: its SHA-256 is not that of what was downloaded: delete it and {AGAIN}")
    return record


def _has_digest(path: Path, published: str) -> bool:
    """Whether a file has a digest, given as sha256:HEX or md5:HEX, of which HEX may be the beginning."""
    kind, _, digits = published.partition(":")
    found = hashlib.new(kind, usedforsecurity=kind != "md5")
    with open(path, "rb") as file:
        while block := file.read(BLOCK):
            found.update(block)
    return found.hexdigest().startswith(digits)


def _real(path: str | os.PathLike[str]) -> Path:
    """The file itself, links followed: beside it lie its record and its part."""
    try:
        return Path(os.path.realpath(path))
    except (OSError, ValueError) as error:  # a zero byte in the name
        raise InputError(f"{str(path)!r}: not the name of a file: {error}") from error


def _beside(file: Path, suffix: str) -> Path:
    return file.with_name(file.name + suffix)


@dataclasses.dataclass(frozen=True)
class KnownWeights:
    """One published file."""

    name: str
    url: str
    file: str  # its name in the folder of weights
    licence: str  # in a few words
    notice: tuple[str, ...]  # lines that a person sees before the download
    named_by: str  # the option that names a copy elsewhere
    published: str | None = None  # sha256:HEX or md5:HEX, or the beginning, where it was published with the file
    hub: HubFiles | None = None  # where it comes from the hub, with files that belong to it


@dataclasses.dataclass(frozen=True)
class HubFiles:
    """One revision of a model on huggingface.co, which huggingface_hub fetches."""

    model: str  # owner/name
    revision: str  # the commit
    sha256: str  # of the file of weights, as the hub's page states it
    others: tuple[str, ...] = ("config.json", "preprocessor_config.json")  # that lie beside it


DEPTH_ANYTHING = HubFiles(
    "depth-anything/Depth-Anything-V2-Small-hf",
    "5426e4f0f36572d16453bbda7a8389317b1bef99",
    "3152477ce0d8d6978d76b995120de97cb5b928701fd0f817769f59e249a16b70",
)
WEIGHTS = {
    "sharp": KnownWeights(
        name="sharp",
        url="https://ml-site.cdn-apple.com/models/sharp/sharp_2572gikvuh.pt",
        file="sharp_2572gikvuh.pt",
        licence="Apple, research only",
        notice=(
            "SHARP's weights are Apple's, under the Apple Machine Learning Research Model licence:",
            "for non-commercial scientific research only. Spackle's own licence does not cover them.",
            "Read its terms: https://github.com/apple/ml-sharp/blob/main/LICENSE_MODEL",
        ),
        named_by="--checkpoint names it to predict",
    ),
    "lama": KnownWeights(
        name="lama",
        url="https://github.com/Sanster/models/releases/download/add_big_lama/big-lama.pt",
        file="big-lama.pt",
        licence="Apache-2.0",
        notice=(
            "LaMa's weights are its authors' (Suvorov et al., 2022), under the Apache License 2.0:",
            "https://github.com/advimman/lama/blob/main/LICENSE",
        ),
        named_by="--inpainter-weights names it to dataset build",
        published="md5:e3aa4aaa15225a33ec84f9f4bc47e500",
    ),
    "features": KnownWeights(
        name="features",
        url="https://download.pytorch.org/models/resnet50-0676ba61.pth",
        file="resnet50-0676ba61.pth",
        licence="BSD-3-Clause",
        notice=(
            "ResNet-50's weights (98 MB, learned from ImageNet) are torchvision's, under the BSD 3-Clause License:",
            "https://github.com/pytorch/vision/blob/main/LICENSE",
        ),
        named_by="loss.features_path names it to train",
        published="sha256:0676ba61",  # torchvision's file names end with its beginning
    ),
    "depth": KnownWeights(
        name="depth",
        url=f"https://huggingface.co/{DEPTH_ANYTHING.model}/resolve/{DEPTH_ANYTHING.revision}/model.safetensors",
        file="depth-anything-v2-small/model.safetensors",
        licence="Apache-2.0",
        notice=(
            "Depth-Anything-V2-Small (99 MB) is its authors' (Yang et al., 2024), under the Apache License 2.0:",
            f"https://huggingface.co/{DEPTH_ANYTHING.model}",
        ),
        named_by="--base hf:FOLDER names its folder",
        hub=DEPTH_ANYTHING,
    ),
}


def known_weights(name: str) -> KnownWeights:
    """The entry of that name; InputError where there is none."""
    if name not in WEIGHTS:
        raise InputError(f"{name}: no weights of that name are known: choose from {', '.join(WEIGHTS)}")
    return WEIGHTS[name]


def installed(name: str) -> Path | None:
    """The file of known weights in the folder of weights; None where it is not there."""
    path = weights_folder() / known_weights(name).file
    return path if os.path.isfile(path) else None


def weights_digest(path: Path) -> str:
    """SHA-256 of a checkpoint: the recorded one of a download, else of the file."""
    record = read_record(path)
    if record is not None:
        return record.sha256
    with open(path, "rb") as file:
        return digest(file).hexdigest()
