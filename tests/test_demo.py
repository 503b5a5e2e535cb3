"""The demo does what it shows: a real photo, held against the true second one."""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

import av
import pytest
from photos import read_ply
from PIL import Image

from spackle import cli
from spackle.image import read_image

SIZE = (741, 500)  # of the photo
INPAINTING = "2D inpainting (biharmonic)"
SPACKLE, TRAINED = "Spackle (seeds)", "Spackle (trained)"


def run(folder: Path) -> tuple[int, str]:
    """Exit code and words of `spackle demo`."""
    code, err = 0, io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", ["spackle", "demo", "-o", str(folder)])
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
    return code, err.getvalue()


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The demo's folder, and what it said."""
    pytest.importorskip("skimage.data")
    folder = tmp_path_factory.mktemp("demo") / "out"
    code, said = run(folder)
    assert code == 0, said
    return folder, said


@pytest.fixture(scope="module")
def report(demo: tuple[Path, str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((demo[0] / "report.json").read_text())
    return found


def test_it_leaves_pictures_a_video_and_a_scene(demo: tuple[Path, str], report: dict[str, Any]) -> None:
    folder = demo[0]
    expected = {"base.ply", "scene.ply", "video.mp4", "comparison.png", "right_view.png", "right_photo.png"}
    assert {path.name for path in folder.iterdir()} == {*expected, "report.json"}
    base, merged = (read_ply(folder / name) for name in ("base.ply", "scene.ply"))
    assert merged.body[: len(base.body)] == base.body
    assert (base.count, merged.count - base.count) == (report["base_gaussians"], report["aux_gaussians"])
    assert read_image(folder / "right_view.png", _size) == read_image(folder / "right_photo.png", _size) == SIZE
    width, height = read_image(folder / "comparison.png", _size)
    assert width > 3 * SIZE[0]
    assert height > 2 * SIZE[1]
    with av.open(str(folder / "video.mp4")) as container:
        frames = list(container.decode(video=0))
    assert len(frames) == 60
    assert (frames[0].width, frames[0].height) == (SIZE[0] + 1, SIZE[1])  # made even


def _size(image: Image.Image) -> tuple[int, int]:
    image.load()
    return image.size


def test_it_fills_the_hole_better_than_2d_inpainting(report: dict[str, Any]) -> None:
    hole = {name: score["in_hole"] for name, score in report["right_camera"]["psnr"].items()}
    assert hole[SPACKLE] >= 16.3
    assert hole[INPAINTING] < hole[SPACKLE]
    assert hole["base"] < hole[SPACKLE]


def test_the_trained_weights_are_better_than_the_seeds(report: dict[str, Any]) -> None:
    scores = report["right_camera"]
    assert scores["psnr"][TRAINED]["in_hole"] > scores["psnr"][SPACKLE]["in_hole"]
    assert scores["ssim"][TRAINED] > scores["ssim"][SPACKLE] + 0.01
    assert scores["psnr"]["base"]["outside"] - scores["psnr"][TRAINED]["outside"] <= 0.05


def test_it_does_not_harm_what_was_seen(report: dict[str, Any]) -> None:
    outside = {name: score["outside"] for name, score in report["right_camera"]["psnr"].items()}
    assert outside["base"] - outside[SPACKLE] <= 0.1


def test_it_closes_the_holes(report: dict[str, Any]) -> None:
    before, after = (report["hole_area_ratio"][key] for key in ("before", "after"))
    assert report["disparity"] == 0.3
    assert 0.02 < before < 0.5
    assert after <= 0.03 * before
    assert report["right_camera"]["har_after"] <= 0.03 * report["right_camera"]["har_before"]


def test_it_prints_the_numbers_of_its_report(demo: tuple[Path, str], report: dict[str, Any]) -> None:
    said = demo[1]
    for name, score in report["right_camera"]["psnr"].items():
        row = next(line for line in said.splitlines() if name in line)
        printed = [float(number) for number in re.findall(r"([\d.]+) dB", row)]
        assert printed == pytest.approx([score["in_hole"], score["outside"]], abs=0.006)
        assert f"{report['right_camera']['ssim'][name]:.3f}" in row
    assert f"{report['aux_gaussians']:,} aux Gaussians" in said
    assert str(demo[0] / "comparison.png") in said.replace("\n", "")
    assert report["residual"]["weights"] == "shipped"


@pytest.mark.parametrize("kind", ["file", "file/deep", "folder"])
def test_an_output_that_cannot_be_written_is_one_line(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("skimage.data")
    (tmp_path / "file").touch()
    (tmp_path / "folder" / "comparison.png").mkdir(parents=True)
    code, said = run(tmp_path / kind)
    assert (code, len(said.splitlines())) == (2, 1)
    assert str(tmp_path / kind) in said
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["comparison.png"]


def test_without_scikit_image_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage.data", None)
    code, said = run(tmp_path / "out")
    assert (code, len(said.splitlines())) == (2, 1)
    assert "pip install 'spackle-nvs[demo]'" in said
    assert not (tmp_path / "out").exists()
