"""What a scene file holds: Gaussians, and what Spackle needs to go on with a scene."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """The content of a scene file; most formats store only Gaussians."""

    path: Path
    gaussians: Gaussians
    # The camera of the photo from which the scene was made.
    camera: Camera | None = None
    # How many Gaussians come from the photo; the Gaussians that fill holes come after them.
    base_count: int | None = None
    # How far to the side the camera may go, because the holes that it uncovers are filled. A
    # disparity of 1 shifts the nearest surface by the picture's diagonal.
    disparity: float | None = None
    # The coefficients of spherical harmonics above degree 0 that each Gaussian of the file has.
    # They are not read.
    unread_harmonics: int = 0

    @property
    def camera_at_origin(self) -> Camera | None:
        """The camera if it is at the world's origin and looks along z, else None.

        A comment in a PLY file has no room for another pose.
        """
        if self.camera is None or not is_at_origin(self.camera):
            return None
        return self.camera


def is_at_origin(camera: Camera) -> bool:
    """Return whether a camera is at the world's origin and looks along z, without a tilt."""
    return torch.equal(camera.world_to_camera, torch.eye(4).to(camera.world_to_camera))
