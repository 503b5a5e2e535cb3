"""ProPainter with random weights in full size, with a stand-in for torchvision."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from spackle.inpaint import InpainterOptions, get_inpainter
from spackle.inpaint.propainter import (
    DILATION_PX,
    NETWORK_NAMES,
    PropainterInpainter,
    dilate_holes,
    find_weight_files,
)
from spackle.runtime.errors import InputError

OPS = """
from torch import nn
class DeformConv2d(nn.Conv2d):
    def forward(self, input, offset, mask=None):
        return super().forward(input)
"""
OURS = ("torchvision", "pytorchcv.models.propainter")  # modules that hold the convolution


def test_holes_are_dilated_by_steps() -> None:
    hole = torch.zeros(1, 1, 20, 20)
    hole[0, 0, 10, 8] = 1
    y, x = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
    assert torch.equal(dilate_holes(hole)[0, 0] > 0, (y - 10).abs() + (x - 8).abs() <= DILATION_PX)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """pytorchcv with a stand-in for torchvision: one layer, without offsets."""
    pytest.importorskip("pytorchcv")
    place = tmp_path_factory.mktemp("stand_in")
    (place / "torchvision").mkdir()
    (place / "torchvision" / "__init__.py").write_text("")
    (place / "torchvision" / "ops.py").write_text(OPS)
    with pytest.MonkeyPatch.context() as patch:
        forget_package()
        patch.setattr(sys, "path", [str(place), *sys.path])
        yield
    forget_package()


def forget_package() -> None:
    for name in [name for name in sys.modules if name.startswith(OURS)]:
        del sys.modules[name]


@pytest.fixture(scope="module")
def weights(package: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files with published names and random weights in half precision."""
    from pytorchcv.models.propainter import propainter
    from pytorchcv.models.propainter_rfc import propainter_rfc
    from pytorchcv.models.raft import raft_things

    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    for name, make in zip(NETWORK_NAMES, (raft_things, propainter_rfc, propainter), strict=True):
        torch.save(
            make().half().state_dict() | {"of_somebody_else": torch.zeros(1)},
            folder / f"{name}-0000-random.pth",
        )
    return folder


@pytest.fixture(scope="module")
def inpainter(weights: Path) -> PropainterInpainter:
    return PropainterInpainter(InpainterOptions(weights=weights, device="cpu"))


def views_of(count: int, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    rgb = torch.rand(count, height, width, 3, generator=torch.Generator().manual_seed(0))
    hole = torch.zeros(count, height, width, dtype=torch.bool)
    hole[:, 20:60, -40:-9] = True
    return rgb, hole, torch.zeros(count, height, width)


class Video:
    """Replaces the networks: records the inputs, and paints holes grey."""

    given: list[tuple[Tensor, Tensor]]

    def __init__(
        self, frames: Any, masks: Any, *networks: nn.Module, use_cuda: bool, step: int
    ) -> None:
        self.frames = frames[0:step]
        self.masks = masks[0:step]
        Video.given.append((self.frames, self.masks))

    def __iter__(self) -> Iterator[Tensor]:
        yield self.frames * (1 - self.masks) + 0.5 * self.masks


@pytest.fixture
def video(package: None, monkeypatch: pytest.MonkeyPatch) -> type[Video]:
    Video.given = []
    monkeypatch.setattr("pytorchcv.models.propainter_stream.ProPainterIterator", Video)
    return Video


def test_the_networks_paint_only_holes(inpainter: PropainterInpainter) -> None:
    rgb, hole, unknown = (x[:, :64, -64:] for x in views_of(2, 64, 64))
    painted = inpainter.paint(rgb, hole, unknown)
    assert torch.equal(painted[~hole], rgb[~hole])
    assert 0 <= float(painted[hole].min()) <= float(painted[hole].max()) <= 1
    assert float((painted - rgb)[hole].abs().mean()) > 0.05
    assert re.fullmatch(r"1, pytorchcv [\d.]+, long side 640", inpainter.version)
    assert inpainter.weight_files.keys() == set(NETWORK_NAMES)
    assert "S-Lab" in inpainter.notice


def test_inputs_of_the_networks(video: type[Video], inpainter: PropainterInpainter) -> None:
    rgb, hole, unknown = views_of(4, 113, 150)
    painted = inpainter.paint(rgb, hole, unknown)
    frames, masks = video.given[0]
    assert frames.shape == (4, 3, 128, 152)
    assert masks.shape == (4, 1, 128, 152)
    torch.testing.assert_close(frames[:, :, :113, :150], 2 * rgb.permute(0, 3, 1, 2) - 1)
    assert torch.equal(masks[:, :, :113, :150], dilate_holes(hole[:, None].float()))
    assert torch.equal(frames[:, :, 112:113].expand(-1, -1, 16, -1), frames[:, :, 112:])
    assert torch.equal(painted[~hole], rgb[~hole])
    torch.testing.assert_close(painted[hole], torch.full((int(hole.sum()), 3), 0.75))
    torch.testing.assert_close(
        inpainter.paint(*(x[1:2] for x in (rgb, hole, unknown))), painted[1:2]
    )
    assert video.given[1][0].shape == (2, 3, 128, 152)  # a video has two frames
    assert torch.equal(inpainter.paint(rgb, torch.zeros_like(hole), unknown), rgb)


def test_colours_that_are_not_finite_are_refused(
    video: type[Video], inpainter: PropainterInpainter, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = views_of(2, 113, 150)
    monkeypatch.setattr(Video, "__iter__", lambda self: iter([self.frames * torch.nan]))
    with pytest.raises(InputError, match="not finite"):
        inpainter.paint(*views)

    def short(self: Video) -> Iterator[Tensor]:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(Video, "__iter__", short)
    with pytest.raises(InputError, match="lower `inpainter_side`"):
        inpainter.paint(*views)


def test_missing_weights_are_refused(tmp_path: Path) -> None:
    published = [f"{name}-0000-d74fed4b.pth" for name in NETWORK_NAMES]
    for given, files, said in (
        (None, [], "give a folder with one file for each of raft_things, .* unpacked from https"),
        (tmp_path / "missing", [], "holds 0 files named raft_things"),
        (tmp_path, [*published, "propainter.safetensors"], "holds 2 files named propainter-"),
    ):
        for name in files:
            (tmp_path / name).write_bytes(b"")
        with pytest.raises(InputError, match=said):
            find_weight_files(given)
    (tmp_path / "propainter.safetensors").unlink()
    assert [file.name for file in find_weight_files(tmp_path).values()] == published


def test_a_missing_package_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pytorchcv", None)
    with pytest.raises(InputError, match=re.escape("pip install 'spackle-nvs[propainter]'")):
        get_inpainter("propainter", InpainterOptions())
