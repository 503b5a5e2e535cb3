"""Photos of the user's own in the evaluation: rectified pairs and posed photos."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import DATA
from helpers.command import refuses, run
from helpers.evaluation_data import HEIGHT, WIDTH
from numpy.typing import NDArray
from PIL import Image

from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.image_files import upright_size
from spackle.depth.depth_map import DepthMap
from spackle.depth.readers import load_depth
from spackle.paper.evaluation.datasets import find_dataset, read_cases
from spackle.paper.evaluation.folder import load_run
from spackle.render import get_renderer
from spackle.runtime.errors import InputError

Matrix = NDArray[np.float64]
BOXES = DATA / "boxes" / "0"
# Of this pair: a box before a wall, at disparities of 10 and 4 pixels.
FOCAL_PX = 60.0
BASELINE_M = 0.2
K = [[FOCAL_PX, 0, WIDTH / 2], [0, FOCAL_PX, HEIGHT / 2], [0, 0, 1]]


def write_scene(folder: Path, content: object, *files: str) -> Path:
    """A scene's folder with a scene.json, and with files of the pair of boxes."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scene.json").write_text(json.dumps(content))
    for file in files:
        shutil.copy(BOXES / file, folder / file)
    return folder


def rectified(**more: Any) -> dict[str, Any]:
    return {
        "left": "left.png",
        "right": "right.png",
        "focal_px": FOCAL_PX,
        "baseline_m": BASELINE_M,
        **more,
    }


def turned(seed: int) -> Matrix:
    """A random pose in another world: camera to world, [4, 4]."""
    rng = np.random.default_rng(seed)
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    pose[:3, 3] = rng.normal(size=3)
    return pose


def posed(left_to_world: Matrix, **more: Any) -> dict[str, Any]:
    """The same two photos as posed ones, the first by its pose, the second by the inverse."""
    right_to_left = np.eye(4)
    right_to_left[0, 3] = BASELINE_M
    world_to_right = np.linalg.inv(left_to_world @ right_to_left)
    left = {"file": "left.png", "camera_to_world": left_to_world.tolist()}
    right = {"file": "right.png", "world_to_camera": world_to_right.tolist(), "input": False}
    return {"K": K, "photos": [left | more, right]}


def pixels(file: Path) -> Matrix:
    return np.asarray(Image.open(file).convert("RGB"), np.float64) / 255


def write_metres(path: Path) -> Matrix:
    """Write the left photo's depth as an array of metres."""
    disparity = np.asarray(Image.open(BOXES / "disp.pfm"), np.float64)
    metres: Matrix = BASELINE_M * FOCAL_PX / disparity
    np.save(path, metres.astype(np.float32))
    return metres


def psnr_by_hand(folder: Path) -> float:
    """PSNR of the base's view at the right camera, without any of the evaluation's code."""
    metres = torch.from_numpy(write_metres(folder / "depth.npy")).float()
    camera = Camera(torch.tensor(K), torch.eye(4), WIDTH, HEIGHT)
    depth = DepthMap(metres, metres > 0, None, None, "depth", Path("boxes"))
    left = torch.from_numpy(pixels(BOXES / "left.png")).float()
    to_right = torch.eye(4)
    to_right[0, 3] = -BASELINE_M
    view = get_renderer().render(
        lift_rgbd(left, depth, camera).gaussians,
        Camera(camera.K, to_right, WIDTH, HEIGHT),
    )
    error = np.square(view.rgb.numpy().astype(np.float64) - pixels(BOXES / "right.png"))
    return float(-10 * np.log10(error.mean()))


def evaluated(root: Path, output: Path, *words: object) -> dict[tuple[str, str], float]:
    """The values of near views, by image and method."""
    done = run(
        *("evaluate", root, "--dataset", "pairs", "--protocol", "near-view", "-o", output),
        *("--metrics", "psnr", *words),
    )
    assert done.code == 0, done.err
    run_of_pairs = load_run(output)
    assert run_of_pairs.problems == {}
    return {
        (row.image, row.method): float(row.value or math.nan)
        for row in run_of_pairs.measurements
        if row.metric == "psnr"
    }


def test_own_pairs_and_posed_photos_are_measured_under_their_own_name(tmp_path: Path) -> None:
    root, output = tmp_path / "data", tmp_path / "out"
    write_scene(root / "pair", rectified(disparity="disp.pfm"), *("left.png", "right.png"))
    shutil.copy(BOXES / "disp.pfm", root / "pair")
    folder = write_scene(
        root / "deeper" / "poses", posed(turned(0), depth="depth.npy"), "left.png", "right.png"
    )
    write_metres(folder / "depth.npy")
    description = {"title": "Boxes & more_1", "terms": "CC0: do what you like"}
    (root / "about.json").write_text(json.dumps(description))

    words = ("--base", "rgbd", "--methods", "base,spackle", "--html")
    psnr = evaluated(root, output, *words)
    expected = psnr_by_hand(tmp_path)
    assert 10 < expected < 30  # a picture with holes
    assert psnr["pair", "base"] == pytest.approx(expected, abs=0.02)  # the file has 8 digits
    assert psnr["poses/left", "base"] == pytest.approx(expected, abs=0.02)
    assert psnr["pair", "spackle"] > psnr["pair", "base"] + 3

    # The table has the mean, under the given title; the report has the terms.
    table = (output / "tables.md").read_text()
    mean = (psnr["pair", "base"] + psnr["poses/left", "base"]) / 2
    assert "Boxes & more_1" in table
    assert f"{mean:.2f}" in table
    latex = (output / "tables.tex").read_text()
    assert r"Boxes \& more\_1" in latex
    assert all("&" not in line for line in latex.splitlines() if line.startswith(r"\label"))
    report = (output / "report.html").read_text()
    assert "Boxes &amp; more_1" in report
    assert "CC0: do what you like" in report

    # Another title is another dataset: the folder of the results says what it holds.
    (root / "about.json").write_text(json.dumps(description | {"title": "Other"}))
    near = ("--dataset", "pairs", "--protocol", "near-view", "--metrics", "psnr")
    again = run("evaluate", root, *near, *words[:4], "-o", output)
    assert (again.code, "title" in again.lines[-1]) == (2, True), again.err


def test_a_network_is_scaled_by_the_depth_or_its_range(tmp_path: Path) -> None:
    root = tmp_path / "data"
    photos = ("left.png", "right.png")
    write_scene(root / "map", rectified(disparity="disp.pfm"), *photos, "disp.pfm")
    write_scene(root / "range", rectified(depth_range=[1.2, 3.0]), *photos)
    write_scene(root / "posed", posed(turned(1), depth_range=[1.2, 3.0]), *photos)
    psnr = evaluated(root, tmp_path / "out", "--base", "lite", "--methods", "base")
    assert psnr.keys() == {("map", "base"), ("range", "base"), ("posed/left", "base")}
    assert psnr["range", "base"] == pytest.approx(psnr["posed/left", "base"], abs=0.02)
    assert all(value > 8 for value in psnr.values())

    # Without any depth, near views cannot be placed, and the message says what to give.
    write_scene(tmp_path / "bare" / "pair", rectified(), *photos)
    words = ("--dataset", "pairs", "--base", "lite", "--methods", "base", "--metrics", "psnr")
    done = run(
        *("evaluate", tmp_path / "bare", *words, "--protocol", "near-view"),
        *("-o", tmp_path / "no"),
    )
    assert "depth is unknown" in done.err
    # Large views need none, and have the folder's name as title.
    words = ("--dataset", "pairs", "--base", "lite", "--methods", "base", "--metrics", "none")
    done = run("evaluate", tmp_path / "bare", *words, "-o", tmp_path / "large")
    assert done.code == 0, done.err
    assert load_run(tmp_path / "large").title == "bare"


@pytest.mark.parametrize("seed", range(4))
def test_poses_in_any_world_are_those_of_the_pair(tmp_path: Path, seed: int) -> None:
    photos = ("left.png", "right.png")
    write_scene(tmp_path / "pair" / "a", rectified(disparity="disp.pfm"), *photos, "disp.pfm")
    (pair,) = read_cases("pairs", tmp_path / "pair")
    # K is that of photos of twice the size.
    content = posed(turned(seed), depth="depth.npy")
    content["K"] = [[2 * number for number in row] for row in K[:2]] + [[0, 0, 1]]
    content["size"] = [2 * WIDTH, 2 * HEIGHT]
    folder = write_scene(tmp_path / "posed" / "a", content, *photos)
    write_metres(folder / "depth.npy")
    (case,) = read_cases("pairs", tmp_path / "posed")

    assert case.photo.name == pair.photo.name == "left.png"
    assert pair.read_depth is not None
    assert case.read_depth is not None
    assert torch.allclose(case.read_depth().depth, pair.read_depth().depth, rtol=1e-5)
    assert torch.allclose(case.read_depth().K, pair.read_depth().K)
    for mine, yours in zip(case.second_views, pair.second_views, strict=True):
        camera = mine.camera.resized(WIDTH, HEIGHT)
        assert torch.allclose(camera.K, yours.camera.K)
        assert torch.allclose(camera.world_to_camera, yours.camera.world_to_camera, atol=1e-6)
        assert mine.is_among_nearest


def test_every_photo_is_an_input_unless_its_entry_says_no(tmp_path: Path) -> None:
    content = posed(np.eye(4))
    del content["photos"][1]["input"]
    write_scene(tmp_path / "a", content, "left.png", "right.png")
    cases = read_cases("pairs", tmp_path)
    assert [case.name for case in cases] == ["a/left", "a/right"]
    assert [view.name for view in cases[1].second_views] == ["a/left"]
    position = cases[1].second_views[0].camera.position
    assert position.tolist() == pytest.approx([-BASELINE_M, 0, 0], abs=1e-6)


def test_numbers_of_a_rectified_pair(tmp_path: Path) -> None:
    numbers = {"cx": 30.5, "cy": 20.5, "doffs_px": 2.0, "disparity_scale": 0.5, "invalid": 9}
    folder = write_scene(
        tmp_path / "a", rectified(disparity="map.npy", **numbers), "left.png", "right.png"
    )
    stored = np.full((HEIGHT, WIDTH), 8, np.float32)
    stored[0] = 9
    np.save(folder / "map.npy", stored)
    (case,) = read_cases("pairs", tmp_path)
    assert case.camera is not None
    assert case.camera.K[:2, 2].tolist() == [30.5, 20.5]
    assert case.second_views[0].camera.K[:2, 2].tolist() == [32.5, 20.5]
    assert case.read_depth is not None
    depth = case.read_depth()
    assert not bool(depth.valid[0].any())
    # baseline · focal / (disparity + doffs)
    assert float(depth.depth[1, 1]) == pytest.approx(0.2 * 60 / (8 * 0.5 + 2))
    # The same file describes the pair for `spackle predict --depth`, too.
    assert torch.equal(load_depth(folder / "map.npy").valid, depth.valid)


def test_the_size_of_a_turned_photo_is_the_upright_one(tmp_path: Path) -> None:
    image = Image.new("RGB", (48, 32))
    exif = image.getexif()
    for orientation in range(1, 9):
        exif[0x0112] = orientation
        image.save(tmp_path / "a.jpg", exif=exif)
        assert upright_size(tmp_path / "a.jpg") == ((48, 32) if orientation < 5 else (32, 48))


PHOTO = {"file": "left.png", "camera_to_world": np.eye(4).tolist()}
OTHER = PHOTO | {"file": "right.png"}
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
BAD: list[tuple[object, str]] = [
    ([], "scene.json: holds no JSON object"),
    ({"focal_px": 3}, "scene.json: describes no photos: give left and right"),
    (rectified(focal=3), "scene.json: focal: there is no such key: did you mean focal_px?"),
    (rectified(baseline_m=0), "baseline_m: input should be greater than 0, not 0"),
    (rectified(baseline_m="0.2"), "baseline_m: input should be a valid number, not '0.2'"),
    ({"left": "left.png", "right": "right.png", "focal_px": 60}, "baseline_m: field required"),
    (rectified(right="gone.png"), "scene.json: right: no file gone.png in the scene's folder"),
    (rectified(disparity="gone.pfm"), "scene.json: disparity: no file gone.pfm"),
    (rectified(right="small.png"), "left.png and small.png differ in size"),
    (rectified(depth_range=[3, 1]), "depth_range: give the nearest depth, then the farthest"),
    (rectified(left="scene.json"), "not an image"),
    ({"photos": [PHOTO]}, "photos: list should have at least 2 items"),
    ({"photos": [PHOTO, OTHER]}, "scene.json: left.png: has no K"),
    ({"K": K, "photos": [{"file": "left.png"}, OTHER]}, "give one of world_to_camera and camera"),
    (
        {"K": K, "photos": [PHOTO | {"world_to_camera": MIRROR}, OTHER]},
        "left.png: give one of world_to_camera and camera_to_world",
    ),
    (
        {"K": K, "photos": [PHOTO | {"camera_to_world": MIRROR}, OTHER]},
        "scene.json: left.png: camera_to_world must be a rotation (no scale, no mirror)",
    ),
    (
        {"K": K, "photos": [PHOTO, OTHER | {"camera_to_wold": MIRROR}]},
        "photos.1.camera_to_wold: there is no such key: did you mean photos.1.camera_to_world?",
    ),
    ({"K": K[:2], "photos": [PHOTO, OTHER]}, "scene.json: K.2: field required"),
    ({"K": K, "photos": [PHOTO, PHOTO]}, "several photos are called left: rename them"),
    (
        {"K": K, "photos": [PHOTO | {"input": False}, OTHER | {"input": False}]},
        "no photo is an input",
    ),
    ({"K": K, "photos": [PHOTO | {"depth": "d.npy"}, OTHER]}, "depth of left.png: no file d.npy"),
    (
        {"K": K, "photos": [PHOTO | {"depth": "thin.npy"}, OTHER]},
        "thin.npy is 36×48 but photo",
    ),
]


@pytest.mark.parametrize(("content", "message"), BAD)
def test_a_bad_description_is_one_line(tmp_path: Path, content: object, message: str) -> None:
    folder = write_scene(tmp_path / "a", content, "left.png", "right.png")
    Image.new("RGB", (36, 24)).save(folder / "small.png")
    np.save(folder / "thin.npy", np.ones((HEIGHT, WIDTH // 2), np.float32))
    with pytest.raises(InputError) as caught:
        read_cases("pairs", tmp_path)
    assert message in str(caught.value)
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"title": "Middlebury"}', "about.json: Middlebury is a dataset of the paper"),
        ('{"titel": "Mine"}', "titel: there is no such key: did you mean title?"),
        ('{"title": "two\\nlines"}', "title: string should match pattern"),
        ('{"title": ""}', "title: string should have at least 1 character"),
        ("{", "about.json: not JSON"),
    ],
)
def test_a_bad_title_is_one_line(tmp_path: Path, text: str, message: str) -> None:
    photos = ("left.png", "right.png")
    write_scene(tmp_path / "data" / "a", rectified(disparity="disp.pfm"), *photos, "disp.pfm")
    (tmp_path / "data" / "about.json").write_text(text)
    words = ("--dataset", "pairs", "--base", "rgbd", "--metrics", "none", "-o", tmp_path / "out")
    refuses(run("evaluate", tmp_path / "data", *words), message)


def test_a_folder_named_like_a_dataset_of_the_paper_needs_a_title(tmp_path: Path) -> None:
    photos = ("left.png", "right.png")
    root = tmp_path / "LLFF"
    write_scene(root / "a", rectified(), *photos)
    words = ("--dataset", "pairs", "--base", "lite", "--metrics", "none", "--methods", "base")
    refuses(run("evaluate", root, *words, "-o", tmp_path / "out"), "choose another title in about")


def test_names_of_datasets_that_do_not_exist(tmp_path: Path) -> None:
    for name, message in (
        ("pair", "did you mean pairs?"),
        ("my_module.SET", "did you mean my_module:SET?"),
        ("spackle.paper.evaluation.datasets.eth3d:ETH3", "did you mean ETH3D?"),
        ("spackle.paper.evaluation.datasets.eth3d:eth3d_cases", "no dataset: give an EvalDataset"),
    ):
        with pytest.raises(InputError, match=message.replace("?", r"\?")):
            find_dataset(name)
    assert find_dataset("spackle.paper.evaluation.datasets.eth3d:ETH3D").title == "ETH3D"
