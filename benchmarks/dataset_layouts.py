"""Write rendered scenes in the layouts of the paper's datasets, each with an about.json.

about.json gives the scenes a name of their own, so that no table or figure calls them by the name
of the dataset whose layout they have.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rendered_scenes import Scene, focal_of, render
from skimage import data as pictures

from spackle.paper.evaluation.datasets import stereo

Array = NDArray[Any]

POINT_STEP = 6  # a COLMAP model has a point at every sixth pixel of the first photo
SEEN_TOLERANCE = 0.02  # relative difference of depths up to which a photo sees a point
HALF_PIXEL = 0.5  # some datasets have pixel centres at integers
MM_PER_M = 1000

# The second views' eyes in baselines of the scene: right, down, forward.
SECOND_EYES = ((1.0, 0.0, 0.0), (-1.0, -0.4, 0.3))


class Frame(NamedTuple):
    """A rendered photo with exact depth; all photos of a scene look into the same direction."""

    rgb: Array  # [H, W, 3] bytes
    depth: Array  # [H, W] metres, inf in the sky
    eye: Array  # [3] right, down, forward of the first photo's eye, in metres
    focal: float  # in pixels

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        height, width = self.depth.shape
        return width, height


def render_frames(scene: Scene, width: int, count: int) -> list[Frame]:
    """A scene's first photo and `count` - 1 second ones, 4 to 3."""
    frames = []
    for place in ((0.0, 0.0, 0.0), *SECOND_EYES)[:count]:
        eye = scene.baseline * np.array(place)
        rgb, depth = render(scene, width, width * 3 // 4, eye)
        frames.append(Frame(rgb, depth, eye, focal_of(scene, width)))
    return frames


def save_image(path: Path, image: Array) -> None:
    """Write a picture; missing folders are created. JPEGs keep the colours at full resolution."""
    path.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {}
    if path.suffix == ".jpg":
        options = {"quality": 95, "subsampling": 0}
    Image.fromarray(image).save(path, **options)


def write_about(folder: Path, title: str, about: str) -> None:
    """Write about.json: the scenes' own name, and what they are."""
    text = json.dumps({"title": title, "about": about}, indent=1, ensure_ascii=False)
    (folder / "about.json").write_text(text + "\n", encoding="utf-8")


# --- the layouts


def write_middlebury(root: Path) -> None:
    """Write Middlebury's Motorcycle, as scikit-image brings it, with a scene.json."""
    folder = root / "Motorcycle"
    library: Any = pictures  # scikit-image has no types
    left, right, disparity = library.stereo_motorcycle()
    save_image(folder / "left.png", left)
    save_image(folder / "right.png", right)
    np.save(folder / "disparity.npy", disparity)
    facts = {
        "left": "left.png",
        "right": "right.png",
        "disparity": "disparity.npy",
        "focal_px": stereo.MOTORCYCLE_FOCAL_PX,
        "cx": stereo.MOTORCYCLE_CX_PX,
        "cy": stereo.MOTORCYCLE_CY_PX,
        "doffs_px": stereo.MOTORCYCLE_DOFFS_PX,
        "baseline_m": stereo.MOTORCYCLE_BASELINE_M,
    }
    (folder / "scene.json").write_text(json.dumps(facts))


def write_booster(root: Path, frames: Sequence[Frame]) -> None:
    """Write a stereo pair as Booster does: OpenCV's calibration, millimetres, disparities."""
    folder = root / "train" / "balanced" / "Scene"
    left, right = frames[:2]
    width, height = left.size
    baseline = float(right.eye[0])
    save_image(folder / "camera_00" / "im0.png", left.rgb)
    save_image(folder / "camera_02" / "im0.png", right.rgb)
    np.save(folder / "disp_00.npy", (left.focal * baseline / left.depth).astype(np.float32))

    cx, cy = width / 2 - HALF_PIXEL, height / 2 - HALF_PIXEL
    numbers = f"{left.focal} 0 {cx} 0 0 {left.focal} {cy} 0 0 0 1 0"
    matrix = f"<rows>3</rows><cols>4</cols><data>{numbers}</data>"
    sides = f"<proj_matL>{matrix}</proj_matL><proj_matR>{matrix}</proj_matR>"
    distance = f"<baselineLR>{MM_PER_M * baseline}</baselineLR>"
    text = f"<opencv_storage>{sides}{distance}</opencv_storage>"
    (folder / "calib_00-02.xml").write_text(text)


def write_wildrgbd(root: Path, frames: Sequence[Frame]) -> None:
    """Write frames as WildRGB-D does: depth in millimetres, poses, and K column by column."""
    folder = root / "toy" / "scenes" / "scene_000"
    poses = []
    for number, frame in enumerate(frames):
        save_image(folder / "rgb" / f"{number:05d}.png", frame.rgb)
        depth_mm = np.where(np.isfinite(frame.depth), MM_PER_M * frame.depth, 0)
        save_image(folder / "depth" / f"{number:05d}.png", depth_mm.round().astype(np.uint16))
        right, down, forward = frame.eye
        poses.append(f"{number} 1 0 0 {right} 0 1 0 {down} 0 0 1 {forward} 0 0 0 1")
    (folder / "cam_poses.txt").write_text("\n".join(poses) + "\n")

    width, height = frames[0].size
    focal = frames[0].focal
    K = [focal, 0, 0, 0, focal, 0, width / 2 - HALF_PIXEL, height / 2 - HALF_PIXEL, 1]
    (folder / "metadata").write_text(json.dumps({"w": width, "h": height, "K": K}))


def write_tanks(root: Path, frames: Sequence[Frame]) -> None:
    """Write photos and a COLMAP model in the layout of Tanks and Temples."""
    folder = root / "Scene"
    _write_colmap(folder / "images", folder / "sparse" / "0", frames)


def write_eth3d(root: Path, frames: Sequence[Frame]) -> None:
    """Write photos and a COLMAP model in ETH3D's layout."""
    folder = root / "scene"
    subfolder = "dslr_images_undistorted"
    model = folder / "dslr_calibration_undistorted"
    _write_colmap(folder / "images" / subfolder, model, frames, f"{subfolder}/")


def write_llff(root: Path, frames: Sequence[Frame]) -> None:
    """Write photos, poses and bounds as LLFF does.

    A row has the columns down, right, backwards, eye, and (height, width, focal length), and then
    the nearest and the farthest depth.
    """
    folder = root / "scene"
    rows = []
    for number, frame in enumerate(frames):
        save_image(folder / "images_4" / f"image{number:03d}.png", frame.rgb)
        width, height = frame.size
        right, down, forward = frame.eye
        matrix = [
            [0, 1, 0, right, height],
            [1, 0, 0, down, width],
            [0, 0, -1, forward, frame.focal],
        ]
        known = frame.depth[np.isfinite(frame.depth)]
        rows.append([*np.ravel(matrix), known.min(), known.max()])
    np.save(folder / "poses_bounds.npy", np.array(rows))


def _write_colmap(photos: Path, model: Path, frames: Sequence[Frame], prefix: str = "") -> None:
    """Write photos, and a COLMAP model as text with points of the first photo.

    Args:
        photos: the folder for the photos.
        model: the folder for the model.
        frames: the photos.
        prefix: what stands before the photos' names in the model.
    """
    first = frames[0]
    width, height = first.size
    v, u = np.mgrid[POINT_STEP // 2 : height : POINT_STEP, POINT_STEP // 2 : width : POINT_STEP]
    z = first.depth[v, u]
    x = (u + 0.5 - width / 2) * z / first.focal
    y = (v + 0.5 - height / 2) * z / first.focal
    points = np.stack([x, y, z], axis=-1)[np.isfinite(z)]  # [N, 3] in metres

    images = []
    for number, frame in enumerate(frames, 1):
        name = f"{number:03d}.jpg"
        save_image(photos / name, frame.rgb)
        shift = " ".join(str(-float(part)) for part in frame.eye)
        images.append(f"{number} 1 0 0 0 {shift} 1 {prefix}{name}")
        images.append(" ".join(_seen_points(frame, points)))

    model.mkdir(parents=True)
    camera = f"1 PINHOLE {width} {height} {first.focal} {first.focal} {width / 2} {height / 2}"
    (model / "cameras.txt").write_text(camera + "\n")
    (model / "images.txt").write_text("\n".join(images) + "\n")
    lines = [f"{key} {px} {py} {pz} 0 0 0 0.1" for key, (px, py, pz) in enumerate(points)]
    (model / "points3D.txt").write_text("\n".join(lines) + "\n")


def _seen_points(frame: Frame, points: Array) -> list[str]:
    """For each point that a photo sees: its place in pixels, and its number."""
    width, height = frame.size
    offset = points - frame.eye
    place = frame.focal * offset[:, :2] / offset[:, 2:] + (width / 2, height / 2)
    observations = []
    for key, (x, y) in enumerate(place):
        if not (0 <= x < width and 0 <= y < height):
            continue
        # What lies in front of the point hides it.
        seen_depth = frame.depth[int(y), int(x)]
        if abs(seen_depth / offset[key, 2] - 1) < SEEN_TOLERANCE:
            observations.append(f"{x} {y} {key}")
    return observations
