"""What a world consists of, ready for the caster."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from worlds.lights import Lights
from worlds.meshes import Mesh
from worlds.viewpoints import MIN_NEAR_M, DrawViewpoint


@dataclasses.dataclass(frozen=True)
class Setting:
    """What all worlds indoors, or all worlds in the open, have in common."""

    # Least share of a photo whose pixels show a surface that is not behind glass; in the open the
    # sky is no surface.
    min_known: float
    # No camera is held nearer to a thing than this, in metres: it would fill the picture.
    near_m: float
    # Range of the share of the light's colour cast that the camera's white balance takes away.
    balanced: tuple[float, float]


INDOORS = Setting(min_known=0.6, near_m=MIN_NEAR_M, balanced=(0.4, 0.95))
# In rooms, but close to a thing.
CLOSE = Setting(min_known=0.6, near_m=0.12, balanced=(0.4, 0.95))
OUTDOORS = Setting(min_known=0.5, near_m=0.8, balanced=(0.05, 0.45))


@dataclasses.dataclass(frozen=True)
class WorldPlan:
    """A room, street, garden or track: its triangles, its light, from where it is photographed.

    Coordinates are metres with z up.
    """

    setting: Setting
    kind: str  # "kitchen", "town street", "garden", "track" and others; told in the world's JSON
    mesh: Mesh  # all triangles, with their materials
    # Textures that are no files, [H, W, 3] or [H, W, 4], by the name that materials give.
    pictures: dict[str, NDArray[np.uint8]]
    lights: Lights
    draw_viewpoint: DrawViewpoint  # called for a random camera; see its definition
    models: tuple[str, ...]  # sorted keys of the library's models in it, for attribution
    # Width in metres of the larger of the two sizes of cells in which `irradiance.solve` keeps
    # light: smaller ones show finer shadows and take longer.
    coarse_m: float
