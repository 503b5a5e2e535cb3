"""What a result depends on, in one digest: so a folder that was interrupted goes on where it stopped."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import spackle
from spackle.bases.depth_map import calibrations_beside
from spackle.bases.open import find_depth
from spackle.digest import digest_of, fingerprint
from spackle.jobs.options import PredictOptions

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
    base = options.named if options.settings.folder is None else "hf"  # its files tell, wherever they lie
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
