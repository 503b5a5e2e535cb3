"""What every base promises."""

from __future__ import annotations

import dataclasses
from typing import Protocol

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.image import Photo


@dataclasses.dataclass(frozen=True)
class BasePrediction:
    """What the photo shows, as Gaussians in the frame of the photo's camera."""

    gaussians: Gaussians
    camera: Camera  # the photo's, where the base knows the lens better than the photo's file does
    notes: dict[str, float | int | str]  # for the report: what was measured, filled or assumed


class Base(Protocol):
    """A frozen network, or a depth map, that turns a photo into Gaussians."""

    name: str

    def predict(self, photo: Photo) -> BasePrediction:
        """Gaussians of everything that the photo shows, and nothing else."""
        ...
