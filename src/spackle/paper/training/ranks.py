"""Several processes that train one network together, started by torchrun.

Each process has a number, its rank. Without torchrun there is one process, of rank 0, and all
functions work, too.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from datetime import timedelta

import torch
import torch.distributed as dist

from spackle.runtime.errors import as_input_error

# One process may still make training samples while the others already wait for it.
MAX_WAIT_FOR_RANKS = timedelta(hours=24)


@contextlib.contextmanager
def joined_ranks(device_kind: str) -> Iterator[torch.device]:
    """Join the processes of this run during the block; yields the device of this process.

    Under torchrun, environment variables say which processes there are. Without these variables
    nothing is joined.

    Args:
        device_kind: "cuda", whose processes communicate by NCCL, or "cpu", whose processes use
            Gloo.

    Raises:
        InputError: the environment variables are set, but the processes cannot join.
    """
    # torchrun starts one process for each GPU, and sets these variables in each.
    gpu_number = 0
    if "WORLD_SIZE" in os.environ:
        with as_input_error(
            "RANK and WORLD_SIZE are set", "but the processes cannot join: {reason}"
        ):
            gpu_number = int(os.environ.get("LOCAL_RANK", "0"))
            backend = "nccl" if device_kind == "cuda" else "gloo"
            dist.init_process_group(backend, timeout=MAX_WAIT_FOR_RANKS)

    device = torch.device(device_kind)
    if device_kind == "cuda":
        device = torch.device(device_kind, gpu_number)
        # Renderers and feature networks use the current device, so it must be this one.
        torch.cuda.set_device(gpu_number)

    try:
        yield device
    finally:
        # Without this, the other processes would wait for one that has failed.
        if dist.is_initialized():
            dist.destroy_process_group()


def rank() -> int:
    """The number of this process among all training processes; process 0 writes and reports."""
    return dist.get_rank() if dist.is_initialized() else 0


def rank_count() -> int:
    """The number of processes that train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def wait_for_ranks() -> None:
    """Wait until all processes have reached this call."""
    if rank_count() > 1:
        dist.barrier()


def sum_of_ranks(numbers: Mapping[str, float], device: torch.device) -> dict[str, float]:
    """The sum of each number over all training processes, in float64, under the same names.

    Every process must call this with the same names, in the same order.
    """
    # One message for all numbers; float64, because counts must stay exact.
    sums = torch.tensor(list(numbers.values()), dtype=torch.float64, device=device)
    if rank_count() > 1:
        dist.all_reduce(sums)
    return dict(zip(numbers, sums.tolist(), strict=True))
