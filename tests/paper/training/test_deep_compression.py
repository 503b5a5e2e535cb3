"""Networks packed by Deep Compression are read back, and damaged files are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from spackle.paper.training.deep_compression import read_deep_compression
from spackle.runtime.errors import InputError

SHAPES = {"conv1": (3, 2, 5, 5), "fire2/squeeze": (4, 3, 1, 1)}


def packed(weights: NDArray[np.uint8]) -> tuple[list[int], list[int]]:
    """Numbers of stored values, and of zeros before each: a gap of 15 zeros stores a zero, too."""
    values, gaps, gap = [], [], 0
    for number in weights.ravel():
        if number == 0 and gap < 15:
            gap += 1
            continue
        values.append(int(number))
        gaps.append(gap)
        gap = 0
    return values, gaps


def write_network(path: Path, rng: np.random.Generator) -> dict[str, NDArray[np.float32]]:
    """Write random sparse layers and a further one; returns the arrays of the first ones."""
    counts, body, arrays = [], b"", {}
    for name, shape in (*SHAPES.items(), ("classifier", (2, 4, 1, 1))):
        table = rng.standard_normal(256).astype("<f4")
        table[0] = 0
        bias = rng.standard_normal(shape[0]).astype("<f4")
        numbers = rng.integers(1, 256, shape) * (rng.random(shape) < 0.1)
        arrays |= {f"{name}.w": table[numbers], f"{name}.b": bias}
        values, gaps = packed(numbers.astype(np.uint8))
        counts.append(len(values))
        gaps += [0] * (len(gaps) % 2)
        pairs = [low + 16 * high for low, high in zip(gaps[::2], gaps[1::2], strict=True)]
        body += table.tobytes() + bias.tobytes() + bytes(values) + bytes(pairs)
    path.write_bytes(np.array(counts, "<u4").tobytes() + body)
    return {name: array for name, array in arrays.items() if not name.startswith("classifier")}


def test_packed_layers_are_read_back(tmp_path: Path) -> None:
    for seed in range(5):
        path = tmp_path / f"{seed}.net"
        arrays = write_network(path, np.random.default_rng(seed))
        found = read_deep_compression(path, SHAPES, 3, "give another")
        assert found.keys() == arrays.keys()
        assert all(np.array_equal(found[name], array) for name, array in arrays.items())


def test_damaged_networks_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.net"
    write_network(path, np.random.default_rng(0))
    content = path.read_bytes()
    for damaged in (content[:5], content[:900], content[:1300]):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"a\.net: .*cut off.*: give another"):
            read_deep_compression(path, SHAPES, 3, "give another")
    path.write_bytes(content)
    with pytest.raises(InputError, match="too many weights"):
        read_deep_compression(path, {"conv1": (3, 1, 1, 1)}, 3, "give another")
