"""The demo completes a real photo better than 2D inpainting does."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from helpers.command import decode, names_in, refuses, report_of, run
from helpers.photos import read_ply
from PIL import Image

from spackle.paper.evaluation.datasets import stereo

INPAINTING = "2D inpainting (biharmonic)"
SPACKLE, TRAINED = "Spackle (initial Gaussians)", "Spackle (trained)"


def size_of(path: Path) -> tuple[int, int]:
    with Image.open(path) as image:
        image.load()
        return image.size


def even(count: int) -> int:
    """The number itself, or the next one, as videos need it."""
    return count + count % 2


def shrink_the_photos(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Let the demo get every `step`-th pixel, each way, of its photos."""
    data = pytest.importorskip("skimage.data")
    left, right, disparity = (values[::step, ::step] for values in data.stereo_motorcycle())
    monkeypatch.setattr(data, "stereo_motorcycle", lambda: (left, right, disparity / step))
    for name in ("FOCAL", "CX", "CY", "DOFFS"):
        constant = f"MOTORCYCLE_{name}_PX"
        monkeypatch.setattr(stereo, constant, getattr(stereo, constant) / step)


@pytest.mark.parametrize(
    ("step", "size"), [(4, (186, 125)), pytest.param(1, (741, 500), marks=pytest.mark.slow)]
)
def test_the_demo_fills_the_hole_better_than_2d_inpainting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, size: tuple[int, int]
) -> None:
    shrink_the_photos(monkeypatch, step)
    monkeypatch.setattr("spackle.views.DEFAULT_VIDEO_SECONDS", 1.0)  # of the video
    monkeypatch.setattr("spackle.results.many_photos.is_compiled", lambda kernel: False)
    folder = tmp_path / "out"
    result = run("demo", "-o", folder)
    assert result.code == 0, result.err
    assert result.lines[0].startswith("first use: ")  # why nothing happens for a while
    expected = {
        "base.ply",
        "scene.ply",
        "video.mp4",
        "comparison.png",
        "right_view.png",
        "right_photo.png",
    }
    assert names_in(folder) == {*expected, "report.json"}
    report = report_of(folder)
    base, merged = (read_ply(folder / name) for name in ("base.ply", "scene.ply"))
    assert merged.body[: len(base.body)] == base.body
    assert (base.count, merged.count - base.count) == (
        report["base_gaussians"],
        report["aux_gaussians"],
    )
    assert size_of(folder / "right_view.png") == size_of(folder / "right_photo.png") == size
    width, height = map(even, size)
    assert size_of(folder / "comparison.png") == (2 * width, 2 * height)
    frames = decode(folder / "video.mp4")
    assert (len(frames), frames[0].width, frames[0].height) == (30, width, height)
    # The perceptual distance needs weights; without them the command says how to get them.
    assert report["right_camera"]["distance"] == {}
    assert "`spackle weights get squeezenet`" in result.err
    psnr = report["right_camera"]["psnr"]
    hole = {name: score["in_hole"] for name, score in psnr.items()}
    assert max(hole[INPAINTING], hole["base"]) + 0.5 < min(hole[SPACKLE], hole[TRAINED])
    assert min(hole[SPACKLE], hole[TRAINED]) >= 16.5
    assert psnr["base"]["outside"] - psnr[SPACKLE]["outside"] <= 0.1
    assert psnr["base"]["outside"] - psnr[TRAINED]["outside"] <= 0.05
    before, after = (report["hole_area_ratio"][key] for key in ("before", "after"))
    assert (report["disparity"], report["residual"]["weights"]) == (0.3, "shipped")
    assert 0.02 < before < 0.5
    assert after <= 0.03 * before
    assert report["right_camera"]["har_after"] <= 0.03 * report["right_camera"]["har_before"]


def test_without_scikit_image_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "skimage.data", None)
    refuses(run("demo", "-o", tmp_path / "out"), "pip install 'spackle-nvs[demo]'")
    assert not (tmp_path / "out").exists()
