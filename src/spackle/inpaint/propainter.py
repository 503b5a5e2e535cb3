"""ProPainter, the paper's inpainter (optional: pip install 'spackle-nvs[propainter]').

It propagates pixels along the optical flow into holes, and generates what no frame shows. Its networks come from
pytorchcv. That package would download weights by itself, so it is given networks that have their weights.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from spackle.device import enough_memory, pick_device
from spackle.errors import InputError, reason_in_a_line
from spackle.image import working_size
from spackle.inpaint import MIN_SIDE, InpainterOptions
from spackle.network_file import load_strict, read_tensors

NETWORKS = ("raft_things", "propainter_rfc", "propainter")  # flow, its completion, colours; prefixes of file names
SOURCE = "https://github.com/osmr/imgclsmob/releases/tag/v0.0.570"
SIDE = 640  # pixels of the long side at which it works; it was trained on 432×240
MULTIPLE = 8  # which divides both sides of the networks' input
DILATION = 4  # pixels around a hole that count as hole, because its rim is a mixture; the authors' choice
ITERATIONS = 20  # of the flow, the authors' choice


class PropainterInpainter:
    """Paints all views at once, as the frames of one video."""

    name = "propainter"
    network: ClassVar[bool] = True
    video: ClassVar[bool] = True
    notice: ClassVar[str] = (
        "ProPainter and its weights are S-Lab's, for non-commercial use only: "
        "https://github.com/sczhou/ProPainter/blob/main/LICENSE"
    )

    def __init__(self, options: InpainterOptions) -> None:
        """Find the package, and load the weights. The network works at `options.side`; its pictures are then enlarged
        to the views' size.

        Raises:
            InputError: an invalid side, a missing package, or weights that are missing, damaged or another network's.
        """
        self._side = options.side_or(SIDE)
        version = _package_version()
        self.files: Mapping[str, Path] = weight_files(options.weights)
        self._networks = [_network(name, file) for name, file in self.files.items()]
        self._device = pick_device(options.device)
        self.version = f"1, pytorchcv {version}, long side {self._side}"

    @torch.no_grad()
    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Complete the views as the frames of one video, and take its colours in the holes.

        Raises:
            InputError: memory is short, or the colours are not finite.
        """
        if not bool(hole.any()):
            return rgb
        height, width = hole.shape[1:]
        small = working_size(width, height, self._side)[::-1]
        frames = F.interpolate(rgb.permute(0, 3, 1, 2), small, mode="bicubic", antialias=True)
        holes = F.interpolate(hole[:, None].float(), small, mode="area") > 0  # thin holes are kept
        with enough_memory("lower --inpainter-side", what=f"for ProPainter at {self._side} pixels"):
            filled = self._fill(frames.clamp(0, 1), holes.float()).to(rgb)
        if not bool(filled.isfinite().all()):
            raise InputError("ProPainter: its colours are not finite: give the published --inpainter-weights")
        painted = F.interpolate(filled, (height, width), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)
        return torch.where(hole[..., None], painted, rgb)

    def _fill(self, frames: Tensor, holes: Tensor) -> Tensor:
        """Frames [V, 3, h, w] in 0..1, repainted in and around the holes [V, 1, h, w], where `holes` is 1."""
        from pytorchcv.models.propainter_stream import ProPainterIterator, TensorSequencer

        count, _, height, width = frames.shape
        turns = [*range(count), *[0] * (count == 1)]  # a video needs two frames
        margin = (0, padded(width) - width, 0, padded(height) - height)
        frames, holes = (F.pad(x[turns].to(self._device), margin, mode="replicate") for x in (frames, holes))
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
    return max(MIN_SIDE, -(-side // MULTIPLE) * MULTIPLE)


def dilated(holes: Tensor) -> Tensor:
    """Holes [V, 1, h, w], dilated by DILATION steps to the four neighbours."""
    for _ in range(DILATION):
        holes = torch.maximum(max_pool2d(holes, (3, 1), 1, (1, 0)), max_pool2d(holes, (1, 3), 1, (0, 1)))
    return holes


def _package_version() -> str:
    try:
        import pytorchcv
        import pytorchcv.models.propainter_stream
    except Exception as error:  # a torchvision of another build raises RuntimeError
        if isinstance(error, ModuleNotFoundError) and (error.name or "").startswith("pytorchcv"):
            raise InputError("inpainter propainter needs a package: pip install 'spackle-nvs[propainter]'") from error
        raise InputError(
            f"inpainter propainter: torchvision cannot be imported ({reason_in_a_line(error)}): "
            f"install the one that was built for torch {torch.__version__}, from the same source"
        ) from error
    return str(pytorchcv.__version__)


def _network(name: str, file: Path) -> nn.Module:
    from pytorchcv.models.propainter import propainter
    from pytorchcv.models.propainter_rfc import propainter_rfc
    from pytorchcv.models.raft import raft_things

    if name == "raft_things":
        network: nn.Module = raft_things(in_normalize=False, iters=ITERATIONS)
    else:
        network = propainter_rfc() if name == "propainter_rfc" else propainter()
    give_weights(network, name, file)
    return network


def weight_files(folder: Path | None) -> dict[str, Path]:
    """The file of each of `NETWORKS` in a folder: NAME.pth, NAME-….pth as it is published, or .safetensors.

    Raises:
        InputError: the folder is missing, or does not hold exactly one file of each.
    """
    wanted = f"{', '.join(NETWORKS)}: one .pth file of each, unpacked from {SOURCE}"
    if folder is None:
        raise InputError(f"inpainter propainter: has no weights: give --inpainter-weights FOLDER with {wanted}")
    try:
        names = sorted(file.name for file in folder.iterdir())
    except (OSError, ValueError) as error:
        raise InputError(f"--inpainter-weights {folder}: no folder that can be read: give one with {wanted}") from error
    files = {}
    for network in NETWORKS:
        own = [name for name in names if re.fullmatch(rf"{network}(-.*)?\.(pth|safetensors)", name)]
        if len(own) != 1:
            found = f"{own[0]} and {own[1]}" if own else f"no {network}-….pth"
            raise InputError(f"--inpainter-weights {folder}: holds {found}: it should hold {wanted}")
        files[network] = folder / own[0]
    return files


def give_weights(network: nn.Module, name: str, file: Path) -> None:
    """Fill a network from its file and freeze it; half precision is widened.

    As in the package that publishes them, tensors that the network does not have are ignored.

    Raises:
        InputError: the file is missing or broken, or holds another network.
    """
    advice = f"unpack the file of {name} from {SOURCE} again"
    found = read_tensors(file, advice)
    published = re.search(r"-\d{4}-([0-9a-f]{8})\.pth$", file.name)  # the first digits of its SHA-1
    if published and not hashlib.sha1(file.read_bytes(), usedforsecurity=False).hexdigest().startswith(published[1]):
        raise InputError(f"{file}: damaged, because its SHA-1 is not the one in its name: {advice}")
    ours = network.state_dict().keys()
    load_strict(network, {key: tensor for key, tensor in found.items() if key in ours}, file, advice)
