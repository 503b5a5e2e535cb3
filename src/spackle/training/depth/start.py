"""The weights that a run of the lite base starts from, and those that stay as they are."""

from __future__ import annotations

import torch

from spackle.bases.lite.network import Block, LiteNet
from spackle.network_file import read_network
from spackle.training.depth.encoder import load_encoder
from spackle.training.depth.recipe import RANDOM, LiteRecipe


def first_network(recipe: LiteRecipe) -> LiteNet:
    """A file's weights; else those that ImageNet taught, and a decoder by the run's seed.

    Raises:
        InputError: a file that is missing, or of another network.
    """
    if recipe.init is not None:
        return read_network(LiteNet(), recipe.init, "lite", "a .safetensors file as init").requires_grad_()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.run.seed)
        network = LiteNet()
    if recipe.encoder != RANDOM:
        network.encoder = load_encoder(recipe.encoder)
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
