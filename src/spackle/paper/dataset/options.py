"""The options of `spackle dataset build`, and the record of all that determines a dataset."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import spackle
from spackle.bases.settings import NETWORK_BASES, BaseSettings
from spackle.core.photo_lists import MANIFEST_SUFFIX
from spackle.core.trajectories import MAX_DISPARITY, SharpTrajectory
from spackle.depth.readers import find_depth_file
from spackle.inpaint import (
    Inpainter,
    InpainterOptions,
    get_inpainter,
    inpainter_class,
    is_inpainter,
)
from spackle.paper.dataset.photos import PhotoFile
from spackle.paper.dataset.views import COMPLETIONS
from spackle.residual import MASK_THRESHOLD
from spackle.runtime.declared_options import KeptFiles
from spackle.runtime.digests import file_fingerprint, json_digest
from spackle.runtime.errors import InputError
from spackle.runtime.plugins import check_name_or_plugin, plugin_digests
from spackle.weights import weights_digest, weights_digests


@dataclasses.dataclass(frozen=True, kw_only=True)
class DatasetOptions:
    """The options of `spackle dataset build`; the command line checks the bounds of its numbers."""

    base: BaseSettings  # turns a photo into Gaussians: a network, or depth maps
    images: Path | None = None  # folder of a list's photos; None: the list's own
    sample: int | None = None  # number of photos; None: all
    seed: int = 0  # for the choice of photos and paths
    views: int = 20  # per photo, including the photo's camera, as in the paper
    trajectory: SharpTrajectory | None = None  # the camera path; None: drawn for each photo
    # Range of the random disparity, which says how far the camera moves.
    disparity: tuple[float, float] = (0.1, 0.6)
    inpainter: str = "exemplar"  # how holes are completed, one of `COMPLETIONS`
    inpainter_weights: Path | None = None  # a file or folder, if the inpainter has a network
    # Long side in pixels of the images that the inpainter's network gets; None: its own default.
    inpainter_side: int | None = None
    workers: int | None = None  # processes; None: one a GPU, or one
    threads: int = 2  # threads per process
    ray: str | None = None  # address of a Ray cluster, whose machines make the samples
    shard_size: int = 50  # photos per shard, that is, per tar file
    keep: KeptFiles = "all"  # "targets": only what training cannot make again

    def open_inpainter(self) -> Inpainter | None:
        """Open the inpainter, which paints holes; None if holes are completed in another way.

        InputError if a package or weights are missing.
        """
        if not is_inpainter(self.inpainter):
            return None
        # None lets the inpainter choose for itself.
        device = None if self.base.device == "auto" else self.base.device
        options = InpainterOptions(
            weights=self.inpainter_weights, side=self.inpainter_side, device=device
        )
        return get_inpainter(self.inpainter, options)

    def check(self, source: Path) -> None:
        """InputError if options contradict each other, or `source`, the folder or list of photos.

        Inpainters check their own options when they are opened.
        """
        # "auto" may take another network on another machine, so a dataset names its base.
        self.base.check(allow_auto=False)
        self._check_depth(source)
        self._check_completion()
        low, high = self.disparity
        if not 0 < low <= high <= MAX_DISPARITY:
            raise InputError(
                f"`disparity` {low:g} {high:g}: give two numbers above 0 and up to "
                f"{MAX_DISPARITY:g}, the smaller first"
            )

    def _check_depth(self, source: Path) -> None:
        """InputError if the base needs depth and gets none, or depth is not a folder."""
        depth = self.base.depth
        # A manifest may name a depth map for each photo; a photo without one is passed over.
        has_manifest = source.suffix.lower() == MANIFEST_SUFFIX
        if depth is None and not self.base.uses_network and not has_manifest:
            raise InputError(
                f"`base` {self.base.name} needs depth: give `depth` FOLDER, or a manifest of the "
                f"photos ({MANIFEST_SUFFIX}) that names their depth maps; "
                f"{', '.join(NETWORK_BASES)} need no depth"
            )
        # A file would be the depth of a single photo.
        if isinstance(depth, Path) and not depth.is_dir():
            raise InputError(
                f"`depth` {depth}: no such folder: give a folder with a depth map for each photo"
            )

    def _check_completion(self) -> None:
        """InputError for an unknown way to complete holes, or options that it does not take.

        Only inpainters with a network take weights and a size.
        """
        takes_options = False
        if is_inpainter(self.inpainter):
            takes_options = inpainter_class(self.inpainter).uses_network
        else:
            check_name_or_plugin("inpainter", self.inpainter, COMPLETIONS)
        has_options = self.inpainter_weights is not None or self.inpainter_side is not None
        if has_options and not takes_options:
            raise InputError(
                f"`inpainter` {self.inpainter} takes neither `inpainter_weights` nor "
                "`inpainter_side`"
            )

    def find_depth(self, photo: PhotoFile) -> Path | None:
        """A photo's depth map: the manifest's, or that in the photo's subfolder of `base.depth`, or
        else that in `base.depth` itself.

        None if the base takes no depth. InputError if there is no map for the photo.
        """
        if photo.depth is not None and not self.base.uses_network:
            return photo.depth
        folder = self.base.depth
        if not isinstance(folder, Path):
            return None
        # Photos of the same name may lie in several subfolders.
        subfolder = folder / Path(photo.name).parent
        return find_depth_file(subfolder if subfolder.is_dir() else folder, photo.path)

    def input_digests(self, photo: PhotoFile) -> list[str]:
        """Name and digest of a photo, the focal length that its manifest states, and the digest of
        its depth map; without what it does not have."""
        digests = [photo.name, photo.sha256]
        digests += [f"{option} {value}" for option, value in photo.lens.stated.items()]
        # A missing depth map is no error yet: the build reports it, and goes on.
        with contextlib.suppress(InputError):
            depth_file = self.find_depth(photo)
            if depth_file is not None:
                digests.append(file_fingerprint(depth_file, "depth map"))
        return digests


def dataset_configuration(
    options: DatasetOptions, photos: Sequence[PhotoFile], inpainter: Inpainter | None
) -> dict[str, Any]:
    """Everything that determines the shards' bytes, ready for JSON, without paths of this machine.

    The number of threads is included, because the last bits of SHARP's results depend on it. The
    number of workers, that is, of processes, changes nothing.

    Args:
        options: of the build.
        photos: the photos that were chosen.
        inpainter: paints the holes; None if they are completed in another way.
    """
    base = options.base
    completion: dict[str, Any] = completion_facts(options, inpainter)
    if inpainter is not None and inpainter.weight_files:
        completion["weights"] = {
            name: weights_digest(file) for name, file in inpainter.weight_files.items()
        }
    code = plugin_digests({"inpainter": options.inpainter})
    if code:
        completion["code"] = code
    inputs_digest = json_digest([options.input_digests(photo) for photo in photos])
    # How the numbers of depth maps were read; what nobody stated is left out.
    depth_reading: dict[str, Any] = {}
    if base.depth_kind != "auto":
        depth_reading["depth_kind"] = base.depth_kind
    if base.depth_unit is not None:
        depth_reading["depth_unit"] = base.depth_unit
    # A dataset with all files says nothing about them.
    kept_files = {} if options.keep == "all" else {"keep": options.keep}
    return {
        "spackle": spackle.__version__,
        "photos": {
            "count": len(photos),
            "sample": options.sample,  # the number of photos that the user asked for; None: all
            "sha256": inputs_digest,
        },
        # What turned photos into Gaussians: a network, or depth maps.
        "base": {
            "name": base.public_name,
            "weights": weights_digests(base.model_files),
            "precision": base.precision,
            "device": base.device,
            **depth_reading,
        },
        "views": {
            "seed": options.seed,
            "views": options.views,
            "trajectory": options.trajectory,
            "disparity": list(options.disparity),
            "threshold": MASK_THRESHOLD,  # opacity below which a pixel is a hole
        },
        "inpainter": completion,
        "shard_size": options.shard_size,
        "threads": options.threads,
        **kept_files,
    }


def completion_facts(options: DatasetOptions, inpainter: Inpainter | None) -> dict[str, str]:
    """How holes are completed: the name and version of the inpainter, or of another way."""
    version = "1"  # of the ways without an inpainter, which have never changed
    if inpainter is not None:
        version = inpainter.version
    return {"name": options.inpainter, "version": version}
