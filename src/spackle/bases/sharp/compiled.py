"""SHARP's forward by `torch.compile`, and on a GPU as one CUDA graph."""

from __future__ import annotations

import copy
from typing import Protocol

import torch
from torch import Tensor

from spackle.bases.protocol import Progress
from spackle.bases.sharp.encoder import WINDOWS, TransformerBlock
from spackle.bases.sharp.network import DepthNetwork, InitialGaussians, SharpNetwork, SharpOutput

WARM_UPS = 2  # calls before a capture, in which libraries choose their kernels and take their workspaces


class Forward(Protocol):
    """`SharpNetwork.forward`, or what does the same."""

    def __call__(
        self, image: Tensor, disparity_factor: float, batch: int, progress: Progress | None = None
    ) -> SharpOutput: ...


def compile_forward(network: SharpNetwork, backend: str = "inductor") -> Forward:
    """The forward of a network, sharing its weights, that `torch.compile` translates when it is first asked.

    It takes a C++ compiler on a processor and Triton on a GPU; a RuntimeError at the first call says what is missing.
    All 48 blocks of the two transformers are one translation; values differ from the network's by rounding. The
    `backend` "eager" translates nothing.
    """
    twin = copy.deepcopy(network, {id(weight): weight for weight in network.parameters()})
    depth: DepthNetwork = twin.monodepth_model.monodepth_predictor  # type: ignore[assignment]
    blocks = [module for module in twin.modules() if isinstance(module, TransformerBlock)]
    for module in (*blocks, depth.decoder, depth.head, twin.feature_model):
        module.compile(backend=backend, dynamic=False)
    return GraphedForward(twin) if next(network.parameters()).device.type == "cuda" else twin


class GraphedForward:
    """A network's forward, captured once and replayed as one CUDA graph, by one thread at a time."""

    def __init__(self, network: SharpNetwork) -> None:
        self.network = network
        self.graph: torch.cuda.CUDAGraph | None = None

    def __call__(
        self, image: Tensor, disparity_factor: float, batch: int, progress: Progress | None = None
    ) -> SharpOutput:
        """As the network's, always with the batch of the first call; there is no progress to see but its end."""
        with torch.cuda.device(image.device):
            if self.graph is None:
                self._capture(image, batch)
            self.image.copy_(image)
            self.factor.fill_(disparity_factor)
            assert self.graph is not None
            self.graph.replay()
        if progress:
            progress(WINDOWS, WINDOWS)
        start = self.output.start  # the next replay writes over it
        kept = InitialGaussians(
            *(t.clone() for t in (start.disparity_map, start.disparity, start.color, start.unscale))
        )
        return SharpOutput(kept, self.output.deltas.clone())

    def _capture(self, image: Tensor, batch: int) -> None:
        self.image, self.factor = image.clone(), image.new_ones(())
        side = torch.cuda.Stream()  # type: ignore[no-untyped-call]
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(WARM_UPS):
                self.network(self.image, self.factor, batch)
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self.output: SharpOutput = self.network(self.image, self.factor, batch)
        self.graph = graph
