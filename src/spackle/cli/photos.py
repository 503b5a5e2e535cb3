"""`spackle predict`: photos, folders or a clip, by this process or by workers. Read `predict_all`."""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import os
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch

import spackle
from spackle._numba import is_compiled
from spackle.bases.depth_map import calibrations_beside, depth_of_array, find_depth
from spackle.bases.lift import lift
from spackle.bases.open import BaseError
from spackle.camera import Camera
from spackle.cli.clip import FILES as CLIP_FILES
from spackle.cli.clip import clip_options, predict_clip
from spackle.cli.photo import PredictOptions
from spackle.clips.files import is_clip
from spackle.device import thread_count
from spackle.errors import InputError
from spackle.files import as_recorded, check_file, digest_of, files_in, fingerprint, results_folder
from spackle.image import PHOTO_SUFFIXES
from spackle.patches import match_patches
from spackle.photo_results import REPORT, earlier_report, predict_photo
from spackle.pipeline import Options, Pipeline
from spackle.progress import Notes, Reporter, asked_to_stop
from spackle.render import Renderer, device_of, get_renderer
from spackle.render.blend import blend_tiles
from spackle.scene_fill import FillContext, OcclusionGuard, fill_scene
from spackle.scene_fill.occlusion_guard import free_factors
from spackle.surface import surface_gaussians
from spackle.weights import installed
from spackle.workers import at_work, threads_of_torch

SIDE = 64  # side in pixels of the picture that `compile_kernels` completes


class NamedPhoto(NamedTuple):
    """A photo, and the name of its results."""

    path: Path
    name: str


def predict_all(given: Sequence[Path], output: Path, options: PredictOptions, reporter: Reporter) -> int:
    """Work through a clip, or photos and folders of photos; returns the number of photos that failed.

    InputError for an option, a clip or a single photo that cannot be used.
    """
    named = find_photos(given)
    count = min(options.workers, len(named))
    threads = options.threads or max(1, thread_count() // count)
    single = len(given) == len(named) == 1 and not os.path.isdir(given[0])
    if clips := [photo.path for photo in named if is_clip(photo.path)]:
        if not single:
            raise InputError(f"{clips[0]}: is a clip: give it alone, without other photos or clips")
        pipeline = Pipeline.open(clip_options(options))
        check_file(clips[0], "clip")
        folder = output / named[0].name
        with results_folder(output), compiled_ahead(pipeline.renderer, reporter.log):
            predict_clip(clips[0], folder, pipeline, options.lens, reporter)
        reporter.log(f"Look at {folder / CLIP_FILES[0]}")
        return 0
    pipeline = options.open()
    if single:
        check_file(named[0].path, "photo")
    shared = _shared_digest(options)
    with results_folder(output, alone=not single), compiled_ahead(pipeline.renderer, reporter.log):
        predictor = Predictor(output, options, shared, single, pipeline, reporter.verbose)
        left = predictor.left(named, reporter)
        if count == 1:
            with threads_of_torch(threads):
                failed = sum(not predictor.predict(photo, reporter) for photo in left)
        else:
            open_predictor = partial(Predictor.open, output, options, shared, reporter.verbose)
            failed = _predict_by_workers(open_predictor, list(left), len(named), count, threads, reporter)
    if failed:
        reporter.log(f"{failed} of {len(named)} photos failed")
    else:
        folder = output / (named[0].name if single else "NAME")
        video = f" at {folder / f'video{options.scene.path.video.suffix}'}, or" if options.render else ""
        reporter.log(f"Look{video} into the scene: spackle view {shlex.quote(str(folder / 'scene.ply'))}")
    return failed


def find_photos(given: Sequence[Path]) -> list[NamedPhoto]:
    """The given photos, and the photos in given folders sorted by name, each with the name of its results.

    A name that is not a file may be a pattern that no shell has expanded. InputError for a folder without photos,
    and for two photos whose results would have the same name.
    """
    photos: list[Path] = []
    for path in given:
        found = files_in(path, PHOTO_SUFFIXES) if os.path.isdir(path) else [path]
        if not found:
            raise InputError(f"{path}: no photos in this folder (looked for {', '.join(PHOTO_SUFFIXES)})")
        pattern = not os.path.lexists(path) and sorted(map(Path, glob.glob(str(path))))
        photos += pattern or found
    # a.jpg and a.png must not write over each other, nor over a.jpg.png.
    stems = Counter(photo.stem.casefold() for photo in photos)
    names = Counter(photo.name.casefold() for photo in photos)
    if twice := [photo for photo in photos if names[photo.name.casefold()] > 1]:
        raise InputError(f"{twice[1]}: {twice[0]} has the same name: process them in two runs, each with its own -o")

    def name(photo: Path) -> str:
        stem = photo.stem.casefold()
        plain = stems[stem] == 1 and stem not in names and photo.stem.strip(".")  # "...png" has the stem ".."
        return photo.stem if plain else photo.name

    return [NamedPhoto(photo, name(photo)) for photo in photos]


def _predict_by_workers(
    open_predictor: Callable[[], Predictor],
    left: Sequence[NamedPhoto],
    total: int,
    count: int,
    threads: int,
    reporter: Reporter,
) -> int:
    """Predict photos by workers; returns how many failed. Messages about a photo are printed once it is done.

    If Ctrl-C or SIGTERM came, raises KeyboardInterrupt once the photos in progress are done.
    """
    if not left:
        return 0
    failed = 0
    done = ready = total - len(left)
    with (
        asked_to_stop(alone=True) as stop,
        reporter.steps("photos", ready, total) as step,
        at_work(open_predictor, left, stop, count=count, threads=threads) as results,
    ):
        for done, result in enumerate(results, ready + 1):
            for what in result.said:
                reporter.log(what) if isinstance(what, str) else reporter.result(what)
            failed += result.failed
            step(done, result.photo)
            if stop():
                break
    if done < total:
        reporter.log("stopped; the same command resumes from here")
        raise KeyboardInterrupt
    return failed


class Predicted(NamedTuple):
    """A worker's result for a photo."""

    photo: str
    failed: bool
    said: Sequence[str | Mapping[str, object]]


@dataclasses.dataclass(frozen=True)
class Predictor:
    """Predicts one photo after the other."""

    output: Path
    options: PredictOptions
    shared: str  # the main process's digest of what all photos share
    single: bool  # there is one photo: it is always redone, and its error ends the command
    pipeline: Pipeline
    verbose: bool

    @staticmethod
    def open(output: Path, options: PredictOptions, shared: str, verbose: bool) -> Predictor:
        """Open the predictor of a worker process; InputError if its base cannot be opened."""
        return Predictor(output, options, shared, False, options.open(), verbose)

    def is_done(self, photo: NamedPhoto) -> bool:
        """Whether the results of an earlier run with the same input and options are still complete."""
        folder = self.output / photo.name
        earlier = {} if self.single or self.options.overwrite else earlier_report(folder)
        with contextlib.suppress(InputError):  # `predict` reports a missing file
            return (
                bool(earlier)
                and earlier.get("request") == self.request(photo)
                and as_recorded(folder, REPORT, earlier.get("files"))
            )
        return False

    def request(self, photo: NamedPhoto) -> str:
        """A digest of all that a photo's results depend on; InputError if the photo or its depth map is missing."""
        files, depth = [fingerprint(photo.path, "photo")], self.options.scene.base.depth
        if isinstance(depth, Path):
            depth = find_depth(depth, photo.path)
            files.append(fingerprint(depth, "depth map"))
            files += [fingerprint(file, "calibration") for file in calibrations_beside(depth) if file.is_file()]
        return digest_of([self.shared, *files])

    def make(self, photo: NamedPhoto) -> Predicted:
        """Predict one photo in a worker, see `predict`."""
        notes = Notes(self.verbose)
        return Predicted(photo.path.name, not self.predict(photo, notes), notes.said)

    def left(self, photos: Iterable[NamedPhoto], reporter: Reporter) -> Iterator[NamedPhoto]:
        """The photos that are not done yet; logs those that are."""
        for photo in photos:
            if self.is_done(photo):
                reporter.log(f"{photo.path.name}: done already (--overwrite does it again)")
                reporter.result({"folder": self.output / photo.name, "done_already": True})
            else:
                yield photo

    def predict(self, photo: NamedPhoto, reporter: Reporter) -> bool:
        """Predict a photo; returns whether it succeeded, and logs why not. InputError if no photo can be predicted."""
        folder = self.output / photo.name
        try:
            options = self.options
            predict_photo(
                photo.path,
                folder,
                self.pipeline,
                reporter,
                lens=options.lens,
                keep_frame=options.keep_frame,
                keep_base=options.keep_base,
                depth_out=options.depth_out,
                render=options.render,
                request=self.request(photo),
            )
        except InputError as error:
            if self.single or isinstance(error, BaseError):  # no other photo can be worked on
                raise
            reporter.log(f"error: {error}")
            reporter.result({"folder": folder, "error": str(error)})
            return False
        return True


def _shared_digest(options: PredictOptions) -> str:
    """A digest of everything that all photos share: version, options, contents of their files; InputError for a missing
    file.
    """
    base, path, fill = options.scene.base, options.scene.path, options.scene.fill
    name = base.named if base.folder is None else "hf"  # the digests of its files identify it, wherever they lie
    files = {**_shared_files(options.scene), **base.files}
    # Windows and compilation change only the last bits of results.
    base = dataclasses.replace(base, name=name, depth=None, calib=None, checkpoint=None, windows=None, compiled=False)
    path = dataclasses.replace(path, cameras=None, path=None)
    choices: list[object] = [dataclasses.asdict(base), dataclasses.asdict(path), fill.weights, fill.texture, fill.mode]
    choices += [options.lens, options.render, options.keep_base, options.depth_out, options.keep_frame]
    prints = {kind: fingerprint(file, kind) for kind, file in files.items()}
    return digest_of([spackle.__version__, choices, prints])


def _shared_files(options: Options) -> dict[str, Path]:
    """The files, apart from the base's, that all photos share, by kind."""
    path, fill = options.path, options.fill
    files = {"calibration": options.base.calib, "camera file": path.cameras, "path file": path.path}
    files |= {"weights": fill.file, "LaMa": installed("lama") if fill.texture == "lama" else None}
    return {kind: file for kind, file in files.items() if file is not None}


@contextlib.contextmanager
def compiled_ahead(renderer: Renderer, log: Callable[[str], None]) -> Iterator[None]:
    """During the block a second process compiles the kernels that are needed last, unless they are on disk.

    Numba compiles one kernel at a time in a process, so a thread would not help.
    """
    if device_of(renderer).type != "cpu" or is_compiled(blend_tiles):
        yield
        return
    log("first use: kernels are compiled for this processor, which takes about half a minute, once")
    words = [sys.executable, "-c", f"from {__name__} import compile_kernels; compile_kernels()"]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(words, stdin=quiet, stdout=quiet, stderr=quiet) as helper:
        try:
            yield
        finally:
            helper.kill()


@torch.no_grad()
def compile_kernels() -> None:
    """Complete a small view, which compiles all kernels of completion, in another order than the main process does."""
    torch.set_num_threads(1)
    camera = Camera.from_focal(SIDE, SIDE, SIDE)
    aside = torch.eye(4)
    aside[0, 3] = -0.4
    moved = dataclasses.replace(camera, world_to_camera=aside)
    depth = torch.full((SIDE, SIDE), 2.0)
    depth[SIDE // 4 : -SIDE // 4, SIDE // 4 : -SIDE // 4] = 1.0
    rgb, hole = torch.rand(SIDE, SIDE, 3), depth < 2
    match_patches(rgb, hole, 1 / depth)
    shape = camera.pixel_centers().flatten(0, 1), 1 / depth.flatten(), torch.zeros(SIDE**2, 2)
    base = surface_gaussians(camera, *shape, 0.6, rgb.flatten(0, 1), torch.full((SIDE**2,), 0.9))
    guard = OcclusionGuard.of(get_renderer("cpu").render(base, camera), camera)
    free_factors(base, moved.position, [guard])
    assert len(fill_scene(FillContext(base, camera, get_renderer("cpu")), [moved, camera]).aux)
    lift(rgb, depth_of_array(depth[::2, ::2].numpy(), Path("depth")), camera)  # of another size, as lite's is
