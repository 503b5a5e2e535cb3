"""The inpainter LaMa: runs its network on crops around the holes of each view.

`LamaInpainter` paints; `load_network` reads the weights. The network is in `lama_network.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from spackle.core.crop import Crop
from spackle.core.photo import working_size
from spackle.inpaint.lama_network import (
    FIRST_WEIGHT,
    LamaNetwork,
    count_blocks,
    expected_shapes,
)
from spackle.inpaint.protocol import InpainterOptions
from spackle.runtime.device import (
    pick_device,
    report_memory_shortage,
    without_autocast_or_tf32,
)
from spackle.runtime.errors import InputError
from spackle.weights import installed_weights
from spackle.weights.checkpoints import check_finite, check_tensors, read_tensors

# Raised whenever a change in this file makes it paint other pixels from the same input.
PAINTING_VERSION = 1

# The long side of the network's input in pixels, if none is given.
DEFAULT_INPUT_SIDE_PX = 1024
# Both sides of the input are multiples of this, because the network halves them three times.
SIDE_MULTIPLE = 8
# Features have an eighth of the side, and are padded by reflection, which needs two of them.
MIN_SIDE_PX = 2 * SIDE_MULTIPLE

# The network sees so many pixels around a group of holes.
MARGIN_PX = 128
# Groups of holes are found on a grid of blocks with this side in pixels.
BLOCK_PX = 16

# A pixel of a reduced image counts as known if no part of it lies in a hole. The average of ones
# may be rounded below 1.
MIN_KNOWN_SHARE = 0.999

DOWNLOAD_ADVICE = "`spackle weights get lama` downloads LaMa's weights"


class LamaInpainter:
    """Paints each view by itself, with the network LaMa."""

    name = "lama"
    uses_network: ClassVar[bool] = True
    paints_views_together: ClassVar[bool] = False
    notice: ClassVar[str] = ""

    def __init__(self, options: InpainterOptions) -> None:
        """Load the network.

        Raises:
            InputError: the side or the device is impossible, or the weights are missing or
                unsuitable.
        """
        self._input_side = options.side_or(DEFAULT_INPUT_SIDE_PX)
        self._device = pick_device(options.device)
        path = options.weights or installed_weights("lama")
        if path is None:
            problem = "no weights: `spackle weights get lama` downloads 206 MB"
            raise InputError(f"inpainter lama: {problem}")
        self.weight_files: Mapping[str, Path] = {"lama": path}
        self._network = load_network(path).to(self._device)
        # Reports note the version: with the same weights, equal versions paint the same pixels. The
        # number in front is raised when this code paints other pixels.
        self.version = f"{PAINTING_VERSION}, long side {self._input_side}"

    @torch.no_grad()
    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the holes of V views, each by itself.

        Args:
            rgb: [V, H, W, 3] sRGB in 0..1.
            hole: [V, H, W] bool, True where a colour has to be painted.
            inverse_depth: ignored.

        Returns:
            [V, H, W, 3] sRGB in 0..1, equal to `rgb` outside of the holes.

        Raises:
            InputError: memory is short, or the network's colours are not finite.
        """
        painted = rgb.clone()
        for view, view_hole, painted_view in zip(rgb, hole, painted, strict=True):
            for group in group_holes(view_hole):
                crop = group.input_crop.slices
                colors = torch.empty_like(view)
                colors[crop] = self._predict_colors(view[crop], view_hole[crop]).to(colors)

                # Each group's colours come from the crop around this group alone.
                bounds = group.bounds.slices
                group_hole = view_hole[bounds]
                painted_view[bounds][group_hole] = colors[bounds][group_hole]
        return painted

    def _predict_colors(self, rgb: Tensor, hole: Tensor) -> Tensor:
        """Return the colours that the network predicts for the pixels of an image.

        A large image is reduced for the network, and its colours are enlarged again.

        Args:
            rgb: [h, w, 3] sRGB in 0..1.
            hole: [h, w] bool.

        Returns:
            [h, w, 3] sRGB in 0..1.

        Raises:
            InputError: memory is short, or the colours are not finite.
        """
        height, width = hole.shape
        small_width, small_height = working_size(width, height, self._input_side)
        is_reduced = (small_height, small_width) != (height, width)
        known_rgb = torch.where(hole[..., None], 0.0, rgb)
        small_rgb = known_rgb.permute(2, 0, 1)[None].to(self._device)  # [1, 3, h, w]
        small_hole = hole[None, None].to(self._device)  # [1, 1, h, w]
        if is_reduced:
            small_size = (small_height, small_width)
            known_share = F.adaptive_avg_pool2d((~small_hole).to(small_rgb), small_size)
            # A reduced pixel that contains any part of a hole is a hole, so that thin holes stay.
            small_hole = known_share < MIN_KNOWN_SHARE
            small_rgb = F.adaptive_avg_pool2d(small_rgb, small_size)

        memory = report_memory_shortage(
            "lower `inpainter_side`", what=f"for LaMa at {max(small_height, small_width)} pixels"
        )
        with memory, without_autocast_or_tf32(self._device):
            padded_colors: Tensor = self._network(
                pad_to_accepted_size(small_rgb), pad_to_accepted_size(small_hole)
            )
        colors = padded_colors[..., :small_height, :small_width]
        if not bool(colors.isfinite().all()):
            problem = "LaMa's colours are not finite"
            raise InputError(f"{self.weight_files['lama']}: {problem}: give other weights")
        if is_reduced:
            # Bicubic interpolation may overshoot 0..1.
            colors = F.interpolate(colors, (height, width), mode="bicubic").clamp_(0, 1)
        return colors[0].permute(1, 2, 0)


class HoleGroup(NamedTuple):
    """Holes that are painted in one call of the network."""

    bounds: Crop  # a rectangle around the holes
    input_crop: Crop  # the larger rectangle that the network receives


def group_holes(hole: Tensor) -> list[HoleGroup]:
    """Find rectangles around groups of holes [H, W].

    The network receives a larger rectangle, with known pixels around the holes. Two groups are
    merged if their rectangles touch, or if the network receives no more pixels for the merged
    group than for the two groups in turn.
    """
    height, width = hole.shape

    def input_crop(bounds: Crop) -> Crop:
        # What the network receives: with a margin, and rounded to sides that the network accepts.
        return bounds.grown(MARGIN_PX, SIDE_MULTIPLE, height, width)

    def belong_together(one: Crop, other: Crop) -> bool:
        common_area = input_crop(one.union(other)).area
        separate_area = input_crop(one).area + input_crop(other).area
        return one.touches(other) or common_area <= separate_area

    # The blocks of a grid that hold a hole; a block at the border may be cut off.
    block_maxima = F.max_pool2d(hole[None].float(), BLOCK_PX, ceil_mode=True)[0]
    hole_blocks = block_maxima.cpu().numpy() > 0
    groups: list[Crop] = []
    for block_row, block_column in zip(*hole_blocks.nonzero(), strict=True):
        top = BLOCK_PX * int(block_row)
        left = BLOCK_PX * int(block_column)
        group = Crop(top, left, top + BLOCK_PX, left + BLOCK_PX)

        # A merged group is larger, so that it may have to be merged with a further one.
        neighbors = [other for other in groups if belong_together(group, other)]
        while neighbors:
            groups.remove(neighbors[0])
            group = group.union(neighbors[0])
            neighbors = [other for other in groups if belong_together(group, other)]
        groups.append(group)
    return [HoleGroup(group, input_crop(group)) for group in groups]


def pad_to_accepted_size(x: Tensor) -> Tensor:
    """Pad images [B, C, H, W] on the right and below, by reflection, to sides the network accepts.

    The sides become multiples of SIDE_MULTIPLE, and at least MIN_SIDE_PX.
    """
    for axis in (-2, -1):
        side = x.shape[axis]
        padded_side = max(MIN_SIDE_PX, math.ceil(side / SIDE_MULTIPLE) * SIDE_MULTIPLE)
        # Mirrored at its last and first pixel, the image repeats with this period: 0 1 2 1 0 1 …
        # In the second half of a period, the pixels count backwards.
        period = max(2 * side - 2, 1)
        place_in_period = torch.arange(padded_side, device=x.device) % period
        source_index = torch.minimum(place_in_period, 2 * side - 2 - place_in_period)
        x = x.index_select(axis, source_index)
    return x


def load_network(path: Path) -> LamaNetwork:
    """Load the network from a file, without running code in the file.

    The network's width and number of blocks follow from the file's tensors. LaMa was trained beside
    a discriminator; the network that paints is called the generator.

    Args:
        path: a file of TorchScript, `torch.save` or safetensors. The names of its tensors may
            begin with the path to the generator, such as "generator."; tensors of other networks
            are ignored.

    Raises:
        InputError: the file is missing or broken, or holds another network.
    """
    all_tensors = read_tensors(path, DOWNLOAD_ADVICE)
    prefix = _generator_prefix(all_tensors)
    if prefix is None:
        raise InputError(f"{path}: holds no generator of LaMa: {DOWNLOAD_ADVICE}")

    tensors = {}
    for name, tensor in all_tensors.items():
        is_of_generator = name.startswith(f"{prefix}model.")
        # Batch norms count the batches of the training, which nothing needs.
        if is_of_generator and not name.endswith(".num_batches_tracked"):
            tensors[name.removeprefix(prefix)] = tensor

    # In a broken file, the weight may be a single number, which has no shape. The width 0 then
    # makes `check_tensors` refuse the file.
    first_shape = tensors[FIRST_WEIGHT].shape
    width = first_shape[0] if first_shape else 0
    check_tensors(tensors, expected_shapes(width, count_blocks(tensors)), path, DOWNLOAD_ADVICE)
    # Copies, because the tensors are mapped from the file, which may be changed or deleted.
    network = LamaNetwork(
        {name: tensor.to(torch.float32, copy=True) for name, tensor in tensors.items()}
    )
    check_finite(network, path, DOWNLOAD_ADVICE)
    return network


def _generator_prefix(tensors: Mapping[str, Tensor]) -> str | None:
    """Return what the names of the generator's tensors begin with in a file.

    The generator is the network of LaMa that paints; a file may hold further networks.

    Args:
        tensors: the file's tensors by name.

    Returns:
        "", "generator.", or a longer path to the generator, and the shortest one of several; None
        if the file has no generator.
    """
    prefixes = []
    for name in tensors:
        if not name.endswith(FIRST_WEIGHT):
            continue
        prefix = name.removesuffix(FIRST_WEIGHT)
        if prefix == "" or prefix.endswith("generator."):
            prefixes.append(prefix)
    return min(prefixes, key=len, default=None)
