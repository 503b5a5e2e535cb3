"""Cameras of other programs: each row of the table in docs/inputs.md. Points of a world are
projected by the other program's own mathematics, and by the cameras that are read.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.scenes import random_gaussians
from PIL import Image
from rich.console import Console

from spackle.core.camera import Camera
from spackle.core.focal_length import FocalSource
from spackle.core.gaussians import quat_from_matrix
from spackle.core.photo import Photo
from spackle.core.trajectories import DepthRange
from spackle.formats import load_cameras, save_ply
from spackle.formats.camera_readers import camera_source_files, is_path_file, read_camera_set
from spackle.formats.camera_set import CameraSet
from spackle.formats.scene_content import SceneFile
from spackle.render import CpuRenderer
from spackle.results.saved_scene import render_scene
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Reporter
from spackle.video.options import VideoOptions
from spackle.views import GivenPath, PathOptions

Array = np.ndarray[Any, Any]
INPUTS_PAGE = Path(__file__).resolve().parents[2] / "docs" / "inputs.md"
WIDTH, HEIGHT = 320, 240
FX, FY, CX, CY = 300.0, 310.0, 150.5, 118.0


def turn(axis: int, angle: float) -> Array:
    """A rotation [3, 3] about an axis."""
    a, b = [index for index in range(3) if index != axis]
    matrix = np.eye(3)
    matrix[a, a] = matrix[b, b] = math.cos(angle)
    matrix[a, b], matrix[b, a] = -math.sin(angle), math.sin(angle)
    return matrix


@dataclasses.dataclass(frozen=True)
class Pose:
    """A camera in a world of its own: where it is, and where its picture's axes point."""

    eye: Array  # [3]
    right: Array
    down: Array
    forward: Array

    def pixels(
        self, points: Array, fx: float = FX, fy: float = FY, cx: float = CX, cy: float = CY
    ) -> Array:
        """Where points [N, 3] of the world appear, from nothing but the definition of a pinhole."""
        offset = points - self.eye
        depth = offset @ self.forward
        return np.stack(
            [fx * offset @ self.right / depth + cx, fy * offset @ self.down / depth + cy], 1
        )


def pose(index: int) -> Pose:
    rotation = turn(2, 0.3 * index) @ turn(0, 2.0) @ turn(1, 0.2 - 0.1 * index)  # a world with z up
    eye = np.array([0.5 * index, -2.0, 1.0 + 0.1 * index])
    return Pose(eye, *rotation.T)


POSES = [pose(index) for index in range(3)]
NAMES = ["a.jpg", "b.jpg", "c.jpg"]


def world_points(one: Pose) -> Array:
    """Points before a camera."""
    rng = np.random.default_rng(1)
    x, y, z = rng.uniform([-1, -1, 2], [1, 1, 6], (20, 3)).T
    return one.eye + x[:, None] * one.right + y[:, None] * one.down + z[:, None] * one.forward


def opengl(one: Pose) -> Array:
    """camera_to_world [4, 4] of nerfstudio: x right, y up, z back, and the position."""
    matrix = np.eye(4)
    matrix[:3, :4] = np.stack([one.right, -one.down, -one.forward, one.eye], 1)
    return matrix


def nerfstudio(**lens: Any) -> dict[str, Any]:
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": opengl(one).tolist()}
        for one, name in zip(POSES, NAMES, strict=True)
    ]
    usual = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
    return {"camera_model": "OPENCV", **usual, **lens, "frames": frames}


def per_frame() -> dict[str, Any]:
    """nerfstudio's file in which each frame has a lens of its own, and the file a wrong one."""
    content = nerfstudio()
    lens = {name: content[name] for name in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
    for frame in content["frames"]:
        frame |= lens
    return content | {"fl_x": 1.0, "w": 10.0, "h": 10.0}


def inria() -> list[dict[str, Any]]:
    """cameras.json of 3DGS: the position, and camera_to_world as rows."""
    return [
        {
            "id": index,
            "img_name": name.removesuffix(".jpg"),
            "width": WIDTH,
            "height": HEIGHT,
            "position": one.eye.tolist(),
            "rotation": np.stack([one.right, one.down, one.forward], 1).tolist(),
            "fy": FY,
            "fx": FX,
        }
        for index, (one, name) in enumerate(zip(POSES, NAMES, strict=True))
    ]


def record3d() -> dict[str, Any]:
    poses = []
    for one in POSES:
        w, x, y, z = quat_from_matrix(torch.from_numpy(opengl(one)[:3, :3])).tolist()
        poses.append([x, y, z, w, *one.eye.tolist()])
    columns = [FX, 0, 0, 0, FY, 0, CX, CY, 1]
    return {"w": WIDTH, "h": HEIGHT, "K": columns, "fps": 60, "poses": poses}


def polycam(one: Pose) -> dict[str, Any]:
    matrix = opengl(one)
    entry = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
    lens = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "width": WIDTH, "height": HEIGHT}
    return entry | lens | {"blur_score": 1.0}


def viewer_path() -> dict[str, Any]:
    """A path of nerfstudio's viewer: a vertical field of view, no principal point."""
    fov = math.degrees(2 * math.atan(HEIGHT / 2 / FY))
    cameras = [
        {"camera_to_world": opengl(one).ravel().tolist(), "fov": fov, "aspect": WIDTH / HEIGHT}
        for one in POSES
    ]
    size = {"render_width": WIDTH, "render_height": HEIGHT}
    return {"camera_type": "perspective", **size, "fps": 24, "seconds": 3, "camera_path": cameras}


def colmap_quaternion(one: Pose) -> list[float]:
    """world_to_camera as COLMAP has it: qw, qx, qy, qz, tx, ty, tz."""
    rotation = np.stack([one.right, one.down, one.forward])
    w, x, y, z = quat_from_matrix(torch.from_numpy(rotation)).tolist()
    return [w, x, y, z, *(-rotation @ one.eye).tolist()]


def write_colmap(folder: Path, model: str, parameters: list[float], *, binary: bool) -> Path:
    folder.mkdir(parents=True)
    numbers = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}
    # The file's order is not that of the names.
    photos = list(zip([7, 3, 5], POSES, NAMES, strict=True))[::-1]
    if binary:
        lens = struct.pack("<QiiQQ", 1, 1, numbers[model], WIDTH, HEIGHT)
        lens += struct.pack(f"<{len(parameters)}d", *parameters)
        (folder / "cameras.bin").write_bytes(lens)
        data = struct.pack("<Q", len(photos))
        for key, one, name in photos:
            data += struct.pack("<i7di", key, *colmap_quaternion(one), 1) + name.encode() + b"\0"
            data += struct.pack("<Qddq", 1, 3.0, 4.0, -1)
        (folder / "images.bin").write_bytes(data)
    else:
        words = " ".join(map(repr, parameters))
        (folder / "cameras.txt").write_text(f"# lenses\n1 {model} {WIDTH} {HEIGHT} {words}\n")
        lines = ["# photos"]
        for key, one, name in photos:
            lines += [" ".join([str(key), *map(repr, colmap_quaternion(one)), "1", name]), ""]
        (folder / "images.txt").write_text("\n".join(lines))
    return folder


def write(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def of_json(name: str, content: Callable[[], Any]) -> Callable[[Path], Path]:
    return lambda folder: write(folder / name, content())


def in_folder(name: str, content: Callable[[], Any]) -> Callable[[Path], Path]:
    """The folder of the file is given."""
    return lambda folder: write(folder / "scene" / name, content()).parent


def write_polycam(folder: Path) -> Path:
    for one, name in zip(POSES, NAMES, strict=True):
        write(folder / "cameras" / f"{name.removesuffix('.jpg')}.json", polycam(one))
    return folder / "cameras"


def write_synthetic(folder: Path) -> Path:
    """A synthetic scene of NeRF: an angle, names without suffix, and the size of the pictures."""
    content = {"camera_angle_x": 2 * math.atan(WIDTH / 2 / FX), "frames": nerfstudio()["frames"]}
    for frame in content["frames"]:
        frame["file_path"] = "./" + frame["file_path"].removesuffix(".jpg")
    (folder / "images").mkdir()
    for name in NAMES:
        Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / name)
    return write(folder / "transforms_train.json", content)


PINHOLE = [FX, FY, CX, CY]
DISTORTED = [*PINHOLE, 0.1, 0.0, 0.0, 0.0]
MIDDLE = {"cx": WIDTH / 2, "cy": HEIGHT / 2}
SQUARE = {**MIDDLE, "fy": FX}


@dataclasses.dataclass(frozen=True)
class Row:
    """A kind of camera file."""

    write: Callable[[Path], Path]  # writes it into a folder, and returns what the user gives
    kind: str
    lens: dict[str, float] = dataclasses.field(default_factory=dict)  # that differs from the usual
    note: str = ""
    is_named: bool = True
    is_metric: bool = False


ROWS = {
    "transforms.json": Row(of_json("transforms.json", nerfstudio), "nerfstudio"),
    "a folder with transforms.json": Row(in_folder("transforms.json", nerfstudio), "nerfstudio"),
    "a lens for each frame": Row(of_json("transforms.json", per_frame), "nerfstudio"),
    "distortion": Row(
        of_json("transforms.json", lambda: nerfstudio(k1=0.1)), "nerfstudio", note="distortion"
    ),
    "a field of view": Row(write_synthetic, "nerfstudio", SQUARE),
    "a path of the viewer": Row(
        of_json("path.json", viewer_path), "nerfstudio", {**MIDDLE, "fx": FY}, is_named=False
    ),
    "cameras.json": Row(of_json("cameras.json", inria), "3DGS", MIDDLE),
    "a folder with cameras.json": Row(in_folder("cameras.json", inria), "3DGS", MIDDLE),
    "sparse/0, binary": Row(
        lambda folder: write_colmap(folder / "sparse/0", "PINHOLE", PINHOLE, binary=True).parents[
            1
        ],
        "COLMAP",
    ),
    "sparse, text": Row(
        lambda folder: write_colmap(folder / "sparse", "PINHOLE", PINHOLE, binary=False).parent,
        "COLMAP",
    ),
    "the model's folder": Row(
        lambda folder: write_colmap(folder / "model", "PINHOLE", PINHOLE, binary=True), "COLMAP"
    ),
    "a file of the model": Row(
        lambda folder: write_colmap(folder / "m", "PINHOLE", PINHOLE, binary=False) / "images.txt",
        "COLMAP",
    ),
    "distortion of COLMAP": Row(
        lambda folder: write_colmap(folder / "model", "OPENCV", DISTORTED, binary=True),
        "COLMAP",
        note="distortion",
    ),
    "eight numbers of distortion": Row(
        lambda folder: write_colmap(
            folder / "model", "FULL_OPENCV", [*DISTORTED, 0.01, 0.02, 0.03, 0.04], binary=False
        ),
        "COLMAP",
        note="distortion",
    ),
    "shuffled cameras.json": Row(of_json("cameras.json", lambda: inria()[::-1]), "3DGS", MIDDLE),
    "metadata.json": Row(
        of_json("metadata.json", record3d), "Record3D", is_named=False, is_metric=True
    ),
    "a folder of cameras": Row(write_polycam, "Polycam", is_metric=True),
}


@pytest.mark.parametrize("name", ROWS)
def test_points_appear_where_the_other_program_sees_them(name: str, tmp_path: Path) -> None:
    row = ROWS[name]
    path = row.write(tmp_path)
    cameras = read_camera_set(path)
    assert (cameras.kind, cameras.is_metric, len(cameras.cameras)) == (row.kind, row.is_metric, 3)
    assert row.note in " ".join(cameras.notes)
    assert bool(cameras.notes) == bool(row.note)
    for one, camera in zip(POSES, cameras.cameras, strict=True):
        points = world_points(one)
        found, depth = camera.project(torch.from_numpy(points))
        np.testing.assert_allclose(found, one.pixels(points, **row.lens), atol=1e-6)
        assert (depth > 0).all()
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert ([cameras.index_of(name) for name in NAMES] == [0, 1, 2]) == row.is_named
    assert all(file.is_file() for file in camera_source_files(path))
    assert not is_path_file(path)


def test_each_kind_of_camera_file_on_the_page_is_read_in_a_test() -> None:
    section = INPUTS_PAGE.read_text(encoding="utf-8").split("## Cameras")[1].split("\n## ")[0]
    listed = re.findall(r"^\| [^|]+ \|[^|]*\| (.+?) \|$", section, re.MULTILINE)
    named = {name.strip("` ") for cell in listed for name in cell.split(";")} - {"kinds", "---"}
    assert named == set(ROWS)


def relative_pixels(one: Pose, photo: Pose, points: Array) -> Array:
    """Where points in the photo's frame (x right, y down, z forward) appear in another picture."""
    axes = np.stack([photo.right, photo.down, photo.forward])
    return one.pixels(photo.eye + points @ axes)


@pytest.mark.parametrize("name", ["b.jpg", "b.png", "b"])
def test_the_photo_that_a_file_names_is_the_origin(name: str, tmp_path: Path) -> None:
    cameras = read_camera_set(write(tmp_path / "transforms.json", nerfstudio())).around_photo(name)
    points = np.random.default_rng(2).uniform([-1, -1, 9], [1, 1, 12], (9, 3))
    for one, camera in zip(POSES, cameras.cameras, strict=True):
        found, _ = camera.project(torch.from_numpy(points))
        np.testing.assert_allclose(found, relative_pixels(one, POSES[1], points), atol=1e-6)
    torch.testing.assert_close(cameras.cameras[1].world_to_camera, torch.eye(4).double())
    assert "taken as the scene's unit" in " ".join(cameras.lines)
    assert "does not name" not in " ".join(cameras.lines)


@pytest.mark.parametrize("kind", ["nerfstudio", "3DGS"])
def test_a_camera_to_the_right_of_an_unnamed_photo_is_to_its_right(
    kind: str, tmp_path: Path
) -> None:
    # In both files the camera is turned as its world is, and stands at x = 0.1.
    matrix = np.eye(4)
    matrix[0, 3] = 0.1
    content: Any = nerfstudio()
    content["frames"] = [{"file_path": "x.png", "transform_matrix": matrix.tolist()}]
    if kind == "3DGS":
        content = inria()[:1]
        content[0] |= {"position": [0.1, 0, 0], "rotation": np.eye(3).tolist()}
    cameras = read_camera_set(write(tmp_path / "c.json", content)).around_photo("p.png")
    (camera,) = cameras.cameras
    torch.testing.assert_close(camera.position, torch.tensor([0.1, 0, 0]).double())
    torch.testing.assert_close(camera.world_to_camera[:3, :3], torch.eye(3).double())
    assert "does not name p.png" in " ".join(cameras.lines)


def test_a_scene_of_another_program_shares_the_world_of_its_cameras(tmp_path: Path) -> None:
    given = GivenPath(cameras=read_camera_set(write(tmp_path / "cameras.json", inria())))
    foreign = SceneFile(tmp_path / "point_cloud.ply", random_gaussians(3))
    views = given.in_scene(foreign, "point_cloud").views
    assert views is not None
    points = world_points(POSES[2])
    found, _ = views[2].project(torch.from_numpy(points).float())
    np.testing.assert_allclose(found, POSES[2].pixels(points, **MIDDLE), atol=0.01)
    assert views[0].K.dtype == torch.float32
    # A scene of a photo stands at the photo's camera.
    own = dataclasses.replace(foreign, camera=Camera.from_focal(FX, WIDTH, HEIGHT))
    around = given.in_scene(own, "b")
    assert around.views is not None
    torch.testing.assert_close(around.views[1].world_to_camera, torch.eye(4))


def test_the_photos_lens_comes_from_the_file_that_names_it(tmp_path: Path) -> None:
    given = GivenPath(cameras=read_camera_set(write(tmp_path / "transforms.json", nerfstudio())))
    half = torch.zeros(HEIGHT // 2, WIDTH // 2, 3)
    photo = Photo(half, 111.0, FocalSource.EXIF, tmp_path / "b.jpg")
    found = given.with_lens(photo)
    assert (found.focal_px, found.focal_source) == (FX / 2, FocalSource.CAMERAS)
    assert FocalSource.CAMERAS.is_from_user
    for kept in (
        dataclasses.replace(photo, path=tmp_path / "z.jpg"),
        dataclasses.replace(photo, focal_source=FocalSource.FOV),
        dataclasses.replace(photo, rgb=torch.zeros(200, 50, 3)),
    ):
        assert given.with_lens(kept) is kept


def test_nerfstudios_change_of_the_scene_applies_to_its_cameras(tmp_path: Path) -> None:
    write(tmp_path / "transforms.json", nerfstudio())
    rotation, shift, scale = turn(0, 0.4) @ turn(2, 1.0), np.array([1.0, 2, 3]), 0.25
    change = np.concatenate([rotation, shift[:, None]], 1)
    write(tmp_path / "dataparser_transforms.json", {"transform": change.tolist(), "scale": scale})
    cameras = read_camera_set(tmp_path)
    points = world_points(POSES[2])
    moved = scale * (points @ rotation.T + shift)
    found, _ = cameras.cameras[2].project(torch.from_numpy(moved))
    np.testing.assert_allclose(found, POSES[2].pixels(points), atol=1e-6)
    assert "dataparser_transforms.json" in " ".join(cameras.notes)
    assert len(camera_source_files(tmp_path)) == 2


def test_a_path_leads_through_cameras_of_another_program(tmp_path: Path) -> None:
    path = write(tmp_path / "transforms.json", nerfstudio())
    given = PathOptions(path=path).load()
    assert given.cameras is given.keyframes is None
    keyframes = given.around_photo("a.jpg").keyframes
    assert keyframes is not None
    photo = Camera.from_focal(FX, WIDTH, HEIGHT)
    found = keyframes.at([0.0, 1.0, 2.0], photo, DepthRange(1.0, 2.0))
    points = np.random.default_rng(2).uniform([-1, -1, 9], [1, 1, 12], (9, 3))
    for one, camera in zip(POSES, found, strict=True):
        pixels, _ = camera.project(torch.from_numpy(points).float())
        axes = np.stack([POSES[0].right, POSES[0].down, POSES[0].forward])
        world = POSES[0].eye + points @ axes
        np.testing.assert_allclose(pixels, one.pixels(world, FX, FX, **MIDDLE), atol=0.01)


@pytest.mark.parametrize("size", [None, (160, 120)])
def test_a_foreign_scene_is_rendered_from_its_own_cameras(
    size: tuple[int, int] | None, tmp_path: Path
) -> None:
    one = POSES[2]
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = np.stack([one.right, one.down, one.forward])
    world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ one.eye
    before_camera = random_gaussians(200)
    scene = before_camera.transform(torch.from_numpy(np.linalg.inv(world_to_camera)))
    save_ply(scene, tmp_path / "point_cloud.ply")
    path = PathOptions(
        cameras=write(tmp_path / "cameras.json", inria()), video=VideoOptions(size=size)
    )
    said = io.StringIO()
    render_scene(
        tmp_path / "point_cloud.ply",
        tmp_path / "out",
        path,
        Reporter(console=Console(file=said, width=300)),
        device="cpu",
    )
    picture = np.asarray(Image.open(tmp_path / "out" / "0002.png"))
    width, height = size or (WIDTH, HEIGHT)
    scale = width / WIDTH
    K = torch.tensor([[FX * scale, 0, width / 2], [0, FY * scale, height / 2], [0, 0, 1]])
    expected = CpuRenderer().render(before_camera, Camera(K, torch.eye(4), width, height)).rgb
    assert expected.std() > 0.1
    np.testing.assert_allclose(picture / 255, expected, atol=0.02)
    assert "its world is taken as that of point_cloud.ply" in said.getvalue()


def bad_nerf(**lens: Any) -> dict[str, Any]:
    return {key: value for key, value in nerfstudio(**lens).items() if value is not None}


def long_name() -> dict[str, Any]:
    content = bad_nerf(w=None)
    content["frames"][0]["file_path"] = "a" * 5000
    return content


def bad_pose() -> dict[str, Any]:
    content = nerfstudio()
    content["frames"][1]["transform_matrix"][0][0] = 7
    return content


BAD: dict[str, tuple[Any, str]] = {
    "fisheye": (bad_nerf(camera_model="OPENCV_FISHEYE"), "not a pinhole: undistort"),
    "fisheye of instant-ngp": (bad_nerf(is_fisheye=True), "a fisheye, not a pinhole"),
    "no focal length": (bad_nerf(fl_x=None, fl_y=None), "give fl_x or camera_angle_x"),
    "no size": (bad_nerf(w=None), "give w and h"),
    "a name too long": (long_name(), "give w and h"),
    "half a pixel": (bad_nerf(w=320.5), "whole numbers"),
    "no rotation": (bad_pose(), "frame 1: the pose must be a rotation"),
    "a number too few": (
        {"frames": [{"transform_matrix": [[1, 0, 0]] * 4}]},
        "transform_matrix.0.3: ",
    ),
    "orthographic": (viewer_path() | {"camera_type": "equirectangular"}, "'equirectangular'"),
    "no frames a second": (viewer_path() | {"fps": 0}, "fps must be positive"),
    "a list of something": ([{"a": 1}], "transforms.json of nerfstudio"),
    "an empty list": ([], "COLMAP folder"),
    "something else": ({"a": 1}, "cameras.json of 3DGS"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_refused_with_the_reason(name: str, tmp_path: Path) -> None:
    content, says = BAD[name]
    path = write(tmp_path / "c.json", content)
    with pytest.raises(InputError) as caught:
        read_camera_set(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert says in str(caught.value)


def test_what_holds_no_cameras_is_refused_with_what_is_wanted(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"anything")
    fisheye = write_colmap(tmp_path / "model", "OPENCV_FISHEYE", DISTORTED, binary=False)
    binary_fisheye = write_colmap(tmp_path / "model2", "OPENCV_FISHEYE", DISTORTED, binary=True)
    for path, says in (
        (tmp_path, "COLMAP folder"),
        (tmp_path / "photo.jpg", "not a file of cameras"),
        (tmp_path / "none.json", "no such camera file"),
        (fisheye, "not a pinhole: undistort"),
        (binary_fisheye, "camera model OPENCV_FISHEYE is not a pinhole: undistort"),
    ):
        with pytest.raises(InputError, match=re.escape(says)):
            read_camera_set(path)


def test_spackles_own_files_stay_in_the_photos_world(tmp_path: Path) -> None:
    frame = {"K": [[FX, 0, CX], [0, FY, CY], [0, 0, 1]], "world_to_camera": np.eye(4).tolist()}
    path = write(tmp_path / "c.json", {"width": WIDTH, "height": HEIGHT, "frames": [frame]})
    cameras = read_camera_set(path)
    assert cameras.origin is None
    assert cameras.around_photo("a.jpg") is cameras
    assert torch.equal(cameras.views()[0].K, load_cameras(path)[0].K)
    assert not is_path_file(path)  # it may be a path, too


def test_two_pictures_of_a_name_name_no_photo() -> None:
    camera = Camera.from_focal(FX, WIDTH, HEIGHT).to(dtype=torch.float64)
    cameras = CameraSet(
        source=Path("c"),
        kind="COLMAP",
        cameras=(camera, camera),
        names=("left/a.jpg", "right/a.jpg"),
        origin=torch.eye(4, dtype=torch.float64),
    )
    assert cameras.index_of("a.jpg") is None
