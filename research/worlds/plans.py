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
    """A street, garden or track."""

    kind: str
    mesh: Mesh
    pictures: dict[str, NDArray[np.uint8]]  # made textures by name
    lights: Lights
    draw_viewpoint: DrawViewpoint  # gives a random camera
    models: tuple[str, ...]  # keys of the models in it, for attribution
    coarse_m: float  # width of the coarse cells of light in metres
