"""The SHARP base: predicts 1,179,648 metric Gaussians from a photo alone, by Apple's weights or a retrained decoder."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases import BasePrediction, Progress
from spackle.bases.sharp.encoder import CONFIGS, WINDOWS, SharpConfig, set_precision
from spackle.bases.sharp.network import (
    GROUPS,
    SharpNetwork,
    SharpOutput,
    compile_forward,
    compose,
    normed_residual,
)
from spackle.bases.sharp.unproject import stretch_gaussians
from spackle.camera import Camera
from spackle.device import Precision, enough_memory, memory_is_short, own_arithmetic, pick_device, pick_dtype
from spackle.errors import InputError, one_line, reading, reason_in_a_line
from spackle.files import sha256_of
from spackle.gaussians import Gaussians
from spackle.image import Photo, working_size
from spackle.network_file import Shapes, load_strict, read_note, read_tensors

LOG = logging.getLogger("spackle")
Forward = Callable[[Tensor, float, int, Progress | None], SharpOutput]  # as `SharpNetwork.forward`
WINDOWS_AT_ONCE = 5  # enough to keep two cores or a small GPU at their peak
ADVICE = "give SHARP's checkpoint as it was downloaded"
NOTE = "spackle.gaussian_decoder"  # a decoder file's only metadata key, as JSON: safetensors shuffles several keys
PARTS = ("feature_model.", "prediction_head.")  # prefixes of the names of a decoder's tensors


class SharpBase:
    """Apple's SHARP (2025), frozen. The published weights are for research only."""

    name = "sharp"

    def __init__(
        self, network: SharpNetwork, *, windows: int | None = None, compiled: bool = False, weights: str = ""
    ) -> None:
        """Use a loaded network on its device; `weights` is its name in the report."""
        check_windows("windows", windows)
        self.network = network
        self.windows = windows or usual_windows(self.device)
        self.weights = weights
        self.compiled = compiled  # false once compilation has failed
        self.compile_problem = ""  # why it failed
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
                `spackle train --method direct-ft` wrote, which names the checkpoint that has the other weights.
            precision: of the heavy arithmetic; auto is bf16 if the hardware multiplies it natively.
            windows: how many of a photo's 35 windows go through the transformer at once; None: 5 on a CPU, all on a
                GPU. The last bits of the result depend on it.
            compiled: let `torch.compile` compile the network at the first photo, which takes minutes, and on a GPU
                replay it as one CUDA graph. If that fails, a warning says why, and the network runs uncompiled.
            device: cpu or a CUDA device; None: CUDA if available.

        Raises:
            InputError: the device is missing, the file does not hold SHARP's weights, `windows` is out of range, or
                memory is short. Nothing in the file is executed.
            ValueError: an unknown precision.
        """
        check_windows("windows", windows)  # before anything is read
        target = pick_device(device)
        network = load_network(path, pick_dtype(precision, target), target)
        return SharpBase(network, windows=windows, compiled=compiled, weights=Path(path).name)

    @property
    def device(self) -> torch.device:
        """The device that holds the network."""
        return next(self.network.parameters()).device

    @property
    def precision(self) -> str:
        """The number type of the heavy arithmetic: fp32 or bf16."""
        return "bf16" if self.network.feature_model.fusion.out_conv.weight.dtype == torch.bfloat16 else "fp32"

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Two layers of Gaussians in metres, the nearer first, in row-major order; InputError if memory is short.

        `progress` is called with the number of windows done, and that of all windows.
        """
        advice = [] if self.windows == 1 else ["try --sharp windows=1"]
        with enough_memory(*advice):
            gaussians = to_metric(self.infer(photo, progress), photo)
        camera = Camera.from_focal(photo.focal_px, photo.width, photo.height)
        notes: dict[str, float | int | str] = {"precision": self.precision, "weights": self.weights}
        return BasePrediction(gaussians, camera.resized(*working_size(photo.width, photo.height)), notes)

    @torch.no_grad()
    def infer(self, photo: Photo, progress: Progress | None = None) -> SharpOutput:
        """The network's output for a photo; `to_metric` turns it into Gaussians."""
        image = to_square(photo.rgb.to(self.device, non_blocking=True), self.network.config.side)
        with own_arithmetic(self.device):
            factor = photo.focal_px / photo.width
            if self.compiled:
                try:
                    self._translation = self._translation or compile_forward(self.network)
                    return self._translation(image, factor, self.windows, progress)
                except RuntimeError as error:  # no compiler, or one that fails
                    if memory_is_short(error):
                        raise
                    self.compiled, self._translation, self.compile_problem = False, None, reason_in_a_line(error)
                    LOG.warning("SHARP runs without torch.compile: %s", self.compile_problem)
            output: SharpOutput = self.network(image, factor, self.windows, progress)
            return output


def usual_windows(device: torch.device) -> int:
    """The default for the number of windows that go through the transformer at once."""
    return WINDOWS_AT_ONCE if device.type == "cpu" else WINDOWS


def check_windows(option: str, windows: int | None) -> None:
    """InputError if the number of windows is out of range; `option` is its name in the message."""
    if windows is not None and not 1 <= windows <= WINDOWS:
        raise InputError(f"{option} must be between 1 and {WINDOWS}, got {windows}")


def to_metric(output: SharpOutput, photo: Photo) -> Gaussians:
    """Convert Gaussians from normalised space, where x / z and y / z run from -1 to 1, to metres, on the CPU."""
    stretch = (photo.width / (2 * photo.focal_px), photo.height / (2 * photo.focal_px), 1.0)
    with own_arithmetic(output.deltas.device):
        return stretch_gaussians(_to_processor(compose(output.start, output.deltas)), stretch)


def _to_processor(gaussians: Gaussians) -> Gaussians:
    """The same Gaussians on the CPU; from a GPU in a single copy, so that the CPU waits only once."""
    if gaussians.means.device.type == "cpu":
        return gaussians
    flat = torch.cat([t.flatten() for t in gaussians.tensors]).to("cpu")
    parts = torch.split(flat, [t.numel() for t in gaussians.tensors])
    return Gaussians(*(part.view(t.shape) for part, t in zip(parts, gaussians.tensors, strict=True)))


def to_square(rgb: Tensor, side: int) -> Tensor:
    """Resize [H, W, 3] sRGB to [1, 3, side, side], bilinearly with aligned corner pixels, as SHARP was trained."""
    image = rgb.permute(2, 0, 1)[None].contiguous()
    return interpolate(image, size=(side, side), mode="bilinear", align_corners=True)


# The checkpoint -----------------------------------------------------------------------------------


def load_network(path: str | os.PathLike[str], dtype: torch.dtype, device: torch.device | str = "cpu") -> SharpNetwork:
    """A frozen network from Apple's .pt file, or a safetensors file with the same names, on a device.

    The size, published or tiny, follows from the shapes. If a file holds only a trained Gaussian decoder, the other
    weights come from the checkpoint that it names. The heavy arithmetic is in `dtype`, float32 or bfloat16.

    Raises:
        InputError: a missing, broken or foreign file, or too little memory. Nothing in the file is executed.
    """
    tensors: Mapping[str, Tensor] = read_tensors(path, ADVICE)
    if (owner := owner_of(path)) is not None:
        tensors = _with_owner(tensors, path, owner)
    places = tensors.get("monodepth_model.monodepth_predictor.encoder.patch_encoder.pos_embed")
    sizes: dict[tuple[int, ...], SharpConfig]
    sizes = {(1, 1 + config.grid**2, config.embed): config for config in CONFIGS.values()}
    config = CONFIGS["full"] if places is None else sizes.get(tuple(places.shape), CONFIGS["full"])
    with torch.device("meta"):
        network = SharpNetwork(config)
    advice = ["try --precision bf16"] if dtype == torch.float32 else []  # it takes half as much
    with enough_memory(*advice):
        convert = functools.partial(set_precision, dtype=dtype)
        load_strict(network, tensors, path, ADVICE, unused=unused_shapes(config), prepare=convert)
        return network.to(device)


def expected_shapes(config: SharpConfig) -> Shapes:
    """All tensor names and shapes of a checkpoint of this size: 1,038 in the published one."""
    with torch.device("meta"):
        return _shapes_of(SharpNetwork(config)) | unused_shapes(config)


def unused_shapes(config: SharpConfig) -> Shapes:
    """Tensors of a checkpoint that inference never reads: checked by name and shape, then dropped.

    These are the transformers' classifiers, and the U-Net that maps two depths to a scale in training.
    """
    shapes: Shapes = {}
    for kind in ("patch_encoder", "image_encoder"):
        name = f"monodepth_model.monodepth_predictor.encoder.{kind}.head"
        shapes |= {f"{name}.weight": (config.classes, config.embed), f"{name}.bias": (config.classes,)}
    width = 16  # the U-Net's channels at full size, doubled with each of four halvings
    with torch.device("meta"):
        into = nn.Sequential(nn.Conv2d(2, width, 3), nn.GroupNorm(GROUPS, width))
        down = nn.ModuleList(_level(width << n, width << n + 1) for n in range(4))
        # All but the first also take the encoder's output of their size.
        up = nn.ModuleList(_level(width << (5 - n if n else 4), width << 3 - n) for n in range(4))
        norms = nn.GroupNorm(GROUPS, 2 * width), nn.GroupNorm(GROUPS, width)
        out = nn.Sequential(norms[0], nn.ReLU(), nn.Conv2d(2 * width, width, 1), norms[1])
        encoder = nn.ModuleDict({"conv_in": into, "convs_down": down})
        decoder = nn.ModuleDict({"convs_up": up, "conv_out": out})
        unet = nn.ModuleDict({"encoder": encoder, "decoder": decoder, "conv_out": nn.Conv2d(width, 1, 1)})
    return shapes | _shapes_of(unet, "depth_alignment.scale_map_estimator.")


def _level(dim_in: int, dim_out: int) -> nn.Sequential:
    """A parameter-free resize, followed by two residual blocks."""
    first = normed_residual(dim_in, dim_out)
    first.shortcut = nn.Conv2d(dim_in, dim_out, 1)
    return nn.Sequential(nn.Identity(), first, normed_residual(dim_out, dim_out))


def _shapes_of(module: nn.Module, prefix: str = "") -> Shapes:
    return {prefix + name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


# A decoder that is trained while the rest stays ---------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Owner:
    """The checkpoint that a decoder was trained on, which holds the weights that were not trained."""

    path: Path  # its path; if it was read from a decoder's file, the file name alone
    sha256: str

    @property
    def places(self) -> tuple[str, str]:
        """The file names tried for the checkpoint beside a decoder: the link of `link_owner`, and its own name."""
        return f"trained-on-{one_line(Path(self.sha256).name)[:12]}.link", self.path.name


def decoder_bytes(decoder: nn.Module, owner: Owner) -> bytes:
    """A `GaussianDecoder` as a safetensors file in float32, which restores unchanged weights bit for bit."""
    tensors = {name: tensor.detach().float().cpu().contiguous() for name, tensor in decoder.state_dict().items()}
    return save(tensors, {NOTE: json.dumps({"checkpoint": owner.path.name, "sha256": owner.sha256})})


def link_owner(owner: Owner, folder: Path) -> None:
    """Put a link to a checkpoint beside its decoders, under a name that nothing else writes to."""
    link = folder / owner.places[0]
    with contextlib.suppress(OSError):  # no links here: then the user must put the checkpoint there
        if link.is_symlink() and not link.exists():  # the checkpoint has moved
            link.unlink()
        if not link.exists():
            link.symlink_to(owner.path.absolute())


def owner_of(path: str | os.PathLike[str]) -> Owner | None:
    """The checkpoint named by a decoder's file; None for other files, InputError if a decoder's file names none."""
    note = read_note(path, NOTE)
    if note is None:
        return None
    with reading(path, "does not say which checkpoint it was trained on: train it again"):
        facts = json.loads(note)
        return Owner(Path(Path(str(facts["checkpoint"])).name), str(facts["sha256"]))


def _with_owner(decoder: Mapping[str, Tensor], path: str | os.PathLike[str], owner: Owner) -> dict[str, Tensor]:
    """The tensors of the checkpoint beside a decoder's file, with the decoder's tensors in place of its own.

    InputError if the checkpoint is missing, unreadable or changed, or if the decoder belongs to another network.
    """
    beside = Path(path).absolute().parent
    home = next((beside / name for name in owner.places if os.path.isfile(beside / name)), None)
    name = one_line(owner.path.name)
    if home is None:
        raise InputError(
            f"{path}: a decoder trained on {name}, which is not beside it: put that checkpoint, or a link to it, there"
        )
    with reading(home, "cannot be read: {reason}", OSError), open(home, "rb") as file:
        found = sha256_of(file)
    if found != owner.sha256:
        raise InputError(
            f"{path}: trained on a checkpoint with the SHA-256 {one_line(owner.sha256)[:64]}, which {home} has not: "
            f"put that {name} beside it"
        )
    whole = read_tensors(home, ADVICE)
    if wrong := sorted({name for name in whole if name.startswith(PARTS)} ^ decoder.keys()):
        raise InputError(
            f"{path}: not the decoder of {home}: {len(wrong)} names differ, e.g. {one_line(wrong[0])[:120]}: "
            "give what `spackle train --method direct-ft` wrote"
        )
    return {**whole, **decoder}
