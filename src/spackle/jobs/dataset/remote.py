"""A `Maker` on a node of a cluster, which has to see the very files that the main process sees."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from spackle.digest import fingerprint
from spackle.errors import InputError
from spackle.jobs.dataset.options import DatasetOptions, configuration, inputs_of
from spackle.jobs.dataset.worker import Job, Made, Maker
from spackle.pseudo.manifest import differences
from spackle.pseudo.photos import PhotoFile


class RemoteMaker:
    """Holds base, renderer and inpainter; gives samples back as bytes, so a node needs no place to write."""

    def __init__(self, options: DatasetOptions, folder: str) -> None:
        """Start in `folder`, the main process's: relative paths, and what is said of them, stay what they are."""
        self.options = options
        torch.set_num_threads(options.threads)
        with contextlib.suppress(OSError):  # where it is missing, so are the files that are looked for in it
            os.chdir(folder)

    def begin(self, expected: Mapping[str, Any]) -> None:
        """Set up.

        Raises:
            InputError: the samples could not be the same as elsewhere: the version or weights differ.
        """
        try:
            self.maker = Maker.of(self.options, Path())
            own = setting(self.options, self.maker)
        except InputError as error:
            raise InputError(f"node {socket.gethostname()}: {error}") from error
        if lines := differences(expected, own):
            raise InputError(
                f"node {socket.gethostname()}: would make another dataset ({'; '.join(lines)}): "
                "install the same version and the same weights on every node"
            )

    def make(self, job: Job, seen: Sequence[str]) -> tuple[Made, bytes | None]:
        """A photo's sample, or None where it gives none.

        Raises:
            InputError: the node does not see the same photo or depth map, or no photo can be worked on.
        """
        _, photo = job
        if what_is_seen(photo, self.options) != seen:
            raise InputError(
                f"{photo.path}: node {socket.gethostname()} does not find this photo or its depth map, or others in "
                "their place: they must lie at the same paths on every node, on a disk that all share"
            )
        return self.maker.sample(job)


def setting(options: DatasetOptions, maker: Maker) -> dict[str, Any]:
    """All that samples depend on besides the photos."""
    return configuration(options, (), maker.inpainter)


def what_is_seen(photo: PhotoFile, options: DatasetOptions) -> list[str]:
    """The contents of a photo and of its depth map, as they lie on this machine."""
    try:
        content = fingerprint(photo.path, "photo")
    except InputError:
        content = "none"
    return [content, *inputs_of(photo, options.base)]
