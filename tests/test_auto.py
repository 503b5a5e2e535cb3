"""`--base auto`: which base it chooses, why, what it says, and when it chooses anew."""

from __future__ import annotations

import dataclasses
import logging
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import portraits
import pytest
import torch
from command import names_in, report_of
from photos import HEIGHT, WIDTH, metres, read_ply, write_depth, write_photo
from safetensors.torch import load_file, save_file
from scenes import same_bits
from sharp_weights import gaussians_of, write_tiny
from stand_in import StandIn, base_of, predict, refuses, write_lite

import spackle
from spackle.bases.depth_map import DepthMap
from spackle.bases.lite.base import LiteBase
from spackle.bases.protocol import BasePrediction, Progress
from spackle.bases.sharp import SharpBase
from spackle.bases.sharp.layers import TINY
from spackle.device import MemoryShort
from spackle.errors import InputError
from spackle.image import Photo

SHARP_FILE = "sharp_2572gikvuh.pt"
NO_DEPTH, NO_SHARP = "no depth in the photo", "no SHARP weights here"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Weights of both networks, which show no scene."""
    folder = tmp_path_factory.mktemp("weights")
    return {"sharp": write_tiny(folder / SHARP_FILE), "lite": write_lite(folder / "lite.safetensors")}


@pytest.fixture(autouse=True)
def shipped(tmp_path: Path, made: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine without SHARP, and with weights of lite that belong to the test."""
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path / "weights"))
    lite = shutil.copy(made["lite"], tmp_path / "lite.safetensors")
    monkeypatch.setattr("spackle.bases.lite.base.SHIPPED", lite)
    return lite


@pytest.fixture
def sharp(tmp_path: Path, made: dict[str, Path]) -> Path:
    """Weights of SHARP where a download puts them."""
    (tmp_path / "weights").mkdir()
    return Path(shutil.copy(made["sharp"], tmp_path / "weights"))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """SHARP in no time, from a checkpoint that is not read; holds what was asked for."""
    asked: list[dict[str, Any]] = []

    def load(path: Path, **options: Any) -> StandIn:
        asked.append({"path": path, **options})
        return StandIn("sharp")

    monkeypatch.setattr(SharpBase, "load", load)
    return asked


def portrait(path: Path) -> Path:
    """A photo with depth in it."""
    path.parent.mkdir(exist_ok=True)
    return portraits.write(path, portraits.apple_jpeg(portraits.codes()))


def broken_portrait(path: Path) -> Path:
    """A photo with something in it that was depth once."""
    image = portraits.png(portraits.codes())
    return portraits.write(path, portraits.gdepth_jpeg(image[:60] + bytes(30) + image[90:]))


# Which base, and why.


def test_a_photo_alone_gets_lite_and_advice(tmp_path: Path) -> None:
    base, result = base_of(tmp_path, "-i", write_photo(tmp_path / "photo.jpg"))
    assert (base["name"], base["chosen"]) == ("lite", f"{NO_DEPTH}, {NO_SHARP}")
    assert "passed_over" not in base
    first, second, _ = result.lines
    assert first == (
        f"photo.jpg: base lite ({NO_DEPTH}, {NO_SHARP}): rough geometry; for better: --depth FILE, "
        "`spackle weights get sharp` (research only), or --base hf:depth-anything/Depth-Anything-V2-Small-hf"
    )
    assert "Gaussians from lite, focal length" in second


def test_the_depth_that_a_person_gives_comes_first(tmp_path: Path, sharp: Path) -> None:
    depth = write_depth(tmp_path / "depth.npy")
    base, result = base_of(tmp_path, "-i", portrait(tmp_path / "photo.jpg"), "--depth", depth)
    assert (base["name"], base["chosen"]) == ("rgbd", "--depth")
    assert len(result.lines) == 2
    assert read_ply(tmp_path / "out" / "photo" / "base.ply").row(0)["z"] == pytest.approx(metres()[0, 0], rel=1e-5)


def test_then_the_depth_in_the_photo_comes(tmp_path: Path, sharp: Path) -> None:
    photo = portrait(tmp_path / "photo.jpg")
    base, result = base_of(tmp_path, "-i", photo)
    assert (base["name"], base["chosen"]) == ("rgbd", "the depth in the photo")
    assert base["depth"].startswith("portrait depth of the photo")
    assert result.lines[0] == "photo.jpg: base rgbd (the depth in the photo)"
    automatic = read_ply(tmp_path / "out" / "photo" / "base.ply")
    base, result = base_of(tmp_path, "-i", photo, "--base", "rgbd")
    assert base["chosen"] == "--base rgbd"
    assert len(result.lines) == 2
    assert read_ply(tmp_path / "out" / "photo" / "base.ply") == automatic


def test_then_sharp_does_if_its_weights_are_here(tmp_path: Path, sharp: Path) -> None:
    base, result = base_of(tmp_path, "-i", write_photo(tmp_path / "photo.jpg"))
    assert base["weights"] == SHARP_FILE
    assert (base["name"], base["chosen"], base["gaussians"]) == ("sharp", NO_DEPTH, gaussians_of(TINY))
    assert result.lines[0] == f"photo.jpg: base sharp ({NO_DEPTH})"


def test_or_if_they_are_given(tmp_path: Path, sharp: Path, quick: list[dict[str, Any]]) -> None:
    given = write_tiny(tmp_path / "mine.pt")
    assert base_of(tmp_path, "-i", write_photo(tmp_path / "photo.jpg"), "-c", given)[0]["name"] == "sharp"
    sharp.unlink()
    assert base_of(tmp_path, "-i", tmp_path / "photo.jpg", "-c", given)[0]["name"] == "sharp"
    assert [asked["path"] for asked in quick] == [given, given]


def test_weights_that_a_person_gave_are_taken_or_refused(tmp_path: Path, sharp: Path) -> None:
    photo, given = write_photo(tmp_path / "photo.jpg"), tmp_path / "mine.pt"
    refuses(predict(tmp_path, "-i", photo, "-c", given), "mine.pt")
    for damage in (garbage, of_another_network):
        said = damage(given)
        refuses(predict(tmp_path, "-i", photo, "-c", given), said)


def test_a_machine_without_a_home_has_no_sharp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("no home")

    monkeypatch.setattr(Path, "home", homeless)
    for name in ("SPACKLE_WEIGHTS", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    photo = write_photo(tmp_path / "photo.png")
    assert base_of(tmp_path, "-i", photo)[0]["chosen"] == f"{NO_DEPTH}, {NO_SHARP}"
    refuses(predict(tmp_path, "-i", photo, "--base", "sharp"), "SPACKLE_WEIGHTS")
    spackle.predict(photo, network=None)


def test_precision_and_speed_are_for_sharp_if_it_is_taken(
    tmp_path: Path, sharp: Path, quick: list[dict[str, Any]]
) -> None:
    words = ("--precision", "fp32", "--windows", 9, "--compile")
    assert base_of(tmp_path, "-i", write_photo(tmp_path / "photo.png"), *words)[0]["name"] == "sharp"
    speed = {"windows": 9, "compiled": True}
    assert quick == [{"path": sharp, "precision": "fp32", "low_memory": False, **speed, "device": None}]
    assert base_of(tmp_path, "-i", portrait(tmp_path / "p.jpg"), *words)[0]["name"] == "rgbd"
    sharp.unlink()
    assert base_of(tmp_path, "-i", tmp_path / "photo.png", *words)[0]["name"] == "lite"
    assert len(quick) == 1


def test_a_persons_lens_beats_that_of_the_depth_in_the_photo(tmp_path: Path) -> None:
    matrix = (70.0, 0.0, 0.0, 0.0, 70.0, 0.0, 32.0, 24.0, 1.0)
    data = portraits.apple_jpeg(portraits.codes(), portraits.apple_xmp(matrix=matrix))
    photo = portraits.write(tmp_path / "photo.jpg", data)
    for words, focal, source in (((), 70.0, "the photo's depth"), (("--focal-px", 50), 50.0, "--focal-px")):
        base_of(tmp_path, "-i", photo, *words)
        report = report_of(tmp_path / "out" / "photo")
        assert (report["focal_px"], report["focal_source"]) == (focal, source)


# What is there but cannot be used is passed over.


def test_broken_depth_in_the_photo_is_passed_over_in_a_line(tmp_path: Path) -> None:
    photo = broken_portrait(tmp_path / "photo.jpg")
    base, result = base_of(tmp_path, "-i", photo)
    assert (base["name"], base["chosen"]) == ("lite", f"the depth in the photo cannot be used, {NO_SHARP}")
    assert result.lines[0].startswith(f"photo.jpg: going on without the depth in the photo: {photo}: ")
    assert result.lines[1].startswith("photo.jpg: base lite (the depth in the photo cannot be used, ")
    (line,) = base["passed_over"]
    assert line.startswith(f"the depth in the photo: {photo}: ")
    refuses(predict(tmp_path, "-i", photo, "--base", "rgbd"), photo)


def test_depth_of_another_shape_than_the_photo_is_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(path: Path) -> DepthMap:
        depth = torch.full((WIDTH, HEIGHT), 2.0)
        return DepthMap(depth, depth > 0, None, None, "depth", path)

    monkeypatch.setattr("spackle.bases.open.load_photo_depth", wrong)
    photo = write_photo(tmp_path / "photo.jpg")
    base, result = base_of(tmp_path, "-i", photo)
    assert base["name"] == "lite"
    assert f"{HEIGHT}×{WIDTH} but photo {photo} is {WIDTH}×{HEIGHT}" in result.lines[0]
    refuses(predict(tmp_path, "-i", photo, "--base", "rgbd"), f"{HEIGHT}×{WIDTH}")


def garbage(file: Path) -> str:
    file.write_bytes(b"not weights at all")
    return "neither a PyTorch checkpoint"


def unlike_its_record(file: Path) -> str:
    record = f'{{"url": "https://x", "size": {file.stat().st_size}, "sha256": "{"0" * 64}"}}'
    file.with_name(f"{file.name}.json").write_text(record)
    return "SHA-256 is not that of what was downloaded"


def of_another_network(file: Path) -> str:
    torch.save({"weight": torch.zeros(3)}, file)
    return "not SHARP's weights"


@pytest.mark.parametrize("damage", [garbage, unlike_its_record, of_another_network])
def test_damaged_weights_of_sharp_are_passed_over_once_for_all_photos(
    tmp_path: Path, sharp: Path, damage: Callable[[Path], str]
) -> None:
    said = damage(sharp)
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    result = predict(tmp_path, "-i", tmp_path / "photos")
    assert result.code == 0
    assert result.lines[0].startswith("a.png: going on without SHARP: ")
    assert said in result.lines[0]
    assert result.lines[1].startswith(f"a.png: base lite ({NO_DEPTH}, SHARP cannot be used): rough geometry")
    assert len(result.lines) == 6
    assert sum("SHARP" in line for line in result.lines) == 2
    one, other = (report_of(tmp_path / "out" / name)["base"] for name in "ab")
    assert one["chosen"] == other["chosen"] == f"{NO_DEPTH}, SHARP cannot be used"
    assert said in one["passed_over"][0]
    assert "done already" in predict(tmp_path, "-i", tmp_path / "photos").err
    refuses(predict(tmp_path, "-i", tmp_path / "photos" / "a.png", "--base", "sharp"), said)


def hungry(*args: object, **options: object) -> None:
    raise MemoryShort("not enough memory for SHARP: try --low-memory")


@pytest.mark.parametrize("when", ["load", "predict"])
def test_too_little_memory_is_passed_over_and_tried_again_the_next_time(
    tmp_path: Path, sharp: Path, quick: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    with monkeypatch.context() as patch:
        patch.setattr(SharpBase if when == "load" else StandIn, when, hungry)
        result = predict(tmp_path, "-i", tmp_path / "photos")
        assert result.code == 0
        assert [line for line in result.lines if "not enough memory" in line] == result.lines[:1]
        refuses(
            predict(tmp_path, "-i", tmp_path / "photos" / "a.png", "--base", "sharp"), "not enough memory for SHARP"
        )
    for name in "ab":
        report = report_of(tmp_path / "out" / name)
        assert (report["base"]["name"], report["request"]) == ("lite", None)
    again = predict(tmp_path, "-i", tmp_path / "photos")
    assert "done already" not in again.err
    assert report_of(tmp_path / "out" / "b")["base"]["name"] == "sharp"


def test_numbers_that_are_none_count_as_a_failure(
    tmp_path: Path, sharp: Path, quick: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    predict_box = StandIn.predict

    def wild(self: StandIn, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        found = predict_box(self, photo, progress)
        far = dataclasses.replace(found.gaussians, means=found.gaussians.means * torch.inf)
        return dataclasses.replace(found, gaussians=far)

    monkeypatch.setattr(StandIn, "predict", wild)
    base, result = base_of(tmp_path, "-i", write_photo(tmp_path / "photo.png"))
    assert base["name"] == "lite"
    assert "range of float32" in result.lines[0]


def test_one_photos_failure_takes_sharp_from_no_other(
    tmp_path: Path, sharp: Path, quick: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    predict_box = StandIn.predict

    def picky(self: StandIn, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        if photo.path.stem == "b":
            raise InputError(f"{photo.path}: not this one")
        return predict_box(self, photo, progress)

    monkeypatch.setattr(StandIn, "predict", picky)
    for name in "abc":
        write_photo(tmp_path / "photos" / f"{name}.png")
    assert predict(tmp_path, "-i", tmp_path / "photos").code == 0
    names = [report_of(tmp_path / "out" / name)["base"]["name"] for name in "abc"]
    assert names == ["sharp", "lite", "sharp"]
    assert len(quick) == 1  # loaded once


def test_everything_may_fail_one_after_the_other(tmp_path: Path, sharp: Path, shipped: Path) -> None:
    photo = broken_portrait(tmp_path / "photo.jpg")
    garbage(sharp)
    base, result = base_of(tmp_path, "-i", photo)
    assert (base["name"], len(base["passed_over"])) == ("lite", 2)
    assert base["chosen"] == "the depth in the photo cannot be used, SHARP cannot be used"
    shipped.write_bytes(b"nothing")
    result = predict(tmp_path, "-i", photo)
    assert (result.code, len(result.lines)) == (2, 3)
    assert str(shipped) in result.lines[-1]


# What is named never gives way to another.


def test_a_photo_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "bad.jpg").write_text("no photo")
    refuses(predict(tmp_path, "-i", tmp_path / "bad.jpg"), tmp_path / "bad.jpg")
    refuses(predict(tmp_path, "-i", tmp_path / "gone.jpg"), tmp_path / "gone.jpg")
    assert not (tmp_path / "out").exists()


def test_depth_that_a_person_gives_is_not_passed_over(tmp_path: Path) -> None:
    photo = portrait(tmp_path / "photos" / "a.jpg")
    np.save(tmp_path / "bad.npy", np.zeros((HEIGHT, WIDTH), np.float32))
    refuses(predict(tmp_path, "-i", photo, "--depth", tmp_path / "bad.npy"), "bad.npy")
    (tmp_path / "depths").mkdir()
    refuses(predict(tmp_path, "-i", photo, "--depth", tmp_path / "depths"), "no depth map in")
    portrait(tmp_path / "photos" / "b.jpg")
    write_depth(tmp_path / "depths" / "b.npy")
    result = predict(tmp_path, "-i", photo.parent, "--depth", tmp_path / "depths")
    assert result.code == 1
    assert sum("no depth map in" in line for line in result.lines) == 1
    assert names_in(tmp_path / "out") == {"b"}


def test_rgbd_takes_depth_given_or_inside_and_says_so_where_there_is_none(tmp_path: Path, sharp: Path) -> None:
    photo = write_photo(tmp_path / "photos" / "a.png")
    result = predict(tmp_path, "-i", photo, "--base", "rgbd")
    refuses(result, photo, "there is none in the photo", "--depth FILE", "lite", "hf:NAME")
    portrait(tmp_path / "photos" / "b.jpg")
    result = predict(tmp_path, "-i", tmp_path / "photos", "--base", "rgbd")
    assert result.code == 1
    assert result.lines[0].startswith(f"error: {photo}: ")
    assert report_of(tmp_path / "out" / "b")["base"]["name"] == "rgbd"


# Folders: what is said once, and what is done again.


def test_a_folder_hears_it_once_and_the_photos_lines_name_the_difference(tmp_path: Path) -> None:
    for name in ("a.png", "c.png", "d.png"):
        write_photo(tmp_path / "photos" / name)
    portrait(tmp_path / "photos" / "b.jpg")
    result = predict(tmp_path, "-i", tmp_path / "photos")
    assert sum("rough geometry" in line for line in result.lines) == 1
    assert sum(": base rgbd (" in line for line in result.lines) == 1
    assert len(result.lines) == 2 * 4 + 2
    from_ = [line.split(" Gaussians from ")[1].split(",")[0] for line in result.lines if " Gaussians from " in line]
    assert from_ == ["lite", "rgbd", "lite", "lite"]


def test_networks_are_loaded_once_and_not_before_a_photo_needs_them(
    tmp_path: Path, sharp: Path, quick: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LiteBase, "load", lambda *args, **options: pytest.fail("loaded"))
    assert predict(tmp_path, "-i", portrait(tmp_path / "photo.jpg")).code == 0
    assert not quick
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    assert predict(tmp_path, "-i", tmp_path / "photos").code == 0
    assert len(quick) == 1
    assert predict(tmp_path, "-i", tmp_path / "photos").err.count("done already") == 2
    assert len(quick) == 1


def test_a_folder_is_done_again_when_better_weights_come(
    tmp_path: Path, made: dict[str, Path], shipped: Path, quick: list[dict[str, Any]]
) -> None:
    write_photo(tmp_path / "photos" / "a.png")

    def base() -> str:
        result = predict(tmp_path, "-i", tmp_path / "photos")
        assert result.code == 0, result.err
        name: str = report_of(tmp_path / "out" / "a")["base"]["name"]
        return "done already" if "done already" in result.err else name

    assert [base(), base()] == ["lite", "done already"]
    tensors = load_file(shipped)
    save_file({name: 2 * tensor for name, tensor in tensors.items()}, shipped)
    assert [base(), base()] == ["lite", "done already"]
    (tmp_path / "weights").mkdir()
    shutil.copy(made["sharp"], tmp_path / "weights")
    assert [base(), base()] == ["sharp", "done already"]
    (tmp_path / "weights" / SHARP_FILE).unlink()
    assert [base(), base()] == ["lite", "done already"]


def test_results_of_sharp_that_give_way_to_lite_are_named(
    tmp_path: Path, made: dict[str, Path], sharp: Path, quick: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)

    def warned() -> list[str]:
        result = predict(tmp_path, "-i", tmp_path / "photos")
        assert result.code == 0, result.err
        return [line for line in result.lines if "warning" in line]

    assert warned() == []

    def bad(path: Path, **options: Any) -> None:
        raise InputError(f"{path}: cut off")

    sharp.write_bytes(b"cut")
    with monkeypatch.context() as patch:
        patch.setattr(SharpBase, "load", bad)
        lines = warned()
        assert lines == [
            f"{name}.png: warning: {tmp_path / 'out' / name} was made by sharp and is made again by lite: "
            f"{NO_DEPTH}, SHARP cannot be used ({sharp})"
            for name in "ab"
        ]
        assert warned() == []  # done already
    shutil.copy(made["sharp"], sharp)
    assert warned() == []
    sharp.unlink()
    assert [line.endswith(f"by lite: {NO_DEPTH}, {NO_SHARP}") for line in warned()] == [True, True]


def test_with_depth_no_network_counts(tmp_path: Path, made: dict[str, Path]) -> None:
    write_photo(tmp_path / "photos" / "a.png")
    words = ("-i", tmp_path / "photos", "--depth", write_depth(tmp_path / "d.npy"))
    assert predict(tmp_path, *words).code == 0
    (tmp_path / "weights").mkdir()
    shutil.copy(made["sharp"], tmp_path / "weights")
    assert "done already" in predict(tmp_path, *words).err
    assert "done already" in predict(tmp_path, *words, "--base", "rgbd").err


def test_weights_that_change_before_they_are_read_stop_the_run(
    tmp_path: Path, sharp: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def change(path: Path, **options: Any) -> StandIn:
        sharp.write_bytes(sharp.read_bytes() + b"more")
        return StandIn("sharp")

    monkeypatch.setattr(SharpBase, "load", change)
    refuses(predict(tmp_path, "-i", write_photo(tmp_path / "photo.png")), "changed while this was running")


# In Python.


def test_python_needs_nothing_but_the_photo(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "spackle")
    photo = write_photo(tmp_path / "photo.jpg")
    scene = spackle.predict(photo, network=None)
    named = spackle.predict(photo, base=spackle.LiteBase.load(), network=None)
    assert same_bits(scene.base, named.base)
    assert [(record.levelname, record.getMessage()[:22]) for record in caplog.records] == [
        ("INFO", "photo.jpg: base lite (")
    ]


def test_python_finds_the_depth_in_the_photo_and_sharp_and_warns(
    tmp_path: Path, sharp: Path, quick: list[dict[str, Any]], caplog: pytest.LogCaptureFixture
) -> None:
    inside = spackle.predict(portrait(tmp_path / "a.jpg"), network=None)
    assert same_bits(inside.base, spackle.predict(spackle.load_photo(tmp_path / "a.jpg"), network=None).base)
    assert not caplog.records
    assert not quick
    spackle.predict(broken_portrait(tmp_path / "b.jpg"), network=None)
    assert [asked["path"] for asked in quick] == [sharp]
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    assert record.getMessage().startswith("b.jpg: going on without the depth in the photo: ")
    with pytest.raises(InputError, match="gone"):
        spackle.predict(tmp_path / "gone.jpg")


def test_a_photo_that_a_program_made_has_no_file_to_look_into(tmp_path: Path) -> None:
    photo = spackle.load_photo(write_photo(tmp_path / "photo.png"))
    drawn = dataclasses.replace(photo, path=Path("nowhere.png"))
    assert same_bits(spackle.predict(drawn, network=None).base, spackle.predict(photo, network=None).base)


def test_python_takes_depth_or_a_base_but_not_both(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "photo.png")
    with pytest.raises(ValueError, match="not both"):
        spackle.predict(photo, write_depth(tmp_path / "d.npy"), base=spackle.LiteBase.load())
