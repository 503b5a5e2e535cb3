"""Base values of the aux Gaussians (paper, section 3.3): f_res predicts deltas over them, as SHARP does over its own.

Colour and depth are propagated from a hole's rim into it, biased to the far side.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from spackle.camera import Camera, beside
from spackle.fill import far_fill
from spackle.filters import greatest_around
from spackle.residual.beyond_border import fill_around
from spackle.residual.view_features import CELL, ViewFeatures, cell_centers
from spackle.surface import surface_slope

BEHIND = 0.005  # relative distance behind everything seen close by: an aux Gaussian must not spill over it
BLOB_CELLS = 2  # "close by": as far as a blob reaches
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
        """The chosen cells, flat [n, ...]: of a boolean grid [h, w], or their numbers in its rows laid end to end."""
        index = cells.flatten().nonzero()[:, 0] if cells.dtype == torch.bool else cells
        lead = self.inverse_depth.ndim - 1
        fields = (self.uv, self.inverse_depth, self.slope, self.rgb)
        uv, inverse_depth, slope, rgb = (field.flatten(0, lead)[index.to(field.device)] for field in fields)
        return Seeds(uv, inverse_depth, slope, rgb, self.unit)


def make_seeds(features: ViewFeatures, camera: Camera, photo_camera: Camera) -> Seeds:
    """Seeds for every cell of a view (covered cells keep what they show).

    What a hole reveals depends on why it is there. Behind a surface of the photo the far side of the rim continues;
    beyond the frame of the photo's camera nothing was in front, and what reaches the frame is extended.
    """
    known = _sources(features)
    if not bool(known.any()):
        # Nothing is seen at all: a grey wall, ten metres away, is as good a guess as any.
        uv = cell_centers(camera).to(features.rgb)
        return Seeds(
            uv, torch.full_like(features.alpha, 0.1), torch.zeros_like(uv), torch.full_like(features.rgb, 0.5), 0.1
        )
    across, _ = far_fill(features.inverse_depth, features.rgb.permute(2, 0, 1)[:0], known, far_bias=0.0)
    inside, uv = inside_photo(across, camera, photo_camera), beside(cell_centers(camera), across)
    filled, rgb = fill_around(features, across, uv, known, inside, camera, photo_camera)
    inverse_depth = placed_behind(filled, features.mask, features.inverse_depth, BLOB_CELLS)
    slope = surface_slope(inverse_depth) / CELL
    return Seeds(uv, inverse_depth, slope, rgb.permute(1, 2, 0), float(inverse_depth.median()))


def _sources(features: ViewFeatures) -> Tensor:
    """[h, w] bool: cells to start from. Specks are none: a stray far one would colour a whole hole."""
    covered = ~features.mask
    share = avg_pool2d(covered.float()[None], 3, stride=1, padding=1, count_include_pad=False)[0]
    solid = covered & (share > 0.5)
    if bool(solid.any()):
        return solid
    return covered if bool(covered.any()) else features.inverse_depth > 0


def inside_photo(inverse_depth: Tensor, camera: Camera, photo_camera: Camera) -> Tensor:
    """[h, w] bool: which cells' points lie in the photo's frame."""
    to_photo = photo_camera.world_to_camera.cpu().double() @ camera.world_to_camera.cpu().double().inverse()
    lens, photo_lens = camera.K.cpu().double(), photo_camera.K.cpu().double()
    across = (cell_centers(camera).cpu().double() - lens[:2, 2]) / lens.diagonal()[:2]
    # Points come multiplied by their inverse depth, which spares divisions.
    points = across @ to_photo[:3, :2].T + to_photo[:3, 2] + inverse_depth[..., None] * to_photo[:3, 3]
    place, z = points[..., :2] * photo_lens.diagonal()[:2] + points[..., 2:] * photo_lens[:2, 2], points[..., 2:]
    size = torch.tensor([photo_camera.width, photo_camera.height])
    return ((z > 0) & (place >= 0) & (place < size * z)).all(-1)


def placed_behind(filled: Tensor, chosen: Tensor, seen: Tensor, radius: int) -> Tensor:
    """Filled inverse depth [h, w]; in the chosen cells ([h, w] bool) behind what is seen within `radius` cells.

    `seen` is the inverse depth [h, w] of what is seen, 0 where nothing is.
    """
    farthest = -greatest_around(-torch.where(seen > 0, seen, torch.inf), radius)
    return torch.where(chosen, torch.minimum(filled, farthest) * (1 - BEHIND), filled)
