"""Complete the right view of stereo pairs by the seeds alone, and compare with the true right photo: a Markdown table.

    python benchmarks/stereo_pairs.py FOLDER

FOLDER holds one folder a scene: a left and a right photo, a disparity map and a `scene.json` that names them and gives
disparity_scale, focal_px, cx, cy, doffs_px and baseline_m (see `spackle.bases.depth_map.load_depth`). Needs OpenCV
for the 2D inpainting beside it: pip install opencv-python-headless.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from spackle import complete, get_renderer, hole_area_ratio, hole_mask
from spackle.bases.lift import lift
from spackle.scene import scene_path
from spackle.training.losses import hole_psnr
from spackle.training.sources import load_pair

DISPARITY = 0.3
TELEA_RADIUS = 3
COLUMNS = ["scene", "HAR before", "after / before", "hole: Telea", "hole: Spackle"]
COLUMNS += ["outside: before", "outside: after", "photo", f"photo, scene ±{DISPARITY:g}", "worst end, scene"]


def telea(image: Tensor, hole: Tensor) -> Tensor:
    """OpenCV's inpainting of an 8-bit render."""
    pixels, mask = (image.numpy() * 255).round().astype(np.uint8), hole.numpy().astype(np.uint8)
    return torch.from_numpy(cv2.inpaint(pixels, mask, TELEA_RADIUS, cv2.INPAINT_TELEA).astype(np.float32) / 255)


@torch.no_grad()
def measure(folder: Path) -> list[float]:
    """One row of the table, without the name."""
    left, right, depth, camera, beside = load_pair(folder)
    prediction, renderer = lift(left, depth, camera), get_renderer()
    scene = complete(prediction, [beside], exact=True, network=None)
    before, after = renderer.render(scene.base, beside), scene.render(beside)
    hole, photo = hole_mask(before.alpha), renderer.render(scene.base, camera).rgb
    path = scene_path(scene.base, camera, "swipe", DISPARITY)
    swipe = complete(prediction, path, network=None)
    ends = [(renderer.render(scene.base, end).alpha, swipe.render(end).alpha) for end in (path[0], path[-1])]
    har, everywhere = hole_area_ratio(before.alpha), torch.ones_like(hole)
    return [
        har,
        hole_area_ratio(after.alpha) / har,
        hole_psnr(telea(before.rgb, hole), right, hole),
        hole_psnr(after.rgb, right, hole),
        hole_psnr(before.rgb, right, ~hole),
        hole_psnr(after.rgb, right, ~hole),
        hole_psnr(scene.render(camera).rgb, photo, everywhere),
        hole_psnr(swipe.render(camera).rgb, photo, everywhere),
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
