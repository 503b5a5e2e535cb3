"""Colours of what fills a hole: structure is the residual's, texture comes from a picture whose hole is painted.

The paper has none of this: its network learns from an inpainter's pictures. A network that learns from true views stays
smooth where the truth is ambiguous.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.blur import blurred
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.inpaint.exemplar import nearest_known
from spackle.render.protocol import Rendering
from spackle.residual.hole_features import CELL, Cues, hole_mask
from spackle.residual.seeds import SPREAD_PX, Rim, Seeds

TEXTURE_CELLS = 1.5  # standard deviation: what this blur takes away is texture, what it leaves is structure
GAIN, GOOD_FIT = 0.9, 0.15  # of texture that fits perfectly; mismatch at which a third of it is left
CONTINUED_CELLS, SAME_DEPTH = 4.0, 0.05  # reach of the photo's own colours beyond its border; relative depth
OVERLAP_CELLS = SPREAD_PX / CELL  # standard deviation of a blob
STEPS = 2


class Texture(Protocol):
    """Gives the cells of a hole their colours."""

    def colors(self, structure: Tensor, rendering: Rendering, cues: Cues, seeds: Seeds, rim: Rim) -> Tensor:
        """Colours [h, w, 3] sRGB of blobs: those of masked cells count; `structure` [h, w, 3] is the residual's."""
        ...


class ExemplarTexture:
    """High frequencies of the view itself over the residual's structure; at its border the photo goes on."""

    def colors(self, structure: Tensor, rendering: Rendering, cues: Cues, seeds: Seeds, rim: Rim) -> Tensor:
        """See `Texture.colors`."""
        fine = rim.exemplar - blurred(rim.exemplar, TEXTURE_CELLS)
        gain = GAIN * (-rim.mismatch / GOOD_FIT).exp()[..., None]
        return sharpened(continued(structure, cues, seeds, rim), 1) + sharpened(gain * fine)


EXEMPLAR = ExemplarTexture()


@dataclasses.dataclass(frozen=True)
class PaintedTexture:
    """The picture that an inpainter makes of the view, structure and all."""

    painter: Inpainter

    def colors(self, structure: Tensor, rendering: Rendering, cues: Cues, seeds: Seeds, rim: Rim) -> Tensor:
        """See `Texture.colors`."""
        hole = hole_mask(rendering.alpha)
        views = (rendering.rgb[None], hole[None], known_inverse_depth(rendering.depth, hole)[None])
        painted = self.painter.paint(*views)[0].permute(2, 0, 1)
        share = avg_pool2d(hole[None].to(painted), CELL, ceil_mode=True)[0, ..., None]
        cells = avg_pool2d(painted * hole, CELL, ceil_mode=True).permute(1, 2, 0) / share.clamp_min(1e-6)
        return sharpened(torch.where(share > 0, cells, cues.rgb))


def continued(structure: Tensor, cues: Cues, seeds: Seeds, rim: Rim) -> Tensor:
    """Colours [h, w, 3] that beyond the photo's border begin as the nearest cell of the photo, if it is as far away.

    Behind an object the nearest cell is the object's, and nothing is continued.
    """
    near = torch.from_numpy(nearest_known(cues.mask.cpu().numpy())).to(cues.mask.device).long()
    own = torch.stack(torch.meshgrid(*(torch.arange(size) for size in cues.mask.shape), indexing="ij")).to(near)
    row, column = (place.clamp_min(0) for place in near)
    apart = (seeds.inverse_depth / cues.inverse_depth[row, column].clamp_min(1e-9)).log()
    fading = torch.exp((1 - (near - own).float().norm(dim=0)) / CONTINUED_CELLS - (apart / SAME_DEPTH).square())
    return torch.lerp(structure, cues.rgb[row, column], (fading * rim.beyond)[..., None])


def sharpened(wanted: Tensor, steps: int = STEPS) -> Tensor:
    """Colours [h, w, c] of blobs that show the wanted ones [h, w, c] where they overlap, by Jacobi steps.

    A cell shows about the mean of the blobs around it under their profile, a Gaussian of OVERLAP_CELLS.
    """
    colors = wanted
    for _ in range(steps):
        colors = colors + wanted - blurred(colors, OVERLAP_CELLS)
    return colors
