"""The SHARP base: predict 1,179,648 Gaussians in metres from one photo.

The weights are Apple's, or Apple's with a retrained Gaussian decoder. `SharpBase` is the base,
`load_network` reads its weights, and `SourceCheckpoint` says on which weights a decoder was
trained.
"""

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
from spackle.core.photo import Photo, resize_photo, working_size
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
MEMORY_ADVICE = "try `windows_per_batch` 1 and `precision` bf16"
# A decoder file's only metadata key, with a value in JSON: safetensors shuffles several keys.
SOURCE_KEY = "spackle.gaussian_decoder"
_ENCODER_PREFIX = "monodepth_model.monodepth_predictor.encoder."
# Tensors that are never read: the transformers' classifiers, and a U-Net that only training uses.
UNUSED_PREFIXES = (
    f"{_ENCODER_PREFIX}patch_encoder.head.",
    f"{_ENCODER_PREFIX}image_encoder.head.",
    "depth_alignment.",
)
DECODER_PREFIXES = ("feature_model.", "prediction_head.")  # of the Gaussian decoder's tensors


class SharpBase:
    """Apple's SHARP (2025), frozen. The published weights are for research only."""

    name = "sharp"

    def __init__(
        self, network: SharpNetwork, *, windows_per_batch: int | None = None, weights: str = ""
    ) -> None:
        """Use a loaded network on its device.

        Args:
            network: from `load_network`.
            windows_per_batch: how many of a photo's 35 overlapping windows go through the
                transformer at once; None: 5 on a CPU, all on a GPU.
            weights: the name of the file of weights, for the report.
        """
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
        """Read a checkpoint.

        Args:
            path: Apple's .pt file, a safetensors file with the same names of tensors, or a decoder
                that `spackle train --method direct-ft` wrote.
            precision: number type of the heavy arithmetic; auto is bf16 if the hardware multiplies
                it natively.
            windows_per_batch: how many of a photo's 35 overlapping windows go through the
                transformer at once; None: 5 on a CPU, all on a GPU. The last bits of the result
                depend on this number.
            device: cpu or a CUDA device; None: CUDA if available.

        Raises:
            InputError: a file, device or number of windows cannot be used, or memory is short.
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
        heavy_weights = self.network.feature_model.fusion.out_conv.weight
        return "bf16" if heavy_weights.dtype == torch.bfloat16 else "fp32"

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Two layers of Gaussians in metres, the nearer layer first, row by row.

        The network works on 35 overlapping windows of the picture: `progress` is called with the
        number of windows done and that of all windows. InputError if memory is short.
        """
        with report_memory_shortage(MEMORY_ADVICE):
            gaussians = to_metric(self.infer(photo, progress), photo)
        # The number of Gaussians does not depend on the photo's size. The camera gets the size at
        # which the scene is shown, the photo's working size.
        camera = Camera.from_focal(photo.focal_px, photo.width, photo.height)
        width, height = working_size(photo.width, photo.height)
        notes: dict[str, float | int | str] = {"precision": self.precision, "weights": self.weights}
        return BasePrediction(
            gaussians, camera.resized(width, height), notes, photo=resize_photo(photo).rgb
        )

    @torch.no_grad()
    def infer(self, photo: Photo, progress: Progress | None = None) -> SharpOutput:
        """The network's output for a photo, which `to_metric` turns into Gaussians.

        `progress` is called with the number of windows of the picture that are done, and that of
        all windows.
        """
        rgb = photo.rgb.to(self.device, non_blocking=True)
        image = resize_to_square(rgb, self.network.config.side)
        disparity_factor = photo.focal_px / photo.width
        with without_autocast_or_tf32(self.device):
            output: SharpOutput = self.network(
                image, disparity_factor, self.windows_per_batch, progress
            )
        return output


def default_window_batch(device: torch.device) -> int:
    """The number of windows that go through the transformer at once if the user sets none."""
    return CPU_WINDOW_BATCH if device.type == "cpu" else WINDOW_COUNT


def check_window_batch(windows_per_batch: int | None) -> None:
    """InputError if the number of windows in a batch is not between 1 and 35; None is allowed."""
    if windows_per_batch is not None and not 1 <= windows_per_batch <= WINDOW_COUNT:
        raise InputError(
            f"`windows_per_batch` must be between 1 and {WINDOW_COUNT}, got {windows_per_batch}"
        )


def to_metric(output: SharpOutput, photo: Photo) -> Gaussians:
    """The network's Gaussians in metres, on the CPU.

    The network's space is normalised: x / z and y / z run from -1 to 1 over the photo. Stretching
    along x and y gives the photo's true field of view.
    """
    stretch_x = photo.width / (2 * photo.focal_px)
    stretch_y = photo.height / (2 * photo.focal_px)
    with without_autocast_or_tf32(output.deltas.device):
        normalised = apply_deltas(output.initial, output.deltas).to("cpu")
        return stretch_gaussians(normalised, (stretch_x, stretch_y, 1.0))


def resize_to_square(rgb: Tensor, side: int) -> Tensor:
    """Resize [H, W, 3] sRGB to [1, 3, side, side].

    Bilinearly with aligned corner pixels, because SHARP was trained so.
    """
    image = rgb.permute(2, 0, 1)[None].contiguous()
    return interpolate(image, size=(side, side), mode="bilinear", align_corners=True)


# --- The checkpoint


def load_network(
    path: str | os.PathLike[str], dtype: torch.dtype, device: torch.device | str = "cpu"
) -> SharpNetwork:
    """A frozen network on a device, from Apple's .pt file or safetensors with the same names.

    The shapes of the tensors tell the network's size, which is the published one or a tiny one for
    tests. If the file holds only a trained Gaussian decoder, all other weights come from the
    checkpoint that it names. The heavy arithmetic is in `dtype`, float32 or bfloat16. Nothing in
    the file is executed. InputError for a missing, broken or foreign file, or too little memory.
    """
    tensors: Mapping[str, Tensor] = read_tensors(path, ADVICE)
    # A decoder's file holds 1 % of the weights, and names the checkpoint with the others: a copy of
    # them in the file of each decoder would fill the disk.
    source = source_checkpoint_of(path)
    if source is not None:
        tensors = _completed_by_source(tensors, path, source)
    # A checkpoint also holds weights that the network does not need for predictions.
    needed_tensors = {
        name: tensor for name, tensor in tensors.items() if not name.startswith(UNUSED_PREFIXES)
    }

    with torch.device("meta"):  # without memory; the weights come from the file
        network = SharpNetwork(_size_of(needed_tensors))
    with report_memory_shortage(MEMORY_ADVICE):
        convert = functools.partial(set_precision, dtype=dtype)
        load_strict(network, needed_tensors, path, ADVICE, prepare=convert)
        return network.to(device)


def _size_of(tensors: Mapping[str, Tensor]) -> SharpConfig:
    """The size of SHARP that a checkpoint belongs to, by the shape of its learned positions.

    If no size fits, the published one is returned: loading then raises an error that says what is
    wrong.
    """
    positions = tensors.get(f"{_ENCODER_PREFIX}patch_encoder.pos_embed", torch.empty(0))
    # Besides the published size there are tiny ones, for tests. There is a position for each token
    # and one for the class token.
    for config in SIZES.values():
        if positions.shape == (1, 1 + config.tokens_per_side**2, config.embed_width):
            return config
    return SIZES["full"]


def expected_shapes(config: SharpConfig) -> TensorShapes:
    """The names and shapes of all tensors that `load_network` reads from a checkpoint."""
    with torch.device("meta"):
        state = SharpNetwork(config).state_dict()
    return {name: tuple(tensor.shape) for name, tensor in state.items()}


# --- A trained decoder


@dataclasses.dataclass(frozen=True)
class SourceCheckpoint:
    """The checkpoint that a decoder was trained on: it holds the weights that were not trained."""

    path: Path  # only the file's name if it was read from a decoder's file
    sha256: str

    @property
    def link_name(self) -> str:
        """The name of `link_source_checkpoint`'s link, which no other file has."""
        short_digest = printable_line(Path(self.sha256).name)[:12]
        return f"trained-on-{short_digest}.link"


def encode_decoder(decoder: nn.Module, source: SourceCheckpoint) -> bytes:
    """The bytes of a safetensors file with a decoder's weights and the name of its checkpoint.

    The `GaussianDecoder` is the part of SHARP that is trained; the checkpoint is where the training
    began. Weights are stored as float32, like the checkpoint's, so that weights which the training
    does not change stay the same to the bit.
    """
    tensors = {
        name: tensor.detach().float().cpu().contiguous()
        for name, tensor in decoder.state_dict().items()
    }
    note = json.dumps({"checkpoint": source.path.name, "sha256": source.sha256})
    return save(tensors, {SOURCE_KEY: note})


def link_source_checkpoint(source: SourceCheckpoint, folder: Path) -> None:
    """Put a link to a checkpoint into the folder of the decoders that were trained on it.

    Where links cannot be made, nothing happens.
    """
    link = folder / source.link_name
    # An OSError means that the link exists already, or that the file system has no links: then the
    # user copies the checkpoint into the folder, as the message about a missing one says.
    with contextlib.suppress(OSError):
        if link.is_symlink() and not link.exists():  # the checkpoint has moved
            link.unlink()
        link.symlink_to(source.path.absolute())


def source_checkpoint_of(path: str | os.PathLike[str]) -> SourceCheckpoint | None:
    """The checkpoint that a decoder's file names; None for a file that holds no decoder.

    InputError if a decoder's file names no checkpoint.
    """
    # Only files that `encode_decoder` wrote have this key.
    note = read_metadata(path, SOURCE_KEY)
    if note is None:
        return None
    with as_input_error(path, "does not say which checkpoint it was trained on: train it again"):
        facts = json.loads(note)
        # Only the name and no folder: an untrusted file must not choose what is read.
        file_name = Path(str(facts["checkpoint"])).name
        return SourceCheckpoint(Path(file_name), str(facts["sha256"]))


def _completed_by_source(
    decoder: Mapping[str, Tensor], path: str | os.PathLike[str], source: SourceCheckpoint
) -> dict[str, Tensor]:
    """All tensors of a network: the decoder's from its file, the others from the source checkpoint.

    Args:
        decoder: the tensors of a decoder that was trained alone.
        path: the file that they were read from.
        source: the checkpoint that the decoder was trained on; it must be in the file's folder.

    Raises:
        InputError: the checkpoint is missing, unreadable or changed, or the decoder belongs to
            another network.
    """
    checkpoint = _find_source(path, source)
    tensors = read_tensors(checkpoint, ADVICE)
    # The decoder's names must be exactly the checkpoint's.
    trained_names = {name for name in tensors if name.startswith(DECODER_PREFIXES)}
    wrong_names = sorted(trained_names ^ decoder.keys())  # in one of the two files only
    if wrong_names:
        example = printable_line(wrong_names[0])[:120]  # a name in a file may be very long
        raise InputError(
            f"{path}: not a decoder of {checkpoint}: {len(wrong_names)} names differ, "
            f"e.g. {example}"
        )
    return {**tensors, **decoder}


def _find_source(path: str | os.PathLike[str], source: SourceCheckpoint) -> Path:
    """Find the checkpoint that a decoder was trained on, beside the decoder's file `path`.

    It is a link that the training made, or a file with the checkpoint's own name. InputError if it
    is missing, unreadable or changed.
    """
    folder = Path(path).absolute().parent
    # The name comes from an untrusted file, and messages with it go to a terminal.
    shown_name = printable_line(source.path.name)
    candidates = [folder / source.link_name, folder / source.path.name]
    checkpoint = next((file for file in candidates if os.path.isfile(file)), None)
    if checkpoint is None:
        raise InputError(
            f"{path}: trained on {shown_name}, which is not in this folder: "
            "put the checkpoint or a link there"
        )

    unreadable = as_input_error(checkpoint, "cannot be read: {reason}", OSError)
    with unreadable, open(checkpoint, "rb") as file:
        sha256 = sha256_of(file)
    # Another checkpoint would load without an error and give a wrong scene.
    if sha256 != source.sha256:
        shown_digest = printable_line(source.sha256)[:64]  # a true SHA-256 has 64 digits
        raise InputError(
            f"{path}: trained on a checkpoint with the SHA-256 {shown_digest}, "
            f"but {checkpoint} has another: put the right {shown_name} into the folder"
        )
    return checkpoint
