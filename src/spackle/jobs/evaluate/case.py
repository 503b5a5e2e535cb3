"""One image of an evaluation: load, predict, look from elsewhere, measure."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.bases.protocol import Base, BasePrediction
from spackle.bases.rgbd import RgbdBase
from spackle.choose import BaseError, Load
from spackle.errors import InputError
from spackle.evaluation.alignment import Alignment, align, to_base
from spackle.evaluation.case import Case
from spackle.evaluation.load import LoadedCase, known_depth, load_case
from spackle.evaluation.methods import make_method
from spackle.evaluation.protocols import NEAR, Gauges, Wanted, large_views, measure
from spackle.evaluation.results import Record
from spackle.evaluation.sheets import TRUTH
from spackle.jobs.evaluate.options import EvaluateOptions
from spackle.render import Renderer
from spackle.residual import ResidualNet, hole_mask


@dataclasses.dataclass(frozen=True)
class Bench:
    """What is set up once for all images."""

    options: EvaluateOptions
    renderer: Renderer
    base: Load | None  # None: the dataset's depth is the base
    network: ResidualNet | None
    direct: Load | None  # the base of the method direct-ft
    gauges: Gauges
    states: Mapping[str, str]  # metric → who measures it, or why nobody does


def examine(case: Case, bench: Bench) -> tuple[Record, dict[str, Tensor]]:
    """All figures of an image, and what is shown of it: a picture of one view by each method, and the truth.

    Raises:
        InputError: a file that cannot be used, or something that the protocol needs and the case lacks.
        BaseError: no image can be worked on.
    """
    near = bench.options.near
    if near and not case.seconds and case.problem is None:
        raise InputError(f"{case.name}: has no second photo")
    loaded = load_case(case if near else dataclasses.replace(case, seconds=()))
    prediction = _predict(loaded, bench)
    alignment = _align(loaded, prediction, bench, bench.base is None) if near else None
    try:
        wanted = _near_views(loaded, prediction, alignment) if alignment else large_views(prediction, _moves(bench))
    except ValueError as error:
        raise InputError(f"{case.name}: no camera path: {error}: check depth and focal length") from error

    def direct_ft() -> tuple[BasePrediction, float]:
        """The other base, and what its cameras' paths are to be multiplied by."""
        assert bench.direct is not None
        other = _of_network(bench.direct).predict(loaded.full)
        if alignment is None:
            return other, 1.0
        return other, alignment.scale / _align(loaded, other, bench, False).scale

    methods = {
        name: make_method(name, bench.network, direct_ft, bench.options.base.precision)
        for name in bench.options.methods
    }
    measured = measure(prediction, wanted, methods, bench.gauges, bench.renderer)
    facts: dict[str, Any] = {
        "width": loaded.photo.width,
        "height": loaded.photo.height,
        "focal_px": round(prediction.camera.focal[0], 3),
        "base_gaussians": len(prediction.gaussians),
        "notes": prediction.notes,
        "alignment": dataclasses.asdict(alignment) if alignment else None,
        "shown": {"setting": measured.shown.setting, "view": measured.shown.name},
    }
    lacks = [f"without one of its second photos: {from_root(lack, bench.options.root)}" for lack in loaded.lacks]
    record = Record(case.name, facts, tuple(measured.rows), remarks=(*lacks, *measured.remarks))
    truth = {} if measured.shown.truth is None else {TRUTH: measured.shown.truth}
    return record, measured.pictures | truth


def from_root(problem: str, root: Path) -> str:
    """A line about a file of a dataset, whose name does not say where that was unpacked."""
    return " ".join(problem.replace(f"{root}/", "").splitlines())


def _moves(bench: Bench) -> tuple[float, ...]:
    return tuple(bench.options.disparities)


def _predict(loaded: LoadedCase, bench: Bench) -> BasePrediction:
    """The base's Gaussians; InputError where a case has no depth for a base that takes it."""
    if bench.base is not None:
        return _of_network(bench.base).predict(loaded.full)
    return RgbdBase(known_depth(loaded.case)).predict(loaded.full)


def _of_network(load: Load) -> Base:
    """A base, loaded; BaseError where it cannot be, since no other image could be worked on either."""
    try:
        return load()
    except BaseError:
        raise
    except InputError as error:
        raise BaseError(str(error)) from error


@torch.no_grad()
def _align(loaded: LoadedCase, prediction: BasePrediction, bench: Bench, is_truth: bool) -> Alignment:
    """The base's scale, by what it sees at the photo's own camera."""
    view = bench.renderer.render(prediction.gaussians, prediction.camera)
    return align(loaded.case, view.depth, ~hole_mask(view.alpha), base_is_truth=is_truth)


def _near_views(loaded: LoadedCase, prediction: BasePrediction, alignment: Alignment) -> list[Wanted]:
    """The true second photos, and the base's world from their cameras."""
    return [
        Wanted(NEAR, view.name, to_base(view.camera, loaded.camera, prediction.camera, alignment.scale), view.rgb)
        for view in loaded.seconds
    ]
