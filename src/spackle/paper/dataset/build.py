"""`spackle dataset build`: photos to shards.

An interrupted build resumes and writes the same bytes.

Read `build_dataset` first. Workers make the photos' samples (views with holes, and their targets)
and put them together to tar files, the shards, as `ShardWriter` says. At the end the manifest lists
all shards.
"""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from spackle.bases.open import BaseError, open_base
from spackle.core.photo import load_photo, resize_photo
from spackle.core.photo_lists import photos_of
from spackle.paper.dataset.encoding import decode_gaussians, encode_gaussians
from spackle.paper.dataset.options import DatasetOptions, completion_facts, dataset_configuration
from spackle.paper.dataset.photos import PhotoFile, choose_photos
from spackle.paper.dataset.sample import pack_sample
from spackle.paper.dataset.shard_writer import ShardWriter
from spackle.paper.dataset.shards import MANIFEST_NAME, Manifest, load_manifest
from spackle.paper.dataset.views import (
    cameras_along_path,
    complete_views,
    draw_random_path,
    render_views,
)
from spackle.render import get_renderer
from spackle.residual import MASK_THRESHOLD
from spackle.runtime.digests import config_differences
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import remove_half_written
from spackle.runtime.folders import make_folder, results_folder
from spackle.runtime.progress import Progress, Reporter, catch_stop_signals, pluralized
from spackle.runtime.worker_options import WorkerOptions, check_like_command
from spackle.runtime.workers import parallel_map


def build_dataset(source: Path, output: Path, options: DatasetOptions, reporter: Reporter) -> str:
    """Build a dataset from a folder or a list of photos, or resume an earlier build.

    Args:
        source: the folder, or a file that lists photos; see `photos_of`.
        output: the folder of the dataset.
        options: what to build.
        reporter: shows progress.

    Returns:
        How the build ended: "complete", or "stopped" by Ctrl-C.

    Raises:
        InputError: options, photos or folders cannot be used, or `output` holds another dataset.
    """
    # Errors in options and weights come now, before any long work.
    options.check(source)
    no_photos = ShardWriter(output, options.shard_size, photo_count=0)
    maker = SampleMaker(options, no_photos)
    # Some inpainters have a licence that the user should know of.
    if maker.inpainter is not None and maker.inpainter.notice:
        reporter.log(maker.inpainter.notice)

    listed = list(photos_of(source, folder=options.images, recursive=True, log=reporter.log))
    with reporter.stage("photos") as progress:
        photos = choose_photos(source, listed, options.sample, options.seed, reporter.log, progress)
    # The record by which a later run of the same command knows that it is the same build.
    config = dataset_configuration(options, photos, maker.inpainter)
    with results_folder(output, (MANIFEST_NAME,), locked=True):
        return DatasetBuild(photos, output, options, reporter, config).run()


@dataclasses.dataclass(frozen=True)
class PhotoResult:
    """That a photo's sample is written, or the reason why the photo has no sample."""

    index: int
    problem: str | None = None


class SampleMaker:
    """Makes photos' samples: Gaussians, rendered views and completed targets."""

    def __init__(self, options: DatasetOptions, writer: ShardWriter) -> None:
        """Open the base, which turns photos into Gaussians, and the inpainter, which paints holes.

        Their networks are loaded with the first photo.

        Args:
            options: what to build.
            writer: takes the samples.

        Raises:
            InputError: opening fails.
        """
        self.options = options
        self.writer = writer
        self.base = open_base(options.base)
        self.renderer = get_renderer(options.base.device)
        self.inpainter = options.open_inpainter()

    @staticmethod
    def open(
        options: DatasetOptions, writer: ShardWriter, config: Mapping[str, Any]
    ) -> SampleMaker:
        """Open the maker of a worker process.

        InputError if its machine would make other samples than the machine of the command, which
        has this `config`.
        """
        maker = SampleMaker(options, writer)
        # On the machine of the command there is nothing to compare.
        if options.ray is None:
            return maker
        own_config = dataset_configuration(options, (), maker.inpainter)
        # Workers get one photo at a time, so they do not know them all.
        own_config["photos"] = config["photos"]
        check_like_command(config, own_config)
        return maker

    def make(self, photo: PhotoFile) -> PhotoResult:
        """Write a photo's sample, and its shard if it was the last one of the shard.

        A problem of this photo alone is a result, too. BaseError if the network cannot be used for
        any photo.
        """
        # A worker that died may have written the sample without saying so.
        problem = None
        if not self.writer.is_done(photo.index):
            problem = self._write_sample(photo)
        self.writer.write_shard_if_ready(self.writer.shard_of(photo.index))
        return PhotoResult(photo.index, problem)

    def _write_sample(self, photo: PhotoFile) -> str | None:
        """Write a photo's sample, or the reason why it has none, which is returned."""
        try:
            sample = self._make_sample(photo)
        except BaseError:
            # The next photo would fail in the same way, so the build ends.
            raise
        except InputError as error:
            problem = str(error)
            self.writer.write_problem(photo.index, self._portable_problem(photo, problem))
            return problem
        self.writer.write_sample(photo.index, sample)
        return None

    def _portable_problem(self, photo: PhotoFile, problem: str) -> str:
        """The message about a photo's problem, beginning with the photo's name.

        Paths of folders are left out, because they differ between machines, and the manifest must
        not.
        """
        problem = problem.replace(str(photo.path), photo.name)
        if photo.depth is not None:
            problem = problem.replace(str(photo.depth), photo.depth.name)
        depth_folder = self.options.base.depth
        # A folder without a name, "." or "/", would be found anywhere in the message.
        if isinstance(depth_folder, Path) and depth_folder.name:
            problem = problem.replace(str(depth_folder), "the depth folder")
        if problem.startswith(f"{photo.name}: "):
            return problem
        return f"{photo.name}: {problem}"

    def _make_sample(self, file: PhotoFile) -> bytes:
        """A photo's sample: its Gaussians, views and targets, as bytes of a tar archive.

        InputError if the photo or its depth cannot be used.
        """
        options = self.options
        photo = load_photo(
            file.path,
            focal_px=file.lens.focal_px,
            focal_mm=file.lens.focal_mm,
            fov=file.lens.fov,
        )
        # The second result says which base it was; here it is always the same.
        prediction, _ = self.base.predict(photo, options.find_depth(file))
        # The dataset holds rounded Gaussians, so its views show these: whoever renders them again
        # finds the same holes.
        encoded_base = encode_gaussians(prediction.gaussians)
        with as_input_error(file.path, "its Gaussians cannot be stored: {reason}", ValueError):
            rounded_base = decode_gaussians(encoded_base)
        prediction = dataclasses.replace(prediction, gaussians=rounded_base)
        kind, disparity = draw_random_path(
            options.trajectory, options.disparity, options.seed, file.sha256
        )
        with as_input_error(file.path, "no camera path: {reason}", ValueError):
            depth_range = prediction.depth_range
            photo_camera = prediction.camera.even()  # videos need even sides
            cameras = cameras_along_path(kind, disparity, photo_camera, depth_range, options.views)
        views = render_views(prediction, cameras, self.renderer)
        targets = complete_views(views, options.inpainter, self.inpainter, self.renderer)

        # Where the sample comes from, for people who read the JSON.
        facts = {
            "photo": {
                "name": file.name,
                "sha256": file.sha256,
                "width": photo.width,
                "height": photo.height,
                # Where the focal length is from: what the base says counts before the photo.
                "focal_source": prediction.lens_source or photo.focal_source.value,
            },
            "base": {"gaussians": len(prediction.gaussians), **prediction.notes},
            "inpainter": completion_facts(options, self.inpainter),
            "threshold": MASK_THRESHOLD,
            "trajectory": {"kind": kind, "disparity": disparity},
        }
        return pack_sample(
            file.key,
            resize_photo(photo).rgb,
            views,
            targets,
            facts,
            encoded_base=encoded_base,
            keep=options.keep,
        )


class DatasetBuild:
    """A build in progress: a dataset's photos, and the state of each."""

    def __init__(
        self,
        photos: Sequence[PhotoFile],
        output: Path,
        options: DatasetOptions,
        reporter: Reporter,
        config: dict[str, Any],
    ) -> None:
        """Start or resume a build.

        Args:
            photos: the photos of the dataset, numbered from 0.
            output: the folder of the dataset, which the caller has locked.
            options: what to build.
            reporter: shows progress.
            config: everything that determines the contents, for the manifest.

        Raises:
            InputError: the folder holds a dataset with another `config`.
        """
        self.photos = photos
        self.output = output
        self.options = options
        self.reporter = reporter
        self.config = config

        # The manifest comes first: it says what the folder holds, also if the build is killed.
        if not (output / MANIFEST_NAME).exists():
            Manifest(config=config, shards=(), complete=False).save(output)
        manifest = load_manifest(output)
        changes = config_differences(manifest.config, config)
        if changes:
            raise InputError(
                f"{output}: holds a dataset with other options ({'; '.join(changes)}): choose "
                "another `output`"
            )
        self.writer = ShardWriter(output, options.shard_size, len(photos))
        make_folder(self.writer.parts)
        remove_half_written(output, self.writer.parts)
        self.writer.remove_problems()

        # A shard counts if its file is there, whole. Its name is shard-NUMBER.tar.
        sizes = {path.name: path.stat().st_size for path in output.iterdir() if path.is_file()}
        self.shards = {}  # entries of the manifest by number
        for shard in manifest.shards:
            if sizes.get(shard.file) == shard.size:
                number = int(shard.file.removeprefix("shard-").removesuffix(".tar"))
                self.shards[number] = shard
        # The manifest of a killed build does not list its shards yet, and all parts of a shard may
        # be there, but not the shard.
        self._collect_shards()

        # Indices of photos whose sample is neither in a shard nor in a file of its own, a part.
        self.missing = {
            photo.index
            for photo in photos
            if self.writer.shard_of(photo.index) not in self.shards
            and not self.writer.is_done(photo.index)
        }

    def run(self) -> str:
        """Make the samples that are missing, and the shards: tar files of some samples each.

        A sample holds a photo, its views and their targets.

        Returns:
            How the build ended: "complete", or "stopped" by Ctrl-C.
        """
        missing_photos = [photo for photo in self.photos if photo.index in self.missing]
        ready_count = len(self.photos) - len(missing_photos)
        if ready_count:
            self.reporter.log(
                f"{self.output}: going on, {ready_count} of {len(self.photos)} photos are done"
            )

        start_time = time.perf_counter()
        with (
            self.reporter.stage("photos") as progress,
            # single_process: a second Ctrl-C ends the program at once.
            catch_stop_signals(single_process=True) as stop_requested,
        ):
            self._make_samples(missing_photos, progress, stop_requested)
        self._collect_shards()
        if self.missing:
            self._save_manifest(complete=False)
            self.reporter.log("stopped; the same command resumes from here")
            return "stopped"

        hours = (time.perf_counter() - start_time) / 3600
        photos_per_hour = len(missing_photos) / hours
        self._finish()
        if missing_photos:
            self.reporter.log(f"{photos_per_hour:,.0f} photos an hour")
        self._log_summary()
        return "complete"

    def _make_samples(
        self, photos: Sequence[PhotoFile], progress: Progress, stop_requested: Callable[[], bool]
    ) -> None:
        """Make the samples of photos in worker processes, which also write the shards.

        Args:
            photos: those of the dataset's photos that are not done yet.
            progress: receives (photos done, photos of the dataset).
            stop_requested: whether the user wants the build to end after the current photo.
        """
        options = self.options
        ready_count = len(self.photos) - len(photos)
        workers = WorkerOptions.of_command(
            options.workers, options.threads, options.base.device, options.ray, len(photos)
        )
        with parallel_map(
            partial(SampleMaker.open, options, self.writer, self.config),
            photos,
            stop_requested,
            workers,
            self.output,
        ) as results:
            # Results come in any order, as soon as they are made.
            for done_count, result in enumerate(results, ready_count + 1):
                self._note(result)
                progress(done_count, len(self.photos))
                if stop_requested():
                    break

    def _note(self, result: PhotoResult) -> None:
        """Note that a photo is done; if it has no sample, the reason is logged."""
        self.missing.discard(result.index)
        if result.problem is not None:
            self.reporter.log(f"passed over: {result.problem}")

    def _collect_shards(self) -> None:
        """Take note of all shards that are written; a shard is written now if its parts wait."""
        for number in range(self.writer.shard_count):
            if number not in self.shards:
                entry = self.writer.write_shard_if_ready(number)
                if entry is not None:
                    self.shards[number] = entry

    def _save_manifest(self, *, complete: bool) -> None:
        """Write the manifest with the shards so far."""
        shards = tuple(self.shards[number] for number in sorted(self.shards))
        Manifest(config=self.config, shards=shards, complete=complete).save(self.output)

    def _finish(self) -> None:
        """Write the final manifest, and remove the folder of samples that waited for their shard.

        If no photo has a sample, everything is deleted, and InputError is raised.
        """
        if self._sample_count():
            self._save_manifest(complete=True)
            shutil.rmtree(self.writer.parts)
            return

        shutil.rmtree(self.writer.parts)
        # An empty dataset would only puzzle whoever finds it.
        shards = self.shards.values()
        for name in (MANIFEST_NAME, *(shard.file for shard in shards)):
            (self.output / name).unlink(missing_ok=True)
        example = min(problem for shard in shards for problem in shard.passed_over)
        raise InputError(
            f"{self.output}: none of {len(self.photos)} photos gave a sample; for example {example}"
        )

    def _log_summary(self) -> None:
        """Log how many photos, shards and bytes the dataset has."""
        photos = pluralized(self._sample_count(), "photo")
        shards = pluralized(len(self.shards), "shard")
        size = decimal(sum(shard.size for shard in self.shards.values()))
        self.reporter.log(f"{photos} in {shards}, {size} -> {self.output}")

    def _sample_count(self) -> int:
        """The number of photos in shards."""
        return sum(len(shard.samples) for shard in self.shards.values())
