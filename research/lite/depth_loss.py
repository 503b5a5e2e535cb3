"""The loss of predicted inverse depth (up to a factor, up to scale and shift, and of its
differences) and its score.

The score aligns a relative inverse depth to the truth by the best scale and shift; a guess without
photo is a baseline.
"""

from __future__ import annotations

import dataclasses

import torch
from frames import Frame
from mixture import DepthBatch
from torch import Tensor, nn
from torch.nn.functional import interpolate

from spackle.bases.lite import network_size
from spackle.paper.training.recipe import NonNegative, RecipePart

FARTHEST = 0.02  # part of the median inverse depth: farther surfaces, mostly sky, get this value
NEAREST = 20.0
# larger errors in log inverse depth are reduced to this: they are mostly errors of the true depth
AT_MOST = 2.0
STEEPEST = 1.0  # upper bound for errors of differences between neighbours
SCALES = (1, 2, 4, 8)  # strides between neighbours in the loss term steps


class DepthLossWeights(RecipePart):
    """The weights of the loss's terms."""

    factor: NonNegative = 1.0
    line: NonNegative = 1.0
    steps: NonNegative = 0.5
    offset: NonNegative = 0.1  # without it features grow until they overflow half precision


def depth_loss(
    predicted: Tensor, truth: Tensor, valid: Tensor, weights: DepthLossWeights
) -> tuple[Tensor, dict[str, Tensor]]:
    """The loss [], and its terms [] unweighted, as means over the pictures.

    Let t be the true inverse depth over its median, and e = predicted − log t, from which its own
    median is subtracted. factor is mean |e|. line is mean |a·exp(predicted) + b − t| / (t + 0.2)
    with the least-squares a ≥ 0 and b, similar to MiDaS (Ranftl et al. 2020). steps is the sum over
    `SCALES` of mean |∂e/∂x| + |∂e/∂y|. offset is the absolute value of the subtracted median, which
    the other terms do not depend on.

    Args:
        predicted: [B, H, W] log inverse depth.
        truth: [B, H, W] inverse depth in any unit, 0 for infinitely far.
        valid: [B, H, W] bool, where the truth is known.
        weights: the weights of the terms.
    """
    mask = valid.to(predicted.dtype)
    truth = (truth / _median(truth, valid & (truth > 0)).clamp_min(1e-6)).clamp(FARTHEST, NEAREST)
    error = predicted - truth.log()
    offset = _median(error, valid)
    middle = offset.detach()
    error = error - middle
    terms = {
        "factor": _mean(error.abs().clamp_max(AT_MOST), mask).mean(),
        "line": _line(predicted - middle, truth, mask).mean(),
        "steps": _steps(error, mask).mean(),
        "offset": offset.where(valid.any(2).any(1)[:, None, None], 0.0).abs().mean(),
    }
    total = (
        weights.factor * terms["factor"]
        + weights.line * terms["line"]
        + weights.steps * terms["steps"]
    )
    total = total + weights.offset * terms["offset"]
    return total, {name: term.detach() for name, term in terms.items()}


def _line(predicted: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    """[B] the term line: the error of the inverse depth after the best scale and shift."""
    inverse = predicted.clamp(-8, 4).exp()
    count = mask.sum((1, 2)).clamp_min(1)

    def mean(x: Tensor) -> Tensor:
        return ((mask * x).sum((1, 2)) / count)[:, None, None]

    p, t = inverse - mean(inverse), truth - mean(truth)
    scale = (mean(p * t) / (mean(p * p) + 1e-3)).clamp_min(0)
    return _mean((scale * p - t).abs() / (truth + 0.2), mask)


def _steps(error: Tensor, mask: Tensor) -> Tensor:
    """[B] the term steps: errors of the differences between neighbours, at several strides."""
    total = error.new_zeros(len(error))
    for stride in SCALES:
        e, m = error[:, ::stride, ::stride], mask[:, ::stride, ::stride]
        for axis in (1, 2):
            n = e.shape[axis] - 1
            both = m.narrow(axis, 1, n) * m.narrow(axis, 0, n)
            step = (e.narrow(axis, 1, n) - e.narrow(axis, 0, n)).abs().clamp_max(STEEPEST)
            total = total + (step * both).sum((1, 2)) / m.sum((1, 2)).clamp_min(1)
    return total


def _mean(x: Tensor, mask: Tensor) -> Tensor:
    return (x * mask).sum((1, 2)) / mask.sum((1, 2)).clamp_min(1)


def _median(x: Tensor, valid: Tensor) -> Tensor:
    """[B, 1, 1] the median of an image's valid values; 1 if there are none."""
    values = [
        one[known].median() if bool(known.any()) else one.new_ones(())
        for one, known in zip(x, valid, strict=True)
    ]
    return torch.stack(values)[:, None, None]


# Surfaces farther than this multiple of the median depth do not count. A camera's step moves them
# by less than a tenth of what it moves the picture's middle; the horizon of a street, 60 times the
# median, would decide the mean of all errors. No photo with measured depth has any.
FARTHEST_COUNTED = 10.0
FARTHEST_FACTOR = 2.0  # upper bound of an aligned depth, as multiple of the farthest true depth


@dataclasses.dataclass(frozen=True)
class DepthScore:
    """The score of one picture."""

    abs_rel: float  # mean |z − z*| / z*
    delta: float  # share of pixels with max(z/z*, z*/z) < 1.25


def score_depth(inverse_depth: Tensor, depth: Tensor, valid: Tensor) -> DepthScore:
    """Align an inverse depth to the truth by least squares in inverse depth, then compare depths.

    Surfaces beyond `FARTHEST_COUNTED` times the median depth do not count.

    Args:
        inverse_depth: [H, W] up to scale and shift.
        depth: [H, W] true z in any unit.
        valid: [H, W] bool, where the true depth is known.
    """
    counted = valid & (depth < FARTHEST_COUNTED * depth[valid].median())
    true = 1 / depth[counted].double()
    found = align(inverse_depth[counted].double(), true).clamp_min(true.min() / FARTHEST_FACTOR)
    ratio = true / found  # of the aligned depth to the true depth
    within = torch.maximum(ratio, 1 / ratio) < 1.25
    return DepthScore(float((ratio - 1).abs().mean()), float(within.double().mean()))


def align(values: Tensor, true: Tensor) -> Tensor:
    """[N] a·values + b with the least-squares distance to `true` [N]; the mean of `true` if all
    values are equal.
    """
    scale, shift = scale_and_shift(values, true)
    return scale * values + shift


def scale_and_shift(values: Tensor, true: Tensor) -> tuple[Tensor, Tensor]:
    """[] a and [] b of the a·values + b with the least-squares distance to `true`, both [N]; a is 0
    if all values are equal.
    """
    v, t = values - values.mean(), true - true.mean()
    spread = (v * v).sum()
    scale = (
        (v * t).sum() / spread
        if spread > 1e-12 * len(v) * values.abs().max() ** 2
        else v.new_zeros(())
    )
    return scale, true.mean() - scale * values.mean()


def vertical_ramp(height: int, width: int) -> Tensor:
    """[H, W] a guess without photo: lower pixels are nearer."""
    return (torch.arange(height) + 0.5)[:, None].expand(height, width)


MEASURES = ("abs_rel", "delta", "ramp_abs_rel", "loss", "factor", "line", "steps", "offset")


@dataclasses.dataclass(frozen=True)
class DepthJudge:
    """Computes loss and scores of a network."""

    weights: DepthLossWeights
    pixels: int  # approximate number of pixels to which validation frames are resized
    precision: torch.dtype
    device: torch.device  # of the network

    def total(self, network: nn.Module, batch: DepthBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] with gradients, and its terms [] unweighted."""
        predicted = self._run(network, batch.rgb)
        truth, valid = batch.inverse_depth.to(self.device), batch.valid.to(self.device)
        return depth_loss(predicted, truth, valid, self.weights)

    @torch.no_grad()
    def measure(self, network: nn.Module, frame: Frame) -> dict[str, float]:
        """`MEASURES` of a frame: scores at the frame's size, the loss at the network's output
        size.
        """
        batch = self._batch(frame)
        predicted = self._run(network, batch.rgb)
        truth, valid = batch.inverse_depth.to(self.device), batch.valid.to(self.device)
        loss, terms = depth_loss(predicted, truth, valid, self.weights)
        depth = 1 / frame.inverse_depth.where(frame.valid, 1.0)
        score = score_depth(_at_size_of(frame, predicted), depth, frame.valid)
        ramp = score_depth(vertical_ramp(*depth.shape), depth, frame.valid)
        scores = {
            "abs_rel": score.abs_rel,
            "delta": score.delta,
            "ramp_abs_rel": ramp.abs_rel,
            "loss": float(loss),
        }
        return {**scores, **{name: float(term) for name, term in terms.items()}}

    @torch.no_grad()
    def predict(self, network: nn.Module, frame: Frame) -> Tensor:
        """[H, W] inverse depth up to a factor, at the frame's size."""
        return _at_size_of(frame, self._run(network, self._batch(frame).rgb))

    def _run(self, network: nn.Module, rgb: Tensor) -> Tensor:
        picture = rgb.to(self.device).contiguous(memory_format=torch.channels_last)
        with torch.autocast(
            self.device.type, self.precision, enabled=self.precision != torch.float32
        ):
            predicted: Tensor = network(picture)
        return predicted.float()

    def _batch(self, frame: Frame) -> DepthBatch:
        """A frame at the size that the network gets."""
        height, width = frame.inverse_depth.shape
        return DepthBatch.of([frame], network_size(height, width, self.pixels))


def _at_size_of(frame: Frame, predicted: Tensor) -> Tensor:
    """[H, W] inverse depth at a frame's size, from log inverse depth [1, h, w]."""
    size = frame.inverse_depth.shape
    return interpolate(predicted.exp()[None], size=size, mode="bilinear", align_corners=False)[
        0, 0
    ].cpu()
