"""What a result depends on, in one digest: so a folder that was interrupted goes on where it stopped."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import spackle
from spackle.bases.depth_maps import calibrations_beside
from spackle.image import check_file
from spackle.jobs.bases import hf_folder
from spackle.jobs.inputs import find_depth
from spackle.jobs.options import PredictOptions

MAX_HASHED = 200_000_000  # bytes of a file that is read to tell whether it has changed
# Options that change no result but by its last bits, or stand there in other words.
IRRELEVANT = ("overwrite", "residual", "low_memory", "windows", "compiled")


def shared_digest(options: PredictOptions) -> str:
    """A digest of all that the photos have in common: the version, the options, and what their files hold.

    Raises:
        InputError: one of the files is missing.
    """
    files = {"calibration": options.calib, "camera file": options.cameras, "path file": options.path}
    files["weights"] = options.residual_file
    choices = {name: value for name, value in dataclasses.asdict(options).items() if not isinstance(value, Path)}
    for name in IRRELEVANT:
        del choices[name]
    base = options.named if hf_folder(options.named) is None else "hf"  # its files tell, wherever they lie
    choices |= {"spackle": spackle.__version__, "residual": options.residual_weights, "base": base}
    weights = {name: fingerprint(file, name) for name, file in options.base_files.items()}
    return digest_of([choices, weights, *(file and fingerprint(file, kind) for kind, file in files.items())])


def request_of(photo: Path, options: PredictOptions, shared: str) -> str:
    """A digest of all that the result of one photo depends on.

    Raises:
        InputError: the photo or its depth map is missing.
    """
    files = [fingerprint(photo, "photo")]
    if options.depth is not None:
        depth = find_depth(options.depth, photo)
        files.append(fingerprint(depth, "depth map"))
        files += [fingerprint(file, "calibration") for file in calibrations_beside(depth) if file.is_file()]
    return digest_of([shared, *files])


def fingerprint(file: Path, kind: str) -> str:
    """The digest of what a file holds; of gigabytes, which would take seconds to read, size and time of change.

    Raises:
        InputError: no such file; `kind` names it in the message.
    """
    size = check_file(file, kind)
    if size > MAX_HASHED:
        return f"{size} bytes of {file.stat().st_mtime_ns}"
    return hashlib.sha256(file.read_bytes()).hexdigest()


def digest_of(value: object) -> str:
    """SHA-256 of a value as JSON."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
