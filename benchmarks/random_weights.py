"""Make random weights in SHARP's or LaMa's shapes, the same each time, to try all commands without
a download:

    python benchmarks/random_weights.py sharp.pt     # 702 M numbers, as published
    python benchmarks/random_weights.py tiny.safetensors --size tiny      # or micro, or lama

Scenes that these weights make are meaningless.
"""

from __future__ import annotations

import argparse
import sys
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor

from spackle.bases.sharp.base import expected_shapes as sharp_shapes
from spackle.bases.sharp.encoder import SIZES
from spackle.cli.script_command import run_script
from spackle.inpaint.lama_network import expected_shapes as lama_shapes
from spackle.runtime.files import check_writable


def deterministic_weights(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """A state dict [name → float32 tensor] whose values depend only on names and shapes.

    Signals in the network neither die nor explode, and the Gaussians fill the picture.
    """

    def made(
        name: str, shape: tuple[int, ...]
    ) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
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
        return 1 + np.float32(0.1) * x if name.endswith("weight") else np.float32(0.02) * x

    return {name: torch.from_numpy(made(name, shape)) for name, shape in shapes.items()}


def lama_weights(*size: int) -> dict[str, Tensor]:
    """`deterministic_weights` for LaMa's generator, of the given width and depth if any; variances
    are around one.
    """
    made = deterministic_weights(lama_shapes(*size))
    return {
        name: 1 + 5 * x.abs() if name.endswith("running_var") else x for name, x in made.items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", type=Path, help="a name that ends in .pt or .safetensors")
    parser.add_argument("--size", choices=("full", "tiny", "micro", "lama"), default="full")
    words = parser.parse_args()
    check_writable(words.file)
    lama = words.size == "lama"
    tensors = lama_weights() if lama else deterministic_weights(sharp_shapes(SIZES[words.size]))
    (torch.save if words.file.suffix == ".pt" else save_file)(tensors, words.file)


if __name__ == "__main__":
    sys.exit(run_script(main))
