"""Residual networks by their names: make an untrained one, or read one from a file of weights."""

from __future__ import annotations

import functools
import os
import sys
from pathlib import Path

from spackle.residual.network import ResidualNet
from spackle.runtime.errors import InputError, printable_line
from spackle.runtime.plugins import load_plugin
from spackle.weights.checkpoints import load_strict, read_metadata, read_tensors, to_channels_last

# The built-in networks. To add one, write a `ResidualNet` and add a line.
ARCHITECTURES = {
    "unet": "spackle.scene_fill.unet:UNet",  # the shipped network
    "sharp-decoder": "spackle.residual.sharp_decoder:SharpDecoder",  # the paper's
}
SHIPPED = Path(__file__).parent.parent / "weights" / "residual.safetensors"
NOTE = "spackle.residual"  # the metadata key of the architecture's name in a file of weights
NAME_WITHOUT_NOTE = "unet"  # a file without this key is older than the second architecture
MAX_NAME_IN_MESSAGE = 60  # characters; the name comes from a stranger's file


def network_class(name: str) -> type[ResidualNet]:
    """The class of a network, by its name in `ARCHITECTURES`, or as "package.module:Class" of
    another package.

    InputError if there is no such network. The module is imported, which runs its code.
    """
    found = load_plugin(ARCHITECTURES.get(name, name), "network")
    if not (isinstance(found, type) and issubclass(found, ResidualNet)):
        raise InputError(f"`network` {name}: not a subclass of spackle.residual.ResidualNet")
    return found


def open_residual(name: str) -> ResidualNet:
    """An untrained network, by its name in `ARCHITECTURES` or as "package.module:Class"."""
    return network_class(name)()


@functools.cache
def shipped_network() -> ResidualNet | None:
    """The network with the weights in the package; None if this build has no weights."""
    return load_residual(SHIPPED) if SHIPPED.is_file() else None


def load_residual(path: str | os.PathLike[str]) -> ResidualNet:
    """Read a network; InputError if the file is missing or broken, or holds another network.

    A network of another package is accepted only if its module was imported before, because a file
    must not choose which code runs.
    """
    advice = "give the residual's weights, 'initial' or 'none'"
    tensors = read_tensors(path, advice)
    name = read_metadata(path, NOTE) or NAME_WITHOUT_NOTE

    # "package.module:Class", for a network of another package.
    module, _, class_name = name.partition(":")
    is_imported = module in sys.modules and class_name.isidentifier()
    if name not in ARCHITECTURES and not is_imported:
        shown = printable_line(name)[:MAX_NAME_IN_MESSAGE]
        raise InputError(f"{path}: unknown architecture {shown}: {advice}")
    network = network_class(name).untrained_for(tensors)

    # Convolutions are faster on a CPU if the channels of a pixel are neighbours in memory.
    return load_strict(network, tensors, path, advice, prepare=to_channels_last)
