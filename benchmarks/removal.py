"""Remove and patch: how close the patch comes to what a removed ball really hid.

    python benchmarks/removal.py --features squeezenet_v1.0.npz -o removal.md --figure removal.jpg

Each rendered scene of `rendered_scenes.py` is rendered with a ball in front of its middle and
without it. The picture with the ball and its depth are lifted to Gaussians, a mask that reaches
3 pixels over the ball's outline removes it, and the hole is patched in three views: the photo's,
one to the left and one to the right. Beside Spackle stand inpainters that paint the holes of each
view by itself. What counts are the pixels that the removal has opened, in the mean of the views:

distance ↓    the masked distance of `spackle evaluate` (SqueezeNet), to the scene without the ball
PSNR ↑        in dB, to the scene without the ball
agreement ↑   in dB: the left view's patch, moved to the right view by the true depth, against the
              right view's own patch
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rendered_scenes
import torch
from PIL import Image
from ray_tracer import ELLIPSOID
from torch import Tensor

import spackle
from spackle import Camera, Gaussians
from spackle.bases.depth import lift_rgbd
from spackle.cli.script_command import check_picture_file, run_script
from spackle.core.filters import maximum_filter
from spackle.depth.depth_map import DepthMap
from spackle.inpaint import InpainterOptions, get_inpainter, known_inverse_depth
from spackle.paper.training.feature_networks import FeatureNet, load_features
from spackle.paper.training.losses import hole_distance, hole_psnr
from spackle.render import get_renderer
from spackle.residual import hole_mask
from spackle.runtime.errors import InputError, unknown_name
from spackle.runtime.files import check_writable

WIDTH, HEIGHT = 320, 240
ROUGH_PX = 3  # how far the mask reaches over the outline
BALL_DEPTH, BALL_RADIUS = 0.6, 0.14  # as fractions of the depth at the picture's middle
EYES = ((0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0))  # in the scene's baselines
SKY_RATIO = 4.0  # the sky is so many times as far as the farthest surface
SAME_SURFACE = 0.02  # relative difference in depth of one surface in two views
PAINTERS = ("opencv", "exemplar")  # each view alone; opencv is Telea's method
RENDERER = get_renderer("cpu")


@dataclasses.dataclass(frozen=True)
class View:
    """One view of a scene: its camera, and the truth without the ball."""

    camera: Camera
    rgb: Tensor  # [H, W, 3] sRGB
    depth: Tensor  # [H, W] z


@dataclasses.dataclass(frozen=True)
class Case:
    """A scene with a ball, as Gaussians of its photo, and what the ball hides."""

    name: str
    gaussians: Gaussians
    mask: Tensor  # [H, W] bool, of the ball in the photo
    views: list[View]  # first the photo's


def read_view(scene: rendered_scenes.Scene, eye: np.ndarray) -> tuple[Tensor, Tensor]:
    """The picture [H, W, 3] and the depth [H, W] of a rendered scene, with a finite sky."""
    rgb, depth = rendered_scenes.render(scene, WIDTH, HEIGHT, eye)
    farthest = depth[np.isfinite(depth)].max()
    finite = np.where(np.isfinite(depth), depth, SKY_RATIO * farthest).astype(np.float32)
    return torch.from_numpy(rgb).float() / 255, torch.from_numpy(finite)


def make_case(make: Callable[[], rendered_scenes.Scene]) -> Case:
    """A scene with a ball before the surface in the picture's middle."""
    scene = make()
    focal = rendered_scenes.focal_of(scene, WIDTH)
    views = []
    for place in EYES:
        eye = scene.baseline * np.array(place)
        camera = Camera.from_focal(focal, WIDTH, HEIGHT)
        pose = torch.eye(4)
        pose[:3, 3] = -torch.tensor(eye, dtype=torch.float32)
        rgb, depth = read_view(scene, eye)
        views.append(View(dataclasses.replace(camera, world_to_camera=pose), rgb, depth))

    middle_depth = float(views[0].depth[HEIGHT // 2, WIDTH // 2])
    in_camera = np.array([0.0, 0.0, BALL_DEPTH * middle_depth])
    radius = BALL_RADIUS * BALL_DEPTH * middle_depth
    center = rendered_scenes.nod(scene.pitch).T @ in_camera
    # Without a shadow, so that the ball changes nothing but what it hides.
    scene.add(
        ELLIPSOID, center, (radius,) * 3,
        rendered_scenes.Look("paint", rendered_scenes.RED), casts=False,
    )  # fmt: skip
    rgb, depth = read_view(scene, np.zeros(3))
    known = torch.ones_like(depth, dtype=torch.bool)
    depth_map = DepthMap(depth, known, None, None, "depth", Path("rendered.npy"))
    base = lift_rgbd(rgb, depth_map, views[0].camera, 0).gaussians
    is_ball = depth < 0.99 * views[0].depth
    return Case(scene.name, base, maximum_filter(is_ball, ROUGH_PX), views)


def agreement(left: View, right: View, pictures: list[Tensor], opened: list[Tensor]) -> float:
    """PSNR in dB between two views' patches, where both show the same point of the truth.

    Args:
        left, right: the two views.
        pictures: [H, W, 3] of both.
        opened: [H, W] bool of both: the pixels of their patches.
    """
    points = right.camera.unproject(right.camera.pixel_centers(), right.depth)
    uv, z = left.camera.project(points)
    column, row = uv[..., 0].floor().long(), uv[..., 1].floor().long()
    inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    column, row = column.clamp(0, WIDTH - 1), row.clamp(0, HEIGHT - 1)
    same = (left.depth[row, column] / z - 1).abs() < SAME_SURFACE
    both = inside & same & opened[1] & opened[0][row, column]
    return hole_psnr(pictures[0][row, column], pictures[1], both)


def measure(
    case: Case, features: FeatureNet | None
) -> tuple[dict[str, list[float]], list[list[Tensor]]]:
    """Distance, PSNR and agreement by method, and rows of pictures for the figure."""
    cameras = [view.camera for view in case.views]
    marked = spackle.marked_gaussians(case.gaussians, [(cameras[0], case.mask)], RENDERER)
    removal = spackle.remove(case.gaussians, marked, cameras, renderer=RENDERER)
    before = [RENDERER.render(case.gaussians, camera) for camera in cameras]
    edited = [RENDERER.render(removal.edited, camera) for camera in cameras]
    holes = [hole_mask(view.alpha) for view in edited]
    opened = [hole & ~hole_mask(view.alpha) for hole, view in zip(holes, before, strict=True)]

    pictures = {"Spackle": [RENDERER.render(removal.patched, camera).rgb for camera in cameras]}
    for name in PAINTERS:
        painter = get_inpainter(name, InpainterOptions(), "fill")
        pictures[name] = [
            painter.paint(view.rgb[None], hole[None], known_inverse_depth(view.depth, hole)[None])[
                0
            ]
            for view, hole in zip(edited, holes, strict=True)
        ]

    results = {}
    for name, views in pictures.items():
        psnrs = []
        distances = []
        for picture, view, hole in zip(views, case.views, opened, strict=True):
            psnrs.append(hole_psnr(picture, view.rgb, hole))
            if features is not None:
                distances.append(hole_distance(features, picture, view.rgb, hole))
        distance = sum(distances) / len(distances) if distances else math.nan
        left, right = case.views[1:]
        matched = agreement(left, right, views[1:], opened[1:])
        results[name] = [distance, sum(psnrs) / len(psnrs), matched]
    shown = [[view.rgb for view in before], [view.rgb for view in edited]]
    return results, [*shown, *pictures.values(), [view.rgb for view in case.views]]


def main() -> None:
    """Measure all scenes, print and write the table, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--features", type=Path, help="SqueezeNet's weights, for the distance")
    parser.add_argument("-o", "--output", type=Path, help="Markdown file")
    parser.add_argument("--figure", type=Path, help="picture file")
    parser.add_argument("--figure-scene", default="still_life", help="its scene")
    parser.add_argument("--only", nargs="*", default=list(rendered_scenes.SCENES))
    words = parser.parse_args()
    for scene in (*words.only, words.figure_scene):
        if scene not in rendered_scenes.SCENES:
            raise InputError(f"scene {scene} is {unknown_name(scene, [*rendered_scenes.SCENES])}")
    if words.output is not None:
        check_writable(words.output)
    if words.figure is not None:
        check_picture_file(words.figure)
    features = None
    if words.features is not None:
        features = load_features("squeezenet", words.features)
    lines = ["| scene | method | distance ↓ | PSNR ↑ | agreement ↑ |", "|---|---|---|---|---|"]
    sums: dict[str, list[float]] = {}
    for key in words.only:
        case = make_case(rendered_scenes.SCENES[key])
        results, rows = measure(case, features)
        for name, figures in results.items():
            lines.append(row_of(case.name, name, figures))
            print(lines[-1], flush=True)
            total = sums.setdefault(name, [0.0, 0.0, 0.0])
            for index, figure in enumerate(figures):
                total[index] += figure / len(words.only)
        if words.figure is not None and key == words.figure_scene:
            # One row a view; from left to right what the rows of `measure` are.
            columns = [torch.cat(views, dim=0) for views in rows]
            sheet = (torch.cat(columns, dim=1).clamp(0, 1) * 255).byte().numpy()
            Image.fromarray(sheet).save(words.figure, quality=88)
    for name, figures in sums.items():
        lines.append(row_of("mean", name, figures))
        print(lines[-1])
    if words.output is not None:
        words.output.write_text("\n".join(lines) + "\n", encoding="utf-8")


def row_of(scene: str, method: str, figures: list[float]) -> str:
    """A row of the table."""
    distance, psnr, matched = figures
    return f"| {scene} | {method} | {distance:.3f} | {psnr:.2f} | {matched:.2f} |"


if __name__ == "__main__":
    sys.exit(run_script(main))
