"""The SHARP base: predict 1,179,648 Gaussians in metres from one photo, by Apple's weights or a retrained decoder."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases import BasePrediction
from spackle.bases.sharp.encoder import SIZES, WINDOW_COUNT, SharpConfig, set_precision
from spackle.bases.sharp.network import SharpNetwork, SharpOutput, apply_deltas
from spackle.bases.sharp.stretch import stretch_gaussians
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import Photo, working_size
from spackle.runtime.device import (
    Precision,
    pick_device,
    pick_dtype,
    report_memory_shortage,
    without_autocast_or_tf32,
)
from spackle.runtime.digests import sha256_of
from spackle.runtime.errors import InputError, as_input_error, printable_line
from spackle.runtime.progress import Progress
from spackle.weights.checkpoints import TensorShapes, load_strict, read_metadata, read_tensors

CPU_WINDOW_BATCH = 5  # enough to keep two cores or a small GPU busy
ADVICE = "give SHARP's checkpoint as it was downloaded"
LESS_MEMORY = "try `windows_per_batch` 1 and `precision` bf16"
SOURCE_KEY = "spackle.gaussian_decoder"  # a decoder file's only metadata key, as JSON: safetensors shuffles several keys
_ENCODER = "monodepth_model.monodepth_predictor.encoder."
# Prefixes of tensors that are never read: the transformers' classifiers, and a U-Net that only training uses.
UNUSED_PREFIXES = (
    f"{_ENCODER}patch_encoder.head.",
    f"{_ENCODER}image_encoder.head.",
    "depth_alignment.",
)
PARAMETER_COUNT = 702_305_169  # in Apple's checkpoint, with the unused ones


class SharpBase:
    """Apple's SHARP (2025), frozen. The published weights are for research only."""

    name = "sharp"

    def __init__(
        self, network: SharpNetwork, *, windows_per_batch: int | None = None, weights: str = ""
    ) -> None:
        """Use a loaded network on its device; `weights` is the name of the weights in the report."""
        check_window_batch(windows_per_batch)
        self.network = network
        self.windows_per_batch = windows_per_batch or default_window_batch(self.device)
        self.weights = weights

    @staticmethod
    def load(
        path: str | os.PathLike[str],
        *,
        precision: Precision = "auto",
        windows_per_batch: int | None = None,
        device: torch.device | str | None = None,
    ) -> SharpBase:
        """Read a checkpoint; InputError for an unusable file, device or number of windows, or too little memory.

        Args:
            path: Apple's .pt file, a safetensors file with the same names, or a decoder that
                `spackle train --method direct-ft` wrote; see `load_network`.
            precision: number type of the heavy arithmetic; auto is bf16 if the hardware multiplies it natively.
            windows: number of a photo's 35 windows that the transformer processes at once; None: 5 on a CPU, all on a
                GPU. The last bits of the result depend on this number.
            device: cpu or a CUDA device; None: CUDA if available.
        """
        target = pick_device(device)
        network = load_network(path, pick_dtype(precision, target), target)
        return SharpBase(network, windows_per_batch=windows_per_batch, weights=Path(path).name)

    @property
    def device(self) -> torch.device:
        """The device that holds the network."""
        return next(self.network.parameters()).device

    @property
    def precision(self) -> str:
        """The number type of the heavy arithmetic: fp32 or bf16."""
        return (
            "bf16"
            if self.network.feature_model.fusion.out_conv.weight.dtype == torch.bfloat16
            else "fp32"
        )

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Two layers of Gaussians in metres, the nearer layer first, row by row; InputError if memory is short."""
        with report_memory_shortage(LESS_MEMORY):
            gaussians = to_metric(self.infer(photo, progress), photo)
        camera = Camera.from_focal(photo.focal_px, photo.width, photo.height)
        notes: dict[str, float | int | str] = {"precision": self.precision, "weights": self.weights}
        return BasePrediction(
            gaussians, camera.resized(*working_size(photo.width, photo.height)), notes
        )

    @torch.no_grad()
    def infer(self, photo: Photo, progress: Progress | None = None) -> SharpOutput:
        """The network's output for a photo; `to_metric` turns it into Gaussians."""
        image = resize_to_square(
            photo.rgb.to(self.device, non_blocking=True), self.network.config.side
        )
        with without_autocast_or_tf32(self.device):
            factor = photo.focal_px / photo.width
            output: SharpOutput = self.network(image, factor, self.windows_per_batch, progress)
        return output


def default_window_batch(device: torch.device) -> int:
    """The default for the number of windows that go through the transformer at once."""
    return CPU_WINDOW_BATCH if device.type == "cpu" else WINDOW_COUNT


def check_window_batch(windows_per_batch: int | None) -> None:
    """InputError if the number of windows in a batch is not between 1 and 35; None is allowed."""
    if windows_per_batch is not None and not 1 <= windows_per_batch <= WINDOW_COUNT:
        raise InputError(
            f"`windows_per_batch` must be between 1 and {WINDOW_COUNT}, got {windows_per_batch}"
        )


def to_metric(output: SharpOutput, photo: Photo) -> Gaussians:
    """Convert Gaussians from normalised space, where x / z and y / z run from -1 to 1, to metres, on the CPU."""
    stretch = (photo.width / (2 * photo.focal_px), photo.height / (2 * photo.focal_px), 1.0)
    with without_autocast_or_tf32(output.deltas.device):
        return stretch_gaussians(apply_deltas(output.initial, output.deltas).to("cpu"), stretch)


def resize_to_square(rgb: Tensor, side: int) -> Tensor:
    """Resize [H, W, 3] sRGB to [1, 3, side, side], bilinearly with aligned corner pixels, as SHARP was trained."""
    image = rgb.permute(2, 0, 1)[None].contiguous()
    return interpolate(image, size=(side, side), mode="bilinear", align_corners=True)


# The checkpoint -----------------------------------------------------------------------------------


def load_network(
    path: str | os.PathLike[str], dtype: torch.dtype, device: torch.device | str = "cpu"
) -> SharpNetwork:
    """A frozen network from Apple's .pt file, or a safetensors file with the same names, on a device.

    The size, published or tiny, follows from the shapes. If a file holds only a trained Gaussian decoder, the other
    weights come from the checkpoint that it names. The heavy arithmetic is in `dtype`, float32 or bfloat16. InputError
    for a missing, broken or foreign file, or too little memory. Nothing in the file is executed.
    """
    tensors: Mapping[str, Tensor] = read_tensors(path, ADVICE)
    if (owner := source_checkpoint_of(path)) is not None:
        tensors = _with_owner(tensors, path, owner)
    tensors = {
        name: tensor for name, tensor in tensors.items() if not name.startswith(UNUSED_PREFIXES)
    }
    positions = tensors.get(f"{_ENCODER}patch_encoder.pos_embed", torch.empty(0)).shape
    sizes: dict[tuple[int, ...], SharpConfig]
    sizes = {(1, 1 + config.grid**2, config.embed): config for config in SIZES.values()}
    with torch.device("meta"):
        network = SharpNetwork(sizes.get(positions, SIZES["full"]))
    with report_memory_shortage(LESS_MEMORY):
        convert = functools.partial(set_precision, dtype=dtype)
        load_strict(network, tensors, path, ADVICE, prepare=convert)
        return network.to(device)


def expected_shapes(config: SharpConfig) -> TensorShapes:
    """The names and shapes of all tensors that `load_network` reads from a checkpoint of this size."""
    with torch.device("meta"):
        return {
            name: tuple(tensor.shape) for name, tensor in SharpNetwork(config).state_dict().items()
        }


# A trained decoder --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class SourceCheckpoint:
    """The checkpoint that a decoder was trained on, which holds the weights that were not trained."""

    path: Path  # only the file's name if it was read from a decoder's file
    sha256: str

    @property
    def places(self) -> tuple[str, str]:
        """Possible names of the checkpoint in a decoder's folder: `link_source_checkpoint`'s link, and the file's own name."""
        return f"trained-on-{printable_line(Path(self.sha256).name)[:12]}.link", self.path.name


def encode_decoder(decoder: nn.Module, owner: SourceCheckpoint) -> bytes:
    """A `GaussianDecoder` as a safetensors file in float32, which restores unchanged weights bit for bit."""
    tensors = {
        name: tensor.detach().float().cpu().contiguous()
        for name, tensor in decoder.state_dict().items()
    }
    return save(
        tensors, {SOURCE_KEY: json.dumps({"checkpoint": owner.path.name, "sha256": owner.sha256})}
    )


def link_source_checkpoint(owner: SourceCheckpoint, folder: Path) -> None:
    """Put a link to a checkpoint into the folder of its decoders, under a name that no other file has."""
    link = folder / owner.places[0]
    with contextlib.suppress(
        OSError
    ):  # the link exists, or the file system has none: then the user copies the file
        if link.is_symlink() and not link.exists():  # the checkpoint has moved
            link.unlink()
        link.symlink_to(owner.path.absolute())


def source_checkpoint_of(path: str | os.PathLike[str]) -> SourceCheckpoint | None:
    """The checkpoint that a decoder's file names; None for another file, InputError if the name is missing."""
    note = read_metadata(path, SOURCE_KEY)
    if note is None:
        return None
    with as_input_error(path, "does not say which checkpoint it was trained on: train it again"):
        facts = json.loads(note)
        return SourceCheckpoint(Path(Path(str(facts["checkpoint"])).name), str(facts["sha256"]))


def _with_owner(
    decoder: Mapping[str, Tensor], path: str | os.PathLike[str], owner: SourceCheckpoint
) -> dict[str, Tensor]:
    """The tensors of the checkpoint in a decoder's folder, with the decoder's tensors in place of the checkpoint's.

    InputError if the checkpoint is missing, unreadable or changed, or if the decoder belongs to another network.
    """
    beside = Path(path).absolute().parent
    home = next((beside / name for name in owner.places if os.path.isfile(beside / name)), None)
    name = printable_line(owner.path.name)
    if home is None:
        raise InputError(
            f"{path}: trained on {name}, which is not in this folder: put the checkpoint or a link there"
        )
    with as_input_error(home, "cannot be read: {reason}", OSError), open(home, "rb") as file:
        found = sha256_of(file)
    if found != owner.sha256:
        raise InputError(
            f"{path}: trained on a checkpoint with the SHA-256 {printable_line(owner.sha256)[:64]}, but {home} has another: "
            f"put the right {name} into the folder"
        )
    whole = read_tensors(home, ADVICE)
    trained = {name for name in whole if name.startswith(("feature_model.", "prediction_head."))}
    if wrong := sorted(trained ^ decoder.keys()):
        raise InputError(
            f"{path}: not a decoder of {home}: {len(wrong)} names differ, e.g. {printable_line(wrong[0])[:120]}"
        )
    return {**whole, **decoder}
