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
from safetensors.torch import load_file
from torch import Tensor

from spackle.crop import Crop
from spackle.device import enough_memory, own_arithmetic, pick_device
from spackle.errors import InputError, reason_in_a_line
from spackle.files import check_file
from spackle.image import MAX_SIDE, working_size
from spackle.inpaint.lama_network import LamaNetwork, Shapes, expected_shapes
from spackle.inpaint.protocol import InpainterOptions
from spackle.inpaint.torchscript import TorchScriptFile
from spackle.weights import installed

SIDE = 1024  # pixels of the long side at which it works
MIN_SIDE = 128
MULTIPLE = 8  # of the sides of what the network is given
SMALLEST = 16  # pixels of them: an eighth is reflected at its ends
MARGIN = 128  # pixels around a group of holes that the network sees
BLOCK = 16  # pixels of the grid on which groups are found
FIRST = "model.1.ffc.convl2l.weight"


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
        self._side = SIDE if options.side is None else options.side
        if not MIN_SIDE <= self._side <= MAX_SIDE:
            raise InputError(f"inpainter lama: its side must be between {MIN_SIDE} and {MAX_SIDE}, got {self._side}")
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
            for group, seen in groups_of(mask):
                drawn = torch.empty_like(view)
                drawn[seen.slices] = self._draw(view[seen.slices], mask[seen.slices]).to(drawn)
                own = mask[group.slices]
                target[group.slices][own] = drawn[group.slices][own]
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
        try:
            with enough_memory(), own_arithmetic(self._device):
                drawn: Tensor = self._network(padded(colors), padded(mask))[..., : small[0], : small[1]]
        except InputError as error:
            raise InputError(f"inpainter lama: too little memory for {max(small)} pixels: lower its side") from error
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
        found = Crop(*(BLOCK * int(place) for place in (row, column, row + 1, column + 1)))
        while near := [other for other in groups if belong(found, other)]:
            groups.remove(near[0])
            found = found.union(near[0])
        groups.append(found)
    return [(group, seen(group)) for group in groups]


def padded(x: Tensor) -> Tensor:
    """[B, C, H, W] to sides that the network takes, reflected to the right and below."""
    for axis in (-2, -1):
        side = x.shape[axis]
        steps = torch.arange(max(SMALLEST, -(-side // MULTIPLE) * MULTIPLE), device=x.device) % max(2 * side - 2, 1)
        x = x.index_select(axis, torch.minimum(steps, 2 * side - 2 - steps))
    return x


def load_network(path: Path) -> LamaNetwork:
    """The network with the weights of a TorchScript file, which is not run, or of safetensors.

    Weights of another width or depth are LaMa's too. Half precision is widened.

    Raises:
        InputError: a missing or broken file, or one of another network.
    """
    check_file(path, "weight file")
    again = "`spackle weights get lama` downloads LaMa's"
    try:
        with open(path, "rb") as file:
            zipped = file.read(4) == b"PK\3\4"
        if zipped:
            with TorchScriptFile(path) as archive:
                names = published_names(archive.shapes)
                tensors = dict(zip(names, archive.read(names.values()), strict=True))
        else:
            found = load_file(path)
            names = published_names({name: tuple(tensor.shape) for name, tensor in found.items()})
            tensors = {name: found[other] for name, other in names.items()}
        wrong = [name for name, x in tensors.items() if not (x.is_floating_point() and bool(x.isfinite().all()))]
        if wrong:
            raise ValueError(f"{len(wrong)} of {len(tensors)} tensors are no finite numbers, such as {wrong[0]}")
        return LamaNetwork({name: tensor.float() for name, tensor in tensors.items()})
    except Exception as error:  # a stranger's bytes can raise anything
        raise InputError(f"{path}: cannot be read as LaMa's weights ({reason_in_a_line(error)}): {again}") from error


def published_names(shapes: Shapes) -> dict[str, str]:
    """Each name of `expected_shapes` to that in a file, where all may begin with the path to a generator.

    Other networks' tensors beside it, such as a discriminator's, are ignored; ValueError where it is not LaMa's.
    """
    before = (name.removesuffix(FIRST) for name in shapes if name.endswith(FIRST))
    prefix = min((start for start in before if not start or start.endswith("generator.")), key=len, default=None)
    if prefix is None:
        raise ValueError("it holds no generator")
    own = {
        name.removeprefix(prefix): shape
        for name, shape in shapes.items()
        if name.startswith(f"{prefix}model.") and not name.endswith(".num_batches_tracked")
    }
    blocks = sum(name.endswith(".conv1.bn_l.weight") for name in own)
    wanted = expected_shapes(sum(own[FIRST][:1]), blocks)
    wrong = sorted(name for name in wanted.keys() | own.keys() if wanted.get(name) != own.get(name))
    if wrong:
        raise ValueError(f"{len(wrong)} tensors are another network's, such as {wrong[0]}")
    return {name: prefix + name for name in wanted}
