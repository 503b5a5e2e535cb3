"""Files of a training run: the checkpoint, which is written atomically, and TensorBoard curves."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import shutil
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.errors import InputError, reading
from spackle.files import atomic_path
from spackle.training.recipe import AnyRecipe, differences

CHECKPOINT = "checkpoint.pt"
BEST, LAST, RUN = "best.safetensors", "last.safetensors", "run.json"
RESULTS = (CHECKPOINT, BEST, LAST, RUN)
PICTURES, LOGS = "pictures", "logs"
Log = Callable[[str], None]


@dataclasses.dataclass
class Progress:
    """The progress of a run, as plain numbers."""

    step: int = 0  # steps done
    best: float | None = None  # lowest value of the task's `aim`, such as the loss; None before the first validation
    best_step: int = 0
    stale: int = 0  # validations since `best_step`
    seconds: float = 0.0  # in total, over all restarts
    history: list[dict[str, float]] = dataclasses.field(default_factory=list)  # the measures of each validation

    def validated(self, measures: dict[str, float], aim: str, min_delta: float) -> bool:
        """Record a validation; returns whether its measure `aim` is lower than the best by more than `min_delta`."""
        self.history.append({"step": self.step, **measures})
        best = math.inf if self.best is None else self.best
        if math.isfinite(measures[aim]) and measures[aim] < best - min_delta:
            self.best, self.best_step, self.stale = measures[aim], self.step, 0
        else:
            self.stale += 1
        return self.stale == 0


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """All state that the next step depends on; the step's number determines its samples."""

    progress: Progress
    network: dict[str, Tensor]
    average: dict[str, Tensor]
    optimizer: dict[str, Any]
    recipe: dict[str, Any]
    digest: str  # identifies the samples
    method: str = "residual"  # older checkpoints do not name one


def save_checkpoint(checkpoint: Checkpoint, folder: Path) -> None:
    """Write checkpoint.pt; InputError if that fails, as on a full disk: then the previous checkpoint remains."""
    buffer = io.BytesIO()  # torch's own writer hides that a disk is full
    torch.save({**vars(checkpoint), "progress": dataclasses.asdict(checkpoint.progress)}, buffer)
    with atomic_path(folder / CHECKPOINT, durable=True) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """The checkpoint in a folder, if any; InputError if it cannot be read."""
    path = folder / CHECKPOINT
    if not path.exists():
        return None
    with reading(path, "cannot be read ({reason}): --overwrite starts anew"):
        state = torch.load(path, map_location="cpu", weights_only=True)
        return Checkpoint(**{**state, "progress": Progress(**state["progress"])})


def find_checkpoint(output: Path, method: str, recipe: AnyRecipe, digest: str, log: Log) -> Checkpoint | None:
    """The checkpoint from which a run resumes, if any.

    InputError if the folder holds a different run, or its checkpoint cannot be read.
    """
    checkpoint = load_checkpoint(output)
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
    """Delete a run's files, except for its samples."""
    for path in (output / name for name in (*RESULTS, PICTURES, LOGS)):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def open_logs(folder: Path, first: int, log: Log) -> AbstractContextManager[Any]:
    """A writer of TensorBoard's event files in a run's folder; None if TensorBoard is not installed.

    Values that an earlier process logged after the step `first` are hidden.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # protobuf warns about its own version
            import tensorboard  # noqa: F401  # checked here: torch's import would raise another message
            from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        log("no TensorBoard logs: pip install 'spackle-nvs[train]'")
        return contextlib.nullcontext()
    return SummaryWriter(str(folder / LOGS), purge_step=first)
