"""SHARP's options of speed: windows at once, torch.compile, one CUDA graph; and how often a GPU is waited for."""

from __future__ import annotations

import contextlib
import logging
from pathlib import Path
from typing import Any

import pytest
import torch
from sharp_weights import MICRO, micro_network, waves
from torch import Tensor
from torch._dynamo.utils import counters
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import spackle
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.encoder import WINDOWS, TransformerBlock
from spackle.bases.sharp.network import GraphedForward, SharpNetwork, SharpOutput, compile_forward
from spackle.image import Photo

PHOTO = Photo(torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0)), 40.0, "EXIF", Path("a.jpg"))


def same(one: SharpOutput, other: SharpOutput) -> bool:
    pairs = zip(vars(one.start).values(), vars(other.start).values(), strict=True)
    return torch.equal(one.deltas, other.deltas) and all(torch.equal(a, b) for a, b in pairs)


@pytest.mark.parametrize(("options", "calls"), [({}, 7), ({"windows": 9}, 4), ({"windows": 1}, WINDOWS)])
def test_so_many_windows_go_at_once_and_change_nothing(options: dict[str, Any], calls: int) -> None:
    seen: list[int] = []
    found = SharpBase(micro_network(), **options).infer(PHOTO, lambda done, total: seen.append(done))
    assert len(seen) == calls
    assert seen[-1] == WINDOWS
    expected = SharpBase(micro_network(), windows=35).infer(PHOTO)
    torch.testing.assert_close(found.start.disparity_map, expected.start.disparity_map, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.deltas, expected.deltas, rtol=1e-4, atol=1e-4)


def test_a_compiled_forward_shares_the_weights_of_its_network() -> None:
    network = micro_network()
    twin = compile_forward(network, backend="eager")
    assert isinstance(twin, SharpNetwork)
    assert all(module._compiled_call_impl is None for module in network.modules())
    assert all(a is b for a, b in zip(twin.parameters(), network.parameters(), strict=True))
    tokens = torch.randn(2, 65, MICRO.embed, generator=torch.Generator().manual_seed(0))
    one, other = (next(m for m in n.modules() if isinstance(m, TransformerBlock)) for n in (twin, network))
    with torch.no_grad():
        torch.testing.assert_close(one(tokens), other(tokens), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # PyTorch's own, of what it uses itself
@pytest.mark.parametrize("backend", ["eager", "inductor"])
def test_a_translated_forward_says_the_same(backend: str) -> None:
    network = micro_network()
    before = counters["stats"]["unique_graphs"]
    with torch.no_grad():
        found = compile_forward(network, backend)(waves(MICRO.side), 0.8, 5)
        expected = network(waves(MICRO.side), 0.8, 5)
    torch.testing.assert_close(found.deltas, expected.deltas, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.start.disparity_map, expected.start.disparity_map, rtol=1e-5, atol=1e-6)
    assert counters["stats"]["unique_graphs"] - before <= 5  # the blocks, of five windows and of one; and three more


def test_without_a_compiler_a_line_says_so_and_all_goes_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    error: Exception = RuntimeError("No working C++ compiler found in\n  torch._inductor.config.cpp.cxx")

    def fail(*arguments: object) -> Any:
        raise error

    monkeypatch.setattr("spackle.bases.sharp.base.compile_forward", lambda network: fail)
    plain, base = SharpBase(micro_network()), SharpBase(micro_network(), compiled=True)
    with caplog.at_level(logging.WARNING, "spackle"):
        found = [base.infer(PHOTO), base.infer(PHOTO)]
    assert (len(caplog.records), base.compiled) == (1, False)
    assert "C++" in base.compile_problem
    expected = plain.infer(PHOTO)
    assert all(same(output, expected) for output in found)
    error = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
    base = SharpBase(micro_network(), compiled=True)  # too little memory is no missing compiler
    with pytest.raises(spackle.InputError, match="not enough memory for the network: try --sharp windows=1"):
        base.predict(PHOTO)
    assert base.compiled


class RecordingGraph(TorchDispatchMode):
    """What a CUDA graph does: remembers operations and where their tensors lie, and repeats them. All else is gone."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, Any, Any, Any]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        self.calls.append((func, args, kwargs or {}, out))
        return out

    def replay(self) -> None:
        for func, args, kwargs, out in self.calls:
            again = func(*args, **kwargs)
            for old, new in zip(tree_leaves(out), tree_leaves(again), strict=True):
                if isinstance(old, Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class NoStream:
    def wait_stream(self, other: object) -> None: ...


def test_one_graph_says_of_every_photo_what_the_network_says(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, stand_in in (
        ("CUDAGraph", RecordingGraph),
        ("graph", lambda graph, stream: graph),
        ("Stream", NoStream),
        ("current_stream", NoStream),
        ("stream", contextlib.nullcontext),
        ("device", contextlib.nullcontext),
    ):
        monkeypatch.setattr(torch.cuda, name, stand_in)
    network = micro_network()
    calls: list[int] = []
    network.register_forward_hook(lambda *_: calls.append(1))
    graphed, seen, found = GraphedForward(network), [], []
    pictures = [(waves(MICRO.side), 0.8), (waves(MICRO.side).flip(-1), 1.3)]
    for one, mode in zip(pictures, (torch.inference_mode(), torch.no_grad()), strict=True):
        with mode:
            found.append(graphed(*one, 35, lambda done, total: seen.append((done, total))))
    assert len(calls) == 3  # to warm up, and captured
    assert seen == [(WINDOWS, WINDOWS)] * 2
    with torch.no_grad():
        assert all(same(output, network(*one, 35)) for output, one in zip(found, pictures, strict=True))
    assert not same(*found)  # the first is not what the second has become
