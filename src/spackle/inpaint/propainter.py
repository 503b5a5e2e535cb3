"""ProPainter, the inpainter of the paper, with the networks of the package pytorchcv.

Pixels are carried into holes along the optical flow; pixels that no view shows are generated. The
package is optional: pip install 'spackle-nvs[propainter]'.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from spackle.core.photo import working_size
from spackle.inpaint.protocol import MIN_INPUT_SIDE_PX, InpainterOptions
from spackle.runtime.device import pick_device, report_memory_shortage
from spackle.runtime.errors import InputError, as_input_error
from spackle.weights.checkpoints import load_strict, read_tensors

# The networks of the flow, of the flow's completion in holes, and of the colours. Names of files
# of weights begin with these names.
NETWORK_NAMES = ("raft_things", "propainter_rfc", "propainter")
WEIGHTS_URL = "https://github.com/osmr/imgclsmob/releases/tag/v0.0.570"
INSTALL_COMMAND = "pip install 'spackle-nvs[propainter]'"

# Raised whenever a change in this file makes it paint other pixels from the same input.
PAINTING_VERSION = 1

# The long side of the networks' input in pixels, if none is given; the training had 432×240.
DEFAULT_INPUT_SIDE_PX = 640
# Both sides of the input are multiples of this.
SIDE_MULTIPLE = 8

# Holes grow by this many pixels, because their borders have mixed colours; the authors' choice.
DILATION_PX = 4
# The network of the flow refines its result so often; the authors' choice.
FLOW_ITERATIONS = 20


class PropainterInpainter:
    """Paints all views at once, as the frames of one video."""

    name = "propainter"
    uses_network: ClassVar[bool] = True
    paints_views_together: ClassVar[bool] = True
    notice: ClassVar[str] = (
        "ProPainter and its weights are S-Lab's, for non-commercial use only: "
        "https://github.com/sczhou/ProPainter/blob/main/LICENSE"
    )

    def __init__(self, options: InpainterOptions) -> None:
        """Load the networks.

        Raises:
            InputError: the side is impossible, the package is missing, or the weights are missing
                or unsuitable.
        """
        self._input_side = options.side_or(DEFAULT_INPUT_SIDE_PX)
        problem = f"cannot import its package ({{reason}}): {INSTALL_COMMAND}"
        with as_input_error("inpainter propainter", problem):
            import pytorchcv
            import pytorchcv.models.propainter_stream
        self.weight_files: Mapping[str, Path] = find_weight_files(options.weights)
        self._networks = [_load_network(name, file) for name, file in self.weight_files.items()]
        self._device = pick_device(options.device)
        # Reports note the version: with the same weights, equal versions paint the same pixels. The
        # number in front is raised when this code paints other pixels.
        package = f"pytorchcv {pytorchcv.__version__}"
        self.version = f"{PAINTING_VERSION}, {package}, long side {self._input_side}"

    @torch.no_grad()
    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the holes of V views, which are in the order of a moving camera.

        Args:
            rgb: [V, H, W, 3] sRGB in 0..1.
            hole: [V, H, W] bool, True where a colour has to be painted.
            inverse_depth: ignored.

        Returns:
            [V, H, W, 3] sRGB in 0..1, equal to `rgb` outside of the holes.

        Raises:
            InputError: memory is short, or the networks' colours are not finite.
        """
        if not bool(hole.any()):
            return rgb
        height, width = hole.shape[1:]
        small_width, small_height = working_size(width, height, self._input_side)
        small_size = (small_height, small_width)
        frames = F.interpolate(rgb.permute(0, 3, 1, 2), small_size, mode="bicubic", antialias=True)
        # A reduced pixel that contains any part of a hole is a hole, so that thin holes stay.
        hole_share = F.interpolate(hole[:, None].float(), small_size, mode="area")
        small_holes = (hole_share > 0).float()

        what = f"for ProPainter at {self._input_side} pixels"
        with report_memory_shortage("lower `inpainter_side`", what=what):
            filled = self._fill_frames(frames.clamp(0, 1), small_holes).to(rgb)
        if not bool(filled.isfinite().all()):
            problem = "the colours are not finite"
            raise InputError(f"ProPainter: {problem}: give the published `inpainter_weights`")

        # Bicubic interpolation may overshoot 0..1.
        enlarged = F.interpolate(filled, (height, width), mode="bicubic").clamp(0, 1)
        return torch.where(hole[..., None], enlarged.permute(0, 2, 3, 1), rgb)

    def _fill_frames(self, frames: Tensor, holes: Tensor) -> Tensor:
        """Repaint frames in and around the holes.

        Args:
            frames: [V, 3, h, w] colours in 0..1.
            holes: [V, 1, h, w] 1 in a hole, else 0.

        Returns:
            [V, 3, h, w] colours in about 0..1.
        """
        from pytorchcv.models.propainter_stream import ProPainterIterator, TensorSequencer

        count, _, height, width = frames.shape
        # The networks take videos of at least two frames, so a single frame is repeated.
        frame_order = [0, 0] if count == 1 else list(range(count))
        # Left, right, top, bottom: the networks accept only some sides.
        margins = (0, padded_side(width) - width, 0, padded_side(height) - height)
        frames = F.pad(frames[frame_order].to(self._device), margins, mode="replicate")
        holes = F.pad(holes[frame_order].to(self._device), margins, mode="replicate")

        video = ProPainterIterator(
            TensorSequencer(2 * frames - 1),  # the networks take colours in -1..1
            TensorSequencer(dilate_holes(holes)),
            *(network.to(self._device) for network in self._networks),
            use_cuda=self._device.type == "cuda",
            step=len(frame_order),  # all frames at once
        )
        filled: Tensor = torch.cat(list(video))
        return (filled[:count, :, :height, :width] + 1) / 2


def padded_side(side: int) -> int:
    """Return the next larger side in pixels that the networks accept."""
    return max(MIN_INPUT_SIDE_PX, math.ceil(side / SIDE_MULTIPLE) * SIDE_MULTIPLE)


def dilate_holes(holes: Tensor) -> Tensor:
    """Grow holes [V, 1, h, w] (1 in a hole, else 0) by DILATION_PX steps to the four neighbours."""
    for _ in range(DILATION_PX):
        from_rows = max_pool2d(holes, kernel_size=(3, 1), stride=1, padding=(1, 0))
        from_columns = max_pool2d(holes, kernel_size=(1, 3), stride=1, padding=(0, 1))
        holes = torch.maximum(from_rows, from_columns)
    return holes


def _load_network(name: str, file: Path) -> nn.Module:
    """Return a frozen network with a file's weights.

    Args:
        name: one of NETWORK_NAMES.
        file: the weights; tensors that the network does not have are ignored.

    Raises:
        InputError: the file is broken, or lacks tensors.
    """
    from pytorchcv.models.propainter import propainter
    from pytorchcv.models.propainter_rfc import propainter_rfc
    from pytorchcv.models.raft import raft_things

    network: nn.Module
    if name == "raft_things":
        # The frames that the network gets are in -1..1 already, so it need not normalise them.
        network = raft_things(in_normalize=False, iters=FLOW_ITERATIONS)
    elif name == "propainter_rfc":
        network = propainter_rfc()
    else:
        network = propainter()

    advice = f"unpack the file of {name} from {WEIGHTS_URL} again"
    tensors = read_tensors(file, advice)
    needed_names = network.state_dict().keys()
    needed_tensors = {key: tensor for key, tensor in tensors.items() if key in needed_names}
    return load_strict(network, needed_tensors, file, advice)


def find_weight_files(folder: Path | None) -> dict[str, Path]:
    """Find each network's file of weights: NAME or NAME-…, with the suffix .pth or .safetensors.

    Args:
        folder: the folder that the user gave, if any.

    Returns:
        The files by the names in NETWORK_NAMES.

    Raises:
        InputError: there is no folder, or a network has no file in it or more than one.
    """
    names = ", ".join(NETWORK_NAMES)
    advice = f"give a folder with one file for each of {names}, unpacked from {WEIGHTS_URL}"
    if folder is None:
        raise InputError(f"inpainter propainter: `inpainter_weights` is missing: {advice}")
    weight_files = {}
    for name in NETWORK_NAMES:
        pattern = rf"{name}(-.*)?\.(pth|safetensors)"
        files = [file for file in folder.glob("*") if re.fullmatch(pattern, file.name)]
        if len(files) != 1:
            problem = f"holds {len(files)} files named {name}-….pth"
            raise InputError(f"`inpainter_weights` {folder}: {problem}: {advice}")
        weight_files[name] = files[0]
    return weight_files
