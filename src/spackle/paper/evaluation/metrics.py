"""Image metrics (metrics.json): our own, and published ones through pyiqa.

pyiqa is optional (pip install 'spackle-nvs[eval]'), and its licence forbids commercial use.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import socket
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spackle.core.filters import gaussian_blur, maximum_filter
from spackle.paper.evaluation.measurements import load_data
from spackle.paper.evaluation.table import NOT_RUN
from spackle.paper.training.losses import hole_psnr
from spackle.runtime.errors import reason_in_a_line

OWN = "own"
NOTICE = (
    "pyiqa: PolyForm Noncommercial licence 1.0.0; several of its networks are for research only"
)
NOT_INSTALLED = "pyiqa is not installed: pip install 'spackle-nvs[eval]'"
WINDOW, SIGMA = 11, 1.5  # SSIM's window, in pixels (Wang et al. 2004)
C1, C2 = 0.01**2, 0.03**2  # SSIM's constants K1 = 0.01, K2 = 0.03, for values in 0..1
GREY_WEIGHTS = torch.tensor([0.299, 0.587, 0.114])
INNER = 7  # side in pixels of the square around a pixel that must lie in the mask, for sharpness

Metric = Callable[
    [Tensor, Tensor | None], float
]  # from (image, truth), each [H, W, 3] sRGB 0..1, to a score


@dataclasses.dataclass(frozen=True)
class MetricFacts:
    """The description of a metric."""

    title: str  # with an arrow for the better direction
    definition: str  # the exact definition, for captions
    lower: bool  # whether lower is better
    digits: int = 4
    truth: bool = False  # whether it needs a true second view
    options: dict[str, Any] | None = (
        None  # for pyiqa, all explicit, because defaults may change; None: our own metric
    )

    def text(self, value: float) -> str:
        return f"{value:.{self.digits}f}"


METRICS = {name: MetricFacts(**facts) for name, facts in load_data("metrics.json").items()}
DEFINITIONS = {
    name: facts for name, facts in METRICS.items() if facts.options is not None
}  # pyiqa's metrics
DEFAULT_METRICS = {
    "large-view": [name for name, facts in METRICS.items() if not facts.truth],
    "near-view": [name for name, facts in METRICS.items() if facts.truth],
}


def metric_name(column: str) -> str | None:
    """The metric of a column such as "psnr", "psnr_hole" or "psnr_outside"; None for counts and shares."""
    name = column.partition("_")[0]
    return name if name in METRICS else None


def psnr(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """PSNR in dB, in float64, over the pixels of `mask` [H, W] (None: all); see `hole_psnr`. Higher is better."""
    everywhere = torch.ones(image.shape[:2], dtype=torch.bool)
    return hole_psnr(image.double(), truth.double(), everywhere if mask is None else mask)


def sharpness(image: Tensor, truth: Tensor, mask: Tensor) -> float:
    """Ratio of the mean gradient magnitude in grey to the truth's: 1 is as sharp as the truth, 0 has no detail.

    Counts pixels inside `mask` [H, W], at least 3 pixels from the mask's border; NaN if no pixel counts. `image` and
    `truth` are [H, W, 3] sRGB 0..1.
    """
    inner = ~maximum_filter(~mask, INNER // 2)
    ours, theirs = (
        torch.hypot(*torch.gradient(picture @ GREY_WEIGHTS))[inner].mean()
        for picture in (image, truth)
    )
    return float(ours / theirs)


def ssim_average(similarity: Tensor, mask: Tensor | None = None) -> float:
    """Average a map of structural similarity (Wang et al. 2004); 1 is equal, higher is better.

    Without a mask, pixels count if their window lies within the image, as published. With a mask, all pixels of the
    mask count, also at the image's border, because much of a hole is at the border.

    Args:
        similarity: [H, W, 3], from `ssim_map`.
        mask: [H, W] bool, the pixels that count.

    Returns:
        The average over pixels and channels; NaN if no pixel counts.
    """
    edge = WINDOW // 2
    return float((similarity[edge:-edge, edge:-edge] if mask is None else similarity[mask]).mean())


def ssim_map(image: Tensor, truth: Tensor) -> Tensor:
    """SSIM at each pixel and channel, [H, W, 3] float64, under a Gaussian window of 11 pixels with σ 1.5.

    At the border the image is mirrored to fill the window. `image` and `truth` are [H, W, 3] sRGB 0..1.
    """
    x, y = image.double(), truth.double()
    mean_x, mean_y, square_x, square_y, product = (
        _blur(moment) for moment in (x, y, x * x, y * y, x * y)
    )
    variance_x, variance_y = square_x - mean_x**2, square_y - mean_y**2
    covariance = product - mean_x * mean_y
    likeness = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    return likeness / ((mean_x**2 + mean_y**2 + C1) * (variance_x + variance_y + C2))


def _blur(image: Tensor) -> Tensor:
    reach = WINDOW // 2
    wide = np.pad(image.numpy(), ((reach, reach), (reach, reach), (0, 0)), "symmetric")
    return gaussian_blur(torch.from_numpy(wide), SIGMA)[reach:-reach, reach:-reach]


def open_metrics(
    names: Sequence[str], device: str, download: bool
) -> tuple[dict[str, Metric], dict[str, str]]:
    """Load metrics by their names in `DEFINITIONS`; a missing package or missing weights are no error.

    Args:
        names: metrics to load; pyiqa is imported only for a non-empty list.
        device: "cpu" or "cuda".
        download: let pyiqa download missing weights; if False, network access is blocked while pyiqa loads.

    Returns:
        The metrics that were loaded; and for each name pyiqa's version, or the reason why the metric is "not run".
    """
    metrics: dict[str, Metric] = {}
    states: dict[str, str] = {}
    if not names:
        return metrics, states
    try:
        with _quiet():
            import pyiqa
    except Exception as error:  # pyiqa needs torchvision, which may not match the installed torch
        absent = isinstance(error, ModuleNotFoundError) and error.name == "pyiqa"
        why = NOT_INSTALLED if absent else f"pyiqa cannot be imported: {reason_in_a_line(error)}"
        return metrics, dict.fromkeys(names, f"{NOT_RUN}: {why}")
    for name in names:
        try:
            with _quiet(), contextlib.nullcontext() if download else _off_the_network():
                network = pyiqa.create_metric(
                    name, device=torch.device(device), **(DEFINITIONS[name].options or {})
                )
            metrics[name], states[name] = _measure_by(network), f"pyiqa {pyiqa.__version__}"
        except Exception as error:  # a foreign package may raise anything; the report gets one line
            why = f"pyiqa cannot load this metric: {reason_in_a_line(error)}"
            if not download:
                why += " (--download-metrics lets pyiqa fetch missing weights)"
            states[name] = f"{NOT_RUN}: {why}"
    return metrics, states


def _measure_by(network: Callable[..., Any]) -> Metric:
    """Make a metric from a pyiqa network; the metric gives one number, possibly NaN."""

    def measure(picture: Tensor, truth: Tensor | None = None) -> float:
        images = [
            image.clamp(0, 1).permute(2, 0, 1)[None].float()
            for image in (picture, truth)
            if image is not None
        ]
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return float(network(*images))

    return measure


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress what pyiqa and its dependencies print, log and warn while they load."""
    output = io.StringIO()
    with (
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _off_the_network() -> Iterator[None]:
    """Block lookups of host names, with which every download begins."""
    lookup = socket.getaddrinfo

    def refuse(*given: Any, **more: Any) -> Any:
        raise OSError("weights are not on this machine")

    socket.getaddrinfo = refuse
    try:
        yield
    finally:
        socket.getaddrinfo = lookup
