"""The server's processes share the GPUs."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import threading
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers.command import run
from helpers.web_client import PHOTO, eventually

from spackle.runtime.errors import InputError
from spackle.web.jobs import Jobs, RetentionLimits

chosen: list[int] = []
# A worker imports this module before it starts.
if multiprocessing.current_process().name != "MainProcess":
    torch.cuda.device_count = lambda: 2
    torch.cuda.set_device = chosen.append  # type: ignore[assignment]


def say_gpu(task: Any, tell: Any) -> None:
    """Tell which GPUs this process has chosen; photos called "slow" never end."""
    job, _ = task
    tell({"line": str(chosen)})
    if job.name == "slow":
        threading.Event().wait()
    if job.name == "die":
        os._exit(9)


def add(jobs: Jobs, name: str) -> str:
    with jobs.reserve_place() as folder:
        (folder / "source").write_bytes(PHOTO)
        return jobs.add(folder, name, "source", None, {}).id


def line_of(jobs: Jobs, id: str) -> str:
    eventually(lambda: jobs.by_id[id].line)
    return str(jobs.by_id[id].line)


def test_each_process_has_a_gpu_of_its_own_and_its_successor_takes_it_over(tmp_path: Path) -> None:
    with contextlib.closing(Jobs(tmp_path, say_gpu, 2, RetentionLimits())) as jobs:
        first = add(jobs, "slow")
        second = add(jobs, "die")
        lines = [line_of(jobs, first), line_of(jobs, second)]
        assert sorted(lines) == ["[0]", "[1]"]
        # The process of the second photo is dead. Another one takes over its GPU.
        third = add(jobs, "photo")
        assert line_of(jobs, third) == lines[1]


def test_a_single_process_uses_the_gpu_that_torch_uses(tmp_path: Path) -> None:
    with contextlib.closing(Jobs(tmp_path, say_gpu, 1, RetentionLimits())) as jobs:
        assert line_of(jobs, add(jobs, "photo")) == "[]"


@pytest.mark.parametrize(("device", "count"), [("auto", 2), ("cpu", 1)])
def test_the_server_has_a_process_for_each_gpu(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, device: str, count: int
) -> None:
    asked = []

    def refuse(folder: Path, work: Any, workers: int, *others: Any) -> Any:
        asked.append(workers)
        raise InputError("only the number was wanted")

    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr("spackle.web.local_server.run_server", refuse)
    run("serve", "-o", tmp_path, "--device", device)
    run("serve", "-o", tmp_path, "--device", device, "--workers", 3)
    assert asked == [count, 3]
