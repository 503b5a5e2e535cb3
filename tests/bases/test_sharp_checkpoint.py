"""SHARP's checkpoint as a stranger's file: strict about what it holds, and nothing in it is run."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from sharp_weights import tiny_weights, write_tiny
from torch import Tensor

import spackle
from spackle.bases.sharp.checkpoint import load_network

FP32 = torch.float32


class Bomb:
    """Unpickling this makes a folder."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Callable[[str], None], tuple[str]]:
        return os.mkdir, (str(self.mark),)


@pytest.fixture(scope="module")
def weights() -> dict[str, Tensor]:
    return tiny_weights()


def refused(path: Path) -> str:
    """The one line that a checkpoint is refused with."""
    with pytest.raises(spackle.InputError) as caught:
        load_network(path, FP32)
    line = str(caught.value)
    assert "\n" not in line
    assert str(path) in line
    assert len(line) < 1000
    return line


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_both_kinds_of_file_give_the_same_network(
    tmp_path: Path, weights: dict[str, Tensor], suffix: str, dtype: torch.dtype
) -> None:
    path = write_tiny(tmp_path / f"weights{suffix}")
    network = load_network(path, dtype)
    path.unlink()  # what was read from it stays
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor.float(), weights[name].to(tensor.dtype).float()), name
        assert not tensor.requires_grad
    assert not network.training
    assert not any("depth_alignment" in name or ".head.weight" in name for name in network.state_dict())


def test_a_pickle_with_code_is_refused_and_not_run(tmp_path: Path, weights: dict[str, Tensor]) -> None:
    mark = tmp_path / "ran"
    torch.save({**weights, "more": Bomb(mark)}, tmp_path / "zip.pt")
    torch.save({**weights, "more": Bomb(mark)}, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    (tmp_path / "plain.pt").write_bytes(pickle.dumps(Bomb(mark)))
    torch.save(Bomb(mark), tmp_path / "alone.pt")
    torch.save(torch.nn.Linear(2, 2), tmp_path / "module.pt")
    torch.save(weights, tmp_path / "before_zips.pt", _use_new_zipfile_serialization=False)
    for name in ("zip.pt", "old.pt", "plain.pt", "alone.pt", "module.pt", "before_zips.pt"):
        assert "nothing in it was run" in refused(tmp_path / name)
    assert not mark.exists()


@pytest.mark.parametrize("share", [0.001, 0.5, 0.999])
@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_a_cut_file_is_refused(tmp_path: Path, suffix: str, share: float) -> None:
    path = write_tiny(tmp_path / f"weights{suffix}")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    refused(path)


def repacked(
    source: Path, target: Path, method: int = zipfile.ZIP_STORED, byteorder: bytes = b"little", share: float = 1
) -> Path:
    """What a checkpoint becomes when another program packs it, of each tensor a share."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", method) as new:
        for entry in old.infolist():
            data = byteorder if entry.filename.endswith("/byteorder") else old.read(entry)
            new.writestr(entry.filename, data[: int(share * len(data))] if "/data/" in entry.filename else data)
    return target


def test_a_zip_that_was_compressed_cut_or_is_big_endian_is_refused(tmp_path: Path, weights: dict[str, Tensor]) -> None:
    path = write_tiny(tmp_path / "w.pt")
    packed = repacked(path, tmp_path / "packed.pt", zipfile.ZIP_DEFLATED)
    assert "zipped again by another program" in refused(packed)
    refused(repacked(path, tmp_path / "cut.pt", share=0.5))
    assert "big-endian" in refused(repacked(path, tmp_path / "turned.pt", byteorder=b"big"))
    assert "endian" in refused(repacked(path, tmp_path / "turned.pt", byteorder=b"middle"))
    network = load_network(repacked(path, tmp_path / "stored.pt"), FP32)  # packed again without compression
    assert all(torch.equal(tensor, weights[name]) for name, tensor in network.state_dict().items())


def test_a_zip_with_one_changed_byte_is_refused(tmp_path: Path, weights: dict[str, Tensor]) -> None:
    path = write_tiny(tmp_path / "w.pt")
    content = bytearray(path.read_bytes())
    number = content.index(weights["feature_model.fusion.out_conv.weight"].numpy().tobytes())
    content[number + 40] ^= 1  # a last digit
    path.write_bytes(content)
    assert "damaged at " in refused(path)


def files_of_other_kinds() -> dict[str, bytes | None]:
    zipped = io.BytesIO()
    with zipfile.ZipFile(zipped, "w") as archive:
        archive.writestr("hello.txt", "hello")
    numbers = io.BytesIO()
    torch.save([1, 2, 3], numbers)
    nested = io.BytesIO()
    torch.save({"state_dict": tiny_weights(), "epoch": 3}, nested)
    numbered = io.BytesIO()
    torch.save({0: torch.zeros(2)}, numbered)
    return {
        "missing.pt": None,
        "empty.pt": b"",
        "text.pt": b"<html>not found</html>",
        "answer.json": b'{"data":{"error": "gone"}}',
        "noise.pt": bytes(range(256)) * 40,
        "zip.pt": zipped.getvalue(),
        "list.pt": numbers.getvalue(),
        "nested.pt": nested.getvalue(),
        "numbered.pt": numbered.getvalue(),
        "huge.safetensors": (2**62).to_bytes(8, "little") + b"{}",
    }


@pytest.mark.parametrize("name", files_of_other_kinds())
def test_files_of_other_kinds_are_refused(tmp_path: Path, name: str) -> None:
    content = files_of_other_kinds()[name]
    if content is not None:
        (tmp_path / name).write_bytes(content)
    line = refused(tmp_path / name)
    known = name in ("missing.pt", "empty.pt", "zip.pt", "list.pt", "nested.pt", "numbered.pt")
    assert ("neither a PyTorch checkpoint nor a safetensors file" in line) is not known


def test_each_difference_is_listed(tmp_path: Path, weights: dict[str, Tensor]) -> None:
    changed = dict(weights)
    del changed["prediction_head.geometry_prediction_head.bias"]
    changed["extra"] = torch.zeros(1)
    unused = "depth_alignment.scale_map_estimator.conv_out.weight"  # by inference
    changed[unused] = torch.zeros(2, 16, 1, 1)
    changed["feature_model.fusion.out_conv.bias"] = torch.zeros(17)
    save_file(changed, tmp_path / "w.safetensors")
    line = refused(tmp_path / "w.safetensors")
    assert "1 missing (prediction_head.geometry_prediction_head.bias)" in line
    assert "1 unknown (extra)" in line
    assert "2 of another shape (" in line
    assert "feature_model.fusion.out_conv.bias [17] instead of [16]" in line
    assert unused in line


def odd_names() -> dict[str, object]:
    nested: tuple[object, ...] = ()
    for _ in range(200):
        nested = (nested,)
    return {
        "escapes": "\x1b[31mred\x1b[0m\r\n\u202e",
        "long": "\x07" * 100_000,
        "nested": nested,
    }


@pytest.mark.parametrize("kind", odd_names())
def test_odd_names_do_not_reach_the_terminal(tmp_path: Path, weights: dict[str, Tensor], kind: str) -> None:
    for value in (torch.zeros(1), torch.zeros(1, dtype=torch.int32)):
        torch.save({**weights, odd_names()[kind]: value}, tmp_path / "w.pt")
        assert refused(tmp_path / "w.pt").isprintable()


def test_large_numbers_and_half_precision_are_read_but_no_nan(tmp_path: Path, weights: dict[str, Tensor]) -> None:
    """Large numbers whose sum overflows are finite."""
    name = "feature_model.fusion.out_conv.bias"
    save_file({**weights, name: torch.full((16,), 3e38)}, tmp_path / "w.safetensors")
    assert float(load_network(tmp_path / "w.safetensors", FP32).state_dict()[name].max()) == pytest.approx(3e38)
    save_file({**weights, name: torch.full((16,), torch.nan)}, tmp_path / "w.safetensors")
    assert "not finite" in refused(tmp_path / "w.safetensors")
    save_file({name: tensor.half() for name, tensor in weights.items()}, tmp_path / "h.safetensors")
    network = load_network(tmp_path / "h.safetensors", FP32)
    assert all(tensor.dtype == FP32 for tensor in network.state_dict().values())


def odd_tensors() -> dict[str, Tensor]:
    hiding = torch.zeros(16)
    hiding.float = "x"  # type: ignore[method-assign,assignment]
    return {
        "int": torch.zeros(16, dtype=torch.int32),
        "meta": torch.zeros(16, device="meta"),
        "sparse": torch.ones(16).to_sparse(),
        "hiding": hiding,
    }


@pytest.mark.parametrize("kind", odd_tensors())
def test_tensors_of_odd_kinds_are_refused(tmp_path: Path, weights: dict[str, Tensor], kind: str) -> None:
    torch.save({**weights, "feature_model.fusion.out_conv.bias": odd_tensors()[kind]}, tmp_path / "w.pt")
    assert "no plain tensor of floats" in refused(tmp_path / "w.pt")


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_a_file_that_changes_later_changes_nothing(tmp_path: Path, suffix: str) -> None:
    path = write_tiny(tmp_path / f"weights{suffix}").rename(tmp_path / "weights.pt")  # its content tells its kind
    network = load_network(path, FP32)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    size = path.stat().st_size
    with open(path, "r+b") as file:
        file.write(b"\0" * size)
    assert all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())
