"""Lite and the models of transformers wherever a base is named: datasets, evaluations and benchmarks."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from command import Run, refuses, run
from evaluation_data import write_boxes
from photos import write_photo
from stand_in import StandIn, write_lite

from spackle.bases.hf import HfBase
from spackle.bases.protocol import BasePrediction, Progress
from spackle.dataset.shards import load_manifest
from spackle.device import MemoryShort
from spackle.errors import InputError
from spackle.image import Photo


@pytest.fixture(scope="module")
def lite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lite(tmp_path_factory.mktemp("weights") / "lite.safetensors")


@pytest.fixture(autouse=True)
def _shipped(tmp_path: Path, lite: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without SHARP, and with these weights of lite."""
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr("spackle.bases.lite.SHIPPED", lite)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Models of the hub without a hub; holds what was asked for."""
    asked: list[dict[str, Any]] = []

    def load(model: str, **options: Any) -> StandIn:
        asked.append({"model": model, **options})
        return StandIn(f"hf:{model}")

    monkeypatch.setattr(HfBase, "load", load)
    return asked


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("middlebury")
    write_boxes(root / "Ball", 0)
    return root


def build(tmp_path: Path, *words: object) -> Run:
    """`spackle dataset build` of one photo."""
    write_photo(tmp_path / "photos" / "a.png")
    options = ("--views", 2, "--inpainter", "none", "--threads", 1, "-o", tmp_path / "out")
    return run("dataset", "build", "--photos", tmp_path / "photos", *options, *words)


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_dataset_of_lite_and_of_a_model(tmp_path: Path, lite: Path, hub: list[dict[str, Any]]) -> None:
    model = tmp_path / "models" / "small"
    model.mkdir(parents=True)
    (model / "config.json").write_text("{}")
    (model / "model.safetensors").write_bytes(b"weights")
    (model / "README.md").write_text("about it")
    digests = {name: sha256(model / name) for name in ("config.json", "model.safetensors")}
    for base, name, weights in (("lite", "lite", sha256(lite)), (f"hf:{model}", "hf:small", digests)):
        result = build(tmp_path / name, "--base", base)
        assert result.code == 0, result.err
        manifest = load_manifest(tmp_path / name / "out")
        assert manifest.complete
        assert len(manifest.samples) == 1
        said = manifest.config["base"]
        assert (said["name"], said["weights"]) == (name, weights)
        assert str(tmp_path) not in (tmp_path / name / "out" / "manifest.json").read_text()
    assert [asked["model"] for asked in hub] == [str(model)]


def test_a_photo_that_a_model_cannot_work_on_is_passed_over_and_too_little_memory_stops(
    tmp_path: Path, hub: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    work = StandIn.predict

    def picky(self: StandIn, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        if photo.path.name == "b.png":
            raise InputError(f"{photo.path}: the model predicts 0 for every pixel")
        return work(self, photo, progress)

    def hungry(self: StandIn, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        raise MemoryShort("not enough memory")

    write_photo(tmp_path / "photos" / "b.png", 80, 60)
    monkeypatch.setattr(StandIn, "predict", hungry)
    refuses(build(tmp_path, "--base", "hf:me/small"), "not enough memory")
    monkeypatch.setattr(StandIn, "predict", picky)
    result = build(tmp_path, "--base", "hf:me/small")
    assert result.code == 0, result.err
    assert "b.png: the model predicts 0 for every pixel" in result.err
    assert [sample.photo for _, sample in load_manifest(tmp_path / "out").samples] == ["a.png"]


def test_an_evaluation_of_lite_and_of_a_model(
    tmp_path: Path, stereo: Path, lite: Path, hub: list[dict[str, Any]]
) -> None:
    for base, title, weights in (("lite", "lite", sha256(lite)), ("hf:me/small", "hf:me/small", None)):
        folder = tmp_path / title
        words = ("--methods", "base", "--metrics", "none", "--disparity", "0.3", "-o", folder / "out")
        root = ("--dataset", "middlebury", "--root", stereo)
        result = run("evaluate", *root, *words, "--base", base, "--precision", "fp32")
        assert result.code == 0, result.err
        said = json.loads((folder / "out" / "results.json").read_text())["config"]["base"]
        assert (said["name"], said["title"], said["weights"]) == (title, title, weights)
        assert "not SHARP, so not the paper's base" in said["says"]
        assert f"| {title} alone |" in (folder / "out" / "tables.md").read_text()
    assert hub == [{"model": "me/small", "precision": "fp32", "device": None}]


def test_where_results_must_say_what_they_are_of_auto_is_refused_and_sharp_the_default(
    tmp_path: Path, stereo: Path
) -> None:
    root = ("--dataset", "middlebury", "--root", stereo, "-o", tmp_path / "out", "--base", "auto")
    for result in (
        build(tmp_path, "--base", "auto"),
        build(tmp_path, "--base", "auto", "--depth", tmp_path / "photos"),
        run("evaluate", *root),
        run("bench", *root),
    ):
        refuses(result, "--base auto: results must say what they are of")
    refuses(build(tmp_path, "--base", "rgbd"), "give --depth FOLDER; sharp, lite, hf:NAME_OR_FOLDER need none")
    assert not (tmp_path / "out").exists()
