"""SHARP with gradients to its Gaussian decoder: the encoder and the depth network stay as they are."""

from __future__ import annotations

import dataclasses
import os

import torch
from torch import Tensor, nn

from spackle.bases.sharp.base import to_square, usual_windows
from spackle.bases.sharp.checkpoint import load_network
from spackle.bases.sharp.layers import set_precision
from spackle.bases.sharp.network import Seen, SharpNetwork, compose
from spackle.camera import Camera
from spackle.device import own_arithmetic
from spackle.gaussians import Gaussians


@dataclasses.dataclass(frozen=True)
class TunableSharp:
    """A network whose decoder, `network.gaussian_decoder()`, keeps float32 weights that small steps can move."""

    network: SharpNetwork
    precision: torch.dtype  # of the heavy arithmetic: what is frozen is stored in it, the decoder converted on the fly

    @staticmethod
    def load(path: str | os.PathLike[str], precision: torch.dtype, device: torch.device) -> TunableSharp:
        """Read a checkpoint (see `load_network`), with the heavy arithmetic in float32 or bfloat16; nothing learns yet.

        Raises:
            InputError: a missing, broken or foreign file, or too little memory: 2.8 GB while it is read.
        """
        network = load_network(path, torch.float32)
        set_precision(network.monodepth_model, precision)
        return TunableSharp(network.to(device), precision)

    @torch.no_grad()
    def see(self, rgb: Tensor, photo_camera: Camera) -> Seen:
        """What the frozen part makes of a photo [H, W, 3], sRGB in 0..1, with a camera of the same size."""
        device = next(self.network.parameters()).device
        image = to_square(rgb.to(device), self.network.config.side)
        with own_arithmetic(device):
            return self.network.see(image, photo_camera.focal[0] / photo_camera.width, usual_windows(device))

    def gaussians(self, decoder: nn.Module, seen: Seen) -> Gaussians:
        """Gaussians in SHARP's normalised space, on the processor, with gradients to a `GaussianDecoder`."""
        device = seen.picture.device
        autocast = torch.autocast(device.type, self.precision, enabled=self.precision != torch.float32)
        with own_arithmetic(device):
            with autocast:
                deltas = decoder(seen.picture, seen.maps)
            return compose(seen.start, deltas).to("cpu")


def normalised_camera(camera: Camera, photo_camera: Camera) -> Camera:
    """A camera that sees Gaussians of the normalised space as `camera`, in metres, sees the same ones in metres.

    The way to metres, D = diag(W / 2fx, H / 2fy, 1) of the photo's camera, is not a rotation. On Gaussians it takes an
    eigendecomposition (`stretch_gaussians`), whose gradient is not defined for round ones, as SHARP's are at first. A
    renderer only ever applies the camera's matrix P, to centres as P x and to covariances as P Σ Pᵀ; so P D draws the
    same picture, and every gradient exists.
    """
    fx, fy = photo_camera.focal
    matrix = camera.world_to_camera.double()  # the product rounded to float32 would move what is seen
    stretch = matrix.new_tensor([photo_camera.width / (2 * fx), photo_camera.height / (2 * fy), 1.0, 1.0])
    return dataclasses.replace(camera, world_to_camera=matrix * stretch)
