"""A set of cameras from a file: where they stand relative to a photo, or in a scene's own world.

`read_camera_set` in `camera_readers.py` reads the files.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path, PurePosixPath

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.keyframes import Keyframe, KeyframePath
from spackle.runtime.errors import InputError

SECONDS_PER_CAMERA = 1.0  # of a path through cameras whose file gives no times


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraSet:
    """The cameras of a file, in the file's order."""

    source: Path
    kind: str  # who writes such files, such as "nerfstudio"
    cameras: tuple[Camera, ...]  # in the file's world, float64; OpenCV's axes at each camera
    names: tuple[str, ...]  # of their pictures; "" for a picture without a name
    # The pose that a photo has that the file does not name: at the origin of the file's world, and
    # straight along its axes. None: the world is that of the photo's camera.
    origin: Tensor | None  # [4, 4] world_to_camera, float64
    is_metric: bool = False  # lengths are metres; else they have the scale of a reconstruction
    seconds_per_camera: float = SECONDS_PER_CAMERA
    notes: tuple[str, ...] = ()  # what was left out or assumed, each in a few words

    def index_of(self, photo_name: str) -> int | None:
        """Return the index of the camera that took a photo; None unless there is exactly one.

        Args:
            photo_name: the name of the photo's file, or that name without its suffix.
        """
        stem = PurePosixPath(photo_name).stem
        indices = []
        for index, name in enumerate(self.names):
            file_name = PurePosixPath(name.replace("\\", "/")).name
            # Some programs leave out the suffix.
            if file_name and (file_name == photo_name or stem in (file_name, Path(file_name).stem)):
                indices.append(index)
        return indices[0] if len(indices) == 1 else None

    def lens_of(self, photo_name: str) -> Camera | None:
        """Return the camera that took a photo, whose pose does not matter; None if unknown."""
        index = None if self.origin is None else self.index_of(photo_name)
        return None if index is None else self.cameras[index]

    def around_photo(self, photo_name: str) -> CameraSet:
        """Return the set in the world of the photo's camera (x right, y down, z forward).

        If the file names the photo, that camera is the origin; else the file's own origin is.
        """
        if self.origin is None:
            return self
        notes = list(self.notes)
        index = self.index_of(photo_name)
        if index is None:
            origin = self.origin
            notes.append(f"does not name {photo_name}: its origin is taken as the photo's camera")
        else:
            origin = self.cameras[index].world_to_camera
        if not self.is_metric:
            notes.append(f"its lengths, in the scale of {self.kind}, are taken as the scene's unit")

        photo_to_world = torch.linalg.inv(origin)
        cameras = [
            dataclasses.replace(camera, world_to_camera=camera.world_to_camera @ photo_to_world)
            for camera in self.cameras
        ]
        return dataclasses.replace(self, cameras=tuple(cameras), origin=None, notes=tuple(notes))

    @property
    def lines(self) -> list[str]:
        """The notes as lines for the user."""
        return [f"{self.source.name}: {note}" for note in self.notes]

    def views(self) -> list[Camera]:
        """Return the cameras in float32, as renderers take them."""
        return [camera.to(dtype=torch.float32) for camera in self.cameras]

    def path(self) -> KeyframePath:
        """Return a smooth path through all cameras, in their order.

        Raises:
            InputError: there are fewer than two cameras, or one has an impossible lens.
        """
        if len(self.cameras) < 2:
            problem = f"a path needs at least two cameras, got {len(self.cameras)}"
            raise InputError(f"{self.source}: {problem}")
        # The path looks at points this far before the cameras. Only their directions matter, but a
        # distance far smaller than the coordinates would be lost in rounding.
        positions = torch.stack([camera.position for camera in self.cameras])
        target_distance = max(1.0, float(positions.abs().max()))
        keys = [
            _keyframe(camera, index * self.seconds_per_camera, target_distance)
            for index, camera in enumerate(self.cameras)
        ]
        return KeyframePath(tuple(keys))


def _keyframe(camera: Camera, time: float, target_distance: float) -> Keyframe:
    """Return the keyframe of a camera at a time in seconds.

    `target_distance` is how far before the camera the point lies at which it looks.
    """
    eye = camera.position
    _, down, forward = camera.world_to_camera[:3, :3]  # the camera's axes in the world
    return Keyframe(
        time=time,
        eye=_three(eye),
        target=_three(eye + target_distance * forward),
        up=_three(-down),
        fov=math.degrees(2 * math.atan(camera.width / 2 / camera.focal[0])),
    )


def _three(vector: Tensor) -> tuple[float, float, float]:
    """Return the numbers of a vector [3]."""
    x, y, z = vector.tolist()
    return x, y, z
