"""The two protocols of the evaluation: which views are rendered, and what is measured in them.

- large-view: controlled camera moves to the left and right (paper, section 4.1); the true pictures
  are unknown.
- near-view: the viewpoints of true second photos.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.photo import working_size
from spackle.core.trajectories import leftmost_and_rightmost
from spackle.paper.evaluation.case import Viewpoint
from spackle.paper.evaluation.measurements import REMARK_METRIC, Measurement, image_measurement
from spackle.paper.evaluation.methods import Fill, MethodView
from spackle.paper.evaluation.metric_suite import MetricSuite
from spackle.residual import CELL, hole_area_ratio, hole_mask
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext

# Names of the stored pictures that are not those of a method.
TRUE_PICTURE = "truth"
INPUT_PICTURE = "input"
HOLE_PICTURE = "hole"

# From the cameras of all views of a setting to the function that fills one of these views.
Method = Callable[[Sequence[Camera]], Fill]


def large_views(
    prediction: BasePrediction, disparities: Sequence[float], max_side: int
) -> list[Viewpoint]:
    """The views of the paper's controlled rendering (section 4.1): two for each disparity.

    At disparity m the camera moves sideways by m · ‖(W/f, H/f)‖ · z_near, once to the left and once
    to the right, where z_near is the scene's nearest depth. It keeps looking at one point of the
    scene, the focus point. The paper does not state this rule.

    Args:
        prediction: the base's Gaussians and its camera of the photo, whose intrinsics the views
            have.
        disparities: sizes of the camera moves; the paper's S1, S2, S3 are 0.3, 0.4, 0.5.
        max_side: the views' long side is at most this, in pixels. Both sides are even, which the
            paper's counts of cells of 2×2 pixels imply.

    Raises:
        InputError: no Gaussian is in front of the camera, or the disparity is impossible.
    """
    camera = prediction.camera
    viewpoints = []
    try:
        depth_range = prediction.depth_range
        width, height = working_size(camera.width, camera.height, max_side)
        camera = camera.resized(width, height).even()

        for disparity in disparities:
            left, right = leftmost_and_rightmost(camera, disparity, depth_range)
            setting = f"{disparity:g}"
            viewpoints.append(Viewpoint(setting, "left", left))
            viewpoints.append(Viewpoint(setting, "right", right))
    except ValueError as error:
        raise InputError(f"no camera path: {error}: check depth and focal length") from error
    return viewpoints


@torch.no_grad()
def measure_views(
    dataset: str,
    image: str,
    context: FillContext,
    viewpoints: Sequence[Viewpoint],
    methods: Mapping[str, Method],
    suite: MetricSuite,
) -> tuple[list[Measurement], dict[str, Tensor]]:
    """Measure every method on every view of an image.

    Args:
        dataset: the dataset's title, for the measurements.
        image: the image's name, for the measurements.
        context: the base's Gaussians (which all methods start from), the renderer and the network.
        viewpoints: the views. Each has a setting: a size of the camera move as text, or "near".
        methods: for each name the method; it gets all cameras of a setting at once, because it may
            complete their views together.
        suite: the metrics.

    Returns:
        measurements: the numbers of all views.
        pictures: [H, W, 3] by name, all of the view with the largest hole: under a method's name
            the view by this method; "hole", white in the hole; "truth", the true picture, if known.
    """
    measurements: list[Measurement] = []
    pictures: dict[str, Tensor] = {}
    largest_hole_ratio = -1.0  # below every ratio, so that the first view counts

    # A method may complete all views of a setting together, so settings are taken one by one.
    for setting in dict.fromkeys(view.setting for view in viewpoints):
        setting_views = [view for view in viewpoints if view.setting == setting]
        cameras = [view.camera for view in setting_views]
        fills = {name: method(cameras) for name, method in methods.items()}

        for view in setting_views:
            result = _measure_view(dataset, image, context, view, fills, suite)
            measurements += result.measurements
            if result.hole_ratio > largest_hole_ratio:
                largest_hole_ratio = result.hole_ratio
                pictures = result.pictures
    return measurements, pictures


class _ViewResult(NamedTuple):
    """What `measure_views` keeps of one view."""

    hole_ratio: float  # the fraction of the view's pixels that the base leaves open
    measurements: list[Measurement]
    pictures: dict[str, Tensor]  # [H, W, 3]: the hole, each method's view, the true picture


def _measure_view(
    dataset: str,
    image: str,
    context: FillContext,
    view: Viewpoint,
    fills: Mapping[str, Fill],
    suite: MetricSuite,
) -> _ViewResult:
    """Render a view by every method, and measure it.

    Args:
        dataset: the dataset's title, for the measurements.
        image: the image's name, for the measurements.
        context: the base's Gaussians, which all methods start from, and the renderer.
        view: the view's camera, and its true picture if known.
        fills: for each method's name the function that fills a view.
        suite: the metrics.
    """
    # What the base alone shows; the hole is where its Gaussians cover too little.
    base_rendering = context.renderer.render(context.base, view.camera)
    hole = hole_mask(base_rendering.alpha)  # [H, W]
    hole_ratio = hole_area_ratio(base_rendering.alpha)
    true_picture = None if view.read_true_picture is None else view.read_true_picture()

    white_hole = hole.cpu()[..., None].expand(-1, -1, 3).float()  # [H, W, 3]
    pictures = {HOLE_PICTURE: white_hole}
    measurements = []

    for method, fill in fills.items():
        filled = fill(view.camera, base_rendering)
        picture = filled.rgb.cpu()  # true pictures are on the CPU, too
        pictures[method] = picture

        # Pictures are compared as they are, in full size; only stored pictures are made smaller.
        numbers = _hole_numbers(
            filled, hole_ratio, pixel_count=hole.numel(), base_count=len(context.base)
        )
        numbers += suite.measure(picture, true_picture, hole)
        for metric, value in numbers:
            if metric == REMARK_METRIC:
                # Remarks are listed image by image, so they do not name view and method.
                remark = image_measurement(dataset, image, metric, value)
                measurements.append(remark)
            else:
                number = Measurement(
                    dataset=dataset,
                    image=image,
                    setting=view.setting,
                    view=view.name,
                    method=method,
                    metric=metric,
                    value=value if math.isfinite(float(value)) else None,  # JSON has no NaN
                )
                measurements.append(number)

    if true_picture is not None:
        pictures[TRUE_PICTURE] = true_picture
    return _ViewResult(hole_ratio, measurements, pictures)


def _hole_numbers(
    filled: MethodView, hole_ratio: float, pixel_count: int, base_count: int
) -> list[tuple[str, float | str]]:
    """The area of a view's hole before and after filling, and counts of Gaussians, by their names.

    HAR is the hole area ratio (paper, eq. 11), the fraction of pixels that are too transparent;
    coverage is 1 - HAR (eq. 10). "aux" counts the Gaussians that a method adds to the base's.
    "hole_cells" is HAR times the number of cells of 2×2 pixels; the paper's method adds a Gaussian
    for each such cell. "merged" counts the base's and the added Gaussians together.

    Args:
        filled: the view by a method. Methods that inpaint the flat picture have no opacity;
            methods that change the base add no Gaussians. Their numbers are left out.
        hole_ratio: HAR of the base alone.
        pixel_count: the number of the view's pixels.
        base_count: the number of the base's Gaussians.
    """
    numbers: list[tuple[str, float | str]] = [("har_before", hole_ratio)]

    # A flat inpainted picture has no opacity, and so no hole.
    if filled.alpha is not None:
        remaining_hole_ratio = hole_area_ratio(filled.alpha)
        numbers.append(("har", remaining_hole_ratio))
        numbers.append(("coverage", 1 - remaining_hole_ratio))

    # A base that was fine-tuned has other Gaussians, and none is added.
    if filled.aux is not None:
        added_count = len(filled.aux)
        numbers.append(("aux", added_count))
        numbers.append(("aux_share", added_count / base_count))
        numbers.append(("merged", base_count + added_count))
        cell_count = pixel_count / CELL**2  # a cell has 2×2 pixels
        numbers.append(("hole_cells", hole_ratio * cell_count))
    return numbers
