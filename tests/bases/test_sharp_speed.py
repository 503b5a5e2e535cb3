"""SHARP's options for speed: windows at once, and torch.compile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from sharp_weights import MICRO, micro_network, waves
from torch._dynamo.utils import counters

import spackle
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.encoder import WINDOWS, TransformerBlock
from spackle.bases.sharp.network import compile_forward
from spackle.image import Photo

PHOTO = Photo(torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0)), 40.0, "EXIF", Path("a.jpg"))


@pytest.mark.parametrize(("options", "calls"), [({}, 7), ({"windows": 9}, 4), ({"windows": 1}, WINDOWS)])
def test_the_number_of_windows_at_once_changes_nothing(options: dict[str, Any], calls: int) -> None:
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
    assert all(module._compiled_call_impl is None for module in network.modules())
    assert all(a is b for a, b in zip(twin.parameters(), network.parameters(), strict=True))
    tokens = torch.randn(2, 65, MICRO.embed, generator=torch.Generator().manual_seed(0))
    one, other = (next(m for m in n.modules() if isinstance(m, TransformerBlock)) for n in (twin, network))
    with torch.no_grad():
        torch.testing.assert_close(one(tokens), other(tokens), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # PyTorch warns about its own calls
@pytest.mark.parametrize("backend", ["eager", "inductor"])
def test_a_compiled_forward_gives_the_same_results(backend: str) -> None:
    network = micro_network()
    before = counters["stats"]["unique_graphs"]
    with torch.no_grad():
        found = compile_forward(network, backend)(waves(MICRO.side), 0.8, 5)
        expected = network(waves(MICRO.side), 0.8, 5)
    torch.testing.assert_close(found.deltas, expected.deltas, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(found.start.disparity_map, expected.start.disparity_map, rtol=1e-5, atol=1e-6)
    assert counters["stats"]["unique_graphs"] - before <= 5  # blocks for five windows and for one, and three parts


def test_without_a_compiler_the_option_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    error: Exception = RuntimeError("No working C++ compiler found in\n  torch._inductor.config.cpp.cxx")

    def fail(*arguments: object) -> Any:
        raise error

    monkeypatch.setattr("spackle.bases.sharp.base.compile_forward", lambda network: fail)
    base = SharpBase(micro_network(), compiled=True)
    with pytest.raises(spackle.InputError, match=r"compile=yes: SHARP cannot be compiled \(No working C\+\+"):
        base.predict(PHOTO)
    error = torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
    with pytest.raises(spackle.InputError, match="not enough memory for the network: try --sharp windows=1"):
        base.predict(PHOTO)
