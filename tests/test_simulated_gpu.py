"""Fill and training on a GPU, in numba's simulator: the processor's results, without copies to the
host.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from helpers.holes import CPU, box_view, random_network
from helpers.scenes import shifted
from helpers.stand_in_gpu import (
    GPU,
    HANDFUL,
    StandInNetwork,
    StandInRenderer,
    on_gpu,
    stand_in_gpu,
    unwrap,
    wrap,
)
from torch import is_tensor
from torch.utils._pytree import tree_leaves, tree_map

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.paper.training.residual import complete_samples
from spackle.paper.training.samples import Sample
from spackle.runtime import parallel_kernels
from spackle.runtime.parallel_kernels import ParallelKernel
from spackle.scene_fill import FillContext, fill_scene, fill_view

IS_SIMULATED = os.environ.get("NUMBA_ENABLE_CUDASIM") == "1"


@pytest.mark.skipif(IS_SIMULATED, reason="this is the process that the test starts")
def test_in_the_simulator() -> None:
    # Numba reads the variable once, when it is imported, so another process is needed.
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n0", "-p", "no:cacheprovider", __file__],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]


# The simulator computes with NumPy's numbers, which warn where a hash shall overflow.
pytestmark = pytest.mark.filterwarnings("ignore:.*overflow encountered:RuntimeWarning")
needs_simulator = pytest.mark.skipif(not IS_SIMULATED, reason="runs in numba's simulator")


def views() -> tuple[FillContext, list[Camera]]:
    """A box before a wall, small, with a random network, and views to its left and right."""
    context, _ = box_view(width=40, height=32)
    context = dataclasses.replace(context, network=random_network(), precision="fp32")
    return context, [shifted(context.photo_camera, right) for right in (-0.4, 0.4)]


def on_stand_in(context: FillContext) -> FillContext:
    """The same context, with Gaussians, renderer and network on the stand-in."""
    network: Any = None if context.network is None else StandInNetwork(context.network)
    return dataclasses.replace(
        context, base=on_gpu(context.base), renderer=StandInRenderer(), network=network
    )


def check_close(found: Gaussians, expected: Gaussians) -> None:
    """Assert that 99.9 % of all numbers agree within a thousandth."""
    pairs = zip(found.tensors, expected.tensors, strict=True)
    agree = [torch.isclose(unwrap(a), b, rtol=1e-3, atol=1e-3).flatten() for a, b in pairs]
    assert float(torch.cat(agree).float().mean()) >= 0.999


@needs_simulator
def test_each_kernel_writes_the_arrays_that_it_writes_on_the_processor() -> None:
    context, (camera, _) = views()
    run_on_processor = ParallelKernel.__call__
    compared: dict[str, int] = {}

    def run_twice(kernel: ParallelKernel, size: Any, *arguments: Any) -> None:
        """Run a kernel on the processor, and on the stand-in with copies of its arguments."""
        # Arguments that share memory, as where a kernel works in place, share it in the copies.
        memory = {
            (tensor.data_ptr(), tensor.shape): wrap(tensor.clone())
            for tensor in tree_leaves(arguments)
            if is_tensor(tensor)
        }
        copies = tree_map(lambda a: memory[a.data_ptr(), a.shape] if is_tensor(a) else a, arguments)
        run_on_processor(kernel, size, *arguments)
        with stand_in_gpu():
            run_on_processor(kernel, size, *copies)
        for here, there in zip(tree_leaves(arguments), tree_leaves(copies), strict=True):
            if is_tensor(here):
                agree = torch.isclose(unwrap(there), here, rtol=1e-4, atol=1e-5, equal_nan=True)
                differing = int((~agree).sum())
                assert differing <= 0.001 * agree.numel(), kernel.__name__
        compared[kernel.__name__] = compared.get(kernel.__name__, 0) + 1

    with mock.patch.object(ParallelKernel, "__call__", run_twice):
        fill_view(context, camera)
    assert len(compared) >= 18, compared


@needs_simulator
def test_views_are_filled_as_on_the_processor_without_copies() -> None:
    context, cameras = views()
    expected = fill_scene(context, cameras, exact=True)
    with stand_in_gpu() as gpu:
        found = fill_scene(on_stand_in(context), cameras, exact=True)
        assert found.aux.means.device.type == "cuda"
    check_close(found.aux, expected.aux)
    assert max(gpu.to_host) <= HANDFUL


@needs_simulator
def test_the_papers_method_runs_without_copies() -> None:
    context, (camera, _) = views()
    expected = context.complete_as_paper(camera)
    with stand_in_gpu() as gpu:
        found = on_stand_in(context).complete_as_paper(camera)
    check_close(found, expected)
    assert max(gpu.to_host) <= HANDFUL


@needs_simulator
def test_the_stand_in_counts_copies_and_refuses_tensors_of_both_devices() -> None:
    with stand_in_gpu() as gpu:
        numbers = torch.zeros(20, device="cuda")
        numbers.cpu()
        with pytest.raises(RuntimeError, match="on the CPU"):
            numbers + torch.zeros(20)
    assert gpu.to_host == [20]


@needs_simulator
def test_a_gpu_without_kernels_leaves_the_work_to_the_processor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    context, (camera, _) = views()
    monkeypatch.setattr(
        parallel_kernels, "_reason_against_gpu", lambda device: "the driver is too old"
    )
    with stand_in_gpu() as gpu:
        found = fill_view(on_stand_in(context), camera).aux
        assert found.means.device.type == "cuda"
    check_close(found, fill_view(context, camera).aux)
    assert max(gpu.to_host) > HANDFUL


@needs_simulator
def test_a_training_step_completes_samples_as_on_the_processor_without_copies() -> None:
    context, (camera, _) = views()
    network = context.network
    assert network is not None
    rendering = CPU.render(context.base, camera)
    photo = CPU.render(context.base, context.photo_camera).rgb

    def sample() -> Sample:
        """The view on the processor, with an arbitrary target."""
        return Sample.of(
            context.base, rendering, camera, context.photo_camera, photo, rendering.rgb
        )

    expected = complete_samples(network, network.inputs, [sample()], CPU)
    with stand_in_gpu() as gpu:
        there = sample().to(GPU)
        there.network_input(network.inputs)
        stand_in: Any = StandInNetwork(network)
        found = complete_samples(stand_in, network.inputs, [there], StandInRenderer())
    assert torch.allclose(unwrap(found.rgb), expected.rgb, atol=1e-3)
    assert max(gpu.to_host) <= HANDFUL
