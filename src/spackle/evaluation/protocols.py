"""From which views a photo is looked at, and what is measured there."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.camera import Camera
from spackle.camera_path import DepthRange, extremes
from spackle.errors import InputError, reason_in_a_line
from spackle.evaluation.methods import Method, Shot
from spackle.evaluation.metrics import METRICS, Metric, psnr, ssim_average, ssim_map
from spackle.evaluation.results import Row
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual import hole_area_ratio, hole_mask
from spackle.training.features import FeatureNet
from spackle.training.losses import hole_distance

NEAR = "near"


@dataclasses.dataclass(frozen=True)
class Wanted:
    """A view to look at."""

    setting: str
    name: str
    camera: Camera
    truth: Tensor | None = None  # [H, W, 3] sRGB 0..1, of the camera's size


@dataclasses.dataclass(frozen=True)
class Gauges:
    """What is measured besides holes and counts."""

    metrics: Sequence[str]  # of `METRICS`
    published: Mapping[str, Metric]  # those of them that pyiqa measures, where it can
    features: FeatureNet | None  # for "distance"


@dataclasses.dataclass(frozen=True)
class Measured:
    """A photo's figures, and pictures of the view with the largest hole."""

    rows: list[Row]
    remarks: list[str]
    shown: Wanted
    pictures: dict[str, Tensor]  # method → [H, W, 3]


def large_views(prediction: BasePrediction, disparities: Sequence[float]) -> list[Wanted]:
    """The paper's controlled rendering (section 4.1); it says which disparities, but not which views.

    Here they are the two ends of the `swipe` path at each disparity m: the eye moves sideways by m · ‖(W/f, H/f)‖ ·
    z_near, once to the left and once to the right, and looks at the focus point. The lens stays the photo's; both sides
    of the picture are even, as the paper's dense counts have it.

    Raises:
        InputError: no Gaussian stands in front of the camera, or a disparity that no path has.
    """
    try:
        even, reach = prediction.camera.even(), DepthRange.of(prediction.gaussians)
        return [
            Wanted(f"{disparity:g}", name, camera)
            for disparity in disparities
            for name, camera in zip(("left", "right"), extremes(even, disparity, reach), strict=True)
        ]
    except ValueError as error:
        raise InputError(f"no camera path: {error}: check depth and focal length") from error


@torch.no_grad()
def measure(
    prediction: BasePrediction,
    wanted: Sequence[Wanted],
    methods: Mapping[str, Method],
    gauges: Gauges,
    renderer: Renderer,
) -> Measured:
    """Every method on every view; views of one setting are a method's to see together."""
    before = [renderer.render(prediction.gaussians, view.camera) for view in wanted]
    holes = [hole_area_ratio(view.alpha) for view in before]
    shown, base = max(range(len(wanted)), key=holes.__getitem__), len(prediction.gaussians)
    rows: list[Row] = []
    remarks: list[str] = []
    pictures: dict[str, Tensor] = {}
    for setting in dict.fromkeys(view.setting for view in wanted):
        own = [index for index, view in enumerate(wanted) if view.setting == setting]
        shot = Shot(prediction, [wanted[i].camera for i in own], [before[i] for i in own], renderer)
        for name, method in methods.items():
            for index, view in zip(own, method(shot), strict=True):
                figures = {"har_before": holes[index]}
                if view.alpha is not None:  # of what is left open (paper, eq. 11 and 10)
                    open_share = hole_area_ratio(view.alpha)
                    figures |= {"har": open_share, "coverage": 1 - open_share}
                if view.aux is not None:
                    figures |= {"aux": view.aux, "aux_share": view.aux / base, "merged": base + view.aux}
                figures |= _quality(view.rgb, wanted[index].truth, before[index], gauges, remarks)
                finite = {key: value if math.isfinite(value) else None for key, value in figures.items()}
                rows.append(Row(setting, wanted[index].name, name, finite))
                if index == shown:
                    pictures[name] = view.rgb
    return Measured(rows, list(dict.fromkeys(remarks)), wanted[shown], pictures)


def _quality(
    rgb: Tensor, truth: Tensor | None, before: Rendering, gauges: Gauges, remarks: list[str]
) -> dict[str, float]:
    """The metrics that were asked for and can be: those with a truth want one."""
    figures: dict[str, float] = {}
    hole = hole_mask(before.alpha)
    places: dict[str, Tensor | None] = {"": None, "_hole": hole, "_outside": ~hole}
    for name in gauges.metrics:
        if METRICS[name].truth and truth is None:
            continue
        if name in gauges.published:
            try:
                figures[name] = gauges.published[name](rgb, truth if METRICS[name].truth else None)
            except Exception as error:  # a stranger's package on an odd picture: the figure is missing, and it shows
                figures[name] = math.nan
                remarks.append(f"{name} failed: {reason_in_a_line(error)}")
        elif truth is not None and name == "psnr":
            figures |= {f"psnr{place}": psnr(rgb, truth, mask) for place, mask in places.items()}
        elif truth is not None and name == "ssim":
            similarity = ssim_map(rgb, truth)
            figures |= {f"ssim{place}": ssim_average(similarity, mask) for place, mask in places.items()}
        elif truth is not None and name == "distance" and gauges.features is not None:
            figures[name] = hole_distance(gauges.features, rgb, truth, hole)
    return figures
