"""ProPainter, the paper's inpainter, with the networks of pytorchcv (pip install 'spackle-nvs[propainter]').

Pixels are propagated into holes along the optical flow; pixels that no frame shows are generated.
"""

from __future__ import annotations

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

NETWORKS = (
    "raft_things",
    "propainter_rfc",
    "propainter",
)  # flow, completion of flow, colours; prefixes of file names
SOURCE = "https://github.com/osmr/imgclsmob/releases/tag/v0.0.570"
SIDE = 640  # default for the long side of the input in pixels; the training had 432×240
MULTIPLE = 8  # both sides of the networks' input are multiples of this
DILATION = (
    4  # steps by which holes are dilated, because rims have mixed colours; the authors' choice
)
INSTALL = "pip install 'spackle-nvs[propainter]'"
ITERATIONS = 20  # of the flow; the authors' choice


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
        """Load the networks; InputError for an invalid side, a missing package, or unsuitable weights."""
        self._side = options.side_or(SIDE)
        with as_input_error(
            "inpainter propainter", f"cannot import its package ({{reason}}): {INSTALL}"
        ):
            import pytorchcv
            import pytorchcv.models.propainter_stream
        self.weight_files: Mapping[str, Path] = weight_files(options.weights)
        self._networks = [_network(name, file) for name, file in self.weight_files.items()]
        self._device = pick_device(options.device)
        self.version = f"1, pytorchcv {pytorchcv.__version__}, long side {self._side}"

    @torch.no_grad()
    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Paint the views, see `Inpainter.paint`; InputError if memory is short, or the colours are not finite."""
        if not bool(hole.any()):
            return rgb
        height, width = hole.shape[1:]
        small = working_size(width, height, self._side)[::-1]
        frames = F.interpolate(rgb.permute(0, 3, 1, 2), small, mode="bicubic", antialias=True)
        holes = F.interpolate(hole[:, None].float(), small, mode="area") > 0  # thin holes are kept
        with report_memory_shortage(
            "lower --inpainter-side", what=f"for ProPainter at {self._side} pixels"
        ):
            filled = self._fill(frames.clamp(0, 1), holes.float()).to(rgb)
        if not bool(filled.isfinite().all()):
            raise InputError(
                "ProPainter: the colours are not finite: give the published --inpainter-weights"
            )
        painted = (
            F.interpolate(filled, (height, width), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)
        )
        return torch.where(hole[..., None], painted, rgb)

    def _fill(self, frames: Tensor, holes: Tensor) -> Tensor:
        """Repaint frames [V, 3, h, w] (values 0..1) in and around the holes; `holes` [V, 1, h, w] is 1 in a hole."""
        from pytorchcv.models.propainter_stream import ProPainterIterator, TensorSequencer

        count, _, height, width = frames.shape
        turns = [*range(count), *[0] * (count == 1)]  # a video needs two frames
        margin = (0, padded(width) - width, 0, padded(height) - height)
        frames, holes = (
            F.pad(x[turns].to(self._device), margin, mode="replicate") for x in (frames, holes)
        )
        video = ProPainterIterator(
            TensorSequencer(2 * frames - 1),
            TensorSequencer(dilated(holes)),
            *(network.to(self._device) for network in self._networks),
            use_cuda=self._device.type == "cuda",
            step=len(turns),
        )
        drawn: Tensor = torch.cat(list(video))
        return (drawn[:count, :, :height, :width] + 1) / 2


def padded(side: int) -> int:
    """Round a side in pixels up to one that the networks accept."""
    return max(MIN_INPUT_SIDE_PX, -(-side // MULTIPLE) * MULTIPLE)


def dilated(holes: Tensor) -> Tensor:
    """Holes [V, 1, h, w], dilated by DILATION steps to the four neighbours."""
    for _ in range(DILATION):
        holes = torch.maximum(
            max_pool2d(holes, (3, 1), 1, (1, 0)), max_pool2d(holes, (1, 3), 1, (0, 1))
        )
    return holes


def _network(name: str, file: Path) -> nn.Module:
    """A frozen network with a file's weights; unknown tensors in the file are ignored."""
    from pytorchcv.models.propainter import propainter
    from pytorchcv.models.propainter_rfc import propainter_rfc
    from pytorchcv.models.raft import raft_things

    if name == "raft_things":
        network: nn.Module = raft_things(in_normalize=False, iters=ITERATIONS)
    else:
        network = propainter_rfc() if name == "propainter_rfc" else propainter()
    advice = f"unpack the file of {name} from {SOURCE} again"
    ours, found = network.state_dict().keys(), read_tensors(file, advice)
    return load_strict(
        network, {key: tensor for key, tensor in found.items() if key in ours}, file, advice
    )


def weight_files(folder: Path | None) -> dict[str, Path]:
    """The file NAME.pth, NAME-….pth or .safetensors of each of `NETWORKS`; InputError for a missing or second file."""
    advice = (
        f"give a folder with one file for each of {', '.join(NETWORKS)}, unpacked from {SOURCE}"
    )
    if folder is None:
        raise InputError(f"inpainter propainter: --inpainter-weights is missing: {advice}")
    files = {}
    for network in NETWORKS:
        pattern = rf"{network}(-.*)?\.(pth|safetensors)"
        found = [file for file in folder.glob("*") if re.fullmatch(pattern, file.name)]
        if len(found) != 1:
            what = f"holds {len(found)} files named {network}-….pth"
            raise InputError(f"--inpainter-weights {folder}: {what}: {advice}")
        files[network] = found[0]
    return files
