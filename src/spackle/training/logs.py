"""Curves and pictures for TensorBoard, where that is installed."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol

from torch import Tensor

from spackle.errors import InputError, reason_in_a_line


class Logs(Protocol):
    """Where the numbers of a run go."""

    def numbers(self, group: str, values: Mapping[str, float], step: int) -> None:
        """Points of the curves GROUP/NAME."""

    def picture(self, name: str, rgb: Tensor, step: int) -> None:
        """An image [H, W, 3] sRGB."""

    def close(self) -> None:
        """Write what is still in memory."""


class NoLogs:
    """Keeps nothing."""

    def numbers(self, group: str, values: Mapping[str, float], step: int) -> None:
        """Nothing."""

    def picture(self, name: str, rgb: Tensor, step: int) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


class TensorBoardLogs:
    """Event files in a folder."""

    def __init__(self, folder: Path, purge_step: int) -> None:
        """ImportError where tensorboard is not installed; what an earlier start logged after a step is hidden."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of protobuf's, about itself
            import tensorboard  # noqa: F401  # torch's own import of it fails with other words
            from torch.utils.tensorboard import SummaryWriter
        self.folder = folder
        self.writer = SummaryWriter(str(folder), purge_step=purge_step)

    def numbers(self, group: str, values: Mapping[str, float], step: int) -> None:
        """Points of the curves GROUP/NAME."""
        for name, value in values.items():
            self._try(self.writer.add_scalar, f"{group}/{name}", value, step)

    def picture(self, name: str, rgb: Tensor, step: int) -> None:
        """An image [H, W, 3] sRGB."""
        self._try(self.writer.add_image, name, rgb.clamp(0, 1), step, dataformats="HWC")

    def close(self) -> None:
        """Write what is still in memory."""
        self._try(self.writer.close)

    def _try(self, write: Callable[..., object], *arguments: object, **options: object) -> None:
        try:
            write(*arguments, **options)
        except OSError as error:  # raised where the next number comes, for its thread cannot
            raise InputError(f"{self.folder}: cannot write the logs: {reason_in_a_line(error)}") from error


def open_logs(folder: Path, step: int, say: Callable[[str], None]) -> Logs:
    """Logs in a folder, or one line that there are none.

    Args:
        folder: made where it is not there.
        step: that the run goes on from.
        say: told where tensorboard is missing.
    """
    try:
        return TensorBoardLogs(folder, step)
    except ImportError:
        say("no TensorBoard logs: pip install 'spackle-nvs[train]'")
        return NoLogs()
