"""Device, memory, precision and threads of computations, and facts about the machine for reports."""

from __future__ import annotations

import functools
import os
import platform
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, get_args

import torch

import spackle
from spackle.runtime.errors import InputError, check_name

# Torch reports a shortage of memory also by plain RuntimeErrors, whose messages contain one of these phrases.
_SHORTAGES = (
    "DefaultCPUAllocator",
    "not enough memory",
    "allocate memory",
    "out of memory",
    "_ALLOC_FAILED",
)


class NotEnoughMemory(InputError):
    """Too little memory was free; a later attempt may succeed."""


def pick_device(device: torch.device | str | None) -> torch.device:
    """The CPU or CUDA device of this name; None selects CUDA if available. InputError for any other device."""
    present = torch.cuda.is_available()
    if device is None:
        return torch.device("cuda" if present else "cpu")
    shown = f"device {str(device)[:40]!a}"
    try:
        target = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{shown}: there is no such device: give cpu or cuda") from error
    if target.type not in ("cpu", "cuda"):
        raise InputError(f"{shown}: networks do not run on such a device: give cpu or cuda")
    if target.type == "cuda" and not present:
        raise InputError(
            f"{shown}: torch finds no CUDA device: give cpu, or install a torch and a driver for CUDA"
        )
    if target.type == "cuda" and (target.index or 0) >= torch.cuda.device_count():
        raise InputError(
            f"{shown}: there is no such CUDA device: give at most cuda:{torch.cuda.device_count() - 1}"
        )
    return target


@contextmanager
def report_memory_shortage(*advice: str, what: str = "for the network") -> Iterator[None]:
    """Turn a shortage of memory into a `NotEnoughMemory` with advice."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        named = isinstance(error, (MemoryError, torch.OutOfMemoryError))
        if not (named or any(words in str(error) for words in _SHORTAGES)):
            raise
        remedies = ", or ".join([*advice, "close other programs"])
        raise NotEnoughMemory(f"not enough memory {what}: {remedies}") from error


@contextmanager
def without_autocast_or_tf32(device: torch.device) -> Iterator[None]:
    """Switch off autocast and TF32 during the block, so that networks compute in the dtypes of their tensors.

    TF32's switches hold for the whole process, so the block affects other threads too.
    """
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        if device.type != "cuda":
            yield
            return
        switches = torch.backends.cuda.matmul, torch.backends.cudnn.conv  # type: ignore[attr-defined]  # torch's stubs
        before = [switch.fp32_precision for switch in switches]
        try:
            for switch in switches:
                switch.fp32_precision = "ieee"
            yield
        finally:
            for switch, value in zip(switches, before, strict=True):
                switch.fp32_precision = value


Precision = Literal["auto", "fp32", "bf16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)


def pick_dtype(precision: Precision, device: torch.device) -> torch.dtype:
    """The dtype for a precision on a device; "auto" is bfloat16 on hardware that multiplies bfloat16."""
    check_name("precision", precision, PRECISIONS)
    if precision == "auto":
        return torch.bfloat16 if has_native_bf16(device) else torch.float32
    return torch.float32 if precision == "fp32" else torch.bfloat16


def has_native_bf16(device: torch.device) -> bool:
    """Whether the hardware multiplies bfloat16 natively: CPUs with AMX or AVX512-BF16, GPUs from Ampere on."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    has = torch.cpu.get_capabilities() if device.type == "cpu" else {}
    return bool(has.get("amx_bf16") or has.get("avx512_bf16"))


def thread_count() -> int:
    """The number of threads; it is torch's, so that one setting controls torch and Spackle's kernels."""
    return torch.get_num_threads()


CHUNKS = 6  # chunks of a task for each thread; several chunks balance uneven work


def parallel_for_chunks(
    function: Callable[[int, int], object], total: int, grain: int | None = None
) -> None:
    """Call `function(start, stop)` for chunks of 0..total, each at most `grain` long, in any order, on several threads.

    Writes of different chunks must not overlap.
    """
    grain = grain or max(-(-total // (CHUNKS * thread_count())), 1)
    helpers = min(thread_count(), -(-total // grain)) - 1
    starts = iter(range(0, total, grain))
    lock = threading.Lock()

    def work() -> None:
        while True:
            with lock:
                start = next(starts, None)
            if start is None:
                return
            function(start, min(start + grain, total))

    futures = [_threads(os.getpid()).submit(work) for _ in range(helpers)]
    try:
        work()
    finally:
        for future in futures:
            future.result()


@functools.cache
def _threads(process: int) -> ThreadPoolExecutor:
    """The thread pool of a process; unlike numba's loops, it works for several Python threads and after a fork."""
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix=f"spackle-{process}")


def package_versions() -> dict[str, str]:
    """Versions of Spackle, Python and the numerical packages."""
    ours = {
        "spackle": spackle.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    return ours | {name: version(name) for name in ("numba", "numpy")}


def hardware_facts(device: torch.device) -> dict[str, Any]:
    """Names of the CPU and, for a CUDA device, of the GPU; numbers of cores and threads."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    facts = {
        "cpu": names[0] if names else platform.machine(),
        "cores": os.cpu_count(),
        "threads": thread_count(),
    }
    return facts | ({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {})
