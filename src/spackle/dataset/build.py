"""`spackle dataset build`: photos to shards, in any number of runs with the same bytes at the end."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from spackle.dataset.maker import PARTS, Made, Maker, PhotoJob, Seconds, key_of, part_file
from spackle.dataset.options import MAX_PHOTOS, DatasetOptions, configuration
from spackle.dataset.photos import PhotoFile, choose, find_photos
from spackle.dataset.shards import NAME, Manifest, load_manifest, shard_name, write_shard
from spackle.errors import InputError
from spackle.files import atomic_path, differences, make_folder, remove_half_written, results_folder
from spackle.progress import Reporter, counted, timed
from spackle.signals import asked_to_stop
from spackle.workers import at_work, cluster

STAGES = ("load", "base", "render", "inpaint", "encode", "write")
NAMED = 5  # missing files that the log names


def build_dataset(source: Path, output: Path, options: DatasetOptions, reporter: Reporter) -> str:
    """Build a dataset of a folder of photos or COCO annotations, or resume that: "complete", or "stopped" by Ctrl-C.

    InputError for options, photos or folders that cannot be used, and for another dataset in `output`.
    """
    options.check()
    completion = Maker.of(options).completion  # fails before long work
    if completion.notice:
        reporter.log(completion.notice)
    with cluster(options.processes) as ray:
        photos = _photos(source, options, reporter)
        config = configuration(options, photos, completion)
        with results_folder(output, (NAME,), alone=True):
            manifest = _begin(output, config)
            return _Build(photos, output, options, reporter, manifest).run(ray)


def _photos(source: Path, options: DatasetOptions, reporter: Reporter) -> list[PhotoFile]:
    found = find_photos(source, options.images)
    if found.missing:
        names = ", ".join((*found.missing[:NAMED], *(["…"] if len(found.missing) > NAMED else [])))
        reporter.log(f"{len(found.missing)} images that {source} names are not in {found.root}: {names}")
    if options.sample is None and len(found.names) > MAX_PHOTOS:
        raise InputError(
            f"{source}: {len(found.names):,} photos are too many for a dataset (at most {MAX_PHOTOS:,}): "
            "give --sample, or build several"
        )
    with reporter.stage("photos") as step:
        return choose(found, options.sample, options.choices.seed, reporter.log, step)


def _begin(output: Path, config: dict[str, Any]) -> Manifest:
    """The manifest of an earlier run, or a new one; InputError for that of another dataset."""
    new = Manifest(config, (), complete=False)
    if not (output / NAME).exists():
        new.save(output)
    manifest = load_manifest(output)
    if lines := differences(manifest.config, new.config):
        raise InputError(f"{output}: holds a dataset of another configuration ({'; '.join(lines)}): choose another -o")
    make_folder(output / PARTS)
    remove_half_written(output, output / PARTS)
    return manifest


class _Build:
    """The photos of a dataset and how far it has come."""

    def __init__(
        self, photos: Sequence[PhotoFile], output: Path, options: DatasetOptions, reporter: Reporter, manifest: Manifest
    ) -> None:
        self.photos, self.output, self.options, self.reporter = photos, output, options, reporter
        self.config, size = manifest.config, options.shard_size
        here = {path.name: path.stat().st_size for path in output.iterdir() if path.is_file()}
        self.shards = {int(s.file[6:-4]): s for s in manifest.shards if here.get(s.file) == s.size}
        self.problems: dict[int, str] = {}  # of photos that give no sample
        self.seconds: Seconds = dict.fromkeys(STAGES, 0.0)
        self.jobs = [
            PhotoJob(index, photo)
            for index, photo in enumerate(photos)
            if index // size not in self.shards and not part_file(output, index).is_file()
        ]
        self.waiting: dict[int, set[int]] = {  # photos that a shard lacks
            index // size: set() for index in range(len(photos)) if index // size not in self.shards
        }
        for job in self.jobs:
            self.waiting[job.index // size].add(job.index)

    def run(self, ray: Any) -> str:
        """Make what is missing, on a Ray cluster where `ray` is the package; "complete" or "stopped"."""
        if ready := len(self.photos) - len(self.jobs):
            self.reporter.log(f"{self.output}: going on, {ready} of {len(self.photos)} photos are done")
        with self.reporter.stage("photos") as step, asked_to_stop(alone=True) as stop:
            self._write_ready()
            if not self.jobs:
                return self._finish(0.0)
            total: Seconds = {}
            makers = self.options.processes, partial(Maker.of, self.options)
            with timed("wall", total), at_work(ray, *makers, self.jobs, self.reporter.log, stop) as results:
                for done, result in enumerate(results, ready + 1):
                    self._keep(result)
                    self._write_ready()
                    step(done, len(self.photos))
                    if stop():
                        break
        if any(self.waiting.values()):
            self.reporter.log("stopped; the same command goes on from here")
            return "stopped"
        return self._finish(total["wall"])

    def _keep(self, result: Made) -> None:
        """Write a photo's sample where it waits for its shard, or log why there is none."""
        if result.sample is not None:
            with (
                timed("write", self.seconds),
                atomic_path(part_file(self.output, result.index)) as temporary,
            ):
                temporary.write_bytes(result.sample)
        self.waiting[result.index // self.options.shard_size].discard(result.index)
        for stage, time in result.seconds.items():
            self.seconds[stage] += time
        if result.problem is not None:
            self.problems[result.index] = result.problem
            self.reporter.log(f"passed over: {result.problem}")

    def _write_ready(self) -> None:
        """Write shards whose photos are all done: first the file, then its entry; its parts go last."""
        size = self.options.shard_size
        for number in sorted(n for n, missing in self.waiting.items() if not missing and n not in self.shards):
            own = range(number * size, min((number + 1) * size, len(self.photos)))
            parts = [(key_of(i), part_file(self.output, i)) for i in own if i not in self.problems]
            passed = [self._portable(self.photos[i].name, self.problems[i]) for i in own if i in self.problems]
            with timed("write", self.seconds):
                self.shards[number] = write_shard(parts, self.output / shard_name(number), passed)
                self._save(complete=False)
                for _, path in parts:
                    path.unlink(missing_ok=True)
            self.reporter.detail(f"  {shard_name(number)}: {len(parts)} photos, {decimal(self.shards[number].size)}")

    def _save(self, *, complete: bool) -> None:
        Manifest(self.config, tuple(self.shards[n] for n in sorted(self.shards)), complete).save(self.output)

    def _finish(self, wall: float) -> str:
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
        if made := len(self.jobs) - len(self.problems):
            stages = ", ".join(f"{stage} {self.seconds[stage] / made:.2f}" for stage in STAGES)
            self.reporter.log(f"{3600 * made / wall:,.0f} photos an hour; seconds a photo: {stages}")
        total = decimal(sum(shard.size for shard in shards))
        self.reporter.log(f"{counted(samples, 'photo')} in {counted(len(shards), 'shard')}, {total} -> {self.output}")
        return "complete"

    def _portable(self, name: str, problem: str) -> str:
        """What is wrong with a photo, without the folders of photos and depth maps."""
        for photo in self.photos:
            problem = problem.replace(str(photo.path), photo.name)
        depth = self.options.base.depth
        if isinstance(depth, Path) and depth.name:  # "." and "/" stand anywhere
            problem = problem.replace(str(depth), "--depth")
        return problem if problem.startswith(f"{name}: ") else f"{name}: {problem}"
