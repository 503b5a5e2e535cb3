"""Where aux Gaussians start: colour and depth carried from a hole's rim into it."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.camera import Camera
from spackle.fill import FAR_BIAS, far_fill
from spackle.residual.cues import CELL, Cues
from spackle.surface import surface_slope

BEHIND = 0.005  # relative distance behind everything seen close by: an aux Gaussian must not spill over it

RIM_CELLS = 2  # "close by": as far as a blob reaches
SPREAD_PX = 1.3  # standard deviation; cells two pixels apart close to alpha 0.95 at the worst spot
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
        """The chosen cells, flat: a boolean grid [h, w] gives fields [n, ...]."""
        return Seeds(self.uv[cells], self.inverse_depth[cells], self.slope[cells], self.rgb[cells], self.unit)


def make_seeds(cues: Cues, camera: Camera, photo_camera: Camera) -> Seeds:
    """Seeds for every cell of a view (covered cells keep what they show).

    What a hole reveals depends on why it is there. Behind a surface of the photo the far side of the
    rim continues; beyond the photo's border nothing was in front, and near and far go on alike.

    Args:
        cues: the view's cells.
        camera: the view.
        photo_camera: the photo's camera, whose frame tells the two kinds of hole apart.
    """
    known = _sources(cues)
    if not bool(known.any()):
        return _empty_view(cues, camera)
    uv = cell_centers(camera)
    colors = cues.rgb.permute(2, 0, 1)
    across, _ = far_fill(cues.inverse_depth, colors, known, far_bias=0.0)
    bias = torch.where(_inside(camera.unproject(uv, 1.0 / across), photo_camera), FAR_BIAS, 0.0)
    filled, rgb = far_fill(cues.inverse_depth, colors, known, far_bias=bias)
    placed = torch.minimum(filled, cues.farthest_around(RIM_CELLS)) * (1.0 - BEHIND)
    inverse_depth = torch.where(cues.mask, placed, filled)
    slope = surface_slope(inverse_depth) / CELL
    return Seeds(uv, inverse_depth, slope, rgb.permute(1, 2, 0), float(inverse_depth.median()))


def _sources(cues: Cues) -> Tensor:
    """[h, w] bool: cells to start from. Specks are none: a stray far one would colour a whole hole."""
    share = avg_pool2d(cues.covered.float()[None, None], 3, stride=1, padding=1, count_include_pad=False)[0, 0]
    for known in (cues.covered & (share > 0.5), cues.covered):
        if bool(known.any()):
            return known
    return cues.inverse_depth > 0


def cell_centers(camera: Camera) -> Tensor:
    """[ceil(H/2), ceil(W/2), 2] in pixels."""
    even = dataclasses.replace(
        camera, width=camera.width + camera.width % CELL, height=camera.height + camera.height % CELL
    )
    return even.pixel_centers(stride=CELL)


def _inside(points: Tensor, camera: Camera) -> Tensor:
    """Which points [..., 3] lie in a camera's frame."""
    uv, z = camera.project(points)
    size = torch.tensor([camera.width, camera.height]).to(uv)
    return ((uv >= 0) & (uv < size)).all(-1) & (z > 0)


def _empty_view(cues: Cues, camera: Camera) -> Seeds:
    """Nothing is seen at all: a grey wall, ten metres away, is as good a guess as any."""
    uv = cell_centers(camera).to(cues.rgb)
    return Seeds(uv, torch.full_like(cues.alpha, 0.1), torch.zeros_like(uv), torch.full_like(cues.rgb, 0.5), 0.1)
