"""What a run tells whoever started it, and its curves and pictures for TensorBoard, where that is installed."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

from torch import Tensor

from spackle.errors import InputError, reason_in_a_line
from spackle.training.checkpoint import Progress


@dataclasses.dataclass(frozen=True)
class Callbacks:
    """Functions that the trainer calls."""

    step: Callable[[int, dict[str, float]], None]  # steps done, and their mean numbers since it was last called
    validated: Callable[[Progress], None]
    saved: Callable[[Progress], None]  # a checkpoint is on the disk
    stop: Callable[[], bool]  # whether somebody wants it to end after this step


class Logs:
    """TensorBoard's event files in a folder; without a folder, nothing."""

    def __init__(self, folder: Path | None = None, purge_step: int = 0) -> None:
        """ImportError where tensorboard is not installed; what an earlier start logged after a step is hidden."""
        self.folder, self.writer = folder, None
        if folder is not None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of protobuf's, about itself
                import tensorboard  # noqa: F401  # torch's own import of it fails with other words
                from torch.utils.tensorboard import SummaryWriter
            self.writer = SummaryWriter(str(folder), purge_step=purge_step)

    def numbers(self, group: str, values: Mapping[str, float], step: int) -> None:
        """Points of the curves GROUP/NAME."""
        for name, value in values.items():
            self._write("add_scalar", f"{group}/{name}", value, step)

    def picture(self, name: str, rgb: Tensor, step: int) -> None:
        """An image [H, W, 3] sRGB."""
        self._write("add_image", name, rgb.clamp(0, 1), step, dataformats="HWC")

    def close(self) -> None:
        """Write what is still in memory."""
        self._write("close")

    def _write(self, method: str, *arguments: object, **options: object) -> None:
        if self.writer is None:
            return
        try:
            getattr(self.writer, method)(*arguments, **options)
        except OSError as error:  # raised where the next number comes, for its thread cannot
            raise InputError(f"{self.folder}: cannot write the logs: {reason_in_a_line(error)}") from error


def open_logs(folder: Path, step: int, say: Callable[[str], None]) -> Logs:
    """Logs in a folder, from a step on; says so where tensorboard is missing, and keeps none."""
    try:
        return Logs(folder, step)
    except ImportError:
        say("no TensorBoard logs: pip install 'spackle-nvs[train]'")
        return Logs()
