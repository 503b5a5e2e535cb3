"""What a run took place on, for its report."""

from __future__ import annotations

import os
import platform
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

import spackle
from spackle.device import thread_count


def versions() -> dict[str, str]:
    """Ours, and those of what computes."""
    ours = {"spackle": spackle.__version__, "python": platform.python_version()}
    return {**ours, "torch": torch.__version__, "numba": numba.__version__, "numpy": np.__version__}


def hardware(device: torch.device) -> dict[str, Any]:
    """Processor, cores and threads, and the GPU where that is the device."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:  # not a Linux
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    facts = {"cpu": names[0] if names else platform.machine(), "cores": os.cpu_count(), "threads": thread_count()}
    return facts | ({"gpu": torch.cuda.get_device_name(device)} if device.type == "cuda" else {})


def load_average() -> float | None:
    """Of the machine over the last minute, where it tells."""
    return round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None
