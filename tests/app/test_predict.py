"""`spackle predict`: what a prediction leaves behind, folders, and one line where something is wrong."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from command import FILES, SHORT, Run, decode, names_in, predicted, refuses, report_of, run, shortened
from photos import (
    HEIGHT,
    WIDTH,
    box,
    calibration,
    camera_file,
    metres,
    picture,
    read_ply,
    write_depth,
    write_pair,
    write_photo,
)
from PIL import Image
from safetensors.torch import save_file

import spackle
from spackle.image import film_to_pixels
from spackle.residual import ResidualNet


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Run]:
    """The folder of one ordinary prediction, and what was said meanwhile."""
    folder = tmp_path_factory.mktemp("plain")
    result = predicted(*write_pair(folder), folder / "out")
    return folder / "out" / "photo", result


@pytest.fixture(scope="module")
def scene(plain: tuple[Path, Run]) -> Path:
    return plain[0] / "scene.ply"


def test_predict_writes_a_scene_a_video_and_a_report(plain: tuple[Path, Run]) -> None:
    folder, result = plain
    assert (result.out, len(result.lines), "\x1b" in result.err) == ("", 2, False)
    assert all(line.startswith("photo.png: ") for line in result.lines)
    assert "aux Gaussians" in result.lines[1]
    assert names_in(folder) == FILES
    assert names_in(folder.parent) == {"photo"}
    report = report_of(folder)
    first, whole = (read_ply(folder / name) for name in ("base.ply", "scene.ply"))
    assert (whole.names, whole.body[: len(first.body)]) == (first.names, first.body)  # rule 1
    assert f"spackle_base {first.count}" in whole.comments
    base, merged = first.count, whole.count
    assert report["base"] == {"name": "rgbd", "chosen": "--depth", "gaussians": base, "depth_filled": 0.0}
    assert report["aux"]["gaussians"] == merged - base > 0
    assert report["aux"]["share"] == pytest.approx((merged - base) / base)
    assert report["merged"] == merged
    assert report["residual"] == {"weights": "shipped"}
    assert (report["focal_source"], report["mode"], report["disparity"]) == ("default 30 mm", "scene", 0.3)
    assert report["views"] == "rotate-forward"
    assert report["focal_px"] == pytest.approx(film_to_pixels(30, WIDTH, HEIGHT), abs=1e-3)
    assert report["photo"] == {"file": "photo.png", "width": WIDTH, "height": HEIGHT}
    assert [view["view"] for view in report["hole_area_ratio"]] == ["-0.3", "+0.3"]
    for view in report["hole_area_ratio"]:
        assert 0.1 < view["before"] < 1
        assert view["after"] < 0.01 * view["before"]
    stages = {"load", "prepare", "base", "complete", "write", "video", "measure"}
    assert set(report["seconds"]) == {*stages, "total"}
    assert report["seconds"]["total"] == pytest.approx(sum(report["seconds"][stage] for stage in stages))


def test_an_independent_reader_finds_the_photo(scene: Path) -> None:
    ply = read_ply(scene)
    focal = film_to_pixels(30, WIDTH, HEIGHT)
    photo, depth = picture(), metres()
    for index in (0, 1, 777, WIDTH * HEIGHT // 2 + WIDTH // 2, WIDTH * HEIGHT - 1):
        row = ply.row(index)
        y, x = divmod(index, WIDTH)
        z = row["z"]
        assert z == pytest.approx(depth[y, x], rel=1e-5)
        assert row["x"] / z * focal + WIDTH / 2 == pytest.approx(x + 0.5, abs=1e-3)
        assert row["y"] / z * focal + HEIGHT / 2 == pytest.approx(y + 0.5, abs=1e-3)
        color = [255 * (0.5 + 0.28209479177387814 * row[f"f_dc_{c}"]) for c in range(3)]
        assert color == pytest.approx(photo[y, x].tolist(), abs=0.01)
        assert math.hypot(*(row[f"rot_{k}"] for k in range(4))) == pytest.approx(1, abs=1e-5)
        assert 1 / (1 + math.exp(-row["opacity"])) == pytest.approx(0.99, abs=1e-5)
        # Half a pixel wide, where the surface faces the camera.
        assert math.exp(max(row[f"scale_{k}"] for k in range(3))) == pytest.approx(0.5 * z / focal, rel=0.2)


@pytest.mark.parametrize(("width", "height", "frames"), [(64, 48, 3), (65, 47, 4), (64, 48, 1)])
def test_the_video_has_the_frames_and_even_sides(tmp_path: Path, width: int, height: int, frames: int) -> None:
    photo = write_photo(tmp_path / "a.png", width, height)
    depth = write_depth(tmp_path / "d.npy", metres(width, height))
    predicted(photo, depth, tmp_path / "out", "--frames", frames)
    pictures = decode(tmp_path / "out" / "a" / "video.mp4")
    assert len(pictures) == frames
    for frame in pictures:
        assert (frame.width, frame.height) == (width + width % 2, height + height % 2)
        assert frame.format.name == "yuv420p"


def test_the_same_input_gives_the_same_bytes(tmp_path: Path, plain: tuple[Path, Run]) -> None:
    predicted(*write_pair(tmp_path), tmp_path / "out")
    again = tmp_path / "out" / "photo"
    for name in ("base.ply", "scene.ply"):
        assert (again / name).read_bytes() == (plain[0] / name).read_bytes()
    first, second = report_of(plain[0]), report_of(again)
    del first["seconds"], second["seconds"]
    assert first == second


def test_a_second_run_replaces_the_first(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    predicted(photo, depth, tmp_path, "--residual", "none", "--no-render")
    assert names_in(tmp_path / "photo") == FILES - {"video.mp4"}
    report, bare = report_of(tmp_path / "photo"), read_ply(tmp_path / "photo" / "scene.ply")
    assert (report["aux"], report["residual"]) == ({"gaussians": 0, "share": 0.0}, {"weights": "none"})
    assert ("video" in report["seconds"], report["video"]) == (False, None)
    assert bare == read_ply(tmp_path / "photo" / "base.ply")
    assert all(view["after"] == view["before"] > 0 for view in report["hole_area_ratio"])
    predicted(photo, depth, tmp_path)
    assert read_ply(tmp_path / "photo" / "scene.ply").count > bare.count
    assert names_in(tmp_path / "photo") == FILES


@pytest.mark.parametrize("kind", ["swipe", "shake", "rotate", "rotate_forward"])
def test_every_path_closes_its_holes(tmp_path: Path, kind: str) -> None:
    predicted(*write_pair(tmp_path), tmp_path, "--trajectory", kind, "--disparity", "0.5")
    report = report_of(tmp_path / "photo")
    assert report["views"] == kind.replace("_", "-")
    assert [view["view"] for view in report["hole_area_ratio"]] == ["-0.5", "+0.5"]
    assert all(view["after"] < 0.01 < view["before"] for view in report["hole_area_ratio"])


def test_disparity_zero_stays_with_the_photo(tmp_path: Path) -> None:
    predicted(*write_pair(tmp_path), tmp_path, "--disparity", "0")
    sent = picture().astype(float)
    for frame in decode(tmp_path / "photo" / "video.mp4")[:1]:
        assert np.abs(frame.to_ndarray(format="rgb24")[2:-2, 2:-2] - sent[2:-2, 2:-2]).mean() < 8


def test_cameras_completes_exactly_the_given_views(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    views = camera_file(tmp_path / "views.json", rights=[0.0, 0.4, -0.4])
    predicted(photo, depth, tmp_path / "out", "--cameras", views)
    folder = tmp_path / "out" / "photo"
    assert names_in(folder) == {*FILES, "views"}
    expected = {f"{index:04d}{kind}.png" for index in range(3) for kind in ("", "_base", "_mask")}
    assert names_in(folder / "views") == expected
    report = report_of(folder)
    assert (report["views"], report["disparity"]) == (views.name, None)
    assert [view["view"] for view in report["hole_area_ratio"]] == ["0", "1", "2"]
    assert all(view["after"] == 0 for view in report["hole_area_ratio"])
    assert all(view["before"] > 0.05 for view in report["hole_area_ratio"][1:])
    assert len(decode(folder / "video.mp4")) == 3
    gaussians, renderer = spackle.load_ply(folder / "scene.ply"), spackle.get_renderer()
    for index, camera in enumerate(spackle.load_cameras(views)):
        stored = {kind: pixels(folder / "views" / f"{index:04d}{kind}.png") for kind in ("", "_mask")}
        drawn = renderer.render(gaussians, camera).rgb.numpy() * 255
        assert stored[""].shape == (HEIGHT, WIDTH, 3)
        assert np.abs(stored[""] - drawn).max() < 2  # the file's colours are rounded, as float32 and as 8 bits
        assert stored["_mask"].mean() / 255 == pytest.approx(report["hole_area_ratio"][index]["before"])


def test_view_mode_completes_each_view_on_its_own(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    views = camera_file(tmp_path / "views.json", rights=[0.1, 0.4, 0.2], sizes=[(64, 48), (64, 48), (33, 21)])
    predicted(photo, depth, tmp_path / "out", "--cameras", views, "--mode", "view", "--no-render")
    folder = tmp_path / "out" / "photo"
    assert pixels(folder / "views" / "0002.png").shape == (21, 33, 3)
    report = report_of(folder)
    assert (report["mode"], report["scene_ply_view"]) == ("view", "1")
    assert all(view["after"] == 0 for view in report["hole_area_ratio"])
    base, merged = (read_ply(folder / name) for name in ("base.ply", "scene.ply"))
    assert merged.body[: len(base.body)] == base.body
    assert merged.count - base.count == report["aux"]["gaussians"]
    # The paper's counts: one Gaussian for each 2×2 cell of the view with a hole in it, twice at most.
    mask = pixels(folder / "views" / "0001_mask.png") > 0
    cells = mask.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).any(axis=(1, 3)).sum()
    assert 0 < report["aux"]["gaussians"] <= 2 * cells


def test_the_seeds_alone_can_be_had_and_fill_the_holes_where_no_weights_came_with_the_package(
    tmp_path: Path, plain: tuple[Path, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    predicted(*write_pair(tmp_path), tmp_path / "asked", "--residual", "seeds")
    report = report_of(tmp_path / "asked" / "photo")
    assert report["residual"]["weights"] == "seeds"
    assert "no trained weights" in report["residual"]["note"]
    monkeypatch.setattr("spackle.scene.SHIPPED", tmp_path / "none.safetensors")
    predicted(*write_pair(tmp_path), tmp_path / "without")
    seeds, without = (tmp_path / name / "photo" / "scene.ply" for name in ("asked", "without"))
    assert seeds.read_bytes() == without.read_bytes()
    assert seeds.read_bytes() != (plain[0] / "scene.ply").read_bytes()


def test_residual_weights_are_loaded_and_named(tmp_path: Path, plain: tuple[Path, Run]) -> None:
    torch.manual_seed(0)
    network = ResidualNet()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.02)
    weights = tmp_path / "random.safetensors"
    save_file(network.state_dict(), weights)
    predicted(*write_pair(tmp_path), tmp_path, "--residual", weights)
    report = report_of(tmp_path / "photo")
    assert report["residual"] == {"weights": str(weights)}
    base = read_ply(plain[0] / "base.ply").body
    assert (tmp_path / "photo" / "base.ply").read_bytes() == (plain[0] / "base.ply").read_bytes()
    ours, seeds = (read_ply(folder / "scene.ply").body for folder in (tmp_path / "photo", plain[0]))
    assert ours[: len(base)] == base
    assert ours != seeds


@pytest.mark.parametrize(
    ("option", "value", "pixels"),
    [("--focal-px", 70, 70), ("--focal-mm", 50, film_to_pixels(50, 64, 48)), ("--fov", 90, 32)],
)
def test_a_given_focal_length_is_used_and_named(tmp_path: Path, option: str, value: float, pixels: float) -> None:
    predicted(*write_pair(tmp_path), tmp_path, option, value)
    report = report_of(tmp_path / "photo")
    assert report["focal_source"] == option
    assert report["focal_px"] == pytest.approx(pixels, abs=1e-3)
    row = read_ply(tmp_path / "photo" / "base.ply").row(0)
    assert row["x"] / row["z"] * pixels == pytest.approx(0.5 - WIDTH / 2, abs=1e-3)


def test_middleburys_calibration_gives_depth_and_lens(tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "im0.png")
    focal, baseline_mm, doffs = 80.0, 200.0, 1.5
    disparity = (focal * baseline_mm / 1000 / metres() - doffs).astype(np.float32)
    np.save(tmp_path / "disp0.npy", disparity)
    calibration(tmp_path / "calib.txt", focal, baseline_mm, doffs)
    predicted(photo, tmp_path / "disp0.npy", tmp_path / "out")
    report = report_of(tmp_path / "out" / "im0")
    assert (report["focal_source"], report["focal_px"]) == ("calibration", 80.0)
    assert read_ply(tmp_path / "out" / "im0" / "base.ply").row(0)["z"] == pytest.approx(6, rel=1e-4)
    # A calibration that lies elsewhere, and a person who knows better.
    (tmp_path / "lens").mkdir()
    (tmp_path / "calib.txt").rename(tmp_path / "lens" / "c.txt")
    options = ("--calib", tmp_path / "lens" / "c.txt", "--focal-px", 60)
    predicted(photo, tmp_path / "disp0.npy", tmp_path / "out", *options)
    report = report_of(tmp_path / "out" / "im0")
    assert (report["focal_source"], report["focal_px"]) == ("--focal-px", 60.0)


@pytest.mark.parametrize(("width", "height"), [(1, 1), (1, 60), (60, 1), (2, 2), (3, 7), (17, 2)])
def test_tiny_photos(tmp_path: Path, width: int, height: int) -> None:
    photo = write_photo(tmp_path / "a.png", width, height)
    predicted(photo, write_depth(tmp_path / "d.npy", metres(width, height)), tmp_path / "out")
    frame = decode(tmp_path / "out" / "a" / "video.mp4")[0]
    assert (frame.width, frame.height) == (width + width % 2, height + height % 2)


@pytest.mark.parametrize("name", ["a b.png", "ü 漢字 🎉.png", "[red]x.png", "a\nb.png", "%s.png", "p.tar.png", "-.png"])
def test_odd_file_names(tmp_path: Path, name: str) -> None:
    photo = write_photo(tmp_path / "in" / name)
    result = predicted(photo, write_depth(tmp_path / "d.npy"), tmp_path / "out")
    assert names_in(tmp_path / "out" / photo.stem) == FILES
    assert all(name.replace("\n", " ") in line for line in result.lines)


@pytest.mark.parametrize("name", ["..png", "...png", ".png"])
def test_no_name_leads_out_of_the_output(tmp_path: Path, name: str) -> None:
    photo = write_photo(tmp_path / "in" / "a.png").rename(tmp_path / "in" / name)
    predicted(photo, write_depth(tmp_path / "d.npy"), tmp_path / "out" / "deep")
    assert names_in(tmp_path) == {"in", "out", "d.npy"}
    assert names_in(tmp_path / "out") == {"deep"}
    assert names_in(tmp_path / "out" / "deep" / name) == FILES


def few_pixels() -> np.ndarray:
    depth = np.zeros((HEIGHT, WIDTH), np.float32)
    depth[5, 7], depth[40, 60], depth[20, 30] = 3, 4, 2
    return depth


def shuffled(low: float, high: float) -> np.ndarray:
    values = np.geomspace(low, high, WIDTH * HEIGHT)
    return np.random.default_rng(0).permutation(values).reshape(HEIGHT, WIDTH).astype(np.float32)


@pytest.mark.parametrize(
    "depth",
    [
        pytest.param(few_pixels(), id="three pixels"),
        pytest.param(np.where(box(), np.nan, 3).astype(np.float32), id="a hole"),
        pytest.param(np.full((HEIGHT, WIDTH), 3, np.float32), id="all equal"),
        pytest.param(np.full((HEIGHT, WIDTH), 3, np.int32), id="whole metres"),
        pytest.param(metres(10 * WIDTH, 10 * HEIGHT), id="ten times larger"),
        pytest.param(metres(16, 12), id="four times smaller"),
        pytest.param(np.sort(shuffled(0.01, 1e5).ravel()).reshape(HEIGHT, WIDTH), id="1 cm to 100 km"),
        pytest.param(shuffled(0.01, 1e5), id="1 cm to 100 km in disorder"),
        pytest.param(np.full((HEIGHT, WIDTH), 1e-4, np.float32), id="a tenth of a millimetre"),
        pytest.param(np.full((HEIGHT, WIDTH), 1e6, np.float32), id="a thousand kilometres"),
        pytest.param(np.asfortranarray(metres()).astype(">f8"), id="Fortran order, big endian"),
    ],
)
def test_odd_depth_maps(tmp_path: Path, depth: np.ndarray) -> None:
    np.save(tmp_path / "d.npy", depth)
    predicted(write_photo(tmp_path / "a.png"), tmp_path / "d.npy", tmp_path / "out")
    assert names_in(tmp_path / "out" / "a") == FILES
    assert report_of(tmp_path / "out" / "a")["base"]["gaussians"] > WIDTH * HEIGHT


def test_missing_depth_is_said_and_counted(tmp_path: Path) -> None:
    depth = np.where(box(), 0, 3).astype(np.float32)
    result = predicted(write_photo(tmp_path / "a.png"), write_depth(tmp_path / "d.npy", depth), tmp_path / "out")
    assert report_of(tmp_path / "out" / "a")["base"]["depth_filled"] == pytest.approx(box().mean(), abs=1e-4)
    assert any("of the depth was missing" in line for line in result.lines)


def test_a_folder_of_photos_with_a_folder_of_depths(tmp_path: Path) -> None:
    photos, depths = tmp_path / "photos", tmp_path / "depths"
    for name in ("a.jpg", "a.png", "a.jpg.png", "b.PNG", "c.png", ".hidden.png"):
        write_photo(photos / name)
    (photos / "notes.txt").write_text("not a photo")
    (photos / "folder.png").mkdir()
    write_depth(depths / "a.npy")
    write_depth(depths / "a.jpg.npy", metres(far=9))
    write_depth(depths / "b.png")
    write_depth(depths / "c.npy")
    result = predicted(photos, depths, tmp_path / "out")
    assert names_in(tmp_path / "out") == {"a.jpg", "a.png", "a.jpg.png", "b", "c"}  # none collide
    for name in names_in(tmp_path / "out"):
        assert names_in(tmp_path / "out" / name) == FILES
        far = 9 if name.startswith("a.jpg") else 6
        assert read_ply(tmp_path / "out" / name / "base.ply").row(0)["z"] == pytest.approx(far, rel=1e-3)
    assert len(result.lines) == 10


def test_a_bad_photo_in_a_folder_stops_nothing_else(tmp_path: Path) -> None:
    photos, depths = tmp_path / "photos", tmp_path / "depths"
    for name in ("a", "c", "e", "f"):
        write_photo(photos / f"{name}.png")
    (photos / "b.png").write_text("not a photo")
    (photos / "d.png").write_bytes((photos / "a.png").read_bytes()[:100])
    for name in "abcd":
        write_depth(depths / f"{name}.npy")
    write_depth(depths / "f.npy", np.zeros((HEIGHT, WIDTH), np.float32))
    result = run("predict", "-i", photos, "--depth", depths, "-o", tmp_path / "out", *SHORT)
    assert result.code == 1
    assert names_in(tmp_path / "out") == {"a", "c"}
    errors = [line for line in result.lines if line.startswith("error: ")]
    for line, culprit in zip(errors, ("b.png", "d.png", "e.png", "f.npy"), strict=True):
        assert culprit in line
    assert result.lines[-1] == "4 of 6 photos failed"


def test_a_folder_goes_on_where_a_killed_run_stopped(tmp_path: Path) -> None:
    photos, out = tmp_path / "photos", tmp_path / "out"
    depth = write_depth(tmp_path / "d.npy")
    for name in "abc":
        write_photo(photos / f"{name}.png")
    predicted(photos, depth, out)
    (out / "b" / "report.json").unlink()  # what is written last is missing: b was not finished
    times = {name: (out / name / "scene.ply").stat().st_mtime_ns for name in "abc"}

    def redone() -> set[str]:
        before = dict(times)
        times.update({name: (out / name / "scene.ply").stat().st_mtime_ns for name in times})
        return {name for name in times if times[name] != before[name]}

    result = predicted(photos, depth, out)
    assert redone() == {"b"}
    assert sum("done already" in line for line in result.lines) == 2
    (out / "c" / "video.mp4").unlink()
    predicted(photos, depth, out)
    assert redone() == {"c"}
    for options in (("--disparity", "0.2"), ("--overwrite", "--disparity", "0.2")):
        predicted(photos, depth, out, *options)
        assert redone() == {"a", "b", "c"}
    write_depth(depth, metres(far=7))
    predicted(photos, depth, out, "--disparity", "0.2")
    assert redone() == {"a", "b", "c"}


def test_a_changed_calibration_is_not_done_already(tmp_path: Path) -> None:
    write_photo(tmp_path / "photos" / "disp0.png")
    disparity = write_depth(tmp_path / "depths" / "disp0.npy")
    calibration(disparity.with_name("calib.txt"), 80, 200, 0)
    for focal in (80, 90):
        calibration(disparity.with_name("calib.txt"), focal, 200, 0)
        predicted(tmp_path / "photos", disparity.parent, tmp_path / "out")
        assert report_of(tmp_path / "out" / "disp0")["focal_px"] == focal


def test_no_old_report_vouches_for_new_files(
    tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    predicted(*pair, tmp_path)
    monkeypatch.setattr("spackle.app.predict.save_views_video", interrupted)
    assert run("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path, "--disparity", "0.5", *SHORT).code == 130
    assert names_in(tmp_path / "photo") == FILES - {"report.json"}


def test_a_folder_where_everything_fails_leaves_no_output(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_text("not a photo")
    out = tmp_path / "new" / "out"
    result = run("predict", "-i", tmp_path / "photos", "--depth", write_depth(tmp_path / "d.npy"), "-o", out, *SHORT)
    assert result.code == 1
    assert not out.parent.exists()


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    return write_pair(tmp_path)


def expect_refusal(tmp_path: Path, *arguments: object, named: object) -> None:
    """`spackle predict` that must fail before it leaves anything in a new folder."""
    out = tmp_path / "new" / "out"
    refuses(run("predict", "-o", out, *shortened(arguments)), named)
    assert not out.parent.exists()


def truncated(path: Path) -> None:
    write_photo(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


BAD_PHOTOS: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "empty": lambda path: path.touch(),
    "text": lambda path: path.write_text("a photo"),
    "truncated": truncated,
    "only a signature": lambda path: path.write_bytes(b"\x89PNG\r\n\x1a\n"),
    "an empty folder": lambda path: path.mkdir(),
    "a pipe": os.mkfifo,
}


@pytest.mark.parametrize("kind", BAD_PHOTOS)
def test_files_that_are_no_photo_and_no_depth_map(tmp_path: Path, kind: str) -> None:
    bad = tmp_path / "bad.png"
    BAD_PHOTOS[kind](bad)
    expect_refusal(tmp_path, "-i", bad, "--depth", write_depth(tmp_path / "d.npy"), named=bad)
    expect_refusal(tmp_path, "-i", write_photo(tmp_path / "a.png"), "--depth", bad, named=bad)


def test_depth_maps_that_do_not_go_with_the_photo(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    far, bad = np.full((HEIGHT, WIDTH), "far"), tmp_path / "bad.npy"
    for depth in (metres(48, 64), np.full((HEIGHT, WIDTH), np.inf), far, np.full((HEIGHT, WIDTH), 1e300)):
        np.save(bad, depth)
        expect_refusal(tmp_path, "-i", pair[0], "--depth", bad, named=bad)
    long = tmp_path / ("x" * 300)  # a name that no file system takes
    expect_refusal(tmp_path, "-i", long, "--depth", pair[1], named=long)
    for file in (pair[0], long):
        expect_refusal(tmp_path, "-i", pair[0], "--depth", file, named=file)
    disparity = pair[1].rename(tmp_path / "disp0.npy")
    expect_refusal(tmp_path, "-i", pair[0], "--depth", disparity, named=disparity)
    (tmp_path / "calib.txt").write_text("cam0=[1 2]\n")
    expect_refusal(tmp_path, "-i", pair[0], "--depth", disparity, named=tmp_path / "calib.txt")
    expect_refusal(tmp_path, "-i", pair[0], "--base", "rgbd", named="--depth")
    (tmp_path / "depths").mkdir()
    expect_refusal(tmp_path, "-i", pair[0], "--depth", tmp_path / "depths", named=pair[0])


BAD_OPTIONS = {
    "--focal-px": ("0", "-50", "nan", "inf", "1e-30", "1e39", "1e6", "50 --fov 60"),
    "--focal-mm": ("0", "1e308"),
    "--fov": ("0", "180", "1e-300"),
    "--disparity": ("-0.1", "2.1", "nan"),
    "--frames": ("0", "1000000"),
    "--precision": ("bf16",),
    "--low-memory": ("",),
    "--base": ("sharp9",),
    "--device": ("cuda",),
    "-c": ("weights.pt",),
    "--residual": ("nowhere.safetensors",),
    "--cameras": ("nowhere.json",),
    "--calib": ("nowhere.txt",),
}


@pytest.mark.parametrize("option", BAD_OPTIONS)
def test_bad_options(tmp_path: Path, pair: tuple[Path, Path], option: str) -> None:
    for value in BAD_OPTIONS[option]:
        named = value if "nowhere" in value else option
        expect_refusal(tmp_path, "-i", pair[0], "--depth", pair[1], option, *value.split(), named=named)


def test_damaged_residual_weights(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    weights = tmp_path / "bad.safetensors"
    save_file({"stem.weight": torch.zeros(3)}, weights)
    for content in (weights.read_bytes(), b"not weights", b"", (2**60).to_bytes(8, "little") + b"{}"):
        weights.write_bytes(content)
        expect_refusal(tmp_path, "-i", pair[0], "--depth", pair[1], "--residual", weights, named=weights)


def test_bad_cameras(tmp_path: Path, pair: tuple[Path, Path], scene: Path) -> None:
    given, views = ("-i", pair[0], "--depth", pair[1], "--cameras"), tmp_path / "views.json"
    for text in ("", "null", "[" * 100_000, "\x89PNG", '{"frames": []}'):
        views.write_text(text, encoding="latin-1")
        expect_refusal(tmp_path, *given, views, named=views)
    result = run("predict", *given, camera_file(views, rights=[0.2], focal=1e-20), "-o", tmp_path / "new")
    assert (result.code, str(views) in result.lines[-1], (tmp_path / "new").exists()) == (2, True, False)
    camera_file(views, rights=[0.2, 0.4], sizes=[(64, 48), (32, 24)])
    expect_refusal(tmp_path, *given, views, named="--no-render")
    refuses(run("render", "-i", scene, "-o", tmp_path / "a.mp4", "--cameras", views), views)
    expect_refusal(tmp_path, *given, camera_file(views, rights=[0.2], sizes=[(8194, 48)]), named=views)
    assert not (tmp_path / "a.mp4").exists()


OUTPUTS = ["file", "file/deep", "long", *(["/proc/new"] if Path("/proc/self").exists() else [])]


@pytest.mark.parametrize("kind", OUTPUTS)
def test_outputs_that_cannot_be_written(tmp_path: Path, pair: tuple[Path, Path], scene: Path, kind: str) -> None:
    (tmp_path / "file").write_text("in the way")
    out = tmp_path / "new" / ("x" * 300) if kind == "long" else tmp_path / kind  # an absolute kind stays as it is
    before = names_in(tmp_path)
    refuses(run("predict", "-i", pair[0], "--depth", pair[1], "-o", out, *SHORT), "output folder", "-o")
    (tmp_path / "photos").mkdir()
    shutil.copy(pair[0], tmp_path / "photos")
    refuses(run("predict", "-i", tmp_path / "photos", "--depth", pair[1], "-o", out, *SHORT), "output folder")
    refuses(run("render", "-i", scene, "-o", out, *SHORT), "output folder")
    assert names_in(tmp_path) == {*before, "photos"}
    assert (tmp_path / "file").read_text() == "in the way"


@pytest.mark.parametrize("taken", sorted(FILES))
def test_a_folder_in_the_place_of_a_result(tmp_path: Path, pair: tuple[Path, Path], taken: str) -> None:
    obstacle = tmp_path / "out" / "photo" / taken
    obstacle.mkdir(parents=True)
    refuses(run("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path / "out", *SHORT), obstacle)
    assert names_in(obstacle.parent) == {taken}  # known before the first file was written


def test_a_full_disk_is_one_line(tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    refuses_late = run("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path / "new" / "out", *SHORT)
    assert refuses_late.code == 2
    assert "No space left" in refuses_late.lines[-1]
    assert not (tmp_path / "new").exists()
