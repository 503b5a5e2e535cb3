"""Base values of the aux Gaussians (paper, section 3.3): f_res predicts deltas over them, as SHARP does over its own.

Colour and depth are carried from a hole's rim into it, biased to the far side. `Rim` adds what stands at the far rim
along the line on which the hole opened.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle._numba import kernel
from spackle.camera import Camera, beside
from spackle.device import run_chunks
from spackle.fill import far_fill
from spackle.filters import broadly_blurred
from spackle.inpaint.exemplar import TONE_CELLS, Exemplar, exemplar
from spackle.residual.beyond_border import fill_around
from spackle.residual.epipolar_walk import CRISP, WIDENING, walk, widened
from spackle.residual.hole_features import CELL, GRAIN, Cues
from spackle.surface import surface_slope

BEHIND = 0.005  # relative distance behind everything seen close by: an aux Gaussian must not spill over it
BLOB_CELLS = 2  # "close by": as far as a blob reaches
SPREAD_PX = 1.3  # standard deviation; cells two pixels apart close to alpha 0.95 at the worst spot
FINE_SPREAD_PX = 0.5  # of one blob a pixel, which a wide one for its cell backs
ALIKE = 1.4  # factor by which the inverse depth of what a line meets may differ from that of what goes on there
OPACITY = 0.99  # not higher, or the renderer's stop would skip the blob behind a thin veil


@dataclasses.dataclass(frozen=True)
class Seeds:
    """Base values of a whole grid, to which the network's deltas apply."""

    uv: Tensor  # [h, w, 2] pixels
    inverse_depth: Tensor  # [h, w]
    slope: Tensor  # [h, w, 2] derivative of the inverse depth by pixel
    rgb: Tensor  # [h, w, 3] sRGB
    unit: float = 1.0  # the view's median inverse depth, in which depths and their deltas are measured

    def select(self, cells: Tensor) -> Seeds:
        """The chosen cells, flat [n, ...]: of a boolean grid [h, w], or their numbers in its rows laid end to end."""
        index = cells.flatten().nonzero()[:, 0] if cells.dtype == torch.bool else cells
        lead = self.inverse_depth.ndim - 1
        fields = (self.uv, self.inverse_depth, self.slope, self.rgb)
        uv, inverse_depth, slope, rgb = (field.flatten(0, lead)[index.to(field.device)] for field in fields)
        return Seeds(uv, inverse_depth, slope, rgb, self.unit)

    def for_pixels(self) -> Seeds:
        """Of flat seeds [n, ...] those of their cells' pixels [4n, ...], row by row in each cell."""
        offsets = beside(torch.tensor([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]]), self.uv)
        uv = (self.uv[:, None] + offsets).flatten(0, 1)
        rise = (self.slope[:, None] * offsets).sum(-1).flatten()
        fields = (self.inverse_depth, self.slope, self.rgb)
        inverse_depth, slope, rgb = (field.repeat_interleave(len(offsets), 0) for field in fields)
        return Seeds(uv, (inverse_depth + rise).clamp_min(0.5 * inverse_depth), slope, rgb, self.unit)


def make_seeds(cues: Cues, camera: Camera, photo_camera: Camera) -> Seeds:
    """Seeds for every cell of a view (covered cells keep what they show).

    What a hole reveals depends on why it is there. Behind a surface of the photo the far side of the rim continues;
    beyond the frame of the photo's camera nothing was in front, and what reaches the frame goes on.
    """
    known = _sources(cues)
    if not bool(known.any()):
        # Nothing is seen at all: a grey wall, ten metres away, is as good a guess as any.
        uv = cell_centers(camera).to(cues.rgb)
        return Seeds(uv, torch.full_like(cues.alpha, 0.1), torch.zeros_like(uv), torch.full_like(cues.rgb, 0.5), 0.1)
    across, _ = far_fill(cues.inverse_depth, cues.rgb.permute(2, 0, 1)[:0], known, far_bias=0.0)
    inside, uv = _inside(across, camera, photo_camera), beside(cell_centers(camera), across)
    filled, rgb = fill_around(cues, across, uv, known, inside, camera, photo_camera)
    inverse_depth = placed_behind(filled, cues.mask, cues, BLOB_CELLS)
    slope = surface_slope(inverse_depth) / CELL
    return Seeds(uv, inverse_depth, slope, rgb.permute(1, 2, 0), float(inverse_depth.median()))


def _sources(cues: Cues) -> Tensor:
    """[h, w] bool: cells to start from. Specks are none: a stray far one would colour a whole hole."""
    mask = cues.mask.contiguous().numpy()
    solid = np.empty(mask.shape, np.bool_)
    run_chunks(lambda start, stop: _solid(start, stop, mask, solid), len(mask), GRAIN)
    known = torch.from_numpy(solid)
    if bool(known.any()):
        return known
    return cues.covered if bool(cues.covered.any()) else cues.inverse_depth > 0


@kernel
def _solid(start: int, stop: int, mask: Any, solid: Any) -> None:
    """In the rows start..stop the cells that are covered as most cells around them are."""
    height, width = mask.shape
    masked = np.zeros(width + 2, np.uint8)  # in each column's three rows, and beyond the sides none
    for y in range(start, stop):
        top, bottom = max(y - 1, 0), min(y + 1, height - 1)
        masked[1:-1] = 0
        for v in range(top, bottom + 1):
            for x in range(width):
                masked[1 + x] += mask[v, x]
        for x in range(width):
            cells = (bottom + 1 - top) * (min(x + 1, width - 1) + 1 - max(x - 1, 0))
            solid[y, x] = not mask[y, x] and 2 * (masked[x] + masked[x + 1] + masked[x + 2]) < cells


def _inside(inverse_depth: Tensor, camera: Camera, photo_camera: Camera) -> Tensor:
    """[h, w] bool: which cells' points lie in the photo's frame."""
    image = inverse_depth.contiguous().numpy()
    inside = np.empty(image.shape, np.bool_)
    lens, photo_lens = (view.K.detach().cpu().double().numpy() for view in (camera, photo_camera))
    here, there = (view.world_to_camera.detach().cpu().double() for view in (camera, photo_camera))
    views = (lens, photo_lens, (there @ here.inverse()).numpy(), photo_camera.width, photo_camera.height)
    run_chunks(lambda start, stop: _look(start, stop, image, *views, inside), len(image), GRAIN)
    return torch.from_numpy(inside)


@kernel
def _look(
    start: int, stop: int, inverse_depth: Any, lens: Any, photo_lens: Any, motion: Any, width: int, height: int,
    inside: Any,
) -> None:  # fmt: skip
    """The rows start..stop of `_inside`; points come multiplied by their inverse depth, which spares divisions."""
    for row in range(start, stop):
        down = (CELL * (row + 0.5) - lens[1, 2]) / lens[1, 1]
        for column in range(inverse_depth.shape[1]):
            across, inverse = (CELL * (column + 0.5) - lens[0, 2]) / lens[0, 0], np.float64(inverse_depth[row, column])
            x = motion[0, 0] * across + motion[0, 1] * down + motion[0, 2] + motion[0, 3] * inverse
            y = motion[1, 0] * across + motion[1, 1] * down + motion[1, 2] + motion[1, 3] * inverse
            z = motion[2, 0] * across + motion[2, 1] * down + motion[2, 2] + motion[2, 3] * inverse
            u, v = photo_lens[0, 0] * x + photo_lens[0, 2] * z, photo_lens[1, 1] * y + photo_lens[1, 2] * z
            inside[row, column] = z > 0 and u >= 0 and u < width * z and v >= 0 and v < height * z


def placed_behind(filled: Tensor, chosen: Tensor, cues: Cues, radius: int) -> Tensor:
    """Filled inverse depth [h, w]; in the chosen cells ([h, w] bool) behind everything seen within `radius` cells."""
    share = np.float32(1.0 - BEHIND)
    seen, cells = (image.contiguous().numpy() for image in (cues.inverse_depth, chosen))
    placed = filled.clone(memory_format=torch.contiguous_format)
    run_chunks(lambda start, stop: _place(start, stop, seen, cells, radius, share, placed.numpy()), len(cells), GRAIN)
    return placed


@kernel
def _place(start: int, stop: int, seen: Any, chosen: Any, radius: int, share: Any, placed: Any) -> None:
    """The rows start..stop of `placed_behind`, in place."""
    height, width = chosen.shape
    for y in range(start, stop):
        for x in range(width):
            if not chosen[y, x]:
                continue
            farthest = placed[y, x]
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                for u in range(max(x - radius, 0), min(x + radius + 1, width)):
                    if seen[v, u] > 0:
                        farthest = min(farthest, seen[v, u])
            placed[y, x] = farthest * share


def cell_centers(camera: Camera) -> Tensor:
    """[ceil(H/2), ceil(W/2), 2] in pixels."""
    return camera.even().pixel_centers(stride=CELL)


@dataclasses.dataclass(frozen=True)
class Rim:
    """For each masked cell, what its line meets; elsewhere the cell itself."""

    rgb: Tensor  # [h, w, 3] sRGB at the far rim, the farther off the more of it
    mirrored: Tensor  # [h, w, 3] sRGB as far beyond the rim as the cell is before it, if that is the same surface
    distance: Tensor  # [h, w] cells to the rim; 0 elsewhere
    exemplar: Tensor  # [h, w, 3] sRGB of patches elsewhere in the view that fit; their tone is the seeds'
    mismatch: Tensor  # [h, w] how badly they fit: root of their mean squared difference; 0 elsewhere
    beyond: Tensor  # [h, w] bool: masked cells whose points lie outside of the photo's frame

    @staticmethod
    def of(cues: Cues, seeds: Seeds, camera: Camera, photo_camera: Camera) -> Rim:
        """See `with_patches`."""
        return Rim.with_patches(cues, seeds, camera, photo_camera)[0]

    @staticmethod
    def with_patches(cues: Cues, seeds: Seeds, camera: Camera, photo_camera: Camera) -> tuple[Rim, Exemplar]:
        """Walk from each masked cell to both sides along its epipolar line, and take the farther surface.

        What moves in front of what, moves along the lines through the epipole, where the view sees the
        photo's eye. So that line leads from a hole to the surface that goes on behind, and structure
        at the rim goes on along it more often than not, coarse structure farther than fine. Where a line meets
        nothing, or something much nearer than what goes on, the seeds stay.

        Also returns patches of the view that fit its masked cells: by the seeds' colours behind an object, by what is
        mirrored beyond the photo's border if that is as far away. There the seeds mix all that reaches the border,
        which looks like fog, and fog is what would fit it.
        """
        uv, rgb, depths = seeds.uv.detach(), seeds.rgb.detach(), seeds.inverse_depth.detach()
        values = torch.cat([rgb, depths[..., None]], dim=-1)
        far, near, steps = walk(uv, values, depths, cues.mask, camera, photo_camera.position)
        unmirrored, apart = (near == far).all(-1, keepdim=True), (near[..., 3] / depths).log().abs()
        in_front = (cues.mask & (far[..., 3] > ALIKE * depths))[..., None]  # what stands there, does not go on behind
        far, near = (torch.where(in_front, rgb, met[..., :3]) for met in (far, near))
        far = widened(far, cues.mask, WIDENING * (steps - CRISP * cues.mask.shape[1]).clamp_min(0))
        near = torch.where(unmirrored, far, near)
        beyond = cues.mask & ~_inside(seeds.inverse_depth, camera, photo_camera)
        tone = torch.where(cues.mask[..., None], rgb, cues.rgb)
        goes_on = (beyond & (apart < math.log(ALIKE)))[..., None]
        patches = exemplar(torch.where(goes_on, near, tone), cues.mask, depths)
        toned = (patches.rgb - broadly_blurred(patches.rgb - tone, TONE_CELLS)).clamp(0, 1)
        found = torch.where(beyond[..., None], toned, patches.rgb)
        return Rim(far, near, steps, found, patches.mismatch, beyond), patches
