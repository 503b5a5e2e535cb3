"""How good a network is on frames that it has not learned from, beside a guess that needs no photo."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases.lite.base import network_size
from spackle.training.depth.augment import Frame
from spackle.training.depth.losses import DepthLossWeights, depth_loss
from spackle.training.depth.mixture import DepthBatch
from spackle.training.depth.score import score_depth, vertical_ramp

MEASURES = ("abs_rel", "delta", "ramp_abs_rel", "loss", "factor", "line", "steps", "offset")


@dataclasses.dataclass(frozen=True)
class DepthJudge:
    """What the loss needs besides a batch."""

    weights: DepthLossWeights
    pixels: int  # of what the network sees of a judged frame, nearly
    precision: torch.dtype
    device: torch.device  # of the network

    def total(self, network: nn.Module, batch: DepthBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] with gradients, and its terms [] unweighted."""
        predicted = self._run(network, batch.rgb)
        truth, valid = batch.inverse_depth.to(self.device), batch.valid.to(self.device)
        return depth_loss(predicted, truth, valid, self.weights)

    @torch.no_grad()
    def measure(self, network: nn.Module, frame: Frame) -> dict[str, float]:
        """`MEASURES` of a frame: scores at its own size, the loss at the network's."""
        batch = self._batch(frame)
        predicted = self._run(network, batch.rgb)
        truth, valid = batch.inverse_depth.to(self.device), batch.valid.to(self.device)
        loss, terms = depth_loss(predicted, truth, valid, self.weights)
        depth = 1 / frame.inverse_depth.where(frame.valid, 1.0)
        score = score_depth(_at_size_of(frame, predicted), depth, frame.valid)
        ramp = score_depth(vertical_ramp(*depth.shape), depth, frame.valid)
        scores = {"abs_rel": score.abs_rel, "delta": score.delta, "ramp_abs_rel": ramp.abs_rel, "loss": float(loss)}
        return {**scores, **{name: float(term) for name, term in terms.items()}}

    @torch.no_grad()
    def predict(self, network: nn.Module, frame: Frame) -> Tensor:
        """[H, W] inverse depth up to a factor, at the frame's size."""
        return _at_size_of(frame, self._run(network, self._batch(frame).rgb))

    def _run(self, network: nn.Module, rgb: Tensor) -> Tensor:
        picture = rgb.to(self.device).contiguous(memory_format=torch.channels_last)
        with torch.autocast(self.device.type, self.precision, enabled=self.precision != torch.float32):
            predicted: Tensor = network(picture)
        return predicted.float()

    def _batch(self, frame: Frame) -> DepthBatch:
        """A frame at the size that the network sees."""
        height, width = frame.inverse_depth.shape
        return DepthBatch.of([frame], network_size(height, width, self.pixels))


def _at_size_of(frame: Frame, predicted: Tensor) -> Tensor:
    """[H, W] inverse depth from its logarithm [1, h, w]."""
    size = frame.inverse_depth.shape
    return interpolate(predicted.exp()[None], size=size, mode="bilinear", align_corners=False)[0, 0].cpu()
