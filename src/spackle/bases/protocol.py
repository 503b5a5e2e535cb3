"""What every base promises."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.image import Photo

Progress = Callable[[int, int], None]  # (steps done, of how many)


@dataclasses.dataclass(frozen=True)
class BasePrediction:
    """What the photo shows, as Gaussians in the frame of the photo's camera."""

    gaussians: Gaussians
    camera: Camera  # the photo's, at its working size
    notes: dict[str, float | int | str]  # for the report: what was measured, filled or assumed
    lens_source: str = ""  # who gave the camera's lens, where it is not the photo's file or a person


class Base(Protocol):
    """A frozen network, or a depth map, that turns a photo into Gaussians."""

    name: str

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of everything that the photo shows, and nothing else.

        Args:
            photo: at its full size. The prediction's camera has the working size (see `working_size`).
            progress: called as the work advances, where it takes long.
        """
        ...
