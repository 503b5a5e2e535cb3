"""`spackle predict` by the best base that there is: what a folder hears once, and what is done again."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from command import refuses, report_of
from photos import write_depth, write_photo
from safetensors.torch import load_file, save_file
from sharp_weights import write_tiny
from stand_in import StandIn, base_of, predict, write_lite

from spackle.bases.sharp import SharpBase
from spackle.device import MemoryShort
from spackle.errors import InputError

SHARP_FILE = "sharp_2572gikvuh.pt"
NO_DEPTH, NO_SHARP = "no depth in the photo", "no SHARP weights here"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Weights of both networks, which show no scene."""
    folder = tmp_path_factory.mktemp("weights")
    return {"sharp": write_tiny(folder / SHARP_FILE), "lite": write_lite(folder / "lite.safetensors")}


@pytest.fixture(autouse=True)
def shipped(tmp_path: Path, made: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine without SHARP, whose loading takes no time, and with weights of lite that belong to the test."""
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    lite = Path(shutil.copy(made["lite"], tmp_path / "lite.safetensors"))
    monkeypatch.setattr("spackle.bases.lite.SHIPPED", lite)
    monkeypatch.setattr(SharpBase, "load", lambda path, **options: StandIn("sharp"))
    return lite


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder with a photo and another."""
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    return tmp_path / "photos"


def install(made: dict[str, Path], tmp_path: Path) -> Path:
    """Weights of SHARP where a download puts them."""
    (tmp_path / "weights").mkdir(exist_ok=True)
    return Path(shutil.copy(made["sharp"], tmp_path / "weights"))


def test_a_photo_alone_gets_lite_and_advice(tmp_path: Path) -> None:
    base, result = base_of(tmp_path, "-i", write_photo(tmp_path / "photo.jpg"))
    assert (base["name"], base["chosen"]) == ("lite", f"{NO_DEPTH}, {NO_SHARP}")
    assert "passed_over" not in base
    first, second, _ = result.lines
    assert first.startswith(f"photo.jpg: base lite ({NO_DEPTH}, {NO_SHARP}): rough geometry; for better: --depth FILE")
    assert "Gaussians from lite, focal length" in second


def test_a_folder_is_done_again_when_better_weights_come(
    tmp_path: Path, made: dict[str, Path], shipped: Path, photos: Path
) -> None:
    def base() -> str:
        result = predict(tmp_path, "-i", photos)
        assert result.code == 0, result.err
        name: str = report_of(tmp_path / "out" / "a")["base"]["name"]
        return "done already" if "done already" in result.err else name

    assert [base(), base()] == ["lite", "done already"]
    save_file({name: 2 * tensor for name, tensor in load_file(shipped).items()}, shipped)
    assert [base(), base()] == ["lite", "done already"]
    weights = install(made, tmp_path)
    assert [base(), base()] == ["sharp", "done already"]
    weights.unlink()
    assert [base(), base()] == ["lite", "done already"]


def test_results_of_sharp_that_give_way_to_lite_are_named(
    tmp_path: Path, made: dict[str, Path], photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bad(path: Path, **options: Any) -> None:
        raise InputError(f"{path}: cut off")

    def warned() -> list[str]:
        return [line for line in predict(tmp_path, "-i", photos).lines if "was made by sharp" in line]

    sharp = install(made, tmp_path)
    assert warned() == []
    sharp.write_bytes(b"cut")
    with monkeypatch.context() as patch:
        patch.setattr(SharpBase, "load", bad)
        first, second = warned()
        assert str(tmp_path / "out" / "a") in first
        assert second.endswith(f"by lite: {NO_DEPTH}, SHARP cannot be used ({sharp})")
        assert warned() == []  # done already
    install(made, tmp_path)
    assert warned() == []
    # With depth no network counts.
    words = ("-i", photos, "--depth", write_depth(tmp_path / "d.npy"))
    assert predict(tmp_path, *words).code == 0
    sharp.unlink()
    assert "done already" in predict(tmp_path, *words, "--base", "rgbd").err


def test_results_for_want_of_memory_are_tried_again_the_next_time(
    tmp_path: Path, made: dict[str, Path], photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hungry(*args: object, **options: object) -> None:
        raise MemoryShort("not enough memory for SHARP")

    install(made, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(SharpBase, "load", hungry)
        result = predict(tmp_path, "-i", photos)
        assert [line for line in result.lines if "not enough memory" in line] == result.lines[:1]
        refuses(predict(tmp_path, "-i", photos, "--base", "sharp"), "not enough memory for SHARP")
    for name in "ab":
        report = report_of(tmp_path / "out" / name)
        assert (report["base"]["name"], report["request"]) == ("lite", None)
    assert "done already" not in predict(tmp_path, "-i", photos).err
    assert report_of(tmp_path / "out" / "b")["base"]["name"] == "sharp"


def test_a_base_that_cannot_be_loaded_stops_a_folder_at_once(
    tmp_path: Path, made: dict[str, Path], photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuses(predict(tmp_path, "-i", photos, "--base", "lite", "-c", made["sharp"]), made["sharp"])
    sharp = install(made, tmp_path)

    def change(path: Path, **options: Any) -> StandIn:
        sharp.write_bytes(sharp.read_bytes() + b"more")
        return StandIn("sharp")

    monkeypatch.setattr(SharpBase, "load", change)
    refuses(predict(tmp_path, "-i", photos), "changed while this was running")
    assert not (tmp_path / "out").exists()
