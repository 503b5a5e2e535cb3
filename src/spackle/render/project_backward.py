"""The projection's gradient: from what the pixels say about a splat to the Gaussian behind it."""

from __future__ import annotations

import math

import numpy as np

from spackle._numba import Array, kernel
from spackle.render.project import Four, Nine, Six, factor, jacobian, rotation, spread


@kernel
def project_backward(
    start: int,
    stop: int,
    means: Array,
    quats: Array,
    scales: Array,
    opacities: Array,
    lens: Array,
    pose: Array,
    eps2d: float,
    table: Array,
    means_grad: Array,
    quats_grad: Array,
    scales_grad: Array,
    opacities_grad: Array,
    colors_grad: Array,
) -> None:
    """Gradients of Gaussians start..stop of one set; arithmetic is float64 as in `project_chunk`.

    Args:
        table: [N, SUMS], what the pixels give to each Gaussian of the set (see SUMS). All
            zeros mean that no pixel saw it; the gradients are then left as they are.
    """
    local, factor_grad, rotation_grad, jacobian_grad = np.empty(3), np.empty((2, 3)), np.empty((3, 3)), np.empty((2, 3))
    for i in range(start, stop):
        row = table[i]
        if not row.any():
            continue
        colors_grad[i, 0], colors_grad[i, 1], colors_grad[i, 2] = row[6], row[7], row[8]
        opacities_grad[i] = row[0] / opacities[i]
        for a in range(3):
            local[a] = pose[a, 0] * means[i, 0] + pose[a, 1] * means[i, 1] + pose[a, 2] * means[i, 2] + pose[a, 3]
        nearness = 1.0 / local[2]
        j, r = jacobian(local[0] * nearness, local[1] * nearness, nearness, lens), rotation(quats[i])
        u_grad, v_grad = splat_backward(row, factor(j, pose, r, scales[i]), eps2d, factor_grad)
        factor_backward(j, pose, r, scales[i], factor_grad, jacobian_grad, rotation_grad, scales_grad[i])
        quat_backward(quats[i], rotation_grad, quats_grad[i])
        local_grad = point_backward(local, lens, jacobian_grad, u_grad, v_grad, row[9])
        for b in range(3):
            means_grad[i, b] = pose[0, b] * local_grad[0] + pose[1, b] * local_grad[1] + pose[2, b] * local_grad[2]


@kernel
def splat_backward(row: Array, factors: Six, eps2d: float, factor_grad: Array) -> tuple[float, float]:
    """From sums over pixels to the gradients of the factor M, and of the centre, which are returned.

    For a pixel at d from the centre, ∂ln(alpha)/∂centre = p and ∂ln(alpha)/∂Σ = ½ p pᵀ with p = Σ⁻¹ d.
    In the blender's terms p = (A·u, D·dy - k·A·u), with A = Σyy/det, D = 1/Σyy and the slope k = Σxy/Σyy.
    """
    _, xy, yy, det = spread(factors, eps2d)
    across, fall = yy / det, 1.0 / yy
    skew = xy / yy * across
    grad_xx = across * across * row[2]
    grad_xy = across * fall * row[5] - across * skew * row[2]
    grad_yy = fall * fall * row[4] - 2.0 * fall * skew * row[5] + skew * skew * row[2]
    for k in range(3):
        m, n = factors[k], factors[3 + k]
        factor_grad[0, k] = grad_xx * m + grad_xy * n
        factor_grad[1, k] = grad_xy * m + grad_yy * n
    return across * row[1], fall * row[3] - skew * row[1]


@kernel
def factor_backward(
    j: Four,
    pose: Array,
    r: Nine,
    scale: Array,
    factor_grad: Array,
    jacobian_grad: Array,
    rotation_grad: Array,
    scale_grad: Array,
) -> None:
    """From the gradient of the factor M = J W R S to those of the Jacobian J, the rotation R and the scales S."""
    jacobian_grad[:, :] = 0.0
    for k in range(3):
        scale_grad[k] = 0.0
        for b in range(3):
            # (J W) is two rows; its column b meets the axis' component b.
            h0, h1 = j[0] * pose[0, b] + j[1] * pose[2, b], j[2] * pose[1, b] + j[3] * pose[2, b]
            along, axis = h0 * factor_grad[0, k] + h1 * factor_grad[1, k], r[3 * b + k]
            scale_grad[k] += along * axis
            rotation_grad[b, k] = along * scale[k]
            for a in range(2):
                for c in range(3):
                    jacobian_grad[a, c] += factor_grad[a, k] * scale[k] * axis * pose[c, b]


@kernel
def quat_backward(quat: Array, r: Array, grad: Array) -> None:
    """From the gradient of a rotation matrix to that of the quaternion before normalisation."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    norm = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w * norm, x * norm, y * norm, z * norm
    gw = 2 * (x * (r[2, 1] - r[1, 2]) + y * (r[0, 2] - r[2, 0]) + z * (r[1, 0] - r[0, 1]))
    gx = 2 * (w * (r[2, 1] - r[1, 2]) + y * (r[0, 1] + r[1, 0]) + z * (r[0, 2] + r[2, 0])) - 4 * x * (r[1, 1] + r[2, 2])
    gy = 2 * (w * (r[0, 2] - r[2, 0]) + x * (r[0, 1] + r[1, 0]) + z * (r[1, 2] + r[2, 1])) - 4 * y * (r[0, 0] + r[2, 2])
    gz = 2 * (w * (r[1, 0] - r[0, 1]) + x * (r[0, 2] + r[2, 0]) + y * (r[1, 2] + r[2, 1])) - 4 * z * (r[0, 0] + r[1, 1])
    along = gw * w + gx * x + gy * y + gz * z
    grad[0], grad[1] = (gw - along * w) * norm, (gx - along * x) * norm
    grad[2], grad[3] = (gy - along * y) * norm, (gz - along * z) * norm


@kernel
def point_backward(
    local: Array, lens: Array, jacobian_grad: Array, u_grad: float, v_grad: float, depth_grad: float
) -> tuple[float, float, float]:
    """The gradient of the centre in the camera's space, from its pixel, its Jacobian and its depth."""
    x, y, z = local
    tx, ty = min(lens[5], max(lens[4], x / z)), min(lens[7], max(lens[6], y / z))
    fx, fy = lens[0] / z, lens[1] / z
    x_grad, y_grad = fx * u_grad, fy * v_grad
    z_grad = depth_grad - (x_grad * x + y_grad * y) / z
    z_grad -= (fx * jacobian_grad[0, 0] + fy * jacobian_grad[1, 1]) / z
    z_grad += (fx * tx * jacobian_grad[0, 2] + fy * ty * jacobian_grad[1, 2]) / z
    if lens[4] <= x / z <= lens[5]:
        x_grad -= fx / z * jacobian_grad[0, 2]
        z_grad += fx / z * tx * jacobian_grad[0, 2]
    if lens[6] <= y / z <= lens[7]:
        y_grad -= fy / z * jacobian_grad[1, 2]
        z_grad += fy / z * ty * jacobian_grad[1, 2]
    return x_grad, y_grad, z_grad
