"""Where the numbers of a run go: metrics.jsonl, TensorBoard's curves, and a function of the user.

metrics.jsonl has a JSON object for each logged step. A resumed run cuts off the lines after its
checkpoint, because it repeats these steps; so every step has one line, however often a run was
killed.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TextIO

from torch import Tensor

from spackle.runtime.errors import as_input_error
from spackle.runtime.files import write_atomic

METRICS_FILE = "metrics.jsonl"
LOGS_FOLDER = "logs"  # of TensorBoard

# A function of the user, which gets the number of a step and its values by name.
Logger = Callable[[int, Mapping[str, float]], object]


@dataclasses.dataclass(frozen=True)
class RunLogs:
    """The open logs of a run."""

    metrics: TextIO  # metrics.jsonl
    curves: Any = None  # TensorBoard's writer; None without TensorBoard
    logger: Logger | None = None

    def add(self, step: int, seconds: float, values: Mapping[str, float]) -> None:
        """Log the values of a step.

        Args:
            step: number of steps done.
            seconds: how long the run has taken so far, over all restarts.
            values: finite numbers by name, such as "train/loss" and "validation/hole_psnr".
        """
        line = {"step": step, "seconds": round(seconds, 3), **values}
        self.metrics.write(json.dumps(line, allow_nan=False) + "\n")
        self.metrics.flush()  # a line that was handed over to the system outlives a killed run
        if self.curves is not None:
            for name, value in values.items():
                self.curves.add_scalar(name, value, step)
        if self.logger is not None:
            self.logger(step, values)

    def add_picture(self, step: int, picture: Tensor) -> None:
        """Show a picture [H, W, 3] sRGB among TensorBoard's images."""
        if self.curves is not None:
            self.curves.add_image("views", picture.clamp(0, 1), step, dataformats="HWC")


@contextlib.contextmanager
def open_logs(
    folder: Path, last_step: int, log: Callable[[str], None], logger: Logger | None = None
) -> Iterator[RunLogs]:
    """The logs of a run, open during the block.

    Args:
        folder: the folder of the run.
        last_step: number of steps that are done; what the logs have of later steps is removed.
        log: receives a line if there is no TensorBoard.
        logger: a function that also gets each step's values.
    """
    cut_metrics(folder / METRICS_FILE, last_step)
    with (
        open(folder / METRICS_FILE, "a", encoding="utf-8") as metrics,
        _open_curves(folder / LOGS_FOLDER, last_step, log) as curves,
    ):
        yield RunLogs(metrics, curves, logger)


def cut_metrics(path: Path, last_step: int) -> None:
    """Remove the lines of later steps from metrics.jsonl, and a last line that is not whole.

    Nothing happens if there is no such file. `last_step` is the last step whose line stays.
    InputError if the file has other lines than those of a run.
    """
    if not path.is_file():
        return
    kept = []
    with as_input_error(path, "not the metrics of a run: move the file away"):
        for line in path.read_bytes().splitlines(keepends=True):
            # Steps ascend, and only the last line can be cut off, so nothing after it is kept.
            if not line.endswith(b"\n") or json.loads(line)["step"] > last_step:
                break
            kept.append(line)
    write_atomic(path, b"".join(kept))


@contextlib.contextmanager
def _open_curves(folder: Path, last_step: int, log: Callable[[str], None]) -> Iterator[Any]:
    """TensorBoard's writer, open during the block.

    Without TensorBoard it is None, and `log` gets a line that says so. Values that the folder has
    of steps after `last_step` are hidden.
    """
    try:
        # If this package is missing, torch's import raises another error than ImportError.
        import tensorboard  # noqa: F401
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        log("no TensorBoard logs: pip install 'spackle-nvs[train]'")
        yield None
        return
    with SummaryWriter(str(folder), purge_step=last_step + 1) as writer:
        yield writer
