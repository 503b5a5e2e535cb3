"""The interface of every base. `settings` lists the bases that `--base` can name, and `open` opens them."""

from __future__ import annotations

import dataclasses
from typing import Protocol

from spackle.core.camera import Camera
from spackle.core.focal_length import focal_mm_to_px
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo
from spackle.runtime.progress import Progress

DEFAULT_MAX_DISPARITY = (
    0.3  # the camera's disparity if neither the user nor the base limits it; the paper's S1
)
DEFAULT_MAX_HOLE_RATIO = 0.125  # share of the widest views that may be holes if the user sets no disparity; more is conspicuous


@dataclasses.dataclass(frozen=True)
class BasePrediction:
    """The photo's Gaussians in the frame of the photo's camera."""

    gaussians: Gaussians
    camera: Camera  # the photo's camera, at its working size
    notes: dict[str, float | int | str]  # for the report: measured, filled or assumed values
    lens_source: str = (
        ""  # source of the focal length, if it is neither the photo's file nor the user
    )
    max_disparity: float = (
        DEFAULT_MAX_DISPARITY  # largest disparity with correct geometry, used if the user sets none
    )
    max_hole_ratio: float = DEFAULT_MAX_HOLE_RATIO  # share of the widest views that may be holes, if the user sets no disparity


class Base(Protocol):
    """A frozen network, or a depth map, that turns a photo into Gaussians."""

    name: str

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Predict Gaussians only for the surfaces that are visible in the photo.

        Args:
            photo: at its full size. The prediction's camera has the working size (see `working_size`).
            progress: called with (steps done, number of steps), by bases whose work takes long.
        """
        ...


PLAUSIBLE_FOCALS_MM = (
    10.0,
    600.0,
)  # a network's estimate is plausible between these 35 mm equivalents (130° to 4°)


def is_plausible_focal(focal_px: float, width: int, height: int) -> bool:
    """Whether a focal length that a network estimates is plausible for a photo of this size."""
    shortest, longest = (focal_mm_to_px(mm, width, height) for mm in PLAUSIBLE_FOCALS_MM)
    return shortest <= focal_px <= longest
