"""What the machine can do at its best, measured on the spot, and what that allows a stage."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch

from spackle.evaluation.suite.clock import CPU, MS, TOTAL, measure
from spackle.evaluation.suite.values import Found, Need, Row

SIDE = 2048  # of the matrices
COPY_MB = 256
RUNS = 7  # at least: the best one counts
KINDS = {"fp32": torch.float32, "fp64": torch.float64, "bf16": torch.bfloat16}
PRODUCT, COPY = "matrix product, {}", "copy of memory"
RATE, BANDWIDTH = "GFLOP/s", "GB/s"


@dataclasses.dataclass(frozen=True)
class Peaks:
    """The best of several runs."""

    operations: Mapping[str, float]  # a second, by type
    bytes: float  # a second, read and written

    @staticmethod
    def of(found: Found) -> Peaks:
        """Out of what `limits_section` found."""
        rates = {kind: 1e9 * max(found.row(PRODUCT.format(kind)).values) for kind in KINDS}
        return Peaks(rates, 1e9 * max(found.row(COPY).values))

    def least_ms(self, need: Need) -> tuple[float, float]:
        """Milliseconds that the operations take at the peak, and the bytes at the bandwidth."""
        operations = sum(count / self.operations[kind] for kind, count in need.operations.items())
        return MS * operations, MS * need.bytes / self.bytes


def limits_section(runs: int, device: torch.device = CPU, side: int = SIDE, megabytes: float = COPY_MB) -> Found:
    """Products of square matrices, 2·side³ operations each, and copies, each byte of which is read and written."""
    rows = [_product(kind, max(runs, RUNS), device, side) for kind in KINDS]
    source = torch.zeros(int(megabytes * 2**20) // 4, device=device)
    target = torch.ones_like(source)
    times = measure(max(runs, RUNS), {"copy": lambda _: target.copy_(source)}, device)["copy", TOTAL]
    rows.append(Row(COPY, tuple(2 * source.nbytes / (ms / MS) / 1e9 for ms in times), BANDWIDTH))
    return Found(tuple(rows), {"matrices": side, "copy_mb": megabytes}, device=device.type)


def _product(kind: str, runs: int, device: torch.device, side: int) -> Row:
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.rand(side, side, generator=generator).to(device, KINDS[kind]) for _ in range(2))
    out = torch.empty_like(a)
    times = measure(runs, {"mm": lambda _: torch.mm(a, b, out=out)}, device)["mm", TOTAL]
    return Row(PRODUCT.format(kind), tuple(2 * side**3 / (ms / MS) / 1e9 for ms in times), RATE)
