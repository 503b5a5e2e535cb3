"""`spackle dataset build`: photos to shards, in any number of runs with the same bytes at the end."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NoReturn

from rich.filesize import decimal

from spackle.errors import InputError
from spackle.jobs.dataset.options import MAX_PHOTOS, DatasetOptions, check_dataset_options, configuration
from spackle.jobs.dataset.ray import at_work_on_ray, cluster
from spackle.jobs.dataset.worker import PARTS, Job, Made, Maker, at_work, part_file
from spackle.output_folder import alone_in, make_folder, remove_half_written, results_folder
from spackle.progress import Reporter
from spackle.pseudo.build import Seconds, key_of, timed
from spackle.pseudo.manifest import NAME, Manifest, ShardEntry, differences, load_manifest
from spackle.pseudo.photos import PhotoFile, choose, find_photos
from spackle.pseudo.propainter import NOTICE
from spackle.pseudo.shards import shard_name, write_shard
from spackle.signals import asked_to_stop

STAGES = ("load", "base", "render", "inpaint", "encode", "write")
NAMED = 5  # missing files that are spelled out


def build_dataset(source: Path, output: Path, options: DatasetOptions, reporter: Reporter) -> str:
    """Build a dataset, or go on with one.

    Args:
        source: a folder of photos, or COCO annotations.
        output: a folder for manifest and shards.
        options: everything else.
        reporter: says what is passed over, and at the end how long each stage took.

    Returns:
        "complete", or "stopped" where Ctrl-C came.

    Raises:
        InputError: options, photos or folders that cannot be used; another dataset in `output`.
    """
    check_dataset_options(options)
    maker = Maker.of(options, output)  # what cannot be is refused before long work
    if options.inpainter == "propainter":
        reporter.say(NOTICE)
    with cluster(options):
        photos = _photos(source, options, reporter)
        config = configuration(options, photos, maker.inpainter)
        with results_folder(output, (NAME,)), alone_in(output, "build"):
            manifest = _begin(output, config)
            return _Build(photos, output, options, reporter, config).run(manifest.shards)


def _photos(source: Path, options: DatasetOptions, reporter: Reporter) -> list[PhotoFile]:
    found = find_photos(source, options.images)
    if found.missing:
        more = len(found.missing) - NAMED
        names = ", ".join(found.missing[:NAMED]) + (f" and {more} more" if more > 0 else "")
        reporter.say(f"{len(found.missing)} images that {source} names are not in {found.root}: {names}")
    if options.sample is None and len(found.names) > MAX_PHOTOS:
        raise InputError(
            f"{source}: {len(found.names):,} photos are too many for a dataset (at most {MAX_PHOTOS:,}): "
            "give --sample, or build several"
        )
    with reporter.stage("photos", {}) as step:
        return choose(found, options.sample, options.choices.seed, reporter.say, step)


def _begin(output: Path, config: dict[str, Any]) -> Manifest:
    """The manifest to go on from; a new one where there is none.

    Raises:
        InputError: the folder holds another dataset.
    """
    new = Manifest(config, (), complete=False)
    if not (output / NAME).exists():
        new.save(output)
    manifest = load_manifest(output)
    if lines := differences(manifest.config, new.config):
        raise InputError(f"{output}: holds a dataset of another configuration ({'; '.join(lines)}): choose another -o")
    make_folder(output / PARTS)
    remove_half_written(output, output / PARTS)
    return manifest


@dataclasses.dataclass
class _Build:
    """The photos of a dataset and how far it has come."""

    photos: Sequence[PhotoFile]
    output: Path
    options: DatasetOptions
    reporter: Reporter
    config: dict[str, Any]

    def run(self, done: Sequence[ShardEntry]) -> str:
        """Make what is missing; "complete" or "stopped"."""
        shards = {int(shard.file[6:-4]): shard for shard in done if self._is_there(shard)}
        problems: dict[int, str] = {}
        seconds: Seconds = dict.fromkeys(STAGES, 0.0)
        jobs = self._jobs(shards)
        ready = len(self.photos) - len(jobs)
        if ready:
            self.reporter.say(f"{self.output}: going on, {ready} of {len(self.photos)} photos are done")
        waiting = self._waiting(shards, jobs)
        made = 0
        with self.reporter.stage("photos", {}) as step, asked_to_stop(alone=True) as stop:
            self._write_ready(shards, waiting, problems, seconds)
            if not jobs:
                return self._finish(shards, seconds, 0, 0.0)
            total: Seconds = {}
            on_ray = functools.partial(at_work_on_ray, say=self.reporter.say)
            workers = at_work if self.options.ray is None else on_ray
            with timed("wall", total), workers(self.options, self.output, jobs) as results:
                for result in results:
                    made += self._note(result, problems, seconds)
                    waiting[result.index // self.options.shard_size].discard(result.index)
                    self._write_ready(shards, waiting, problems, seconds)
                    step(ready + made + len(problems), len(self.photos))
                    if stop():
                        break
        if any(waiting.values()):
            self.reporter.say("stopped; the same command goes on from here")
            return "stopped"
        return self._finish(shards, seconds, made, total["wall"])

    def _is_there(self, shard: ShardEntry) -> bool:
        """Whether a shard still lies where it was written; what is in it is for `verify`."""
        path = self.output / shard.file
        return path.is_file() and path.stat().st_size == shard.size

    def _jobs(self, shards: dict[int, ShardEntry]) -> list[Job]:
        """Photos that are neither in a shard nor waiting for theirs."""
        size = self.options.shard_size
        return [
            (index, photo)
            for index, photo in enumerate(self.photos)
            if index // size not in shards and not part_file(self.output, index).is_file()
        ]

    def _waiting(self, shards: dict[int, ShardEntry], jobs: Sequence[Job]) -> dict[int, set[int]]:
        """For each shard that is to be written the photos that it waits for."""
        size = self.options.shard_size
        waiting: dict[int, set[int]] = {n: set() for n in range(-(-len(self.photos) // size)) if n not in shards}
        for index, _ in jobs:
            waiting[index // size].add(index)
        return waiting

    def _note(self, result: Made, problems: dict[int, str], seconds: Seconds) -> int:
        for stage, time in result.seconds.items():
            seconds[stage] += time
        if result.problem is None:
            return 1
        problems[result.index] = result.problem
        self.reporter.say(f"passed over: {result.problem}")
        return 0

    def _write_ready(
        self, shards: dict[int, ShardEntry], waiting: dict[int, set[int]], problems: dict[int, str], seconds: Seconds
    ) -> None:
        """Shards whose photos are all done: first the file, then its entry, and its parts go last."""
        size = self.options.shard_size
        for number in sorted(n for n, missing in waiting.items() if not missing and n not in shards):
            own = range(number * size, min((number + 1) * size, len(self.photos)))
            parts = [(key_of(i), part_file(self.output, i)) for i in own if i not in problems]
            passed = [self._portable(self.photos[i].name, problems[i]) for i in own if i in problems]
            with timed("write", seconds):
                shards[number] = write_shard(parts, self.output / shard_name(number), passed)
                self._save(shards, complete=False)
                for _, path in parts:
                    path.unlink(missing_ok=True)
            self.reporter.detail(f"  {shard_name(number)}: {len(parts)} photos, {decimal(shards[number].size)}")

    def _save(self, shards: dict[int, ShardEntry], *, complete: bool) -> None:
        Manifest(self.config, tuple(shards[n] for n in sorted(shards)), complete).save(self.output)

    def _finish(self, shards: dict[int, ShardEntry], seconds: Seconds, made: int, wall: float) -> str:
        """The last manifest, and no trace of how it came to be."""
        samples = sum(len(shard.samples) for shard in shards.values())
        if samples:
            self._save(shards, complete=True)
        for file in (self.output / PARTS).iterdir():  # of shards that an earlier run had finished
            file.unlink(missing_ok=True)
        (self.output / PARTS).rmdir()
        if not samples:
            self._take_back(shards.values())
        if made:
            stages = ", ".join(f"{stage} {seconds[stage] / made:.2f}" for stage in STAGES)
            self.reporter.say(f"{3600 * made / wall:,.0f} photos an hour; seconds a photo: {stages}")
        total = sum(shard.size for shard in shards.values())
        self.reporter.say(f"{samples} photos in {len(shards)} shards, {decimal(total)} -> {self.output}")
        return "complete"

    def _take_back(self, shards: Collection[ShardEntry]) -> NoReturn:
        """Nothing came of it, so nothing stays, and the next run tries all photos again."""
        for name in (NAME, *(shard.file for shard in shards)):
            (self.output / name).unlink(missing_ok=True)
        why = min(line for shard in shards for line in shard.passed_over)
        raise InputError(f"{self.output}: none of {len(self.photos)} photos gave a sample, such as {why}")

    def _portable(self, name: str, problem: str) -> str:
        """What is wrong with a photo, without the folders in which it and its depth happened to lie."""
        for photo in self.photos:
            problem = problem.replace(str(photo.path), photo.name)
        depth = self.options.base.depth
        if depth is not None and depth.name:  # "." and "/" stand anywhere
            problem = problem.replace(str(depth), "--depth")
        return problem if problem.startswith(f"{name}: ") else f"{name}: {problem}"
