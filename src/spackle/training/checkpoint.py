"""What a run leaves in its folder: checkpoints to resume from, each whole or the one before it, and curves."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import os
import shutil
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.errors import InputError, reason_in_a_line
from spackle.files import atomic_path
from spackle.training.recipe import AnyRecipe, differences

NEWEST, PREVIOUS = "checkpoint.pt", "checkpoint.previous.pt"
BEST, LAST, RUN = "best.safetensors", "last.safetensors", "run.json"
RESULTS = (NEWEST, PREVIOUS, BEST, LAST, RUN)
PICTURES, LOGS, BAD = "pictures", "logs", "bad_batch"
Log = Callable[[str], None]


@dataclasses.dataclass
class Progress:
    """How far a run has come, as plain numbers."""

    step: int = 0  # steps done
    best: float | None = None  # of the task's aim, such as the loss; None before the first validation
    best_step: int = 0
    stale: int = 0  # validations since then
    seconds: float = 0.0  # of all its starts together
    history: list[dict[str, float]] = dataclasses.field(default_factory=list)  # each validation's measures

    def validated(self, measures: dict[str, float], aim: str, min_delta: float) -> bool:
        """Note a validation; whether its measure called `aim` is the best so far: the lower the better."""
        self.history.append({"step": self.step, **measures})
        best = math.inf if self.best is None else self.best
        if math.isfinite(measures[aim]) and measures[aim] < best - min_delta:
            self.best, self.best_step, self.stale = measures[aim], self.step, 0
        else:
            self.stale += 1
        return self.stale == 0


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Everything that the next step depends on; which samples come next follows from the step."""

    progress: Progress
    network: dict[str, Tensor]
    average: dict[str, Tensor]
    optimizer: dict[str, Any]
    recipe: dict[str, Any]
    digest: str  # of the samples
    method: str = "residual"  # older checkpoints do not name one


def save_checkpoint(checkpoint: Checkpoint, folder: Path) -> None:
    """Write checkpoint.pt; the one before it stays as checkpoint.previous.pt.

    InputError where it cannot be written, or the disk is full; what was there stays.
    """
    buffer = io.BytesIO()  # torch's own writer hides that a disk is full
    torch.save({**vars(checkpoint), "progress": dataclasses.asdict(checkpoint.progress)}, buffer)
    newest = folder / NEWEST
    with atomic_path(newest) as temporary:
        temporary.write_bytes(buffer.getbuffer())
        if newest.exists():
            os.replace(newest, folder / PREVIOUS)


def load_checkpoint(folder: Path, log: Log) -> Checkpoint | None:
    """The last whole checkpoint of a folder, if any; logs what is wrong with a newer one.

    InputError for checkpoints of which none can be read.
    """
    problem = None
    for path in (folder / NEWEST, folder / PREVIOUS):
        if not path.exists():
            continue
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            checkpoint = Checkpoint(**{**state, "progress": Progress(**state["progress"])})
        except Exception as error:  # a damaged file can raise anything
            problem = problem or f"{path}: cannot be read ({reason_in_a_line(error)})"
        else:
            if problem:
                log(f"{problem}: going on from the one before it")
            return checkpoint
    if problem:
        raise InputError(f"{problem}, nor is there one before it: --overwrite starts anew")
    return None


def find_checkpoint(output: Path, method: str, recipe: AnyRecipe, digest: str, log: Log) -> Checkpoint | None:
    """The checkpoint that a run goes on from, if any.

    InputError where the folder holds another run, or none of its checkpoints can be read.
    """
    checkpoint = load_checkpoint(output, log)
    if checkpoint is None:
        return None
    what, other = "", differences(checkpoint.recipe, recipe)
    if checkpoint.method != method:
        what = f"--method {checkpoint.method}, not of {method}"
    elif other:
        what = f"another recipe ({other[0]}{f' and {len(other) - 1} more' if len(other) > 1 else ''} differs)"
    elif checkpoint.digest != digest:
        what = "another recipe (the files that data names differ)"
    if what:
        raise InputError(f"{output}: holds a run of {what}: choose another with -o, or --overwrite to start anew")
    log(f"{output}: going on from step {checkpoint.progress.step}")
    return checkpoint


def remove_run(output: Path) -> None:
    """Delete what a run has left; its samples stay."""
    for path in (output / name for name in (*RESULTS, PICTURES, LOGS, BAD)):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def open_logs(folder: Path, first: int, log: Log) -> AbstractContextManager[Any]:
    """A writer of TensorBoard's event files in a run's folder, None where TensorBoard is not installed.

    What an earlier start logged after the step `first` is hidden.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of protobuf's, about itself
            import tensorboard  # noqa: F401  # torch's own import of it fails with other words
            from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        log("no TensorBoard logs: pip install 'spackle-nvs[train]'")
        return contextlib.nullcontext()
    return SummaryWriter(str(folder / LOGS), purge_step=first)
