"""Processes that share work: each on a device of its own."""

from __future__ import annotations

from pathlib import Path

from two_gpus import Worker

from spackle.workers import at_work


def test_each_of_several_workers_has_its_own_gpu(tmp_path: Path) -> None:
    with at_work(Worker, [tmp_path] * 4, lambda: False, count=2, threads=1) as results:
        found = {name: tuple(numbers) for name, numbers in results}
    assert sorted(found.values()) == [(0,), (1,)]
