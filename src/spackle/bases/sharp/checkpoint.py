"""Reading SHARP's checkpoint: strict about names and shapes, and never running what is in the file."""

from __future__ import annotations

import os
import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from spackle.bases.sharp.config import CONFIGS, SharpConfig
from spackle.bases.sharp.network import SharpNetwork
from spackle.bases.sharp.precision import set_precision
from spackle.bases.sharp.unused import Shapes, unused_shapes
from spackle.errors import InputError, reason_in_a_line
from spackle.image import check_file

NAMED = 3  # how many of the names that differ are spelled out


def load_network(path: str | os.PathLike[str], dtype: torch.dtype, device: torch.device | str = "cpu") -> SharpNetwork:
    """A frozen network from Apple's .pt file, or from a .safetensors file with the same names.

    The size, published or tiny, is told from the shapes.

    Args:
        path: the checkpoint.
        dtype: of the heavy arithmetic, float32 or bfloat16.
        device: where the network is to run.

    Raises:
        InputError: a missing, broken or foreign file. Nothing in it is executed.
    """
    tensors = read_tensors(path)
    config = _config_of(tensors)
    check_shapes({name: tuple(tensor.shape) for name, tensor in tensors.items()}, expected_shapes(config), path)
    with torch.device("meta"):
        network = SharpNetwork(config)
    try:
        network.load_state_dict({name: tensors[name].float() for name in network.state_dict()}, assign=True)
        network.eval().requires_grad_(False)
        set_precision(network, dtype)  # reads what is on the disk still
        for name, parameter in network.named_parameters():
            if parameter.data_ptr() == tensors[name].data_ptr():  # not copied yet: the file may change later
                parameter.data = parameter.data.clone()
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read to its end: {reason_in_a_line(error)}") from error
    broken = [name for name, tensor in network.state_dict().items() if not tensor.sum().isfinite()]
    if broken:
        raise InputError(f"{path}: holds numbers that are not finite ({_some(broken)}): download it again")
    return network.to(device)


def read_tensors(path: str | os.PathLike[str]) -> dict[str, Tensor]:
    """The tensors of a checkpoint, their numbers read from the disk only when they are used.

    Raises:
        InputError: a missing or broken file, or one that holds anything but named tensors.
    """
    check_file(path, "checkpoint")
    try:
        if Path(path).suffix == ".safetensors":
            with safe_open(path, framework="pt") as file:
                loaded = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # it is no dict
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about old pickles, which are refused or fine
                loaded = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except pickle.UnpicklingError as error:
        raise InputError(
            f"{path}: holds more than tensors, or is damaged; nothing in it was run: "
            "give Apple's checkpoint as it was downloaded, or a .safetensors file"
        ) from error
    except Exception as error:  # a stranger's bytes can raise anything
        raise InputError(
            f"{path}: not a checkpoint, or cut off ({reason_in_a_line(error)}): download it again"
        ) from error
    if not isinstance(loaded, Mapping) or not loaded:
        raise InputError(f"{path}: holds no named tensors: give SHARP's checkpoint")
    for name, value in loaded.items():
        if not (isinstance(name, str) and _is_plain(value)):
            shown = ascii(name)[:120] if isinstance(name, str) else type(name).__name__
            raise InputError(f"{path}: {shown} is no plain tensor of floats: give SHARP's weights alone")
    return dict(loaded)


def _is_plain(value: object) -> bool:
    """A dense tensor of floats with nothing attached: a file can give a tensor attributes that hide its methods."""
    if type(value) not in (Tensor, torch.nn.Parameter) or vars(value):
        return False
    assert isinstance(value, Tensor)
    dense = not value.is_nested and value.layout == torch.strided and value.device.type == "cpu"
    return dense and value.is_floating_point()


def expected_shapes(config: SharpConfig) -> Shapes:
    """Every name and shape that a checkpoint of this size has, 1,038 in the published one."""
    with torch.device("meta"):
        network = SharpNetwork(config)
    return {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()} | unused_shapes(config)


def check_shapes(found: Shapes, expected: Shapes, path: str | os.PathLike[str]) -> None:
    """InputError that lists what differs."""
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


def _config_of(tensors: Mapping[str, Tensor]) -> SharpConfig:
    """The size whose positions a checkpoint has; the published one where none fits, for the message's sake."""
    name = "monodepth_model.monodepth_predictor.encoder.patch_encoder.cls_token"
    width = tensors[name].shape[-1] if name in tensors and tensors[name].ndim else None
    return next((config for config in CONFIGS.values() if config.embed == width), CONFIGS["full"])


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(name[:120] for name in names[:NAMED]) + (f", and {more} more" if more > 0 else "")
