"""Two GPUs that are not there: the processor does their work, and it is noted on which of them it was asked for."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode


class TwoGpus(TorchFunctionMode):
    """Within it, what goes to a GPU stays on the processor."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        super().__init__()
        self.current, self.used = 0, set[int]()
        for name, answer in {"is_available": True, "device_count": 2, "get_device_name": "none"}.items():
            patch.setattr(torch.cuda, name, lambda *arguments, answer=answer: answer)
        patch.setattr(torch.cuda, "set_device", lambda number: setattr(self, "current", number))

    def __torch_function__(
        self, function: Callable[..., Any], types: object, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        if function is torch.device:
            return function(*args, **(kwargs or {}))
        named: Mapping[str, Any] = kwargs or {}
        return function(*map(self._placed, args), **{name: self._placed(value) for name, value in named.items()})

    def _placed(self, value: Any) -> Any:
        if not isinstance(value, (str, torch.device)) or not str(value).startswith("cuda"):
            return value
        number = torch.device(value).index
        self.used.add(self.current if number is None else number)
        return torch.device("cpu")


class Worker:
    """A `Worker` that tells the GPU of its process, when another has begun as well."""

    def make(self, job: Path) -> tuple[str, list[int]]:
        name = multiprocessing.current_process().name
        (job / name).touch()
        while len(list(job.iterdir())) < 2:
            time.sleep(0.02)
        return name, chosen


chosen: list[int] = []
if multiprocessing.current_process().name != "MainProcess":  # in a worker, which imports this before it starts
    torch.cuda.device_count = lambda: 2
    torch.cuda.set_device = chosen.append
