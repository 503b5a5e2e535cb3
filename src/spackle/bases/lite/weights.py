"""The weights of the lite base in a file: of one network or of several that are asked together."""

from __future__ import annotations

import os

from torch import Tensor

from spackle.bases.lite.network import STAGES, LiteNet
from spackle.errors import InputError
from spackle.network_file import fill_network, read_tensors

SCALE = "/scale"  # behind the name of weights in eight bits: what one step of them is, for each output
LAST = f"encoder.stages.{len(STAGES['lite2']) - 1}.0.project.bias"  # its length tells the sizes of networks apart


def load_networks(path: str | os.PathLike[str], otherwise: str = "a .safetensors file") -> list[LiteNet]:
    """The networks of a file, ready to be asked, with weights in single precision.

    Args:
        path: a file of `spackle.training.depth.export`, or the plain tensors of one network.
        otherwise: for messages: what to give in place of a file that is missing.

    Raises:
        InputError: a missing or broken file, or weights of another architecture.
    """
    tensors = _unpacked(read_tensors(path, "lite", otherwise))
    if LAST in tensors:
        return [_network(tensors, path)]
    parts: dict[str, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        number, _, rest = name.partition(".")
        parts.setdefault(number, {})[rest] = tensor
    numbers = sorted(parts, key=lambda number: (len(number), number))
    return [_network(parts[number], path) for number in numbers] or [_network({}, path)]


def _network(tensors: dict[str, Tensor], path: str | os.PathLike[str]) -> LiteNet:
    last = tensors.get(LAST)
    for size, stages in STAGES.items():
        if last is not None and last.shape == (stages[-1][-1],):
            return fill_network(LiteNet(size), tensors, path, "lite")
    raise InputError(f"lite weights {path} are of another network: {LAST} is missing or of another length")


def _unpacked(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """All tensors as floats; steps without a scale that fits are left out, and what they are for is then missing."""
    values: dict[str, Tensor] = {}
    for name, tensor in tensors.items():
        scale = tensors.get(name + SCALE)
        if tensor.is_floating_point() and not name.endswith(SCALE):
            values[name] = tensor
        elif scale is not None and tensor.dim() == 4 and scale.shape == tensor.shape[:1]:
            values[name] = tensor.float() * scale[:, None, None, None]
    return values
