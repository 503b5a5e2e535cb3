"""What a world in the open consists of, ready for the caster."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from worlds.lights import Lights
from worlds.meshes import Mesh
from worlds.outdoors import DrawViewpoint


@dataclasses.dataclass(frozen=True)
class OpenPlan:
    """A street, garden or track: its triangles, its light, and from where it is photographed.

    Coordinates are metres with z up.
    """

    kind: str  # "town street", "suburban street", "garden" or "track"; told in the world's JSON
    mesh: Mesh  # all triangles, with their materials
    # Textures that are no files, [H, W, 3] or [H, W, 4], by the name that materials give.
    pictures: dict[str, NDArray[np.uint8]]
    lights: Lights
    draw_viewpoint: DrawViewpoint  # called for a random camera; see its definition
    models: tuple[str, ...]  # sorted keys of the library's models in it, for attribution
    # Width in metres of the larger of the two sizes of cells in which `irradiance.solve` keeps
    # light: smaller ones show finer shadows and take longer.
    coarse_m: float
