"""`spackle predict --base sharp` with a small checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers.command import FILES, SHORT, names_in, report_of, run
from helpers.photos import write_photo
from helpers.sharp_weights import gaussians_of, tiny_weights, write_tiny
from helpers.stand_in import QUICK

from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.encoder import MICRO_SIZE
from spackle.runtime.device import pick_dtype


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    return write_tiny(tmp_path / "micro.safetensors", MICRO_SIZE)


def test_a_photo_becomes_a_scene_and_is_done_again_for_other_weights_but_not_for_other_speed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_photo(tmp_path / "photos" / "a.png")
    weights, folder = write_tiny(tmp_path / "w.pt", MICRO_SIZE), tmp_path / "out" / "a"
    arguments = (
        "predict",
        tmp_path / "photos",
        "-o",
        tmp_path / "out",
        "--base",
        "sharp",
        "-c",
        weights,
        *SHORT,
    )
    assert (run(*arguments).code, names_in(folder)) == (0, FILES)
    report = report_of(folder)
    native = pick_dtype("auto", torch.device("cpu")) == torch.bfloat16
    expected = {"name": "sharp", "chosen": "chosen by name", "gaussians": gaussians_of(MICRO_SIZE)}
    expected |= {
        "precision": "bf16" if native else "fp32",
        "weights": weights.name,
        "usual_disparity": 0.3,
    }
    assert report["base"].items() >= expected.items()
    assert all(row["after"] < 0.01 < row["before"] for row in report["hole_area_ratio"])
    with monkeypatch.context() as patch:
        patch.setattr(SharpBase, "load", lambda *args, **options: pytest.fail("loaded"))
        assert run(*arguments, "--sharp-windows", 9).err.count("done already") == 1
    changed = tiny_weights(MICRO_SIZE)
    changed["prediction_head.texture_prediction_head.bias"] += 0.1
    torch.save(changed, weights)
    result = run(*arguments, "--precision", "fp32", "--sharp-windows", 1)
    assert (result.code, "done already" in result.err) == (0, False)
    assert report_of(folder)["base"]["precision"] == "fp32"


@pytest.mark.parametrize(
    "wrong", [("missing.png", "out"), ("a.png", "out", "--focal-px", 1e9), ("a.png", "a.png")]
)
def test_the_network_is_not_loaded_for_what_cannot_be(
    tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, wrong: tuple[object, ...]
) -> None:
    write_photo(tmp_path / "a.png")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(SharpBase, "load", lambda *args, **options: pytest.fail("loaded"))
    assert (
        run("predict", wrong[0], "-o", *wrong[1:], "--base", "sharp", "-c", weights, *QUICK).code
        == 2
    )
