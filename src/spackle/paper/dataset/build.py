"""`spackle dataset build`: photos to shards; an interrupted build resumes and writes the same bytes."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.filesize import decimal

import spackle
from spackle.bases.open import BaseError, open_base
from spackle.bases.settings import NETWORK_BASES, BaseSettings
from spackle.core.photo import load_photo, resize_photo
from spackle.core.trajectories import MAX_DISPARITY, DepthRange, SharpTrajectory
from spackle.depth.readers import find_depth_file
from spackle.inpaint import (
    Inpainter,
    InpainterOptions,
    get_inpainter,
    inpainter_class,
    is_inpainter,
)
from spackle.paper.dataset.photos import PhotoFile, choose_photos, find_photos
from spackle.paper.dataset.sample import pack_sample
from spackle.paper.dataset.shards import MANIFEST_NAME, Manifest, load_manifest, write_shard
from spackle.paper.dataset.views import (
    COMPLETIONS,
    cameras_along_path,
    complete_views,
    draw_random_path,
    render_views,
)
from spackle.render import get_renderer
from spackle.residual import MASK_THRESHOLD
from spackle.runtime.digests import config_differences, file_fingerprint, json_digest
from spackle.runtime.errors import InputError, as_input_error, check_name
from spackle.runtime.files import remove_half_written, write_atomic
from spackle.runtime.folders import make_folder, results_folder
from spackle.runtime.progress import Reporter, catch_stop_signals, pluralized
from spackle.runtime.workers import parallel_map
from spackle.weights import weights_digest, weights_digests

PARTS_FOLDER = "parts"  # folder in the output for samples that are not in a shard yet


@dataclasses.dataclass(frozen=True)
class DatasetOptions:
    """The options of `spackle dataset build`; the command line checks the bounds of its numbers."""

    base: BaseSettings
    images: Path | None = None  # folder of a COCO JSON's photos
    sample: int | None = None  # number of photos; None: all
    seed: int = 0  # for the choice of photos and paths
    views: int = 20  # per photo, including the photo's camera, as in the paper
    trajectory: SharpTrajectory | None = None  # None: drawn for each photo
    disparity: tuple[float, float] = (
        0.1,
        0.6,
    )  # range of the random disparity, see `spackle.core.trajectories.disparity_to_offset`
    inpainter: str = "exemplar"  # one of `COMPLETIONS`
    inpainter_weights: Path | None = None  # a file or folder, if the inpainter has a network
    inpainter_side: int | None = (
        None  # long side in pixels of the images that the inpainter's network gets
    )
    workers: int = 1  # processes
    threads: int = 2  # threads per process
    shard_size: int = 50  # photos per shard

    def open_inpainter(self) -> Inpainter | None:
        """Open the inpainter; None for "geometry" and "none". InputError if a package or weights are missing."""
        if not is_inpainter(self.inpainter):
            return None
        device = None if self.base.device == "auto" else self.base.device
        return get_inpainter(
            self.inpainter,
            InpainterOptions(
                weights=self.inpainter_weights, side=self.inpainter_side, device=device
            ),
        )

    def check(self) -> None:
        """InputError if options contradict each other; inpainters check their options themselves."""
        self.base.check(allow_auto=False)
        depth = self.base.depth
        if depth is None and not self.base.uses_network:
            raise InputError(
                f"--base {self.base.name} needs depth: give --depth FOLDER; {', '.join(NETWORK_BASES)} need no depth"
            )
        if isinstance(depth, Path) and not depth.is_dir():  # a single map would fit one photo only
            raise InputError(
                f"--depth {depth}: no such folder: give a folder with a depth map for each photo"
            )
        if not is_inpainter(self.inpainter):
            check_name("inpainter", self.inpainter, COMPLETIONS)
        takes = is_inpainter(self.inpainter) and inpainter_class(self.inpainter).uses_network
        if not takes and (self.inpainter_weights or self.inpainter_side) is not None:
            raise InputError(
                f"--inpainter {self.inpainter} takes neither --inpainter-weights nor --inpainter-side"
            )
        low, high = self.disparity
        if not 0 < low <= high <= MAX_DISPARITY:
            raise InputError(
                f"--disparity {low:g} {high:g}: give two numbers above 0 and up to {MAX_DISPARITY:g}, the smaller first"
            )

    def depth_of(self, photo: PhotoFile) -> Path | None:
        """A photo's depth map: in the photo's subfolder of --depth, or else in --depth itself; None without --depth."""
        folder = self.base.depth
        if not isinstance(folder, Path):
            return None
        beside = folder / Path(photo.name).parent
        return find_depth_file(beside if beside.is_dir() else folder, photo.path)

    def inputs_of(self, photo: PhotoFile) -> list[str]:
        """Name and digest of a photo, and the digest of its depth map."""
        inputs = [photo.name, photo.sha256]
        with contextlib.suppress(InputError):  # the build reports a missing depth map later
            inputs += (
                [file_fingerprint(depth, "depth map")] if (depth := self.depth_of(photo)) else []
            )
        return inputs


def dataset_configuration(
    options: DatasetOptions, photos: Sequence[PhotoFile], inpainter: Inpainter | None
) -> dict[str, Any]:
    """Everything that determines the shards' bytes, ready for JSON, without paths of this machine.

    The number of threads is included, because SHARP's last bits depend on it; the number of workers is not.
    """
    base = options.base
    inputs = json_digest([options.inputs_of(photo) for photo in photos])
    completion: dict[str, Any] = _completion(options, inpainter)
    if inpainter is not None and inpainter.weight_files:
        completion["weights"] = {
            name: weights_digest(file) for name, file in inpainter.weight_files.items()
        }
    return {
        "spackle": spackle.__version__,
        "photos": {"count": len(photos), "sample": options.sample, "sha256": inputs},
        "base": {
            "name": base.public_name,
            "weights": weights_digests(base.model_files),
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
        "inpainter": completion,
        "shard_size": options.shard_size,
        "threads": options.threads,
    }


def _completion(options: DatasetOptions, inpainter: Inpainter | None) -> dict[str, str]:
    return {"name": options.inpainter, "version": "1" if inpainter is None else inpainter.version}


def build_dataset(source: Path, output: Path, options: DatasetOptions, reporter: Reporter) -> str:
    """Build a dataset from a folder of photos or from COCO annotations, or resume an earlier build.

    Returns:
        How the build ended: "complete", or "stopped" by Ctrl-C.

    Raises:
        InputError: options, photos or folders cannot be used, or `output` holds another dataset.
    """
    options.check()
    maker = SampleMaker(options)  # raises errors before any long work
    if maker.inpainter is not None and maker.inpainter.notice:
        reporter.log(maker.inpainter.notice)
    root, names = find_photos(source, options.images, reporter.log)
    with reporter.stage("photos") as step:
        photos = choose_photos(root, names, options.sample, options.seed, reporter.log, step)
    config = dataset_configuration(options, photos, maker.inpainter)
    with results_folder(output, (MANIFEST_NAME,), locked=True):
        return DatasetBuild(photos, output, options, reporter, config).run()


@dataclasses.dataclass(frozen=True)
class PhotoResult:
    """The sample of a photo, or the reason why the photo has no sample."""

    index: int
    sample: bytes | None = None  # the photo's part of a tar archive
    problem: str | None = None


class SampleMaker:
    """Makes photos' samples: base, views and targets."""

    def __init__(self, options: DatasetOptions) -> None:
        """Open base and inpainter, whose networks are loaded with the first photo; InputError if opening fails."""
        self.options, self.base = options, open_base(options.base)
        self.renderer, self.inpainter = get_renderer(options.base.device), options.open_inpainter()

    def make(self, photo: PhotoFile) -> PhotoResult:
        """Make a photo's sample; BaseError if the base would fail for every photo."""
        try:
            return PhotoResult(photo.index, sample=self._sample(photo))
        except BaseError:
            raise
        except InputError as error:
            return PhotoResult(photo.index, problem=str(error))

    def _sample(self, file: PhotoFile) -> bytes:
        options, photo = self.options, load_photo(file.path)
        prediction, _ = self.base.predict(photo, options.depth_of(file))
        kind, disparity = draw_random_path(
            options.trajectory, options.disparity, options.seed, file.sha256
        )
        with as_input_error(file.path, "no camera path: {reason}", ValueError):
            depth_range = DepthRange.of(prediction.gaussians)
            cameras = cameras_along_path(
                kind, disparity, prediction.camera.even(), depth_range, options.views
            )
        stack = render_views(prediction, cameras, self.renderer)
        targets = complete_views(stack, options.inpainter, self.inpainter, self.renderer)
        facts = {
            "photo": {
                "name": file.name,
                "sha256": file.sha256,
                "width": photo.width,
                "height": photo.height,
                "focal_source": prediction.lens_source or photo.focal_source.value,
            },
            "base": {"gaussians": len(prediction.gaussians), **prediction.notes},
            "inpainter": _completion(options, self.inpainter),
            "threshold": MASK_THRESHOLD,
            "trajectory": {"kind": kind, "disparity": disparity},
        }
        return pack_sample(file.key, resize_photo(photo).rgb, stack, targets, facts)


class DatasetBuild:
    """A dataset's photos, and the state of each."""

    def __init__(
        self,
        photos: Sequence[PhotoFile],
        output: Path,
        options: DatasetOptions,
        reporter: Reporter,
        config: dict[str, Any],
    ) -> None:
        """Start or resume a build in a folder; InputError if the folder holds another dataset."""
        self.photos, self.output, self.options, self.reporter = photos, output, options, reporter
        self.config, self.size = config, options.shard_size
        if not (output / MANIFEST_NAME).exists():
            Manifest(config=config, shards=(), complete=False).save(output)
        manifest = load_manifest(output)
        if lines := config_differences(manifest.config, config):
            raise InputError(
                f"{output}: holds a dataset with other options ({'; '.join(lines)}): choose another -o"
            )
        make_folder(output / PARTS_FOLDER)
        remove_half_written(output, output / PARTS_FOLDER)
        sizes = {path.name: path.stat().st_size for path in output.iterdir() if path.is_file()}
        self.shards = {int(s.file[6:-4]): s for s in manifest.shards if sizes.get(s.file) == s.size}
        self.missing = {  # indices of photos
            index
            for index in range(len(photos))
            if index // self.size not in self.shards and not self._part(index).is_file()
        }
        self.problems: dict[int, str] = {}  # why photos have no sample, by index

    def run(self) -> str:
        """Make the missing samples; returns "complete" or "stopped"."""
        jobs = [photo for photo in self.photos if photo.index in self.missing]
        if ready := len(self.photos) - len(jobs):
            self.reporter.log(
                f"{self.output}: going on, {ready} of {len(self.photos)} photos are done"
            )
        start = time.perf_counter()
        with self.reporter.stage("photos") as step, catch_stop_signals(single_process=True) as stop:
            for number in range(-(-len(self.photos) // self.size)):
                self._write_shard(number)
            make, options, gpu = (
                partial(SampleMaker, self.options),
                self.options,
                self.options.base.device != "cpu",
            )
            with parallel_map(
                make, jobs, stop, count=options.workers, threads=options.threads, gpu=gpu
            ) as results:
                for done, result in enumerate(results, ready + 1):
                    self._store(result)
                    self._write_shard(result.index // self.size)
                    step(done, len(self.photos))
                    if stop():
                        break
        if self.missing:
            self.reporter.log("stopped; the same command resumes from here")
            return "stopped"
        self._finish(len(jobs), time.perf_counter() - start)
        return "complete"

    def _part(self, index: int) -> Path:
        """The file that holds a photo's sample until its shard is written."""
        return self.output / PARTS_FOLDER / f"{self.photos[index].key}.tar"

    def _store(self, result: PhotoResult) -> None:
        """Write a photo's sample to its `_part`, or log why the photo has no sample."""
        if result.sample is not None:
            write_atomic(self._part(result.index), result.sample)
        self.missing.discard(result.index)
        if result.problem is not None:
            self.problems[result.index] = result.problem
            self.reporter.log(f"passed over: {result.problem}")

    def _write_shard(self, number: int) -> None:
        """If all photos of a shard are done, write the shard, then its entry in the manifest; then delete the parts."""
        indices = range(number * self.size, min((number + 1) * self.size, len(self.photos)))
        if number in self.shards or not self.missing.isdisjoint(indices):
            return
        parts = [(self.photos[i].key, self._part(i)) for i in indices if i not in self.problems]
        name = f"shard-{number:06d}.tar"
        skipped = [
            self._portable(self.photos[i], self.problems[i]) for i in indices if i in self.problems
        ]
        self.shards[number] = write_shard(parts, self.output / name, skipped)
        self._save(complete=False)
        for _, path in parts:
            path.unlink(missing_ok=True)
        self.reporter.detail(f"  {name}: {len(parts)} photos, {decimal(self.shards[number].size)}")

    def _save(self, *, complete: bool) -> None:
        shards = tuple(self.shards[number] for number in sorted(self.shards))
        Manifest(config=self.config, shards=shards, complete=complete).save(self.output)

    def _finish(self, made: int, seconds: float) -> None:
        """Write the final manifest and remove the parts; without samples, delete everything and raise InputError."""
        shards = self.shards.values()
        samples = sum(len(shard.samples) for shard in shards)
        if samples:
            self._save(complete=True)
        shutil.rmtree(self.output / PARTS_FOLDER)
        if not samples:
            for name in (MANIFEST_NAME, *(shard.file for shard in shards)):
                (self.output / name).unlink(missing_ok=True)
            why = min(line for shard in shards for line in shard.passed_over)
            raise InputError(
                f"{self.output}: none of {len(self.photos)} photos gave a sample; for example {why}"
            )
        if made:
            self.reporter.log(f"{3600 * made / seconds:,.0f} photos an hour")
        total = decimal(sum(shard.size for shard in shards))
        self.reporter.log(
            f"{pluralized(samples, 'photo')} in {pluralized(len(shards), 'shard')}, {total} -> {self.output}"
        )

    def _portable(self, photo: PhotoFile, problem: str) -> str:
        """The error message about a photo, without the paths of folders, which differ between machines."""
        problem, depth = problem.replace(str(photo.path), photo.name), self.options.base.depth
        if isinstance(depth, Path) and depth.name:  # "." and "/" would be found anywhere
            problem = problem.replace(str(depth), "--depth")
        return problem if problem.startswith(f"{photo.name}: ") else f"{photo.name}: {problem}"
