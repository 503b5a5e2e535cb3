"""Worker processes share the GPUs."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path

import pytest
import torch

from spackle.runtime.workers import parallel_map

chosen: list[int] = []
if (
    multiprocessing.current_process().name != "MainProcess"
):  # a worker imports this module before it starts
    torch.cuda.device_count = lambda: 2
    torch.cuda.set_device = chosen.append  # type: ignore[assignment]


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
    with parallel_map(
        Worker, [tmp_path] * 4, lambda: False, count=2, threads=1, gpu=gpu
    ) as results:
        assert set(results) == expected
