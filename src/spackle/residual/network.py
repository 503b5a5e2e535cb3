"""f_res, the residual network (paper, section 3.3, eq. 5): what every network states, and how a
network is run.

A network turns the features of a view into deltas: for each cell of 2×2 pixels, 14 numbers that
change the cell's initial Gaussian, the first guess of what fills the hole.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from spackle.core.crop import Crop, crops_around_mask
from spackle.residual.composer import DELTA_CHANNELS
from spackle.runtime.device import Precision, pick_dtype, without_autocast_or_tf32

STRIDE = 16  # cells along the side of one cell of a network's coarsest grid, after four halvings


class ResidualNet(nn.Module):
    """f_res: maps features [B, C, h, w] of a view's cells to deltas [B, 14, h, w], for any h and w.

    The last layers start at zero, so the deltas of an untrained network are zero.

    `forward` takes the features alone; that of a `local` network also takes an optional `Crop`, and
    then returns the deltas of this rectangle of cells only.
    """

    # In recipes and weight files; a class that gives none is called "package.module:Class".
    name: ClassVar[str]
    # The inputs by name, in the order of their channels. Inputs that are not named are not
    # computed.
    inputs: ClassVar[tuple[str, ...]]
    # Whether a cell's deltas are the same in every crop with enough context around the cell.
    local: ClassVar[bool]
    # The subclass of `ViewCompletion` that computes the inputs; None: `ViewCompletion` itself.
    view_type: ClassVar[type[Any] | None] = None

    def __init_subclass__(cls, **options: Any) -> None:
        """Name a network of another package by its module and class, by which it is found."""
        super().__init_subclass__(**options)
        if "name" not in vars(cls):
            cls.name = f"{cls.__module__}:{cls.__qualname__}"

    @classmethod
    def untrained_for(cls, tensors: Mapping[str, Tensor]) -> ResidualNet:
        """An untrained network that the weights `tensors` of a file fit, if it comes in several
        sizes.
        """
        return cls()


def channel_slices(names: Iterable[str], channels: Mapping[str, int]) -> dict[str, slice]:
    """Where the channels of each input lie among all channels of a network, by the input's name.

    Args:
        names: the network's inputs, in the order of their channels.
        channels: the number of channels of each input, by name.
    """
    slices: dict[str, slice] = {}
    start = 0
    for name in names:
        slices[name] = slice(start, start + channels[name])
        start += channels[name]
    return slices


def pad_to_stride(features: Tensor) -> Tensor:
    """Pad features [B, C, h, w] at the right and at the bottom to multiples of `STRIDE`, repeating
    the last cells.
    """
    height, width = features.shape[-2:]
    return pad(features, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate")


@torch.no_grad()
def predict_deltas(
    network: ResidualNet, features: Tensor, cells: Tensor, precision: Precision = "auto"
) -> Tensor:
    """Deltas [h, w, 14] of a view, float32 on the features' device; 0 outside of `cells`.

    On the processor, a network whose deltas depend only on nearby cells (`network.local`) runs on a
    few rectangles around `cells`. Any other runs on the whole view; so does each on a GPU, which
    takes less time for that than for the search of rectangles.

    Args:
        network: f_res, on any device.
        features: [1, C, h, w], the inputs that the network names.
        cells: [h, w] bool: the cells whose deltas are wanted.
        precision: of the convolutions; auto is bfloat16 if the hardware multiplies it natively.
    """
    device = next(network.parameters()).device
    dtype = pick_dtype(precision, device)
    deltas = features.new_zeros(*cells.shape, DELTA_CHANNELS)
    is_cropped = network.local and features.device.type == "cpu"
    if is_cropped:
        # Outer rectangles begin at multiples of the stride, so that the network's coarsest grid is
        # the same in each of them.
        crops = crops_around_mask(cells, STRIDE)
    else:
        height, width = cells.shape
        whole_view = Crop(top=0, left=0, bottom=height, right=width)
        crops = [(whole_view, whole_view)]

    # One autocast block around all crops, so that the weights are converted once.
    with (
        without_autocast_or_tf32(device),
        torch.autocast(device.type, dtype, enabled=dtype != torch.float32),
    ):
        for inner, outer in crops:
            # The outer rectangle gives context to the cells of the inner one.
            crop = features[(..., *outer.slices)]
            crop = crop.contiguous(memory_format=torch.channels_last).to(device)
            if is_cropped:
                inner_of_crop = inner.moved(-outer.top, -outer.left)
                crop_deltas = network(crop, inner_of_crop)
            else:
                crop_deltas = network(crop)
            crop_deltas = crop_deltas[0].permute(1, 2, 0).to(deltas)  # [rows, columns, 14]

            # A rectangle also holds cells whose deltas nobody asked for; these stay 0.
            is_asked_for = cells[inner.slices][..., None]
            deltas[inner.slices] = torch.where(is_asked_for, crop_deltas, 0)
    return deltas
