"""Some hundred damaged files for each reader; `make fuzz N=5000` tries more. What fails lies in fuzz-failures/."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import fuzz
import numpy as np
import pytest
from readers import READERS, sealed


@pytest.fixture(scope="module")
def failures() -> dict[str, str]:
    """Of all readers: one child is enough for them."""
    return fuzz.fuzz(list(READERS), 300)


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_refused_in_time_and_in_memory(name: str, failures: dict[str, str]) -> None:
    for path, problem in failures.items():
        assert not Path(path).name.startswith(f"{name}-"), f"python tests/fuzz/fuzz.py --replay {path}: {problem}"


def gif(side: int) -> bytes:
    head = b"GIF89a" + struct.pack("<HHBBB", side, side, 0x80, 0, 0) + b"\0\0\0\xff\xff\xff"
    return head + b",\0\0\0\0" + struct.pack("<HHB", side, side, 0) + b"\x02\x02\x4c\x01\0;"


def png(side: int, kind: int, depth: int = 8) -> bytes:
    """Black, and as small as zlib makes it."""
    row = side * depth // 8 * {0: 1, 2: 3, 6: 4}[kind] + 1
    packer = zlib.compressobj(9)
    body = b"".join(packer.compress(bytes(row)) for _ in range(side)) + packer.flush()
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", side, side, depth, kind, 0, 0, 0)), (b"IDAT", body), (b"IEND", b"")]
    parts = (struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d)) for n, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def claiming(png: bytes) -> bytes:
    """The same, but that its data are 4 GB long."""
    at = png.index(b"IDAT")
    return png[: at - 4] + b"\xff" * 4 + png[at:]


def npz(side: int) -> bytes:
    head = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({side}, {side})}}".ljust(117) + "\n"
    array = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + head.encode() + np.ones(side * side).tobytes()
    return sealed({"a.npz": array})["a.npz"]


def test_small_files_that_announce_much_stay_below_the_bound(tmp_path: Path) -> None:
    cases = [
        ("pictures", "a.gif", gif(9_999)),
        *(("pictures", "a.png", png(side, 2)) for side in (9_999, 5_600)),
        ("pictures", "a.png", claiming(png(64, 2))),
        ("depth", "a.png", png(9_999, 0, 16)),
        ("depth", "a.npz", npz(5_600)),
    ]
    assert all(len(data) < 1_000_000 for _, _, data in cases)
    saved = [fuzz.save(case, 0, {name: data}, tmp_path / f"{k}") for k, (case, name, data) in enumerate(cases)]
    assert fuzz.replayed(*saved) == ["as it should be"] * len(cases)
