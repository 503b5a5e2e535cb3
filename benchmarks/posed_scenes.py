"""Write a rendered scene as eight photos with a COLMAP model, to judge scenes of several photos.

    python benchmarks/posed_scenes.py still_life FOLDER     # a name of `rendered_scenes.SCENES`
    python benchmarks/posed_photos.py FOLDER

The model's points lie at strong contrasts, as those of a reconstruction do, 150 chosen in each
photo. Their depths err by 0.15 % and their positions in photos by half a pixel (standard
deviations), and a fifth of the photos that could see a point do not.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rendered_scenes import SCENES, focal_of, render

from spackle.cli.script_command import run_script
from spackle.runtime.errors import InputError
from spackle.runtime.folders import make_folder

Array = NDArray[Any]

WIDTH, HEIGHT = 576, 432  # pixels
# The photos' eyes in baselines of the scene: right, down, forward.
EYES = (
    (0.0, 0.0, 0.0),
    (-2.2, 0.0, 0.0),
    (2.2, 0.0, 0.0),
    (0.0, -1.32, 0.0),
    (-1.1, 0.33, 0.0),
    (1.1, -0.66, 0.66),
    (3.08, -0.44, 0.0),
    (-3.08, -0.44, 0.0),
)
POINTS_PER_PHOTO = 150
TRIED_PIXELS = 20_000  # of which the quarter with the strongest contrast may become points
MARGIN_PX = 3
DEPTH_ERROR = 0.0015
PIXEL_ERROR = 0.5
MISSED_SHARE = 0.2
SEEN_TOLERANCE = 0.03  # relative difference of depths up to which a photo sees a point


def contrast_points(rgb: Array, depth: Array, eye: Array, focal: float, rng: Any) -> Array:
    """[N, 3] points of a photo's surfaces where its contrast is strong, with errors of depth."""
    down, right = np.gradient(rgb.astype(float).mean(2))
    u = rng.integers(MARGIN_PX, WIDTH - MARGIN_PX, TRIED_PIXELS)
    v = rng.integers(MARGIN_PX, HEIGHT - MARGIN_PX, TRIED_PIXELS)
    strongest = np.argsort(-np.hypot(down, right)[v, u])[: TRIED_PIXELS // 4]
    chosen = rng.permutation(strongest)[:POINTS_PER_PHOTO]
    u = u[chosen]
    v = v[chosen]
    z = depth[v, u]
    rays = np.stack([(u + 0.5 - WIDTH / 2) / focal, (v + 0.5 - HEIGHT / 2) / focal], axis=1)
    points = np.concatenate([rays * z[:, None], z[:, None]], axis=1)[np.isfinite(z)]
    errors = rng.normal(0, DEPTH_ERROR, points.shape) * points[:, 2:]
    moved: Array = points + errors + eye
    return moved


def main() -> None:
    """Write the photos and the model."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    model = options.folder / "sparse" / "0"
    photos = options.folder / "images"
    for part in (model, photos):
        if part.exists():
            raise InputError(f"{part}: is there already: give another folder")
    make_folder(options.folder)

    scene = SCENES[options.scene]()
    focal = focal_of(scene, WIDTH)
    rng = np.random.default_rng(0)
    eyes = [scene.baseline * np.array(eye) for eye in EYES]
    views = [render(scene, WIDTH, HEIGHT, eye) for eye in eyes]
    points = np.concatenate(
        [
            contrast_points(rgb, depth, eye, focal, rng)
            for (rgb, depth), eye in zip(views, eyes, strict=True)
        ]
    )

    make_folder(model)
    make_folder(photos)
    lines = []
    for number, ((rgb, depth), eye) in enumerate(zip(views, eyes, strict=True)):
        Image.fromarray(rgb).save(photos / f"{number:03d}.png")
        offsets = points - eye
        places = focal * offsets[:, :2] / offsets[:, 2:] + (WIDTH / 2, HEIGHT / 2)
        observations = []
        for key, (x, y) in enumerate(places):
            is_inside = 0 <= x < WIDTH and 0 <= y < HEIGHT
            if not is_inside or rng.random() < MISSED_SHARE:
                continue
            # What lies in front of the point hides it.
            if abs(depth[int(y), int(x)] / offsets[key, 2] - 1) < SEEN_TOLERANCE:
                x_error, y_error = rng.normal(0, PIXEL_ERROR, 2)
                observations.append(f"{x + x_error} {y + y_error} {key}")
        shift = " ".join(str(-float(part)) for part in eye)
        lines += [f"{number + 1} 1 0 0 0 {shift} 1 {number:03d}.png", " ".join(observations)]
    lens = f"1 PINHOLE {WIDTH} {HEIGHT} {focal} {focal} {WIDTH / 2} {HEIGHT / 2}"
    (model / "cameras.txt").write_text(lens + "\n")
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{key} {x} {y} {z} 0 0 0 0.5" for key, (x, y, z) in enumerate(points)]
    (model / "points3D.txt").write_text("\n".join(rows) + "\n")


if __name__ == "__main__":
    sys.exit(run_script(main))
