"""How many processes share the jobs of a command, and where they run."""

from __future__ import annotations

import socket
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from spackle.runtime.device import thread_count
from spackle.runtime.digests import config_differences
from spackle.runtime.errors import InputError

# A GPU keeps few threads busy, and a worker of a cluster should fit on any machine.
THREADS_ON_RAY = 2


@dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """The processes that share the jobs of a command."""

    count: int | None  # of processes; None: one a GPU, or as many as a cluster has room for
    threads: int  # torch's threads in each
    gpu: bool  # whether each uses one GPU, where there is one
    ray: str | None = None  # address of a Ray cluster; None: the processes run on this machine

    @staticmethod
    def of_command(
        count: int | None, threads: int | None, device: str, ray: str | None, job_count: int
    ) -> WorkerOptions:
        """The processes for what a user has said, and for what he has not.

        Args:
            count: number of processes; by default one for each GPU of this machine, or one; on a
                cluster as many as it has room for.
            threads: of each process; by default this machine's cores, shared evenly.
            device: "auto", "cpu", "cuda", or one GPU, such as "cuda:1".
            ray: address of a Ray cluster, or None.
            job_count: number of jobs; there are no more processes than jobs.
        """
        if ray is None and count is None:
            count = gpu_worker_count(device)
        if count is not None:
            count = max(1, min(count, job_count))
        if threads is None:
            threads = THREADS_ON_RAY if ray is not None else max(1, thread_count() // (count or 1))
        return WorkerOptions(count=count, threads=threads, gpu=device != "cpu", ray=ray)

    @property
    def in_this_process(self) -> bool:
        """Whether the calling process does all jobs."""
        return self.ray is None and self.count == 1


def check_like_command(expected: Mapping[str, Any], own: Mapping[str, Any]) -> None:
    """InputError if a worker's machine would give other results than that of the command.

    Args:
        expected: what determines the results, on the machine of the command.
        own: the same on this machine.
    """
    changes = config_differences(expected, own)
    if changes:
        raise InputError(
            f"{socket.gethostname()}: differs from the machine of the command "
            f"({'; '.join(changes)}): all need the same packages, weights and kind of device"
        )


def gpu_worker_count(device: str) -> int:
    """The number of worker processes on this machine: one for each GPU that may be used, or one.

    Args:
        device: "auto", "cpu", "cuda", or one GPU, such as "cuda:1".
    """
    # A GPU with a number is the only one that the user wants.
    any_gpu = device in ("auto", "cuda")
    return max(torch.cuda.device_count(), 1) if any_gpu else 1


def this_process() -> WorkerOptions:
    """The calling process alone, with the threads that it has."""
    return WorkerOptions(count=1, threads=thread_count(), gpu=False)
