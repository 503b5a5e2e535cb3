"""The demo does what it shows: a real photo, held against the true second one."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import av
import pytest
from command import names_in, refuses, report_of, run
from photos import read_ply
from PIL import Image

from spackle.image import read_image

SIZE = (741, 500)  # of the photo
INPAINTING = "2D inpainting (biharmonic)"
SPACKLE, TRAINED = "Spackle (seeds)", "Spackle (trained)"


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The demo's folder, and what it said."""
    pytest.importorskip("skimage.data")
    folder = tmp_path_factory.mktemp("demo") / "out"
    result = run("demo", "-o", folder)
    assert result.code == 0, result.err
    return folder, result.err


@pytest.fixture(scope="module")
def report(demo: tuple[Path, str]) -> dict[str, Any]:
    return report_of(demo[0])


def test_it_leaves_pictures_a_video_and_a_scene(demo: tuple[Path, str], report: dict[str, Any]) -> None:
    folder = demo[0]
    expected = {"base.ply", "scene.ply", "video.mp4", "comparison.png", "right_view.png", "right_photo.png"}
    assert names_in(folder) == {*expected, "report.json"}
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


def test_it_fills_the_hole_better_than_2d_inpainting_and_harms_nothing_that_was_seen(report: dict[str, Any]) -> None:
    psnr, ssim = report["right_camera"]["psnr"], report["right_camera"]["ssim"]
    hole = {name: score["in_hole"] for name, score in psnr.items()}
    assert max(hole[INPAINTING], hole["base"]) < hole[SPACKLE] < hole[TRAINED]
    assert hole[SPACKLE] >= 16.3
    assert ssim[TRAINED] > ssim[SPACKLE] + 0.01
    assert psnr["base"]["outside"] - psnr[SPACKLE]["outside"] <= 0.1
    assert psnr["base"]["outside"] - psnr[TRAINED]["outside"] <= 0.05


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
    refuses(run("demo", "-o", tmp_path / kind), tmp_path / kind)
    assert names_in(tmp_path / "folder") == {"comparison.png"}


def test_without_scikit_image_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "skimage.data", None)
    refuses(run("demo", "-o", tmp_path / "out"), "pip install 'spackle-nvs[demo]'")
    assert not (tmp_path / "out").exists()
