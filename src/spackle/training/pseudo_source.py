"""Views of a pseudo-supervised dataset as a source of samples (paper, appendix, "Dataset")."""

from __future__ import annotations

import os

import numpy as np
import torch

from spackle.errors import InputError
from spackle.pseudo import PseudoFiles
from spackle.training.sample import Sample

UNCOMPLETED = "none"  # the inpainter that leaves its holes open


class PseudoViews:
    """Random views with holes of random photos, and their completed targets."""

    name = "pseudo"

    def __init__(self, location: str | os.PathLike[str]) -> None:
        """Read the manifest.

        Raises:
            InputError: no finished dataset, one without holes, or one whose targets nobody has completed.
        """
        self.files = PseudoFiles(location)
        config = self.files.manifest.config
        if config.get("inpainter", {}).get("name") == UNCOMPLETED:
            raise InputError(f"{location}: built with --inpainter none, so its targets teach nothing: build another")
        self._open = [
            (photo, view)
            for photo, (_, sample) in enumerate(self.files.samples)
            for view, hole in enumerate(sample.holes)
            if hole > 0
        ]
        if not self._open:
            raise InputError(f"{location}: no view in it has a hole: build it with a wider --disparity")

    @property
    def digest(self) -> str:
        """The same for the same dataset, wherever it lies."""
        return self.files.manifest.digest

    def view(self, rng: np.random.Generator) -> Sample:
        """A view, the same for the same state of `rng`; its rendering is the stored one.

        Raises:
            InputError: a shard that is missing or damaged.
        """
        photo, index = self._open[int(rng.integers(len(self._open)))]
        found = self.files.group(photo).view(index, with_base=True)
        assert found.base is not None
        known = torch.ones_like(found.mask)
        return Sample.of(found.base, found.rendering, found.camera, found.photo_camera, found.target, known)
