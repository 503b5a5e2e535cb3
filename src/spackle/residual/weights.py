"""Weights of the residual network, as safetensors."""

from __future__ import annotations

import functools
import os
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from spackle.errors import InputError
from spackle.residual.network import ResidualNet

SHIPPED = Path(__file__).parent.parent / "weights" / "residual.safetensors"


@functools.cache
def shipped_network() -> ResidualNet | None:
    """The network with the weights that come with the package; None where a build has none."""
    return load_residual(SHIPPED) if SHIPPED.is_file() else None


def load_residual(path: str | os.PathLike[str]) -> ResidualNet:
    """Read a network; half precision is widened to single.

    Raises:
        InputError: a missing or broken file, or weights of another architecture.
    """
    if not os.path.isfile(path):
        raise InputError(f"residual weights {path} not found: give a .safetensors file, 'seeds' or 'none'")
    try:
        tensors = load_file(path)
    except (SafetensorError, OSError) as error:
        raise InputError(f"residual weights {path} are not readable as safetensors: {error}") from error
    network = ResidualNet()
    expected = network.state_dict()
    wrong = sorted(name for name in expected.keys() & tensors.keys() if expected[name].shape != tensors[name].shape)
    wrong += sorted(expected.keys() ^ tensors.keys())
    if wrong:
        raise InputError(
            f"residual weights {path} are of another network: {len(wrong)} tensors differ, e.g. {wrong[0]}"
        )
    network.load_state_dict({name: tensor.to(torch.float32) for name, tensor in tensors.items()})
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it
    return network.eval().requires_grad_(False)
