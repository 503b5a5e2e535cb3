"""`spackle dataset build`: photos to shards, in any number of runs with the same bytes at the end."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from spackle.bases.open import BaseError, open_base
from spackle.camera_path import DepthRange
from spackle.dataset.options import DatasetOptions, configuration
from spackle.dataset.photos import PhotoFile, choose, find_photos
from spackle.dataset.sample import pack_sample
from spackle.dataset.shards import NAME, Manifest, load_manifest, shard_name, write_shard
from spackle.dataset.views import draw_path, open_completion, path_cameras, render_views
from spackle.errors import InputError, reading
from spackle.files import fingerprint, write_whole
from spackle.folders import differences, make_folder, remove_half_written, results_folder
from spackle.image import load_photo, resize_photo
from spackle.inpaint import InpainterOptions
from spackle.progress import Reporter, asked_to_stop, counted, timed
from spackle.render import get_renderer
from spackle.residual import MASK_THRESHOLD
from spackle.workers import at_work, cluster

MAX_PHOTOS = 1_000_000  # six digits name a photo
PARTS = "parts"  # in the output: samples that are in no shard yet
STAGES = ("load", "base", "render", "inpaint", "encode", "write")


def build_dataset(source: Path, output: Path, options: DatasetOptions, reporter: Reporter) -> str:
    """Build a dataset of a folder of photos or COCO annotations, or resume that: "complete", or "stopped" by Ctrl-C.

    InputError for options, photos or folders that cannot be used, and for another dataset in `output`.
    """
    options.check()
    maker = Maker(options)  # fails before long work
    if maker.completion.notice:
        reporter.log(maker.completion.notice)
    with cluster(options.processes) as ray:
        photos = _photos(source, options, reporter)
        new = Manifest(config=configuration(options, photos, maker.completion), shards=(), complete=False)
        with results_folder(output, (NAME,), alone=True):
            manifest = _begin(output, new)
            return _Build(photos, output, options, reporter, manifest).run(ray)


def _photos(source: Path, options: DatasetOptions, reporter: Reporter) -> list[PhotoFile]:
    root, names = find_photos(source, options.images, reporter.log)
    if options.sample is None and len(names) > MAX_PHOTOS:
        raise InputError(
            f"{source}: {len(names):,} photos are too many for a dataset (at most {MAX_PHOTOS:,}): "
            "give --sample, or build several"
        )
    with reporter.stage("photos") as step:
        return choose(root, names, options.sample, options.seed, reporter.log, step)


def _begin(output: Path, new: Manifest) -> Manifest:
    """The manifest of an earlier run, or the new one; InputError for that of another dataset."""
    if not (output / NAME).exists():
        new.save(output)
    manifest = load_manifest(output)
    if lines := differences(manifest.config, new.config):
        raise InputError(f"{output}: holds a dataset of another configuration ({'; '.join(lines)}): choose another -o")
    make_folder(output / PARTS)
    remove_half_written(output, output / PARTS)
    return manifest


@dataclasses.dataclass(frozen=True)
class Made:
    """The sample of a photo, or the reason why there is none."""

    index: int
    seconds: dict[str, float]  # of each stage
    sample: bytes | None = None  # a stretch of a tar archive
    problem: str | None = None


class Maker:
    """Makes the sample of one photo after the other: its base, views and targets."""

    def __init__(self, options: DatasetOptions) -> None:
        """Set up; a network is loaded with the first photo. InputError where that cannot be."""
        self.options, self.base = options, open_base(options.base)
        self.renderer = get_renderer(options.base.device)
        device = None if options.base.device == "auto" else options.base.device
        inpainter = InpainterOptions(options.inpainter_weights, options.inpainter_side, device)
        self.completion = open_completion(options.inpainter, inpainter, self.renderer)

    @property
    def setup(self) -> dict[str, Any]:
        """The manifest's configuration, but for the photos."""
        return configuration(self.options, (), self.completion)

    def inputs(self, photo: PhotoFile) -> list[str]:
        """Digests of a photo and of its depth map, as they lie on this machine."""
        try:
            content = fingerprint(photo.path, "photo")
        except InputError:
            content = "none"
        return [content, *self.options.inputs_of(photo)]

    def make(self, photo: PhotoFile) -> Made:
        """A photo's sample; BaseError if no photo can give one."""
        seconds: dict[str, float] = {}
        try:
            return Made(photo.index, seconds, sample=self._sample(photo, seconds))
        except BaseError:
            raise
        except InputError as error:
            return Made(photo.index, seconds, problem=str(error))

    def _sample(self, file: PhotoFile, seconds: dict[str, float]) -> bytes:
        options = self.options
        with timed("load", seconds):
            photo = load_photo(file.path)
        with timed("base", seconds):
            prediction, _ = self.base.predict(photo, options.depth_of(file))
        base, camera = prediction.gaussians, prediction.camera
        with timed("render", seconds):
            path = draw_path(options.trajectory, options.disparity, options.seed, file.sha256)
            with reading(file.path, "no camera path: {reason}", ValueError):
                cameras = path_cameras(path, camera.even(), DepthRange.of(base), options.views)
            stack = render_views(base, camera, cameras, self.renderer)
        with timed("inpaint", seconds):
            targets = self.completion.complete(stack)
        with timed("encode", seconds):
            facts = {
                "photo": {
                    "name": file.name,
                    "sha256": file.sha256,
                    "width": photo.width,
                    "height": photo.height,
                    "focal_source": prediction.lens_source or photo.focal_source,
                },
                "base": {"gaussians": len(base), **prediction.notes},
                "inpainter": {"name": self.completion.name, "version": self.completion.version},
                "threshold": MASK_THRESHOLD,
            }
            return pack_sample(key_of(file.index), resize_photo(photo).rgb, stack, targets, path, facts)


def key_of(index: int) -> str:
    """The first part of the names of a photo's files: its place among the photos."""
    return f"{index:06d}"


class _Build:
    """The photos of a dataset and how far it has come."""

    def __init__(
        self, photos: Sequence[PhotoFile], output: Path, options: DatasetOptions, reporter: Reporter, manifest: Manifest
    ) -> None:
        self.photos, self.output, self.options, self.reporter = photos, output, options, reporter
        self.config, self.size = manifest.config, options.shard_size
        sizes = {path.name: path.stat().st_size for path in output.iterdir() if path.is_file()}
        self.shards = {int(s.file[6:-4]): s for s in manifest.shards if sizes.get(s.file) == s.size}
        self.missing = {  # photos by their index
            index
            for index in range(len(photos))
            if index // self.size not in self.shards and not self._part(index).is_file()
        }
        self.problems: dict[int, str] = {}  # of photos that give no sample
        self.seconds = dict.fromkeys(STAGES, 0.0)

    def run(self, ray: Any) -> str:
        """Make what is missing, on a Ray cluster where `ray` is the package; "complete" or "stopped"."""
        jobs = [photo for photo in self.photos if photo.index in self.missing]
        if ready := len(self.photos) - len(jobs):
            self.reporter.log(f"{self.output}: going on, {ready} of {len(self.photos)} photos are done")
        total = {"wall": 0.0}
        with self.reporter.stage("photos") as step, asked_to_stop(alone=True) as stop:
            for number in range(-(-len(self.photos) // self.size)):
                self._write_shard(number)
            if jobs:
                make = self.options.processes, partial(Maker, self.options)
                with timed("wall", total), at_work(ray, *make, jobs, self.reporter.log, stop) as results:
                    for done, result in enumerate(results, ready + 1):
                        self._keep(result)
                        self._write_shard(result.index // self.size)
                        step(done, len(self.photos))
                        if stop():
                            break
        if self.missing:
            self.reporter.log("stopped; the same command goes on from here")
            return "stopped"
        self._finish(len(jobs) - len(self.problems), total["wall"])
        return "complete"

    def _part(self, index: int) -> Path:
        """Where a photo's sample waits for its shard."""
        return self.output / PARTS / f"{key_of(index)}.tar"

    def _keep(self, result: Made) -> None:
        """Write a photo's sample where it waits for its shard, or log why there is none."""
        if result.sample is not None:
            with timed("write", self.seconds):
                write_whole(self._part(result.index), result.sample)
        self.missing.discard(result.index)
        for stage, time in result.seconds.items():
            self.seconds[stage] += time
        if result.problem is not None:
            self.problems[result.index] = result.problem
            self.reporter.log(f"passed over: {result.problem}")

    def _write_shard(self, number: int) -> None:
        """Write a shard whose photos are all done: first the file, then its entry; its parts go last."""
        indices = range(number * self.size, min((number + 1) * self.size, len(self.photos)))
        if number in self.shards or not self.missing.isdisjoint(indices):
            return
        parts = [(key_of(i), self._part(i)) for i in indices if i not in self.problems]
        skipped = [self._portable(self.photos[i].name, self.problems[i]) for i in indices if i in self.problems]
        with timed("write", self.seconds):
            self.shards[number] = write_shard(parts, self.output / shard_name(number), skipped)
            self._save(complete=False)
            for _, path in parts:
                path.unlink(missing_ok=True)
        self.reporter.detail(f"  {shard_name(number)}: {len(parts)} photos, {decimal(self.shards[number].size)}")

    def _save(self, *, complete: bool) -> None:
        shards = tuple(self.shards[number] for number in sorted(self.shards))
        Manifest(config=self.config, shards=shards, complete=complete).save(self.output)

    def _finish(self, made: int, seconds: float) -> None:
        """Write the last manifest and remove the rest; InputError, and nothing stays, if no photo gave a sample."""
        shards = self.shards.values()
        samples = sum(len(shard.samples) for shard in shards)
        if samples:
            self._save(complete=True)
        for file in (self.output / PARTS).iterdir():  # of shards that an earlier run had finished
            file.unlink(missing_ok=True)
        (self.output / PARTS).rmdir()
        if not samples:
            for name in (NAME, *(shard.file for shard in shards)):
                (self.output / name).unlink(missing_ok=True)
            why = min(line for shard in shards for line in shard.passed_over)
            raise InputError(f"{self.output}: none of {len(self.photos)} photos gave a sample, such as {why}")
        if made:
            stages = ", ".join(f"{stage} {self.seconds[stage] / made:.2f}" for stage in STAGES)
            self.reporter.log(f"{3600 * made / seconds:,.0f} photos an hour; seconds a photo: {stages}")
        total = decimal(sum(shard.size for shard in shards))
        self.reporter.log(f"{counted(samples, 'photo')} in {counted(len(shards), 'shard')}, {total} -> {self.output}")

    def _portable(self, name: str, problem: str) -> str:
        """A photo's problem without the folders of photos and depth maps, as these differ between machines."""
        for photo in self.photos:
            problem = problem.replace(str(photo.path), photo.name)
        depth = self.options.base.depth
        if isinstance(depth, Path) and depth.name:  # "." and "/" stand anywhere
            problem = problem.replace(str(depth), "--depth")
        return problem if problem.startswith(f"{name}: ") else f"{name}: {problem}"
