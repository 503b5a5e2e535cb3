"""All kernels of a fill compile for a GPU; this needs numba-cuda, but no GPU."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest
from helpers.holes import box_view, random_network
from helpers.scenes import shifted

from spackle.runtime import parallel_kernels
from spackle.scene_fill import fill_scene

HOPPER = (9, 0)  # the compute capability of an H100


def kernels_of_a_fill() -> dict[str, tuple[parallel_kernels.ParallelKernel, tuple[Any, ...]]]:
    """Each kernel that runs while two views are filled, by its name, with its arguments."""
    runs: dict[str, tuple[parallel_kernels.ParallelKernel, tuple[Any, ...]]] = {}
    run_all = parallel_kernels.ParallelKernel.__call__

    def note_and_run(kernel: parallel_kernels.ParallelKernel, size: Any, *arguments: Any) -> None:
        """Run a kernel as always, and note its arguments."""
        runs[kernel.__name__] = (kernel, arguments)
        run_all(kernel, size, *arguments)

    context, _ = box_view(width=40, height=32)
    context = dataclasses.replace(context, network=random_network())
    cameras = [shifted(context.photo_camera, right) for right in (-0.4, 0.4)]
    with mock.patch.object(parallel_kernels.ParallelKernel, "__call__", note_and_run):
        fill_scene(context, cameras, exact=True)
    return runs


def test_all_kernels_compile_for_a_gpu() -> None:
    pytest.importorskip("numba_cuda")
    import numba
    from numba import cuda

    from spackle.runtime import kernels_on_gpu

    runs = kernels_of_a_fill()
    assert len(runs) >= 18
    a_gpu = SimpleNamespace(compute_capability=HOPPER)
    with mock.patch("numba.cuda.dispatcher.get_current_device", return_value=a_gpu):
        for kernel, arguments in runs.values():
            thread = kernels_on_gpu.gpu_thread(kernel.body, kernel.index_count)
            arrays = tuple(parallel_kernels._as_array(argument) for argument in arguments)
            signature = (numba.int64, numba.int64, numba.typeof(arrays))
            assembly, _ = cuda.compile_ptx(thread.py_func, signature, cc=HOPPER)
            assert ".target sm_90" in assembly
