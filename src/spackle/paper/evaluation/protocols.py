"""The views of both protocols, the scale between base and dataset, and the measurements."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.core.camera import Camera
from spackle.core.photo import working_size
from spackle.core.trajectories import DepthRange, leftmost_and_rightmost
from spackle.depth.depth_map import DepthMap
from spackle.paper.evaluation.case import Case, Points, Viewpoint
from spackle.paper.evaluation.measurements import REMARK, Measurement
from spackle.paper.evaluation.methods import Fill
from spackle.paper.evaluation.metrics import METRICS, Metric, psnr, ssim_average, ssim_map
from spackle.paper.training.feature_networks import FeatureNet
from spackle.paper.training.losses import hole_distance
from spackle.residual import CELL, hole_area_ratio, hole_mask
from spackle.runtime.errors import InputError, reason_in_a_line
from spackle.scene_fill import FillContext

MIN_PIXELS = 8  # the least number of pixels for a scale
BOUNDS_QUANTILES = (
    0.001,
    0.999,
)  # LLFF's near and far bounds are these quantiles of the depths of points
TRUTH, INPUT, HOLE = "truth", "input", "hole"  # names of pictures beside the methods


@dataclasses.dataclass(frozen=True)
class MetricSuite:
    """The metrics to measure, besides holes and counts."""

    metrics: Sequence[str]  # names in `METRICS`
    published: Mapping[str, Metric]  # pyiqa's metrics that were loaded
    features: FeatureNet | None  # for the metric "distance"

    def measure(
        self, rgb: Tensor, truth: Tensor | None, hole: Tensor
    ) -> Iterator[tuple[str, float | str]]:
        """Measure an image [H, W, 3]; yields names and values. A metric that fails gives NaN and a remark.

        Without a truth, metrics that need a truth are left out; `hole` [H, W] is the base's hole.
        """
        places: dict[str, Tensor | None] = {"": None, "_hole": hole, "_outside": ~hole}
        for name in self.metrics:
            if name in self.published and not (METRICS[name].truth and truth is None):
                try:
                    yield name, self.published[name](rgb, truth if METRICS[name].truth else None)
                except Exception as error:  # a foreign package may fail on an unusual image; the report names the error
                    yield name, math.nan
                    yield REMARK, f"{name} failed: {reason_in_a_line(error)}"
            elif truth is not None and name == "psnr":
                yield from (
                    (f"psnr{place}", psnr(rgb, truth, mask)) for place, mask in places.items()
                )
            elif truth is not None and name == "ssim":
                similarity = ssim_map(rgb, truth)
                yield from (
                    (f"ssim{place}", ssim_average(similarity, mask))
                    for place, mask in places.items()
                )
            elif truth is not None and name == "distance" and self.features is not None:
                yield name, hole_distance(self.features, rgb, truth, hole)


def large_views(
    prediction: BasePrediction, disparities: Sequence[float], side: int
) -> list[Viewpoint]:
    """The views of the paper's controlled rendering (section 4.1): the two ends of the `swipe` path at each disparity.

    At disparity m the camera moves sideways by m · ‖(W/f, H/f)‖ · z_near, once to the left and once to the right, and
    looks at the focus point. The paper does not state this rule. Intrinsics are the photo's. The long side is at most
    `side`. Both sides are even, which the paper's counts of dense grids imply.

    Raises:
        InputError: no Gaussian is in front of the camera, or the disparity is impossible.
    """
    try:
        camera, reach = prediction.camera, DepthRange.of(prediction.gaussians)
        even = camera.resized(*working_size(camera.width, camera.height, side)).even()
        return [
            Viewpoint(f"{disparity:g}", name, camera)
            for disparity in disparities
            for name, camera in zip(
                ("left", "right"), leftmost_and_rightmost(even, disparity, reach), strict=True
            )
        ]
    except ValueError as error:
        raise InputError(f"no camera path: {error}: check depth and focal length") from error


def align(case: Case, z_base: Tensor, seen: Tensor) -> float:
    """The ratio of the units of length, z_dataset / z_base: the median over pixels with known depth in both.

    The dataset's depth comes from a depth map, or else from points, or else from bounds. A metric base and a metric
    dataset are aligned too, because a network's metres are rarely exact.

    Args:
        case: the case, in the dataset's unit.
        z_base: [H, W] the base's depth at the input camera, at any size with the photo's aspect ratio.
        seen: [H, W] bool, the pixels with a valid depth of the base.

    Raises:
        InputError: too few pixels have known depth in both.
    """
    seen = seen & torch.isfinite(z_base) & (z_base > 0)
    ratios = [_depth_ratios(case.depth(), z_base, seen)] if case.depth else []
    ratios += [_point_ratios(case, case.points(), z_base, seen)] if case.points else []
    for known in ratios:
        known = known[torch.isfinite(known) & (known > 0)].double()
        if len(known) >= MIN_PIXELS:
            return float(known.median())
    if case.bounds is not None and seen.any():
        # The geometric mean of the scales that match the nearest and the farthest depth.
        z = z_base[seen].double().sort().values
        scales = [
            b / float(z[round(q * (len(z) - 1))])
            for b, q in zip(case.bounds, BOUNDS_QUANTILES, strict=True)
        ]
        return math.sqrt(math.prod(scales))
    raise InputError(
        f"{case.name}: the base's scale cannot be found: the dataset's depth is unknown, or the dataset's and the "
        f"base's depth share under {MIN_PIXELS} pixels: take --protocol large-view"
    )


def to_base(view: Camera, photo: Camera, base: Camera, scale: float) -> Camera:
    """Transform a second view's camera into the base's world.

    If the base's principal point or focal length differs from the dataset's, the base's scene is sheared: the same
    pixel at the same depth is another point. The returned camera projects the base's points to the pixels where `view`
    projects the dataset's. The result is exact if the two cameras look in the same direction, as in rectified pairs, or
    have the same intrinsics; otherwise the result is exact up to a skew of the pixel grid.

    Args:
        view: in the input photo's frame and the dataset's unit.
        photo: the dataset's camera of the input photo.
        base: the base's camera of the input photo (`BasePrediction.camera`), at any size with the photo's aspect ratio.
        scale: see `align`.

    Returns:
        The camera, with the image size of `view`, in the base's frame and unit.
    """
    K, pose = view.K.double(), view.world_to_camera.double()
    # Maps the base's point at a pixel, up to the scale, to the dataset's point.
    shear = torch.linalg.solve(photo.K.double(), base.resized(photo.width, photo.height).K.double())
    # RQ decomposition: an upper triangular matrix with positive diagonal times a rotation.
    flip = torch.eye(3, dtype=torch.float64).flip(0)
    rotation, intrinsics = torch.linalg.qr((flip @ (K @ pose[:3, :3] @ shear)).T)
    intrinsics, rotation = flip @ intrinsics.T @ flip, flip @ rotation.T
    signs = torch.diag(intrinsics.diagonal().sign())
    intrinsics, rotation = intrinsics @ signs, signs @ rotation
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = torch.linalg.solve(intrinsics, K @ pose[:3, 3]) / scale
    intrinsics = intrinsics / intrinsics[2, 2]
    intrinsics[0, 1] = 0.0  # drop the skew, which a Camera cannot have
    return Camera(intrinsics.to(view.K), matrix.to(view.world_to_camera), view.width, view.height)


def _depth_ratios(known: DepthMap, z_base: Tensor, seen: Tensor) -> Tensor:
    """Ratios of dataset depth to base depth; each pixel of the base uses the nearest pixel of the depth map."""
    (height, width), (rows, columns) = z_base.shape, known.depth.shape
    y = ((torch.arange(height) + 0.5) * rows / height).long()
    x = ((torch.arange(width) + 0.5) * columns / width).long()
    z, valid = known.depth[y][:, x], known.valid[y][:, x] & seen
    return z[valid] / z_base[valid]


def _point_ratios(case: Case, points: Points, z_base: Tensor, seen: Tensor) -> Tensor:
    """Ratios of dataset depth to base depth; each point uses the pixel of the base in which the point lies."""
    assert case.camera is not None  # points are in pixels of this camera
    height, width = z_base.shape
    cells = (
        (points.uv * torch.tensor([width / case.camera.width, height / case.camera.height]))
        .floor()
        .long()
    )
    inside = ((cells >= 0) & (cells < torch.tensor([width, height]))).all(1)
    x, y = cells[inside].unbind(1)
    known = seen[y, x]
    return points.z[inside][known] / z_base[y, x][known]


@torch.no_grad()
def measure_views(
    image: Measurement,
    context: FillContext,
    viewpoints: Sequence[Viewpoint],
    methods: Mapping[str, Callable[[Sequence[Camera]], Fill]],
    gauges: MetricSuite,
) -> tuple[list[Measurement], dict[str, Tensor]]:
    """Measure every method on every view of a base; a method gets all cameras of a setting at once.

    Returns:
        Rows, whose dataset and image are copied from the row `image`. Also pictures [H, W, 3] of the view with the
        largest hole: the hole in white, the view by each method, and the truth if known.
    """
    rows: list[Measurement] = []
    pictures: dict[str, Tensor] = {}
    largest, base = -1.0, len(context.base)
    for setting in dict.fromkeys(view.setting for view in viewpoints):
        views = [view for view in viewpoints if view.setting == setting]
        fills = {name: method([view.camera for view in views]) for name, method in methods.items()}
        for view in views:
            before = context.renderer.render(context.base, view.camera)
            hole, truth = hole_mask(before.alpha), view.truth() if view.truth else None
            share = hole_area_ratio(before.alpha)
            shown = {HOLE: hole.cpu()[..., None].expand(-1, -1, 3).float()}
            for name, fill in fills.items():
                rgb, alpha, aux = fill(view.camera, before)
                shown[name] = rgb = rgb.cpu()  # the truth is on the CPU
                numbers: list[tuple[str, float | str]] = [("har_before", share)]
                if alpha is not None:  # HAR after completion, and coverage (paper, eqs. 11 and 10)
                    left = hole_area_ratio(alpha)
                    numbers += [("har", left), ("coverage", 1 - left)]
                if aux is not None:
                    count = len(aux)
                    numbers += [
                        ("aux", count),
                        ("aux_share", count / base),
                        ("merged", base + count),
                    ]
                    numbers.append(("hole_cells", share * hole.numel() / CELL**2))
                row = image._replace(setting=setting, view=view.name, method=name)
                for metric, value in (*numbers, *gauges.measure(rgb, truth, hole)):
                    finite = isinstance(value, str) or math.isfinite(value)
                    of = image if metric == REMARK else row  # a remark has no setting and no method
                    rows.append(of._replace(metric=metric, value=value if finite else None))
            if share > largest:
                largest, pictures = share, shown | ({} if truth is None else {TRUTH: truth})
    return rows, pictures
