"""Gaussians and their quaternions, against SciPy's rotations."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.scenes import random_gaussians, same_bits
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from spackle.core.gaussians import Gaussians, quat_from_matrix, quat_multiply, quat_to_matrix

QUATS = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 1e-2)
PROPERTY = settings(deadline=None, max_examples=40)


def scipy_matrix(quat: tuple[float, ...]) -> Tensor:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    return torch.from_numpy(rotation.from_quat(np.roll(quat, -1)).as_matrix())


def similarity(quat: tuple[float, ...], factor: float, offset: tuple[float, ...]) -> Tensor:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = (
        factor * scipy_matrix(quat),
        torch.tensor(offset, dtype=torch.float64),
    )
    return matrix


@pytest.mark.parametrize("field", ["means", "quats", "scales", "opacities", "colors"])
def test_a_field_of_the_wrong_shape_is_named(field: str) -> None:
    with pytest.raises(ValueError, match=r"Gaussians\.\w+ has shape"):
        dataclasses.replace(random_gaussians(3), **{field: getattr(random_gaussians(2), field)})


def test_joined_sets_keep_their_order_bit_for_bit() -> None:
    first, second, third = (random_gaussians(n, n, torch.float64) for n in (3, 1, 5))
    joined = Gaussians.cat([Gaussians.empty(dtype=torch.float64), first, second, third])
    assert (len(joined), len(Gaussians.empty())) == (9, 0)
    assert same_bits(joined.select(slice(0, 3)), first)
    assert same_bits(joined.select(torch.tensor([3])), second)
    assert same_bits(joined.select(torch.arange(9) >= 4), third)
    asking = Gaussians(*(t.requires_grad_() for t in first.tensors))
    assert all(
        t.requires_grad and t.dtype == torch.float32 for t in asking.to(dtype=torch.float32).tensors
    )
    assert not any(t.requires_grad for t in asking.detach().tensors)


@PROPERTY
@given(QUATS, QUATS)
def test_quaternions_rotate_like_scipys(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    one, other = (torch.tensor(quat, dtype=torch.float64) for quat in (a, b))
    for factor in (1, 7.5):
        torch.testing.assert_close(
            quat_to_matrix(factor * one), scipy_matrix(a), rtol=0, atol=1e-12
        )
    back = quat_from_matrix(scipy_matrix(a))
    assert (float(back.norm()), bool(back[0] >= 0)) == (pytest.approx(1, abs=1e-12), True)
    torch.testing.assert_close(quat_to_matrix(back), scipy_matrix(a), rtol=0, atol=1e-12)
    product = quat_multiply(one, other)
    torch.testing.assert_close(
        quat_to_matrix(product), scipy_matrix(a) @ scipy_matrix(b), rtol=0, atol=1e-12
    )
    assert float(product.norm()) == pytest.approx(math.hypot(*a) * math.hypot(*b))


@pytest.mark.parametrize(
    "quat", [(0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1), (0, math.sqrt(0.5), -math.sqrt(0.5), 0)]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_half_turns_are_well_conditioned(quat: tuple[float, ...], dtype: torch.dtype) -> None:
    found = quat_from_matrix(scipy_matrix(quat).to(dtype))
    assert abs(float(found @ torch.tensor(quat, dtype=dtype))) == pytest.approx(1, abs=1e-6)
    nearly = quat_from_matrix(scipy_matrix((1e-4, *quat[1:])).to(dtype))
    assert float(nearly[0]) == pytest.approx(1e-4, rel=1e-2)


@PROPERTY
@given(QUATS, st.floats(0.05, 20), st.tuples(*[st.floats(-20, 20)] * 3))
def test_a_transform_moves_points_and_covariances_alike(
    quat: tuple[float, ...], factor: float, offset: tuple
) -> None:
    some, matrix = random_gaussians(6, dtype=torch.float64), similarity(quat, factor, offset)
    moved, linear = some.transform(matrix), matrix[:3, :3]
    torch.testing.assert_close(
        moved.means, torch.stack([linear @ m + matrix[:3, 3] for m in some.means])
    )
    for gaussian, covariance in zip(range(6), some.covariances(), strict=True):
        turn = scipy_matrix(tuple(some.quats[gaussian].tolist()))
        torch.testing.assert_close(
            covariance, turn @ torch.diag(some.scales[gaussian] ** 2) @ turn.T
        )
    torch.testing.assert_close(
        moved.covariances(), linear @ some.covariances() @ linear.T, rtol=1e-8, atol=1e-10
    )
    assert torch.equal(moved.opacities, some.opacities)
    assert torch.equal(moved.colors, some.colors)


@pytest.mark.parametrize("last", [[0, 0, -1], [0, 0, 2], [0, 0, 0], [0.1, 0, 1], [math.nan] * 3])
def test_other_matrices_than_similarities_are_refused(last: list[float]) -> None:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[2, :3] = torch.tensor(last)
    with pytest.raises(ValueError, match="uniform scale"):
        random_gaussians(2, dtype=torch.float64).transform(matrix)
