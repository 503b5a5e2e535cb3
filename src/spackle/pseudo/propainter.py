"""ProPainter, the paper's inpainter (optional: pip install 'spackle-nvs[propainter]').

It follows the flow of a video into the holes, and draws what no frame shows. Its networks are pytorchcv's, which
fetches weights by itself for networks that it builds; so it is handed networks that have theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.functional import max_pool2d

from spackle.camera import Camera
from spackle.device import enough_memory, pick_device
from spackle.errors import InputError, reason_in_a_line
from spackle.image import working_size
from spackle.pseudo.propainter_weights import NETWORKS, give_weights, weight_files
from spackle.pseudo.views import ViewStack

SIDE = 640  # pixels of the long side at which it works; it was trained on 432×240
MIN_SIDE = 128  # of what the networks are given: the coarsest map of the flow, 1/64, needs two cells each way
MULTIPLE = 8  # of that
DILATION = 4  # pixels around a hole that count as hole, the authors' choice: its rim is a mixture
ITERATIONS = 20  # of the flow, the authors' choice
NOTICE = (
    "ProPainter and its weights are S-Lab's, for non-commercial use only: "
    "https://github.com/sczhou/ProPainter/blob/main/LICENSE"
)


class PropainterInpainter:
    """Completes all views of a photo at once, as the frames of one video."""

    name = "propainter"

    def __init__(self, weights: Path | None, side: int = SIDE, device: str | None = None) -> None:
        """Find the package, and load the weights.

        Args:
            weights: a folder, see `weight_files`.
            side: pixels of the long side at which it works; what it draws is enlarged to the views' size.
            device: "cpu" or "cuda"; where None, CUDA if there is any.

        Raises:
            InputError: the package is not installed, or the weights are missing, damaged or others.
        """
        version = _package_version()
        self._networks = _networks(weights)
        self._side, self._device = side, pick_device(device)
        self.version = f"1, pytorchcv {version}, long side {side}"

    @torch.no_grad()
    def complete(self, views: ViewStack) -> Tensor:
        """The colours of the completed video, in the holes.

        Raises:
            InputError: too little memory, or no finite colours.
        """
        if not bool(views.mask.any()):
            return views.rgb
        height, width = views.mask.shape[1:]
        small = working_size(width, height, self._side)[::-1]
        order = path_order(views.cameras)
        frames = F.interpolate(views.rgb[order].permute(0, 3, 1, 2), small, mode="bicubic", antialias=True)
        holes = F.interpolate(views.mask[order, None].float(), small, mode="area") > 0  # a thin one is not lost
        try:
            with enough_memory():
                filled = self._fill(frames.clamp(0, 1), holes.float()).to(views.rgb)
        except InputError as error:
            raise InputError(f"ProPainter: too little memory at {self._side} pixels: lower --inpainter-side") from error
        if not bool(filled.isfinite().all()):
            raise InputError("ProPainter: its colours are not finite: give the published --inpainter-weights")
        targets = torch.empty_like(views.rgb)
        targets[order] = F.interpolate(filled, (height, width), mode="bicubic").clamp(0, 1).permute(0, 2, 3, 1)
        return torch.where(views.mask[..., None], targets, views.rgb)

    def _fill(self, frames: Tensor, holes: Tensor) -> Tensor:
        """Frames [V, 3, h, w] in 0..1, drawn anew in and around the holes [V, 1, h, w], which are 1."""
        from pytorchcv.models.propainter_stream import ProPainterIterator, TensorSequencer

        count, _, height, width = frames.shape
        turns = [*range(count), *[0] * (count == 1)]  # a video has two frames
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


def path_order(cameras: Sequence[Camera]) -> list[int]:
    """Views as a flight along the path meets them: the first one, the photo's, is put where it is the least detour."""
    eyes = torch.stack([camera.position.double() for camera in cameras])
    others = list(range(1, len(cameras)))
    orders = [[*others[:place], 0, *others[place:]] for place in range(len(cameras))]
    return min(orders, key=lambda order: float(eyes[order].diff(dim=0).norm(dim=-1).sum()))


def padded(side: int) -> int:
    """Pixels of a side that the networks can take."""
    return max(MIN_SIDE, -(-side // MULTIPLE) * MULTIPLE)


def dilated(holes: Tensor) -> Tensor:
    """Holes [V, 1, h, w] with all that is at most DILATION steps away, up, down, left or right."""
    for _ in range(DILATION):
        holes = torch.maximum(max_pool2d(holes, (3, 1), 1, (1, 0)), max_pool2d(holes, (1, 3), 1, (0, 1)))
    return holes


def _package_version() -> str:
    try:
        import pytorchcv
        import pytorchcv.models.propainter_stream
    except Exception as error:  # a torchvision of another build raises RuntimeError
        if isinstance(error, ModuleNotFoundError) and (error.name or "").startswith("pytorchcv"):
            raise InputError("--inpainter propainter needs a package: pip install 'spackle-nvs[propainter]'") from error
        raise InputError(
            f"--inpainter propainter: torchvision cannot be imported ({reason_in_a_line(error)}): "
            f"install the one that was built for torch {torch.__version__}, from where this torch came"
        ) from error
    return str(pytorchcv.__version__)


def _networks(weights: Path | None) -> list[nn.Module]:
    from pytorchcv.models.propainter import propainter
    from pytorchcv.models.propainter_rfc import propainter_rfc
    from pytorchcv.models.raft import raft_things

    files = weight_files(weights)
    networks: list[nn.Module] = [raft_things(in_normalize=False, iters=ITERATIONS), propainter_rfc(), propainter()]
    for network, name in zip(networks, NETWORKS, strict=True):
        give_weights(network, name, files[name])
    return networks
