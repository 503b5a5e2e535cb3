"""Some damaged files for each reader; `make fuzz N=5000` tries more. Failures are kept in
fuzz-failures/.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import fuzz
import pytest
from readers import stored_files


def run(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, fuzz.__file__, *map(str, arguments)], capture_output=True, text=True
    )
    assert done.returncode == 0, (
        f"{done.stdout}{done.stderr}: python tests/fuzz/fuzz.py --replay shows one again"
    )
    return done.stdout


@pytest.mark.parametrize("count", [60, pytest.param(3000, marks=pytest.mark.slow)])
def test_damaged_files_leave_no_thread_no_file_and_no_memory_behind(count: int) -> None:
    for line in run(
        "-n", count, "--held", "--readers", "clips", "pictures", "photos", "depth"
    ).splitlines():
        threads, files, megabytes = map(int, line.split()[1:])
        # Pillow's cycles: 12 KB a picture
        assert (threads, files, megabytes < 40 + count // 50) == (0, 0, True), line


@pytest.mark.parametrize("count", [20, pytest.param(300, marks=pytest.mark.slow)])
def test_damaged_files_are_refused_in_time_and_in_memory(count: int) -> None:
    assert run("-n", count) == ""


@pytest.mark.parametrize("count", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_small_files_with_a_large_announced_size_stay_below_the_bound(
    tmp_path: Path, count: int
) -> None:
    cases = [
        (name, files)
        for name in ("pictures", "depth")
        for files in list(stored_files(f"large_{name}"))[:count]
    ]
    assert all(len(data) < 1_000_000 for _, files in cases for data in files.values())
    saved = [fuzz.save(name, 0, files, tmp_path / f"{k}") for k, (name, files) in enumerate(cases)]
    # Tens of megapixels are decoded for real, the longest in four seconds of a quiet processor, and
    # several times that beside other programs. What is tested is the memory.
    arguments = ["--seconds", 120, "--replay", *saved]
    assert run(*arguments).splitlines() == ["as it should be"] * min(2 * count, 6)
