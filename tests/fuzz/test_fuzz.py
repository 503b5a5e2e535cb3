"""A hundred damaged files for each reader; `make fuzz N=5000` tries more. Failures are kept in fuzz-failures/."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
from pathlib import Path

import fuzz
import numpy as np
import pytest
from PIL import Image


def run(*arguments: object) -> str:
    done = subprocess.run([sys.executable, fuzz.__file__, *map(str, arguments)], capture_output=True, text=True)
    assert done.returncode == 0, f"{done.stdout}{done.stderr}: python tests/fuzz/fuzz.py --replay shows one again"
    return done.stdout


@pytest.mark.parametrize("count", [150, pytest.param(3000, marks=pytest.mark.slow)])
def test_damaged_files_leave_no_thread_no_file_and_no_memory_behind(count: int) -> None:
    for line in run("-n", count, "--held", "--readers", "clips", "pictures", "depth").splitlines():
        threads, files, megabytes = map(int, line.split()[1:])
        assert (threads, files, megabytes < 40) == (0, 0, True), line


def test_damaged_files_are_refused_in_time_and_in_memory() -> None:
    assert run("-n", 120) == ""


def gif(side: int) -> bytes:
    head = b"GIF89a" + struct.pack("<HHBBB", side, side, 0x80, 0, 0) + b"\0\0\0\xff\xff\xff"
    return head + b",\0\0\0\0" + struct.pack("<HHB", side, side, 0) + b"\x02\x02\x4c\x01\0;"


def png(mode: str, side: int) -> bytes:
    file = io.BytesIO()
    Image.new(mode, (side, side)).save(file, "PNG", compress_level=9)
    return file.getvalue()


def npz(side: int) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, depth=np.ones((side, side)))
    return file.getvalue()


def test_small_files_with_a_large_announced_size_stay_below_the_bound(tmp_path: Path) -> None:
    small = png("RGB", 64)
    at = small.index(b"IDAT")
    cases = [
        ("pictures", "a.gif", gif(9_999)),
        *(("pictures", "a.png", png(mode, side)) for mode, side in (("L", 9_999), ("RGB", 5_600))),
        ("pictures", "a.png", small[: at - 4] + b"\xff" * 4 + small[at:]),  # the header announces 4 GB
        ("depth", "a.png", png("I;16", 9_999)),
        ("depth", "a.npz", npz(5_600)),
    ]
    assert all(len(data) < 1_000_000 for _, _, data in cases)
    saved = [fuzz.save(case, 0, {name: data}, tmp_path / f"{k}") for k, (case, name, data) in enumerate(cases)]
    assert run("--replay", *saved).splitlines() == ["as it should be"] * len(cases)
