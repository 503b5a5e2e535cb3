"""Colours of what fills a hole: structure is the residual's, texture comes from a picture whose hole is painted.

The paper has none of this: its network learns from an inpainter's pictures. A network that learns from true views stays
smooth where the truth is ambiguous.
"""

from __future__ import annotations

import dataclasses
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from spackle.fill import FAR_BIAS, far_fill
from spackle.filters import blurred, broadly_blurred
from spackle.inpaint import Inpainter, known_inverse_depth
from spackle.inpaint.exemplar import Exemplar, nearest_known
from spackle.render.protocol import Rendering
from spackle.residual.hole_features import CELL, Cues, from_cells, hole_mask, in_cells
from spackle.residual.seeds import Rim, Seeds

TEXTURE_PX = 3.0  # standard deviation: what this blur takes away is texture, what it leaves is structure
GOOD_FIT = 0.5  # mismatch at which a third of the texture is left
SHOWN, SHOWN_FIT = 0.4, 0.36  # share of patches beyond the photo's border, and mismatch at which a third of it is left
OFTEN = 4.0  # what is taken more often is a pattern, and fades
BROAD = 0.022  # standard deviation, of the view's width: what this blur leaves of them is not shown
CONTINUED_CELLS, SAME_DEPTH = 4.0, 0.05  # reach of the photo's own colours beyond its border; relative depth
CALM_CELLS, COARSE = 4.0, 2  # standard deviation of the means that strengths of texture are compared by; cells in one
LEAST_ENERGY = 1e-7
OVERLAP_PX = 0.8  # standard deviation of what a pixel shows of the blobs: more than theirs, for votes blur as well
STEPS = 2


class Texture(Protocol):
    """Says which colours the pixels of a hole are to show."""

    def colors(
        self, structure: Tensor, rendering: Rendering, cues: Cues, seeds: Seeds, rim: Rim, patches: Exemplar
    ) -> Tensor:
        """Colours [2h, 2w, 3] sRGB that pixels are to show: those of masked cells count.

        Args:
            structure: [h, w, 3] sRGB, the residual's.
            rendering: of the view.
            cues, seeds, rim: of its cells.
            patches: that fit its masked cells.
        """
        ...


class ExemplarTexture:
    """High frequencies of the view itself over the residual's structure; at its border the photo goes on.

    Beyond the photo's border the residual knows least, and its structure is fog: a part of what is not broad there
    is that of patches.
    """

    def colors(
        self, structure: Tensor, rendering: Rendering, cues: Cues, seeds: Seeds, rim: Rim, patches: Exemplar
    ) -> Tensor:
        """See `Texture.colors`."""
        known = in_cells(rendering.rgb)
        found = from_cells(patches.of_blocks(known))
        fine = found - blurred(found, TEXTURE_PX)
        often = (patches.taken() / OFTEN).clamp_min(1)
        gain = (-patches.mismatch / GOOD_FIT).exp() / often * _in_proportion(fine, cues, seeds, rim)
        smooth = in_cells(_magnified(continued(structure, cues, seeds, rim), cues.mask))
        picture = from_cells(torch.where(cues.mask[..., None, None, None], smooth, known))
        broad = broadly_blurred(found - picture, BROAD * found.shape[1])
        shown = SHOWN * (-patches.mismatch / SHOWN_FIT).exp() / often * rim.beyond
        gain, shown = (
            from_cells(share[..., None, None, None].expand(*share.shape, CELL, CELL, 1)) for share in (gain, shown)
        )
        return fine.mul_(gain).add_(picture).lerp_(found.sub_(broad), shown)


def _in_proportion(fine: Tensor, cues: Cues, seeds: Seeds, rim: Rim) -> Tensor:
    """Factors [h, w] of at most 1 that make texture [2h, 2w, 3] no stronger than that of the surface around a hole.

    Strokes of what is lively elsewhere do not belong on a calm wall, even where they fit what is there.
    """
    energy, hole = avg_pool2d(fine.square().sum(-1)[None], CELL)[0], cues.mask.float()
    parts = torch.stack([energy * hole, hole, energy * (1 - hole), 1 - hole])
    coarse = avg_pool2d(parts, COARSE, ceil_mode=True, count_include_pad=False)
    own, masked, others, seen = blurred(coarse.permute(1, 2, 0), CALM_CELLS / COARSE).unbind(-1)
    every = (slice(None, None, COARSE),) * 2
    around = (others / seen.clamp_min(1e-6)).clamp_min(LEAST_ENERGY).log()
    known, bias = ~cues.mask[every], FAR_BIAS * ~rim.beyond[every]
    if bool(known.any()):
        around = far_fill(seeds.inverse_depth[every], around[None], known, far_bias=bias)[1][0]
    share = (around.exp() / (own / masked.clamp_min(1e-6)).clamp_min(LEAST_ENERGY)).sqrt().clamp_max(1)
    factors = interpolate(share[None, None], scale_factor=COARSE, mode="bilinear")[0, 0]
    return factors[: hole.shape[0], : hole.shape[1]]


EXEMPLAR = ExemplarTexture()


@dataclasses.dataclass(frozen=True)
class PaintedTexture:
    """The picture that an inpainter makes of the view, structure and all."""

    painter: Inpainter

    def colors(
        self, structure: Tensor, rendering: Rendering, cues: Cues, seeds: Seeds, rim: Rim, patches: Exemplar
    ) -> Tensor:
        """See `Texture.colors`."""
        hole = hole_mask(rendering.alpha)
        views = (rendering.rgb[None], hole[None], known_inverse_depth(rendering.depth, hole)[None])
        return from_cells(in_cells(self.painter.paint(*views)[0]))


def _magnified(cells: Tensor, mask: Tensor) -> Tensor:
    """A pixel's colours [2h, 2w, 3] between those of the cells [h, w, 3] around it, masked ones [h, w] alone."""
    both = torch.cat([cells * mask[..., None], mask[..., None]], dim=-1).permute(2, 0, 1)
    pixels = interpolate(both[None], scale_factor=CELL, mode="bilinear")[0].permute(1, 2, 0)
    return pixels[..., :3] / pixels[..., 3:].clamp_min(1e-6)


def continued(structure: Tensor, cues: Cues, seeds: Seeds, rim: Rim) -> Tensor:
    """Colours [h, w, 3] that beyond the photo's border begin as the nearest cell of the photo, if it is as far away.

    Behind an object the nearest cell is the object's, and nothing is continued.
    """
    near = torch.from_numpy(nearest_known(cues.mask.numpy())).long()
    own = torch.stack(torch.meshgrid(*(torch.arange(size) for size in cues.mask.shape), indexing="ij"))
    row, column = (place.clamp_min(0) for place in near)
    apart = (seeds.inverse_depth / cues.inverse_depth[row, column].clamp_min(1e-9)).log()
    fading = torch.exp((1 - torch.hypot(*(near - own).float())) / CONTINUED_CELLS - (apart / SAME_DEPTH).square())
    return torch.lerp(structure, cues.rgb[row, column], (fading * rim.beyond)[..., None])


def sharpened(wanted: Tensor, steps: int = STEPS) -> Tensor:
    """Colours [H, W, c] of blobs that show the wanted ones [H, W, c] where they overlap, by Jacobi steps.

    A pixel shows about the mean of the blobs around it under their profile, a Gaussian of OVERLAP_PX.
    """
    colors = wanted
    for _ in range(steps):
        colors = colors + wanted - blurred(colors, OVERLAP_PX)
    return colors
