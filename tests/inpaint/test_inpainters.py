"""The registry of inpainters, and what each keeps to whose weights or package are here."""

from __future__ import annotations

import pytest
import torch

from spackle.errors import InputError
from spackle.inpaint import INPAINTERS, InpainterOptions, get_inpainter


@pytest.mark.parametrize("name", sorted(name for name, kind in INPAINTERS.items() if not kind.network))
def test_only_the_holes_change_and_every_time_in_the_same_way(name: str) -> None:
    if name == "opencv":
        pytest.importorskip("cv2")
    rgb = torch.rand(2, 24, 33, 3, generator=torch.Generator().manual_seed(0)) / 2 + 0.25
    hole = torch.zeros(2, 24, 33, dtype=torch.bool)
    hole[0, 4:13, 10:20] = hole[0, :, -3:] = True
    rgb[hole] = 0
    inverse_depth = torch.where(hole, 0.0, 0.5)
    inpainter = get_inpainter(name, InpainterOptions())
    painted = inpainter.paint(rgb, hole, inverse_depth)
    assert torch.equal(painted[~hole], rgb[~hole])
    assert 0.2 < float(painted[hole].min()) < float(painted[hole].max()) < 0.8
    assert torch.equal(inpainter.paint(rgb, hole, inverse_depth), painted)
    assert torch.equal(inpainter.paint(rgb[1:], hole[1:], inverse_depth[1:]), rgb[1:])


def test_an_unknown_inpainter_is_a_line() -> None:
    with pytest.raises(InputError, match="inpainter nobody: unknown"):
        get_inpainter("nobody", InpainterOptions())
