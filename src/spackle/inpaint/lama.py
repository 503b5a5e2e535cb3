"""LaMa: large holes in one pass of a network that sees the whole picture at once (Suvorov et al., WACV 2022).

The network looks at a rectangle around each group of holes, reduced where that is large. Its published weights are
fetched by `spackle weights get lama`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor

from spackle.crop import Crop
from spackle.device import enough_memory, own_arithmetic, pick_device
from spackle.errors import InputError
from spackle.image import working_size
from spackle.inpaint import InpainterOptions
from spackle.inpaint.lama_network import LamaNetwork, expected_shapes
from spackle.network_file import check_finite, check_tensors, read_tensors
from spackle.weights import installed

SIDE = 1024  # pixels of the long side at which it works
MULTIPLE = 8  # of the sides of what the network is given
SMALLEST = 16  # pixels of them: an eighth is reflected at its ends
MARGIN = 128  # pixels around a group of holes that the network sees
BLOCK = 16  # pixels of the grid on which groups are found
FIRST = "model.1.ffc.convl2l.weight"
ADVICE = "`spackle weights get lama` downloads LaMa's weights"


class LamaInpainter:
    """Paints each view by itself, sharp, and different from view to view."""

    name = "lama"
    network: ClassVar[bool] = True
    notice: ClassVar[str] = ""

    def __init__(self, options: InpainterOptions) -> None:
        """Load the weights. What the network draws is enlarged from `options.side` to the crop's size.

        Raises:
            InputError: a side that cannot be, no such device, or weights that are missing, damaged or others.
        """
        self._side = options.side_or(SIDE)
        self._device = pick_device(options.device)
        path = options.weights or installed("lama")
        if path is None:
            raise InputError("inpainter lama: has no weights: `spackle weights get lama` downloads them (206 MB)")
        self.files: Mapping[str, Path] = {"lama": path}
        self._network = load_network(path).to(self._device)
        self.version = f"1, long side {self._side}"

    @torch.no_grad()
    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """The network's colours in the holes, of each view by itself; depth says nothing to it.

        Raises:
            InputError: too little memory, or no finite colours.
        """
        painted = rgb.clone()
        for view, mask, target in zip(rgb, hole, painted, strict=True):
            for group, crop in groups_of(mask):
                drawn = torch.empty_like(view)
                drawn[crop.slices] = self._draw(view[crop.slices], mask[crop.slices]).to(drawn)
                masked = mask[group.slices]
                target[group.slices][masked] = drawn[group.slices][masked]
        return painted

    def _draw(self, rgb: Tensor, hole: Tensor) -> Tensor:
        """The network's picture [h, w, 3] for one with holes [h, w]."""
        height, width = hole.shape
        colors = torch.where(hole[..., None], 0.0, rgb).permute(2, 0, 1)[None].to(self._device)
        mask = hole[None, None].to(self._device)
        small = working_size(width, height, self._side)[::-1]
        if small != (height, width):
            known = F.adaptive_avg_pool2d((~mask).to(colors), small)
            mask = known < 0.999  # a pixel that lies in a hole with any part of it
            colors = F.adaptive_avg_pool2d(colors, small)
        shortage = enough_memory("lower --inpainter-side", what=f"for LaMa at {max(small)} pixels")
        with shortage, own_arithmetic(self._device):
            drawn: Tensor = self._network(padded(colors), padded(mask))[..., : small[0], : small[1]]
        if not bool(drawn.isfinite().all()):
            raise InputError(f"{self.files['lama']}: LaMa's colours are not finite with these weights: give others")
        if small != (height, width):
            drawn = F.interpolate(drawn, (height, width), mode="bicubic").clamp_(0, 1)
        return drawn[0].permute(1, 2, 0)


def groups_of(hole: Tensor) -> list[tuple[Crop, Crop]]:
    """Rectangles around connected holes [H, W], and what the network sees of each.

    Those that touch are one, and those that are cheaper to look at together.
    """

    def seen(group: Crop) -> Crop:
        return group.grown(MARGIN, MULTIPLE, *hole.shape)

    def belong(one: Crop, other: Crop) -> bool:
        return one.touches(other) or seen(one.union(other)).area <= seen(one).area + seen(other).area

    blocks = F.max_pool2d(hole[None].float(), BLOCK, ceil_mode=True)[0].cpu().numpy() > 0
    groups: list[Crop] = []
    for row, column in zip(*blocks.nonzero(), strict=True):
        group = Crop(*(BLOCK * int(index) for index in (row, column, row + 1, column + 1)))
        while near := [other for other in groups if belong(group, other)]:
            groups.remove(near[0])
            group = group.union(near[0])
        groups.append(group)
    return [(group, seen(group)) for group in groups]


def padded(x: Tensor) -> Tensor:
    """[B, C, H, W] to sides that the network takes, reflected to the right and below."""
    for axis in (-2, -1):
        side = x.shape[axis]
        steps = torch.arange(max(SMALLEST, -(-side // MULTIPLE) * MULTIPLE), device=x.device) % max(2 * side - 2, 1)
        x = x.index_select(axis, torch.minimum(steps, 2 * side - 2 - steps))
    return x


def load_network(path: Path) -> LamaNetwork:
    """The network with the weights of a TorchScript file, which is not run, of `torch.save` or of safetensors.

    Weights of another width or depth are LaMa's too. Half precision is widened. All names may begin with the path to
    a generator; other networks' tensors beside it, such as a discriminator's, are ignored.

    Raises:
        InputError: a missing or broken file, or one of another network.
    """
    found = read_tensors(path, ADVICE)
    before = (name.removesuffix(FIRST) for name in found if name.endswith(FIRST))
    prefix = min((start for start in before if not start or start.endswith("generator.")), key=len, default=None)
    if prefix is None:
        raise InputError(f"{path}: another network's weights: it holds no generator: {ADVICE}")
    tensors = {
        name.removeprefix(prefix): tensor
        for name, tensor in found.items()
        if name.startswith(f"{prefix}model.") and not name.endswith(".num_batches_tracked")
    }
    blocks = sum(name.endswith(".conv1.bn_l.weight") for name in tensors)
    check_tensors(tensors, expected_shapes(sum(tensors[FIRST].shape[:1]), blocks), path, ADVICE)
    network = LamaNetwork({name: tensor.to(torch.float32, copy=True) for name, tensor in tensors.items()})
    check_finite(network, path, ADVICE)
    return network
