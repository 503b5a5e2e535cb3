"""SHARP's network from its checkpoint: strict about names, shapes and numbers."""

from __future__ import annotations

import os
from collections.abc import Mapping

import torch
from torch import Tensor

from spackle.bases.device import enough_memory
from spackle.bases.sharp.config import CONFIGS, SharpConfig
from spackle.bases.sharp.decoder_file import owner_of, with_owner
from spackle.bases.sharp.network import SharpNetwork
from spackle.bases.sharp.precision import set_precision
from spackle.bases.sharp.tensor_file import plain_text, read_tensors
from spackle.bases.sharp.unused import Shapes, unused_shapes
from spackle.errors import InputError, reason_in_a_line

NAMED = 3  # how many of the names that differ are spelled out


def load_network(path: str | os.PathLike[str], dtype: torch.dtype, device: torch.device | str = "cpu") -> SharpNetwork:
    """A frozen network from Apple's .pt file, or from a safetensors file with the same names.

    The size, published or tiny, is told from the shapes. A file with a trained Gaussian decoder alone stands
    for the checkpoint that it names, with that decoder in it.

    Args:
        path: the checkpoint, or the decoder.
        dtype: of the heavy arithmetic, float32 or bfloat16.
        device: where the network is to run.

    Raises:
        InputError: a missing, broken or foreign file, or too little memory. Nothing in the file is executed.
    """
    tensors = read_tensors(path)
    if (owner := owner_of(path)) is not None:
        tensors = with_owner(tensors, path, owner)
    network = _empty_network(_config_of(tensors))
    check_shapes({name: tuple(tensor.shape) for name, tensor in tensors.items()}, _shapes_of(network), path)
    advice = ["try --precision bf16"] if dtype == torch.float32 else []  # it takes half as much
    try:
        with enough_memory(*advice):
            _fill(network, tensors, dtype)
    except (OSError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read to its end: {reason_in_a_line(error)}") from error
    broken = [name for name, tensor in network.state_dict().items() if not _is_finite(tensor)]
    if broken:
        raise InputError(f"{path}: holds numbers that are not finite ({_some(broken)}): download it again")
    with enough_memory(*advice):
        return network.to(device)


def expected_shapes(config: SharpConfig) -> Shapes:
    """Every name and shape that a checkpoint of this size has, 1,038 in the published one."""
    return _shapes_of(_empty_network(config))


def check_shapes(found: Shapes, expected: Shapes, path: str | os.PathLike[str]) -> None:
    """Compare what a checkpoint holds with what it should.

    Raises:
        InputError: something differs; the message lists what.
    """
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


def _fill(network: SharpNetwork, tensors: Mapping[str, Tensor], dtype: torch.dtype) -> None:
    """Give an empty network its numbers, in memory of its own and in the types that it computes in."""
    network.load_state_dict({name: tensors[name].float() for name in network.state_dict()}, assign=True)
    network.eval().requires_grad_(False)
    set_precision(network, dtype)  # reads what is on the disk still
    for name, parameter in network.named_parameters():
        if parameter.data_ptr() == tensors[name].data_ptr():  # not copied yet: the file may change later
            parameter.data = parameter.data.clone()


def _is_finite(tensor: Tensor) -> bool:
    """Whether all numbers are. A finite sum proves it at little cost; but a sum of finite numbers can overflow."""
    return bool(tensor.sum().isfinite()) or bool(tensor.isfinite().all())


def _empty_network(config: SharpConfig) -> SharpNetwork:
    """Names and shapes without numbers."""
    with torch.device("meta"):
        return SharpNetwork(config)


def _shapes_of(network: SharpNetwork) -> Shapes:
    """What the checkpoint of a network holds, with what inference never uses."""
    used = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    return used | unused_shapes(network.config)


def _config_of(tensors: Mapping[str, Tensor]) -> SharpConfig:
    """The size whose positions a checkpoint has; the published one where none fits, for the message's sake."""
    name = "monodepth_model.monodepth_predictor.encoder.patch_encoder.cls_token"
    width = tensors[name].shape[-1] if name in tensors and tensors[name].ndim else None
    return next((config for config in CONFIGS.values() if config.embed == width), CONFIGS["full"])


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(map(plain_text, names[:NAMED])) + (f", and {more} more" if more > 0 else "")
