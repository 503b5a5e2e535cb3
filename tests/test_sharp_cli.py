"""`spackle predict --base sharp` as people use it, with a small checkpoint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from command import FILES, names_in, report_of, run
from photos import picture, read_ply, write_photo
from PIL import Image
from sharp_weights import gaussians_of, tiny_weights, write_tiny

from spackle.app import predict
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.checkpoint import load_network
from spackle.bases.sharp.layers import TINY
from spackle.device import pick_dtype
from spackle.image import Photo

QUICK = ("--no-render", "--residual", "none")


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny(tmp_path_factory.mktemp("weights") / "tiny.pt")


@pytest.fixture(autouse=True)
def _no_weights_of_my_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))


def test_a_photo_alone_becomes_a_scene_a_video_and_a_report(tmp_path: Path, weights: Path) -> None:
    photo = write_photo(tmp_path / "photo.jpg")
    result = run("predict", "-i", photo, "-o", tmp_path / "out", "--base", "sharp", "-c", weights, "--frames", 3)
    assert result.code == 0, result.err
    assert names_in(tmp_path / "out" / "photo") == FILES
    report = report_of(tmp_path / "out" / "photo")
    native = pick_dtype("auto", torch.device("cpu")) == torch.bfloat16
    precision = "bf16" if native else "fp32"
    expected = {"name": "sharp", "chosen": "--base sharp", "gaussians": gaussians_of(TINY)}
    assert report["base"] == expected | {"precision": precision, "weights": "tiny.pt"}
    assert report["photo"] == {"file": "photo.jpg", "width": 64, "height": 48}
    assert report["focal_source"] == "default 30 mm"
    assert read_ply(tmp_path / "out" / "photo" / "base.ply").count == gaussians_of(TINY)
    for row in report["hole_area_ratio"]:
        assert row["after"] < 0.01 < row["before"]


def test_precision_and_memory_are_options(tmp_path: Path, weights: Path) -> None:
    photo = write_photo(tmp_path / "photo.png")
    options = ("--base", "sharp", "-c", weights, "--precision", "fp32", "--low-memory", "--focal-px", 50, *QUICK)
    result = run("predict", "-i", photo, "-o", tmp_path / "out", *options)
    assert result.code == 0, result.err
    report = report_of(tmp_path / "out" / "photo")
    assert report["base"]["precision"] == "fp32"
    assert (report["focal_px"], report["focal_source"]) == (50, "--focal-px")
    result = run("predict", "-i", photo, "-o", tmp_path / "out", "--base", "sharp", "--precision", "fp8")
    assert result.code == 2
    assert "fp32" in result.err


def test_downloaded_weights_are_found_and_held_to_their_record(tmp_path: Path) -> None:
    photo, folder = write_photo(tmp_path / "photo.png"), tmp_path / "weights"
    folder.mkdir()
    file = write_tiny(folder / "sharp_2572gikvuh.pt")
    arguments = ("predict", "-i", photo, "-o", tmp_path / "out", "--base", "sharp", *QUICK)
    assert run(*arguments).code == 0
    assert report_of(tmp_path / "out" / "photo")["base"]["weights"] == file.name
    record = f'{{"url": "https://x", "size": {file.stat().st_size}, "sha256": "{"0" * 64}"}}'
    (folder / "sharp_2572gikvuh.pt.json").write_text(record)
    result = run(*arguments)
    assert result.code == 2
    assert "SHA-256 is not that of what was downloaded" in result.err


def test_without_weights_one_line_says_both_ways(tmp_path: Path) -> None:
    result = run("predict", "-i", write_photo(tmp_path / "photo.png"), "-o", tmp_path / "out", "--base", "sharp")
    assert result.code == 2
    assert result.err.count("\n") == 1
    assert "spackle weights get sharp" in result.err
    assert "-c FILE" in result.err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("option", ["--depth", "--calib"])
def test_depth_beside_sharp_is_refused(tmp_path: Path, weights: Path, option: str) -> None:
    photo = write_photo(tmp_path / "photo.png")
    arguments = ("--base", "sharp", "-c", weights, option, tmp_path / "d")
    result = run("predict", "-i", photo, "-o", tmp_path / "out", *arguments)
    assert result.code == 2
    assert option in result.err


def test_a_checkpoint_that_is_none_is_one_line_and_nothing_is_written(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "photo.png")
    result = run("predict", "-i", photo, "-o", tmp_path / "out", "--base", "sharp", "-c", photo)
    assert result.code == 2
    assert result.err.count("\n") == 1
    assert str(photo) in result.err
    assert not (tmp_path / "out").exists()


def test_a_folder_goes_on_and_other_weights_do_it_again(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    weights = write_tiny(tmp_path / "w.pt")
    arguments = ("predict", "-i", tmp_path / "photos", "-o", tmp_path / "out", "--base", "sharp", "-c", weights, *QUICK)
    assert run(*arguments).code == 0
    assert run(*arguments).err.count("done already") == 2
    changed = tiny_weights()
    changed["prediction_head.texture_prediction_head.bias"] += 0.1
    torch.save(changed, weights)
    assert "done already" not in run(*arguments).err


def test_less_memory_or_time_gives_the_same_result_and_so_is_not_done_again(tmp_path: Path, weights: Path) -> None:
    write_photo(tmp_path / "photos" / "a.png")
    arguments = ("predict", "-i", tmp_path / "photos", "-o", tmp_path / "out", "--base", "sharp", "-c", weights, *QUICK)
    assert run(*arguments).code == 0
    assert "done already" in run(*arguments, "--low-memory").err
    assert "done already" in run(*arguments, "--windows", 9, "--compile").err


def test_weights_that_change_before_they_are_read_stop_the_whole_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    weights = write_tiny(tmp_path / "w.pt")
    load_photo = predict.load_photo

    def replace_weights(*args: Any, **options: Any) -> Photo:
        changed = tiny_weights()
        changed["prediction_head.texture_prediction_head.bias"] += 0.1
        torch.save(changed, weights)
        return load_photo(*args, **options)

    monkeypatch.setattr("spackle.app.predict.load_photo", replace_weights)
    arguments = ("predict", "-i", tmp_path / "photos", "-o", tmp_path / "out", "--base", "sharp", "-c", weights, *QUICK)
    result = run(*arguments)
    assert result.code == 2
    assert "changed while this was running" in result.err
    assert result.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_weights_that_go_while_a_folder_is_worked_on_are_not_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    weights = write_tiny(tmp_path / "w.pt")
    write_report = predict.write_report

    def remove_weights(*args: Any) -> None:
        weights.unlink(missing_ok=True)
        write_report(*args)

    monkeypatch.setattr("spackle.app.predict.write_report", remove_weights)
    arguments = ("predict", "-i", tmp_path / "photos", "-o", tmp_path / "out", "--base", "sharp", "-c", weights, *QUICK)
    assert run(*arguments).code == 0
    assert names_in(tmp_path / "out") == {"a", "b"}


@pytest.mark.parametrize("problem", ["photo", "focal", "output", "done"])
def test_the_network_is_not_loaded_for_a_photo_that_does_not_need_it(
    tmp_path: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, problem: str
) -> None:
    photo = write_photo(tmp_path / "photos" / "a.png")
    base = ("--base", "sharp", "-c", weights, *QUICK)
    if problem == "done":
        assert run("predict", "-i", photo.parent, "-o", tmp_path / "out", *base).code == 0
    monkeypatch.setattr(SharpBase, "load", lambda *args, **options: pytest.fail("loaded"))
    (tmp_path / "file").touch()
    wrong = {
        "photo": ("-i", tmp_path / "missing.png", "-o", tmp_path / "out"),
        "focal": ("-i", photo, "-o", tmp_path / "out", "--focal-px", 1e9),
        "output": ("-i", photo, "-o", tmp_path / "file"),
        "done": ("-i", photo.parent, "-o", tmp_path / "out"),
    }
    assert run("predict", *wrong[problem], *base).code == (0 if problem == "done" else 2)


@pytest.mark.parametrize("size", [(1, 1), (3000, 3), (10, 2000)])
def test_photos_of_odd_shapes_go_all_the_way(tmp_path: Path, weights: Path, size: tuple[int, int]) -> None:
    Image.fromarray(picture()).resize(size).save(tmp_path / "odd.png")
    options = ("--base", "sharp", "-c", weights, "--frames", 2)
    result = run("predict", "-i", tmp_path / "odd.png", "-o", tmp_path / "out", *options)
    assert result.code == 0, result.err
    assert names_in(tmp_path / "out" / "odd") == FILES


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_anyone_can_make_weights_to_try_it_with(tmp_path: Path, suffix: str) -> None:
    for name in ("one", "two"):
        result = run("weights", "make", tmp_path / f"{name}{suffix}", "--size", "tiny")
        assert result.code == 0, result.err
        assert "show no scene" in result.err
    network = load_network(tmp_path / f"one{suffix}", torch.float32)
    for name, tensor in load_network(tmp_path / f"two{suffix}", torch.float32).state_dict().items():
        assert torch.equal(tensor, network.state_dict()[name])
    result = run("weights", "make", tmp_path / "three.bin", "--size", "tiny")
    assert result.code == 2
    assert ".safetensors" in result.err
