"""One view completed as the paper does it: eq. 2 to 7 in one pass.

Eq. 8, the union with the base, is `Gaussians.cat([base, aux])`; rendering that is eq. 9.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from spackle.camera import Camera
from spackle.device import Precision
from spackle.gaussians import Gaussians
from spackle.patches import Patches
from spackle.render import Renderer
from spackle.residual.base_values import Seeds, make_seeds
from spackle.residual.compose import compose
from spackle.residual.mask import MASK_THRESHOLD
from spackle.residual.network import ResidualNet, predict_deltas
from spackle.residual.rim import Rim, find_rim
from spackle.residual.view_features import ViewFeatures


@torch.no_grad()
def complete_view(
    base: Gaussians,
    camera: Camera,
    photo_camera: Camera,
    renderer: Renderer,
    network: ResidualNet | None,
    *,
    threshold: float = MASK_THRESHOLD,
    precision: Precision = "auto",
) -> Gaussians:
    """𝒢̃_aug of a view (eq. 7): one Gaussian for each masked cell, on top of the base, which is only read.

    Args:
        base: N Gaussians in the world's frame, 𝒢_base.
        camera: the view v.
        photo_camera: that of the base's photo.
        renderer: ℛ.
        network: f_res, which runs on the device where it lies; None: the base values alone, as if its deltas were 0.
        threshold: τ_α.
        precision: of the network; auto is bfloat16 where the hardware multiplies it natively.
    """
    features = ViewFeatures.of(renderer.render(base, camera), threshold)  # eqs. 2 to 4
    if not bool(features.mask.any()):
        return Gaussians.empty(base.means.device)
    return complete_cells(features, camera, photo_camera, network, precision).aux.to(base.means.device)


@dataclasses.dataclass(frozen=True)
class CompletedCells:
    """The aux Gaussians of a view's n masked cells, and what they were made of."""

    aux: Gaussians  # [n]
    seeds: Seeds  # base values of all cells
    deltas: Tensor | None  # [n, 14]; None without a network
    rim: tuple[Rim, Patches] | None  # likewise


def complete_cells(
    features: ViewFeatures, camera: Camera, photo_camera: Camera, network: ResidualNet | None, precision: Precision
) -> CompletedCells:
    """f_res over base values, for the masked cells alone (eqs. 5 and 7)."""
    seeds = make_seeds(features, camera, photo_camera)
    rim, deltas = None, None
    if network is not None:
        rim = find_rim(features, seeds, camera, photo_camera)
        deltas = predict_deltas(network, features, seeds, rim[0], precision)[features.mask]
    return CompletedCells(compose(seeds.select(features.mask), deltas, camera), seeds, deltas, rim)
