"""Training runs in separate processes, and their checkpoints."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers.command import Run, run
from spackle.paper.training.checkpoint import Checkpoint, load_checkpoint
from spackle.runtime.task_process import import_ahead, process_context


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """One thread fixes the order of sums, so that results are equal bit for bit."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def state(folder: Path) -> Checkpoint:
    checkpoint = load_checkpoint(folder)
    assert checkpoint is not None
    return checkpoint


def losses_of(done: Run) -> list[float]:
    return [
        float(line.split("loss ")[1].split(",")[0])
        for line in done.lines
        if line.startswith("train: ")
    ]


def assert_same_weights(one: Path, other: Path, tolerance: float = 0.0) -> None:
    a, b = state(one), state(other)
    assert a.progress.step == b.progress.step
    for mine, yours in ((a.network, b.network), (a.average, b.average)):
        assert max(float((mine[name] - yours[name]).abs().max()) for name in yours) <= tolerance


class Started:
    """A command in a process of its own, which is forked where that is possible: quickly."""

    def __init__(self, arguments: Sequence[str], code: str, environment: dict[str, str]) -> None:
        import_ahead("spackle.runtime.workers", "spackle.paper.training.train")
        context = process_context()
        self._errors, errors = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_run, args=(arguments, code, {**os.environ, **environment}, errors)
        )
        self._process.start()
        errors.close()

    def communicate(self) -> str:
        """What the command wrote to the standard error, at its end; nothing if it was killed."""
        said = ""
        with contextlib.suppress(EOFError):  # a killed process has sent nothing
            said = self._errors.recv()
        self._errors.close()
        self._process.join()
        return said

    @property
    def returncode(self) -> int:
        """The exit code; the negative number of the signal that has killed the process."""
        code = self._process.exitcode
        assert code is not None, "the process runs"
        return int(code)


def _run(arguments: Sequence[str], code: str, environment: dict[str, str], errors: Any) -> None:
    """Run code and then a command in the process that has started; the code may itself be another
    command, which takes the arguments and exits.
    """
    os.environ.clear()
    os.environ.update(environment)
    torch.set_num_threads(1)
    sys.argv = ["spackle", *arguments]
    exec(code, {"sys": sys})
    done = run(*arguments)
    errors.send(done.err)
    sys.exit(done.code)


def started(arguments: Sequence[str], code: str, **environment: str) -> Started:
    """Start a command in a new process that first runs `code`."""
    return Started(arguments, code, environment)


def killed_at(number: int) -> str:
    """Code for `started` that kills a run in this step, counted from 0, before its weights
    change.
    """
    return f"""
import os
from spackle.paper.training import train
rate = train.learning_rate
def kill_or_rate(step, optim):
    return os.kill(os.getpid(), 9) if step == {number} else rate(step, optim)
train.learning_rate = kill_or_rate
"""


def run_two(arguments: Sequence[str], code: str = "") -> None:
    """Run a command in two distributed processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    shared = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    processes = [started(arguments, code, RANK=str(rank), **shared) for rank in range(2)]
    said = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], said
