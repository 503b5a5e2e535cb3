"""The SHARP base: a photo alone to 1,179,648 metric Gaussians.

Its forward may be translated by `torch.compile` and replayed as a CUDA graph, and its Gaussian decoder may learn while
the encoder and the depth network stay as they are.
"""

from __future__ import annotations

import copy
import dataclasses
import logging
import os
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases.protocol import BasePrediction, Progress
from spackle.bases.sharp.checkpoint import load_network
from spackle.bases.sharp.layers import WINDOWS, TransformerBlock, set_precision
from spackle.bases.sharp.network import DepthNetwork, InitialGaussians, Seen, SharpNetwork, SharpOutput, compose
from spackle.bases.sharp.unproject import stretch_gaussians
from spackle.camera import Camera
from spackle.device import Precision, enough_memory, memory_is_short, own_arithmetic, pick_device, pick_dtype
from spackle.errors import InputError, reason_in_a_line
from spackle.gaussians import Gaussians
from spackle.image import Photo, working_size

LOG = logging.getLogger("spackle")
Forward = Callable[[Tensor, float, int, Progress | None], SharpOutput]  # as `SharpNetwork.forward`
WINDOWS_AT_ONCE = 5  # enough to keep two cores or a small GPU at their peak


class SharpBase:
    """Apple's SHARP (2025), frozen. The published weights are for research only."""

    name = "sharp"

    def __init__(
        self,
        network: SharpNetwork,
        *,
        windows: int | None = None,
        compiled: bool = False,
        weights: str = "",
    ) -> None:
        """Use a network that is loaded already, on its device; `weights` is what the report calls it."""
        check_windows("windows", windows)
        self.network = network
        self.windows = windows or usual_windows(self.device)
        self.weights = weights
        self.compiled = compiled  # as long as nothing comes between
        self.compile_problem = ""  # what came
        self._translation: Forward | None = None

    @staticmethod
    def load(
        path: str | os.PathLike[str],
        *,
        precision: Precision = "auto",
        windows: int | None = None,
        compiled: bool = False,
        device: torch.device | str | None = None,
    ) -> SharpBase:
        """Read a checkpoint.

        Args:
            path: Apple's .pt file, a safetensors file with the same names, or the decoder that
                `spackle train --method direct-ft` wrote, which names the checkpoint for the rest.
            precision: of the heavy arithmetic; auto is bf16 where the hardware multiplies it natively.
            windows: of the 35 of a photo, how many go through the transformer at once; None: 5 on a processor, all on
                a GPU. The last bits depend on it.
            compiled: let `torch.compile` translate the network with the first photo, which takes minutes, and replay
                it as one CUDA graph on a GPU. Where that fails, a warning says why, and the network runs as it is.
            device: cpu or a CUDA device; where None, CUDA if it is there.

        Raises:
            InputError: a device that is not there, a file that is not SHARP's weights, windows that cannot be, or too
                little memory. Nothing in the file is executed.
            ValueError: an unknown precision.
        """
        check_windows("windows", windows)  # before anything is read
        target = pick_device(device)
        network = load_network(path, pick_dtype(precision, target), target)
        name = Path(path).name
        return SharpBase(network, windows=windows, compiled=compiled, weights=name)

    @property
    def device(self) -> torch.device:
        """Where the network lies."""
        return next(self.network.parameters()).device

    @property
    def precision(self) -> str:
        """What the heavy arithmetic runs in: fp32 or bf16."""
        return "bf16" if self.network.feature_model.fusion.out_conv.weight.dtype == torch.bfloat16 else "fp32"

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Two layers of Gaussians in metres, the nearer first, in row-major order; InputError where memory is short.

        `progress` is called with windows done and their number.
        """
        advice = [] if self.windows == 1 else ["try --sharp windows=1"]
        with enough_memory(*advice):
            gaussians = to_processor(to_metric(self.look(photo, progress), photo))
        camera = Camera.from_focal(photo.focal_px, photo.width, photo.height)
        notes: dict[str, float | int | str] = {"precision": self.precision, "weights": self.weights}
        return BasePrediction(gaussians, camera.resized(*working_size(photo.width, photo.height)), notes)

    @torch.no_grad()
    def look(self, photo: Photo, progress: Progress | None = None) -> SharpOutput:
        """What the network says about a photo; `to_metric` makes Gaussians of it."""
        image = to_square(photo.rgb.to(self.device, non_blocking=True), self.network.config.side)
        with own_arithmetic(self.device):
            factor = photo.focal_px / photo.width
            if self.compiled:
                try:
                    self._translation = self._translation or compile_forward(self.network)
                    return self._translation(image, factor, self.windows, progress)
                except RuntimeError as error:  # no compiler, or one that cannot do it
                    if memory_is_short(error):
                        raise
                    self.compiled, self._translation, self.compile_problem = False, None, reason_in_a_line(error)
                    LOG.warning("SHARP runs without torch.compile: %s", self.compile_problem)
            output: SharpOutput = self.network(image, factor, self.windows, progress)
            return output


def usual_windows(device: torch.device) -> int:
    """How many windows go through the transformer at once, where nobody says it."""
    return WINDOWS_AT_ONCE if device.type == "cpu" else WINDOWS


def check_windows(option: str, windows: int | None) -> None:
    """InputError for a number of windows that cannot be; `option` is what the person calls it."""
    if windows is not None and not 1 <= windows <= WINDOWS:
        raise InputError(f"{option} must be between 1 and {WINDOWS}, got {windows}")


def to_metric(output: SharpOutput, photo: Photo) -> Gaussians:
    """Gaussians in metres, on the network's device: the normalised space is x and y in -1..1 times z."""
    stretch = (photo.width / (2 * photo.focal_px), photo.height / (2 * photo.focal_px), 1.0)
    with own_arithmetic(output.deltas.device):
        return stretch_gaussians(compose(output.start, output.deltas), stretch)


def to_processor(gaussians: Gaussians) -> Gaussians:
    """The same on the processor; from a GPU in one copy, the only one that waits for it: five would wait five times."""
    if gaussians.means.device.type == "cpu":
        return gaussians
    flat = torch.cat([t.flatten() for t in gaussians.tensors]).to("cpu")
    parts = torch.split(flat, [t.numel() for t in gaussians.tensors])
    return Gaussians(*(part.view(t.shape) for part, t in zip(parts, gaussians.tensors, strict=True)))


def to_square(rgb: Tensor, side: int) -> Tensor:
    """[H, W, 3] sRGB to [1, 3, side, side], bilinear with the corner pixels on the corners, as SHARP was trained."""
    image = rgb.permute(2, 0, 1)[None].contiguous()
    return interpolate(image, size=(side, side), mode="bilinear", align_corners=True)


WARM_UPS = 2  # calls before a capture, in which libraries choose their kernels and take their workspaces


def compile_forward(network: SharpNetwork, backend: str = "inductor") -> SharpNetwork | GraphedForward:
    """The forward of a network, sharing its weights, that `torch.compile` translates when it is first asked.

    It takes a C++ compiler on a processor and Triton on a GPU; a RuntimeError at the first call says what is missing.
    All 48 blocks of the two transformers are one translation; values differ from the network's by rounding. The
    `backend` "eager" translates nothing.
    """
    twin = copy.deepcopy(network, {id(weight): weight for weight in network.parameters()})
    depth: DepthNetwork = twin.monodepth_model.monodepth_predictor  # type: ignore[assignment]
    blocks = [module for module in twin.modules() if isinstance(module, TransformerBlock)]
    for module in (*blocks, depth.decoder, depth.head, twin.feature_model):
        module.compile(backend=backend, dynamic=False)
    return GraphedForward(twin) if next(network.parameters()).device.type == "cuda" else twin


class GraphedForward:
    """A network's forward, captured once and replayed as one CUDA graph, by one thread at a time."""

    def __init__(self, network: SharpNetwork) -> None:
        self.network = network
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(
        self, image: Tensor, disparity_factor: float, batch: int, progress: Progress | None = None
    ) -> SharpOutput:
        """As the network's, always with the batch of the first call; there is no progress to see but its end."""
        with torch.cuda.device(image.device):
            if self.graph is None:
                self._capture(image, batch)
            self.image.copy_(image)
            self.factor.fill_(disparity_factor)
            assert self.graph is not None
            self.graph.replay()
        if progress:
            progress(WINDOWS, WINDOWS)
        start = self.output.start  # the next replay writes over it
        return SharpOutput(InitialGaussians(*(t.clone() for t in vars(start).values())), self.output.deltas.clone())

    @torch.inference_mode(False)
    @torch.no_grad()
    def _capture(self, image: Tensor, batch: int) -> None:
        """Record a forward over buffers that later calls may write to, in inference mode or not."""
        self.image, self.factor = image.clone(), image.new_ones(())
        side = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(WARM_UPS):
                self.network(self.image, self.factor, batch)
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=side):  # by itself it takes that of the first device it was used on
            self.output: SharpOutput = self.network(self.image, self.factor, batch)
        self.graph = graph


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

    def gaussians(self, decoder: nn.Module, seen: Seen, place: torch.device | str = "cpu") -> Gaussians:
        """Gaussians in SHARP's normalised space, at a place, with gradients to a `GaussianDecoder`."""
        device = seen.picture.device
        autocast = torch.autocast(device.type, self.precision, enabled=self.precision != torch.float32)
        with own_arithmetic(device):
            with autocast:
                deltas = decoder(seen.picture, seen.maps)
            return compose(seen.start, deltas).to(place)


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
