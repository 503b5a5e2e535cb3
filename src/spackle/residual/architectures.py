"""Residual networks by their names: make an untrained one, or read one from a file of weights."""

from __future__ import annotations

import functools
import os
import sys
from pathlib import Path

from spackle.residual.network import ResidualNet
from spackle.runtime.errors import InputError, printable_line
from spackle.runtime.plugins import is_plugin, load_plugin
from spackle.weights.checkpoints import load_strict, read_metadata, read_tensors, to_channels_last

# The built-in networks. To add one, write a `ResidualNet` and add a line.
ARCHITECTURES = {
    "unet": "spackle.scene_fill.unet:UNet",  # the shipped network
    "sharp-decoder": "spackle.residual.sharp_decoder:SharpDecoder",  # the paper's
}
SHIPPED = Path(__file__).parent.parent / "weights" / "residual.safetensors"
ARCHITECTURE_KEY = "spackle.residual"  # in a file's metadata: the architecture's name
ARCHITECTURE_OF_OLD_FILES = "unet"  # files without this key are older than the second architecture
RESIDUAL_ADVICE = "give the residual's weights, 'initial' or 'none'"
MAX_NAME_IN_MESSAGE = 60  # characters; the name comes from a stranger's file


def network_class(name: str, option: str = "network") -> type[ResidualNet]:
    """The class of a network, by its name in `ARCHITECTURES`, or as "package.module:Class" of
    another package.

    InputError, which names the `option`, if there is no such network. The module is imported, which
    runs its code.
    """
    path = ARCHITECTURES.get(name, name)  # "package.module:Class"
    plugin = load_plugin(path, option)
    if not (isinstance(plugin, type) and issubclass(plugin, ResidualNet)):
        raise InputError(f"`{option}` {name}: not a subclass of spackle.residual.ResidualNet")
    return plugin


def open_residual(name: str) -> ResidualNet:
    """An untrained network, by its name in `ARCHITECTURES` or as "package.module:Class"."""
    network = network_class(name)()
    to_channels_last(network)
    return network


@functools.cache
def shipped_network() -> ResidualNet | None:
    """The network with the weights in the package; None if this build has no weights."""
    return load_residual(SHIPPED) if SHIPPED.is_file() else None


def load_residual(path: str | os.PathLike[str]) -> ResidualNet:
    """Read a residual network from a file of weights, whose metadata name the network's class.

    A network of another package is accepted only if its module was imported before, because a file
    must not choose which code runs.

    InputError if the file is missing or broken, or if no such network is known.
    """
    advice = RESIDUAL_ADVICE
    tensors = read_tensors(path, advice)
    # Files that name no class were written when there was only one.
    name = read_metadata(path, ARCHITECTURE_KEY) or ARCHITECTURE_OF_OLD_FILES

    # The name of another package's network has the form "package.module:Class".
    module, _, class_name = name.partition(":")
    is_imported = module in sys.modules and class_name.isidentifier()
    if name not in ARCHITECTURES and not is_imported:
        short_name = printable_line(name)[:MAX_NAME_IN_MESSAGE]
        if is_plugin(name):
            raise InputError(
                f"{path}: weights of the network {short_name} of another package: if you trust "
                f"its code, add `residual_network` {short_name}"
            )
        raise InputError(f"{path}: unknown architecture {short_name}: {advice}")
    network = network_class(name).untrained_for(tensors)
    return load_strict(network, tensors, path, advice, prepare=to_channels_last)
