"""What a scene file holds: Gaussians, and what Spackle needs to go on with a scene.

A reader of a format returns a `DecodedScene`; `load_scene` makes it a `SceneFile`.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.spherical_harmonics import degree_of_count
from spackle.formats.gaussian_columns import GaussianColumns


class UnsupportedSceneError(ValueError):
    """A file that may be sound, but is not read; the text says what it is, and what to do."""


def left_out_note(broken_count: int) -> str:
    """The words for Gaussians that are left out because they are not finite."""
    return f"{broken_count:,} Gaussians that are not finite are left out"


def harmonics_loss(degree: int, kept_degree: int = 0) -> str:
    """The words for spherical harmonics that are left out above `kept_degree`."""
    effect = "colours do not change with the view"
    if kept_degree > 0:
        effect = f"those up to degree {kept_degree} are kept"
    return f"spherical harmonics of degree {degree} are dropped: {effect}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class DecodedScene:
    """What a reader finds in a file; all but the Gaussians may be unknown."""

    columns: GaussianColumns
    format: str  # with the version, such as "SPZ 3"
    writer: str | None = None  # the program that wrote the file, as the file names it
    # The highest degree of the file's spherical harmonics. Those above degree 3 are not read.
    harmonics_degree: int = 0
    # What else was left out or assumed, each in a few words for the user.
    notes: tuple[str, ...] = ()
    camera: Camera | None = None  # of the photo
    base_count: int | None = None  # how many Gaussians come from the photo
    byte_count: int = 0  # of all files that were read, if there may be several; 0 for a single one


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
    # Whether the unit of length is known to be the metre.
    is_metric: bool = False
    format: str = ""  # with the version, such as "SPZ 3"
    writer: str | None = None  # the program that wrote the file, as the file names it
    # The highest degree of the file's spherical harmonics. Those above degree 3 are not read.
    harmonics_degree: int = 0
    # What else was left out or assumed, each in a few words for the user.
    notes: tuple[str, ...] = ()
    byte_count: int = 0  # of the file, or of all files of the scene

    @staticmethod
    def of_scene(
        path: Path,
        base: Gaussians,
        aux: Gaussians,
        camera: Camera,
        *,
        is_metric: bool,
        disparity: float | None = None,
    ) -> SceneFile:
        """The content of a file for a completed scene.

        Args:
            path: the name of the file, or that of the photo, which gives the scene its name.
            base: the Gaussians of the photo, or of several.
            aux: those that fill holes.
            camera: of the photo, or of the most central one.
            is_metric: whether the unit of length is known to be the metre.
            disparity: how far to the side the camera may go, see the field.
        """
        return SceneFile(
            path=path,
            gaussians=Gaussians.cat([base, aux]),
            camera=camera,
            base_count=len(base),
            disparity=disparity,
            is_metric=is_metric,
        )

    @property
    def losses(self) -> list[str]:
        """What was left out or assumed when the file was read, each in a few words."""
        losses = list(self.notes)
        kept_degree = degree_of_count(self.gaussians.harmonics_count)
        if self.harmonics_degree > kept_degree:
            losses.append(harmonics_loss(self.harmonics_degree, kept_degree))
        return losses

    @property
    def is_added(self) -> Tensor:
        """[N] bool: the Gaussians that were added to fill holes; none if that is not known."""
        count = len(self.gaussians)
        base_count = count if self.base_count is None else self.base_count
        return torch.arange(count) >= base_count


def is_at_origin(camera: Camera) -> bool:
    """Return whether a camera is at the world's origin and looks along z, without a tilt."""
    return torch.equal(camera.world_to_camera, torch.eye(4).to(camera.world_to_camera))
