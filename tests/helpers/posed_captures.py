"""Photos of a box before a wall, from known places, in the folders of programs that write cameras.

The photos are computed from the definition of a pinhole, and so are the depths and the points. The
world of the files is not that in which the box and the wall were made: it is turned and moved.
"""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from helpers.scenes import Scene, cast
from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.core.gaussians import quat_from_matrix
from spackle.core.photo import Photo
from spackle.depth.depth_map import DepthMap
from spackle.runtime.progress import Progress

WIDTH, HEIGHT, FOCAL = 120, 90, 110.0
WALL_Z, BOX_Z = 4.0, 2.5
BOX_HALF = (0.45, 0.35)  # half of the box's width and height
EYES = ((-0.4, 0.0, 0.0), (0.0, 0.05, 0.0), (0.4, 0.0, 0.1))
LEFT_OUT_EYE = (0.2, -0.05, 0.05)
# What the base of these tests makes of a true inverse depth.
WRONG_SCALE = 2.0
WRONG_SHIFT = 0.1
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])  # between OpenGL's axes at a camera and OpenCV's


def camera_at(eye: tuple[float, float, float]) -> Camera:
    """A camera that looks at the middle between box and wall."""
    start = Camera.from_focal(FOCAL, WIDTH, HEIGHT).to(dtype=torch.float64)
    return start.looking(torch.tensor(eye), torch.tensor([0.0, 0.0, 3.2]))


def paint(points: Tensor, hue: tuple[float, float, float]) -> Tensor:
    """Colours [H, W, 3] of points of a plane: waves of several lengths, so that patches differ."""
    x, y = points[..., 0], points[..., 1]
    waves = [
        torch.sin(11 * x + 5 * y) + torch.sin(29 * x - 23 * y),
        torch.sin(9 * y - 4 * x) + torch.cos(31 * x + 17 * y),
        torch.cos(7 * x + 8 * y) + torch.sin(19 * y),
    ]
    return (torch.tensor(hue) + 0.1 * torch.stack(waves, dim=-1)).clamp(0, 1)


@functools.cache
def view(eye: tuple[float, float, float]) -> Scene:
    """A photo and its exact depth."""
    camera = camera_at(eye)
    on_wall, on_box = cast(camera, WALL_Z), cast(camera, BOX_Z)
    is_box = (on_box[..., 0].abs() < BOX_HALF[0]) & (on_box[..., 1].abs() < BOX_HALF[1])
    points = torch.where(is_box[..., None], on_box, on_wall)
    red, blue = paint(on_box, (0.75, 0.35, 0.25)), paint(on_wall, (0.25, 0.45, 0.7))
    rgb = torch.where(is_box[..., None], red, blue).float()
    return Scene(rgb, camera.to_camera(points)[..., 2].float(), camera)


def world() -> Tensor:
    """The matrix [4, 4] from the scene to the world of the files."""
    turned = Camera.from_focal(1, 2, 2).looking(
        torch.tensor([1.0, -2.0, 0.5]), torch.tensor([3.0, 1.0, 2.0])
    )
    return turned.world_to_camera.double()


def pose(eye: tuple[float, float, float]) -> Tensor:
    """world_to_camera [4, 4] of the files."""
    return camera_at(eye).world_to_camera.double() @ torch.linalg.inv(world())


def sparse_points(count: int = 160) -> Tensor:
    """Points [N, 3] of the scene, on the wall and on the box."""
    rng = np.random.default_rng(3)
    wall = np.c_[rng.uniform([-2, -1.4], [2, 1.4], (count, 2)), np.full(count, WALL_Z)]
    half = np.array(BOX_HALF) * 0.9
    box = np.c_[rng.uniform(-half, half, (count // 3, 2)), np.full(count // 3, BOX_Z)]
    return torch.from_numpy(np.r_[wall, box])


def in_world(points: Tensor) -> Tensor:
    """Points [N, 3] in the world of the files."""
    return points @ world()[:3, :3].T + world()[:3, 3]


def observations(eye: tuple[float, float, float]) -> list[tuple[float, float, int]]:
    """Where a photo sees points: x, y and the point's number."""
    scene = view(eye)
    uv, z = scene.camera.project(sparse_points())
    seen = []
    for key, ((x, y), depth) in enumerate(zip(uv.tolist(), z.tolist(), strict=True)):
        is_inside = 0 <= x < WIDTH and 0 <= y < HEIGHT
        if is_inside and abs(float(scene.depth[int(y), int(x)]) / depth - 1) < 0.02:
            seen.append((x, y, key))
    return seen


def write_photos(folder: Path, suffix: str = ".png") -> list[str]:
    """Write the photos and, into the folder `truth` beside, their depths; returns the names."""
    folder.mkdir(parents=True, exist_ok=True)
    truth = folder.parent / "truth"
    truth.mkdir(exist_ok=True)
    names = []
    for index, eye in enumerate(EYES):
        scene = view(eye)
        pixels = (255 * scene.rgb + 0.5).to(torch.uint8).numpy()
        names.append(f"{index}{suffix}")
        Image.fromarray(pixels).save(folder / names[-1], quality=95)
        np.save(truth / f"{index}.npy", scene.depth.numpy())
    return names


def write_colmap(folder: Path, *, with_points: bool = True) -> Path:
    """Write a COLMAP folder: images and sparse/0, as text."""
    names = write_photos(folder / "images")
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    lens = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}"
    (model / "cameras.txt").write_text(lens + "\n")
    lines = []
    for number, (name, eye) in enumerate(zip(names, EYES, strict=True), 1):
        matrix = pose(eye)
        quat = quat_from_matrix(matrix[:3, :3]).tolist()
        words = [number, *quat, *matrix[:3, 3].tolist(), 1, name]
        lines.append(" ".join(map(str, words)))
        seen = observations(eye) if with_points else []
        lines.append(" ".join(f"{x} {y} {key}" for x, y, key in seen))
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    if with_points:
        rows = [
            f"{key} {x} {y} {z} 0 0 0 0.3"
            for key, (x, y, z) in enumerate(in_world(sparse_points()).tolist())
        ]
        (model / "points3D.txt").write_text("\n".join(rows) + "\n")
    return folder


def opengl(eye: tuple[float, float, float]) -> np.ndarray[Any, Any]:
    """camera_to_world [4, 4] with OpenGL's axes at the camera."""
    matrix: np.ndarray[Any, Any] = np.linalg.inv(pose(eye).numpy()) @ FLIP
    return matrix


def write_nerfstudio(folder: Path) -> Path:
    """Write transforms.json, photos, and a PLY of points without notes of who sees them."""
    names = write_photos(folder / "images")
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": opengl(eye).tolist()}
        for name, eye in zip(names, EYES, strict=True)
    ]
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "w": WIDTH, "h": HEIGHT}
    content = {**lens, "ply_file_path": "sparse_pc.ply", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    rows = in_world(sparse_points()).tolist()
    header = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n"
    header += "property float x\nproperty float y\nproperty float z\nend_header\n"
    text = "".join(f"{x} {y} {z}\n" for x, y, z in rows)
    (folder / "sparse_pc.ply").write_text(header + text)
    return folder


def write_record3d(folder: Path) -> Path:
    """Write metadata.json, photos in rgb, and depth maps in metres of half their size."""
    write_photos(folder / "rgb", ".jpg")
    (folder / "depth").mkdir()
    poses = []
    for index, eye in enumerate(EYES):
        matrix = torch.from_numpy(opengl(eye))
        w, x, y, z = quat_from_matrix(matrix[:3, :3]).tolist()
        poses.append([x, y, z, w, *matrix[:3, 3].tolist()])
        np.save(folder / "depth" / f"{index}.npy", view(eye).depth[::2, ::2].numpy())
    K = [FOCAL, 0, 0, 0, FOCAL, 0, WIDTH / 2, HEIGHT / 2, 1]
    content = {"w": WIDTH, "h": HEIGHT, "K": K, "fps": 30, "poses": poses}
    (folder / "metadata.json").write_text(json.dumps(content))
    return folder


class WrongBase:
    """A base that knows the true surfaces, but with a wrong scale and shift of inverse depth."""

    name = "wrong"

    def predict(self, photo: Photo, progress: Progress | None = None) -> BasePrediction:
        """Gaussians at wrong depths; the true ones lie in the folder `truth`."""
        true_depth = np.load(photo.path.parent.parent / "truth" / f"{photo.path.stem}.npy")
        depth = 1 / (WRONG_SCALE / torch.from_numpy(true_depth) + WRONG_SHIFT)
        depth_map = DepthMap(depth, depth > 0, None, None, "depth", photo.path)
        return lift_rgbd(photo.rgb, depth_map, photo.camera, levels=0)
