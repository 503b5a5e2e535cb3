"""Weights of the residual network, as safetensors."""

from __future__ import annotations

import functools
import os
from pathlib import Path

from spackle.network_file import read_network
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
    return read_network(ResidualNet(), path, "residual", "a .safetensors file, 'seeds' or 'none'")
