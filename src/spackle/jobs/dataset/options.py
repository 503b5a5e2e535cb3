"""The choices of `spackle dataset build`, which of them cannot be, and what they are called in the manifest."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import spackle
from spackle.bases.open import find_depth, kind_of
from spackle.camera_path import MAX_DISPARITY, TRAJECTORIES, TrajectoryKind, spelled
from spackle.device import Precision
from spackle.digest import digest_of, fingerprint, weights_digest
from spackle.errors import InputError
from spackle.image import MAX_SIDE
from spackle.jobs.bases import public_name
from spackle.jobs.options import PredictOptions, check_has_depth, check_options
from spackle.pseudo.build import ViewChoices
from spackle.pseudo.inpainters import Inpainter, InpainterOptions
from spackle.pseudo.photos import PhotoFile
from spackle.pseudo.propainter import MIN_SIDE, SIDE
from spackle.pseudo.propainter_weights import weight_files

MAX_VIEWS = 100  # two digits name a view
MAX_PHOTOS = 1_000_000  # six digits name a photo
MAX_THREADS = 1024


@dataclasses.dataclass(frozen=True)
class DatasetOptions:
    """The choices of `spackle dataset build`."""

    base: PredictOptions  # its name and what it needs
    choices: ViewChoices
    images: Path | None = None  # where the photos of a COCO JSON lie
    sample: int | None = None  # so many photos; all where None
    inpainter: str = "geometry"
    inpainter_weights: Path | None = None  # a folder, for propainter
    inpainter_side: int | None = None  # pixels of the long side at which propainter works
    workers: int = 1  # processes
    ray: str | None = None  # the cluster where they are; this machine where None
    threads: int = 2  # of each
    shard_size: int = 50  # photos

    @property
    def for_inpainter(self) -> InpainterOptions:
        """What an inpainter with a network takes."""
        device = None if self.base.device == "auto" else self.base.device
        return InpainterOptions(self.inpainter_weights, self.inpainter_side or SIDE, device)


def base_options(
    base: str, depth: Path | None, checkpoint: Path | None, precision: Precision, device: str
) -> PredictOptions:
    """What a prediction takes, without any completion."""
    return PredictOptions(
        base=base, depth=depth, checkpoint=checkpoint, precision=precision, device=device, residual="none"
    )


def view_choices(seed: int, views: int, trajectory: str | None, disparity: tuple[float, float]) -> ViewChoices:
    """Which views; a trajectory by its name in `TRAJECTORIES`."""
    kinds: dict[str, TrajectoryKind] = {name: name for name in TRAJECTORIES}
    return ViewChoices(seed, views, None if trajectory is None else kinds[trajectory], disparity)


def check_dataset_options(options: DatasetOptions) -> None:
    """InputError for an option that cannot be used, whatever the photos."""
    kind_of(options.base.base)  # a dataset says of which base it is, so no `auto`
    check_options(options.base)
    check_has_depth(options.base)
    depth = options.base.depth
    if depth is not None and not depth.is_dir():  # one map for all photos would be wrong for all but one
        raise InputError(f"--depth {depth}: no such folder: a dataset takes one with a depth map for each photo")
    choices = options.choices
    low, high = choices.disparity
    if not 0 < low <= high <= MAX_DISPARITY:
        raise InputError(
            f"--disparity {low:g} {high:g}: give the smaller and the greater, above 0 and up to {MAX_DISPARITY:g}"
        )
    for name, value, least, most in (
        ("--views", choices.views, 2, MAX_VIEWS),
        ("--seed", choices.seed, 0, 2**31 - 1),
        ("--sample", 1 if options.sample is None else options.sample, 1, MAX_PHOTOS),
        ("--workers", options.workers, 1, MAX_THREADS),
        ("--threads", options.threads, 1, MAX_THREADS),
        ("--shard-size", options.shard_size, 1, MAX_PHOTOS),
        ("--inpainter-side", SIDE if options.inpainter_side is None else options.inpainter_side, MIN_SIDE, MAX_SIDE),
    ):
        if not least <= value <= most:
            raise InputError(f"{name} must be between {least} and {most}, got {value}")
    for name, given in (("weights", options.inpainter_weights), ("side", options.inpainter_side)):
        if given is not None and options.inpainter != "propainter":
            raise InputError(
                f"--inpainter-{name} {given}: the {options.inpainter} inpainter has no network: leave the option out"
            )


def configuration(options: DatasetOptions, photos: Sequence[PhotoFile], inpainter: Inpainter) -> dict[str, Any]:
    """Everything that decides what the shards hold, ready for JSON; nothing of where files lie.

    Threads are part of it: SHARP's last bits depend on their number. Workers are not.
    """
    base = options.base
    inputs = digest_of([inputs_of(photo, base) for photo in photos])
    choices, kind = dataclasses.asdict(options.choices), options.choices.trajectory
    return {
        "spackle": spackle.__version__,
        "photos": {"count": len(photos), "sample": options.sample, "sha256": inputs},
        "base": {
            "name": public_name(base.base),
            "weights": base_digest(base),
            "precision": base.precision,
            "device": base.device,
        },
        "views": choices | {"disparity": list(options.choices.disparity), "trajectory": kind and spelled(kind)},
        "inpainter": {"name": inpainter.name, "version": inpainter.version} | _inpainter_weights(options),
        "shard_size": options.shard_size,
        "threads": options.threads,
    }


def _inpainter_weights(options: DatasetOptions) -> dict[str, dict[str, str]]:
    """SHA-256 of each file of an inpainter that has any."""
    if options.inpainter_weights is None:
        return {}
    return {"weights": {name: weights_digest(file) for name, file in weight_files(options.inpainter_weights).items()}}


def depth_of(photo: PhotoFile, depth: Path) -> Path:
    """The depth map of a photo: in a folder, below the same subfolder as the photo.

    Raises:
        InputError: there is none.
    """
    beside = depth / Path(photo.name).parent
    return find_depth(beside if depth.is_dir() and beside.is_dir() else depth, photo.path)


def base_digest(base: PredictOptions) -> str | dict[str, str] | None:
    """SHA-256 of the base's weights, of each file where there are several; None where none are known."""
    digests = {name: weights_digest(file) for name, file in base.base_files.items()}
    return digests if len(digests) > 1 else next(iter(digests.values()), None)


def inputs_of(photo: PhotoFile, base: PredictOptions) -> list[str]:
    """Name and content of a photo and of its depth map."""
    if base.depth is None:
        return [photo.name, photo.sha256]
    try:
        return [photo.name, photo.sha256, fingerprint(depth_of(photo, base.depth), "depth map")]
    except InputError:  # its turn will come
        return [photo.name, photo.sha256, "none"]
