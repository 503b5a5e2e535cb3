"""Files of a training run: the checkpoint from which a run resumes, and TensorBoard curves."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.paper.training.recipe import AnyRecipe, changed_keys
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import atomic_path

CHECKPOINT_FILE = "checkpoint.pt"
BEST_WEIGHTS = "best.safetensors"
LAST_WEIGHTS = "last.safetensors"
RUN_REPORT = "run.json"
RUN_FILES = (CHECKPOINT_FILE, BEST_WEIGHTS, LAST_WEIGHTS, RUN_REPORT)
PICTURES_FOLDER = "pictures"
LOGS_FOLDER = "logs"
Log = Callable[[str], None]


@dataclasses.dataclass
class TrainingProgress:
    """The progress of a run."""

    step: int = 0  # steps done
    best: float | None = (
        None  # lowest value of the task's `aim`, such as the loss; None before the first validation
    )
    best_step: int = 0
    stale: int = 0  # validations since `best_step`
    seconds: float = 0.0  # in total, over all restarts
    history: list[dict[str, float]] = dataclasses.field(
        default_factory=list
    )  # the measures of each validation

    def record_validation(self, measures: dict[str, float], aim: str, min_delta: float) -> bool:
        """Record a validation; returns whether the measure `aim` is lower than the best by more than `min_delta`."""
        self.history.append({"step": self.step, **measures})
        best, value = math.inf if self.best is None else self.best, measures.get(aim, math.inf)
        if value < best - min_delta:
            self.best, self.best_step, self.stale = value, self.step, 0
        else:
            self.stale += 1
        return self.stale == 0


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """All state on which the next step depends; the number of a step determines the step's samples."""

    progress: TrainingProgress
    network: dict[str, Tensor]
    average: dict[str, Tensor]
    optimizer: dict[str, Any]
    recipe: dict[str, Any]
    digest: str  # identifies the samples
    method: str = "residual"


def save_checkpoint(checkpoint: Checkpoint, folder: Path) -> None:
    """Write checkpoint.pt; if the disk is full, raise InputError and keep the previous checkpoint."""
    buffer = io.BytesIO()  # torch.save to a file hides that the disk is full
    torch.save({**vars(checkpoint), "progress": dataclasses.asdict(checkpoint.progress)}, buffer)
    with atomic_path(folder / CHECKPOINT_FILE) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """The checkpoint in a folder; None if there is none, InputError if it cannot be read."""
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return None
    with as_input_error(path, "cannot be read ({reason}): --overwrite starts a new run"):
        state = torch.load(path, map_location="cpu", weights_only=True)
        return Checkpoint(**{**state, "progress": TrainingProgress(**state["progress"])})


def find_checkpoint(
    output: Path, method: str, recipe: AnyRecipe, digest: str, log: Log
) -> Checkpoint | None:
    """The checkpoint from which a run resumes, or None; InputError if the folder holds a different run."""
    checkpoint = load_checkpoint(output)
    if checkpoint is None:
        return None
    changed = [] if checkpoint.method == method else ["--method"]
    changed += changed_keys(checkpoint.recipe, recipe)
    changed += [] if checkpoint.digest == digest else ["the data's files"]
    if changed:
        raise InputError(
            f"{output}: holds a run with other settings ({', '.join(changed)}): choose another folder with -o, "
            "or start a new run with --overwrite"
        )
    log(f"{output}: resuming from step {checkpoint.progress.step}")
    return checkpoint


def remove_run(output: Path) -> None:
    """Delete a run's files, except for its samples."""
    for path in (output / name for name in (*RUN_FILES, PICTURES_FOLDER, LOGS_FOLDER)):
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)


def open_logs(folder: Path, first: int, log: Log) -> AbstractContextManager[Any]:
    """Open TensorBoard's writer as a context, and hide stored values after step `first`; None without TensorBoard."""
    try:
        import tensorboard  # noqa: F401  # if it is missing, torch's import raises another error
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        log("no TensorBoard logs: pip install 'spackle-nvs[train]'")
        return contextlib.nullcontext()
    return SummaryWriter(str(folder / LOGS_FOLDER), purge_step=first)
