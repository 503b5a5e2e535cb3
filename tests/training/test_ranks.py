"""Processes that share work: each on a device of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from two_gpus import Worker

from spackle.training.train import joined_ranks
from spackle.workers import Workers, at_work_here


def test_each_process_computes_on_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    chosen: list[int] = []
    monkeypatch.setattr(torch.cuda, "set_device", chosen.append)
    monkeypatch.setattr("torch.distributed.init_process_group", lambda backend, **options: None)
    for name, value in {"WORLD_SIZE": "4", "RANK": "3", "LOCAL_RANK": "1"}.items():
        monkeypatch.setenv(name, value)
    with joined_ranks("cuda") as device:
        assert (device, chosen) == (torch.device("cuda", 1), [1])
    with joined_ranks("cpu") as device:
        assert (device, chosen) == (torch.device("cpu"), [1])


@pytest.mark.parametrize("gpu", [True, False])
def test_each_of_several_workers_has_its_own_gpu(tmp_path: Path, gpu: bool) -> None:
    with at_work_here(Workers(2, 1, gpu=gpu), Worker, [tmp_path] * 4, lambda: False) as results:
        found = {name: tuple(numbers) for name, numbers in results}
    assert sorted(found.values()) == ([(0,), (1,)] if gpu else [(), ()])
