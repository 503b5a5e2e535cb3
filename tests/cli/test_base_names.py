"""Bases on the command line: `auto` for a folder, and names in datasets and evaluations."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from helpers.command import Run, refuses, report_of, run
from helpers.evaluation_data import write_boxes
from helpers.photos import write_depth, write_photo
from helpers.stand_in import StandIn, predict
from safetensors.torch import load_file, save_file

import spackle
from spackle.bases import BasePrediction
from spackle.bases.sharp import SharpBase
from spackle.bases.transformers import HfBase
from spackle.core.photo import Photo
from spackle.formats import PlyFile
from spackle.paper.dataset.shards import load_manifest
from spackle.runtime.errors import InputError, NotEnoughMemory
from spackle.runtime.progress import Progress


@pytest.fixture(autouse=True)
def _quick(shipped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without SHARP, whose loading takes no time."""
    monkeypatch.setattr(SharpBase, "load", lambda path, **options: StandIn("sharp"))


def build(tmp_path: Path, *words: object) -> Run:
    """`spackle dataset build` of one photo."""
    write_photo(tmp_path / "photos" / "a.png")
    options = ("--views", 2, "--inpainter", "none", "--threads", 1, "-o", tmp_path / "out")
    return run("dataset", "build", tmp_path / "photos", *options, *words)


def succeeds(result: Run) -> None:
    assert result.code == 0, result.err


def test_a_dataset_skips_bad_photos_and_stops_without_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, short = StandIn.predict, True

    def picky(self: StandIn, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        if short:
            raise NotEnoughMemory("not enough memory")
        if photo.path.name == "b.png":
            raise InputError(f"{photo.path}: the model predicts 0 for every pixel")
        return work(self, photo, progress)

    write_photo(tmp_path / "photos" / "b.png", 80, 60)
    monkeypatch.setattr(HfBase, "load", lambda model, **options: StandIn(f"hf:{model}"))
    monkeypatch.setattr(StandIn, "predict", picky)
    refuses(build(tmp_path, "--base", "hf:me/small"), "not enough memory")
    short = False
    succeeds(result := build(tmp_path, "--base", "hf:me/small"))
    assert "b.png: the model predicts 0 for every pixel" in result.err
    assert [sample.photo for _, sample in load_manifest(tmp_path / "out").samples] == ["a.png"]


def test_results_that_must_name_their_base_refuse_auto(tmp_path: Path) -> None:
    write_boxes(tmp_path / "middlebury" / "Ball", 0)
    root = (
        "--dataset",
        "middlebury",
        tmp_path / "middlebury",
        "-o",
        tmp_path / "out",
        "--base",
        "auto",
    )
    for result in (
        build(tmp_path, "--base", "auto"),
        build(tmp_path, "--base", "auto", "--depth", tmp_path / "photos"),
        run("evaluate", *root),
        run("bench", *root),
    ):
        refuses(result, "--base auto is not allowed here, because the results name their base")
    refuses(
        build(tmp_path, "--base", "rgbd"),
        "--depth FOLDER, or a manifest",
        "sharp, moge, lite, hf:NAME_OR_FOLDER need no depth",
    )
    assert not (tmp_path / "out").exists()


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for name in ("a.png", "b.png"):
        write_photo(tmp_path / "photos" / name)
    return tmp_path / "photos"


def install(made: dict[str, Path], tmp_path: Path) -> Path:
    """Put weights of SHARP into the folder for downloads."""
    (tmp_path / "weights").mkdir(exist_ok=True)
    return Path(shutil.copy(made["sharp"], tmp_path / "weights"))


def test_a_folder_is_done_again_when_weights_come_or_go(
    tmp_path: Path, made: dict[str, Path], shipped: Path, photos: Path
) -> None:
    def again(*options: object) -> str:
        """The base whose results are made now."""
        succeeds(result := predict(tmp_path, photos, *options))
        name: str = report_of(tmp_path / "out" / "a")["base"]["name"]
        return "done already" if "done already" in result.err else name

    (photos / "b.png").unlink()
    assert [again(), again()] == ["lite", "done already"]
    save_file({name: 2 * tensor for name, tensor in load_file(shipped).items()}, shipped)
    assert [again(), again()] == ["lite", "done already"]
    sharp = install(made, tmp_path)
    assert [again(), again()] == ["sharp", "done already"]
    sharp.unlink()
    assert again() == "lite"
    words = ("--depth", write_depth(tmp_path / "d.npy"))
    assert again(*words) == "rgbd"
    install(made, tmp_path)
    assert again(*words, "--base", "rgbd") == "done already"  # with depth no network counts


def test_disparity_of_the_person_else_of_the_photo(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "photo.png")
    depth = ("--depth", write_depth(tmp_path / "d.npy"))
    for options, far, said in (
        (("--disparity", 0.25), 0.25, ""),
        (
            depth,
            0.07,
            "disparity 0.07 of 0.3: 11.9% of the widest view is invented; "
            "--disparity 0.3 moves farther",
        ),
        ((), 0.1, ""),  # the photo would bear more, but lite's coarse depth would not
    ):
        result = predict(tmp_path, photo, *options)
        report = report_of(tmp_path / "out" / "photo")
        assert report["disparity"] == far
        assert said in result.err
        assert PlyFile(tmp_path / "out" / "photo" / "scene.ply").disparity() == far
        assert [row["view"] for row in report["hole_area_ratio"]] == [f"-{far:g}", f"+{far:g}"]
    scene = spackle.predict(photo, residual="none")
    assert scene.disparity == 0.1
    assert torch.equal(scene.path()[20].position, scene.path(disparity=0.1)[20].position)
    files = [tmp_path / f"{name}.mp4" for name in ("as it is", "said")]
    for file, options in zip(files, ((), ("--disparity", 0.1)), strict=True):
        succeeds(
            run(
                "render",
                tmp_path / "out" / "photo" / "scene.ply",
                "-o",
                file,
                "--frames",
                3,
                *options,
            )
        )
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize("when", ["load", "predict"])
def test_a_photo_is_done_again_if_memory_was_short_for_a_better_base(
    tmp_path: Path, made: dict[str, Path], photos: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    def hungry(*args: object, **options: object) -> None:
        raise NotEnoughMemory("not enough memory for SHARP")

    install(made, tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(SharpBase if when == "load" else StandIn, when, hungry)
        succeeds(predict(tmp_path, photos))
    for name in "ab":
        report = report_of(tmp_path / "out" / name)
        assert (report["base"]["name"], report["request"]) == ("lite", None)
    assert "done already" not in predict(tmp_path, photos).err
    assert report_of(tmp_path / "out" / "b")["base"]["name"] == "sharp"
    assert "done already" in predict(tmp_path, photos).err


def test_a_base_that_cannot_be_loaded_stops_a_folder_at_once(
    tmp_path: Path, made: dict[str, Path], photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuses(predict(tmp_path, photos, "--base", "lite", "-c", made["sharp"]), made["sharp"])
    sharp = install(made, tmp_path)

    def change(path: Path, **options: object) -> StandIn:
        sharp.write_bytes(sharp.read_bytes() + b"more")
        return StandIn("sharp")

    monkeypatch.setattr(SharpBase, "load", change)
    for words in (("--base", "sharp"), ()):
        result = predict(tmp_path, photos, *words)
        assert (
            result.code,
            result.lines[-1].endswith("changed while this was running: start again"),
        ) == (2, True)
        assert "going on without" not in result.err
