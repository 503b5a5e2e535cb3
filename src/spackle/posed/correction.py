"""Bring a photo's predicted depth to the depth of known points, and move its Gaussians likewise.

A base guesses depth from one photo: its unit is unknown, and near and far may be too close to each
other. Points of a reconstruction have depths in the world's unit. `fit_correction` finds the map
between the two, `move_gaussians` applies it.
"""

from __future__ import annotations

import dataclasses

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
FIELD_NODES = (10, 13)  # rows and columns of the field of factors over a photo
# Weights of the field's bends and of its size, for a mean number of one point to a node.
BEND_PENALTY = 0.1
SIZE_PENALTY = 0.01
MAX_FIELD = 0.7  # largest log factor of the field: a factor of two


@dataclasses.dataclass(frozen=True)
class DepthCorrection:
    """A map of depths in a photo: 1/z' = exp(field at the pixel) · (scale / z + shift)."""

    scale: float
    shift: float  # 1 / unit of the world
    # [rows, columns] log factors on a regular grid, whose outer nodes lie at the photo's corners.
    field: Tensor

    def inverse_depth(self, inverse: Tensor, place: Tensor) -> Tensor:
        """The corrected inverse depth [N], positive wherever `inverse` [N] is.

        `place` [N, 2] is the pixel's x and y, from 0 to 1 over the photo.
        """
        scaled = self.scale * inverse
        shifted = torch.maximum(scaled + self.shift, MIN_KEPT_RATIO * scaled)
        return self._factors(place) * shifted

    def _factors(self, place: Tensor) -> Tensor:
        """The field's factors [N] at places [N, 2] of 0..1, linear between nodes in their logs."""
        # `grid_sample` takes -1..1, and repeats the border beyond it.
        grid = (2 * place - 1)[None, None]  # [1, 1, N, 2]
        field = self.field.to(place)[None, None]  # [1, 1, rows, columns]
        logs = grid_sample(field, grid, padding_mode="border", align_corners=True)
        return logs[0, 0, 0].exp()


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
    place = points.uv[usable].double() / torch.tensor([width, height], dtype=torch.float64)

    # First one scale and shift for the whole photo, then what a smooth field can still explain.
    scale, shift = _fit_scale_and_shift(inverse, known_inverse)
    flat = torch.zeros(FIELD_NODES, dtype=torch.float64)
    correction = DepthCorrection(scale, shift, flat)
    if with_field:
        # log(known / predicted) is what the field should be at each point.
        missing = (known_inverse / correction.inverse_depth(inverse, place)).log()
        correction = DepthCorrection(scale, shift, _fit_field(missing, place))

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
    """[N] weights by the errors [N]: 1 for none, a quarter at two deviations, 0 for gross ones.

    What counts as gross becomes less from round to round (graduated non-convexity).
    """
    part = fit_round / (FIT_ROUNDS - 1)  # 0 in the first round, 1 in the last
    least = FIRST_DEVIATION * (MIN_DEVIATION / FIRST_DEVIATION) ** part
    relative = errors / (2 * _deviation(errors, least))
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
        weights = _weights(columns @ solution - 1, fit_round)
        weighted = columns * weights[:, None]
        normal = columns.T @ weighted + penalty * weights.sum()
        solution = torch.linalg.solve(normal, weighted.sum(0))
    fitted_scale, fitted_shift = solution.tolist()
    # Depth that runs the wrong way is no depth: then the scale alone is right.
    if fitted_scale <= 0:
        return scale, 0.0
    return fitted_scale, fitted_shift * float(unit)


def _fit_field(missing: Tensor, place: Tensor) -> Tensor:
    """[rows, columns] log factors that explain `missing` [N] at places [N, 2] of 0..1, smoothly."""
    rows, columns = FIELD_NODES
    sampling = _bilinear_weights(place)  # [N, rows · columns]
    # With few points to a node, the bends cost more than what they explain.
    mean_weight = len(missing) / (rows * columns)
    bends = _bend_rows()
    smoothness = BEND_PENALTY * bends.T @ bends + SIZE_PENALTY * torch.eye(rows * columns)
    field = torch.zeros(rows * columns, dtype=torch.float64)
    for fit_round in range(FIT_ROUNDS):
        weights = _weights(sampling @ field - missing, fit_round)
        normal = sampling.T @ (sampling * weights[:, None]) / max(1.0, mean_weight) ** 0.5
        right_side = sampling.T @ (weights * missing) / max(1.0, mean_weight) ** 0.5
        field = torch.linalg.solve(normal + smoothness, right_side)
    return field.clamp(-MAX_FIELD, MAX_FIELD).reshape(rows, columns)


def _bilinear_weights(place: Tensor) -> Tensor:
    """[N, nodes] the share of each of the field's nodes at places [N, 2] of 0..1."""
    rows, columns = FIELD_NODES
    x = place[:, 0].clamp(0, 1) * (columns - 1)
    y = place[:, 1].clamp(0, 1) * (rows - 1)
    # The share of a node falls from 1 to 0 over the distance to its neighbours.
    across = (1 - (x[:, None] - torch.arange(columns)).abs()).clamp(min=0)  # [N, columns]
    down = (1 - (y[:, None] - torch.arange(rows)).abs()).clamp(min=0)  # [N, rows]
    return (down[:, :, None] * across[:, None, :]).flatten(1)


def _bend_rows() -> Tensor:
    """[bends, nodes] second differences along the rows and columns of the field, and across."""
    rows, columns = FIELD_NODES
    nodes = torch.eye(rows * columns, dtype=torch.float64).reshape(rows, columns, -1)
    along_columns = nodes[:-2] - 2 * nodes[1:-1] + nodes[2:]
    along_rows = nodes[:, :-2] - 2 * nodes[:, 1:-1] + nodes[:, 2:]
    twist = nodes[1:, 1:] - nodes[1:, :-1] - nodes[:-1, 1:] + nodes[:-1, :-1]
    parts = [along_columns, along_rows, 2**0.5 * twist]
    return torch.cat([part.reshape(-1, rows * columns) for part in parts])


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

    # r = z' / z at each mean. A Gaussian behind the camera, which no base makes, is only scaled.
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

    # x' = r(x) · x has the Jacobian r I + x ∇rᵀ, after the change of lens.
    identity = torch.eye(3, dtype=torch.float64)
    jacobian = ratio[:, None, None] * identity + means[:, :, None] * ratio_gradient[:, None, :]
    factor = quat_to_matrix(gaussians.quats.double()) * gaussians.scales.double()[:, None, :]
    axes, scales, _ = torch.linalg.svd(jacobian @ (lens_change @ factor))
    # A mirrored frame of axes is no rotation; an axis may point either way.
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()
    dtype = gaussians.means.dtype
    return dataclasses.replace(
        gaussians,
        means=(means * ratio[:, None]).to(dtype),
        quats=quat_from_matrix(axes).to(dtype),
        scales=scales.to(dtype),
    )
