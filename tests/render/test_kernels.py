"""The cache of compiled kernels is invalid after a change of a kernel's sources."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

USER = """
import os
import spackle.runtime.kernels
spackle.runtime.kernels.FASTMATH = set(os.environ["FLAGS"].split())
from number import SIDE
from helper import doubled
from spackle.runtime.kernels import kernel

@kernel
def area(x):
    return inner(doubled(x))

@kernel
def inner(x):
    return x * SIDE

print(area(3), sum(area.stats.cache_hits.values()), sum(area.stats.cache_misses.values()))
"""
HELPER = """
from spackle.runtime.kernels import kernel

@kernel
def doubled(x):
    return {factor} * x
"""


def run(folder: Path, side: int = 10, factor: int = 2, flags: str = "nsz afn") -> list[int]:
    """The kernel's result, the number of cache hits, and the number of compilations."""
    sources = {"number": f"SIDE = {side}\n", "helper": HELPER.format(factor=factor), "user": USER}
    for name, text in sources.items():
        path = folder / f"{name}.py"
        if not path.exists() or path.read_text() != text:
            path.write_text(text)
    mine = {"FLAGS": flags, "NUMBA_CACHE_DIR": str(folder / "kept"), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, str(folder / "user.py")]
    done = subprocess.run(
        command, env={**os.environ, **mine}, capture_output=True, text=True, check=True
    )
    return [int(word) for word in done.stdout.split()]


def test_a_kernel_is_compiled_again_after_a_change(tmp_path: Path) -> None:
    assert run(tmp_path) == [60, 0, 1]
    assert run(tmp_path, flags="afn nsz") == [60, 1, 0]
    assert run(tmp_path, flags="contract") == [60, 0, 1]
    assert run(tmp_path, side=11) == [66, 0, 1]
    assert run(tmp_path, side=11, factor=5) == [165, 0, 1]
