"""Several processes that train one network, started by torchrun; or one."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from datetime import timedelta

import torch
import torch.distributed as dist

from spackle.errors import reading

PATIENCE = timedelta(hours=24)  # making samples takes one process longer than another


def rank() -> int:
    """This process among those that train together, from 0; the first one writes and reports."""
    return dist.get_rank() if dist.is_initialized() else 0


def rank_count() -> int:
    """How many processes train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def wait_for_ranks() -> None:
    """Until all have come here."""
    if rank_count() > 1:
        dist.barrier()


def sum_of_ranks(numbers: Sequence[float], device: torch.device) -> list[float]:
    """Each number's sum over the processes, the same in all of them."""
    if rank_count() == 1:
        return list(numbers)
    # In float64: what is compared and decided upon must not depend on how many processes there are.
    tensor = torch.tensor(numbers, dtype=torch.float64, device=device)
    dist.all_reduce(tensor)
    values: list[float] = tensor.tolist()
    return values


@contextlib.contextmanager
def joined_ranks(kind: str) -> Iterator[torch.device]:
    """Join the processes of this run, as torchrun's environment names them; yields this one's device of a kind.

    "cuda" talks by nccl, "cpu" by gloo. InputError for variables that are no numbers, or others that cannot be reached.
    """
    local = 0
    if "WORLD_SIZE" in os.environ:
        with reading("RANK and WORLD_SIZE are set", "but the processes cannot join: {reason}"):
            local = int(os.environ.get("LOCAL_RANK", "0"))
            dist.init_process_group("nccl" if kind == "cuda" else "gloo", timeout=PATIENCE)
    try:
        yield torch.device(kind, local) if kind == "cuda" else torch.device(kind)
    finally:
        if dist.is_initialized():
            dist.destroy_process_group()
