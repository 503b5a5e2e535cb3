"""Processes that train together: each on a device of its own."""

from __future__ import annotations

import pytest
import torch

from spackle.training.train import joined_ranks


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
