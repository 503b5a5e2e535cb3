"""SHARP's network from its checkpoint, and the checkpoint of a trained Gaussian decoder alone.

Files are a stranger's: their kind is told by their content, nothing in them runs, and names, shapes and numbers have to
be SHARP's.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pickle
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn

from spackle.bases.sharp.layers import CONFIGS, GROUPS, SharpConfig, normed_residual, set_precision
from spackle.bases.sharp.network import SharpNetwork
from spackle.device import enough_memory
from spackle.errors import InputError, reason_in_a_line
from spackle.files import check_file, sha256_of

Shapes = dict[str, tuple[int, ...]]

NAMED = 3  # how many of the names that differ are spelled out
NOTE = "spackle.gaussian_decoder"  # in the file's metadata: JSON, for safetensors shuffles several notes
PARTS = ("feature_model.", "prediction_head.")  # how its tensors' names begin
MAX_HEADER = 100_000_000  # bytes of a safetensors header; the format allows no more
ENCRYPTED = 1  # a zip member's flag


def load_network(path: str | os.PathLike[str], dtype: torch.dtype, device: torch.device | str = "cpu") -> SharpNetwork:
    """A frozen network from Apple's .pt file, or a safetensors file with the same names, on a device.

    The size, published or tiny, is told from the shapes. A file with a trained Gaussian decoder alone stands for the
    checkpoint that it names, with that decoder in it. The heavy arithmetic is in `dtype`, float32 or bfloat16.

    Raises:
        InputError: a missing, broken or foreign file, or too little memory. Nothing in the file is executed.
    """
    tensors = read_checkpoint_tensors(path)
    if (owner := owner_of(path)) is not None:
        tensors = _with_owner(tensors, path, owner)
    token = tensors.get("monodepth_model.monodepth_predictor.encoder.patch_encoder.cls_token")
    width = token.shape[-1] if token is not None and token.ndim else None
    config = next((config for config in CONFIGS.values() if config.embed == width), CONFIGS["full"])
    _check_shapes({name: tuple(tensor.shape) for name, tensor in tensors.items()}, expected_shapes(config), path)
    with torch.device("meta"):
        network = SharpNetwork(config)
    advice = ["try --precision bf16"] if dtype == torch.float32 else []  # it takes half as much
    try:
        with enough_memory(*advice):
            network.load_state_dict({name: tensors[name].float() for name in network.state_dict()}, assign=True)
            network.eval().requires_grad_(False)
            set_precision(network, dtype)  # reads what is on the disk still
            for name, parameter in network.named_parameters():
                if parameter.data_ptr() == tensors[name].data_ptr():  # not copied yet: the file may change later
                    parameter.data = parameter.data.clone()
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read to its end: {reason_in_a_line(error)}") from error
    # A finite sum proves it at little cost; but a sum of finite numbers can overflow.
    broken = [name for name, t in network.state_dict().items() if not (t.sum().isfinite() or t.isfinite().all())]
    if broken:
        raise InputError(f"{path}: holds numbers that are not finite ({_some(broken)}): download it again")
    with enough_memory(*advice):
        return network.to(device)


def expected_shapes(config: SharpConfig) -> Shapes:
    """Every name and shape that a checkpoint of this size has, 1,038 in the published one."""
    with torch.device("meta"):
        return _shapes_of(SharpNetwork(config)) | unused_shapes(config)


def _check_shapes(found: Shapes, expected: Shapes, path: str | os.PathLike[str]) -> None:
    """InputError where a checkpoint holds something else than it should; the message lists what."""
    missing, unknown = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    reshaped = [
        f"{name} {list(found[name])} instead of {list(expected[name])}"
        for name in expected
        if name in found and found[name] != expected[name]
    ]
    kinds = {"missing": missing, "unknown": unknown, "of another shape": reshaped}
    problems = [f"{len(names)} {kind} ({_some(names)})" for kind, names in kinds.items() if names]
    if problems:
        raise InputError(f"{path}: not SHARP's weights: of {len(expected)} tensors {'; '.join(problems)}")


def _shapes_of(module: nn.Module, prefix: str = "") -> Shapes:
    return {prefix + name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(map(plain_text, names[:NAMED])) + (f", and {more} more" if more > 0 else "")


@dataclasses.dataclass(frozen=True)
class Owner:
    """The checkpoint that a decoder was trained on, and needs for all that was not trained."""

    path: Path  # where it lies; of one that a decoder's file names, the name alone
    sha256: str

    @property
    def places(self) -> tuple[str, str]:
        """What it, or a link to it, is called beside a decoder: the link of `link_owner`, and its own name."""
        return f"trained-on-{plain_text(Path(self.sha256).name, 12)}.link", self.path.name


def decoder_bytes(decoder: nn.Module, owner: Owner) -> bytes:
    """A safetensors file of a `GaussianDecoder` in float32: weights that have not changed come back bit for bit."""
    tensors = {name: tensor.detach().float().cpu().contiguous() for name, tensor in decoder.state_dict().items()}
    return save(tensors, {NOTE: json.dumps({"checkpoint": owner.path.name, "sha256": owner.sha256})})


def link_owner(owner: Owner, folder: Path) -> None:
    """Let decoders in a folder find their checkpoint; the link's name is one that nothing is ever written to."""
    link = folder / owner.places[0]
    with contextlib.suppress(OSError):  # this place has no links: then a person puts the checkpoint there
        if link.is_symlink() and not link.exists():  # to where it lay once
            link.unlink()
        if not link.exists():
            link.symlink_to(owner.path.absolute())


def owner_of(path: str | os.PathLike[str]) -> Owner | None:
    """The checkpoint that a readable file with a decoder names; None for other files, InputError if it names none."""
    with open(path, "rb") as file:
        head = file.read(9)
    if not _is_safetensors(head):
        return None
    with safe_open(path, framework="pt") as opened:
        note = (opened.metadata() or {}).get(NOTE)
    if note is None:
        return None
    try:
        facts = json.loads(note)
        return Owner(Path(Path(str(facts["checkpoint"])).name), str(facts["sha256"]))
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path}: does not say which checkpoint it was trained on: train it again") from error


def _with_owner(decoder: Mapping[str, Tensor], path: str | os.PathLike[str], owner: Owner) -> dict[str, Tensor]:
    """The tensors of the checkpoint beside a decoder's file, with the decoder's in place of its own.

    InputError: it is not there, cannot be read or has changed, or the decoder is another network's.
    """
    beside = Path(path).absolute().parent
    home = next((beside / name for name in owner.places if os.path.isfile(beside / name)), None)
    name = plain_text(owner.path.name)
    if home is None:
        raise InputError(
            f"{path}: a decoder trained on {name}, which is not beside it: put that checkpoint, or a link to it, there"
        )
    try:
        with open(home, "rb") as file:
            found = sha256_of(file)
    except OSError as error:
        raise InputError(f"{home}: cannot be read: {reason_in_a_line(error)}") from error
    if found != owner.sha256:
        raise InputError(
            f"{path}: trained on a checkpoint with the SHA-256 {plain_text(owner.sha256)}, which {home} has not: "
            f"put that {name} beside it"
        )
    whole = read_checkpoint_tensors(home)
    replaced = {name for name in whole if name.startswith(PARTS)}
    if wrong := sorted(replaced ^ decoder.keys()):
        raise InputError(
            f"{path}: not the decoder of {home}: {len(wrong)} names differ, e.g. {plain_text(wrong[0])}: "
            "give what `spackle train --method direct-ft` wrote"
        )
    return {**whole, **decoder}


def read_checkpoint_tensors(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """The tensors of what torch.save wrote or of a safetensors file; numbers are read from the disk when they are used.

    Raises:
        InputError: a missing or broken file, or one that holds anything but named tensors.
    """
    check_file(path, "checkpoint")
    try:
        with enough_memory():
            loaded = _read(path)
    except InputError:
        raise
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: holds more than tensors, or is damaged; nothing in it was run: "
            "give Apple's checkpoint as it was downloaded, or a .safetensors file"
        ) from error
    except Exception as error:  # a stranger's bytes can raise anything
        reason = plain_text(reason_in_a_line(error), 200)
        raise InputError(f"{path}: not a checkpoint, or cut off ({reason}): download it again") from error
    if not isinstance(loaded, Mapping) or not loaded:
        raise InputError(f"{path}: holds no named tensors: give SHARP's checkpoint")
    for name, value in loaded.items():
        if not isinstance(name, str):
            raise InputError(f"{path}: a {type(name).__name__} stands for a name: give SHARP's weights alone")
        if not _is_plain(value):
            raise InputError(f"{path}: {plain_text(name)} is no plain tensor of floats: give SHARP's weights alone")
    return dict(loaded)


def plain_text(text: str, longest: int = 120) -> str:
    """A stranger's text for a message: as it is where it is plain, else quoted and escaped."""
    text = text[:longest]
    return text if text.isascii() and text.isprintable() else ascii(text)[:longest]


def _read(path: str | os.PathLike[str]) -> object:
    """Whatever is in a file, by its first bytes: people rename files."""
    with open(path, "rb") as file:
        head = file.read(9)
    if head.startswith(b"PK\x03\x04"):
        _check_archive(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about kinds of tensors that are refused
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    if _is_safetensors(head):
        with safe_open(path, framework="pt") as opened:
            return {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118  # it is no dict
    if head.startswith(b"\x80"):
        raise InputError(
            f"{path}: a bare pickle, as PyTorch wrote before 1.6; nothing in it was run: "
            "save it again with a current torch.save, or give Apple's checkpoint as it was downloaded"
        )
    raise InputError(f"{path}: neither a PyTorch checkpoint nor a safetensors file: give SHARP's checkpoint")


def _is_safetensors(head: bytes) -> bool:
    """By the first nine bytes of a file."""
    return head[8:] == b"{" and int.from_bytes(head[:8], "little") <= MAX_HEADER


def _check_archive(path: str | os.PathLike[str]) -> None:
    """InputError unless a zip's members lie in it plainly and undamaged: torch maps them, and looks at nothing."""
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if any(member.compress_type != zipfile.ZIP_STORED or member.flag_bits & ENCRYPTED for member in members):
            raise InputError(
                f"{path}: zipped again by another program: give Apple's checkpoint as it was downloaded, "
                "or what torch.save writes"
            )
        # The record says little or big, and torch refuses whatever else it says.
        if any(member.filename.endswith("/byteorder") and member.file_size == len("big") for member in members):
            raise InputError(f"{path}: its numbers are big-endian: save it again on a little-endian machine")
        summed = any(member.CRC for member in members)  # torch.save can be told to leave the sums out
        if summed and (damaged := archive.testzip()) is not None:
            raise InputError(f"{path}: damaged at {plain_text(damaged)}: download it again")


def _is_plain(value: object) -> bool:
    """Whether it is a dense tensor of floats without attributes, which could hide its methods."""
    if type(value) not in (Tensor, torch.nn.Parameter) or vars(value):
        return False
    assert isinstance(value, Tensor)
    dense = not value.is_nested and value.layout == torch.strided and value.device.type == "cpu"
    return dense and value.is_floating_point()


def unused_shapes(config: SharpConfig) -> Shapes:
    """What a checkpoint holds and inference never reads: it is checked by name and shape, then dropped.

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
        # All but the first also see what the encoder made at their size.
        up = nn.ModuleList(_level(width << (5 - n if n else 4), width << 3 - n) for n in range(4))
        norms = nn.GroupNorm(GROUPS, 2 * width), nn.GroupNorm(GROUPS, width)
        out = nn.Sequential(norms[0], nn.ReLU(), nn.Conv2d(2 * width, width, 1), norms[1])
        encoder = nn.ModuleDict({"conv_in": into, "convs_down": down})
        decoder = nn.ModuleDict({"convs_up": up, "conv_out": out})
        unet = nn.ModuleDict({"encoder": encoder, "decoder": decoder, "conv_out": nn.Conv2d(width, 1, 1)})
    return shapes | _shapes_of(unet, "depth_alignment.scale_map_estimator.")


def _level(dim_in: int, dim_out: int) -> nn.Sequential:
    """Two residual blocks behind a change of size, which has no parameters."""
    first = normed_residual(dim_in, dim_out)
    first.shortcut = nn.Conv2d(dim_in, dim_out, 1)
    return nn.Sequential(nn.Identity(), first, normed_residual(dim_out, dim_out))


def deterministic_weights(shapes: Shapes) -> dict[str, Tensor]:
    """A state dict [name → float32 tensor] that depends on names and shapes alone, and shows no scene.

    The scale of each kind is such that signals neither die nor explode, and the Gaussians fill the picture.
    """
    return {name: torch.from_numpy(_tensor(name, shape)) for name, shape in shapes.items()}


def _tensor(name: str, shape: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    generator = np.random.Generator(np.random.Philox(zlib.crc32(name.encode())))
    x = generator.standard_normal(shape, dtype=np.float32)
    if name.endswith(("pos_embed", "cls_token")):
        return np.float32(0.02) * x
    if name.endswith(".gamma"):
        return np.float32(0.1) * (1 + np.float32(0.1) * x)
    if name.endswith("monodepth_predictor.head.4.bias"):
        return 1 + np.float32(0.1) * x  # disparities around one
    if len(shape) > 1:
        return x / np.float32(np.sqrt(np.prod(shape[1:])))
    if name.endswith("weight"):
        return 1 + np.float32(0.1) * x
    return np.float32(0.02) * x
