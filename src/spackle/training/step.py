"""One step forward: samples in, completed views out, with gradients to the residual network alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from spackle.gaussians import Gaussians
from spackle.render import Renderer
from spackle.residual.compose import compose
from spackle.residual.hole_features import Cues
from spackle.residual.network import network_input
from spackle.training.sample import Sample

MIN_AUX = 64  # aux Gaussians of a view, however small its holes (paper, "Training Details and Loss Weights")


@dataclasses.dataclass(frozen=True)
class Batch:
    """Completed views and their truth, stacked."""

    rgb: Tensor  # [B, H, W, 3] sRGB of base and aux Gaussians, with gradients
    alpha: Tensor  # [B, H, W] likewise
    base_rgb: Tensor  # [B, H, W, 3] of the base alone
    target: Tensor  # [B, H, W, 3]
    hole: Tensor  # [B, H, W] bool
    valid: Tensor  # [B, H, W] bool


def complete_samples(
    network: nn.Module, samples: Sequence[Sample], renderer: Renderer, precision: torch.dtype = torch.float32
) -> Batch:
    """Run the network on samples of one size, and render them with what it adds.

    Args:
        network: a `ResidualNet`, by itself or wrapped, on any device; the only thing that gets gradients.
        samples: of the same height and width.
        renderer: draws base and aux Gaussians together, in the tiles that aux Gaussians can touch.
        precision: what the network's convolutions compute in.
    """
    features = torch.cat([network_input(sample.cues, sample.seeds, sample.rim) for sample in samples])
    place, features = features.device, features.to(next(network.parameters()).device)
    with torch.autocast(features.device.type, precision, enabled=precision != torch.float32):
        deltas = network(features.contiguous(memory_format=torch.channels_last))
    views = [
        renderer.render([sample.base, aux_of(sample, field)], sample.camera, tiles=sample.tiles, onto=sample.rendering)
        for sample, field in zip(samples, deltas.float().to(place), strict=True)
    ]
    return Batch(
        rgb=torch.stack([view.rgb for view in views]),
        alpha=torch.stack([view.alpha for view in views]),
        base_rgb=torch.stack([sample.rendering.rgb for sample in samples]),
        target=torch.stack([sample.target for sample in samples]),
        hole=torch.stack([sample.hole for sample in samples]),
        valid=torch.stack([sample.valid for sample in samples]),
    )


def aux_of(sample: Sample, deltas: Tensor) -> Gaussians:
    """The aux Gaussians that deltas [14, h, w] make of a sample's seeds."""
    cells = training_cells(sample.cues)
    return compose(sample.seeds.select(cells), deltas.permute(1, 2, 0)[cells], sample.camera)


def training_cells(cues: Cues, least: int = MIN_AUX) -> Tensor:
    """[h, w] bool: the masked cells, and where they are fewer than `least` the most transparent others."""
    missing = least - int(cues.mask.sum())
    if missing <= 0:
        return cues.mask
    rest = torch.where(cues.mask, torch.inf, cues.alpha).flatten()
    cells = cues.mask.flatten().clone()
    cells[rest.topk(min(missing, int((~cells).sum())), largest=False).indices] = True
    return cells.view_as(cues.mask)
