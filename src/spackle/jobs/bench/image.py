"""One image of a benchmark: load, predict, time the views."""

from __future__ import annotations

import dataclasses
import os

from spackle.bases.lift import RgbdBase
from spackle.bases.protocol import Base
from spackle.errors import InputError
from spackle.evaluation.case import Case, LoadedCase, load_case
from spackle.evaluation.efficiency import Clock, ViewBench, time_base
from spackle.evaluation.efficiency_cells import SIDE
from spackle.evaluation.efficiency_results import ImageCost
from spackle.evaluation.protocols import large_views
from spackle.evaluation.setup import Bench
from spackle.jobs.bench.options import BenchOptions


def time_image(case: Case, options: BenchOptions, tools: Bench, clock: Clock, warm: bool) -> ImageCost:
    """All settings of an image.

    Args:
        case: the image.
        options: which views, how often.
        tools: what all images share.
        clock: of the base's device.
        warm: something was predicted before in this process.

    Raises:
        InputError: a file that cannot be used, or a depth map that the case lacks.
        BaseError: no image can be worked on.
    """
    load = _load_of_machine()
    loaded = load_case(dataclasses.replace(case, seconds=()))
    base = time_base(_base_of(loaded, tools), loaded.full, options.base_times, clock, warm)
    try:
        views = large_views(base.prediction, options.disparities)
    except ValueError as error:
        raise InputError(f"{case.name}: no camera path: {error}: check depth and focal length") from error
    bench = ViewBench(base, tools.renderer, tools.network, clock, options.base.precision)
    costs = [bench.time_view(view.setting, view.camera, options.runs) for view in views if view.name == SIDE]
    size = {"width": loaded.photo.width, "height": loaded.photo.height}
    facts = {**size, "load": load, "warm": base.warm, "notes": base.prediction.notes}
    return ImageCost(case.name, facts, tuple(costs))


def _base_of(loaded: LoadedCase, tools: Bench) -> Base:
    """The network, or the case's own depth."""
    if tools.base is not None:
        return tools.base()
    if loaded.case.depth is None:
        raise InputError(f"{loaded.case.name}: has no depth map, which --base rgbd takes")
    return RgbdBase(loaded.case.depth())


def _load_of_machine() -> float | None:
    """How many processes want a core, over the last minute; None where the system does not say."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
