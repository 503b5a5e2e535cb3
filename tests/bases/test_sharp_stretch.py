"""Gaussians stretched along the axes, against NumPy's decompositions of their covariances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers.scenes import same_bits
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from spackle.bases.sharp.stretch import BLOCK_SIZE, CHUNK_SIZE, stretch_gaussians
from spackle.core.gaussians import Gaussians

PROPERTY = settings(deadline=None, max_examples=40)
SEEDS = st.integers(0, 2**32 - 1)
FACTORS = st.floats(0.2, 3)  # a photo 0.4 to 6 times as wide as its focal length
STRETCHES = st.tuples(FACTORS, FACTORS, st.just(1.0))
DECADES = st.sampled_from(
    [(-2.0, -2.0), (-2.01, -1.99), (-3.0, -1.0), (-8.0, 3.0)]
)  # powers of ten of the scales
PHOTO = (0.67, 0.5, 1.0)


def random_set(count: int, seed: int = 0, decades: tuple[float, float] = (-3, -1)) -> Gaussians:
    """Gaussians with quaternions of any length and with scales over `decades` (powers of ten)."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    low, high = decades
    quats = torch.randn(count, 4, generator=generator) * 10 ** (4 * uniform(count, 1) - 2)
    scales = 10 ** (low + (high - low) * uniform(count, 3))
    return Gaussians(uniform(count, 3), quats, scales, uniform(count), uniform(count, 3))


def factors(gaussians: Gaussians) -> Any:
    """R S [N, 3, 3] float64; a zero quaternion is no rotation."""
    quats, scales = gaussians.quats.double().numpy(), gaussians.scales.double().numpy()
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    w, x, y, z = np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1), [1, 0, 0, 0]).T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.array(rows).transpose(2, 0, 1) * scales[:, None]


def check(
    before: Gaussians,
    after: Gaussians,
    stretch: tuple[float, float, float],
    tolerance: float = 1e-5,
) -> None:
    """Check everything that `stretch_gaussians` promises about quats and scales."""
    matrix = np.array(stretch)[:, None] * factors(before)
    wanted = matrix @ matrix.transpose(0, 2, 1)
    square = factors(after)
    error = np.linalg.norm(square @ square.transpose(0, 2, 1) - wanted, axis=(1, 2))
    assert (error <= tolerance * np.linalg.norm(wanted, axis=(1, 2))).all()
    # Small scales are compared with singular values of the matrix; NumPy's have eight correct
    # digits near this limit.
    digits, sizes = max(tolerance, 1e-7), np.linalg.svd(matrix)[1]
    told = (sizes > 1e-8 * sizes[:, :1]) & (sizes > 0)
    np.testing.assert_allclose(after.scales.double().numpy()[told], sizes[told], rtol=digits)
    # The product of the scales is compared too, because it depends on the smallest ones.
    volumes = before.scales.double().prod(1).numpy() * np.prod(stretch)
    told = volumes > 0
    np.testing.assert_allclose(
        after.scales.double().prod(1).numpy()[told], volumes[told], rtol=3 * digits
    )
    assert bool((after.scales[:, :-1] >= after.scales[:, 1:]).all())
    assert bool((after.scales >= 0).all() & (after.quats[:, 0] >= 0).all())
    torch.testing.assert_close(
        after.quats.norm(dim=1), torch.ones(len(after)).to(after.quats), rtol=0, atol=1e-6
    )


@PROPERTY
@given(SEEDS, DECADES, STRETCHES, st.tuples(*[st.floats(1e-3, 1e3)] * 3))
def test_covariances_are_kept(
    seed: int, decades: tuple, stretch: tuple, thousandfold: tuple
) -> None:
    before = random_set(50, seed, decades)
    for factors in (stretch, thousandfold):
        check(before, stretch_gaussians(before, factors), factors, 1e-6)


def degenerate() -> Gaussians:
    """Points, lines, discs, balls, threads and plates, all of extreme sizes.

    Their quaternions have extreme lengths.
    """
    odd, usual = (0.3, -1.2, 0.7, 2.0), (0.1, 0.3, 0.2)
    scales = [
        (0, 0, 0),
        (0, 2, 0),
        (1, 0, 2),
        (0.5, 0.5, 0.5),
        (1e-12, 1, 2e-12),
        (1e3, 1e-8, 1e3),
        (1e-8, 1e3, 1),
    ]
    scales += [(1e37, 1e30, 2e37), (1e-36, 1e-30, 1e-33)]
    quats = [(0, 0, 0, 0), (3e-7, -1e-6, 2e-6, 1e-6), (3e7, -1e9, 2e8, 1e8), (0, 1, 0, 0)]
    one = torch.ones(len(scales) + len(quats))
    every = (
        torch.tensor([odd] * len(scales) + quats),
        torch.tensor([*scales, *[usual] * len(quats)]),
    )
    return Gaussians(one[:, None].expand(-1, 3), *every, one, one[:, None].expand(-1, 3))


@pytest.mark.parametrize(
    ("before", "stretch"),
    [
        *(
            (degenerate(), stretch)
            for stretch in ((1.0, 1.0, 1.0), PHOTO, (0.5, 0.5, 1.0), (2.0, 3.0, 1.0))
        ),
        *(
            (random_set(200), stretch)
            for stretch in ((1.0, 1.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0))
        ),
    ],
)
def test_degenerate_gaussians_and_flattening(
    before: Gaussians, stretch: tuple[float, float, float]
) -> None:
    check(before, stretch_gaussians(before, stretch), stretch)


def test_means_are_multiplied_and_the_rest_is_passed_on() -> None:
    before, kept = random_set(7), random_set(7)
    after = stretch_gaussians(before, PHOTO)
    torch.testing.assert_close(after.means, before.means * torch.tensor(PHOTO))
    assert (after.opacities is before.opacities, after.colors is before.colors) == (True, True)
    assert same_bits(before, kept)
    assert len(stretch_gaussians(Gaussians.empty(), PHOTO)) == 0


def test_results_repeat_whatever_threads_neighbours_and_layout() -> None:
    before = random_set(2 * CHUNK_SIZE + BLOCK_SIZE + 5)
    wide = torch.cat(before.tensors[1:3], dim=1).requires_grad_()
    strided = Gaussians(before.means, wide[:, :4], wide[:, 4:], before.opacities, before.colors)
    parts = [
        before.select(slice(0, 3)),
        before.select(slice(3, CHUNK_SIZE)),
        before.select(slice(CHUNK_SIZE, None)),
    ]
    expected = Gaussians.cat(stretch_gaussians(part, PHOTO) for part in parts)
    threads = torch.get_num_threads()
    try:
        for count, again in ((1, before), (2, before), (5, strided)):
            torch.set_num_threads(count)
            assert same_bits(stretch_gaussians(again, PHOTO), expected)
    finally:
        torch.set_num_threads(threads)
