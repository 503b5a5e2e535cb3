"""Device, memory, precision and threads of computations, and facts about the machine."""

from __future__ import annotations

import functools
import math
import os
import platform
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import torch

import spackle  # for the version, which is written in this one place; it loads nothing else
from spackle.runtime.declared_options import Precision as Precision
from spackle.runtime.errors import InputError, NotEnoughMemory, check_name, is_memory_shortage


def pick_device(device: torch.device | str | None) -> torch.device:
    """The CPU or CUDA device of this name, such as "cuda:1"; None picks CUDA if it is available.

    Raises:
        InputError: there is no such device, or it is neither a CPU nor CUDA's.
    """
    has_cuda = torch.cuda.is_available()
    if device is None:
        return torch.device("cuda" if has_cuda else "cpu")

    name = f"device {str(device)[:40]!a}"  # for messages: shortened and quoted
    try:
        picked = torch.device(device)
    except (RuntimeError, TypeError) as error:
        raise InputError(f"{name}: there is no such device: give cpu or cuda") from error
    if picked.type not in ("cpu", "cuda"):
        raise InputError(f"{name}: networks do not run on such a device: give cpu or cuda")
    if picked.type == "cuda" and not has_cuda:
        raise InputError(
            f"{name}: torch finds no CUDA device: "
            "give cpu, or install a torch and a driver for CUDA"
        )
    # "cuda" without a number has no index. It exists whenever device 0 does.
    if picked.type == "cuda" and (picked.index or 0) >= torch.cuda.device_count():
        last = torch.cuda.device_count() - 1
        raise InputError(f"{name}: there is no such CUDA device: give at most cuda:{last}")
    return picked


def use_gpu(number: int | None) -> None:
    """Let this process compute on one of this machine's GPUs, unless a computation names another.

    Args:
        number: counts worker processes from 0; with more processes than GPUs, several share one.
            None leaves the GPU that torch uses.
    """
    if number is not None and torch.cuda.device_count() > 1:
        torch.cuda.set_device(number % torch.cuda.device_count())


@contextmanager
def report_memory_shortage(*advice: str, what: str = "for the network") -> Iterator[None]:
    """Turn a shortage of memory in the block, on the CPU or GPU, into a `NotEnoughMemory`.

    Args:
        advice: what the user can do, such as "give a smaller model".
        what: what the memory is for.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_memory_shortage(error):
            raise
        remedies = ", or ".join([*advice, "close other programs"])
        raise NotEnoughMemory(f"not enough memory {what}: {remedies}") from error


@contextmanager
def without_autocast_or_tf32(device: torch.device) -> Iterator[None]:
    """Let networks compute in the dtypes of their tensors during the block, whatever is set.

    Autocast would compute in a shorter dtype, TF32 would round float32 to 10 bits of mantissa. The
    switches of TF32 hold for the whole process, so the block affects other threads, too.
    """
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        if device.type != "cuda":
            yield
            return

        switches = (
            torch.backends.cuda.matmul,
            torch.backends.cudnn.conv,  # type: ignore[attr-defined]  # torch's stubs lack it
        )
        previous_precisions = [switch.fp32_precision for switch in switches]
        try:
            for switch in switches:
                switch.fp32_precision = "ieee"  # all bits of float32
            yield
        finally:
            for switch, precision in zip(switches, previous_precisions, strict=True):
                switch.fp32_precision = precision


PRECISIONS: tuple[Precision, ...] = get_args(Precision)


def pick_dtype(precision: Precision, device: torch.device) -> torch.dtype:
    """The dtype for a precision on a device; "auto" is bfloat16 on hardware that multiplies it.

    Raises:
        InputError: an unknown precision.
    """
    check_name("precision", precision, PRECISIONS)
    if precision == "bf16":
        return torch.bfloat16
    if precision == "auto" and has_native_bf16(device):
        return torch.bfloat16
    return torch.float32


def has_native_bf16(device: torch.device) -> bool:
    """Whether the hardware itself multiplies bfloat16, so that it is faster than float32.

    CPUs with AMX or AVX512-BF16 do, and NVIDIA's GPUs from the generation Ampere on.
    """
    if device.type == "cuda":
        ampere = (8, 0)  # CUDA's compute capability of this generation
        return torch.cuda.get_device_capability(device) >= ampere
    if device.type == "cpu":
        capabilities = torch.cpu.get_capabilities()
        return bool(capabilities.get("amx_bf16") or capabilities.get("avx512_bf16"))
    return False


def thread_count() -> int:
    """The number of threads; it is torch's, so that one setting controls torch and our kernels."""
    return torch.get_num_threads()


CHUNKS_PER_THREAD = 6  # some chunks take longer than others; small ones keep all threads busy


def parallel_for_chunks(
    function: Callable[[int, int], object], total: int, chunk_length: int | None = None
) -> None:
    """Call `function(start, stop)` for consecutive chunks of 0..total on several threads.

    Args:
        function: does the work for the indices start..stop−1. Chunks come in any order, several at
            a time, so they must not write to the same memory. It should release the GIL.
        total: number of indices.
        chunk_length: the largest number of indices in a chunk; by default total / (6 · threads).
    """
    if chunk_length is None:
        chunk_length = max(math.ceil(total / (CHUNKS_PER_THREAD * thread_count())), 1)
    chunk_count = math.ceil(total / chunk_length)
    starts = iter(range(0, total, chunk_length))
    lock = threading.Lock()

    def work_on_chunks() -> None:
        """Take the next chunk and do its work, until no chunk is left."""
        while True:
            with lock:  # iterators are not safe to share
                start = next(starts, None)
            if start is None:
                return
            function(start, min(start + chunk_length, total))

    # The calling thread works, too, so one helper less is needed.
    helper_count = min(thread_count(), chunk_count) - 1
    pool = _thread_pool(os.getpid())
    helpers = [pool.submit(work_on_chunks) for _ in range(helper_count)]
    try:
        work_on_chunks()
    finally:
        for helper in helpers:
            helper.result()  # waits, and raises the helper's exception


@functools.cache
def _thread_pool(process_id: int) -> ThreadPoolExecutor:
    """The pool of threads of a process.

    A forked process inherits the pool's object without its threads, so the pool is cached by the
    process's id. The pool stands in for numba's own parallel loops, which fail after a fork, and if
    several Python threads start them.
    """
    return ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix=f"spackle-{process_id}")


def package_versions() -> dict[str, str]:
    """Versions of Spackle, Python and the numerical packages, by name."""
    return {
        "spackle": spackle.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numba": version("numba"),
        "numpy": version("numpy"),
    }


def hardware_facts(device: torch.device) -> dict[str, Any]:
    """Names of the CPU and, for a CUDA device, of the GPU; numbers of cores and threads."""
    facts = {"cpu": _cpu_name(), "cores": os.cpu_count(), "threads": thread_count()}
    if device.type == "cuda":
        facts["gpu"] = torch.cuda.get_device_name(device)
    return facts


def _cpu_name() -> str:
    """The name of the CPU where Linux tells it, else its architecture, such as "arm64"."""
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        for line in cpu_info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.machine()
