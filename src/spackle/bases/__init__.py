"""A base turns one photo into the 3D Gaussians of the surfaces that the photo shows.

Here stand the interface `Base` and its result. `settings` lists the bases and their options,
`open` opens and chooses them. The bases are SHARP and MoGe-2 (published networks), lite (two small
networks in the package), transformers (any depth model of that library) and depth (a measured depth
map).
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.focal_length import focal_mm_to_px
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo
from spackle.core.trajectories import DepthRange
from spackle.runtime.progress import Progress

# The camera's move, as a share of the view that the nearest surface shifts by, if neither the user
# nor the base limits it: the smallest move in the paper (S1).
DEFAULT_MAX_DISPARITY = 0.3
# Share of the widest views that may be holes if the user sets no disparity; more is conspicuous.
DEFAULT_MAX_HOLE_RATIO = 0.125
# A network's estimate of the focal length is plausible in this range of 35 mm equivalents, which
# are fields of view from 130° to 4°.
PLAUSIBLE_FOCALS_MM = (10.0, 600.0)


@dataclasses.dataclass(frozen=True)
class BasePrediction:
    """The photo's Gaussians in the frame of the photo's camera."""

    gaussians: Gaussians
    camera: Camera  # the photo's camera, at its working size
    notes: dict[str, float | int | str]  # for the report: measured, filled or assumed values
    lens_source: str = ""  # who gave the focal length, if neither the photo's file nor the user did
    max_disparity: float = DEFAULT_MAX_DISPARITY  # largest camera move with correct geometry
    max_hole_ratio: float = DEFAULT_MAX_HOLE_RATIO  # share of the widest views that may be holes
    is_metric: bool = True  # whether the unit of length is known to be the metre
    # [H, W, 3] sRGB: the photo at the camera's size, which residual networks see (I in eq. 5).
    # None: unknown, as for Gaussians of another tool; a rendering of the Gaussians then stands in.
    photo: Tensor | None = dataclasses.field(default=None, repr=False, compare=False)

    @property
    def depth_range(self) -> DepthRange:
        """The depths on which a camera path depends; ValueError if nothing is before the camera."""
        return DepthRange.of(self.gaussians, is_metric=self.is_metric)


class Base(Protocol):
    """A frozen network, or a depth map, that turns a photo into Gaussians."""

    name: str

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Predict Gaussians only for the surfaces that are visible in the photo.

        Args:
            photo: at its full size. The prediction's camera has the working size (the long side is
                at most 1536 pixels).
            progress: called with (steps done, number of steps), by bases whose work takes long.
        """
        ...


def is_plausible_focal(focal_px: float, width: int, height: int) -> bool:
    """Whether a focal length that a network estimates is plausible for a photo of this size."""
    # A network may see a painting or a close-up as a view through an impossible lens.
    shortest_mm, longest_mm = PLAUSIBLE_FOCALS_MM
    shortest_px = focal_mm_to_px(shortest_mm, width, height)
    longest_px = focal_mm_to_px(longest_mm, width, height)
    return shortest_px <= focal_px <= longest_px
