"""The SHARP base: a photo alone to 1,179,648 metric Gaussians."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.bases.device import enough_memory, own_arithmetic, pick_device
from spackle.bases.protocol import BasePrediction, Progress
from spackle.bases.sharp.checkpoint import load_network
from spackle.bases.sharp.network import SharpNetwork, SharpOutput
from spackle.bases.sharp.start import compose
from spackle.bases.sharp.unproject import stretch_gaussians
from spackle.camera import Camera
from spackle.gaussians import Gaussians
from spackle.image import Photo, working_size
from spackle.precision import Precision, pick_dtype

WINDOWS_AT_ONCE = 5  # enough to keep two cores or a small GPU at their peak
WINDOWS_AT_ONCE_GPU = 35


class SharpBase:
    """Apple's SHARP (2025), frozen. The published weights are for research only."""

    name = "sharp"

    def __init__(self, network: SharpNetwork, *, low_memory: bool = False, weights: str = "") -> None:
        """Use a network that is loaded already; `weights` is what the report calls it."""
        self.network = network
        self.low_memory = low_memory
        self.weights = weights

    @staticmethod
    def load(
        path: str | os.PathLike[str],
        *,
        precision: Precision = "auto",
        low_memory: bool = False,
        device: torch.device | str | None = None,
    ) -> SharpBase:
        """Read a checkpoint.

        Args:
            path: Apple's .pt file, a safetensors file with the same names, or the decoder that
                `spackle train --method direct-ft` wrote, which names the checkpoint for the rest.
            precision: of the heavy arithmetic; auto is bf16 where the hardware multiplies it natively. In either,
                the last bits of the Gaussians depend on the number of threads, because sums run in another order;
                bf16's last bits are coarser.
            low_memory: take less memory and a little more time to predict.
            device: cpu or a CUDA device; where None, CUDA if it is there.

        Raises:
            InputError: a device that is not there, a file that is not SHARP's weights, or too little memory.
                Nothing in the file is executed.
            ValueError: an unknown precision.
        """
        target = pick_device(device)
        network = load_network(path, pick_dtype(precision, target), target)
        return SharpBase(network, low_memory=low_memory, weights=Path(path).name)

    @property
    def precision(self) -> str:
        """What the heavy arithmetic runs in: fp32 or bf16."""
        return "bf16" if self.network.feature_model.fusion.out_conv.weight.dtype == torch.bfloat16 else "fp32"

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Two layers of Gaussians in metres, the nearer one first, each in row-major order.

        Args:
            photo: at its full size: the network looks at a square picture made from all of its pixels.
            progress: called with windows done and their number.

        Raises:
            InputError: too little memory.
        """
        advice = [] if self.low_memory else ["try --low-memory"]
        with enough_memory(*advice):
            gaussians = to_metric(self.look(photo, progress), photo).to("cpu")
        camera = Camera.from_focal(photo.focal_px, photo.width, photo.height)
        notes: dict[str, float | int | str] = {"precision": self.precision, "weights": self.weights}
        return BasePrediction(gaussians, camera.resized(*working_size(photo.width, photo.height)), notes)

    @torch.no_grad()
    def look(self, photo: Photo, progress: Progress | None = None) -> SharpOutput:
        """What the network says about a photo; `to_metric` makes Gaussians of it."""
        device = next(self.network.parameters()).device
        batch = WINDOWS_AT_ONCE if device.type == "cpu" else WINDOWS_AT_ONCE_GPU
        image = to_square(photo.rgb.to(device), self.network.config.side)
        with own_arithmetic(device):
            output: SharpOutput = self.network(
                image, photo.focal_px / photo.width, 1 if self.low_memory else batch, progress
            )
        return output


def to_metric(output: SharpOutput, photo: Photo) -> Gaussians:
    """Gaussians in metres, on the network's device: the normalised space is x and y in -1..1 times z."""
    stretch = (photo.width / (2 * photo.focal_px), photo.height / (2 * photo.focal_px), 1.0)
    with own_arithmetic(output.deltas.device):
        return stretch_gaussians(compose(output.start, output.deltas), stretch)


def to_square(rgb: Tensor, side: int) -> Tensor:
    """[H, W, 3] sRGB to [1, 3, side, side], bilinear with the corner pixels on the corners, as SHARP was trained."""
    image = rgb.permute(2, 0, 1)[None].contiguous()
    return interpolate(image, size=(side, side), mode="bilinear", align_corners=True)
