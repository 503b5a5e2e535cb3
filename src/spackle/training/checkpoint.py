"""What a run needs to go on, and the weights that come out of it: whole files, or the ones before them."""

from __future__ import annotations

import dataclasses
import io
import math
import os
import shutil
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.errors import InputError, reason_in_a_line
from spackle.files import atomic_path
from spackle.training.recipe import AnyRecipe, differences

NEWEST, PREVIOUS = "checkpoint.pt", "checkpoint.previous.pt"
BEST, LAST, RUN, PICTURES, LOGS, BAD = (
    "best.safetensors", "last.safetensors", "run.json", "pictures", "logs", "bad_batch",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a run has come, as plain numbers."""

    step: int = 0  # steps done
    best: float | None = None  # of what the method aims at, such as the loss; None before the first validation
    best_step: int = 0
    stale: int = 0  # validations since then
    seconds: float = 0.0  # of all its starts together
    history: tuple[dict[str, float], ...] = ()  # what each validation found

    def validated(self, found: dict[str, float], aim: str, min_delta: float) -> Progress:
        """After a validation whose number called `aim` says which weights are best; the lower the better."""
        history = (*self.history, found)
        best = math.inf if self.best is None else self.best
        if math.isfinite(found[aim]) and found[aim] < best - min_delta:
            return dataclasses.replace(self, best=found[aim], best_step=self.step, stale=0, history=history)
        return dataclasses.replace(self, stale=self.stale + 1, history=history)


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Everything that the next step depends on; which samples come next follows from the step."""

    progress: Progress
    network: dict[str, Tensor]
    average: dict[str, Tensor]
    optimizer: dict[str, Any]
    recipe: dict[str, Any]
    digest: str  # of the samples
    method: str = "residual"  # checkpoints from before there was another do not say


def save_checkpoint(checkpoint: Checkpoint, folder: Path) -> None:
    """Write checkpoint.pt; the one before it stays as checkpoint.previous.pt.

    InputError where it cannot be written, or the disk is full; what was there stays.
    """
    progress = dataclasses.asdict(checkpoint.progress)
    state = {**vars(checkpoint), "progress": {**progress, "history": list(progress["history"])}}
    buffer = io.BytesIO()  # torch's own writer hides that a disk is full
    torch.save(state, buffer)
    newest = folder / NEWEST
    with atomic_path(newest) as temporary:
        temporary.write_bytes(buffer.getbuffer())
        if newest.exists():
            os.replace(newest, folder / PREVIOUS)


def load_checkpoint(folder: Path) -> tuple[Checkpoint | None, str | None]:
    """The last whole checkpoint of a folder or None, and what is wrong with a newer one, if anything.

    InputError for checkpoints of which none can be read.
    """
    problem = None
    for path in (folder / NEWEST, folder / PREVIOUS):
        if not path.exists():
            continue
        try:
            state = torch.load(path, map_location="cpu", weights_only=True)
            history = tuple(state["progress"].pop("history"))
            return Checkpoint(**{**state, "progress": Progress(**state["progress"], history=history)}), problem
        except Exception as error:  # a damaged file can raise anything
            problem = problem or f"{path}: cannot be read ({reason_in_a_line(error)})"
    if problem:
        raise InputError(f"{problem}, nor is there one before it: --overwrite starts anew")
    return None, None


def check_same_run(checkpoint: Checkpoint, method: str, recipe: AnyRecipe, digest: str, folder: Path) -> None:
    """InputError where a checkpoint is of another method, of another recipe, or of other samples."""
    other = differences(checkpoint.recipe, recipe)
    if not other and checkpoint.digest != digest:
        other = ["the files that data names"]
    if checkpoint.method != method:
        what = f"--method {checkpoint.method}, not of {method}"
    elif other:
        what = f"another recipe ({other[0]}{f' and {len(other) - 1} more' if len(other) > 1 else ''} differs)"
    else:
        return
    raise InputError(f"{folder}: holds a run of {what}: choose another with -o, or --overwrite to start anew")


def holds_run(folder: Path) -> bool:
    """Whether a run left something in a folder that another one would replace."""
    return any((folder / name).exists() for name in (NEWEST, PREVIOUS, BEST, LAST, RUN))


def replace_run(folder: Path, new: Path) -> None:
    """Move a run that has ended from `new` to where an older one was, but not the samples.

    Where it is killed, the checkpoint is still in `new`, and a second call does the rest.
    """
    for name in (RUN, PREVIOUS, BAD, LOGS, PICTURES, BEST, LAST, NEWEST):
        old, own = folder / name, new / name
        if name in (PREVIOUS, BAD) or own.exists():  # else it was moved before
            shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)
        if own.exists():
            os.replace(own, old)
    shutil.rmtree(new)
