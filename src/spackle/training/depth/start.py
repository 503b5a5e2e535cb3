"""The weights that a run of the lite base starts from, and those that stay as they are."""

from __future__ import annotations

from pathlib import Path

import torch

from spackle.bases.lite.network import Block, LiteNet, Size, load_networks
from spackle.errors import InputError
from spackle.training.depth.encoder import load_encoder
from spackle.training.depth.recipe import RANDOM, LiteRecipe

EVEN = 10.0  # the standard deviation that features of the decoder are brought to where a run starts from another


def first_network(recipe: LiteRecipe) -> LiteNet:
    """A file's weights; else those that ImageNet taught, and a decoder by the run's seed.

    Raises:
        InputError: a file that is missing, or of another network.
    """
    if recipe.init is not None:
        return balanced(_network_of(recipe.init, recipe.network)).requires_grad_()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.run.seed)
        network = LiteNet(recipe.network)
    if recipe.encoder != RANDOM:
        network.encoder = load_encoder(recipe.network, recipe.encoder)
    return network


def _network_of(path: Path, size: Size) -> LiteNet:
    """The network of this size in a file, the first where there are several."""
    networks = load_networks(path, "a .safetensors file as init")
    for network in networks:
        if network.encoder.size == size:
            return network
    raise InputError(f"{path}: has no network of the size {size}: add network={networks[0].encoder.size}")


@torch.no_grad()
def balanced(network: LiteNet) -> LiteNet:
    """The same function by weights of even size, changed in place.

    Features of the decoder grow while it learns, and its last weights shrink, until a step of the optimiser is large
    beside them and the run diverges. Every level is linear but for ReLU, so a factor can go from one to the next.
    """
    spreads: list[float] = []
    hooks = [fuse.register_forward_hook(lambda *call: spreads.append(float(call[2].std()))) for fuse in network.fuse]
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
    """Let the encoder's stem and first stages stay as they are, and the depthwise convolutions of the others.

    Those are a sixteenth of its weights and would take two thirds of a step's time on a processor. All learns
    where `stages` is 0.
    """
    if stages:
        for part in (network.encoder.stem, *network.encoder.stages[:stages]):
            part.requires_grad_(False)
        for part in network.encoder.modules():
            if isinstance(part, Block):
                part.depthwise.requires_grad_(False)
    return network
