"""`spackle predict`: files of a prediction, and folders of photos."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.command import FILES, SHORT, Run, decode, names_in, predicted, refuses, report_of, run
from helpers.photos import (
    HEIGHT,
    WIDTH,
    box,
    camera_file,
    metres,
    picture,
    read_ply,
    write_depth,
    write_photo,
)
from PIL import Image
from safetensors.torch import save_file

import spackle
from spackle.core.focal_length import focal_mm_to_px
from spackle.core.gaussians import Gaussians
from spackle.formats.ply import save_ply
from spackle.pipeline import FillOptions
from spackle.results.results_file import RESULTS_NAME
from spackle.runtime.folders import results_folder
from spackle.scene_fill.unet import UNet
from spackle.weights import published_weights


def hashes(folder: Path) -> dict[str, object]:
    """The records of a report's files, after a check against the files."""
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
    assert (result.out, "\x1b" in result.err) == ("", False)
    assert all(line.startswith(("photo.png: ", "first use: ")) for line in result.lines[:-1])
    assert "aux Gaussians" in result.lines[-2]
    look = f"Look at {folder / 'video.mp4'}, or into the scene: spackle view {folder / 'scene.ply'}"
    assert result.lines[-1] == look
    assert (names_in(folder), names_in(folder.parent)) == (FILES, {"photo"})
    report = report_of(folder)
    whole = read_ply(folder / "scene.ply")
    base, merged = report["base"]["gaussians"], whole.count
    assert f"spackle_base {base}" in whole.comments
    known = {
        "name": "rgbd",
        "chosen": "a depth map is given",
        "gaussians": base,
        "depth_filled": 0.0,
        "usual_disparity": 0.3,
    }
    assert report["base"].items() > known.items()
    assert report["aux"] == {
        "gaussians": merged - base,
        "share": pytest.approx((merged - base) / base),
    }
    assert report["merged"] == merged > base
    assert report["residual"] == {"weights": "shipped", "fill": "exemplar"}
    assert (report["focal_source"], report["mode"], report["disparity"]) == (
        "default 30 mm",
        "scene",
        0.07,
    )
    assert report["focal_px"] == pytest.approx(focal_mm_to_px(30, WIDTH, HEIGHT), abs=1e-3)
    assert report["photo"] == {"file": "photo.png", "width": WIDTH, "height": HEIGHT}
    assert (report["views"], report["disparity_source"]) == ("rotate-forward", "photo")
    assert [view["view"] for view in report["hole_area_ratio"]] == ["-0.07", "+0.07"]
    for view in report["hole_area_ratio"]:
        assert 0.1 < view["before"] < 0.13
        assert view["after"] < 0.01 * view["before"]


def test_a_second_run_replaces_the_first(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    words = (
        "--residual",
        "none",
        "--no-render",
        "--fov",
        90,
        "--keep-base",
        "--depth-out",
        "depth.png",
    )
    predicted(*pair, tmp_path, *words)
    folder = tmp_path / "photo"
    assert names_in(folder) == FILES - {"video.mp4"} | {"base.ply", "depth.png"}
    error = pixels(folder / "depth.png") / 1000 / metres() - 1  # but where the box begins
    assert np.quantile(np.abs(error), 0.9) < 0.01
    report, bare = report_of(folder), read_ply(folder / "scene.ply")
    assert (report["focal_source"], report["focal_px"]) == ("fov", WIDTH / 2)
    row = bare.row(0)
    assert row["x"] / row["z"] * WIDTH / 2 == pytest.approx(0.5 - WIDTH / 2, abs=1e-3)
    assert (report["aux"], report["residual"]) == (
        {"gaussians": 0, "share": 0.0},
        {"weights": "none", "fill": "none"},
    )
    assert bare == read_ply(folder / "base.ply")
    assert all(view["after"] == view["before"] > 0 for view in report["hole_area_ratio"])
    predicted(*pair, tmp_path, "--trajectory", "swipe", "--disparity", "0.5", "--keep-base")
    report = report_of(folder)
    assert (report["views"], [view["view"] for view in report["hole_area_ratio"]]) == (
        "swipe",
        ["-0.5", "+0.5"],
    )
    assert all(view["after"] < 0.01 < view["before"] for view in report["hole_area_ratio"])
    first, whole = (read_ply(folder / name) for name in ("base.ply", "scene.ply"))
    assert (whole.names, whole.body[: len(first.body)]) == (first.names, first.body)  # rule 1


def test_cameras_completes_exactly_the_given_views(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    views = camera_file(tmp_path / "views.json", rights=[0.0, 0.4, -0.4])
    predicted(*pair, tmp_path / "out", "--cameras", views)
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
        drawn = renderer.render(gaussians, camera).rgb.numpy() * 255
        # The file's colours are rounded, as float32 and as 8 bits.
        assert np.abs(pixels(folder / "views" / f"{index:04d}.png") - drawn).max() < 2
        mask = pixels(folder / "views" / f"{index:04d}_mask.png")
        assert mask.mean() / 255 == pytest.approx(report["hole_area_ratio"][index]["before"])


def test_a_file_of_another_program_that_names_the_photo_places_its_views_and_lens(
    tmp_path: Path, pair: tuple[Path, Path]
) -> None:
    # nerfstudio: camera to world, x right, y up, z back. The photo stands at x = 5, turned by 90°
    # about y; the other camera is 0.4 m to its right, which is along the world's -z.
    turned = [[0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
    right = [[0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, -0.4], [0, 0, 0, 1]]
    height, width = pixels(pair[0]).shape[:2]
    frames = [
        {"file_path": "images/photo.png", "transform_matrix": turned},
        {"file_path": "images/other.png", "transform_matrix": right},
    ]
    lens = {"w": 2 * width, "h": 2 * height, "fl_x": 2.4 * width, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(lens))
    done = predicted(*pair, tmp_path / "out", "--cameras", tmp_path / "transforms.json")
    assert "transforms.json: its lengths, in the scale of nerfstudio" in done.out + done.err
    report = report_of(tmp_path / "out" / "photo")
    assert report["focal_source"] == "cameras"
    assert report["focal_px"] == pytest.approx(1.2 * width)
    photo_view, side_view = report["hole_area_ratio"]
    assert photo_view["before"] < 0.02 < 0.05 < side_view["before"]
    # The same view in Spackle's own format shows the same.
    views = tmp_path / "views.json"
    K = [[2.4 * width, 0, width], [0, 2.4 * width, height], [0, 0, 1]]
    pose = [[1, 0, 0, -0.4], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    own = {"frames": [{"K": K, "world_to_camera": pose, "width": 2 * width, "height": 2 * height}]}
    views.write_text(json.dumps(own))
    predicted(*pair, tmp_path / "own", "--cameras", views, "--focal-px", 1.2 * width)
    drawn = pixels(tmp_path / "out" / "photo" / "views" / "0001_base.png").astype(float)
    expected = pixels(tmp_path / "own" / "photo" / "views" / "0000_base.png").astype(float)
    assert np.abs(drawn - expected).max() < 2


def test_view_mode_completes_each_view_on_its_own(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    views = camera_file(
        tmp_path / "views.json", rights=[0.1, 0.4, 0.2], sizes=[(64, 48), (64, 48), (33, 21)]
    )
    predicted(
        *pair, tmp_path / "out", "--cameras", views, "--mode", "view", "--no-render", "--keep-base"
    )
    folder = tmp_path / "out" / "photo"
    assert pixels(folder / "views" / "0002.png").shape == (21, 33, 3)
    report = report_of(folder)
    assert (report["mode"], report["scene_ply_view"]) == ("view", "1")
    assert all(view["after"] == 0 for view in report["hole_area_ratio"])
    base, merged = (read_ply(folder / name) for name in ("base.ply", "scene.ply"))
    assert merged.body[: len(base.body)] == base.body
    # One Gaussian for each 2×2 cell of the view with a hole in it, one for each of its pixels, and
    # one more at most.
    mask = pixels(folder / "views" / "0001_mask.png") > 0
    cells = mask.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).any(axis=(1, 3)).sum()
    assert 0 < report["aux"]["gaussians"] == merged.count - base.count <= 6 * cells


def test_weights_and_texture_are_named_and_change_the_scene(
    tmp_path: Path,
    pair: tuple[Path, Path],
    plain: tuple[Path, Run],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    torch.manual_seed(0)
    weights = tmp_path / "random.safetensors"
    save_file(
        {name: 0.02 * torch.randn_like(value) for name, value in UNet().state_dict().items()},
        weights,
    )
    requests, scenes = list[str](), list[bytes]()
    for words, named, texture in (
        (("--workers", 4), "shipped", "exemplar"),  # a single photo needs none
        (("--fill", "network"), "shipped", "network"),
        (("--fill", "none"), "none", "none"),
        (("--residual", weights), str(weights), "exemplar"),
        (("--residual", "initial"), "initial", "exemplar"),
        ((), "initial", "exemplar"),  # no weights are shipped
    ):
        if not words:
            monkeypatch.setattr("spackle.pipeline.SHIPPED", tmp_path / "none.safetensors")
        predicted(*pair, tmp_path, "--no-render", *words)
        report = report_of(tmp_path / "photo")
        assert report["residual"] == {"weights": named, "fill": texture}
        assert read_ply(tmp_path / "photo" / "scene.ply").row(0) == read_ply(
            plain[0] / "scene.ply"
        ).row(0)
        requests.append(report["request"])
        scenes.append((tmp_path / "photo" / "scene.ply").read_bytes())
    assert scenes[0] == (plain[0] / "scene.ply").read_bytes()
    for found in (requests, scenes):
        assert (found[-2], len(set(found))) == (found[-1], 5)


def test_lama_is_used_if_its_weights_are_downloaded(
    tmp_path: Path, pair: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACKLE_WEIGHTS", str(tmp_path))
    command = ("predict", pair[0], "--depth", pair[1], "-o", tmp_path / "out")
    refuses(run(*command, "--fill", "lama"), "spackle weights get lama")
    (tmp_path / published_weights("lama").file).write_text("not LaMa's")
    choices = (
        FillOptions(),
        FillOptions(mode="view"),
        FillOptions(fill="lama", mode="view"),
        FillOptions(residual="none"),
    )
    assert [choice.texture for choice in choices] == ["lama", "exemplar", "lama", "none"]
    refuses(run(*command), published_weights("lama").file)


@pytest.mark.parametrize("name", ["ü 漢字 🎉.png", "[red]x.png", "a\nb.png", "...png"])
def test_odd_file_names(tmp_path: Path, name: str) -> None:
    photo = write_photo(tmp_path / "in" / "photo.png").rename(tmp_path / "in" / name)
    result = predicted(photo, write_depth(tmp_path / "d.npy"), tmp_path / "out", "--no-render")
    (folder,) = (tmp_path / "out").iterdir()
    assert folder.name == (
        name if name.startswith(".") else Path(name).stem
    )  # inside the output folder
    assert all(name.replace("\n", " ") in line for line in result.lines[:-1])


def test_a_bad_photo_of_a_folder_stops_nothing_else(tmp_path: Path) -> None:
    photos, depths = tmp_path / "photos", tmp_path / "depths"
    for name in ("a.jpg", "a.png", "b.PNG", ".hidden.png", "e.png", "f.png"):
        write_photo(photos / name)
    for name in ("notes.txt", "c.png"):
        (photos / name).write_text("not a photo")
    (photos / "folder.png").mkdir()
    (photos / "d.png").write_bytes((photos / "a.png").read_bytes()[:100])
    for name in ("a.npy", "b.png", "c.npy", "d.npy"):
        write_depth(depths / name)
    write_depth(depths / "f.npy", np.zeros((HEIGHT, WIDTH), np.float32))
    result = run("predict", photos, "--depth", depths, "-o", tmp_path / "out", *SHORT)
    assert result.code == 1, result.err
    assert names_in(tmp_path / "out") == {"a.jpg", "a.png", "b", RESULTS_NAME}
    for name in ("a.jpg", "a.png", "b"):
        assert names_in(tmp_path / "out" / name) == FILES
        assert read_ply(tmp_path / "out" / name / "scene.ply").row(0)["z"] == pytest.approx(
            6, rel=1e-3
        )
    errors = [line for line in result.lines if line.startswith("error: ")]
    assert all(
        bad in line for bad, line in zip(("c.png", "d.png", "e.png", "f.npy"), errors, strict=True)
    )
    assert result.lines[-1] == "4 of 7 photos failed"


def test_a_disk_that_fails_for_one_photo_stops_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a.png", "b.png", "c.png"):
        write_photo(tmp_path / "photos" / name)
        write_depth(tmp_path / "depths" / f"{Path(name).stem}.npy")
    move = os.replace

    def move_or_fail(source: Path, target: Path) -> None:
        if target == tmp_path / "out" / "a" / "scene.ply":
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(source), None, str(target))
        move(source, target)

    def save_or_fail(gaussians: Gaussians, path: Path, **options: Any) -> None:
        if path.parent.parent.name == "b":
            raise MemoryError
        save_ply(gaussians, path, **options)

    monkeypatch.setattr("spackle.runtime.folders.os.replace", move_or_fail)
    monkeypatch.setattr("spackle.results.photo_folder.save_ply", save_or_fail)
    words = ("--depth", tmp_path / "depths", "-o", tmp_path / "out", "--no-render", "--json")
    result = run("predict", tmp_path / "photos", *words)
    errors = [line for line in result.lines if line.startswith("error: ")]
    assert errors == [
        f"error: {tmp_path / 'out' / 'a'}: cannot write: {os.strerror(errno.EIO)}",
        "error: not enough memory to complete b.png: give a smaller photo, or close other programs",
    ]
    assert (result.code, result.lines[-1]) == (1, "2 of 3 photos failed")
    assert names_in(tmp_path / "out") == {"c", "results.jsonl"}
    assert [json.loads(line).get("error") is None for line in result.out.splitlines()] == [
        False,
        False,
        True,
    ]


def test_several_photos_a_folder_and_a_pattern_share_a_run(tmp_path: Path) -> None:
    names = ("a.png", "more/b.jpg", "wild1.png", "wild2.png")
    photos, out = [write_photo(tmp_path / name) for name in names], tmp_path / "out"
    given = (
        photos[0],
        tmp_path / "more",
        tmp_path / "w*[0-9].png",
        "--depth",
        write_depth(tmp_path / "d.npy"),
    )
    result = run("predict", *given, "-o", out, *SHORT)
    folders = {"a", "b", "wild1", "wild2"}
    assert (result.code, names_in(out)) == (0, {*folders, RESULTS_NAME}), result.err
    video, scene = (out / "NAME" / name for name in ("video.mp4", "scene.ply"))
    assert result.lines[-1] == f"Look at {video}, or into the scene: spackle view {scene}"
    refuses(
        run("predict", photos[1], write_photo(tmp_path / "other" / "b.jpg"), "-o", out),
        "has the same name",
    )
    refuses(
        run("predict", photos[0], tmp_path / "a.mp4", "-o", out), "a.mp4: is a clip: give it alone"
    )


def test_what_is_changed_or_damaged_in_a_folder_is_redone(tmp_path: Path) -> None:
    photos, out, depth = tmp_path / "photos", tmp_path / "out", write_depth(tmp_path / "d.npy")
    for name in "abc":
        write_photo(photos / f"{name}.png")

    def redone(*options: object) -> str:
        """The names of the photos that were predicted again."""
        result = predicted(photos, depth, out, "--json", *options)
        lines = [json.loads(line) for line in result.out.splitlines()]
        done = {Path(line["folder"]).name for line in lines if "done_already" in line}
        return "".join(sorted(set("abc") - done))

    assert redone() == "abc"
    assert set(report_of(out / "a")["files"]) == FILES - {"report.json"}
    whole = {name: hashes(out / name) for name in "abc"}
    (out / "b" / "report.json").unlink()  # b was not finished
    (out / "c" / "video.mp4").unlink()
    assert redone() == "bc"
    os.truncate(out / "a" / "scene.ply", 1000)
    data = bytearray((out / "b" / "scene.ply").read_bytes())
    data[-1] ^= 1
    (out / "b" / "scene.ply").write_bytes(data)
    assert redone() == "ab"
    assert {name: hashes(out / name) for name in "abc"} == whole
    assert redone() == ""
    assert redone("--overwrite") == redone("--disparity", "0.2") == "abc"
    write_depth(depth, metres(far=7))
    assert redone("--disparity", "0.2") == "abc"


def test_two_runs_never_share_a_folder(tmp_path: Path, pair: tuple[Path, Path]) -> None:
    out = tmp_path / "out"
    with results_folder(out / "photo", locked=True):
        refuses(
            run("predict", pair[0], "--depth", pair[1], "-o", out, *SHORT),
            out / "photo",
            "another run",
        )
    with results_folder(out, locked=True):
        refuses(
            run("predict", pair[0].parent, "--depth", pair[1], "-o", out, *SHORT),
            out,
            "another run",
        )
    out.mkdir()
    (out / ".lock").touch()  # of a killed run
    predicted(pair[0].parent, pair[1], out)


def test_missing_depth_and_a_map_of_another_size_are_mentioned(tmp_path: Path) -> None:
    depth = np.where(box(640, 480), np.nan, 3).astype(np.float32)
    photo, depth_file = write_photo(tmp_path / "a.png"), write_depth(tmp_path / "d.npy", depth)
    said = predicted(photo, depth_file, tmp_path / "out", "--no-render").err
    assert "% of the depth was missing and has been filled" in said
    assert "the depth map is 640×480, and was resampled" in said


def test_a_frame_is_cut_off_unless_geometry_is_given(tmp_path: Path) -> None:
    photo, out = tmp_path / "a.png", tmp_path / "out"
    Image.fromarray(np.pad(picture(), ((6, 7), (3, 4), (0, 0)))).save(photo)
    lite = ("predict", photo, "-o", out, "--base", "lite", "--no-render", *SHORT)
    cut = run(*lite)
    frame = "a frame (4, 7, 5, 8 pixels: left, top, right, bottom)"
    assert f"a.png: {frame} is cut off; --keep-frame keeps it" in cut.err
    cut_off = {"left": 4, "top": 7, "right": 5, "bottom": 8}  # the outermost pixels are mixed
    inner, whole = (
        {"file": "a.png", "width": WIDTH + w, "height": HEIGHT + h} for w, h in ((-2, -2), (7, 13))
    )
    assert report_of(out / "a")["photo"] == {**inner, "frame_cut_off": cut_off}
    assert "is cut off" not in run(*lite, "--keep-frame").err
    assert report_of(out / "a")["photo"] == whole
    depth = write_depth(tmp_path / "a.npy", np.pad(metres(), ((6, 7), (3, 4)), mode="edge"))
    predicted(photo, depth, out, "--no-render")
    assert report_of(out / "a")["photo"] == whole


def test_photos_of_any_suffix_in_a_folder_are_predicted_and_the_others_named(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    image = Image.fromarray(picture())
    for name, kind in {"a.jfif": "JPEG", "b.bmp": "BMP", "c": "PNG"}.items():
        image.save(folder / name, kind)
    blue = Image.new("RGB", image.size, "blue")
    image.save(folder / "d.gif", save_all=True, append_images=[blue])  # alone, it is a clip
    (folder / "notes.txt").write_text("no photo")
    (folder / "drawing.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n")
    result = run("predict", folder, "-o", tmp_path / "out", "--no-render", "--disparity", "0.05")
    assert result.code == 1
    assert names_in(tmp_path / "out") >= {"a", "b", "c", "d"}
    assert "1 file is no photo, and is left out: notes.txt" in result.err
    assert "drawing.jpg: a PostScript file" in result.err
    assert "d.gif: the file is animated, and its first picture is used" in result.err
