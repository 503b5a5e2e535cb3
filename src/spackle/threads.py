"""Loops shared between threads, each step a kernel that runs without the GIL.

Numba's own parallel loops depend on a threading layer that is either unsafe to enter from two Python
threads or unsafe after a fork; a plain thread pool is neither, and its kernels compile faster.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import torch

_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()


def thread_count() -> int:
    """As many threads as torch itself uses, so that one setting rules both."""
    return torch.get_num_threads()


def run_chunks(function: Callable[[int, int], object], total: int, grain: int) -> None:
    """Call `function(start, stop)` for consecutive chunks of at most `grain` of 0..total.

    A thread takes the next chunk when it is done with its last, so uneven chunks balance. The order of
    the calls is free: what they write must not overlap.
    """
    chunks = -(-total // grain)
    helpers = min(thread_count(), chunks) - 1
    starts = iter(range(0, total, grain))
    lock = threading.Lock()

    def work() -> None:
        while True:
            with lock:
                start = next(starts, None)
            if start is None:
                return
            function(start, min(start + grain, total))

    futures = [_executor().submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        for future in futures:
            future.result()


def _executor() -> ThreadPoolExecutor:
    global _pool
    with _pool_lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="spackle")
        return _pool


def _forget_pool() -> None:
    """A forked child has none of its parent's threads, and starts its own."""
    global _pool, _pool_lock
    _pool, _pool_lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)
