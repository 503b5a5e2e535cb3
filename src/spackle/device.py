"""Device, memory, precision and threads of computations, and the facts about them for reports.

Numba's own parallel loops need a threading layer that is unsafe to enter from two Python threads or after a fork. A
plain thread pool is safe in both cases, and kernels for it compile faster. The last bits of a network's output depend
on the number of threads, because it changes the order of sums.
"""

from __future__ import annotations

import os
import platform
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import torch

import spackle
from spackle.errors import InputError

# Words in the messages with which torch reports a shortage of memory, if it does not raise a dedicated exception.
_SHORTAGES = (
    "DefaultCPUAllocator",
    "not enough memory",
    "allocate memory",  # from the system, when a file is mapped; and from torch
    "out of memory",  # CUDA outside torch's allocator
    "_ALLOC_FAILED",  # cuBLAS and cuDNN
)


class MemoryShort(InputError):
    """There was too little memory; a later attempt may succeed."""


def pick_device(device: torch.device | str | None) -> torch.device:
    """The torch device of this name; for None, a CUDA device if there is one, else the CPU.

    InputError if the device does not exist, or is neither a CPU nor a CUDA device.
    """
    present = torch.cuda.is_available()
    if device is None:
        return torch.device("cuda" if present else "cpu")
    shown = f"device {str(device)[:40]!a}"
    try:
        target = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{shown}: there is no such device: give cpu or cuda") from error
    if target.type not in ("cpu", "cuda"):
        raise InputError(f"{shown}: networks do not run there: give cpu or cuda")
    if target.type == "cuda" and not present:
        raise InputError(f"{shown}: torch finds no CUDA device: give cpu, or install a torch and a driver for CUDA")
    if target.type == "cuda" and (target.index or 0) >= torch.cuda.device_count():
        raise InputError(f"{shown}: the last CUDA device is cuda:{torch.cuda.device_count() - 1}: give that or another")
    return target


def memory_is_short(error: BaseException) -> bool:
    """Whether an exception reports a shortage of memory, in one of torch's many ways."""
    named = isinstance(error, (MemoryError, torch.OutOfMemoryError))
    return named or any(words in str(error) for words in _SHORTAGES)


@contextmanager
def enough_memory(*advice: str, what: str = "for the network") -> Iterator[None]:
    """Turn a shortage of memory, which torch reports in many ways, into one `MemoryShort` line with advice."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not memory_is_short(error):
            raise
        remedies = ", or ".join([*advice, "close other programs"])
        raise MemoryShort(f"not enough memory {what}: {remedies}") from error


@contextmanager
def own_arithmetic(device: torch.device) -> Iterator[None]:
    """Compute in the tensors' own dtypes, whatever the caller has set for other networks.

    Autocast would round to sixteen bits; TF32 would drop thirteen bits of each float32 in a GPU's convolutions. TF32's
    switches hold for the whole process, so other threads are affected too until the switches are restored.
    """
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        if device.type != "cuda":
            yield
            return
        # Not the older allow_tf32, which cannot be read if the caller has used these newer switches.
        switches = torch.backends.cuda.matmul, torch.backends.cudnn.conv  # type: ignore[attr-defined]  # its stubs
        before = [switch.fp32_precision for switch in switches]
        try:
            for switch in switches:
                switch.fp32_precision = "ieee"
            yield
        finally:
            for switch, value in zip(switches, before, strict=True):
                switch.fp32_precision = value


Precision = Literal["auto", "fp32", "bf16"]
PRECISIONS = ("auto", "fp32", "bf16")


def pick_dtype(precision: Precision, device: torch.device) -> torch.dtype:
    """The dtype for a value of --precision on a device; ValueError for an unknown precision."""
    if precision not in PRECISIONS:
        raise ValueError(f"precision {precision!r} is none of {', '.join(PRECISIONS)}")
    if precision == "auto":
        return torch.bfloat16 if multiplies_bf16(device) else torch.float32
    return torch.float32 if precision == "fp32" else torch.bfloat16


def multiplies_bf16(device: torch.device) -> bool:
    """Whether the hardware multiplies bfloat16 natively: CPUs with AMX or AVX512-BF16, GPUs from Ampere on."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    has = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return bool(has.get("amx_bf16") or has.get("avx512_bf16"))


_pool: ThreadPoolExecutor | None = None
_pool_lock = threading.Lock()


def thread_count() -> int:
    """Number of threads: torch's own, so that one setting controls both."""
    return torch.get_num_threads()


CHUNKS = 6  # chunks of a task for each thread: so many that uneven ones balance


def run_chunks(function: Callable[[int, int], object], total: int, grain: int | None = None) -> None:
    """Call `function(start, stop)` for chunks of 0..total, each at most `grain` long, in any order, on several threads.

    Writes of different chunks must not overlap. A thread takes the next chunk when it has finished one, so uneven
    chunks balance.
    """
    grain = grain or max(-(-total // (CHUNKS * thread_count())), 1)
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
    """Drop the pool in a forked child, which has none of its parent's threads."""
    global _pool, _pool_lock
    _pool, _pool_lock = None, threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


def versions() -> dict[str, str]:
    """Versions of Spackle, Python and the numerical packages."""
    ours = {"spackle": spackle.__version__, "python": platform.python_version(), "torch": torch.__version__}
    return ours | {name: version(name) for name in ("numba", "numpy")}


def hardware(device: torch.device) -> dict[str, Any]:
    """The CPU, its cores, the number of threads, and the GPU if that is the device."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not a Linux
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    facts = {"cpu": names[0] if names else platform.machine(), "cores": os.cpu_count(), "threads": thread_count()}
    return facts | ({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {})


def load_average() -> float | None:
    """The machine's load over the last minute; None if unknown."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
