"""LaMa: its published arithmetic, its files, and what of a picture it looks at and paints."""

from __future__ import annotations

import contextlib
import os
import pickle
import re
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from dataset_builds import build, write_inputs
from plain_lama import Weights, made_input, plain_logits
from safetensors.torch import save_file
from torch import Tensor, nn

from spackle.cli.weights import lama_weights
from spackle.dataset.shards import load_manifest
from spackle.errors import InputError
from spackle.inpaint import InpainterOptions, get_inpainter
from spackle.inpaint.lama import MARGIN, LamaInpainter, groups_of, load_network, padded
from spackle.inpaint.lama_network import LamaNetwork, expected_shapes
from spackle.weights import PUBLISHED

GOLDEN = Path(__file__).parents[1] / "data" / "lama_golden.npz"  # of the original class, see `made_input`
X = made_input(24, 40)


@pytest.fixture(scope="module", autouse=True)
def _one_thread() -> None:
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def weights() -> Weights:
    """Of a network of one block, an eighth as wide as the published one."""
    return lama_weights(8, 1)


@pytest.fixture(scope="module")
def file(weights: Weights, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lama") / "lama.safetensors"
    save_file(weights, path)
    return path


# The network --------------------------------------------------------------------------------------


def test_a_narrow_network_is_the_original() -> None:
    golden = torch.from_numpy(np.load(GOLDEN)["tiny"])
    logits = LamaNetwork(lama_weights(16, 3)).logits(made_input(64, 96))[0, :, ::4, ::4]
    torch.testing.assert_close(logits, golden, rtol=0, atol=1e-5 * float(golden.abs().max()))


@pytest.mark.slow
def test_the_published_size_is_the_original() -> None:
    golden = torch.from_numpy(np.load(GOLDEN)["full"])
    logits = LamaNetwork(lama_weights()).logits(made_input(192, 256))[0, :, ::8, ::8]
    torch.testing.assert_close(logits, golden, rtol=0, atol=1e-5 * float(golden.abs().max()))


def test_the_published_size() -> None:
    shapes = expected_shapes()
    assert len(shapes) == 989 - 152  # without counts of batches
    assert sum(np.prod(shape) for name, shape in shapes.items() if "running" not in name) == 50_975_875


@pytest.mark.parametrize(("height", "width"), [(16, 16), (24, 40)])
def test_folded_weights_are_the_plain_network(weights: Weights, height: int, width: int) -> None:
    x, network = made_input(height, width), LamaNetwork(weights)
    plain = plain_logits(weights, x)
    torch.testing.assert_close(network.logits(x), plain, rtol=0, atol=1e-5 * float(plain.abs().max()))
    rgb = torch.where(x[:, 3:] > 0, torch.nan, x[:, :3])  # in a hole there may be anything
    torch.testing.assert_close(network(rgb, x[:, 3:] > 0), plain.sigmoid(), rtol=0, atol=1e-5)


# Its files ----------------------------------------------------------------------------------------


class Tree(nn.Module):
    """A module with tensors at these names; TorchScript keeps what it has of code, too."""

    def __init__(self, tensors: Weights) -> None:
        super().__init__()
        self.kernel_size, self.training = [3, 3], False
        for first in dict.fromkeys(name.partition(".")[0] for name in tensors):
            if first in tensors:
                self.register_buffer(first, tensors[first])
            else:
                inside = {
                    name.removeprefix(f"{first}."): x for name, x in tensors.items() if name.startswith(f"{first}.")
                }
                self.add_module(first, Tree(inside))

    def forward(self, x: Tensor) -> Tensor:
        return x + len(self.kernel_size)


def write_script(tensors: Weights, path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchScript is of the past
        torch.jit.save(torch.jit.script(Tree(tensors)), path)


def named(prefix: str, weights: Weights, change: Callable[[Tensor], Tensor] = lambda x: x) -> Weights:
    return {prefix + name: change(x) for name, x in weights.items()}


OTHERS = {"discriminator.model0.0.weight": torch.ones(3, 3), "model.generator.count": torch.ones(1)}


@pytest.mark.parametrize("prefix", ["model.generator.", "generator.", ""])
@pytest.mark.parametrize("write", [write_script, save_file, torch.save])
def test_published_files_are_read(
    weights: Weights, tmp_path: Path, prefix: str, write: Callable[[Weights, Path], None]
) -> None:
    counts = {f"{prefix}model.1.bn_l.num_batches_tracked": torch.tensor(7)}
    write(named(prefix, weights) | counts | (OTHERS if prefix == "model.generator." else {}), tmp_path / "big-lama.pt")
    assert torch.equal(load_network(tmp_path / "big-lama.pt").logits(X), LamaNetwork(weights).logits(X))


def test_half_precision_is_widened(weights: Weights, tmp_path: Path) -> None:
    write_script(named("generator.", weights, Tensor.half), tmp_path / "half.pt")
    logits = load_network(tmp_path / "half.pt").logits(X)
    torch.testing.assert_close(logits, LamaNetwork(named("", weights, lambda x: x.half().float())).logits(X))


class Touch:
    """Unpickled, it makes a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> object:
        return os.mkdir, (str(self.path),)


def archive(path: Path, records: dict[str, bytes], how: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", how) as opened:
        for name, data in records.items():
            opened.writestr(f"big-lama/{name}", data)


def records_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as opened:
        return {name.partition("/")[2]: opened.read(name) for name in opened.namelist()}


def test_code_in_a_file_is_not_run(weights: Weights, tmp_path: Path) -> None:
    path, mark = tmp_path / "big-lama.pt", tmp_path / "mark"
    write_script(named("generator.", weights), path)
    records = records_of(path)
    code = next(name for name in records if name.startswith("code/") and name.endswith(".py"))
    records[code] = f"import os\nos.mkdir({str(mark)!r})\n".encode()
    archive(path, records)
    assert torch.equal(load_network(path).logits(X), LamaNetwork(weights).logits(X))
    for evil in (Touch(mark), {"generator": Touch(mark)}):
        data = pickle.dumps(evil, protocol=2)
        archive(path, records | {"data.pkl": data})
        with pytest.raises(InputError, match=re.escape(str(path))):
            load_network(path)
        assert not mark.exists()
        pickle.loads(data)
        mark.rmdir()


def test_cut_and_damaged_files_are_a_line(weights: Weights, tmp_path: Path) -> None:
    path, random = tmp_path / "big-lama.pt", np.random.default_rng(0)
    for write in (write_script, save_file):
        write(named("generator.", weights), path)
        whole = path.read_bytes()
        for size in [1, 3, 4, 9, *(len(whole) * np.arange(1, 30) // 30), len(whole) - 1]:
            path.write_bytes(whole[:size])
            with pytest.raises(InputError, match=f"^[^\n]*{re.escape(str(path))}[^\n]*$"):
                load_network(path)
        for _ in range(30):  # a byte that does not matter may change
            damaged = bytearray(whole)
            damaged[random.integers(len(whole))] ^= 1 << random.integers(8)
            path.write_bytes(damaged)
            with contextlib.suppress(InputError):
                load_network(path)


FIRST = "model.1.ffc.convl2l.weight"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({FIRST: None}, "holds no generator"),
        ({"model.16.bias": torch.zeros(4)}, "1 tensors are another network's, such as model.16.bias"),
        ({"model.17.bias": torch.zeros(4)}, "such as model.17.bias"),
        ({FIRST: torch.full((8, 4, 7, 7), torch.nan)}, "1 of 89 tensors are no finite numbers"),
        ({FIRST: torch.ones(8, 4, 7, 7).int()}, "no finite numbers, such as model.1.ffc"),
        ({FIRST: torch.tensor(1.0)}, "another network's"),
    ],
)  # fmt: skip
def test_other_networks_are_a_line(
    weights: Weights, tmp_path: Path, change: dict[str, Tensor | None], said: str
) -> None:
    tensors = {name: x for name, x in (weights | change).items() if x is not None}
    write_script(named("generator.", tensors), tmp_path / "big-lama.pt")
    with pytest.raises(InputError, match=said):
        load_network(tmp_path / "big-lama.pt")


STORAGE = b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x04tQ"
TENSOR = b"ctorch._utils\n_rebuild_tensor_v2\n(" + STORAGE + b"K\x00(%s(%stR"
NAME = b"X\x01\x00\x00\x00a"


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\x80\x02}q\x00" + NAME + b"h\x00s.", "hold themselves"),
        (b"\x80\x02}q\x00" + 60 * (b"}(" + NAME + b"h\x00X\x01\x00\x00\x00bh\x00uq\x00") + b".", "too many"),
        (b"\x80\x02" + TENSOR % (b"J\xff\xff\xff\x7ft", b"K\x00t") + b".", "does not fit"),
        (b"\x80\x02" + TENSOR % (b"K\x02t", b"K\x04t") + b".", "does not fit"),
        (b"\x80\x02" + TENSOR % (b"J\xff\xff\xff\xfft", b"K\x01t") + b".", "no storage, shape or stride"),
        (b"\x80\x02" + TENSOR.replace(b"Float", b"Metal") % (b"K\x02t", b"K\x01t") + b".", "torch MetalStorage"),
        (b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x0fno", "cannot be read"),
        (b"\x80\x02}\x82\x01.", "extension"),
        (b"0" * 5_000_000, "too large"),
        (b"\x80\x02R.", "cannot be read"),
        (b"\x80\x02}r\xff\xff\xff\x7f.", "holds no generator"),  # a memo of 2 billion places
    ],
)  # fmt: skip
def test_pickles_that_mean_harm_are_a_line(tmp_path: Path, data: bytes, said: str) -> None:
    archive(tmp_path / "big-lama.pt", {"data.pkl": data, "data/0": bytes(16)})
    with pytest.raises(InputError, match=said):
        load_network(tmp_path / "big-lama.pt")


def test_storages_that_are_not_what_the_pickle_says_are_a_line(weights: Weights, tmp_path: Path) -> None:
    path = tmp_path / "big-lama.pt"
    write_script(named("generator.", weights), path)
    records = records_of(path)
    archive(path, records, zipfile.ZIP_DEFLATED)  # it could hold a thousand times its size
    with pytest.raises(InputError, match="larger than the file"):
        load_network(path)
    archive(path, records | {"data/0": records["data/0"][:-4]})
    with pytest.raises(InputError, match="storage 0 has not the"):
        load_network(path)
    archive(path, {name: data for name, data in records.items() if name != "data/0"})
    with pytest.raises(InputError, match="data/0"):
        load_network(path)


# What it paints -----------------------------------------------------------------------------------


def views(height: int, width: int, *holes: tuple[int, int, int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """One view of waves with rectangular holes of black, and no depth."""
    rgb, hole = made_input(height, width)[:, :3].permute(0, 2, 3, 1), torch.zeros(1, height, width, dtype=torch.bool)
    for top, left, bottom, right in holes:
        hole[:, top:bottom, left:right] = True
    return torch.where(hole[..., None], 0.0, rgb), hole, torch.zeros(1, height, width)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The sizes of what the network is given."""
    sizes: list[tuple[int, ...]] = []
    forward = LamaNetwork.forward

    def noted(self: LamaNetwork, rgb: Tensor, hole: Tensor) -> Tensor:
        sizes.append(tuple(hole.shape[2:]))
        return forward(self, rgb, hole)

    monkeypatch.setattr(LamaNetwork, "forward", noted)
    return sizes


def test_only_holes_change_and_only_their_surroundings_are_seen(file: Path, seen: list[tuple[int, ...]]) -> None:
    inpainter = LamaInpainter(InpainterOptions(file, device="cpu"))
    rgb, hole, depth = views(60, 700, (20, 10, 40, 20), (0, 690, 60, 700))
    painted = inpainter.paint(rgb, hole, depth)
    assert seen == [(64, 32 + MARGIN), (64, 12 + MARGIN + 4)]
    assert torch.equal(painted[~hole], rgb[~hole])
    assert bool((painted[hole] > 0).all() & (painted[hole] < 1).all())
    assert float(painted[hole].std(0).min()) > 1e-3
    assert torch.equal(inpainter.paint(rgb, hole, depth), painted)
    both = [torch.cat([x, torch.zeros_like(x)]) for x in (rgb, hole, depth)]
    assert torch.equal(inpainter.paint(*both), torch.cat([painted, torch.zeros_like(rgb)]))
    part = padded(rgb[:, :, :160].permute(0, 3, 1, 2)), padded(hole[:, None, :, :160])
    plain = load_network(file)(*part)[0, :, :60].permute(1, 2, 0)
    torch.testing.assert_close(painted[0, 20:40, 10:20], plain[20:40, 10:20])


def test_large_crops_are_reduced_and_no_hole_is_lost(file: Path, seen: list[tuple[int, ...]]) -> None:
    inpainter = LamaInpainter(InpainterOptions(file, 128, "cpu"))
    rgb, hole, depth = views(200, 300, (70, 100, 71, 200))
    rgb = torch.where(hole[..., None], 0.0, 0.25).expand_as(rgb)
    painted = inpainter.paint(rgb, hole, depth)
    assert seen == [(88, 128)]
    assert torch.equal(painted[~hole], rgb[~hole])
    assert bool((painted[hole] > 0).all())
    assert inpainter.version == "1, long side 128"
    given: list[Tensor] = []
    inpainter._network.forward = lambda *inputs: (given.extend(inputs), inputs[0])[1]  # type: ignore[assignment]
    inpainter.paint(rgb, hole, depth)
    known = ~given[1].expand_as(given[0])
    torch.testing.assert_close(given[0][known], torch.full((int(known.sum()),), 0.25))  # no black of the hole
    assert int(given[1].sum()) == 2 * 44  # of a row of a hundred pixels, at 0.43


def test_pictures_smaller_than_the_network_takes() -> None:
    x = torch.arange(9.0).view(1, 1, 3, 3)
    row = torch.tensor([0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2, 1])
    assert torch.equal(padded(x), x[..., row, :][..., row])
    assert padded(torch.ones(1, 1, 1, 17)).shape == (1, 1, 16, 24)


def test_groups_of_holes() -> None:
    hole = torch.zeros(500, 900, dtype=torch.bool)
    assert groups_of(hole) == []
    hole[10:20, 10:20] = hole[30:40, 18:60] = True  # near each other
    hole[400:, 850:] = True
    groups = groups_of(hole)
    assert [(c.top, c.left, c.bottom, c.right) for c, _ in groups] == [(0, 0, 48, 64), (400, 848, 512, 912)]
    assert [(c.top, c.left, c.bottom, c.right) for _, c in groups] == [(0, 0, 176, 192), (272, 720, 500, 900)]
    hole[:, :3] = hole[:, -3:] = hole[:3] = hole[-3:] = True  # around everything
    assert len(groups_of(hole)) == 1
    generator = torch.Generator().manual_seed(0)
    speckled = torch.rand(700, 800, generator=generator) > 0.9999
    counts = torch.zeros(700, 800)
    for crop, _ in groups_of(speckled):
        counts[crop.slices] += 1
    assert bool((counts[speckled] == 1).all())


def test_what_goes_wrong_is_a_line(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    with pytest.raises(InputError, match="spackle weights get lama"):
        get_inpainter("lama", InpainterOptions())
    (tmp_path / PUBLISHED["lama"].file).write_bytes(file.read_bytes())
    inpainter = get_inpainter("lama", InpainterOptions(device="cpu"))
    assert list(inpainter.files.values()) == [tmp_path / "big-lama.pt"]
    with pytest.raises(InputError, match="its side must be between 128 and 1536"):
        get_inpainter("lama", InpainterOptions(file, 8))
    with pytest.raises(InputError, match="not a plain file"):
        get_inpainter("lama", InpainterOptions(tmp_path))
    picture = views(40, 40, (0, 0, 9, 9))

    def short(self: LamaNetwork, rgb: Tensor, hole: Tensor) -> Tensor:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(LamaNetwork, "forward", short)
    with pytest.raises(InputError, match="too little memory for 40 pixels"):
        inpainter.paint(*picture)
    monkeypatch.setattr(LamaNetwork, "forward", lambda self, rgb, hole: rgb * torch.nan)
    with pytest.raises(InputError, match="not finite"):
        inpainter.paint(*picture)


def test_a_dataset_is_painted_and_says_by_what(file: Path, tmp_path: Path) -> None:
    place = write_inputs(tmp_path / "inputs", 1, 33, 32)
    done = build(place, tmp_path / "out", "--views", 3, "--inpainter", "lama", "--inpainter-weights", file)
    assert done.code == 0, done.err
    used = load_manifest(tmp_path / "out").config["inpainter"]
    assert (used["name"], used["version"], list(used["weights"])) == ("lama", "1, long side 1024", ["lama"])
