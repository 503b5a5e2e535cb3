"""Quarter turns and mirror images of a map, with its intrinsics."""

from __future__ import annotations

import dataclasses

from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Turn:
    """Rows and columns swapped first, then mirrored."""

    transpose: bool = False
    mirror_x: bool = False  # left and right
    mirror_y: bool = False  # top and bottom

    def grid(self, values: Tensor) -> Tensor:
        """[H, W] to [H, W] or [W, H]."""
        values = values.T if self.transpose else values
        axes = [axis for axis, mirrored in enumerate((self.mirror_y, self.mirror_x)) if mirrored]
        return values.flip(axes).contiguous()

    def matrix(self, K: Tensor, width: int, height: int) -> Tensor:
        """Intrinsics [3, 3] of a width×height map, after the turn."""
        (fx, cx), (fy, cy) = (float(K[0, 0]), float(K[0, 2])), (float(K[1, 1]), float(K[1, 2]))
        if self.transpose:
            fx, cx, fy, cy, width, height = fy, cy, fx, cx, height, width
        cx = width - cx if self.mirror_x else cx
        cy = height - cy if self.mirror_y else cy
        return K.new_tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def then(self, after: Turn) -> Turn:
        """This turn followed by another."""
        x, y = (self.mirror_y, self.mirror_x) if after.transpose else (self.mirror_x, self.mirror_y)
        return Turn(self.transpose != after.transpose, x != after.mirror_x, y != after.mirror_y)


UPRIGHT = Turn()
# How a picture with this EXIF orientation is turned upright.
BY_ORIENTATION = {
    2: Turn(mirror_x=True),
    3: Turn(mirror_x=True, mirror_y=True),
    4: Turn(mirror_y=True),
    5: Turn(transpose=True),
    6: Turn(transpose=True, mirror_x=True),
    7: Turn(transpose=True, mirror_x=True, mirror_y=True),
    8: Turn(transpose=True, mirror_y=True),
}
# HEIF's `irot`: so many quarter turns anticlockwise. Its `imir`: 0 swaps top and bottom, 1 left and right.
BY_IROT = (UPRIGHT, BY_ORIENTATION[8], BY_ORIENTATION[3], BY_ORIENTATION[6])
BY_IMIR = (BY_ORIENTATION[4], BY_ORIENTATION[2])
