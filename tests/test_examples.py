"""The examples: each runs on small inputs, and is listed in the docs."""

from __future__ import annotations

import importlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.command import decode
from helpers.evaluation_data import HEIGHT, WIDTH, write_boxes
from helpers.photos import write_depth, write_photo
from helpers.sharp_weights import write_tiny
from PIL import Image

import spackle
from spackle.formats import scene_files
from spackle.paper.training.measured_photos import load_pair

ROOT = Path(__file__).parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


def main_of(number: int) -> Callable[..., Any]:
    (file,) = (ROOT / "examples").glob(f"{number:02}_*.py")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(file.parent)
        main: Callable[..., Any] = importlib.import_module(file.stem).main
    return main


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_photo(tmp_path_factory.mktemp("photo") / "photo.jpg", 96, 72)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    made = spackle.predict(
        write_photo(folder / "photo.png"), write_depth(folder / "depth.npy"), trajectory="swipe"
    )
    made.save(folder / "scene.ply")
    return folder / "scene.ply"


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_in_the_docs(example: Path) -> None:
    assert example.name in (ROOT / "docs" / "examples.md").read_text(encoding="utf-8")


def test_examples_of_a_photo(photo: Path, tmp_path: Path) -> None:
    main_of(1)(photo, tmp_path / "1")
    assert {path.suffix for path in (tmp_path / "1").iterdir()} == {".mp4", ".ply", ".html"}
    main_of(4)(photo, tmp_path / "4")
    own = spackle.Scene.load(tmp_path / "4" / "scene.ply")
    # the depths are between 2 and 20 m
    assert float(own.base.means[:, 2].median()) == pytest.approx(11, abs=3)
    main_of(6)(photo, tmp_path / "6.mp4")
    assert len(decode(tmp_path / "6.mp4")) > 30


def test_the_example_of_progress_and_cancel(
    photo: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main_of(19)(photo, tmp_path / "late.ply", 0)
    assert capsys.readouterr().out.splitlines()[-1] == f"{photo}: ended after 0 s"
    main_of(19)(photo, tmp_path / "photo.ply", 600)
    assert "complete 100%" in capsys.readouterr().out.splitlines()
    assert [path.name for path in tmp_path.iterdir()] == ["photo.ply"]


def test_the_example_of_a_depth_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main_of(2)(
        write_photo(tmp_path / "photo.png"), write_depth(tmp_path / "depth.png"), tmp_path / "out"
    )
    assert "from the scene's own depth" in capsys.readouterr().out
    assert spackle.Scene.load(tmp_path / "out" / "scene.ply").disparity == pytest.approx(0.2)


def test_the_example_completes_a_scene_of_another_tool(scene: Path, tmp_path: Path) -> None:
    base = spackle.Scene.load(scene).base
    spackle.save_ply(base, tmp_path / "theirs.ply")
    main_of(5)(tmp_path / "theirs.ply", scene.with_name("photo.png"), tmp_path / "completed.ply")
    completed = spackle.Scene.load(tmp_path / "completed.ply")
    assert len(completed.base) == len(base)
    assert len(completed.aux) > 100


def test_the_example_of_an_own_format(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_files, "SCENE_ENCODERS", dict(scene_files.SCENE_ENCODERS))
    main_of(15)(scene, tmp_path / "points.xyz")
    lines = (tmp_path / "points.xyz").read_text().splitlines()
    gaussians = spackle.Scene.load(scene).gaussians
    assert len(lines) == len(gaussians)
    first = [float(word) for word in lines[0].split()]
    assert first[:3] == pytest.approx(gaussians.means[0].tolist(), abs=1e-5)


def test_the_example_of_an_own_network(photo: Path, tmp_path: Path) -> None:
    main_of(16)(photo, tmp_path / "out.mp4")
    assert len(decode(tmp_path / "out.mp4")) > 30


def test_the_example_of_an_own_dataset(tmp_path: Path) -> None:
    write_boxes(tmp_path / "boxes", 0)
    pair = load_pair(tmp_path / "boxes")
    folder = tmp_path / "pairs" / "boxes"
    folder.mkdir(parents=True)
    shutil.copy(tmp_path / "boxes" / "left.png", folder / "photo.png")
    shutil.copy(tmp_path / "boxes" / "right.png", folder / "second.png")
    np.save(folder / "depth.npy", pair.depth.depth.numpy())
    numbers = {"width": WIDTH, "height": HEIGHT, "focal_px": 60, "right_m": 0.2}
    (folder / "camera.json").write_text(json.dumps(numbers))
    main_of(17)(tmp_path / "pairs", tmp_path / "results")
    table = (tmp_path / "results" / "tables.md").read_text()
    assert "My pairs" in table


def test_the_example_of_own_photos(tmp_path: Path) -> None:
    write_boxes(tmp_path / "boxes", 0)
    photos = (tmp_path / "boxes" / "left.png", tmp_path / "boxes" / "right.png")
    main_of(18)(*photos, "60", "0.2", "1.2", "3", str(tmp_path / "results"))
    table = (tmp_path / "results" / "evaluation" / "tables.md").read_text()
    assert "My garden" in table


def test_examples_of_videos(scene: Path, tmp_path: Path) -> None:
    main_of(7)(scene, tmp_path)
    assert [len(decode(tmp_path / f"{name}.mp4")) for name in ("swipe", "keyframes", "truck")] == [
        48,
        24,
        24,
    ]
    main_of(8)(scene, tmp_path)
    assert len(decode(tmp_path / "sbs.mp4")) == 24
    files = (tmp_path / "anaglyph.png", scene.with_name("photo.png"))
    glasses, photo = (np.asarray(Image.open(file), float) for file in files)
    assert np.abs(glasses[..., 0] - photo[..., 0]).mean() > 5  # in 0..255


@pytest.mark.slow
def test_the_example_of_sharp(photo: Path, tmp_path: Path) -> None:
    main_of(3)(write_tiny(tmp_path / "sharp.pt"), tmp_path / "out", [photo])
    assert len(spackle.Scene.load(tmp_path / "out" / "photo.ply").base) > 1000


@pytest.mark.slow
def test_examples_with_a_true_second_photo(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("skimage.data")
    main_of(9)(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"base.png", "completed.png", "truth.png"}
    capsys.readouterr()
    main_of(10)(tmp_path / "fitted.png")
    lines = capsys.readouterr().out.splitlines()
    assert float(lines[-1].split()[2]) > float(lines[0].split()[2]) + 1  # dB
    figures = {(row.method, row.metric): row.value for row in main_of(13)()}
    assert figures["spackle", "psnr_hole"] > figures["mine", "psnr_hole"] + 2


@pytest.mark.slow
def test_the_example_of_training(tmp_path: Path) -> None:
    for index in range(3):
        write_photo(tmp_path / "photos" / f"{index}.png", 96 + 16 * index, 80)
    main_of(12)(tmp_path / "photos", tmp_path / "out")
    assert len(decode(tmp_path / "out" / "video.mp4")) > 30


def test_the_example_of_a_notebook(photo: Path, tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(photo.read_bytes())
    subprocess.run(
        [sys.executable, ROOT / "examples" / "14_notebook.py"],
        cwd=tmp_path,
        check=True,
        timeout=300,
    )
    assert (tmp_path / "photo.html").stat().st_size > 10_000
