"""Several processes that train one network, started by torchrun; or one."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Iterator, Sequence
from datetime import timedelta

import torch
import torch.distributed as dist

from spackle.errors import InputError, reason_in_a_line

PATIENCE = timedelta(hours=24)  # the first process makes the samples while the others wait


@dataclasses.dataclass(frozen=True)
class Ranks:
    """This process among those that train together."""

    rank: int = 0
    count: int = 1
    local: int = 0  # on this machine: which GPU

    @property
    def first(self) -> bool:
        """Whether it is this one that writes and speaks."""
        return self.rank == 0

    def wait(self) -> None:
        """Until all have come here."""
        if self.count > 1:
            dist.barrier()

    def sum(self, numbers: Sequence[float], device: torch.device) -> list[float]:
        """Each number's sum over the processes, the same in all of them."""
        if self.count == 1:
            return list(numbers)
        # Sums of float64: what is compared and decided upon must not depend on how many there are.
        tensor = torch.tensor(numbers, dtype=torch.float64, device=device)
        dist.all_reduce(tensor)
        values: list[float] = tensor.tolist()
        return values


@contextlib.contextmanager
def joined_ranks(device: str) -> Iterator[Ranks]:
    """Join the processes of this run, as torchrun's environment names them; alone where it names none.

    "cuda" talks by nccl, "cpu" by gloo. InputError for variables that are no numbers, or others that cannot be reached.
    """
    if "WORLD_SIZE" not in os.environ:
        yield Ranks()
        return
    try:
        ranks = Ranks(int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]), int(os.environ.get("LOCAL_RANK", "0")))
        dist.init_process_group("nccl" if device == "cuda" else "gloo", timeout=PATIENCE)
    except (KeyError, ValueError, RuntimeError) as error:
        reason = reason_in_a_line(error)
        raise InputError(f"RANK and WORLD_SIZE are set, but the processes cannot join: {reason}") from error
    try:
        yield ranks
    finally:
        dist.destroy_process_group()
