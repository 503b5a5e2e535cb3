"""A network's weights out of a safetensors file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from spackle.errors import InputError

Network = TypeVar("Network", bound=nn.Module)


def read_tensors(path: str | os.PathLike[str], what: str, otherwise: str) -> dict[str, Tensor]:
    """The tensors of a file by name; InputError where it is missing or broken.

    `what` says for messages whose weights they are, `otherwise` what to give in place of a missing file.
    """
    if not os.path.isfile(path):
        raise InputError(f"{what} weights {path} not found: give {otherwise}")
    try:
        tensors: dict[str, Tensor] = load_file(path)
    except (SafetensorError, OSError) as error:
        raise InputError(f"{what} weights {path} are not readable as safetensors: {error}") from error
    return tensors


def fill_network(network: Network, tensors: Mapping[str, Tensor], path: str | os.PathLike[str], what: str) -> Network:
    """The network with these weights, ready to be asked; half precision is widened to single.

    InputError for weights of another architecture; `path` and `what` are for its message.
    """
    expected = network.state_dict()
    wrong = sorted(name for name in expected.keys() & tensors.keys() if expected[name].shape != tensors[name].shape)
    wrong += sorted(expected.keys() ^ tensors.keys())
    if wrong:
        raise InputError(f"{what} weights {path} are of another network: {len(wrong)} tensors differ, e.g. {wrong[0]}")
    if endless := [name for name in expected if not bool(torch.isfinite(tensors[name]).all())]:
        raise InputError(f"{what} weights {path} hold numbers that are not finite, e.g. in {endless[0]}: take others")
    network.load_state_dict({name: tensor.to(torch.float32) for name, tensor in tensors.items()})
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it
    return network.eval().requires_grad_(False)
