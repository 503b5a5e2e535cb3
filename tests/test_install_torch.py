"""Which torch `make demo` asks pip for."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "install_torch.sh"
CPU = "https://download.pytorch.org/whl/cpu"


@pytest.mark.parametrize(
    ("system", "gpu", "answers", "index", "asked"),
    [
        ("Linux", False, True, None, f"install --extra-index-url {CPU} torch"),
        ("Linux", False, False, None, "install torch"),  # and a line that says what comes
        ("Linux", True, True, None, "install torch"),
        ("Darwin", False, True, None, "install torch"),
        ("Linux", False, True, "", "install torch"),
        ("Linux", True, False, "https://there/cu130", "install --extra-index-url https://there/cu130 torch"),
    ],
)
def test_the_cpu_build_is_taken_where_no_gpu_is(
    tmp_path: Path, system: str, gpu: bool, answers: bool, index: str | None, asked: str
) -> None:
    fakes = {"uname": f"echo {system}", "nvidia-smi": f"exit {1 - gpu}", "python": f"exit {1 - answers}"}
    for name, line in {**fakes, "pip": 'echo "$@"'}.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / name).chmod(0o755)
    environment = {name: value for name, value in os.environ.items() if name != "TORCH_INDEX"}
    environment |= {"PATH": f"{tmp_path}:{os.environ['PATH']}"} | ({} if index is None else {"TORCH_INDEX": index})
    command = [SCRIPT, tmp_path / "pip", "install"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=30)
    assert done.stdout.strip() == asked
    assert ("3 GB" in done.stderr) == (asked == "install torch" and system == "Linux" and not gpu and not answers)
