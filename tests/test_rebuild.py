"""The scripts that rebuild the shipped weights, in miniature: from data to a file that the package
loads.
"""

from __future__ import annotations

import os
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.photos import write_photo
from safetensors.torch import load_file

from spackle.bases.lite import SHIPPED_WEIGHTS as LITE
from spackle.bases.lite import load_networks
from spackle.residual.architectures import SHIPPED, load_residual

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


def test_the_residual_is_rebuilt(tmp_path: Path) -> None:
    for index in range(3):
        write_photo(tmp_path / "photos" / f"{index}.png", 96 + 16 * index, 80)
    small = [
        "data.views=4",
        "data.validation_views=1",
        "data.cells=16",
        "data.stereo=null",
        "data.rgbd=[]",
    ]
    out = tmp_path / "out"
    rebuild(
        "rebuild_residual.py", out, f"data.photos={tmp_path}/photos", "loss.features=none", *small
    )
    made, shipped = load_file(out / "residual.safetensors"), load_file(SHIPPED)
    assert {name: (x.shape, x.dtype) for name, x in made.items()} == {
        name: (x.shape, x.dtype) for name, x in shipped.items()
    }
    assert load_residual(out / "residual.safetensors").name == "unet"
    parts = [
        load_file(out / name)["stem.weight"]
        for name in ("mixed.safetensors", "third/best.safetensors", "fourth/best.safetensors")
    ]
    expected = 0.1 * parts[0] + 0.4 * parts[1] + 0.5 * parts[2]
    assert float((made["stem.weight"].float() - expected).abs().max()) < 1e-3


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
