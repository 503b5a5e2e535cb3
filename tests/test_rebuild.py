"""The script that rebuilds the shipped weights of lite, in miniature: from data to a file that the
package loads. That of the residual: research/worlds/tests/test_worlds_rebuild.py.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from spackle.bases.lite import SHIPPED_WEIGHTS as LITE
from spackle.bases.lite import load_networks

pytestmark = pytest.mark.slow
RESEARCH = Path(__file__).parents[1] / "research"
SHORT = [
    "optim.steps=2",
    "optim.batch=2",
    "optim.warmup=0",
    "run.validate_every=2",
    "run.save_every=2",
]


def rebuild(script: str, output: Path, *overrides: str) -> None:
    command = [sys.executable, RESEARCH / script, "-o", output, *SHORT, *overrides]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=1200, env=environment)
    assert done.returncode == 0, done.stderr


def test_lite_is_rebuilt(tmp_path: Path) -> None:
    runpy.run_path(str(RESEARCH / "lite" / "tests" / "lite_data.py"))["write_data"](tmp_path)
    data = [
        f"data.photos={tmp_path}/photos",
        f"data.stereo={tmp_path}/pairs",
        f"data.validation_stereo={tmp_path}/others",
    ]
    rgbd = [f"data.rgbd=[{{folder: {tmp_path}/kitchen, focal_px: 60}}]"]
    small = [
        "data.made=2",
        "data.guesses=1",
        "data.size=[64, 96]",
        "data.scales=[1]",
        "encoder=random",
    ]
    rebuild("lite/rebuild.py", tmp_path / "out", *data, *rgbd, *small)
    sizes = [
        network.encoder.size for network in load_networks(tmp_path / "out" / "lite.safetensors")
    ]
    assert sizes == [network.encoder.size for network in load_networks(LITE)] == ["lite0", "lite2"]
