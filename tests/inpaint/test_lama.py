"""LaMa: the network, its files, crops around holes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.sharp_weights import waves
from random_weights import lama_weights
from safetensors.torch import save_file
from torch import Tensor

from spackle.inpaint import InpainterOptions, get_inpainter
from spackle.inpaint.lama import (
    MARGIN_PX,
    LamaInpainter,
    group_holes,
    load_network,
    pad_to_accepted_size,
)
from spackle.inpaint.lama_network import LamaNetwork, expected_shapes
from spackle.runtime.errors import InputError
from spackle.weights import PUBLISHED_WEIGHTS

Weights = dict[str, Tensor]
GOLDEN = dict(np.load(DATA / "lama_golden.npz"))  # of the original code


def made_input(height: int, width: int) -> Tensor:
    """[1, 4, H, W]: waves with two holes, and the mask."""
    y, x = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / width, indexing="ij")
    hole = (x > 0.6) | (((x - 0.3).abs() < 0.1) & ((y - 0.5).abs() < 0.25))
    return torch.cat([waves(height, width) * ~hole, hole[None, None]], 1)


X = made_input(24, 40)


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def weights() -> Weights:
    return lama_weights(8, 1)


@pytest.fixture(scope="module")
def file(weights: Weights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lama") / "lama.safetensors"
    save_file(weights, path)
    return path


@pytest.mark.parametrize(
    ("name", "size", "height", "width", "step"),
    [("tiny", (16, 3), 64, 96, 4), pytest.param("full", (), 192, 256, 8, marks=pytest.mark.slow)],
)
def test_the_network_matches_the_original(
    name: str, size: tuple[int, ...], height: int, width: int, step: int
) -> None:
    golden = torch.from_numpy(GOLDEN[name])
    network = LamaNetwork(lama_weights(*size))
    x = made_input(height, width)
    logits = network.logits(x)
    torch.testing.assert_close(
        logits[0, :, ::step, ::step], golden, rtol=0, atol=1e-5 * float(golden.abs().max())
    )
    rgb = torch.where(x[:, 3:] > 0, torch.nan, x[:, :3])  # colours in a hole are ignored
    torch.testing.assert_close(network(rgb, x[:, 3:] > 0), logits.sigmoid(), rtol=0, atol=1e-5)


def test_the_published_size() -> None:
    shapes = expected_shapes()
    assert len(shapes) == 989 - 152  # without counts of batches
    assert (
        sum(np.prod(shape) for name, shape in shapes.items() if "running" not in name) == 50_975_875
    )


def named(prefix: str, weights: Weights) -> Weights:
    return {prefix + name: x for name, x in weights.items()}


@pytest.mark.parametrize("prefix", ["model.generator.", "generator.", ""])
def test_published_files_are_read(weights: Weights, tmp_path: Path, prefix: str) -> None:
    path = tmp_path / "big-lama.pt"
    others = {f"{prefix}model.1.bn_l.num_batches_tracked": torch.tensor(7)}
    if prefix == "model.generator.":
        others |= {
            "discriminator.model0.0.weight": torch.ones(3, 3),
            "model.generator.count": torch.ones(1),
        }
    halves = {name: x.half() for name, x in weights.items()}
    torch.save(named(prefix, halves) | others, path)
    network = load_network(path)
    path.write_bytes(bytes(path.stat().st_size))  # the file is no longer needed
    expected = LamaNetwork({name: x.float() for name, x in halves.items()})
    assert torch.equal(network.logits(X), expected.logits(X))


FIRST = "model.1.ffc.convl2l.weight"
DIFFERENT: list[tuple[dict[str, Tensor | None], str]] = [
    ({FIRST: None}, "holds no generator"),
    ({"model.16.bias": torch.zeros(4)}, r"1 unknown \(model.16.bias"),
    ({"model.17.bias": torch.zeros(4)}, r"1 of another shape \(model.17.bias"),
    ({FIRST: torch.tensor(1.0)}, "of another shape"),
]


@pytest.mark.parametrize(("change", "said"), DIFFERENT)
def test_other_networks_are_refused(
    weights: Weights, tmp_path: Path, change: dict[str, Tensor | None], said: str
) -> None:
    tensors = {name: x for name, x in (weights | change).items() if x is not None}
    save_file(named("generator.", tensors), tmp_path / "big-lama.pt")
    with pytest.raises(
        InputError, match=f"big-lama.pt: .*{said}.*: `spackle weights get lama` downloads"
    ):
        load_network(tmp_path / "big-lama.pt")


def views(
    height: int, width: int, *holes: tuple[int, int, int, int]
) -> tuple[Tensor, Tensor, Tensor]:
    rgb = made_input(height, width)[:, :3].permute(0, 2, 3, 1)
    hole = torch.zeros(1, height, width, dtype=torch.bool)
    for top, left, bottom, right in holes:
        hole[:, top:bottom, left:right] = True
    return torch.where(hole[..., None], 0.0, rgb), hole, torch.zeros(1, height, width)


def test_only_holes_change_and_the_network_gets_crops(file: Path) -> None:
    inpainter = LamaInpainter(InpainterOptions(weights=file, device="cpu"))
    seen: list[tuple[int, ...]] = []
    inpainter._network.register_forward_pre_hook(
        lambda network, inputs: seen.append(tuple(inputs[1].shape[2:]))
    )
    rgb, hole, depth = views(60, 700, (20, 10, 40, 20), (0, 690, 60, 700))
    painted = inpainter.paint(rgb, hole, depth)
    assert seen == [(64, 32 + MARGIN_PX), (64, 12 + MARGIN_PX + 4)]
    assert torch.equal(painted[~hole], rgb[~hole])
    assert bool((painted[hole] > 0).all() & (painted[hole] < 1).all())
    assert float(painted[hole].std(0).min()) > 1e-3
    assert torch.equal(inpainter.paint(rgb, hole, depth), painted)
    both = [torch.cat([x, torch.zeros_like(x)]) for x in (rgb, hole, depth)]
    assert torch.equal(inpainter.paint(*both), torch.cat([painted, torch.zeros_like(rgb)]))
    part = (
        pad_to_accepted_size(rgb[:, :, :160].permute(0, 3, 1, 2)),
        pad_to_accepted_size(hole[:, None, :, :160]),
    )
    plain = load_network(file)(*part)[0, :, :60].permute(1, 2, 0)
    torch.testing.assert_close(painted[0, 20:40, 10:20], plain[20:40, 10:20])


def test_large_crops_are_reduced_and_no_hole_is_lost(file: Path) -> None:
    inpainter = LamaInpainter(InpainterOptions(weights=file, side=128, device="cpu"))
    given: list[Tensor] = []
    inpainter._network.register_forward_pre_hook(lambda network, inputs: given.extend(inputs))
    rgb, hole, depth = views(200, 300, (70, 100, 71, 200))
    rgb = torch.where(hole[..., None], 0.0, 0.25).expand_as(rgb)
    painted = inpainter.paint(rgb, hole, depth)
    shown, holes = given
    assert shown.shape[2:] == (88, 128)
    assert torch.equal(painted[~hole], rgb[~hole])
    assert bool((painted[hole] > 0).all())
    assert inpainter.version == "1, long side 128"
    known = shown[~holes.expand_as(shown)]
    torch.testing.assert_close(known, torch.full_like(known, 0.25))  # without black from the hole
    assert int(holes.sum()) == 2 * 44  # a row of a hundred pixels, reduced to 0.43


def test_each_hole_is_in_one_crop() -> None:
    holes = torch.rand(700, 800, generator=torch.Generator().manual_seed(0)) > 0.9999
    counts = torch.zeros(700, 800)
    for crop, _ in group_holes(holes):
        counts[crop.slices] += 1
    assert bool((counts[holes] == 1).all())


def test_errors_are_one_line(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    with pytest.raises(InputError, match="spackle weights get lama"):
        get_inpainter("lama", InpainterOptions())
    (tmp_path / PUBLISHED_WEIGHTS["lama"].file).write_bytes(file.read_bytes())
    inpainter = get_inpainter("lama", InpainterOptions(device="cpu"))
    assert list(inpainter.weight_files.values()) == [tmp_path / "big-lama.pt"]
    with pytest.raises(InputError, match="`inpainter_side` must be between 128 and 1536, got 8"):
        get_inpainter("lama", InpainterOptions(weights=file, side=8))
    with pytest.raises(InputError, match="not a plain file"):
        get_inpainter("lama", InpainterOptions(weights=tmp_path))
    picture = views(40, 40, (0, 0, 9, 9))

    def short(self: LamaNetwork, rgb: Tensor, hole: Tensor) -> Tensor:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(LamaNetwork, "forward", short)
    with pytest.raises(
        InputError, match="not enough memory for LaMa at 40 pixels: lower `inpainter_side`"
    ):
        inpainter.paint(*picture)
    monkeypatch.setattr(LamaNetwork, "forward", lambda self, rgb, hole: rgb * torch.nan)
    with pytest.raises(InputError, match="not finite"):
        inpainter.paint(*picture)
