"""What a scene's file holds, read once for whatever is made of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from spackle.camera import Camera
from spackle.formats import load_ply, load_ply_base_count, load_ply_camera, load_ply_disparity
from spackle.gaussians import Gaussians


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """What a PLY holds."""

    path: Path
    gaussians: Gaussians
    camera: Camera | None  # the photo's
    base_count: int | None
    disparity: float | None = None  # how far it was completed

    @staticmethod
    def load(path: Path) -> SceneFile:
        """Read a PLY of ours, of INRIA's or of SHARP's.

        Raises:
            InputError: a file that is no scene.
        """
        return SceneFile(
            path, load_ply(path), load_ply_camera(path), load_ply_base_count(path), load_ply_disparity(path)
        )

    @property
    def untilted_camera(self) -> Camera | None:
        """The camera where it stands at the world's origin, which is all that a comment of a PLY can say."""
        return self.camera if self.camera is not None and at_origin(self.camera) else None


def at_origin(camera: Camera) -> bool:
    """Whether a camera stands at the world's origin and looks along z."""
    return torch.equal(camera.world_to_camera, torch.eye(4).to(camera.world_to_camera))
