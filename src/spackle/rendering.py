"""What a renderer returns."""

from __future__ import annotations

import dataclasses

from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Rendering:
    """One view: three images of the same size."""

    rgb: Tensor  # [H, W, 3] sRGB in 0..1, over black
    depth: Tensor  # [H, W] expected z, normalised by alpha; 0 where alpha is 0
    alpha: Tensor  # [H, W] accumulated opacity in 0..1

    def detach(self) -> Rendering:
        """The same values cut off from autograd."""
        return Rendering(self.rgb.detach(), self.depth.detach(), self.alpha.detach())
