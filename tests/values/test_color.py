"""sRGB and linear RGB, against the standard written in plain Python."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from spackle.color import linear_to_srgb, srgb_to_linear

BOTH = pytest.mark.parametrize("transfer", [srgb_to_linear, linear_to_srgb])


def decoded(value: float) -> float:
    return value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4


def encoded(value: float) -> float:
    return 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055


@settings(deadline=None)
@given(st.floats(0, 1))
def test_both_ways_follow_the_standard(value: float) -> None:
    assert float(srgb_to_linear(torch.tensor(value, dtype=torch.float64))) == pytest.approx(decoded(value), abs=1e-12)
    assert float(linear_to_srgb(torch.tensor(value, dtype=torch.float64))) == pytest.approx(encoded(value), abs=1e-12)


def test_every_byte_survives_the_way_there_and_back_in_single_precision() -> None:
    levels = torch.arange(256)
    back = linear_to_srgb(srgb_to_linear(levels.float() / 255)) * 255
    assert torch.equal(back.round().long(), levels)


@BOTH
def test_transfers_rise_and_clamp(transfer: object) -> None:
    ramp = transfer(torch.linspace(0, 1, 10001, dtype=torch.float64))  # type: ignore[operator]
    assert bool((ramp.diff() > 0).all())
    outside = transfer(torch.tensor([-3.0, -0.0, 1.0, 7.0, math.inf]))  # type: ignore[operator]
    assert outside.tolist() == pytest.approx([0, 0, 1, 1, 1], abs=1e-6)


@BOTH
def test_gradients_are_finite_everywhere_and_right_inside(transfer: object) -> None:
    values = torch.tensor([-0.1, 0.0, 1e-8, 0.001, 0.02, 0.3, 0.9, 1.0, 1.1], dtype=torch.float64, requires_grad=True)
    transfer(values).sum().backward()  # type: ignore[operator]
    assert values.grad is not None
    assert bool(values.grad.isfinite().all())
    inside = torch.tensor([0.001, 0.02, 0.3, 0.9], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(transfer, (inside,))
