"""`spackle predict --posed`: photos with known cameras in the folders of several programs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.command import names_in, report_of, run
from helpers.posed_captures import (
    EYES,
    LEFT_OUT_EYE,
    camera_at,
    pose,
    view,
    world,
    write_colmap,
    write_nerfstudio,
    write_photos,
    write_record3d,
)
from helpers.scenes import psnr
from PIL import Image

import spackle
from spackle.core.camera import Camera
from spackle.formats.scene_files import load_scene
from spackle.render import CpuRenderer
from spackle.scene import Scene

# Knows the true surfaces, but in a wrong unit: only points can bring them to their places.
WRONG_BASE = ("--base", "helpers.posed_captures:WrongBase")
SHORT = ("--frames", "8", "--fill", "exemplar")
POSED_FILES = {"scene.ply", "cameras.json", "video.mp4", "report.json"}


def predicted(folder: Path, *options: object) -> Path:
    """Run the command successfully; returns the folder of results."""
    result = run("predict", "--posed", folder, "-o", folder.parent / "out", *SHORT, *options)
    assert result.code == 0, result.err
    return folder.parent / "out" / folder.name


def left_out_psnr(results: Path) -> float:
    """How well the scene shows the place of a photo that nobody gave, in dB."""
    lens = camera_at(LEFT_OUT_EYE)
    camera = Camera(lens.K, pose(LEFT_OUT_EYE), lens.width, lens.height).to(dtype=torch.float32)
    gaussians = load_scene(results / "scene.ply").gaussians
    return psnr(CpuRenderer().render(gaussians, camera).rgb, view(LEFT_OUT_EYE).rgb)


@pytest.fixture(scope="module")
def colmap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results of a COLMAP folder, which no test may change."""
    folder = write_colmap(tmp_path_factory.mktemp("colmap") / "room")
    return predicted(folder, *WRONG_BASE)


def test_a_colmap_folder_becomes_one_scene_in_colmaps_world(colmap: Path) -> None:
    assert names_in(colmap) == POSED_FILES
    assert left_out_psnr(colmap) > 20
    report = report_of(colmap)
    assert report["cameras"] == {"kind": "COLMAP", "photos": 3}
    assert [photo["depth_from"] for photo in report["photos"]] == ["COLMAP's points"] * 3
    assert all(photo["depth_error"] < 0.02 for photo in report["photos"])
    assert report["photos"][0]["file"] == "1.png"  # the most central one
    assert report["merged"] == report["union"]["gaussians"] + report["aux"]["gaussians"]
    assert not report["is_metric"]
    assert all(view["after"] < 0.02 for view in report["hole_area_ratio"])
    scene = load_scene(colmap / "scene.ply")
    assert scene.base_count == report["union"]["gaussians"]


def test_the_scene_opens_at_the_most_central_photo(colmap: Path) -> None:
    scene = Scene.load(colmap / "scene.ply")
    rendering = CpuRenderer().render(scene.gaussians, scene.camera)
    assert psnr(rendering.rgb, view(EYES[1]).rgb) > 25


def test_the_cameras_beside_the_scene_and_those_of_the_folder_share_its_world(
    colmap: Path, tmp_path: Path
) -> None:
    own_folder = colmap.parent.parent / "room"
    for cameras in (colmap / "cameras.json", own_folder):
        result = run("render", colmap / "scene.ply", "--cameras", cameras, "-o", tmp_path / "views")
        assert result.code == 0, result.err
        names = ["1.png", "0.png", "2.png"] if cameras.suffix else ["0.png", "1.png", "2.png"]
        for index, name in enumerate(names):
            with Image.open(tmp_path / "views" / f"{index:04d}.png") as image:
                shown = torch.from_numpy(np.array(image)).float() / 255
            assert psnr(shown, view(EYES[int(name[0])]).rgb) > 22


def test_a_second_run_does_nothing_and_a_killed_one_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_colmap(tmp_path / "room")
    command = ("predict", "--posed", folder, "-o", tmp_path / "out", *SHORT, *WRONG_BASE)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("spackle.posed.predict.save_video", killed)
        assert run(*command).code == 130
    assert not POSED_FILES & names_in(tmp_path / "out" / "room")
    resumed = run(*command)
    assert resumed.code == 0
    assert resumed.err.count("predicted by an earlier run") == 3
    assert names_in(tmp_path / "out" / "room") == POSED_FILES
    report = (tmp_path / "out" / "room" / "report.json").read_bytes()
    again = run(*command)
    assert "done already" in again.err
    assert (tmp_path / "out" / "room" / "report.json").read_bytes() == report
    # Another photo is another request.
    shutil.copy(folder / "images" / "0.png", folder / "images" / "2.png")
    assert "done already" not in run(*command).err


def test_points_of_nerfstudio_need_no_notes_of_who_sees_them(tmp_path: Path) -> None:
    results = predicted(write_nerfstudio(tmp_path / "nerf"), *WRONG_BASE)
    assert left_out_psnr(results) > 20
    report = report_of(results)
    assert [photo["depth_from"] for photo in report["photos"]] == ["nerfstudio's points"] * 3


def test_without_points_patches_that_photos_share_give_the_scale(tmp_path: Path) -> None:
    results = predicted(write_colmap(tmp_path / "room", with_points=False), *WRONG_BASE)
    assert left_out_psnr(results) > 18
    report = report_of(results)
    assert [photo["depth_from"] for photo in report["photos"]] == ["matched patches"] * 3


def test_measured_depth_beside_the_photos_is_lifted(tmp_path: Path) -> None:
    results = predicted(write_record3d(tmp_path / "phone"))
    assert left_out_psnr(results) > 20
    report = report_of(results)
    assert report["is_metric"]
    assert [photo["depth_from"] for photo in report["photos"]] == ["depth map"] * 3


def test_python_gives_the_scene(tmp_path: Path) -> None:
    folder = write_record3d(tmp_path / "phone")
    scene = spackle.predict_posed(folder, fill="none")
    assert len(scene.aux) == 0
    assert list(scene.cameras) == ["1.jpg", "0.jpg", "2.jpg"]
    scene.save(tmp_path / "scene.html")  # the page of the viewer
    assert b"<title>" in (tmp_path / "scene.html").read_bytes()
    scene.save(tmp_path / "scene.ply")
    loaded = load_scene(tmp_path / "scene.ply")
    assert loaded.base_count == len(scene.base)
    centre = loaded.gaussians.means.double().median(0).values
    back = torch.linalg.inv(world()) @ torch.cat([centre, torch.ones(1)]).double()
    assert 2 < float(back[2]) < 5  # between box and wall


def no_photos(folder: Path) -> Path:
    write_colmap(folder)
    shutil.rmtree(folder / "images")
    return folder


def one_photo(folder: Path) -> Path:
    write_colmap(folder)
    for name in ("0.png", "2.png"):
        (folder / "images" / name).unlink()
    return folder


def no_cameras(folder: Path) -> Path:
    write_photos(folder / "images")
    return folder


def turned_photos(folder: Path) -> Path:
    write_colmap(folder)
    for file in (folder / "images").iterdir():
        with Image.open(file) as image:
            upright = image.transpose(Image.Transpose.ROTATE_90)
        upright.save(file)
    return folder


def nameless_cameras(folder: Path) -> Path:
    write_photos(folder / "images")
    K = camera_at(EYES[0]).K.tolist()
    frames = [
        {"K": K, "world_to_camera": pose(eye).tolist(), "width": 120, "height": 90} for eye in EYES
    ]
    (folder / "cameras.json").write_text(json.dumps({"frames": frames}))
    return folder


def one_place(folder: Path) -> Path:
    write_colmap(folder)
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    words = lines[0].split()
    for row in (2, 4):
        name = lines[row].split()[-1]
        lines[row] = " ".join([str(row), *words[1:9], name])
    file.write_text("\n".join(lines) + "\n")
    return folder


def foreign_points(folder: Path) -> Path:
    write_colmap(folder)
    rng = np.random.default_rng(5)
    file = folder / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    for row in (1, 3, 5):
        keys = rng.permutation([int(word) for word in lines[row].split()[2::3]])
        uv = rng.uniform([0, 0], [120, 90], (len(keys), 2))
        lines[row] = " ".join(f"{x} {y} {key}" for (x, y), key in zip(uv, keys, strict=True))
    file.write_text("\n".join(lines) + "\n")
    points = folder / "sparse" / "0" / "points3D.txt"
    eyes = np.linalg.inv(pose(EYES[1]).numpy())
    far = rng.uniform(0.3, 40, 300)
    rows = []
    for key, z in enumerate(far):
        x, y, z_world = (eyes @ [*(rng.uniform(-0.4, 0.4, 2) * z), z, 1])[:3]
        rows.append(f"{key} {x} {y} {z_world} 0 0 0 0.3")
    points.write_text("\n".join(rows) + "\n")
    return folder


REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no cameras": (no_cameras, "holds no cameras"),
    "no photos": (no_photos, "no photo with a camera"),
    "one photo": (one_photo, "one photo with a camera"),
    "turned photos": (turned_photos, "90×120, but its camera is of a picture of 120×90"),
    "cameras without names": (nameless_cameras, "its cameras name no photos"),
    "one place": (one_place, "all cameras stand at one place"),
    "points of another scene": (foreign_points, "fewer than two photos agree with their cameras"),
    "no folder": (lambda folder: folder, "no such folder"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_folder_that_gives_no_scene_is_refused_with_the_reason(name: str, tmp_path: Path) -> None:
    make, reason = REFUSED[name]
    folder = make(tmp_path / "room")
    result = run("predict", "--posed", folder, "-o", tmp_path / "out", *SHORT, *WRONG_BASE)
    assert result.code == 2, result.err
    assert reason in result.err
    assert not (tmp_path / "out").exists()


def test_photos_and_cameras_without_the_other_are_left_out_with_a_line(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "room")
    (folder / "images" / "2.png").rename(folder / "images" / "unknown.png")
    result = run("predict", "--posed", folder, "-o", tmp_path / "out", *SHORT, *WRONG_BASE)
    assert result.code == 0, result.err
    assert "2.png without a photo: left out" in result.err
    assert "unknown.png without a camera: left out" in result.err


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("photo.png",), "names the photos"),
        (("--trajectory", "swipe"), "--trajectory: with --posed"),
        (("--depth", "depth"), "--depth: not with --posed"),
        (("--fov", "60"), "--fov: not with --posed"),
        (("--workers", "2"), "--workers: not with --posed"),
    ],
)
def test_options_that_contradict_known_cameras_are_refused(
    options: tuple[str, ...], reason: str, tmp_path: Path
) -> None:
    folder = write_colmap(tmp_path / "room")
    result = run("predict", *options, "--posed", folder, "-o", tmp_path / "out")
    assert result.code == 2
    assert reason in result.err


def test_predict_without_photos_says_what_it_needs() -> None:
    result = run("predict")
    assert result.code == 2
    assert "give photos, folders of photos, one clip, or --posed FOLDER" in result.err
