"""Published quality metrics by way of pyiqa (optional: pip install 'spackle-nvs[eval]'; not for commercial use)."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import socket
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from spackle.errors import reason_in_a_line

NOTICE = "pyiqa: PolyForm Noncommercial licence 1.0.0; several of the networks that it fetches are for research only"
NOT_INSTALLED = "pyiqa is not installed: pip install 'spackle-nvs[eval]'"

Metric = Callable[[Tensor, Tensor | None], float]  # (picture, truth), [H, W, 3] sRGB 0..1 each, to a score


@dataclasses.dataclass(frozen=True)
class Definition:
    """Exactly which variant of a metric is meant."""

    call: str  # pyiqa's name of it
    says: str  # for the tables' captions
    options: tuple[tuple[str, Any], ...]  # pinned, whatever another release has for defaults


DEFINITIONS: dict[str, Definition] = {
    "clipiqa": Definition(
        "clipiqa",
        "CLIP RN50 without positional embedding at the picture's own size; mean over the prompt pairs Good/bad image, "
        "Sharp/blurry image, sharp/blurry edges, High/low resolution image, Noise-free/noisy image",
        (("model_type", "clipiqa"), ("backbone", "RN50"), ("pos_embedding", False)),
    ),
    "niqe": Definition(
        "niqe",
        "on the float render, of which pyiqa rounds the luma (YIQ) to 0..255; blocks of 96×96, "
        "the pristine model of the authors' release",
        (("test_y_channel", True),),
    ),
    "musiq": Definition(
        "musiq", "trained on KonIQ-10k; scales 224, 384 and the picture's own", (("pretrained", "koniq10k"),)
    ),
    "dists": Definition("dists", "VGG16 with the authors' weights, at the picture's own size", ()),
    "lpips": Definition(
        "lpips",
        "AlexNet, version 0.1, at the picture's own size (the paper does not say which network it took)",
        (("net", "alex"), ("version", "0.1")),
    ),
}


@dataclasses.dataclass(frozen=True)
class Opened:
    """The metrics that can run here, and why the others cannot."""

    metrics: dict[str, Metric]
    missing: dict[str, str]
    version: str | None  # pyiqa's


def open_metrics(names: Sequence[str], device: str, download: bool) -> Opened:
    """Load metrics by their names in `DEFINITIONS`; what is missing is no error.

    Args:
        names: which ones; none leaves pyiqa alone.
        device: "cpu" or "cuda".
        download: let pyiqa fetch weights that are not here; otherwise it is kept off the network while it looks.
    """
    metrics: dict[str, Metric] = {}
    missing: dict[str, str] = {}
    if not names:
        return Opened(metrics, missing, None)
    try:
        pyiqa = _import()
    except Exception as error:
        return Opened(metrics, {name: _why_not(error) for name in names}, None)
    for name in names:
        attempts: list[str] = []
        try:
            with _quiet(), contextlib.nullcontext() if download else _off_the_network(attempts):
                metrics[name] = _open(pyiqa, DEFINITIONS[name], device)
        except Exception as error:  # whatever a stranger's package raises is one line of the report
            missing[name] = (
                "weights: not on this machine (--download-metrics lets pyiqa fetch them)"
                if attempts
                else f"pyiqa cannot load it: {reason_in_a_line(error)}"
            )
    return Opened(metrics, missing, str(getattr(pyiqa, "__version__", "unknown")))


def _import() -> Any:
    with _quiet():
        import pyiqa
    return pyiqa


def _why_not(error: Exception) -> str:
    """torchvision, which pyiqa needs, raises RuntimeError where it is not the one of the installed torch."""
    if isinstance(error, ModuleNotFoundError) and error.name == "pyiqa":
        return NOT_INSTALLED
    return f"pyiqa cannot be imported: {reason_in_a_line(error)}"


def _open(pyiqa: Any, definition: Definition, device: str) -> Metric:
    """A metric that gives one number; NaN is passed on for the caller to count."""
    network = pyiqa.create_metric(definition.call, device=torch.device(device), **dict(definition.options))

    def measure(picture: Tensor, truth: Tensor | None = None) -> float:
        images = [image.clamp(0, 1).permute(2, 0, 1)[None].float() for image in (picture, truth) if image is not None]
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return float(network(*images))

    return measure


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """pyiqa and what it is made of print, log and warn while they load."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@contextlib.contextmanager
def _off_the_network(attempts: list[str]) -> Iterator[None]:
    """Refuse to look up any host, and note the attempts: every way to download begins with that."""
    lookup = socket.getaddrinfo

    def refuse(host: Any, *rest: Any, **more: Any) -> Any:
        attempts.append(str(host))
        raise OSError("no download without leave")

    socket.getaddrinfo = refuse
    try:
        yield
    finally:
        socket.getaddrinfo = lookup
