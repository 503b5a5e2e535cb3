"""Training runs as processes of their own, and what they leave."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

from spackle.training.checkpoint import Checkpoint, load_checkpoint

CLI = "from spackle.cli import main\nmain()"


def state(folder: Path) -> Checkpoint:
    checkpoint, _ = load_checkpoint(folder)
    assert checkpoint is not None
    return checkpoint


def assert_same_weights(one: Path, other: Path, tolerance: float = 0.0) -> None:
    a, b = state(one), state(other)
    assert a.progress.step == b.progress.step
    for mine, yours in ((a.network, b.network), (a.average, b.average)):
        assert max(float((mine[name] - yours[name]).abs().max()) for name in yours) <= tolerance


def one_thread_at_a_time() -> Iterator[None]:
    """Sums in one order: what is compared here are bits."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def started(arguments: Sequence[str], code: str, entry: str = CLI, **environment: str) -> subprocess.Popen[str]:
    """A command in a process of its own, with something done before it."""
    code = f"import sys\nsys.argv = {['spackle', *arguments]!r}\n{code}\n{entry}"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
        stderr=subprocess.PIPE,
        text=True,
    )


def killed_at(number: int) -> str:
    """Code for `started`: the process is killed when a step begins."""
    return f"""
import os
from spackle.training.trainer import Trainer
step = Trainer.step
Trainer.step = lambda self, number: os.kill(os.getpid(), 9) if number == {number} else step(self, number)
"""
