"""`spackle predict`: what a prediction leaves behind, folders, and one line where something is wrong."""

from __future__ import annotations

import hashlib
import os
import shutil
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
from spackle.bases.open import open_base
from spackle.bases.settings import BaseSettings
from spackle.folders import results_folder
from spackle.gaussians import Gaussians
from spackle.image import film_to_pixels, load_photo
from spackle.pipeline import FillOptions
from spackle.residual import ResidualNet
from spackle.residual.network import shipped_network
from spackle.scene_fill import FillContext, exemplar_texture, fill_scene
from spackle.weights import published_weights


def hashes(folder: Path) -> dict[str, object]:
    """What a report says of its files, once that is found true."""
    files = report_of(folder)["files"]
    for name, record in files.items():
        data = (folder / name).read_bytes()
        assert record == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    return dict(files)


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image)


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
    assert report["residual"] == {"weights": "shipped", "fill": "exemplar"}
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


def test_the_same_input_gives_the_same_bytes(tmp_path: Path, plain: tuple[Path, Run]) -> None:
    predicted(*write_pair(tmp_path), tmp_path / "out")
    again = tmp_path / "out" / "photo"
    for name in ("base.ply", "scene.ply"):
        assert (again / name).read_bytes() == (plain[0] / name).read_bytes()
    first, second = report_of(plain[0]), report_of(again)
    for report in (first, second):
        del report["seconds"]
    assert first == second


def test_a_second_run_replaces_the_first(tmp_path: Path) -> None:
    photo, depth = write_pair(tmp_path)
    predicted(photo, depth, tmp_path, "--residual", "none", "--no-render")
    assert names_in(tmp_path / "photo") == FILES - {"video.mp4"}
    report, bare = report_of(tmp_path / "photo"), read_ply(tmp_path / "photo" / "scene.ply")
    assert (report["aux"], report["residual"]) == ({"gaussians": 0, "share": 0.0}, {"weights": "none", "fill": "none"})
    assert ("video" in report["seconds"], report["video"]) == (False, None)
    assert bare == read_ply(tmp_path / "photo" / "base.ply")
    assert all(view["after"] == view["before"] > 0 for view in report["hole_area_ratio"])
    predicted(photo, depth, tmp_path, "--trajectory", "swipe", "--disparity", "0.5")
    report = report_of(tmp_path / "photo")
    assert (report["views"], [view["view"] for view in report["hole_area_ratio"]]) == ("swipe", ["-0.5", "+0.5"])
    assert all(view["after"] < 0.01 < view["before"] for view in report["hole_area_ratio"])
    assert read_ply(tmp_path / "photo" / "scene.ply").count > bare.count
    assert names_in(tmp_path / "photo") == FILES


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
    # One Gaussian for each 2×2 cell of the view with a hole in it, one for each of its pixels, and one more at most.
    mask = pixels(folder / "views" / "0001_mask.png") > 0
    cells = mask.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).any(axis=(1, 3)).sum()
    assert 0 < report["aux"]["gaussians"] <= 6 * cells


def test_the_seeds_alone_can_be_had_and_fill_the_holes_where_no_weights_came_with_the_package(
    tmp_path: Path, plain: tuple[Path, Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    predicted(*write_pair(tmp_path), tmp_path / "asked", "--residual", "seeds")
    report = report_of(tmp_path / "asked" / "photo")
    assert report["residual"]["weights"] == "seeds"
    assert "no trained weights" in report["residual"]["note"]
    monkeypatch.setattr("spackle.pipeline.SHIPPED", tmp_path / "none.safetensors")
    predicted(*write_pair(tmp_path), tmp_path / "without")
    seeds, without = (tmp_path / name / "photo" / "scene.ply" for name in ("asked", "without"))
    assert seeds.read_bytes() == without.read_bytes()
    assert seeds.read_bytes() != (plain[0] / "scene.ply").read_bytes()
    torch.manual_seed(0)
    weights = tmp_path / "random.safetensors"
    save_file({name: 0.02 * torch.randn_like(value) for name, value in ResidualNet().state_dict().items()}, weights)
    predicted(*write_pair(tmp_path), tmp_path / "named", "--residual", weights)
    assert report_of(tmp_path / "named" / "photo")["residual"]["weights"] == str(weights)
    assert (tmp_path / "named" / "photo" / "base.ply").read_bytes() == (plain[0] / "base.ply").read_bytes()
    assert (tmp_path / "named" / "photo" / "scene.ply").read_bytes() != seeds.read_bytes()


@pytest.mark.parametrize("fill", ["none", "network", "exemplar"])
def test_the_texture_of_the_fill_is_chosen_named_and_part_of_what_is_asked_for(
    tmp_path: Path, plain: tuple[Path, Run], fill: str
) -> None:
    photo, depth = write_pair(tmp_path)
    views = camera_file(tmp_path / "views.json", rights=[0.4])
    requests = []
    for chosen in ("auto", fill):
        predicted(photo, depth, tmp_path, "--cameras", views, "--no-render", "--fill", chosen)
        requests.append(report_of(tmp_path / "photo")["request"])
    report, camera = report_of(tmp_path / "photo"), spackle.load_cameras(views)[0]
    assert report["residual"] == {"weights": "none" if fill == "none" else "shipped", "fill": fill}
    assert (requests[0] == requests[1]) == (fill == "exemplar")  # which is what auto comes to
    base = open_base(BaseSettings(depth=depth)).predict(load_photo(photo))[0]
    texture = exemplar_texture if fill == "exemplar" else None
    context = FillContext(base.gaussians, base.camera, spackle.get_renderer(), shipped_network(), texture)
    aux = Gaussians.empty() if fill == "none" else fill_scene(context, [camera], exact=True).aux
    assert report["aux"]["gaussians"] == len(aux)
    drawn = spackle.get_renderer().render([base.gaussians, aux], camera).rgb
    assert np.abs(pixels(tmp_path / "photo" / "views" / "0000.png") - 255 * drawn.numpy()).max() <= 0.51


def test_lamas_weights_are_painted_with_where_they_are_and_missed_where_they_are_named(
    tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    expect_refusal(tmp_path, "-i", pair[0], "--depth", pair[1], "--fill", "lama", named="spackle weights get lama")
    assert (FillOptions().texture, FillOptions(None, "network").texture) == ("exemplar", "network")
    (tmp_path / published_weights("lama").file).write_text("not LaMa's")
    choices = (
        FillOptions(),
        FillOptions(mode="view"),
        FillOptions(None, "lama", "view"),
        FillOptions("none"),
    )
    assert [choice.texture for choice in choices] == ["lama", "exemplar", "lama", "none"]
    expect_refusal(tmp_path, "-i", pair[0], "--depth", pair[1], named=published_weights("lama").file)


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


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        *(
            (name, Path(name).stem)
            for name in ("a b.png", "ü 漢字 🎉.png", "[red]x.png", "a\nb.png", "%s.png", "-.png")
        ),
        *((name, name) for name in ("..png", "...png", ".png")),  # none leads out of the output
    ],
)
def test_odd_file_names(tmp_path: Path, name: str, folder: str) -> None:
    photo = write_photo(tmp_path / "in" / "photo.png").rename(tmp_path / "in" / name)
    result = predicted(photo, write_depth(tmp_path / "d.npy"), tmp_path / "out" / "deep")
    assert names_in(tmp_path) == {"in", "out", "d.npy"}
    assert names_in(tmp_path / "out") == {"deep"}
    assert names_in(tmp_path / "out" / "deep" / folder) == FILES
    assert all(name.replace("\n", " ") in line for line in result.lines)


def test_a_folder_of_photos_with_a_folder_of_depths_where_a_bad_photo_stops_nothing_else(tmp_path: Path) -> None:
    photos, depths = tmp_path / "photos", tmp_path / "depths"
    for name in ("a.jpg", "a.png", "a.jpg.png", "b.PNG", ".hidden.png", "e.png", "f.png"):
        write_photo(photos / name)
    (photos / "notes.txt").write_text("not a photo")
    (photos / "folder.png").mkdir()
    (photos / "c.png").write_text("not a photo")
    (photos / "d.png").write_bytes((photos / "a.png").read_bytes()[:100])
    for name in ("a.npy", "b.png", "c.npy", "d.npy"):
        write_depth(depths / name)
    write_depth(depths / "a.jpg.npy", metres(far=9))
    write_depth(depths / "f.npy", np.zeros((HEIGHT, WIDTH), np.float32))
    result = run("predict", "-i", photos, "--depth", depths, "-o", tmp_path / "out", *SHORT)
    assert result.code == 1, result.err
    assert names_in(tmp_path / "out") == {"a.jpg", "a.png", "a.jpg.png", "b"}  # none collide
    for name in names_in(tmp_path / "out"):
        assert names_in(tmp_path / "out" / name) == FILES
        far = 9 if name.startswith("a.jpg") else 6
        assert read_ply(tmp_path / "out" / name / "base.ply").row(0)["z"] == pytest.approx(far, rel=1e-3)
    errors = [line for line in result.lines if line.startswith("error: ")]
    for line, culprit in zip(errors, ("c.png", "d.png", "e.png", "f.npy"), strict=True):
        assert culprit in line
    assert result.lines[-1] == "4 of 8 photos failed"


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
    disparity = write_depth(tmp_path / "disp0.npy")
    for focal in (80, 90):
        calibration(tmp_path / "calib.txt", focal, 200, 0)
        for map_, options in ((depth, ()), (disparity, ()), (depth, ("--stereo", "ou")), (depth, ("--format", "gif"))):
            predicted(photos, map_, out, *options)
            assert redone() == {"a", "b", "c"}


def test_a_report_vouches_for_its_files_alone(tmp_path: Path) -> None:
    photos, out, depth = tmp_path / "photos", tmp_path / "out", write_depth(tmp_path / "d.npy")
    for name in "abc":
        write_photo(photos / f"{name}.png")
    predicted(photos, depth, out)
    assert set(report_of(out / "a")["files"]) == FILES - {"report.json"}
    whole = {name: hashes(out / name) for name in "abc"}
    shutil.copytree(out, tmp_path / "copy")  # all files are newer than their reports, which then read them
    assert sum("done already" in line for line in predicted(photos, depth, tmp_path / "copy").lines) == 3
    os.truncate(out / "a" / "scene.ply", 1000)
    data = bytearray((out / "b" / "scene.ply").read_bytes())
    data[-1] ^= 1
    (out / "b" / "scene.ply").write_bytes(data)
    result = predicted(photos, depth, out)
    assert [line for line in result.lines if "done already" in line] == [
        "c.png: done already (--overwrite does it again)"
    ]
    assert {name: hashes(out / name) for name in "abc"} == whole


@pytest.mark.parametrize("failing", ["save_views", "write_json"])
def test_an_interrupted_run_leaves_the_old_set_whole(
    tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    predicted(*pair, tmp_path)
    before = hashes(tmp_path / "photo")
    monkeypatch.setattr(f"spackle.cli.photo.{failing}", interrupted)
    assert run("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path, "--disparity", "0.5", *SHORT).code == 130
    assert hashes(tmp_path / "photo") == before
    assert names_in(tmp_path / "photo") == FILES


def test_two_runs_never_share_a_folder(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    out = tmp_path / "out"
    with results_folder(out / "photo", alone=True):
        refuses(run("predict", "-i", pair[0], "--depth", pair[1], "-o", out, *SHORT), out / "photo", "another run")
        predicted(write_photo(tmp_path / "other.png"), pair[1], out)  # beside it is room
    with results_folder(out, alone=True):
        refuses(run("predict", "-i", pair[0].parent, "--depth", pair[1], "-o", out, *SHORT), out, "another run")
    assert names_in(out) == {"other"}
    (out / ".lock").touch()  # of a killed run
    predicted(pair[0].parent, pair[1], out)


def expect_refusal(tmp_path: Path, *arguments: object, named: object) -> None:
    """`spackle predict` that must fail before it leaves anything in a new folder."""
    out = tmp_path / "new" / "out"
    refuses(run("predict", "-o", out, *shortened(arguments)), named)
    assert not out.parent.exists()


def test_missing_depth_and_a_map_of_another_size_are_taken(tmp_path: Path) -> None:
    depth = np.where(box(640, 480), np.nan, 3).astype(np.float32)
    predicted(write_photo(tmp_path / "a.png"), write_depth(tmp_path / "d.npy", depth), tmp_path / "out")
    base = report_of(tmp_path / "out" / "a")["base"]
    assert WIDTH * HEIGHT / 2 < base["gaussians"] <= 1.5 * WIDTH * HEIGHT
    assert base["depth_filled"] == pytest.approx(box().mean(), abs=0.02)
    assert base["depth_resampled_from"] == "640×480"


def test_a_frame_is_cut_off_photo_and_depth_and_can_be_kept(tmp_path: Path) -> None:
    photo, depth, out = tmp_path / "a.png", tmp_path / "a.npy", tmp_path / "out"
    whole = np.pad(picture(), ((6, 7), (3, 4), (0, 0)))
    Image.fromarray(whole).save(photo)
    write_depth(depth, np.pad(metres(), ((6, 7), (3, 4)), constant_values=1))
    result = predicted(photo, depth, out, "--no-render")
    assert "a.png: a dark frame (4, 7, 5, 8 pixels: left, top, right, bottom)" in result.lines[0]
    cut_off = {"left": 4, "top": 7, "right": 5, "bottom": 8, "shade": "dark"}  # the outermost pixels are mixed
    inner = {"width": WIDTH - 2, "height": HEIGHT - 2}
    assert report_of(out / "a")["photo"] == {"file": "a.png", **inner, "frame_cut_off": cut_off}
    Image.fromarray(picture()[1:-1, 1:-1]).save(photo)
    predicted(photo, write_depth(depth, metres()[1:-1, 1:-1]), tmp_path / "plain", "--no-render")
    for file in ("base.ply", "scene.ply"):
        assert (out / "a" / file).read_bytes() == (tmp_path / "plain" / "a" / file).read_bytes()
    Image.fromarray(whole).save(photo)
    kept = run("predict", "-i", photo, "-o", out, "--base", "lite", "--keep-frame", "--no-render", *SHORT)
    assert "uniform" not in kept.err
    assert report_of(out / "a")["photo"] == {"file": "a.png", "width": WIDTH + 7, "height": HEIGHT + 13}


def test_depth_maps_that_do_not_go_with_the_photo(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    wrong = write_depth(tmp_path / "wrong.npy", metres(48, 64))
    expect_refusal(tmp_path, "-i", pair[0], "--depth", wrong, named=wrong)
    long = tmp_path / ("x" * 300)  # a name that no file system takes
    expect_refusal(tmp_path, "-i", long, "--depth", pair[1], named=long)
    expect_refusal(tmp_path, "-i", pair[0], "--depth", long, named=long)
    disparity = pair[1].rename(tmp_path / "disp0.npy")  # without a calibration
    expect_refusal(tmp_path, "-i", pair[0], "--depth", disparity, named=disparity)
    expect_refusal(tmp_path, "-i", pair[0], "--base", "rgbd", named="--depth")


@pytest.mark.parametrize("kind", ["missing", "empty", "text", "an empty folder", "a pipe"])
def test_files_that_are_no_photo_and_no_depth_map(tmp_path: Path, kind: str) -> None:
    bad = tmp_path / "bad.png"
    if kind == "a pipe":
        os.mkfifo(bad)
    elif kind == "an empty folder":
        bad.mkdir()
    elif kind != "missing":
        bad.write_text("a photo" if kind == "text" else "")
    expect_refusal(tmp_path, "-i", bad, "--depth", write_depth(tmp_path / "d.npy"), named=bad)
    expect_refusal(tmp_path, "-i", write_photo(tmp_path / "a.png"), "--depth", bad, named=bad)


def test_bad_cameras(tmp_path: Path, pair: tuple[Path, Path], scene: Path) -> None:
    given, views = ("-i", pair[0], "--depth", pair[1], "--cameras"), tmp_path / "views.json"
    views.write_text('{"frames": []}')
    expect_refusal(tmp_path, *given, views, named=views)
    result = run("predict", *given, camera_file(views, rights=[0.2], focal=1e-20), "-o", tmp_path / "new")
    assert (result.code, str(views) in result.lines[-1], (tmp_path / "new").exists()) == (2, True, False)
    camera_file(views, rights=[0.2, 0.4], sizes=[(64, 48), (32, 24)])
    expect_refusal(tmp_path, *given, views, named="--no-render")
    refuses(run("render", "-i", scene, "-o", tmp_path / "a.mp4", "--cameras", views), views)
    expect_refusal(tmp_path, *given, camera_file(views, rights=[0.2], sizes=[(8194, 48)]), named=views)
    assert not (tmp_path / "a.mp4").exists()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        *((("--focal-px", value), "--focal-px") for value in ("-50", "nan", "1e39", "50 --fov 60")),
        *((("--focal-mm", value), "--focal-mm") for value in ("0", "1e308")),
        *((("--fov", value), "--fov") for value in ("0", "180")),
        *((("--disparity", value), "--disparity") for value in ("-0.1", "2.1", "nan")),
        *((("--frames", value), "--frames") for value in ("0", "1000000")),
        (("--precision", "bf16"), "--precision"),
        (("--sharp", "windows=1"), "--sharp windows=1"),
        (("--base", "sharp9"), "--base"),
        (("--device", "cuda"), "--device"),
        (("-c", "weights.pt"), "-c"),
        (("--residual", "nowhere.safetensors"), "nowhere.safetensors"),
        (("--residual", "bad.safetensors"), "bad.safetensors"),
        (("--cameras", "nowhere.json"), "nowhere.json"),
        (("--calib", "nowhere.txt"), "nowhere.txt"),
    ],
)
def test_bad_options(
    tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, options: tuple[str, str], named: str
) -> None:
    monkeypatch.chdir(tmp_path)
    save_file({"stem.weight": torch.zeros(3)}, "bad.safetensors")
    option, value = options
    expect_refusal(tmp_path, "-i", pair[0], "--depth", pair[1], option, *value.split(), named=named)


@pytest.mark.parametrize("kind", ["file", "file/deep", "long", *sorted(FILES)])
def test_outputs_that_cannot_be_written(tmp_path: Path, pair: tuple[Path, Path], scene: Path, kind: str) -> None:
    (tmp_path / "file").write_text("in the way")
    out = tmp_path / "new" / ("x" * 300) if kind == "long" else tmp_path / kind
    if kind in FILES:  # a folder in the place of a result
        (tmp_path / "out" / "photo" / kind).mkdir(parents=True)
        refuses(run("predict", "-i", pair[0], "--depth", pair[1], "-o", tmp_path / "out", *SHORT), kind)
        assert names_in(tmp_path / "out" / "photo") == {kind}  # known before the first file was written
        return
    before = names_in(tmp_path)
    refuses(run("predict", "-i", pair[0], "--depth", pair[1], "-o", out, *SHORT), "output folder", "-o")
    refuses(run("render", "-i", scene, "-o", out, *SHORT), "output folder")
    assert names_in(tmp_path) == before
    assert (tmp_path / "file").read_text() == "in the way"
