"""Worker processes share the GPUs."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import pytest
import torch

from spackle.runtime import loaded_kernels
from spackle.runtime.worker_options import WorkerOptions
from spackle.runtime.workers import parallel_map

chosen: list[int] = []


class OpenWorker:
    """Opens a worker, in a process whose torch sees two GPUs from the time it gets this object."""

    def __setstate__(self, state: object) -> None:
        torch.cuda.device_count = lambda: 2
        torch.cuda.set_device = chosen.append  # type: ignore[assignment]

    def __getstate__(self) -> object:
        return {"is_sent": True}  # without a state, no process would call `__setstate__`

    def __call__(self) -> Worker:
        return Worker()


class Worker:
    def make(self, folder: Path) -> tuple[int, ...]:
        """Return the GPU of this process once two processes are at work."""
        (folder / multiprocessing.current_process().name).touch()
        while len(list(folder.iterdir())) < 2:
            time.sleep(0.02)
        return tuple(chosen)


@pytest.mark.parametrize(("gpu", "expected"), [(True, {(0,), (1,)}), (False, {()})])
def test_each_process_uses_a_gpu_of_its_own(
    tmp_path: Path, gpu: bool, expected: set[tuple[int, ...]]
) -> None:
    workers = WorkerOptions(count=2, threads=1, gpu=gpu)
    with parallel_map(OpenWorker(), [tmp_path] * 4, lambda: False, workers, tmp_path) as results:
        assert set(results) == expected


@pytest.mark.parametrize(
    ("count", "device", "ray", "expected"),
    [
        (None, "auto", None, 2),  # one for each of two GPUs
        (None, "cpu", None, 1),
        (5, "cpu", None, 3),  # no more than jobs
        (None, "auto", "local", None),  # as many as the cluster has room for
    ],
)
def test_a_user_who_says_nothing_gets_a_process_for_each_gpu(
    monkeypatch: pytest.MonkeyPatch, count: int | None, device: str, ray: str | None, expected: int
) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert WorkerOptions.of_command(count, None, device, ray, job_count=3).count == expected


def test_numba_is_whole_before_processes_are_forked() -> None:
    """A kernel was compiled or loaded when the module was imported, so numba is loaded."""
    assert loaded_kernels._same.signatures
    assert loaded_kernels._same(3) == 3
