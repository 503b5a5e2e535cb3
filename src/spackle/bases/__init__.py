"""What every base promises; `settings` says what may be named, and `open` opens it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.image import Photo, film_to_pixels

Progress = Callable[[int, int], None]  # (steps done, of how many)
USUAL_DISPARITY = 0.3  # how far a camera goes where neither a person nor the base says; the paper's S1
UNCOVERED = 0.125  # of the widest views, where nobody says how far a camera goes; more, and the fill meets the eye


@dataclasses.dataclass(frozen=True)
class BasePrediction:
    """What the photo shows, as Gaussians in the frame of the photo's camera."""

    gaussians: Gaussians
    camera: Camera  # the photo's, at its working size
    notes: dict[str, float | int | str]  # for the report: what was measured, filled or assumed
    lens_source: str = ""  # who gave the camera's lens, where it is not the photo's file or a person
    disparity: float = USUAL_DISPARITY  # how far a camera goes at most where nobody says: so far this geometry is right
    uncovered: float = UNCOVERED  # share of the widest views that may be holes, where nobody says how far it goes


class Base(Protocol):
    """A frozen network, or a depth map, that turns a photo into Gaussians."""

    name: str

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians of everything that the photo shows, and nothing else.

        Args:
            photo: at its full size. The prediction's camera has the working size (see `working_size`).
            progress: called with (steps done, number of steps), by bases whose work takes long.
        """
        ...


SEEN_LENSES_MM = (10.0, 600.0)  # 35 mm equivalents that a network is believed to see in a photo: 130° to 4°


def believed_lens(focal_px: float, width: int, height: int) -> bool:
    """Whether a photo of that size may have the focal length that a network sees in it."""
    shortest, longest = (film_to_pixels(mm, width, height) for mm in SEEN_LENSES_MM)
    return shortest <= focal_px <= longest


NEAREST_M = 1.5  # an arm's length and a half
NEAREST_QUANTILE = 0.999  # trajectories take the 0.1 % nearest for the nearest depth; beyond are specks


def nearest(values: Tensor) -> Tensor:
    """The inverse depth [], a high quantile of [N], that is placed at `NEAREST_M`."""
    return values.kthvalue(1 + round(NEAREST_QUANTILE * (len(values) - 1))).values
