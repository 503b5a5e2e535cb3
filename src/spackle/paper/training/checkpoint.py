"""Files of a training run, and the checkpoint from which a run resumes."""

from __future__ import annotations

import dataclasses
import io
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.paper.training.recipe import AnyRecipe, changed_keys
from spackle.paper.training.run_logs import LOGS_FOLDER, METRICS_FILE
from spackle.runtime.digests import DIGEST_KEY, signed, unsigned
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import atomic_path
from spackle.runtime.tensor_digests import tree_digest

CHECKPOINT_FILE = "checkpoint.pt"
BEST_WEIGHTS = "best.safetensors"  # the averaged weights of the best validation
LAST_WEIGHTS = "last.safetensors"  # the averaged weights of the last save
RUN_REPORT = "run.json"
RUN_FILES = (CHECKPOINT_FILE, BEST_WEIGHTS, LAST_WEIGHTS, RUN_REPORT, METRICS_FILE)
PICTURES_FOLDER = "pictures"  # one picture a validation
Log = Callable[[str], None]  # prints a line


@dataclasses.dataclass
class TrainingProgress:
    """How far a run is, and its validations so far."""

    step: int = 0  # steps done
    # Lowest value of the task's `selection_measure`, such as the loss; None before the first
    # validation.
    best: float | None = None
    best_step: int = 0  # the step of that value
    stale: int = 0  # validations since `best_step`
    seconds: float = 0.0  # in total, over all restarts
    # The measures of each validation by name, and its "step".
    history: list[dict[str, float]] = dataclasses.field(default_factory=list)
    # The numbers of each step since the last logged one. They are saved, so that the means that are
    # logged next are those of an uninterrupted run.
    unlogged: list[dict[str, float]] = dataclasses.field(default_factory=list)

    def record_validation(
        self, measures: dict[str, float], selection_measure: str, min_delta: float
    ) -> bool:
        """Record the measures of a validation; returns whether it is the best one so far.

        Args:
            measures: means over the validation items, by name.
            selection_measure: the name of the measure that decides; lower is better. If it is
                missing from `measures`, because it was never finite, the validation is no
                improvement.
            min_delta: an improvement must be larger than this.
        """
        self.history.append({"step": self.step, **measures})
        best = math.inf if self.best is None else self.best
        value = measures.get(selection_measure, math.inf)
        is_best = value < best - min_delta
        if is_best:
            self.best = value
            self.best_step = self.step
            self.stale = 0
        else:
            self.stale += 1
        return is_best


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """All state on which the next step depends.

    The samples of a step need none: they follow from its number.
    """

    progress: TrainingProgress
    network: dict[str, Tensor]  # weights by name
    average: dict[str, Tensor]  # moving average of the weights by name
    optimizer: dict[str, Any]  # AdamW's state_dict
    recipe: dict[str, Any]  # the settings, ready for JSON
    digest: str  # identifies the samples
    method: str = "residual"  # what is trained: the name of the task


def save_checkpoint(checkpoint: Checkpoint, folder: Path) -> None:
    """Write checkpoint.pt, whole or not at all, with a digest of its content.

    If the disk is full, InputError, and the previous checkpoint stays.
    """
    state = {**vars(checkpoint), "progress": dataclasses.asdict(checkpoint.progress)}
    # torch.save to a file would hide that the disk is full, so the bytes are made in memory.
    buffer = io.BytesIO()
    torch.save(signed(state, tree_digest), buffer)
    with atomic_path(folder / CHECKPOINT_FILE) as temporary:
        temporary.write_bytes(buffer.getbuffer())


def load_checkpoint(folder: Path, log: Log | None = None) -> Checkpoint | None:
    """The checkpoint in a folder; None if there is none, InputError if it cannot be read.

    `log` receives a line about a checkpoint of an older version, in which damage cannot be noticed.
    """
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return None
    with as_input_error(path, "cannot be read ({reason}): `overwrite` starts a new run"):
        state = torch.load(path, map_location="cpu", weights_only=True)
        if DIGEST_KEY not in state and log is not None:
            log(f"{path}: of an older version, without a digest that would show damage")
        # One flipped bit would silently train on with other weights.
        state = unsigned(state, tree_digest)
        progress = TrainingProgress(**state.pop("progress"))
        return Checkpoint(progress=progress, **state)


def find_checkpoint(
    output: Path, method: str, recipe: AnyRecipe, digest: str, log: Log
) -> Checkpoint | None:
    """The checkpoint from which a run resumes, or None if the folder has no checkpoint.

    Args:
        output: the folder of the run.
        method: what is trained: the name of the task.
        recipe: the settings of the run.
        digest: identifies the samples.
        log: receives a line if there is a checkpoint.

    Raises:
        InputError: the checkpoint belongs to a run of another method, with other settings or other
            samples.
    """
    checkpoint = load_checkpoint(output, log)
    if checkpoint is None:
        return None

    changes = changed_keys(checkpoint.recipe, recipe)
    if checkpoint.method != method:
        changes.insert(0, "`method`")
    if checkpoint.digest != digest:
        changes.append("the data's files")
    if changes:
        raise InputError(
            f"{output}: holds a run with other settings ({', '.join(changes)}): choose another "
            "`output`, or start a new run with `overwrite`"
        )

    log(f"{output}: resuming from step {checkpoint.progress.step}")
    return checkpoint


def remove_run(output: Path) -> None:
    """Delete a run's files in the folder `output`, except for its samples."""
    for name in (*RUN_FILES, PICTURES_FOLDER, LOGS_FOLDER):
        path = output / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
