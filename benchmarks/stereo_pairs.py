"""Completed views of stereo pairs beside the true right photo: seeds, trained weights, 2D inpainting; Markdown tables.

    python benchmarks/stereo_pairs.py FOLDER [--residual FILE] [--features squeezenet_v1.0.npz]

FOLDER holds one folder a scene: a left and a right photo, a disparity map and a `scene.json` that names them and gives
disparity_scale, focal_px, cx, cy, doffs_px and baseline_m (see `spackle.training.sources.load_pair`). The first table
completes the right camera's view: HAR, PSNR in the hole (beside Telea's inpainting: pip install
opencv-python-headless) and outside of it, PSNR at the photo's own camera, with --features the perceptual distance in
the hole (`spackle.training.distance.hole_distance`). The second completes whole swipes in one scene and looks at their
ends: HAR before and after, and PSNR at the photo's camera.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from spackle import Completer, Gaussians, get_renderer, hole_area_ratio, hole_mask
from spackle.bases.lift import lift
from spackle.inpaint.opencv import OpenCV
from spackle.residual import ResidualNet
from spackle.residual.network import SHIPPED, load_residual
from spackle.scene import scene_path
from spackle.training.features import FeatureNet, load_features
from spackle.training.losses import hole_distance, hole_psnr
from spackle.training.sources import load_pair

DISPARITIES = (0.3, 0.4, 0.5)
FRAMES = 60
TELEA_RADIUS = 3
COLUMNS = ["HAR before", "HAR after / before: seeds", "trained", "hole: Telea", "seeds", "trained", "outside: base"]
COLUMNS += ["seeds", "trained", "photo: seeds", "trained"]
SWIPES = [f"{d:g}: {what}" for d in DISPARITIES for what in ("HAR before", "after", "worst end", "photo")]


class Scene:
    """A pair, lifted, with a completer for each way of filling."""

    def __init__(self, folder: Path, network: ResidualNet) -> None:
        self.name, self.renderer = folder.name, get_renderer()
        left, self.right, depth, self.camera, self.beside = load_pair(folder)
        self.base = lift(left, depth, self.camera).gaussians
        self.photo = self.renderer.render(self.base, self.camera).rgb
        ways = {"seeds": None, "trained": network}
        self.ways = {name: Completer(self.base, self.camera, self.renderer, net) for name, net in ways.items()}

    def pair(self, features: FeatureNet | None) -> list[float]:
        """Numbers of the right camera's view."""
        before = self.renderer.render(self.base, self.beside)
        hole, har = hole_mask(before.alpha), hole_area_ratio(before.alpha)
        found = [way.completed_view(self.beside, rendering=before) for way in self.ways.values()]
        views = [view.rgb for _, view in found]
        filled = [OpenCV("this").inpaint(before.rgb, hole, TELEA_RADIUS), *views]
        numbers = [har, *(hole_area_ratio(view.alpha) / har for _, view in found)]
        numbers += [hole_psnr(rgb, self.right, hole) for rgb in filled]
        numbers += [hole_psnr(rgb, self.right, ~hole) for rgb in (before.rgb, *views)]
        numbers += [self.photo_psnr(aux) for aux, _ in found]
        if features is not None:
            numbers += [hole_distance(features, rgb, self.right, hole) for rgb in views]
        return numbers

    def swipes(self) -> list[float]:
        """Numbers of the ends of swipes, each completed in one scene with the trained weights."""
        numbers = []
        for disparity in DISPARITIES:
            path = scene_path(self.base, self.camera, "swipe", disparity, FRAMES)
            aux = self.ways["trained"].complete_scene(path)
            sets = ([self.base], [self.base, aux])
            before, after = (
                [hole_area_ratio(self.renderer.render(part, end).alpha) for end in (path[0], path[-1])] for part in sets
            )
            worst = max(closed / opened for opened, closed in zip(before, after, strict=True))
            numbers += [sum(before) / 2, sum(after) / 2, worst, self.photo_psnr(aux)]
        return numbers

    def photo_psnr(self, aux: Gaussians) -> float:
        """Of the completed scene at the photo's own camera, against the base's render there."""
        view = self.renderer.render([self.base, aux], self.camera).rgb
        return hole_psnr(view, self.photo, torch.ones(view.shape[:2], dtype=torch.bool))


def print_table(columns: Sequence[str], scenes: Sequence[Scene], measure: Callable[[Scene], list[float]]) -> None:
    """Markdown, each row as soon as it is there, and the mean of each column."""
    print(f"\n| scene | {' | '.join(columns)} |\n|---{'|---' * len(columns)}|", flush=True)
    rows: list[list[float]] = []
    for scene in scenes:
        rows.append(measure(scene))
        print_row(scene.name, rows[-1])
    print_row("mean", torch.tensor(rows, dtype=torch.float64).mean(0).tolist())


def print_row(name: str, values: Sequence[float]) -> None:
    print(f"| {name} | {' | '.join(f'{v:.4f}' if v < 1 else f'{v:.2f}' for v in values)} |", flush=True)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--residual", type=Path, default=SHIPPED)
    parser.add_argument("--features", type=Path, help="SqueezeNet 1.0's weights")
    chosen = parser.parse_args()
    features = None if chosen.features is None else load_features("squeezenet", chosen.features)
    network = load_residual(chosen.residual)
    scenes = [Scene(path.parent, network) for path in sorted(chosen.folder.glob("*/scene.json"))]
    if not scenes:
        parser.error(f"{chosen.folder}: no folder with a scene.json in it")
    more = [] if features is None else ["distance: seeds", "trained"]
    print_table([*COLUMNS, *more], scenes, lambda scene: scene.pair(features))
    print_table(SWIPES, scenes, Scene.swipes)


if __name__ == "__main__":
    main()
