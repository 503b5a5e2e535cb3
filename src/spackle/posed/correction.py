"""Bring a photo's predicted depth to the depth of known points, and move its Gaussians likewise.

A base guesses depth from one photo: its unit is unknown, and near and far may be too close to each
other. Points of a reconstruction have depths in the world's unit. `fit_correction` finds the map
between the two, `move_gaussians` applies it.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians, quat_from_matrix, quat_to_matrix

MIN_POINTS = 8  # fewer do not tell right depths from wrong ones
FIT_ROUNDS = 12  # of reweighted least squares; later ones change nothing visible
# The median error of half of the points, times this, is the standard deviation of normal errors.
MEDIAN_TO_DEVIATION = 1.4826
MIN_DEVIATION = 0.003  # relative; below it, errors are those of pixels, not of depth
# In the first round, points count that miss by several times this; else a small thing in front of
# a large wall would be taken for an outlier before the shift is found that explains both.
FIRST_DEVIATION = 0.2
# A shift of inverse depth must pay: weight of its square against the points' relative errors.
SHIFT_PENALTY = 1e-4
MIN_KEPT_RATIO = 0.25  # a shift leaves at least this share of the scaled inverse depth
# Nodes of the field of factors: layers of inverse depth, rows and columns over the photo. Layers,
# because points on a wall say nothing about a plain column before it.
FIELD_NODES = (4, 10, 13)
# The layers reach between these quantiles of the photo's inverse depth.
LAYER_QUANTILES = (0.05, 0.95)
# Weights against bends within a layer, against steps and bends from layer to layer, and against
# large factors, where the mean number of points to a node of one layer is one. Chosen by true
# depths of rendered scenes: docs/fill.md.
BEND_PENALTY = 0.05
STEP_PENALTY = 0.02
LAYER_BEND_PENALTY = 0.05
SIZE_PENALTY = 0.003
MAX_SAMPLES = 100_000  # pixels from which the layers' range is estimated
MAX_FIELD = 0.7  # largest log factor of the field: a factor of two


@dataclasses.dataclass(frozen=True)
class DepthCorrection:
    """A map of depths in a photo: 1/z' = exp(field) · (scale / z + shift).

    The field changes smoothly over the photo, and from near to far.
    """

    scale: float
    shift: float  # 1 / unit of the world
    # [layers, rows, columns] log factors on a regular grid. The outer rows and columns lie at the
    # photo's border; the layers are equally spaced in scale / z + shift.
    field: Tensor
    first_layer: float = 0.0  # scale / z + shift of the first layer, which is the farthest
    last_layer: float = 1.0

    def inverse_depth(self, inverse: Tensor, place: Tensor) -> Tensor:
        """The corrected inverse depth [N], positive wherever `inverse` [N] is.

        `place` [N, 2] is the pixel's x and y, from 0 to 1 over the photo.
        """
        shifted = self.shifted_inverse_depth(inverse)
        # The field has a grid over the photo for each of several depths, its layers. In between,
        # it is interpolated: `grid_sample` takes x, y and layer as -1..1, and repeats the border
        # beyond it.
        nearness = (shifted - self.first_layer) / (self.last_layer - self.first_layer)
        position = 2 * torch.cat([place, nearness[:, None]], dim=1) - 1  # [N, 3]
        field = self.field.to(place)[None, None]  # [1, 1, layers, rows, columns]
        logs = grid_sample(
            field, position[None, None, None], padding_mode="border", align_corners=True
        )
        return logs[0, 0, 0, 0].exp() * shifted

    def shifted_inverse_depth(self, inverse: Tensor) -> Tensor:
        """scale / z + shift of inverse depths [N], kept above a quarter of scale / z."""
        scaled = self.scale * inverse
        return torch.maximum(scaled + self.shift, MIN_KEPT_RATIO * scaled)


@dataclasses.dataclass(frozen=True)
class KnownDepths:
    """Points of a photo whose depth is known."""

    uv: Tensor  # [N, 2] pixel positions in the photo's camera
    z: Tensor  # [N] depths in the world's unit

    def __len__(self) -> int:
        return len(self.z)

    def select(self, index: Tensor) -> KnownDepths:
        """Some of the points, by a mask or an index."""
        return KnownDepths(self.uv[index], self.z[index])


@dataclasses.dataclass(frozen=True)
class FittedCorrection:
    """A correction, and how well it explains the points."""

    correction: DepthCorrection
    error: float  # median relative error of the points' depths after it
    explained_ratio: float  # share of the points that lie within three deviations
    point_count: int


def fit_correction(
    points: KnownDepths, base_depth: Tensor, is_known: Tensor, *, with_field: bool = True
) -> FittedCorrection | None:
    """Fit the map from a base's depths to those of points; up to a third may be wrong.

    Least squares of the relative errors of inverse depth, in which points with large errors lose
    their weight from round to round.

    Args:
        points: the known depths, in pixels of the base's depth.
        base_depth: [H, W] the base's depth.
        is_known: [H, W] bool, where the base has a depth.
        with_field: also fit factors that change smoothly over the photo.

    Returns:
        None if fewer than 8 points lie where the base has a depth.
    """
    height, width = base_depth.shape
    column = points.uv[:, 0].floor().long()
    row = points.uv[:, 1].floor().long()
    is_inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (points.z > 0)
    usable = is_inside.clone()
    usable[is_inside] = is_known[row[is_inside], column[is_inside]]
    if int(usable.sum()) < MIN_POINTS:
        return None

    inverse = 1 / base_depth[row[usable], column[usable]].double()
    known_inverse = 1 / points.z[usable].double()
    # x and y from 0 to 1 over the photo.
    place = points.uv[usable].double() / torch.tensor([width, height], dtype=torch.float64)

    # First one scale and shift for the whole photo, then what a smooth field can still explain.
    scale, shift = _fit_scale_and_shift(inverse, known_inverse)
    no_change = torch.zeros(FIELD_NODES, dtype=torch.float64)  # logarithms of factors of 1
    correction = DepthCorrection(scale, shift, no_change)
    if with_field:
        # The field has layers from far to near, which reach over nearly all depths of the photo. A
        # part of its pixels is enough to know these.
        every_inverse = 1 / base_depth[is_known].double()
        step = max(1, len(every_inverse) // MAX_SAMPLES)
        shifted = correction.shifted_inverse_depth(every_inverse[::step])
        low, high = (float(shifted.quantile(share)) for share in LAYER_QUANTILES)
        if high > low:
            correction = dataclasses.replace(correction, first_layer=low, last_layer=high)
        # log(known / predicted) is what the field should be at each point.
        known_logs = (known_inverse / correction.inverse_depth(inverse, place)).log()
        # Where each point lies between the farthest layer (0) and the nearest one (1).
        layers_range = correction.last_layer - correction.first_layer
        from_first = correction.shifted_inverse_depth(inverse) - correction.first_layer
        nearness = from_first / layers_range
        field = _fit_field(known_logs, place, nearness)
        correction = dataclasses.replace(correction, field=field)

    errors = (correction.inverse_depth(inverse, place) / known_inverse - 1).abs()
    deviation = _deviation(errors)
    return FittedCorrection(
        correction=correction,
        error=float(errors.median()),
        explained_ratio=float((errors <= 3 * deviation).double().mean()),
        point_count=len(errors),
    )


def _deviation(errors: Tensor, least: float = MIN_DEVIATION) -> float:
    """The standard deviation of those errors [N] that are not gross; at least `least`."""
    return max(least, MEDIAN_TO_DEVIATION * float(errors.abs().median()))


def _weights(errors: Tensor, fit_round: int) -> Tensor:
    """[N] weights of points by their errors [N]: 1 for no error, a quarter at two standard
    deviations, almost 0 for gross errors.

    What counts as gross becomes less from round to round (graduated non-convexity).
    """
    # Below this, a deviation counts as this. It falls geometrically from FIRST_DEVIATION, at which
    # hardly any error is gross, to MIN_DEVIATION.
    part = fit_round / (FIT_ROUNDS - 1)  # 0 in the first round, 1 in the last
    least_deviation = FIRST_DEVIATION * (MIN_DEVIATION / FIRST_DEVIATION) ** part
    relative = errors / (2 * _deviation(errors, least_deviation))
    return 1 / (1 + relative.square()).square()


def _fit_scale_and_shift(inverse: Tensor, known_inverse: Tensor) -> tuple[float, float]:
    """Scale and shift that take predicted inverse depths [N] to the known ones [N]."""
    # Divided by the known value, errors are relative, so that far points count, too. The shift is
    # in units of the median, so that its penalty does not depend on the world's unit.
    unit = known_inverse.median()
    slope_column = inverse / known_inverse
    shift_column = unit / known_inverse
    columns = torch.stack([slope_column, shift_column], dim=1)  # [N, 2]

    scale = float((known_inverse / inverse).median())
    solution = torch.tensor([scale, 0.0], dtype=torch.float64)
    penalty = torch.diag(torch.tensor([0.0, SHIFT_PENALTY], dtype=torch.float64))
    for fit_round in range(FIT_ROUNDS):
        # From round to round, points with large errors lose more of their weight.
        weights = _weights(columns @ solution - 1, fit_round)
        weighted = columns * weights[:, None]

        # Weighted least squares of columns @ solution = 1: AᵀWA and AᵀW1. The penalty grows with
        # the points' weight, so that its part in the result does not depend on their number.
        normal = columns.T @ weighted + penalty * weights.sum()
        right_side = weighted.sum(0)
        solution = torch.linalg.solve(normal, right_side)
    fitted_scale, fitted_shift = solution.tolist()
    # Depth that runs the wrong way is no depth: then the scale alone is right.
    if fitted_scale <= 0:
        return scale, 0.0
    return fitted_scale, fitted_shift * float(unit)


def _fit_field(known_logs: Tensor, place: Tensor, nearness: Tensor) -> Tensor:
    """The smooth field [layers, rows, columns] of log factors that explains those of N points.

    Args:
        known_logs: [N] log of the factor by which each point's inverse depth must still change.
        place: [N, 2] x and y of the points in the photo, 0..1.
        nearness: [N] inverse depth of the points: 0 at the first layer, 1 at the last one.
    """
    # The field at a point is a weighted mean of its nodes: one row of `sampling`.
    layers, rows, columns = FIELD_NODES
    by_layer = _shares(nearness, layers)[:, :, None, None]
    by_row = _shares(place[:, 1], rows)[:, None, :, None]
    by_column = _shares(place[:, 0], columns)[:, None, None, :]
    sampling = (by_layer * by_row * by_column).flatten(1)  # [N, nodes]

    # More points may bend the field more, but twice as many do not say twice as much: the weight
    # of all together grows as the root of their number.
    points_a_node = len(known_logs) / (rows * columns)
    weight_of_points = 1 / max(1.0, points_a_node) ** 0.5

    # Least squares, in which points with large errors lose more of their weight in each round.
    smoothness = _smoothness()
    field = torch.zeros(sampling.shape[1], dtype=torch.float64)
    for fit_round in range(FIT_ROUNDS):
        errors = sampling @ field - known_logs
        weights = weight_of_points * _weights(errors, fit_round)
        normal = sampling.T @ (sampling * weights[:, None])
        right_side = sampling.T @ (weights * known_logs)
        field = torch.linalg.solve(normal + smoothness, right_side)
    return field.clamp(-MAX_FIELD, MAX_FIELD).reshape(FIELD_NODES)


def _shares(position: Tensor, count: int) -> Tensor:
    """[N, count] the share of each of equally spaced nodes at positions [N] of 0..1.

    A node's share falls from 1 to 0 over the distance to its neighbours.
    """
    steps = position.clamp(0, 1)[:, None] * (count - 1)
    return (1 - (steps - torch.arange(count)).abs()).clamp(min=0)


def _smoothness() -> Tensor:
    """[nodes, nodes] the matrix C by which a field f of log factors costs fᵀ C f.

    Bends within a layer (a grid over the photo at one depth), steps and bends from layer to layer,
    and large factors cost.
    """
    # The last axis of `nodes` holds, for each node, the coefficients that pick it out of a field.
    # So a difference of neighbours in this grid holds the coefficients of that difference.
    count = math.prod(FIELD_NODES)
    nodes = torch.eye(count, dtype=torch.float64).reshape(*FIELD_NODES, count)

    # Second differences down, across and along the diagonal; then those from layer to layer.
    down = nodes[:, :-2] - 2 * nodes[:, 1:-1] + nodes[:, 2:]
    across = nodes[:, :, :-2] - 2 * nodes[:, :, 1:-1] + nodes[:, :, 2:]
    twist = nodes[:, 1:, 1:] - nodes[:, 1:, :-1] - nodes[:, :-1, 1:] + nodes[:, :-1, :-1]
    step = nodes[1:] - nodes[:-1]
    layer_bend = nodes[:-2] - 2 * nodes[1:-1] + nodes[2:]
    weighted = [
        (BEND_PENALTY, down),
        (BEND_PENALTY, across),
        (2 * BEND_PENALTY, twist),  # a twist counts along both directions
        (STEP_PENALTY, step),
        (LAYER_BEND_PENALTY, layer_bend),
        (SIZE_PENALTY, nodes),
    ]
    # A difference d·f costs (d·f)² = fᵀ d dᵀ f.
    cost = torch.zeros(count, count, dtype=torch.float64)
    for weight, differences in weighted:
        rows = differences.reshape(-1, count)
        cost += weight * rows.T @ rows
    return cost


def move_gaussians(
    gaussians: Gaussians, correction: DepthCorrection, base_camera: Camera, camera: Camera
) -> Gaussians:
    """Gaussians moved along the rays of their pixels to the corrected depths.

    Their shapes follow: a surface that becomes steeper keeps thin, tilted Gaussians.

    Args:
        gaussians: in the frame of the photo's camera.
        correction: of the depths.
        base_camera: the photo's camera as the base assumed it, at the origin.
        camera: the photo's true camera, of the same size; only its lens counts.

    Returns:
        Gaussians in the frame of the true camera (x right, y down, z forward).
    """
    # The same pixel at the same depth, seen through the true lens: K⁻¹ K_base.
    lens_change = torch.linalg.solve(camera.K.double(), base_camera.K.double())
    means = gaussians.means.double() @ lens_change.T
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    K = camera.K.double()

    # r = z' / z at each mean: the corrected depth by the old one. A Gaussian behind the camera,
    # which no base makes, has no place in the photo; it is moved by the correction's scale alone,
    # which is one of inverse depths, so depths are divided by it.
    with torch.enable_grad():
        points = means.clone().requires_grad_(True)
        z = points[:, 2]
        is_in_front = z > 0
        safe_z = z.where(is_in_front, torch.ones_like(z))
        place = (points @ K.T)[:, :2] / safe_z[:, None] / size
        corrected = correction.inverse_depth(1 / safe_z, place)
        ratio = 1 / (safe_z * corrected)
        ratio = ratio.where(is_in_front, torch.full_like(ratio, 1 / correction.scale))
        # Each ratio depends on its own point alone, so one backward pass gives all gradients.
        (ratio_gradient,) = torch.autograd.grad(ratio.sum(), points)
    ratio = ratio.detach()

    # A Gaussian's shape follows the map near its mean, its Jacobian. After the change of lens, the
    # map is x' = r(x) · x, whose Jacobian is r I + x ∇rᵀ.
    identity = torch.eye(3, dtype=torch.float64)
    jacobian = ratio[:, None, None] * identity + means[:, :, None] * ratio_gradient[:, None, :]
    factor = quat_to_matrix(gaussians.quats.double()) * gaussians.scales.double()[:, None, :]

    # With factor = rotation · scales, the covariance is factor · factorᵀ. The singular values of
    # the changed factor are the new standard deviations, along the left singular vectors.
    axes, scales, _ = torch.linalg.svd(jacobian @ (lens_change @ factor))

    # Axes that form a mirrored frame (determinant -1) are no rotation. An axis may point either
    # way, so all three are turned round.
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()
    dtype = gaussians.means.dtype
    return dataclasses.replace(
        gaussians,
        means=(means * ratio[:, None]).to(dtype),
        quats=quat_from_matrix(axes).to(dtype),
        scales=scales.to(dtype),
    )
