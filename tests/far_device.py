"""A device that is far away, as a GPU is, on a machine without one: it mixes with no other, and what waits is counted.

`meta` stands for it, because PyTorch knows of that everywhere; but its tensors hold numbers.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import gsplat_stand_in
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

FAR = torch.device("meta")
CPU = torch.device("cpu")
ATEN = torch.ops.aten
READS = {ATEN._local_scalar_dense.default, ATEN.nonzero.default, ATEN.equal.default, ATEN.masked_select.default}


class FarTensor(Tensor):
    """Numbers that lie far away."""

    near: Tensor

    @staticmethod
    def of(near: Tensor) -> FarTensor:
        far: FarTensor = Tensor._make_wrapper_subclass(  # type: ignore[attr-defined]
            FarTensor, near.shape, near.stride(), near.storage_offset(), dtype=near.dtype, device=FAR
        )
        far.near = near
        return far

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})

    def __repr__(self, **_: Any) -> str:
        return f"far {self.near!r}"


class FarDevice(TorchDispatchMode):
    """Computes far away; `waits` are the operations for which the host waits."""

    def __init__(self) -> None:
        super().__init__()
        self.waits: list[str] = []
        self.away = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        tensors = tree_leaves((args, kwargs))
        far = any(isinstance(t, FarTensor) for t in tensors) or kwargs.get("device") == FAR
        if far and not self.away and waits(func, args, kwargs):
            self.waits.append(str(func))
        return compute(func, args, kwargs)

    @contextlib.contextmanager
    def uncounted(self) -> Iterator[None]:
        """What is done here is not looked at."""
        self.away = True
        try:
            yield
        finally:
            self.away = False


def waits(func: Any, args: Any, kwargs: Any) -> bool:
    if func is ATEN._to_copy.default and kwargs.get("device") is not None:
        return torch.device(kwargs["device"]) == CPU or not (
            kwargs.get("non_blocking") or isinstance(args[0], FarTensor)
        )
    if func in (ATEN.index.Tensor, ATEN.index_put_.default, ATEN.index_put.default):
        return any(t is not None and t.dtype == torch.bool for t in args[1])
    return func in READS


def compute(func: Any, args: Any, kwargs: Any) -> Any:
    """Do it, here; numbers that lie apart do not meet."""
    tensors = [t for t in tree_leaves((args, kwargs)) if isinstance(t, Tensor)]
    far = any(isinstance(t, FarTensor) for t in tensors)
    moved = func in (ATEN._to_copy.default, ATEN.copy_.default)
    if far and not moved and any(not isinstance(t, FarTensor) and t.ndim for t in tensors):
        raise AssertionError(f"{func}: tensors of two devices: {args}")
    device = kwargs.get("device")
    if device is not None:
        far = torch.device(device) == FAR
        kwargs = {**kwargs, "device": CPU}
    out = func(*unwrapped(args), **unwrapped(kwargs))
    name = str(func).split(".")[1]
    if name.endswith("_") and not name.endswith("__"):
        return args[0]  # in place
    return tree_map(lambda t: FarTensor.of(t) if isinstance(t, Tensor) else t, out) if far else out


def unwrapped(tree: Any) -> Any:
    return tree_map(lambda t: t.near if isinstance(t, FarTensor) else t, tree)


class Watched:
    """The stand-in for gsplat there: its own looks at numbers do not count; the one wait that gsplat has does."""

    def __init__(self, far: FarDevice) -> None:
        self.far = far

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            if name == "isect_tiles":
                self.far.waits.append(name)
            with self.far.uncounted():
                return getattr(gsplat_stand_in, name)(*arguments, **options)

        return call


@pytest.fixture
def far_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[FarDevice]:
    """Tensors go there by `.to("meta")`."""
    # There is no autocast for `meta`, not even one to switch off.
    monkeypatch.setattr(torch, "autocast", lambda *arguments, **options: contextlib.nullcontext())
    with FarDevice() as mode:
        yield mode
