"""Scene files: what a PLY holds, and the formats that a scene is written in, by the end of a file's name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import torch

from spackle.camera import Camera
from spackle.formats.atomic import write_whole
from spackle.formats.compressed_ply import encode_compressed_ply
from spackle.formats.gltf import encode_glb
from spackle.formats.ply import load_ply, load_ply_base_count, load_ply_camera, load_ply_disparity, save_ply
from spackle.formats.sog import encode_sog
from spackle.formats.splat import encode_splat
from spackle.formats.spz import encode_spz
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


def _write_ply(scene: SceneFile, path: Path) -> None:
    camera, base_count, disparity = scene.untilted_camera, scene.base_count, scene.disparity
    save_ply(scene.gaussians, path, camera=camera, base_count=base_count, disparity=disparity)


def _write_compressed_ply(scene: SceneFile, path: Path) -> None:
    write_whole(path, encode_compressed_ply(scene.gaussians, scene.untilted_camera, scene.base_count))


# Each writes a whole file or none. A new format is one file and one line here; the first end that fits a name counts.
SCENE_WRITERS: dict[str, Callable[[SceneFile, Path], None]] = {
    ".compressed.ply": _write_compressed_ply,
    ".ply": _write_ply,
    ".spz": lambda scene, path: write_whole(path, encode_spz(scene.gaussians)),
    ".splat": lambda scene, path: write_whole(path, encode_splat(scene.gaussians)),
    ".sog": lambda scene, path: write_whole(path, encode_sog(scene.gaussians)),
    ".glb": lambda scene, path: write_whole(path, encode_glb(scene.gaussians, scene.camera, scene.base_count)),
}
