"""Published image metrics through pyiqa; the only file that imports pyiqa.

pyiqa is optional (pip install 'spackle-nvs[eval]'), and its licence forbids commercial use.
"""

from __future__ import annotations

import contextlib
import io
import socket
import warnings
from collections.abc import Callable, Iterator, Sequence
from types import ModuleType
from typing import Any, NoReturn

import torch
from torch import Tensor

from spackle.paper.evaluation.metrics import METRICS
from spackle.paper.evaluation.table import NOT_RUN
from spackle.runtime.errors import reason_in_a_line

LICENCE_NOTICE = (
    "pyiqa: PolyForm Noncommercial licence 1.0.0; several of its networks are for research only"
)
NOT_INSTALLED = "pyiqa is not installed: pip install 'spackle-nvs[eval]'"

# From an image and the true picture (or None), each [H, W, 3] sRGB 0..1, to a score.
Metric = Callable[[Tensor, Tensor | None], float]

PUBLISHED_METRICS = {
    name: metric for name, metric in METRICS.items() if metric.pyiqa_options is not None
}


def open_published_metrics(
    names: Sequence[str], device: str, download: bool
) -> tuple[dict[str, Metric], dict[str, str]]:
    """Load metrics of `PUBLISHED_METRICS`; a missing package or missing weights are no error.

    Args:
        names: the metrics to load; pyiqa is imported only if there are any.
        device: "cpu" or "cuda".
        download: whether pyiqa may download missing weights; if not, it cannot reach the network.

    Returns:
        metrics: the metrics that were loaded, by name.
        states: for each name pyiqa's version, or "not run" and the reason.
    """
    metrics: dict[str, Metric] = {}
    states: dict[str, str] = {}
    if not names:
        return metrics, states

    try:
        pyiqa = _import_pyiqa()
    except Exception as error:  # pyiqa needs torchvision, which may not match the installed torch
        # A missing package is usual, a broken one is not: the two need different advice.
        is_absent = isinstance(error, ModuleNotFoundError) and error.name == "pyiqa"
        if is_absent:
            reason = NOT_INSTALLED
        else:
            reason = f"pyiqa cannot be imported: {reason_in_a_line(error)}"
        return metrics, dict.fromkeys(names, f"{NOT_RUN}: {reason}")

    for name in names:
        try:
            metrics[name] = _load_metric(pyiqa, name, device, download)
            states[name] = f"pyiqa {pyiqa.__version__}"
        except Exception as error:  # a foreign package may raise anything; the report gets one line
            reason = f"pyiqa cannot load this metric: {reason_in_a_line(error)}"
            if not download:
                reason += " (`download_metrics` lets pyiqa fetch missing weights)"
            states[name] = f"{NOT_RUN}: {reason}"
    return metrics, states


def _import_pyiqa() -> ModuleType:
    """Import pyiqa without the lines that it and its dependencies print."""
    with _silenced():
        import pyiqa
    module: ModuleType = pyiqa
    return module


def _load_metric(pyiqa: ModuleType, name: str, device: str, download: bool) -> Metric:
    """Load one of pyiqa's metrics with the options in `PUBLISHED_METRICS`.

    Args:
        pyiqa: the imported package.
        name: the metric's name, here as in pyiqa.
        device: "cpu" or "cuda".
        download: whether missing weights may be fetched; if not, looking up a host name raises
            OSError.
    """
    # The network is blocked while the metric loads, which is when it fetches weights.
    with contextlib.ExitStack() as stack:
        stack.enter_context(_silenced())
        if not download:
            stack.enter_context(_without_network())
        options = PUBLISHED_METRICS[name].pyiqa_options or {}
        network = pyiqa.create_metric(name, device=torch.device(device), **options)
    return _metric_of_network(network)


def _metric_of_network(network: Callable[..., Any]) -> Metric:
    """A function that measures pictures [H, W, 3] with one of pyiqa's networks."""

    def measure(picture: Tensor, true_picture: Tensor | None = None) -> float:
        """The network's score for a picture, compared with the true one if given; it may be NaN."""
        pictures = [picture] if true_picture is None else [picture, true_picture]
        # Published metrics expect batches [1, 3, H, W] of numbers 0..1.
        batches = [image.clamp(0, 1).permute(2, 0, 1)[None].float() for image in pictures]

        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return float(network(*batches))

    return measure


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Drop what pyiqa and its dependencies print, log and warn in the block while they load."""
    dropped = io.StringIO()
    with (
        contextlib.redirect_stdout(dropped),
        contextlib.redirect_stderr(dropped),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _without_network() -> Iterator[None]:
    """Let every lookup of a host name in the block fail; each download begins with a lookup."""
    lookup = socket.getaddrinfo

    def refuse(*arguments: Any, **options: Any) -> NoReturn:
        """Stand in for `socket.getaddrinfo`; OSError is what a missing network raises, too."""
        raise OSError("weights are not on this machine")

    socket.getaddrinfo = refuse
    try:
        yield
    finally:
        socket.getaddrinfo = lookup
