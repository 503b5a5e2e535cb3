"""The choices of `spackle dataset build`, their checks, and their names in the manifest."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import spackle
from spackle.bases.depth_map import find_depth
from spackle.bases.open import NETWORKS, BaseSettings, kind_of
from spackle.camera_path import MAX_DISPARITY, TrajectoryKind
from spackle.dataset.photos import PhotoFile
from spackle.dataset.views import COMPLETIONS, Completion
from spackle.errors import InputError, check_name
from spackle.files import fingerprint
from spackle.folders import digest_of
from spackle.inpaint import INPAINTERS
from spackle.residual import MASK_THRESHOLD
from spackle.weights import weights_digest
from spackle.workers import Workers


@dataclasses.dataclass(frozen=True)
class DatasetOptions:
    """The choices of `spackle dataset build`; the command line keeps its numbers within their bounds."""

    base: BaseSettings
    images: Path | None = None  # folder of the photos of a COCO JSON
    sample: int | None = None  # number of photos; all where None
    seed: int = 0  # of the choice and of the paths
    views: int = 20  # of a photo, its own among them, as in the paper
    trajectory: TrajectoryKind | None = None  # drawn for each photo where None
    disparity: tuple[float, float] = (0.1, 0.6)  # drawn between these, see `spackle.camera_path.max_offset`
    inpainter: str = "geometry"  # of `COMPLETIONS`
    inpainter_weights: Path | None = None  # a file or a folder, for one with a network
    inpainter_side: int | None = None  # long side in pixels at which its network works
    workers: int = 1  # processes
    ray: str | None = None  # address of their cluster; this machine where None
    threads: int = 2  # of each
    shard_size: int = 50  # photos

    @property
    def inpaints_by_network(self) -> bool:
        return self.inpainter in INPAINTERS and INPAINTERS[self.inpainter].network

    @property
    def processes(self) -> Workers:
        network = self.base.kind.network or self.inpaints_by_network
        return Workers(self.workers, self.threads, self.ray, gpu=network and self.base.device != "cpu")

    def check(self) -> None:
        """InputError for options that do not go together; inpainters check theirs themselves."""
        kind_of(self.base.name)  # a dataset says of which base it is, so no `auto`
        self.base.check()
        depth = self.base.depth
        if depth is None and not self.base.kind.network:
            raise InputError(
                f"--base {self.base.name} needs the photos' depth: give --depth FOLDER; {', '.join(NETWORKS)} need none"
            )
        if isinstance(depth, Path) and not depth.is_dir():  # one map for all photos would be wrong for all but one
            raise InputError(f"--depth {depth}: no such folder: a dataset takes one with a depth map for each photo")
        check_name("--inpainter", self.inpainter, COMPLETIONS)
        for option, value in (("weights", self.inpainter_weights), ("side", self.inpainter_side)):
            if value is not None and not self.inpaints_by_network:
                line = f"--inpainter-{option} {value}: the {self.inpainter} inpainter has no network"
                raise InputError(f"{line}: leave the option out")
        low, high = self.disparity
        if not 0 < low <= high <= MAX_DISPARITY:
            raise InputError(
                f"--disparity {low:g} {high:g}: give the smaller and the greater, above 0 and up to {MAX_DISPARITY:g}"
            )
        self.processes.check()

    def depth_of(self, photo: PhotoFile) -> Path | None:
        """A photo's depth map in --depth, below the photo's subfolder; None without --depth; InputError if missing."""
        folder = self.base.depth
        if not isinstance(folder, Path):
            return None
        beside = folder / Path(photo.name).parent
        return find_depth(beside if beside.is_dir() else folder, photo.path)

    def inputs_of(self, photo: PhotoFile) -> list[str]:
        """Name and content of a photo and of its depth map."""
        try:
            depth = self.depth_of(photo)
            return [photo.name, photo.sha256, *([fingerprint(depth, "depth map")] if depth else [])]
        except InputError:  # the build names it later
            return [photo.name, photo.sha256, "none"]


def configuration(options: DatasetOptions, photos: Sequence[PhotoFile], completion: Completion) -> dict[str, Any]:
    """Everything that decides what the shards hold, ready for JSON, without the places of files.

    Threads are part of it: SHARP's last bits depend on their number. Workers are not.
    """
    base = options.base
    weights = {name: weights_digest(file) for name, file in completion.files.items()}
    return {
        "spackle": spackle.__version__,
        "photos": {
            "count": len(photos),
            "sample": options.sample,
            "sha256": digest_of([options.inputs_of(photo) for photo in photos]),
        },
        "base": {
            "name": base.public_name,
            "weights": base_digest(base.files),
            "precision": base.precision,
            "device": base.device,
        },
        "views": {
            "seed": options.seed,
            "views": options.views,
            "trajectory": options.trajectory,
            "disparity": list(options.disparity),
            "threshold": MASK_THRESHOLD,
        },
        "inpainter": {"name": completion.name, "version": completion.version}
        | ({"weights": weights} if weights else {}),
        "shard_size": options.shard_size,
        "threads": options.threads,
    }


def base_digest(files: Mapping[str, Path]) -> str | dict[str, str] | None:
    """SHA-256 of a base's weights, of each file where there are several; None where none are known."""
    digests = {name: weights_digest(file) for name, file in files.items()}
    return digests if len(digests) > 1 else next(iter(digests.values()), None)
