"""What Spackle adds to the paper's completion of a view: colours at the rims of holes, and patches
that match.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor

from spackle.core.filters import approximate_gaussian_blur
from spackle.core.patch_matching import TONE_BLUR_CELLS, Patches, match_patches
from spackle.residual.completion import ViewCompletion
from spackle.residual.composer import color_logit
from spackle.residual.epipolar import trace_epipolar_lines
from spackle.residual.initializer import inside_photo

# A rim whose inverse depth exceeds the initial Gaussian's by more than this factor is a nearer
# surface, which does not continue into the hole.
NEARER_SURFACE_RATIO = 1.4
# From a cell to the rim of its hole; makes the network's input of order one.
TYPICAL_DISTANCE_CELLS = 16.0
TYPICAL_MISMATCH = 0.1  # of a patch, in sRGB; makes the network's input of order one


@dataclasses.dataclass(frozen=True)
class FarRim:
    """For each hole cell, the colours at the far rim of its hole; other cells have their own
    colours.
    """

    rgb: Tensor  # [h, w, 3] sRGB at the rim
    # [h, w, 3] sRGB at the cell's mirror image beyond the rim; `rgb`, if that lies on another
    # surface
    mirrored: Tensor
    distance: Tensor  # [h, w] cells to the rim; 0 outside of holes


class SceneViewCompletion(ViewCompletion):
    """The completion of a view, extended by what lies around its holes.

    "rim" are colours at the far rim of a hole, found along epipolar lines: when a camera moves,
    image points move along them, so the line through a hole leads to the surface that was
    uncovered. "patches" are colours of patches elsewhere in the view that match a hole.

    The initial Gaussians, which appear below, are the first guess of what fills each cell (2×2
    pixels).
    """

    INPUT_CHANNELS: ClassVar[Mapping[str, int]] = {
        **ViewCompletion.INPUT_CHANNELS,
        "rim": 7,  # colour at the far rim, mirrored colour, distance to the rim
        "patches": 4,  # colour of matching patches, mismatch
    }

    @functools.cached_property
    def far_rim(self) -> FarRim:
        """For each hole cell, the colours where the cell's epipolar line meets the far rim of its
        hole.

        A cell keeps its initial colour if its line meets no rim, or if the surface at the rim is
        much nearer than the cell, and so does not continue into the hole.
        """
        rgb = self.initial.rgb.detach()
        inverse_depth = self.initial.inverse_depth.detach()
        rim_values, mirrored_values, distance = trace_epipolar_lines(
            self.initial.uv.detach(),
            torch.cat([rgb, inverse_depth[..., None]], dim=-1),  # [h, w, 4]
            inverse_depth,
            self.mask,
            self.camera,
            self.photo_camera.position,
        )
        rim_inverse_depth = rim_values[..., 3]  # the channel after the colour
        is_nearer = self.mask & (rim_inverse_depth > NEARER_SURFACE_RATIO * inverse_depth)
        return FarRim(
            rgb=torch.where(is_nearer[..., None], rgb, rim_values[..., :3]),
            mirrored=torch.where(is_nearer[..., None], rgb, mirrored_values[..., :3]),
            distance=distance,
        )

    @functools.cached_property
    def beyond_photo(self) -> Tensor:
        """[h, w] bool: hole cells whose initial Gaussians project outside of the photo."""
        return self.mask & ~inside_photo(self.initial.inverse_depth, self.camera, self.photo_camera)

    @functools.cached_property
    def patches(self) -> Patches:
        """Patches of the view's visible part that match its holes.

        Each hole cell gets a patch whose colours resemble a guess. Inside the photo, the guess
        is the initial colours. Beyond the photo's border these are too blurred, so the guess is the
        colours at the cells' mirror images beyond the rim.
        """
        guess = torch.where(
            self.beyond_photo[..., None], self.far_rim.mirrored, self._smooth_colors
        )
        return match_patches(guess, self.mask, self.initial.inverse_depth.detach())

    @functools.cached_property
    def patch_colors(self) -> Tensor:
        """[h, w, 3] sRGB: colours of patches elsewhere in the view that match its hole cells.

        Beyond the photo's border, patches were chosen for their likeness to mirrored colours. So
        their tone (the low frequencies) may be wrong there, and is replaced by the tone of the
        initial colours.
        """
        colors = self.patches.rgb
        tone_difference = approximate_gaussian_blur(colors - self._smooth_colors, TONE_BLUR_CELLS)
        toned = (colors - tone_difference).clamp(0, 1)
        return torch.where(self.beyond_photo[..., None], toned, colors)

    @property
    def _smooth_colors(self) -> Tensor:
        """[h, w, 3] sRGB: the rendered colours, and the initial colours in holes."""
        return torch.where(self.mask[..., None], self.initial.rgb.detach(), self.features.rgb)

    def input(self, name: str) -> Tensor:
        """[h, w, c] float32: the channels of one input, by its name in `INPUT_CHANNELS`; 0 outside
        of holes.

        "rim" has the colour at the rim of the hole, the colour at the cell's mirror image beyond
        the rim, and the distance to the rim. "patches" has the colour of matching patches, and how
        badly they match. These colours are differences from the initial colours, as logits, so
        that a network can add them to the initial colours.
        """
        if name == "rim":
            initial_logit = color_logit(self.initial.rgb[self.mask])
            distance = (self.far_rim.distance[self.mask][:, None] / TYPICAL_DISTANCE_CELLS).log1p()
            return self._in_holes(
                color_logit(self.far_rim.rgb[self.mask]) - initial_logit,
                color_logit(self.far_rim.mirrored[self.mask]) - initial_logit,
                distance,
            )
        if name == "patches":
            initial_logit = color_logit(self.initial.rgb[self.mask])
            mismatch = self.patch_mismatch[self.mask][:, None] / TYPICAL_MISMATCH
            return self._in_holes(
                color_logit(self.patch_colors[self.mask]) - initial_logit, mismatch
            )
        return super().input(name)

    @functools.cached_property
    def patch_mismatch(self) -> Tensor:
        """[h, w]: how badly the patches match, as a root mean square of colour differences; 0
        outside of holes.
        """
        return self.patches.mismatch

    def _in_holes(self, *channels: Tensor) -> Tensor:
        """A grid [h, w, c] of channels [n, c₁], [n, c₂], … of the n hole cells; 0 elsewhere."""
        in_holes = torch.cat(channels, dim=-1)  # [n, c]
        grid = in_holes.new_zeros(*self.mask.shape, in_holes.shape[-1])
        grid[self.mask] = in_holes
        return grid
