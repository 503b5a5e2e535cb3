"""The options of `spackle evaluate` and `spackle bench`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch

from spackle.bases.settings import BaseSettings
from spackle.core.photo import MAX_WORKING_SIDE_PX
from spackle.core.trajectories import MAX_DISPARITY
from spackle.inpaint import inpainter_class
from spackle.paper.evaluation.case import SecondViews
from spackle.paper.evaluation.datasets import find_dataset
from spackle.paper.evaluation.method_descriptions import METHODS
from spackle.paper.evaluation.metrics import METRICS
from spackle.paper.evaluation.paper_numbers import PAPER_DISPARITIES
from spackle.pipeline import FillOptions
from spackle.runtime.device import pick_device
from spackle.runtime.errors import InputError, check_name
from spackle.runtime.plugins import check_name_or_plugin, is_plugin, load_function

Protocol = Literal["large-view", "near-view"]

# Long side of the paper's large views. That it is not 1536, as of near views, follows from the
# paper's counts of added Gaussians: they are (1280 / 1536)² of the masked cells that views of
# 1536 would have.
LARGE_VIEW_SIDE_PX = 1280

PAPER_BASE = BaseSettings(name="sharp")
DEFAULT_METHODS = ("base", "paper-initial", "paper", "spackle")
TIMED_METHODS = ("paper", "spackle")  # the methods that `spackle bench` times


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """The options of `spackle evaluate`.

    A method is one way to render new views of a photo; the base is the network (or depth map)
    that turns the photo into Gaussians, from which all methods start. Some methods add Gaussians
    with the residual network.
    """

    dataset: str  # a key of `DATASETS`, or `package.module:NAME`
    root: Path  # the folder of the unpacked dataset
    # "large-view": camera moves to the left and right; "near-view": viewpoints of second photos.
    protocol: Protocol = "large-view"
    # Keys of `METHODS`, or `package.module:Name` for a function of (cameras, context) that returns
    # a function like those in methods.py.
    methods: Sequence[str] = DEFAULT_METHODS
    disparities: Sequence[float] = PAPER_DISPARITIES  # sizes of the camera moves of large views
    metrics: Sequence[str] | None = None  # keys of `METRICS`; None: all of the protocol
    base: BaseSettings = PAPER_BASE  # precision and device also apply to the residual network
    residual: str | None = (
        None  # a file of weights, or "initial"; None: the shipped weights, if any
    )
    # The network's class, `package.module:Class`, if `residual` has weights of another package's.
    residual_network: str | None = None
    direct_ft: Path | None = None  # weights of the method direct-ft
    # Weights of the residual network for the method dense, which should be trained with Gaussians
    # in all cells; None: those of `residual`.
    dense_residual: Path | None = None
    inpainter: str = "opencv"  # of the method inpaint2d
    # SqueezeNet's weights, for the metric distance; None: the downloaded ones, if any.
    features: Path | None = None
    # Which second photos of a case near views use; "auto" is the dataset's own choice.
    second_views: SecondViews | Literal["auto"] = "auto"
    # Long side of the views, in pixels; None: the paper's, 1280 for large views, 1536 for near
    # ones.
    side: int | None = None
    limit: int | None = None  # the number of images, spread over the dataset; None: all
    download_metrics: bool = False  # whether pyiqa may fetch the weights of metrics
    workers: int | None = None  # processes that share the images; None: one a GPU, or one
    threads: int | None = None  # of each process; None: the cores, shared evenly
    ray: str | None = None  # address of a Ray cluster, whose machines measure the images

    @property
    def fill(self) -> FillOptions:
        """The residual network, as options of the fill, which load it."""
        return FillOptions(residual=self.residual, residual_network=self.residual_network)

    @property
    def plugin_names(self) -> dict[str, str]:
        """The names of code that may be of other packages, each under a different option."""
        names = {
            "dataset": self.dataset,
            "inpainter": self.inpainter,
            "residual_network": self.residual_network or "",
        }
        return names | {f"methods {method}": method for method in self.methods}

    @property
    def compares_with_photos(self) -> bool:
        """Whether the views are at the viewpoints of second photos, and are compared with these."""
        return self.protocol == "near-view"

    @property
    def chosen_second_views(self) -> SecondViews:
        """Which second photos of a case near views use, with "auto" decided by the dataset."""
        if self.second_views == "auto":
            return find_dataset(self.dataset).second_views
        return self.second_views

    @property
    def max_side(self) -> int:
        """The long side of the views, in pixels."""
        if self.side is not None:
            return self.side
        return MAX_WORKING_SIDE_PX if self.compares_with_photos else LARGE_VIEW_SIDE_PX

    @property
    def device(self) -> torch.device:
        """The device of networks."""
        name = None if self.base.device == "auto" else self.base.device
        return pick_device(name)

    @property
    def settings_of_base(self) -> BaseSettings:
        """The base's settings; if the base has no network, its precision is set back to "auto".

        The chosen precision then applies to the residual network alone: a base without a network
        would refuse any other value than "auto".
        """
        lacks_precision = self.base.resolved_name in ("rgbd", "lite")
        if lacks_precision:
            return dataclasses.replace(self.base, precision="auto")
        return self.base

    def check(self) -> None:
        """Raise an InputError if an option cannot be used; the dataset's files are not read."""
        find_dataset(self.dataset)
        self._check_methods()
        inpainter_class(self.inpainter)  # fails for an unknown name
        self._check_metrics()
        # The base "auto" is refused: it depends on what is installed, and results with different
        # bases cannot be compared.
        self.settings_of_base.check(allow_auto=False)
        if self.residual == "none":
            raise InputError("`residual` none: leaves the holes open: give `methods` base instead")
        self._check_disparities()

    def _check_methods(self) -> None:
        """Raise an InputError if a method is unknown, or lacks its weights."""
        if not self.methods:
            raise InputError(f"`methods`: none is given: choose from {', '.join(METHODS)}")
        for method in self.methods:
            check_name_or_plugin("methods", method, METHODS)
            if is_plugin(method):
                load_function(method, "methods")

        if self.dense_residual is not None and "dense" not in self.methods:
            raise InputError(
                f"`dense_residual` {self.dense_residual}: weights of the method dense, which is "
                "not among the `methods`: add it, or leave the weights out"
            )

        # Direct FT trains SHARP's own weights, so no other base has such a file.
        has_tuned_base = self.base.name == "sharp" and self.direct_ft is not None
        if "direct-ft" in self.methods and not has_tuned_base:
            raise InputError(
                "`methods` direct-ft: is SHARP after further training: add `base` sharp, and "
                "`direct_ft` FILE with the weights of `spackle train` for the method direct-ft"
            )

    def _check_metrics(self) -> None:
        """Raise an InputError if a metric is unknown, or needs true pictures of the views."""
        # None stands for the default metrics, which always fit.
        chosen_metrics = () if self.metrics is None else self.metrics
        for metric in chosen_metrics:
            check_name("metrics", metric, METRICS)
            if METRICS[metric].needs_true_picture and not self.compares_with_photos:
                raise InputError(
                    f"`metrics` {metric}: needs a true second view: add `protocol` near-view"
                )

    def _check_disparities(self) -> None:
        """Raise an InputError if a size of the camera move is impossible, or none is given."""
        if not self.disparities:
            raise InputError("`disparity`: give at least one number")
        for disparity in self.disparities:
            is_possible = 0 < disparity <= MAX_DISPARITY  # false for NaN
            if not is_possible:
                raise InputError(
                    f"`disparity` {disparity:g}: must be above 0 and up to {MAX_DISPARITY:g}"
                )


@dataclasses.dataclass(frozen=True, kw_only=True)
class BenchOptions:
    """The options of `spackle bench`, which counts added Gaussians and measures times."""

    dataset: str  # a key of `DATASETS`, or `package.module:NAME`
    root: Path  # the folder of the unpacked dataset
    disparities: Sequence[float] = PAPER_DISPARITIES  # sizes of the camera moves
    base: BaseSettings = PAPER_BASE  # turns photos into Gaussians
    residual: str | None = (
        None  # a file of weights, or "initial"; None: the shipped weights, if any
    )
    # The network's class, `package.module:Class`, if `residual` has weights of another package's.
    residual_network: str | None = None
    side: int | None = None  # long side of the views, in pixels; None: 1280, as in the paper
    limit: int | None = None  # the number of images, spread over the dataset; None: all
    runs: int = 5  # how often each stage after the base is timed
    base_runs: int | None = None  # how often the base is timed; None: see `timed_runs_of_base`

    @property
    def timed_runs_of_base(self) -> int:
        """How often the base is timed: if not given, once for SHARP (slow), else `runs` times."""
        if self.base_runs is not None:
            return self.base_runs
        return 1 if self.base.resolved_name == "sharp" else self.runs

    @property
    def as_evaluation(self) -> EvaluateOptions:
        """The options of an evaluation that opens the same dataset, base and residual network."""
        return EvaluateOptions(
            dataset=self.dataset,
            root=self.root,
            methods=TIMED_METHODS,
            disparities=self.disparities,
            metrics=(),  # a benchmark measures times, not images
            base=self.base,
            residual=self.residual,
            residual_network=self.residual_network,
            side=self.side,
            limit=self.limit,
        )


def split_words(text: str) -> tuple[str, ...]:
    """The words of a text such as "a, b,c", without repetitions."""
    words = [word.strip() for word in text.split(",")]
    return tuple(dict.fromkeys(word for word in words if word))


def parse_disparities(text: str) -> tuple[float, ...]:
    """The numbers of a text such as "0.3,0.4", without repetitions; InputError for other texts."""
    try:
        numbers = [float(word) for word in split_words(text)]
    except ValueError as error:
        raise InputError(
            f"`disparity` {text}: not numbers: give numbers with commas, such as 0.3,0.4,0.5"
        ) from error
    return tuple(dict.fromkeys(numbers))
