"""The registry of inpainters, and inpainters without networks."""

from __future__ import annotations

import pytest
import torch
from helpers.scenes import psnr
from torch import Tensor

from spackle.inpaint import INPAINTERS, InpainterOptions, get_inpainter, inpainter_class
from spackle.inpaint.plain import PlainInpainter
from spackle.runtime.errors import InputError


@pytest.mark.parametrize(
    "name", sorted(name for name in INPAINTERS if not inpainter_class(name).uses_network)
)
def test_only_holes_change_and_results_repeat(name: str) -> None:
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


def test_exemplar_extends_a_pattern_also_without_depth() -> None:
    y, x = torch.meshgrid(torch.arange(100), torch.arange(117), indexing="ij")
    bricks = torch.where((y % 8 < 2) | ((x + 7 * (y // 8 % 2)) % 14 < 2), 0.8, 0.3)
    truth = bricks[..., None] * torch.tensor([1, 0.8, 0.6])
    hole = torch.zeros(100, 117, dtype=torch.bool)
    hole[40:66, 45:71] = True
    holes = torch.stack([hole, hole | True, hole & False])
    depths = torch.ones(3, 100, 117)
    depths[0, :, :9] = 0
    rgb = torch.where(holes[..., None], 0.0, truth)
    painter = get_inpainter("exemplar", InpainterOptions())
    painted = painter.paint(rgb, holes, depths)
    assert psnr(painted[0][hole], truth[hole]) > 40
    assert torch.equal(painted[0][~hole], truth[~hole])
    assert torch.equal(painted[1:], rgb[1:])
    assert torch.equal(painter.paint(rgb[:1], holes[:1], 0 * depths[:1]), painted[:1])


class BlackInpainter(PlainInpainter):
    """The shortest inpainter: leaves the holes black."""

    name = "black"
    version = "1"

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        return torch.where(hole[..., None], 0.0, rgb)


def test_an_inpainter_of_another_package_is_named_by_its_module() -> None:
    plugin = get_inpainter(f"{__name__}:BlackInpainter", InpainterOptions())
    assert isinstance(plugin, BlackInpainter)
    assert not plugin.uses_network
    assert plugin.weight_files == {}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("exemplary", "did you mean exemplar"),
        ("no_such_package:Painter", "cannot import no_such_package"),
        ("spackle.inpaint.plain:Painter", "spackle.inpaint.plain has no Painter"),
        (":Painter", "package.module:Name"),
        ("spackle.inpaint.plain:", "package.module:Name"),
    ],
)
def test_an_unknown_inpainter_is_refused(name: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        get_inpainter(name, InpainterOptions())
