"""What is trained, and on what, as the loop sees it: the loop knows of steps and losses, not of Gaussians."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal, Protocol, TypeVar

from torch import Tensor, nn

T = TypeVar("T")
MethodName = Literal["residual", "direct-ft", "lite"]  # as --method spells them, and checkpoints


class Method(Protocol):
    """A network's task: items, which are counted from 0, in; a loss out."""

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

    @property
    def measures(self) -> Sequence[str]:
        """What `judged` finds, by name."""

    @property
    def aim(self) -> str:
        """Which of them says what weights are best: the lower the better."""

    def loss(self, network: nn.Module, step: int, items: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of items to learn from, with gradients, and its terms []; the same for the same step.

        Raises:
            InputError: an item that cannot be read.
        """

    def judged(self, network: nn.Module, items: Sequence[int]) -> dict[str, list[float]]:
        """How good a network is on items to be judged by: values of each measure; InputError likewise."""

    def words(self, found: Mapping[str, float]) -> str:
        """What a line about a validation says behind its aim: the means of the measures, from a comma on."""

    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: rows of a few judged items in `columns`; InputError likewise."""

    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Copy items to learn from, or their names, to a folder."""

    def export(self, network: nn.Module, path: Path) -> None:
        """Write weights as the rest of the package reads them; InputError where that cannot be."""


def chunks(values: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """`size` of them at a time, the last ones perhaps fewer."""
    for start in range(0, len(values), size):
        yield values[start : start + size]
