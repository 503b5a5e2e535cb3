"""Bases by name: lite and the models of transformers wherever a base is named, and what each has no use for."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from command import Run, names_in, report_of, run
from evaluation_data import write_boxes
from photos import read_ply, write_photo
from safetensors.torch import load_file, save_file
from sharp_weights import write_tiny
from stand_in import StandIn, base_of, predict, refuses, write_lite

from spackle.app.predict import PredictOptions, shared_digest
from spackle.app.video import PathOptions
from spackle.bases.hf import HfBase
from spackle.bases.open import KINDS, BaseSettings, open_base
from spackle.bases.protocol import BasePrediction, Progress
from spackle.dataset.shards import load_manifest
from spackle.device import MemoryShort
from spackle.downloads import WEIGHTS
from spackle.errors import InputError
from spackle.evaluation.setup import EvaluateOptions
from spackle.image import Photo
from spackle.scene import ResidualChoice


@pytest.fixture(scope="module")
def lite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_lite(tmp_path_factory.mktemp("weights") / "lite.safetensors")


@pytest.fixture(autouse=True)
def _shipped(tmp_path: Path, lite: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without SHARP, and with these weights of lite."""
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.setattr("spackle.bases.lite.base.SHIPPED", lite)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Models of the hub without a hub; holds what was asked for."""
    asked: list[dict[str, Any]] = []

    def load(model: str, **options: Any) -> StandIn:
        asked.append({"model": model, **options})
        return StandIn(f"hf:{model}")

    monkeypatch.setattr(HfBase, "load", load)
    return asked


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--base", "lite", "--depth", "d.npy"), "--depth d.npy: the lite base finds depth itself"),
        (("--base", "lite", "--calib", "c.txt"), "--calib c.txt: the lite base"),
        (("--base", "lite", "--precision", "bf16"), "--precision bf16: the lite base"),
        (("--base", "lite", "--low-memory"), "--low-memory: the lite base"),
        (("--base", "lite", "--windows", "9"), "--windows 9: the lite base is fast as it is"),
        (("--base", "lite", "-c", "gone.safetensors"), "gone.safetensors"),
        (("--base", "hf:a/b", "--depth", "d.npy"), "--depth d.npy: the hf base finds depth itself"),
        (("--base", "hf:a/b", "-c", "x.pt"), "-c x.pt: the hf base"),
        (("--base", "hf:a/b", "--low-memory"), "--low-memory: the hf base"),
        (("--base", "hf:a/b", "--compile"), "--compile: the hf base is not SHARP"),
        (("--base", "hf:"), "names no model"),
        (("--base", "hf"), "there are auto, rgbd, sharp, lite, hf:NAME"),
        (("--base", "shrap"), "did you mean sharp?"),
        (("--base", "rgbd", "-c", "x.pt"), "-c x.pt: the rgbd base has no checkpoint"),
        (("-c", "gone.pt"), "gone.pt"),
        (("--calib", "c.txt"), "--calib c.txt: is for a disparity map"),
        (("--depth", "d.npy", "--low-memory"), "--low-memory: the rgbd base has no network"),
        (("--depth", "d.npy", "--compile"), "--compile: the rgbd base has no network"),
        (("--precision", "fp8"), "fp8"),
        (("--windows", "36"), "--windows must be between 1 and 35, got 36"),
        (("--windows", "2", "--low-memory"), "--windows 2: low memory means one window at a time"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_what_a_base_has_no_use_for_is_refused(tmp_path: Path, words: tuple[str, ...], named: str) -> None:
    refuses(predict(tmp_path, "-i", write_photo(tmp_path / "photo.jpg"), *words), named)
    assert not (tmp_path / "out").exists()


def test_weights_of_lite_that_are_none_stop_a_folder_at_once(tmp_path: Path) -> None:
    sharp = write_tiny(tmp_path / "sharp.safetensors")
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    refuses(predict(tmp_path, "-i", tmp_path / "photos", "--base", "lite", "-c", sharp), sharp)
    assert not (tmp_path / "out").exists()


# Lite and models of transformers by name.


def test_lite_takes_other_weights(tmp_path: Path, lite: Path) -> None:
    photo = write_photo(tmp_path / "photo.png")
    assert base_of(tmp_path, "-i", photo, "--base", "lite")[0]["chosen"] == "--base lite"
    before = read_ply(tmp_path / "out" / "photo" / "base.ply")
    tensors = load_file(lite)
    save_file({name: 1.5 * tensor for name, tensor in tensors.items()}, tmp_path / "mine.safetensors")
    base_of(tmp_path, "-i", photo, "--base", "lite", "-c", tmp_path / "mine.safetensors")
    assert read_ply(tmp_path / "out" / "photo" / "base.ply") != before


def test_a_model_of_the_hub_is_loaded_once_for_all_photos(tmp_path: Path, hub: list[dict[str, Any]]) -> None:
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    words = ("-i", tmp_path / "photos", "--base", "hf:me/small", "--precision", "fp32", "--device", "cpu")
    assert predict(tmp_path, *words).code == 0
    assert hub == [{"model": "me/small", "precision": "fp32", "device": "cpu"}]
    for name in "ab":
        base = report_of(tmp_path / "out" / name)["base"]
        assert (base["name"], base["chosen"]) == ("hf:me/small", "--base hf:me/small")
    assert predict(tmp_path, *words).err.count("done already") == 2
    assert len(hub) == 1
    assert "done already" not in predict(tmp_path, *words, "--base", "hf:me/large").err


def test_a_model_that_cannot_be_loaded_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(model: str, **options: Any) -> HfBase:
        raise InputError(f"hf:{model}: the hub has no such model")

    monkeypatch.setattr(HfBase, "load", missing)
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    refuses(predict(tmp_path, "-i", tmp_path / "photos", "--base", "hf:me/gone"), "hf:me/gone: the hub has no such")


def write_model(folder: Path) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    (folder / "model.safetensors").write_bytes(b"weights")
    (folder / "README.md").write_text("about it")
    return folder


def test_a_models_folder_counts_by_its_files_and_not_by_its_place(tmp_path: Path) -> None:
    folder = write_model(tmp_path / "one" / "small")
    settings = BaseSettings(f"hf:{folder}")
    assert set(settings.files) == {"config.json", "model.safetensors"}
    assert settings.public_name == "hf:small"
    assert BaseSettings("hf:me/small").public_name == "hf:me/small"

    def digest(model: object) -> str:
        settings = BaseSettings(f"hf:{model}")
        return shared_digest(PredictOptions(settings, ResidualChoice("none"), PathOptions()), open_base(settings))

    before = digest(folder)
    elsewhere = shutil.copytree(folder, tmp_path / "two")
    assert digest(elsewhere) == before
    (elsewhere / "README.md").write_text("more about it")
    assert digest(elsewhere) == before
    for name in ("config.json", "model.safetensors"):
        changed = shutil.copytree(folder, tmp_path / f"changed {name}")
        (changed / name).write_text("other")
        assert digest(changed) != before
    assert len({before, digest("me/small"), digest("me/large")}) == 3


# Elsewhere: results must say what they are of, so a base is named.


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


def evaluate(stereo: Path, tmp_path: Path, *words: object) -> Run:
    """`spackle evaluate` of the base alone on one pair."""
    options = ("--methods", "base", "--metrics", "none", "--disparity", "0.3", "-o", tmp_path / "out")
    return run("evaluate", "--dataset", "middlebury", "--root", stereo, *options, *words)


def bench(stereo: Path, tmp_path: Path, *words: object) -> Run:
    options = ("--runs", 2, "--disparity", "0.3", "--residual", "seeds", "-o", tmp_path / "out")
    return run("bench", "--dataset", "middlebury", "--root", stereo, *options, *words)


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_dataset_of_lite_and_of_a_model(tmp_path: Path, lite: Path, hub: list[dict[str, Any]]) -> None:
    model = write_model(tmp_path / "models" / "small")
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
        result = evaluate(stereo, folder, "--base", base, "--precision", "fp32")
        assert result.code == 0, result.err
        said = json.loads((folder / "out" / "results.json").read_text())["config"]["base"]
        assert (said["name"], said["title"], said["weights"]) == (title, title, weights)
        assert "not SHARP, so not the paper's base" in said["says"]
        assert f"| {title} alone |" in (folder / "out" / "tables.md").read_text()
    assert hub == [{"model": "me/small", "precision": "fp32", "device": None}]


def test_tables_call_weights_apples_where_they_came_from_apple(tmp_path: Path) -> None:
    file, record = tmp_path / "my_sharp.pt", tmp_path / "my_sharp.pt.json"
    file.write_bytes(b"weights")
    unknown = "a network of SHARP's shape, from the photo alone, by weights of unknown origin: my_sharp.pt"
    assert BaseSettings("sharp", checkpoint=file).says == unknown
    for url, says in (("https://mirror.example/a.pt", unknown), (WEIGHTS["sharp"].url, KINDS["sharp"].says)):
        record.write_text(json.dumps({"url": url, "size": 7, "sha256": sha256(file)}))
        assert BaseSettings("sharp", checkpoint=file).says == says
    assert BaseSettings("lite", checkpoint=file).says == KINDS["lite"].says


def test_a_benchmark_of_a_model_times_it_each_run(tmp_path: Path, stereo: Path, hub: list[dict[str, Any]]) -> None:
    result = bench(stereo, tmp_path, "--base", "hf:me/small")
    assert result.code == 0, result.err
    found = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert found["config"]["base"]["title"] == "hf:me/small"
    assert len(found["images"][0]["views"][0]["seconds"]["base"]) == 2


def test_the_folder_of_a_benchmark_has_a_plain_name(
    tmp_path: Path, stereo: Path, hub: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ("--runs", 1, "--disparity", "0.3", "--residual", "seeds", "--base", "hf:me/small")
    assert run("bench", "--dataset", "middlebury", "--root", stereo, *words).code == 0
    assert names_in(tmp_path) == {"bench-middlebury-hf-me-small"}


def test_auto_is_refused_where_results_must_say_what_they_are_of(tmp_path: Path, stereo: Path) -> None:
    for result in (
        build(tmp_path, "--base", "auto"),
        build(tmp_path, "--base", "auto", "--depth", tmp_path / "photos"),
        evaluate(stereo, tmp_path, "--base", "auto"),
        bench(stereo, tmp_path, "--base", "auto"),
    ):
        refuses(result, "--base auto: results must say what they are of")
    assert not (tmp_path / "out").exists()


def test_a_dataset_of_rgbd_takes_a_folder_of_depth(tmp_path: Path) -> None:
    refuses(build(tmp_path, "--base", "rgbd"), "give --depth FOLDER; sharp, lite, hf:NAME_OR_FOLDER need none")


def test_evaluations_start_from_the_papers_base() -> None:
    assert EvaluateOptions("middlebury", Path("x")).base.name == "sharp"
