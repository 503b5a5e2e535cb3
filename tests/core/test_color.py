"""sRGB and linear RGB: the standard's values, bounds, and gradients."""

from __future__ import annotations

import math

import pytest
import torch

from spackle.core.color import linear_to_srgb, srgb_to_linear, to_uint8


def test_transfers_follow_the_standard_and_every_byte_survives() -> None:
    srgb = torch.tensor([0, 0.02, 0.04045, 0.5, 0.735356983052, 1], dtype=torch.float64)
    linear = [0, 0.02 / 12.92, 0.0031308, 0.214041140482, 0.5, 1]
    assert srgb_to_linear(srgb).tolist() == pytest.approx(linear, abs=1e-7)
    assert linear_to_srgb(torch.tensor(linear)).tolist() == pytest.approx(srgb.tolist(), abs=1e-6)
    levels = torch.arange(256)
    assert torch.equal(to_uint8(linear_to_srgb(srgb_to_linear(levels / 255))).long(), levels)
    assert to_uint8(torch.tensor([math.nan, -math.inf, -1, 0.7 / 255, 2, math.inf])).tolist() == [
        0,
        0,
        0,
        1,
        255,
        255,
    ]


@pytest.mark.parametrize("transfer", [srgb_to_linear, linear_to_srgb])
def test_transfers_rise_clamp_and_have_gradients(transfer: object) -> None:
    ramp = transfer(torch.linspace(0, 1, 10001, dtype=torch.float64))  # type: ignore[operator]
    assert bool((ramp.diff() > 0).all())
    outside = torch.tensor([-3.0, -0.0, 1.0, 7.0, math.inf])
    assert transfer(outside).tolist() == pytest.approx([0, 0, 1, 1, 1], abs=1e-6)  # type: ignore[operator]
    values = torch.tensor([-0.1, 0.0, 1e-8, 1.0, 1.1], dtype=torch.float64, requires_grad=True)
    transfer(values).sum().backward()  # type: ignore[operator]
    assert values.grad is not None
    assert bool(values.grad.isfinite().all())
    assert torch.autograd.gradcheck(
        transfer, (torch.tensor([0.001, 0.3, 0.9]).double().requires_grad_(),)
    )
