"""Scene files: what a PLY holds, and the formats that a scene is written in, by the end of a file's name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch

from spackle.camera import Camera
from spackle.errors import InputError
from spackle.files import write_whole
from spackle.formats.columns import Columns
from spackle.formats.compressed_ply import encode_compressed_ply
from spackle.formats.gltf import encode_glb
from spackle.formats.ply import load_ply, load_ply_base_count, load_ply_camera, load_ply_disparity, save_ply
from spackle.formats.sog import encode_sog
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


SPLAT_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def encode_splat(gaussians: Gaussians) -> bytes:
    """Gaussians, in their order and axes, as a .splat file of antimatter15's viewer: 32 bytes each, and nothing else.

    Colours, opacities and rotations are rounded to bytes.

    Raises:
        ValueError: where a Gaussian is not finite.
    """
    columns = Columns.of(gaussians)
    rows = np.empty(len(gaussians), SPLAT_ROW)
    rows["means"] = columns.means
    rows["scales"] = np.exp(columns.log_scales)
    rows["rgba"][:, :3] = np.round(columns.srgb * 255)
    rows["rgba"][:, 3] = np.round(columns.opacities * 255)
    rows["quats"] = np.clip(np.round(columns.quats * 128 + 128), 0, 255)
    return rows.tobytes()


Writer = Callable[[SceneFile, Path], None]
# Each writes a whole file or none. A new format is one file and one line here; the first end that fits a name counts.
SCENE_WRITERS: dict[str, Writer] = {
    ".compressed.ply": lambda scene, path: write_whole(
        path, encode_compressed_ply(scene.gaussians, scene.untilted_camera, scene.base_count)
    ),
    ".ply": lambda scene, path: save_ply(
        scene.gaussians,
        path,
        camera=scene.untilted_camera,
        base_count=scene.base_count,
        disparity=scene.disparity,
    ),
    ".spz": lambda scene, path: write_whole(path, encode_spz(scene.gaussians)),
    ".splat": lambda scene, path: write_whole(path, encode_splat(scene.gaussians)),
    ".sog": lambda scene, path: write_whole(path, encode_sog(scene.gaussians)),
    ".glb": lambda scene, path: write_whole(path, encode_glb(scene.gaussians, scene.camera, scene.base_count)),
}


def writer_of(path: Path, more: Mapping[str, Writer] | None = None) -> Writer:
    """What writes a file of this name, of SCENE_WRITERS and `more`; InputError for a name of no format."""
    writers = {**SCENE_WRITERS, **(more or {})}
    for suffix, writer in writers.items():
        if path.name.lower().endswith(suffix):
            return writer
    raise InputError(f"{path}: which format? Give a name that ends in {', '.join(writers)}")
