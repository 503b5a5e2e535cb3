"""Complete the right view of stereo pairs by the seeds alone, and compare with the true right photo: a Markdown table.

    python benchmarks/stereo_pairs.py FOLDER

FOLDER holds one folder a scene: a left and a right photo, a disparity map and a `scene.json` that names them and gives
disparity_scale, focal_px, cx, cy, doffs_px and baseline_m (see `spackle.bases.depth_maps.load_depth`). Needs OpenCV
for the 2D inpainting beside it: pip install opencv-python-headless.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from spackle import Camera, complete, get_renderer, hole_area_ratio, hole_mask, load_depth, load_photo
from spackle.bases.rgbd import lift
from spackle.scene import scene_path

DISPARITY = 0.3
TELEA_RADIUS = 3
COLUMNS = ["scene", "HAR before", "after / before", "hole: Telea", "hole: Spackle"]
COLUMNS += ["outside: before", "outside: after", "photo", f"photo, scene ±{DISPARITY:g}", "worst end, scene"]


def psnr(image: Tensor, truth: Tensor, where: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB of sRGB images [H, W, 3], over a mask [H, W] where given."""
    error = (image - truth) ** 2
    return float(-10 * torch.log10(error.mean() if where is None else error[where].mean()))


def cameras(facts: dict[str, float], width: int, height: int) -> tuple[Camera, Camera]:
    """The left camera, which is the world's, and the right one beside it."""
    K = torch.tensor([[facts["focal_px"], 0, facts["cx"]], [0, facts["focal_px"], facts["cy"]], [0, 0, 1]])
    right_K, beside = K.clone(), torch.eye(4)
    right_K[0, 2] += facts["doffs_px"]
    beside[0, 3] = -facts["baseline_m"]
    return Camera(K, torch.eye(4), width, height), Camera(right_K, beside, width, height)


def telea(image: Tensor, hole: Tensor) -> Tensor:
    """OpenCV's inpainting of an 8-bit render."""
    pixels, mask = (image.numpy() * 255).round().astype(np.uint8), hole.numpy().astype(np.uint8)
    return torch.from_numpy(cv2.inpaint(pixels, mask, TELEA_RADIUS, cv2.INPAINT_TELEA).astype(np.float32) / 255)


@torch.no_grad()
def measure(folder: Path) -> list[float]:
    """One row of the table, without the name."""
    facts = json.loads((folder / "scene.json").read_text())
    left, right = (load_photo(folder / facts[side]).rgb for side in ("left", "right"))
    camera, beside = cameras(facts, left.shape[1], left.shape[0])
    prediction, renderer = lift(left, load_depth(folder / facts["disparity"]), camera), get_renderer()
    scene = complete(prediction, [beside], exact=True, network=None)
    before, after = renderer.render(scene.base, beside), scene.render(beside)
    hole, photo = hole_mask(before.alpha), renderer.render(scene.base, camera).rgb
    path = scene_path(scene.base, camera, "swipe", DISPARITY)
    swipe = complete(prediction, path, network=None)
    ends = [(renderer.render(scene.base, end).alpha, swipe.render(end).alpha) for end in (path[0], path[-1])]
    har = hole_area_ratio(before.alpha)
    return [
        har,
        hole_area_ratio(after.alpha) / har,
        psnr(telea(before.rgb, hole), right, hole),
        psnr(after.rgb, right, hole),
        psnr(before.rgb, right, ~hole),
        psnr(after.rgb, right, ~hole),
        psnr(scene.render(camera).rgb, photo),
        psnr(swipe.render(camera).rgb, photo),
        max(hole_area_ratio(closed) / hole_area_ratio(open_) for open_, closed in ends),
    ]


def main(root: Path) -> None:
    """Print the table, and the mean of every column."""
    folders = sorted(path.parent for path in root.glob("*/scene.json"))
    if not folders:
        sys.exit(f"{root}: no folder with a scene.json in it")
    print(f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|")
    rows = []
    for folder in folders:
        rows.append(measure(folder))
        print_row(folder.name, rows[-1])
    print_row("mean", [sum(column) / len(rows) for column in zip(*rows, strict=True)])


def print_row(name: str, row: list[float]) -> None:
    """Ratios with their digits, decibels with two."""
    cells = [f"{row[0]:.3f}", f"{row[1]:.4f}", *(f"{value:.2f}" for value in row[2:-1]), f"{row[-1]:.4f}"]
    print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
