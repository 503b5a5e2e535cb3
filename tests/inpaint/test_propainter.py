"""ProPainter with random weights, from their files to a whole dataset, over a stand-in for torchvision.

The networks are the published ones in full size, on the smallest pictures that they take.
"""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from dataset_builds import build, content, refused, write_inputs
from safetensors.torch import save_file
from torch import Tensor, nn

from spackle.dataset import DatasetFiles
from spackle.dataset.shards import load_manifest
from spackle.errors import InputError
from spackle.inpaint.propainter import (
    DILATION,
    NETWORKS,
    PropainterInpainter,
    dilated,
    give_weights,
    weight_files,
)
from spackle.inpaint.protocol import InpainterOptions

OPS = """
from torch import nn
class DeformConv2d(nn.Conv2d):
    def forward(self, input, offset, mask=None):
        return super().forward(input)
"""
OURS = ("torchvision", "pytorchcv.models.propainter")  # modules that hold the convolution


# Parts that need no package -----------------------------------------------------------------------


def test_holes_grow_by_steps() -> None:
    hole = torch.zeros(1, 1, 20, 20)
    hole[0, 0, 10, 8] = 1
    y, x = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
    assert torch.equal(dilated(hole)[0, 0] > 0, (y - 10).abs() + (x - 8).abs() <= DILATION)


# With the package ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """pytorchcv beside a torchvision that has one layer, without its offsets; workers find it too."""
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


def random_networks() -> dict[str, nn.Module]:
    """The architectures with numbers that anyone can draw, the same each time."""
    from pytorchcv.models.propainter import propainter
    from pytorchcv.models.propainter_rfc import propainter_rfc
    from pytorchcv.models.raft import raft_things

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return {"raft_things": raft_things(), "propainter_rfc": propainter_rfc(), "propainter": propainter()}


@pytest.fixture(scope="module")
def weights(package: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files as they are published, two by torch.save and one as safetensors, in half precision to save room."""
    folder = tmp_path_factory.mktemp("weights")
    for name, network in random_networks().items():
        tensors = {
            key: value.half() if value.is_floating_point() else value for key, value in network.state_dict().items()
        }
        if name == "raft_things":
            save_file(tensors, folder / f"{name}.safetensors")
        else:
            torch.save(tensors | {"of_somebody_else": torch.zeros(1)}, folder / f"{name}-0000-random.pth")
    return folder


@pytest.fixture(scope="module")
def inpainter(weights: Path) -> PropainterInpainter:
    """With random weights."""
    return PropainterInpainter(InpainterOptions(weights, device="cpu"))


def views_of(count: int, height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    """Pictures, holes at their right, and no depth."""
    rgb = torch.rand(count, height, width, 3, generator=torch.Generator().manual_seed(0))
    hole = torch.zeros(count, height, width, dtype=torch.bool)
    hole[:, 20:60, -40:-9] = True
    return rgb, hole, torch.zeros(count, height, width)


class Video:
    """In place of the networks: says what they were given, and paints the holes grey."""

    given: list[tuple[Tensor, Tensor]]

    def __init__(self, frames: Any, masks: Any, *networks: nn.Module, use_cuda: bool, step: int) -> None:
        self.frames, self.masks = frames[0:step], masks[0:step]
        Video.given.append((self.frames, self.masks))

    def __iter__(self) -> Iterator[Tensor]:
        yield self.frames * (1 - self.masks) + 0.5 * self.masks


@pytest.fixture
def video(package: None, monkeypatch: pytest.MonkeyPatch) -> type[Video]:
    Video.given = []
    monkeypatch.setattr("pytorchcv.models.propainter_stream.ProPainterIterator", Video)
    return Video


def test_what_the_networks_are_given(video: type[Video], inpainter: PropainterInpainter) -> None:
    rgb, hole, unknown = views_of(4, 113, 150)
    painted = inpainter.paint(rgb, hole, unknown)
    frames, masks = video.given[0]
    assert frames.shape == (4, 3, 128, 152)
    assert masks.shape == (4, 1, 128, 152)
    torch.testing.assert_close(frames[:, :, :113, :150], 2 * rgb.permute(0, 3, 1, 2) - 1)
    assert torch.equal(masks[:, :, :113, :150], dilated(hole[:, None].float()))
    assert torch.equal(frames[:, :, 112:113].expand(-1, -1, 16, -1), frames[:, :, 112:])
    assert torch.equal(painted[~hole], rgb[~hole])
    torch.testing.assert_close(painted[hole], torch.full((int(hole.sum()), 3), 0.75))
    torch.testing.assert_close(inpainter.paint(rgb[1:2], hole[1:2], unknown[1:2]), painted[1:2])
    assert video.given[1][0].shape == (2, 3, 128, 152)  # a video has two frames
    assert torch.equal(inpainter.paint(rgb, torch.zeros_like(hole), unknown), rgb)


def test_large_views_are_worked_on_in_small_and_no_hole_is_lost(video: type[Video], weights: Path) -> None:
    rgb, hole, unknown = views_of(2, 200, 300)
    hole = torch.zeros_like(hole)
    hole[1, 50, :] = True  # one pixel high
    small = PropainterInpainter(InpainterOptions(weights, 150, "cpu"))
    painted = small.paint(rgb, hole, unknown)
    assert video.given[0][0].shape == (2, 3, 128, 152)
    assert torch.equal(painted[~hole], rgb[~hole])
    torch.testing.assert_close(painted[hole], torch.full((300, 3), 0.75))
    assert "long side 150" in small.version


def test_colours_that_are_none_are_refused(
    video: type[Video], inpainter: PropainterInpainter, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = views_of(2, 113, 150)
    monkeypatch.setattr(Video, "__iter__", lambda self: iter([self.frames * torch.nan]))
    with pytest.raises(InputError, match="not finite"):
        inpainter.paint(*views)

    def short(self: Video) -> Iterator[Tensor]:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(Video, "__iter__", short)
    with pytest.raises(InputError, match="lower --inpainter-side"):
        inpainter.paint(*views)


# Weights ------------------------------------------------------------------------------------------


def test_weights_that_are_not_there_are_told(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"give --inpainter-weights FOLDER with raft_things, .* unpacked from https"):
        weight_files(None)
    with pytest.raises(InputError, match="no folder that can be read"):
        weight_files(tmp_path / "missing")
    with pytest.raises(InputError, match="holds no raft_things"):
        weight_files(tmp_path)
    for name in ("raft_things-0000-d74fed4b.pth", "propainter_rfc-0000-a865ddc0.pth", "propainter-0000-5f3cc1e7.pth"):
        (tmp_path / name).write_bytes(b"")
    assert [file.name.split("-")[0] for file in weight_files(tmp_path).values()] == list(NETWORKS)
    with pytest.raises(InputError, match="no folder"):
        weight_files(tmp_path / "propainter-0000-5f3cc1e7.pth")
    (tmp_path / "propainter.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match=r"holds propainter-0000-5f3cc1e7.pth and propainter.safetensors"):
        weight_files(tmp_path)


class Small(nn.Module):
    """A network with a constant of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(3, 2)
        self.register_buffer("where", torch.arange(4))


def test_weights_are_widened_and_constants_stay(tmp_path: Path) -> None:
    network = Small()
    values = {"linear.weight": torch.ones(2, 3).half(), "linear.bias": torch.zeros(2), "where": torch.tensor([9] * 4)}
    torch.save(values | {"more": [1]}, tmp_path / "a.pth")
    give_weights(network, "small", tmp_path / "a.pth")
    assert torch.equal(network.linear.weight, torch.ones(2, 3))  # and float32
    assert network.get_buffer("where").tolist() == [0, 1, 2, 3]
    assert not network.linear.weight.requires_grad


GOOD = {"linear.weight": torch.ones(2, 3), "linear.bias": torch.zeros(2)}
BROKEN: list[tuple[str, object, str]] = [  # names, bytes or what is saved, and what is said of them
    ("folder.pth", Path.mkdir, "not a plain file"),
    ("garbled.pth", b"\x80\x02no" * 50, "cannot be read as weights"),
    ("cut.pth", ..., "cannot be read as weights"),
    ("cut.safetensors", b"\x40\0\0\0\0\0\0\0{" + b" " * 9, "cannot be read as weights"),
    ("code.pth", {"linear.weight": print}, "cannot be read as weights"),
    ("alone.pth", torch.ones(3), "cannot be read as weights"),
    ("others.pth", {"a": torch.ones(3)}, "2 of 2 tensors are missing"),
    ("shape.pth", GOOD | {"linear.bias": torch.ones(3)}, "such as linear.bias"),
    ("whole.pth", GOOD | {"linear.bias": torch.ones(2).int()}, "1 of 2 tensors"),
    ("nan.pth", GOOD | {"linear.bias": torch.tensor([0, torch.nan])}, "not finite"),
    ("sparse.pth", GOOD | {"linear.weight": GOOD["linear.weight"].to_sparse()}, "1 of"),
    ("small-0000-0badf00d.pth", GOOD, "SHA-1 is not the one in its name"),
]


@pytest.mark.parametrize(("name", "held", "said"), BROKEN, ids=[name for name, *_ in BROKEN])
def test_broken_weights_are_a_line(tmp_path: Path, name: str, held: object, said: str) -> None:
    path = tmp_path / name
    if isinstance(held, bytes):
        path.write_bytes(held)
    elif held is ...:  # a good file, cut off
        torch.save(GOOD, path)
        path.write_bytes(path.read_bytes()[:-200])
    elif held is Path.mkdir:
        path.mkdir()
    else:
        torch.save(held, path)
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: .*{said}"):  # in one line
        give_weights(Small(), "small", path)


# The command --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two photos, nearly as small as a photo may be, and their depth."""
    return write_inputs(tmp_path_factory.mktemp("inputs"), 2, 33, 32)


def test_a_dataset_is_built_by_any_number_of_workers_and_says_by_what(
    place: Path, weights: Path, tmp_path: Path
) -> None:
    options = ["--views", 3, "--inpainter", "propainter", "--inpainter-weights", weights]
    done = build(place, tmp_path / "one", *options)
    assert done.code == 0, done.err
    assert [line for line in done.lines if "S-Lab" in line and "non-commercial" in line] == [done.lines[0]]
    assert build(place, tmp_path / "two", *options, "--workers", 2).code == 0
    assert content(tmp_path / "one") == content(tmp_path / "two")
    manifest = load_manifest(tmp_path / "one")
    view = DatasetFiles(tmp_path / "one").group(1).view(2)
    assert float((view.target - view.rendering.rgb)[view.mask].abs().mean()) > 0.05
    used = manifest.config["inpainter"]
    assert used["name"] == "propainter"
    assert re.fullmatch(r"1, pytorchcv [\d.]+, long side 640", used["version"])
    assert used["weights"].keys() == set(NETWORKS)
    # Other weights are another dataset.
    other = shutil.copytree(weights, tmp_path / "other")
    flow = {key: value + 1 for key, value in random_networks()["raft_things"].state_dict().items()}
    save_file(flow, other / "raft_things.safetensors")
    done = build(place, tmp_path / "one", *options[:-1], other, "--inpainter-side", 320)
    assert done.code == 2
    for words in ("inpainter.weights.raft_things: ", "long side 640", "long side 320"):
        assert words in done.lines[-1]
    assert "inpainter.weights.propainter: " not in done.lines[-1]


@pytest.mark.parametrize("found", ["nothing", "a torchvision of another torch"])
def test_without_its_packages_propainter_is_a_line(
    place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, found: str
) -> None:
    for name in [name for name in sys.modules if name.startswith(OURS)]:
        monkeypatch.delitem(sys.modules, name)
    said = ["pip install 'spackle-nvs[propainter]'"]
    if found == "nothing":
        monkeypatch.setitem(sys.modules, "pytorchcv", None)
    else:
        pytest.importorskip("pytorchcv")
        problem = "operator torchvision::nms does not exist"  # what torchvision says
        (tmp_path / "torchvision").mkdir()
        (tmp_path / "torchvision" / "__init__.py").write_text(f"raise RuntimeError({problem!r})\n")
        monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
        said = [f"torchvision cannot be imported ({problem})", torch.__version__]
    refused(build(place, tmp_path / "out", "--inpainter", "propainter"), *said)
