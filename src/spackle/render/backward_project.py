"""The backward pass of projection: from sums over pixels to gradients of the Gaussians' tensors."""

from __future__ import annotations

import math

import numpy as np

from spackle.render.covariance import (
    FX,
    FY,
    MAX_X_SLOPE,
    MAX_Y_SLOPE,
    MIN_X_SLOPE,
    MIN_Y_SLOPE,
    Numbers,
    covariance_factor,
    projection_jacobian,
    rotation_matrix,
    widened_covariance,
)
from spackle.render.project import Arrays, KernelCamera
from spackle.runtime.kernels import Array, inlined_kernel, kernel

MIN_NORM = 1e-12  # of a quaternion, for a safe division


@kernel
def project_backward(
    start: int, stop: int, scene: Arrays, camera: KernelCamera, table: Array, gradients: Arrays
) -> None:
    """Write the gradients of the Gaussians start..stop of a set, computed in float64.

    Args:
        start, stop: indices in the set.
        scene: the set's arrays: means [n, 3], quats [n, 4], scales [n, 3], opacities [n],
            colors [n, 3].
        camera: the view.
        table: [n, 10] sums over pixels: with the offset (dx, dy) from the centre,
            u = dx - slope·dy and v = ∂L/∂ln(alpha) the sums of v, v·u, v·u², v·dy, v·dy², v·u·dy;
            then the gradients of red, green, blue and depth. A row of zeros belongs to an invisible
            Gaussian, which gets no gradients.
        gradients: of the arrays of `scene`, of the same shapes, zero at first; written here.
    """
    means, quats, scales, opacities, _ = scene
    lens = camera.lens
    pose = camera.pose
    means_grad, quats_grad, scales_grad, opacities_grad, colors_grad = gradients
    center = np.empty(3)  # in the camera's frame
    factor_grad = np.empty((2, 3))
    rotation_grad = np.empty((3, 3))
    jacobian_grad = np.empty((2, 3))
    for i in range(start, stop):
        sums = table[i]
        if not sums.any():
            continue
        colors_grad[i, 0] = sums[6]
        colors_grad[i, 1] = sums[7]
        colors_grad[i, 2] = sums[8]
        # alpha is proportional to the opacity, so ∂ln(alpha)/∂opacity = 1 / opacity.
        opacities_grad[i] = sums[0] / opacities[i]

        # The forward pass once more, as in `project_block`.
        transform_point(pose, means[i], center)
        inverse_z = 1.0 / center[2]
        jacobian = projection_jacobian(
            center[0] * inverse_z, center[1] * inverse_z, inverse_z, lens
        )
        rotation = rotation_matrix(quats[i])
        factor = covariance_factor(jacobian, pose, rotation, scales[i])

        # And back, step by step.
        u_grad, v_grad = ellipse_backward(sums, factor, camera.eps2d, factor_grad)
        factor_backward(
            jacobian,
            pose,
            rotation,
            scales[i],
            factor_grad,
            (jacobian_grad, rotation_grad),
            scales_grad[i],
        )
        quat_backward(quats[i], rotation_grad, quats_grad[i])
        center_grad = center_backward(center, lens, jacobian_grad, u_grad, v_grad, sums[9])
        for b in range(3):
            means_grad[i, b] = (
                pose[0, b] * center_grad[0]
                + pose[1, b] * center_grad[1]
                + pose[2, b] * center_grad[2]
            )


@inlined_kernel
def transform_point(pose: Array, point: Array, result: Array) -> None:
    """Write a world point [3] to `result` [3], in the frame of a camera with `pose` [3, 4]."""
    for a in range(3):
        result[a] = (
            pose[a, 0] * point[0] + pose[a, 1] * point[1] + pose[a, 2] * point[2] + pose[a, 3]
        )


@kernel
def ellipse_backward(
    sums: Array, factor: Numbers, eps2d: float, factor_grad: Array
) -> tuple[float, float]:
    """Turn sums over pixels into gradients of a projected Gaussian's shape and centre.

    For a pixel at the offset d = (dx, dy) from the centre, alpha is the opacity times
    exp(-½ (fall·dy² + across·u²)). Here u = dx - slope·dy is the distance from the place in the
    pixel's row where alpha is largest, fall = 1/Σyy, across = Σyy/det Σ and slope = Σxy/Σyy.

    With p = Σ⁻¹ d = (across·u, fall·dy - slope·across·u), the derivatives are
    ∂ln(alpha)/∂centre = p and ∂ln(alpha)/∂Σ = ½ p pᵀ.

    Args:
        sums: [10] over pixels, with v = ∂L/∂ln(alpha): of v, v·u, v·u², v·dy, v·dy², v·u·dy; then
            four that are not used here.
        factor: M row by row, with Σ = M Mᵀ + eps2d·I.
        eps2d: pixels².
        factor_grad: [2, 3]: the gradient of M is written here.

    Returns:
        The gradient of the centre's pixel position (u, v).
    """
    _, sum_vu, sum_vuu, sum_vdy, sum_vdydy, sum_vudy, _, _, _, _ = sums
    _, xy, yy, det = widened_covariance(factor, eps2d)
    across = yy / det
    fall = 1.0 / yy
    skew = xy / yy * across  # slope·across

    # The sums over pixels of v·p pᵀ, which are twice the gradient of Σ. In Σ = M Mᵀ + …, M occurs
    # twice, so that the gradient of M is twice the gradient of Σ times M.
    xx_grad = across * across * sum_vuu
    xy_grad = across * fall * sum_vudy - across * skew * sum_vuu
    yy_grad = fall * fall * sum_vdydy - 2.0 * fall * skew * sum_vudy + skew * skew * sum_vuu
    for k in range(3):
        m = factor[k]  # M[0, k]
        n = factor[3 + k]  # M[1, k]
        factor_grad[0, k] = xx_grad * m + xy_grad * n
        factor_grad[1, k] = xy_grad * m + yy_grad * n
    return across * sum_vu, fall * sum_vdy - skew * sum_vu


@kernel
def factor_backward(
    jacobian: Numbers,
    pose: Array,
    rotation: Numbers,
    scale: Array,
    factor_grad: Array,
    grads: Arrays,
    scale_grad: Array,
) -> None:
    """Turn the gradient of M = J W R S into gradients of J, of R and of the scales S.

    Element by element, M[i, k] is the sum over j of (J W)[i, j]·R[j, k]·S[k]. Here i is pixel x or
    y, j an axis of the world, and k an axis of the Gaussian.

    Args:
        jacobian: J = [[xx, 0, xz], [0, yy, yz]] as (xx, xz, yy, yz).
        pose: [3, 4] world to camera; W is its rotation.
        rotation: R, row by row.
        scale: [3] standard deviations.
        factor_grad: [2, 3] of M.
        grads: of J [2, 3] and of R [3, 3], written here.
        scale_grad: [3], written here.
    """
    jacobian_grad, rotation_grad = grads
    xx, xz, yy, yz = jacobian
    jacobian_grad[:, :] = 0.0
    for k in range(3):
        scale_grad[k] = 0.0
        for j in range(3):
            # The elements (J W)[0, j] for pixel x and (J W)[1, j] for pixel y.
            jw_x = xx * pose[0, j] + xz * pose[2, j]
            jw_y = yy * pose[1, j] + yz * pose[2, j]
            # They are the factors of R[j, k]·S[k] in M[0, k] and M[1, k], which gives the gradient
            # of this product, and so the gradients of both its factors.
            product_grad = jw_x * factor_grad[0, k] + jw_y * factor_grad[1, k]
            rotation_element = rotation[3 * j + k]
            scale_grad[k] += product_grad * rotation_element
            rotation_grad[j, k] = product_grad * scale[k]

            # (J W)[i, j] is the sum over the camera's axes c of J[i, c]·W[c, j].
            for i in range(2):
                for c in range(3):
                    jacobian_grad[i, c] += (
                        factor_grad[i, k] * scale[k] * rotation_element * pose[c, j]
                    )


@kernel
def quat_backward(quat: Array, rotation_grad: Array, quat_grad: Array) -> None:
    """Turn the gradient of a rotation matrix into that of its quaternion before normalisation.

    The matrix of a unit quaternion (w, x, y, z) is

        1 - 2(yy + zz)    2(xy - wz)    2(xz + wy)
          2(xy + wz)    1 - 2(xx + zz)  2(yz - wx)
          2(xz - wy)      2(yz + wx)  1 - 2(xx + yy)

    Args:
        quat: [4] wxyz, of any length.
        rotation_grad: [3, 3].
        quat_grad: [4], written here.
    """
    w = np.float64(quat[0])
    x = np.float64(quat[1])
    y = np.float64(quat[2])
    z = np.float64(quat[3])
    inverse_norm = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), MIN_NORM)
    w = w * inverse_norm
    x = x * inverse_norm
    y = y * inverse_norm
    z = z * inverse_norm

    # The derivative of this matrix by each component, times the gradient r of the matrix.
    r = rotation_grad
    w_grad = 2 * (x * (r[2, 1] - r[1, 2]) + y * (r[0, 2] - r[2, 0]) + z * (r[1, 0] - r[0, 1]))
    x_grad = 2 * (
        w * (r[2, 1] - r[1, 2]) + y * (r[0, 1] + r[1, 0]) + z * (r[0, 2] + r[2, 0])
    ) - 4 * x * (r[1, 1] + r[2, 2])
    y_grad = 2 * (
        w * (r[0, 2] - r[2, 0]) + x * (r[0, 1] + r[1, 0]) + z * (r[1, 2] + r[2, 1])
    ) - 4 * y * (r[0, 0] + r[2, 2])
    z_grad = 2 * (
        w * (r[1, 0] - r[0, 1]) + x * (r[0, 2] + r[2, 0]) + y * (r[1, 2] + r[2, 1])
    ) - 4 * z * (r[0, 0] + r[1, 1])

    # Normalisation removes the part of the gradient along the quaternion.
    along = w_grad * w + x_grad * x + y_grad * y + z_grad * z
    quat_grad[0] = (w_grad - along * w) * inverse_norm
    quat_grad[1] = (x_grad - along * x) * inverse_norm
    quat_grad[2] = (y_grad - along * y) * inverse_norm
    quat_grad[3] = (z_grad - along * z) * inverse_norm


@kernel
def center_backward(
    center: Array,
    lens: Array,
    jacobian_grad: Array,
    u_grad: float,
    v_grad: float,
    depth_grad: float,
) -> tuple[float, float, float]:
    """The gradient of a Gaussian's centre in the camera's frame.

    Args:
        center: [3] in the camera's frame.
        lens: [8] fx, fy, cx, cy in pixels, and the bounds (left, right, top, bottom) of the slopes
            x/z and y/z for which the Jacobian is exact.
        jacobian_grad: [2, 3] of the projection's Jacobian, which depends on the centre, too.
        u_grad, v_grad: of the centre's pixel position.
        depth_grad: of its depth z.
    """
    x, y, z = center
    # The Jacobian uses these limited slopes; at a limit they do not move with the centre.
    x_slope = min(lens[MAX_X_SLOPE], max(lens[MIN_X_SLOPE], x / z))
    y_slope = min(lens[MAX_Y_SLOPE], max(lens[MIN_Y_SLOPE], y / z))
    fx_over_z = lens[FX] / z
    fy_over_z = lens[FY] / z

    # By way of the pixel position u = fx·x/z, v = fy·y/z, and of the depth.
    x_grad = fx_over_z * u_grad
    y_grad = fy_over_z * v_grad
    z_grad = depth_grad - (x_grad * x + y_grad * y) / z

    # By way of the Jacobian [[fx/z, 0, -fx·slope/z], [0, fy/z, -fy·slope/z]]: first by its factor
    # 1/z, then by the slopes, where they move.
    z_grad -= (fx_over_z * jacobian_grad[0, 0] + fy_over_z * jacobian_grad[1, 1]) / z
    z_grad += (
        fx_over_z * x_slope * jacobian_grad[0, 2] + fy_over_z * y_slope * jacobian_grad[1, 2]
    ) / z
    if lens[MIN_X_SLOPE] <= x / z <= lens[MAX_X_SLOPE]:
        x_grad -= fx_over_z / z * jacobian_grad[0, 2]
        z_grad += fx_over_z / z * x_slope * jacobian_grad[0, 2]
    if lens[MIN_Y_SLOPE] <= y / z <= lens[MAX_Y_SLOPE]:
        y_grad -= fy_over_z / z * jacobian_grad[1, 2]
        z_grad += fy_over_z / z * y_slope * jacobian_grad[1, 2]
    return x_grad, y_grad, z_grad
