"""What projection to the image makes of Gaussians: one packed record, one tile box and one sort key each."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import numpy.typing as npt

from spackle.camera import Camera
from spackle.render.protocol import TILE

Array = npt.NDArray[Any]

# A record is what the blender needs, in three quarters of a cache line. Along a row of pixels at distance dy
# from the centre, a Gaussian's alpha is 2^(PEAK - FALL·dy² - ACROSS·(x - X - SLOPE·dy)²): no square of this
# form is ever negative.
X, Y, SLOPE, ACROSS, FALL, PEAK, HALF_WIDTH, HALF_HEIGHT, DEPTH, RED, GREEN, BLUE = range(12)
RECORD = 12  # floats in a record

SPARE = 1 << 16  # Gaussians
BLUR_CLAMP = 0.3  # how far beyond the border, in half-images, the projection is still linearised in place


@dataclasses.dataclass(frozen=True)
class View:
    """A camera as plain numbers."""

    lens: Array  # [8] float64: fx, fy, cx, cy and the bounds (left, right, top, bottom) of x/z and y/z
    pose: Array  # [3, 4] float64, world to camera
    width: int
    height: int
    eps2d: float

    @staticmethod
    def of(camera: Camera, eps2d: float) -> View:
        """Read a camera's matrices; the bounds are gsplat's."""
        K = camera.K.detach().double().cpu().numpy()
        pose = np.ascontiguousarray(camera.world_to_camera.detach().double().cpu().numpy()[:3])
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        slack_x, slack_y = BLUR_CLAMP * 0.5 * camera.width / fx, BLUR_CLAMP * 0.5 * camera.height / fy
        left, right = -cx / fx - slack_x, (camera.width - cx) / fx + slack_x
        top, bottom = -cy / fy - slack_y, (camera.height - cy) / fy + slack_y
        lens = np.array([fx, fy, cx, cy, left, right, top, bottom])
        return View(lens, pose, camera.width, camera.height, eps2d)

    def same_as(self, other: View) -> bool:
        """Whether both show the same."""
        return (
            (self.width, self.height, self.eps2d) == (other.width, other.height, other.eps2d)
            and np.array_equal(self.lens, other.lens)
            and np.array_equal(self.pose, other.pose)
        )

    @property
    def tiles(self) -> tuple[int, int]:
        """Rows and columns of tiles."""
        return -(-self.height // TILE), -(-self.width // TILE)


@dataclasses.dataclass(frozen=True)
class Splats:
    """Gaussians on the image plane, in the order in which they came."""

    records: Array  # [N, RECORD] float32
    boxes: Array  # [N, 4] uint16, the tiles touched: columns from, to, rows from, to (exclusive)
    keys: Array  # [N] uint32, the bits of the depth of visible Gaussians, packed to the front of each chunk
    ids: Array  # [N] int32, the Gaussians that the keys belong to

    @staticmethod
    def allocate(n: int) -> Splats:
        """Room for n Gaussians, and for some more that may come later; what is not written to takes no memory."""
        n += n // 4 + SPARE
        return Splats(
            np.empty((n, RECORD), np.float32),
            np.empty((n, 4), np.uint16),
            np.empty(n, np.uint32),
            np.empty(n, np.int32),
        )


def count_before(wanted: Array) -> Array:
    """How many tiles are wanted above and to the left of each corner, [rows + 1, columns + 1] int32."""
    return np.pad(wanted.astype(np.int32).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0))).astype(np.int32)
