"""Weights from untrusted files: the formats, the refusals, and that no code in a file runs."""

from __future__ import annotations

import os
import pickle
import tracemalloc
import warnings
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from spackle.runtime.errors import InputError
from spackle.weights.checkpoints import load_strict, read_tensors

Weights = dict[str, Tensor]
GOOD = {"linear.weight": torch.arange(6.0).view(2, 3), "linear.bias": torch.tensor([0.5, -1.0])}
WHOLE = GOOD | {"places": torch.arange(4)}


class Small(nn.Module):
    """A network with an integer buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = nn.Linear(3, 2)
        self.register_buffer("places", torch.arange(4))


def write_script(tensors: Weights, path: Path) -> None:
    network = Small()
    network.load_state_dict(tensors)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchScript is deprecated
        torch.jit.save(torch.jit.script(network), path)


def write_old(content: object, path: Path) -> None:
    torch.save(content, path, _use_new_zipfile_serialization=False)


def write_parameters(tensors: Weights, path: Path) -> None:
    parameters = {
        name: nn.Parameter(tensor) for name, tensor in tensors.items() if tensor.is_floating_point()
    }
    torch.save(OrderedDict(tensors | parameters | {"epoch": 3, "list": [1]}), path)


WRITERS = [save_file, torch.save, write_script, write_old, write_parameters]


def read(path: Path) -> Weights:
    return read_tensors(path, "give another")


def refusal(path: Path) -> str:
    """The message with which a file is refused as weights of `Small`."""
    with pytest.raises(InputError) as caught:
        load_strict(Small(), read(path), path, "give another")
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert line.isprintable()
    assert len(line) < 1000
    return line


@pytest.mark.parametrize("write", WRITERS)
def test_every_format_is_read(tmp_path: Path, write: Callable[[Weights, Path], None]) -> None:
    write(WHOLE, tmp_path / "weights")
    found = read(tmp_path / "weights")
    assert found.keys() == WHOLE.keys()
    assert all(torch.equal(found[name], tensor) for name, tensor in WHOLE.items())


def test_views_of_one_storage_and_empty_tensors_are_read(tmp_path: Path) -> None:
    whole = torch.arange(12.0)
    tensors = {"a": whole.view(3, 4).T, "b": whole[5:9], "c": whole[:0]}
    torch.save(tensors, tmp_path / "a.pt")
    found = read(tmp_path / "a.pt")
    assert all(torch.equal(found[name], tensor) for name, tensor in tensors.items())


class Bomb:
    """Unpickling an instance makes a folder."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (str(self.mark),)


def write_archive(path: Path, records: dict[str, bytes], how: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", how) as opened:
        for name, data in records.items():
            opened.writestr(f"weights/{name}", data)


def records_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as opened:
        return {name.partition("/")[2]: opened.read(name) for name in opened.namelist()}


def test_code_in_a_file_is_not_run(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    mark = tmp_path / "mark"
    write_script(WHOLE, path)
    records = records_of(path)
    code = next(name for name in records if name.startswith("code/") and name.endswith(".py"))
    write_archive(path, records | {code: f"import os\nos.mkdir({str(mark)!r})\n".encode()})
    assert read(path).keys() == WHOLE.keys()
    torch.save(WHOLE | {"more": Bomb(mark)}, path)
    assert read(path).keys() == WHOLE.keys()
    torch.save(Bomb(mark), path)
    assert "no named tensors" in refusal(path)
    write_old(Bomb(mark), path)
    assert "nothing in the pickle was run" in refusal(path)
    path.write_bytes(pickle.dumps(Bomb(mark)))
    assert "nothing in the pickle was run" in refusal(path)
    assert not mark.exists()
    pickle.loads(path.read_bytes())
    assert mark.exists()


STORAGE = (
    b"(X\x07\x00\x00\x00storagectorch\nFloatStorage\nX\x01\x00\x00\x000X\x03\x00\x00\x00cpuK\x04tQ"
)
TENSOR = b"ctorch._utils\n_rebuild_tensor_v2\n(" + STORAGE + b"K\x00(%s(%stR"
NAME = b"X\x01\x00\x00\x00a"


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"\x80\x02}q\x00" + NAME + b"h\x00s.", "contain themselves"),
        (
            b"\x80\x02}q\x00" + 60 * (b"}(" + NAME + b"h\x00X\x01\x00\x00\x00bh\x00uq\x00") + b".",
            "too many",
        ),
        (
            b"\x80\x02}" + NAME + TENSOR % (b"J\xff\xff\xff\x7ft", b"K\x01t") + b"s.",
            "out of bounds",
        ),
        (
            b"\x80\x02}" + NAME + TENSOR % (b"J\xff\xff\xff\xfft", b"K\x01t") + b"s.",
            "not a file of weights",
        ),
        (
            b"\x80\x02" + TENSOR.replace(b"Float", b"Metal") % (b"K\x02t", b"K\x01t") + b".",
            "no named tensors",
        ),
        (b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x0fno", "not a file of weights"),
        (b"\x80\x05\x96" + bytes(5) + b"\x01" + bytes(2) + b"no", "a bytearray"),  # of a terabyte
        (b"0" * 5_000_000, "too large"),
        (b"\x80\x02}r\xff\xff\xff\x7f.", "no named tensors"),  # a memo of 2 billion places
    ],
)
def test_malicious_pickles_are_refused(tmp_path: Path, data: bytes, says: str) -> None:
    write_archive(tmp_path / "a.pt", {"data.pkl": data, "data/0": bytes(16)})
    assert says in refusal(tmp_path / "a.pt")


def test_a_length_beyond_the_end_of_an_old_file_takes_no_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    write_old(GOOD, path)
    name = b"protocol_version"
    content = path.read_bytes()
    length = len(name).to_bytes(4, "little")
    assert length + name in content
    path.write_bytes(content.replace(length + name, b"\xff\xff\xff\x7f" + name))
    tracemalloc.start()
    try:
        assert "not a file of weights" in refusal(path)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 100_000_000


def test_unusual_archives_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.pt"
    torch.save(GOOD, path)
    records = records_of(path)
    write_archive(path, records, zipfile.ZIP_DEFLATED)
    assert "is compressed" in refusal(path)
    write_archive(path, records | {"data/0": records["data/0"][:-4]})
    assert "has not the 24 bytes" in refusal(path)
    write_archive(path, {name: data for name, data in records.items() if name != "data/0"})
    assert "data/0" in refusal(path)
    write_archive(path, records)
    path.write_bytes(path.read_bytes().replace(GOOD["linear.weight"].numpy().tobytes(), bytes(24)))
    assert "damaged at " in refusal(path)


@pytest.mark.parametrize(
    "content",
    [
        b"<html>not found</html>",
        b'{"data":{"error": "gone"}}',
        (2**62).to_bytes(8, "little") + b"{}",
        torch.ones(3),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: object) -> None:
    if isinstance(content, bytes):
        (tmp_path / "a").write_bytes(content)
    else:
        torch.save(content, tmp_path / "a")
    assert "not a file of weights, or damaged (" in refusal(tmp_path / "a")
    assert "no such weight file" in refusal(tmp_path / "missing")
    write_archive(tmp_path / "a.zip", {"hello.txt": b"hello"})
    assert "without the pickle of a network" in refusal(tmp_path / "a.zip")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"linear.bias": None}, "(1 missing (linear.bias); 2 tensors are expected): give another"),
        (
            {f"more{n}": torch.ones(1) for n in range(5)},
            "5 unknown (more0, more1, more2, and 2 more)",
        ),
        ({"linear.bias": torch.ones(3)}, "1 of another shape (linear.bias [3] instead of [2])"),
        ({"linear.bias": torch.ones(2).int()}, "1 not of floats (linear.bias)"),
        ({"linear.bias": torch.ones(2).to_sparse()}, "1 missing (linear.bias)"),
        ({"linear.bias": torch.tensor([0, torch.nan])}, "not finite (linear.bias): give another"),
        ({"\x1b[31mred\x1b[0m\r\n\u202e" * 10_000: torch.ones(1)}, "1 unknown ("),
    ],
)
def test_each_difference_is_named(
    tmp_path: Path, change: dict[str, Tensor | None], says: str
) -> None:
    tensors = {name: tensor for name, tensor in (GOOD | change).items() if tensor is not None}
    for write in (torch.save, write_old):
        write(tensors, tmp_path / "a.pt")
        assert says in refusal(tmp_path / "a.pt")


@pytest.mark.parametrize("write", [save_file, torch.save])
def test_a_filled_network_is_frozen_and_shares_no_memory_with_its_file(
    tmp_path: Path, write: Callable[[Weights, Path], None]
) -> None:
    large, path = (
        torch.tensor([3e38, 3e38]),
        tmp_path / "a.pt",
    )  # finite numbers whose sum is infinite
    write(GOOD | {"linear.bias": large, "places": torch.tensor([9] * 4)}, path)
    network = load_strict(Small(), read(path), path, "give another")
    with open(path, "r+b") as file:
        file.write(bytes(path.stat().st_size))
    assert torch.equal(network.linear.weight, GOOD["linear.weight"])
    assert torch.equal(network.linear.bias, large)
    assert network.get_buffer("places").tolist() == [0, 1, 2, 3]
    assert not network.training
    assert not any(parameter.requires_grad for parameter in network.parameters())
    write({name: tensor.half() for name, tensor in GOOD.items()}, path)
    network = load_strict(Small(), read(path), path, "give another")
    assert torch.equal(network.linear.weight, GOOD["linear.weight"])
    assert network.linear.weight.dtype == torch.float32


def test_an_old_file_whose_pickle_asks_for_more_memory_than_the_file_has_is_refused(
    tmp_path: Path,
) -> None:
    path = tmp_path / "old.pt"
    write_old({"a": torch.zeros(50_000)}, path)
    content = path.read_bytes()
    # The number of a storage's floats, as the pickle writes it: BININT and four bytes.
    count = b"J" + (50_000).to_bytes(4, "little")
    other = b"M" + (50_000).to_bytes(2, "little")  # BININT2, for numbers of two bytes
    assert content.count(count) + content.count(other) >= 1
    huge = b"J" + (2**31 - 1).to_bytes(4, "little")
    path.write_bytes(content.replace(count, huge).replace(other, huge))
    tracemalloc.start()
    line = refusal(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "its tensors take 8,589,934,588 bytes, and the file has 2" in line
    assert peak < 10_000_000
