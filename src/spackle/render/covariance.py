"""The covariance of a projected Gaussian, as formulas for kernels.

A Gaussian has the covariance Σ = R S (R S)ᵀ, with the rotation R of its quaternion and its scales
S. Seen by a camera with the rotation W, and with the projection's Jacobian J at the centre, it
covers an ellipse with the covariance M Mᵀ, M = J W R S.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from spackle.runtime.kernels import Array, inlined_kernel

Numbers = Array | tuple[Any, ...]

MIN_SQUARED_NORM = 1e-24  # of a quaternion, for a safe division

# The indices of the numbers in `KernelCamera.lens`.
FX, FY, CX, CY, MIN_X_SLOPE, MAX_X_SLOPE, MIN_Y_SLOPE, MAX_Y_SLOPE = range(8)


@inlined_kernel
def projected_covariance(
    x_slope: float,
    y_slope: float,
    inverse_z: float,
    quat: Numbers,
    scale: Numbers,
    lens: Array,
    pose: Array,
    eps2d: float,
) -> Numbers:
    """The projected covariance in pixels² as (xx, xy, yy, determinant), for one Gaussian.

    Args:
        x_slope, y_slope, inverse_z: x/z, y/z and 1/z of the centre (x, y, z) in the camera's frame.
        quat: [4] wxyz, of any length.
        scale: [3] standard deviations along the Gaussian's axes.
        lens: [8] fx, fy, cx, cy in pixels, and the bounds (left, right, top, bottom) of the slopes
            x/z and y/z, beyond which the Jacobian stays the same.
        pose: [3, 4] world to camera.
        eps2d: added to xx and yy, in pixels².
    """
    jacobian = projection_jacobian(x_slope, y_slope, inverse_z, lens)
    factor = covariance_factor(jacobian, pose, rotation_matrix(quat), scale)
    return widened_covariance(factor, eps2d)


@inlined_kernel
def projection_jacobian(x_slope: float, y_slope: float, inverse_z: float, lens: Array) -> Numbers:
    """The Jacobian [[xx, 0, xz], [0, yy, yz]] of the projection to pixels, as (xx, xz, yy, yz).

    Its rows are pixel x and y, its columns the coordinates of a point (x, y, z) in the camera's
    frame, at which it is [[fx/z, 0, -fx·x/z²], [0, fy/z, -fy·y/z²]].

    Args:
        x_slope, y_slope, inverse_z: x/z, y/z and 1/z of the point.
        lens: [8] fx, fy, cx, cy in pixels, and bounds (left, right, top, bottom) of the slopes. As
            in gsplat, a slope beyond its bound counts as the bound.
    """
    xx = lens[FX] * inverse_z
    yy = lens[FY] * inverse_z
    xz = -xx * min(lens[MAX_X_SLOPE], max(lens[MIN_X_SLOPE], x_slope))
    yz = -yy * min(lens[MAX_Y_SLOPE], max(lens[MIN_Y_SLOPE], y_slope))
    return xx, xz, yy, yz


@inlined_kernel
def rotation_matrix(quat: Numbers) -> Numbers:
    """The nine numbers of a rotation matrix, row by row, from a quaternion (wxyz) of any length."""
    qw = np.float64(quat[0])
    qx = np.float64(quat[1])
    qy = np.float64(quat[2])
    qz = np.float64(quat[3])
    # The usual factor 2, divided by ‖q‖², so that the quaternion counts as normalised.
    two = 2.0 / max(qw * qw + qx * qx + qy * qy + qz * qz, MIN_SQUARED_NORM)
    r00 = 1 - two * (qy * qy + qz * qz)
    r01 = two * (qx * qy - qw * qz)
    r02 = two * (qx * qz + qw * qy)
    r10 = two * (qx * qy + qw * qz)
    r11 = 1 - two * (qx * qx + qz * qz)
    r12 = two * (qy * qz - qw * qx)
    r20 = two * (qx * qz - qw * qy)
    r21 = two * (qy * qz + qw * qx)
    r22 = 1 - two * (qx * qx + qy * qy)
    return r00, r01, r02, r10, r11, r12, r20, r21, r22


@inlined_kernel
def covariance_factor(jacobian: Numbers, pose: Array, rotation: Numbers, scale: Numbers) -> Numbers:
    """The two rows of M = J W R S, whose product M Mᵀ is the projected covariance, in float64.

    Args:
        jacobian: J = [[xx, 0, xz], [0, yy, yz]] as (xx, xz, yy, yz).
        pose: [3, 4] world to camera; W is its rotation.
        rotation: R, row by row.
        scale: [3] standard deviations, the diagonal of S.
    """
    xx, xz, yy, yz = jacobian
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation

    # The rows of J W: h for pixel x (horizontal), v for pixel y (vertical).
    h0 = xx * pose[0, 0] + xz * pose[2, 0]
    h1 = xx * pose[0, 1] + xz * pose[2, 1]
    h2 = xx * pose[0, 2] + xz * pose[2, 2]
    v0 = yy * pose[1, 0] + yz * pose[2, 0]
    v1 = yy * pose[1, 1] + yz * pose[2, 1]
    v2 = yy * pose[1, 2] + yz * pose[2, 2]

    # Times the columns of R S: the first row (m0, m1, m2) of M, and the second one (n0, n1, n2).
    s0 = np.float64(scale[0])
    s1 = np.float64(scale[1])
    s2 = np.float64(scale[2])
    m0 = s0 * (h0 * r00 + h1 * r10 + h2 * r20)
    m1 = s1 * (h0 * r01 + h1 * r11 + h2 * r21)
    m2 = s2 * (h0 * r02 + h1 * r12 + h2 * r22)
    n0 = s0 * (v0 * r00 + v1 * r10 + v2 * r20)
    n1 = s1 * (v0 * r01 + v1 * r11 + v2 * r21)
    n2 = s2 * (v0 * r02 + v1 * r12 + v2 * r22)
    return m0, m1, m2, n0, n1, n2


@inlined_kernel
def widened_covariance(factor: Numbers, eps2d: float) -> Numbers:
    """The covariance M Mᵀ + eps2d·I in pixels² as (xx, xy, yy, determinant).

    `factor` has the two rows m and n of M, one after the other. The determinant of M Mᵀ is the
    squared cross product of these rows (Cauchy–Binet), which is exact also for a Gaussian that is
    seen edge-on.
    """
    m0, m1, m2, n0, n1, n2 = factor
    cxx = m0 * m0 + m1 * m1 + m2 * m2
    cyy = n0 * n0 + n1 * n1 + n2 * n2
    cxy = m0 * n0 + m1 * n1 + m2 * n2

    # The cross product of the rows.
    k0 = m1 * n2 - m2 * n1
    k1 = m2 * n0 - m0 * n2
    k2 = m0 * n1 - m1 * n0
    det = k0 * k0 + k1 * k1 + k2 * k2 + eps2d * (cxx + cyy + eps2d)
    return cxx + eps2d, cxy, cyy + eps2d, det
