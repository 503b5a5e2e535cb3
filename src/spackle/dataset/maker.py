"""Makes the samples of a dataset: a photo's base, views, targets and files."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from spackle.bases.open import BaseError, OpenedBase, open_base
from spackle.camera_path import DepthRange
from spackle.dataset.completion import Completion, open_completion
from spackle.dataset.options import DatasetOptions, configuration
from spackle.dataset.photos import PhotoFile
from spackle.dataset.sample import pack_sample
from spackle.dataset.views import draw_path, path_cameras, render_views
from spackle.errors import InputError
from spackle.files import fingerprint
from spackle.image import load_photo, resize_photo
from spackle.inpaint import InpainterOptions
from spackle.progress import timed
from spackle.render import Renderer, get_renderer

PARTS = "parts"  # in the output: samples that are in no shard yet

Seconds = dict[str, float]  # of each stage


@dataclasses.dataclass(frozen=True)
class PhotoJob:
    """A photo, and its place among all."""

    index: int
    file: PhotoFile

    @property
    def path(self) -> Path:
        return self.file.path


@dataclasses.dataclass(frozen=True)
class Made:
    """What became of a photo."""

    index: int
    seconds: Seconds
    sample: bytes | None = None  # a stretch of a tar archive
    problem: str | None = None  # why there is no sample


def key_of(index: int) -> str:
    """How a photo's files begin: its place among the photos."""
    return f"{index:06d}"


def part_file(output: Path, index: int) -> Path:
    """Where a photo's sample waits for its shard."""
    return output / PARTS / f"{key_of(index)}.tar"


@dataclasses.dataclass(frozen=True)
class Maker:
    """A base, a renderer and a completion, at work on one photo after the other."""

    options: DatasetOptions
    base: OpenedBase
    renderer: Renderer
    completion: Completion

    @staticmethod
    def of(options: DatasetOptions) -> Maker:
        """Set up; a network is loaded with the first photo. InputError where that cannot be."""
        base, renderer = open_base(options.base), get_renderer(options.base.device)
        device = None if options.base.device == "auto" else options.base.device
        wishes = InpainterOptions(options.inpainter_weights, options.inpainter_side, device)
        return Maker(options, base, renderer, open_completion(options.inpainter, wishes, renderer))

    @property
    def setup(self) -> dict[str, Any]:
        """The manifest's configuration, but for the photos."""
        return configuration(self.options, (), self.completion)

    def inputs(self, job: PhotoJob) -> list[str]:
        """Digests of a photo and of its depth map, as they lie on this machine."""
        try:
            content = fingerprint(job.path, "photo")
        except InputError:
            content = "none"
        return [content, *self.options.inputs_of(job.file)]

    def make(self, job: PhotoJob) -> Made:
        """A photo's sample; BaseError if no photo can give one."""
        seconds: Seconds = {}
        try:
            return Made(job.index, seconds, sample=self._sample(key_of(job.index), job.file, seconds))
        except BaseError:
            raise
        except InputError as error:
            return Made(job.index, seconds, problem=str(error))

    def _sample(self, key: str, file: PhotoFile, seconds: Seconds) -> bytes:
        with timed("load", seconds):
            photo = load_photo(file.path)
        with timed("base", seconds):
            prediction, _ = self.base.predict(photo, self.options.depth_of(file))
        choices, base, camera = self.options.choices, prediction.gaussians, prediction.camera
        with timed("render", seconds):
            path = draw_path(choices, file.sha256)
            try:
                cameras = path_cameras(path, camera.even(), DepthRange.of(base), choices.views)
            except ValueError as error:
                raise InputError(f"{file.path}: no camera path: {error}") from error
            stack = render_views(base, camera, cameras, self.renderer, choices.threshold)
        with timed("inpaint", seconds):
            targets = self.completion.complete(stack)
        with timed("encode", seconds):
            lens = {"focal_source": prediction.lens_source or photo.focal_source}
            size = {"width": photo.width, "height": photo.height}
            facts = {
                "photo": {"name": file.name, "sha256": file.sha256} | size | lens,
                "base": {"gaussians": len(base), **prediction.notes},
                "inpainter": {"name": self.completion.name, "version": self.completion.version},
                "threshold": choices.threshold,
            }
            return pack_sample(key, resize_photo(photo).rgb, stack, targets, path, facts)
