"""What is trained, and on what, as the loop sees it: the loop knows of steps and losses, not of Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from torch import Tensor, nn

from spackle.training.step import Batch

T = TypeVar("T")
MethodName = Literal["residual", "direct-ft"]  # as --method spells them, and checkpoints


class Method(Protocol):
    """A network's task: items, which are counted from 0, in; views that it completed, out."""

    @property
    def name(self) -> MethodName:
        """What `--method` calls it."""

    @property
    def digest(self) -> str:
        """Of everything that decides what is learned from, but not of where it lies."""

    @property
    def items(self) -> int:
        """How many there are to learn from; an epoch has each once."""

    @property
    def judged_items(self) -> int:
        """How many there are to be judged by."""

    @property
    def items_a_step(self) -> int:
        """How many a step takes, of all processes together."""

    @property
    def at_once(self) -> int:
        """How many go through the network together; a step with more adds up their gradients."""

    @property
    def columns(self) -> str:
        """What the pictures show from left to right."""

    @property
    def remedy(self) -> str:
        """What to do about items that make a loss that is no number."""

    def complete(self, network: nn.Module, step: int, items: Sequence[int]) -> Batch:
        """Views of items to learn from, with gradients; the same for the same step.

        Raises:
            InputError: an item that cannot be read.
        """

    def complete_judged(self, network: nn.Module, items: Sequence[int]) -> Batch:
        """Views of items to be judged by; InputError likewise."""

    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: rows of a few judged views in `columns`; InputError likewise."""

    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Copy items to learn from, or their names, to a folder."""

    def export(self, network: nn.Module, path: Path) -> None:
        """Write weights as the rest of the package reads them; InputError where that cannot be."""


def chunks(values: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """`size` of them at a time, the last ones perhaps fewer."""
    for start in range(0, len(values), size):
        yield values[start : start + size]
