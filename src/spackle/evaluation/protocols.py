"""From which views a photo is looked at, and what is measured there."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor

from spackle.bases.protocol import BasePrediction
from spackle.camera_path import DepthRange, extremes
from spackle.errors import InputError, reason_in_a_line
from spackle.evaluation.case import Viewpoint
from spackle.evaluation.methods import Method
from spackle.evaluation.metrics import METRICS, Metric, psnr, ssim_average, ssim_map
from spackle.evaluation.rows import REMARK, Row
from spackle.render import Renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.training.losses import FeatureNet, hole_distance


@dataclasses.dataclass(frozen=True)
class Gauges:
    """What is measured besides holes and counts."""

    metrics: Sequence[str]  # of `METRICS`
    published: Mapping[str, Metric]  # those of them that pyiqa measures, where it can
    features: FeatureNet | None  # for "distance"

    def measure(self, rgb: Tensor, truth: Tensor | None, hole: Tensor) -> Iterator[tuple[str, float | str]]:
        """Figures of a picture [H, W, 3], by their names; a metric that failed gives NaN and a remark.

        Metrics of a truth are left out where there is none; `hole` [H, W] is the base's.
        """
        places: dict[str, Tensor | None] = {"": None, "_hole": hole, "_outside": ~hole}
        for name in self.metrics:
            if METRICS[name].truth and truth is None:
                continue
            if name in self.published:
                try:
                    yield name, self.published[name](rgb, truth if METRICS[name].truth else None)
                except Exception as error:  # a stranger's package on an odd picture: the figure is missing, and shows
                    yield name, math.nan
                    yield REMARK, f"{name} failed: {reason_in_a_line(error)}"
            elif truth is not None and name == "psnr":
                yield from ((f"psnr{place}", psnr(rgb, truth, mask)) for place, mask in places.items())
            elif truth is not None and name == "ssim":
                similarity = ssim_map(rgb, truth)
                yield from ((f"ssim{place}", ssim_average(similarity, mask)) for place, mask in places.items())
            elif truth is not None and name == "distance" and self.features is not None:
                yield name, hole_distance(self.features, rgb, truth, hole)


def large_views(prediction: BasePrediction, disparities: Sequence[float]) -> list[Viewpoint]:
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
            Viewpoint(f"{disparity:g}", name, camera)
            for disparity in disparities
            for name, camera in zip(("left", "right"), extremes(even, disparity, reach), strict=True)
        ]
    except ValueError as error:
        raise InputError(f"no camera path: {error}: check depth and focal length") from error


@torch.no_grad()
def measure_views(
    image: Row,
    prediction: BasePrediction,
    viewpoints: Sequence[Viewpoint],
    methods: Mapping[str, Method],
    gauges: Gauges,
    renderer: Renderer,
) -> tuple[list[Row], dict[str, Tensor]]:
    """Every method on every view; views of one setting are a method's to see together.

    Returns:
        Rows, which take dataset and name from `image`; and the view with the largest hole by each method,
        [H, W, 3], the truth last where there is one.
    """
    before = [renderer.render(prediction.gaussians, view.camera) for view in viewpoints]
    holes = [hole_area_ratio(view.alpha) for view in before]
    shown, base = max(range(len(viewpoints)), key=holes.__getitem__), len(prediction.gaussians)
    rows: list[Row] = []
    remarks: dict[Row, None] = {}
    pictures: dict[str, Tensor] = {}
    for setting in dict.fromkeys(view.setting for view in viewpoints):
        own = [index for index, view in enumerate(viewpoints) if view.setting == setting]
        cameras, renderings = [viewpoints[index].camera for index in own], [before[index] for index in own]
        for name, method in methods.items():
            for index, filled in zip(own, method(cameras, renderings), strict=True):
                figures: list[tuple[str, float | str]] = [("har_before", holes[index])]
                if filled.alpha is not None:  # of what is left open (paper, eq. 11 and 10)
                    open_share = hole_area_ratio(filled.alpha)
                    figures += [("har", open_share), ("coverage", 1 - open_share)]
                if filled.aux is not None:
                    figures += [("aux", filled.aux), ("aux_share", filled.aux / base), ("merged", base + filled.aux)]
                view, hole = viewpoints[index], hole_mask(before[index].alpha)
                for metric, value in (*figures, *gauges.measure(filled.rgb, view.truth, hole)):
                    if isinstance(value, str):
                        remarks[image._replace(metric=metric, value=value)] = None
                        continue
                    finite = value if math.isfinite(value) else None
                    rows.append(Row(image.dataset, image.image, setting, view.name, name, metric, finite))
                if index == shown:
                    pictures[name] = filled.rgb
    truth = viewpoints[shown].truth
    return [*rows, *remarks], pictures | ({} if truth is None else {TRUTH: truth})


TRUTH = "truth"  # among the pictures of a view
