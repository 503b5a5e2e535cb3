"""A stand-in for a GPU, where there is none: tensors that say they are on it, and copies counted.

Its memory is the host's, and numba's simulator runs the kernels. Like a GPU it refuses operations
on tensors of both devices; other than a GPU it knows how much travels to the host.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_flatten, tree_map

from spackle.core.camera import Camera
from spackle.core.crop import Crop
from spackle.core.gaussians import Gaussians
from spackle.render import CpuRenderer, Renderer
from spackle.render.protocol import Rendering
from spackle.residual import ResidualNet
from spackle.runtime import kernels_on_gpu

GPU = torch.device("cuda", 0)
HANDFUL = 16  # a camera's numbers: so many may travel at a time

CONVERSIONS = {Tensor.cpu, Tensor.numpy, Tensor.tolist, Tensor.__array__}
NUMBERS = {
    Tensor.item,
    Tensor.__bool__,
    Tensor.__int__,
    Tensor.__float__,
    Tensor.__index__,
}


class OnGpu(Tensor):
    """A tensor of the host's memory that says it is on a GPU."""

    __torch_function__ = torch._C._disabled_torch_function_impl


def wrap(tensor: Tensor) -> OnGpu:
    """The same memory, as if it were a GPU's."""
    with torch._C.DisableTorchFunction():
        return tensor.as_subclass(OnGpu)


def unwrap(value: Any) -> Any:
    """The same memory as the host's; anything but the stand-in's tensors is returned as it is."""
    if isinstance(value, OnGpu):
        with torch._C.DisableTorchFunction():
            return value.as_subclass(Tensor)
    return value


class StandInGpu(TorchFunctionMode):
    """While it is active, the device "cuda" exists; `to_host` has the sizes of what came back."""

    def __init__(self) -> None:
        super().__init__()
        self.to_host: list[int] = []

    def __torch_function__(
        self,
        function: Callable[..., Any],
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Run a function of torch on the host's memory, and give its tensors to their device."""
        kwargs = dict(kwargs or {})
        tensors = [value for value in tree_flatten((args, kwargs))[0] if isinstance(value, Tensor)]
        is_on_gpu = any(isinstance(tensor, OnGpu) for tensor in tensors)

        if function == Tensor.device.__get__ and is_on_gpu:
            return GPU
        if function == Tensor.is_cuda.__get__:
            return is_on_gpu
        host_args, host_kwargs = tree_map(unwrap, (args, kwargs))
        if function in CONVERSIONS | NUMBERS and is_on_gpu:
            self.to_host.append(args[0].numel())
            return function(*host_args, **host_kwargs)

        wanted = _wanted_device(function, args, kwargs)
        if wanted is not None:
            if wanted.type == "cpu" and is_on_gpu:
                self.to_host.append(args[0].numel())
            host_args, host_kwargs = tree_map(_without_gpu, (host_args, host_kwargs))
            result = function(*host_args, **host_kwargs)
            return tree_map(_wrapped, result) if wanted.type == "cuda" else result

        # An operation on tensors of both devices fails on a GPU, but for single numbers.
        if is_on_gpu and function is not Tensor.copy_:
            for tensor in tensors:
                if not isinstance(tensor, OnGpu) and tensor.ndim:
                    raise RuntimeError(f"{function}: a tensor on the CPU among those of a GPU")
        result = function(*host_args, **host_kwargs)
        return tree_map(_wrapped, result) if is_on_gpu else result


def _wrapped(value: Any) -> Any:
    """A tensor as if it were on the GPU; anything else as it is."""
    return wrap(value) if isinstance(value, Tensor) else value


def _without_gpu(value: Any) -> Any:
    """The CPU in place of the GPU's name; anything else as it is."""
    is_gpu = value == "cuda" or (isinstance(value, torch.device) and value.type == "cuda")
    return torch.device("cpu") if is_gpu else value


def _wanted_device(
    function: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]
) -> torch.device | None:
    """The device that a call names for its result; None if it names none."""
    if function is Tensor.to:
        for value in (*args[1:], *kwargs.values()):
            if isinstance(value, torch.device):
                return value
            if isinstance(value, Tensor):
                return GPU if isinstance(value, OnGpu) else torch.device("cpu")
        return None
    device = kwargs.get("device")
    return torch.device(device) if device is not None else None


class StandInRenderer(Renderer):
    """Draws on the processor, and says that it draws on the GPU."""

    device = GPU

    def render(self, gaussians: Any, camera: Camera, **options: Any) -> Rendering:
        """The images of `CpuRenderer`, on the stand-in."""
        sets = [gaussians] if isinstance(gaussians, Gaussians) else gaussians
        with torch._C.DisableTorchFunction():
            host_sets = [Gaussians(*map(unwrap, part.tensors)) for part in sets]
            rendering = CpuRenderer().render(host_sets, camera)
            return Rendering(*map(wrap, rendering.tensors))


class StandInNetwork:
    """A residual network that computes on the processor, and says that it does on the GPU."""

    def __init__(self, network: ResidualNet) -> None:
        self.network = network
        self.inputs = network.inputs
        self.local = network.local
        self.view_type = network.view_type

    def to(self, device: torch.device) -> StandInNetwork:
        """The same; it is there already."""
        return self

    def parameters(self) -> Iterator[Tensor]:
        """One tensor, for those who ask where the network is."""
        yield wrap(torch.zeros(1))

    def __call__(self, features: Tensor, *inner: Crop) -> Tensor:
        """The network's output for all cells, or for the inner ones, on the stand-in."""
        with torch._C.DisableTorchFunction():
            return wrap(self.network(unwrap(features), *inner))


@contextlib.contextmanager
def stand_in_gpu() -> Iterator[StandInGpu]:
    """Let the device "cuda" exist in a block, run by numba's simulator."""

    def as_array(argument: Any) -> Any:
        """A kernel's argument as an array of the host's memory."""
        if isinstance(argument, OnGpu):
            with torch._C.DisableTorchFunction():
                return unwrap(argument).detach().numpy()
        assert not isinstance(argument, Tensor), "a kernel on a GPU got a tensor of the CPU"
        if isinstance(argument, tuple):
            return type(argument)(*map(as_array, argument))
        return argument

    simulated = mock.patch.multiple(
        kernels_on_gpu,
        # Two threads share the items, which shows whether all are done, and none twice.
        THREADS_PER_BLOCK=2,
        MAX_BLOCKS=1,
        _as_device_array=as_array,
        _current_stream=lambda: 0,
    )
    with (
        simulated,
        mock.patch("torch.cuda.device", return_value=contextlib.nullcontext()),
        StandInGpu() as gpu,
    ):
        yield gpu


def on_gpu(gaussians: Gaussians) -> Gaussians:
    """Gaussians on the stand-in."""
    return Gaussians(*(wrap(tensor.clone()) for tensor in gaussians.tensors))
