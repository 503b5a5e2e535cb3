"""Real spherical harmonics of the degrees 1 to 3, as 3D Gaussian splatting orders and signs them.

A function of direction d is f(d) = Σ cₖ Yₖ(d). Coefficients stand in the order of the degree, and
within a degree l in the order m = -l..l: 3 of degree 1, then 5 of degree 2, then 7 of degree 3. The
constant harmonic of degree 0 is not among them.
"""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

MAX_DEGREE = 3
# The number of harmonics of the degrees 1 to d, for d = 0, 1, 2, 3.
HARMONICS_COUNTS = (0, 3, 8, 15)

# Factors that make the integral of Yₖ² over all directions 1.
C1 = math.sqrt(3 / (4 * math.pi))
C2_MIXED = math.sqrt(15 / (4 * math.pi))  # of x y, y z, x z
C2_AXIAL = math.sqrt(5 / (16 * math.pi))  # of 2 z² - x² - y²
C2_SQUARES = math.sqrt(15 / (16 * math.pi))  # of x² - y²
C3_OUTER = math.sqrt(35 / (32 * math.pi))  # of y (3 x² - y²), x (x² - 3 y²)
C3_MIXED = math.sqrt(105 / (4 * math.pi))  # of x y z
C3_INNER = math.sqrt(21 / (32 * math.pi))  # of x (4 z² - x² - y²), y (4 z² - x² - y²)
C3_AXIAL = math.sqrt(7 / (16 * math.pi))  # of z (2 z² - 3 x² - 3 y²)
C3_SQUARES = math.sqrt(105 / (16 * math.pi))  # of z (x² - y²)

# Rounding errors of a rotation's matrix that are below this are not from the rotation itself.
EXACT_TOLERANCE = 1e-9


def degree_of_count(count: int) -> int:
    """The degree of a set of `count` harmonics; ValueError unless it is 0, 3, 8 or 15."""
    if count not in HARMONICS_COUNTS:
        raise ValueError(f"{count} spherical harmonics: 3, 8 or 15 are the degrees 1, 2 and 3")
    return HARMONICS_COUNTS.index(count)


def harmonics_of(directions: Tensor, degree: int) -> Tensor:
    """The values Yₖ(d) of all harmonics of the degrees 1 to `degree`, [..., 3 | 8 | 15].

    `directions` are unit vectors [..., 3].
    """
    x, y, z = directions.unbind(-1)
    values = [-C1 * y, C1 * z, -C1 * x]
    xx = x * x
    yy = y * y
    zz = z * z
    if degree >= 2:
        values += [
            C2_MIXED * (x * y),
            -C2_MIXED * (y * z),
            C2_AXIAL * (2 * zz - xx - yy),
            -C2_MIXED * (x * z),
            C2_SQUARES * (xx - yy),
        ]
    if degree >= 3:
        values += [
            -C3_OUTER * y * (3 * xx - yy),
            C3_MIXED * (x * y) * z,
            -C3_INNER * y * (4 * zz - xx - yy),
            C3_AXIAL * z * (2 * zz - 3 * xx - 3 * yy),
            -C3_INNER * x * (4 * zz - xx - yy),
            C3_SQUARES * z * (xx - yy),
            -C3_OUTER * x * (xx - 3 * yy),
        ]
    return torch.stack(values, dim=-1)


def rotate_harmonics(coefficients: Tensor, rotation: Tensor) -> Tensor:
    """The coefficients [N, K, 3] of functions that were turned together with the scene.

    The turned function g of f is g(R d) = f(d). Half and quarter turns about an axis, and mirrors,
    exchange and negate coefficients without changing a bit of them.

    Args:
        coefficients: [N, K, 3] for K harmonics and three colours.
        rotation: [3, 3] the matrix R; it may also mirror.
    """
    degree = degree_of_count(coefficients.shape[1])
    directions = _sample_directions().to(coefficients.device)  # [S, 3]
    rotation = rotation.to(directions)
    # Rows are Rᵀ d, the directions that R turns into the samples.
    before = harmonics_of(directions @ rotation, degree)  # [S, K]
    after = harmonics_of(directions, degree)

    parts = []
    for band in range(1, degree + 1):
        # Coefficients of one degree mix only with each other: Σ c'ₖ Yₖ(d) = Σ cₖ Yₖ(Rᵀ d) for all
        # samples d, which are more than enough to find the matrix from c to c'.
        rows = slice(HARMONICS_COUNTS[band - 1], HARMONICS_COUNTS[band])
        matrix = torch.linalg.lstsq(after[:, rows].cpu(), before[:, rows].cpu()).solution
        # So that a coefficient is not changed by the rounding errors of zeros and ones.
        nearest = matrix.round()
        matrix = torch.where((matrix - nearest).abs() < EXACT_TOLERANCE, nearest, matrix)
        matrix = matrix.to(coefficients.device)
        parts.append(torch.einsum("jk,nkc->njc", matrix, coefficients[:, rows].double()))
    return torch.cat(parts, dim=1).to(coefficients.dtype)


@functools.cache
def _sample_directions() -> Tensor:
    """Unit vectors [32, 3] in float64, spread over the sphere along a spiral."""
    count = 32  # more than twice the seven harmonics of degree 3
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / count
    golden_angle = math.pi * (3 - math.sqrt(5))
    angle = golden_angle * index
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)
