"""Judge scenes of several photos with known cameras by photos that were left out.

    python benchmarks/posed_photos.py FOLDER [--photos 3] [--choices spread near random-1] \\
        [--features squeezenet_v1.0.npz] [-o SHEET.jpg] [--json NUMBERS.json]

FOLDER holds photos and cameras as `spackle predict --posed` reads them. A few photos make a scene;
each other photo is compared with the scene as its camera sees it. The choices of photos are:

spread      those that are farthest from each other, beginning with the most central one
near        the most central one and its nearest neighbours
random-N    drawn by a generator with the seed N

The rows are the scenes:

nearest     the base of the photo whose camera is nearest, at the depths of the points
union       all photos merged
filled      the union with its holes filled

and the columns, each the mean over the photos that were left out:

PSNR        of the whole view, in dB
in holes    PSNR over the pixels that the union leaves open
elsewhere   PSNR over all other pixels
distance    masked perceptual distance in those holes, if --features names the network's weights
holes       share of pixels that the scene leaves open, in percent
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import re
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from spackle.bases.settings import BaseSettings
from spackle.cli.script_command import check_picture_file, run_script
from spackle.core.camera import Camera
from spackle.core.color import to_uint8
from spackle.core.gaussians import Gaussians
from spackle.core.photo import resize_photo
from spackle.paper.training.feature_networks import FeatureNet, load_features
from spackle.paper.training.losses import hole_distance, hole_psnr
from spackle.pipeline import Pipeline, PipelineOptions
from spackle.posed.capture import Capture, PosedFile, read_capture
from spackle.posed.path import central_first
from spackle.posed.scene import PosedScene, complete_posed
from spackle.residual import hole_mask
from spackle.runtime.errors import InputError
from spackle.runtime.files import check_writable
from spackle.runtime.progress import Reporter

CHOICE = re.compile(r"spread|near|random-\d+")  # of photos that make a scene
SCENES = ("nearest", "union", "filled")
COLUMNS = ("PSNR", "in holes", "elsewhere", "distance", "holes")
LEAST_HOLE_PIXELS = 200  # fewer give no PSNR worth the name
PATH_FRAMES = 48  # of the scene's path, whose views are filled


@dataclasses.dataclass(frozen=True)
class LeftOut:
    """A photo that was left out, at its working size."""

    file: PosedFile
    rgb: Tensor  # [H, W, 3] sRGB
    camera: Camera  # in the world


def choose(capture: Capture, choice: str, count: int) -> list[int]:
    """The indices of the photos that make a scene, by the name of a choice."""
    positions = torch.stack([photo.camera.position for photo in capture.photos])
    distances = torch.cdist(positions, positions)
    central = central_first([photo.camera for photo in capture.photos])[0]
    if choice == "near":
        return distances[central].argsort(stable=True)[:count].tolist()
    if choice == "spread":
        chosen = [central]
        while len(chosen) < count:
            chosen.append(int(distances[chosen].min(0).values.argmax()))
        return chosen
    generator = torch.Generator().manual_seed(int(choice.removeprefix("random-")))
    return torch.randperm(len(capture.photos), generator=generator)[:count].tolist()


def load_left_out(file: PosedFile) -> LeftOut:
    """A photo and its camera at the working size."""
    photo = resize_photo(file.load())
    camera = file.camera.resized(photo.width, photo.height).to(dtype=torch.float32)
    return LeftOut(file, photo.rgb, camera)


def nearest_photo(scene: PosedScene, camera: Camera) -> Gaussians:
    """The Gaussians of the photo whose camera is nearest."""
    distances = [float((one.camera.position - camera.position).norm()) for one in scene.photos]
    return scene.photos[distances.index(min(distances))].gaussians


@torch.no_grad()
def measure(
    scene: PosedScene, photo: LeftOut, pipeline: Pipeline, features: FeatureNet | None
) -> tuple[dict[str, dict[str, float]], list[Tensor]]:
    """The figures of a photo that was left out, by scene and column, and the views [H, W, 3]."""
    sets = {
        "nearest": [nearest_photo(scene, photo.camera)],
        "union": [scene.base],
        "filled": [scene.base, scene.aux],
    }
    renderings = {
        name: pipeline.renderer.render(parts, photo.camera) for name, parts in sets.items()
    }
    is_hole = hole_mask(renderings["union"].alpha)
    has_holes = int(is_hole.sum()) >= LEAST_HOLE_PIXELS
    everywhere = torch.ones_like(is_hole)
    figures: dict[str, dict[str, float]] = {}
    for name, rendering in renderings.items():
        rgb = rendering.rgb
        distance = math.nan
        if features is not None and has_holes:
            distance = hole_distance(features, rgb, photo.rgb, is_hole)
        figures[name] = {
            "PSNR": hole_psnr(rgb, photo.rgb, everywhere),
            "in holes": hole_psnr(rgb, photo.rgb, is_hole) if has_holes else math.nan,
            "elsewhere": hole_psnr(rgb, photo.rgb, ~is_hole),
            "distance": distance,
            "holes": 100 * float(hole_mask(rendering.alpha).float().mean()),
        }
    return figures, [photo.rgb, *(renderings[name].rgb for name in SCENES)]


def mean_figures(
    all_figures: Sequence[dict[str, dict[str, float]]],
) -> dict[str, dict[str, float]]:
    """The mean of each figure over photos, of those that have it."""
    means: dict[str, dict[str, float]] = {}
    for scene in SCENES:
        means[scene] = {}
        for column in COLUMNS:
            values = [figures[scene][column] for figures in all_figures]
            known = [value for value in values if math.isfinite(value)]
            means[scene][column] = sum(known) / len(known) if known else math.nan
    return means


def table_row(choice: str, scene: str, figures: dict[str, float]) -> str:
    """A row of the table in Markdown."""
    cells = []
    for column in COLUMNS:
        digits = 3 if column == "distance" else 2
        value = figures[column]
        cells.append(f"{value:.{digits}f}" if math.isfinite(value) else "")
    return f"| {choice} | {scene} | {' | '.join(cells)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--photos", type=int, default=3)
    parser.add_argument("--choices", nargs="+", default=["spread", "near", "random-1"])
    parser.add_argument("--base", default="lite")
    parser.add_argument("--features", type=Path)
    parser.add_argument("--most", type=int, default=1000, help="photos left out that are compared")
    parser.add_argument("-o", "--output", type=Path, help="a sheet of pictures")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()

    for choice in options.choices:
        if CHOICE.fullmatch(choice) is None:
            raise InputError(f"--choices {choice}: choose spread, near or random-N")
    if options.output is not None:
        check_picture_file(options.output)
    if options.json is not None:
        check_writable(options.json)
    features = None
    if options.features is not None:
        features = load_features("squeezenet", options.features, torch.device("cpu"))
    capture = read_capture(options.folder)
    if not 0 < options.photos < len(capture.photos):
        raise InputError(
            f"--photos {options.photos}: {options.folder} has {len(capture.photos)} photos: "
            "give at least 1, and fewer than all"
        )
    pipeline = Pipeline.open(PipelineOptions(base=BaseSettings(name=options.base)))
    print(f"| photos | scene | {' | '.join(COLUMNS)} |")
    print("|---|---|" + "---|" * len(COLUMNS))
    numbers: dict[str, object] = {}
    rows: list[Tensor] = []
    for choice in options.choices:
        chosen = choose(capture, choice, options.photos)
        start = time.process_time()
        scene = complete_posed(
            dataclasses.replace(capture, photos=tuple(capture.photos[i] for i in sorted(chosen))),
            pipeline,
            Reporter(),
            frame_count=PATH_FRAMES,
        )
        seconds = time.process_time() - start
        others = [photo for i, photo in enumerate(capture.photos) if i not in chosen]
        others = others[:: max(1, -(-len(others) // options.most))]
        all_figures = []
        for index, file in enumerate(others):
            figures, views = measure(scene, load_left_out(file), pipeline, features)
            all_figures.append(figures)
            # Of each choice the first and the middle photo are shown.
            if index in (0, len(others) // 2):
                rows.append(torch.cat(views, dim=1))
        means = mean_figures(all_figures)
        for name in SCENES:
            print(table_row(choice, name, means[name]), flush=True)
        numbers[choice] = {
            "photos": [capture.photos[i].name for i in sorted(chosen)],
            "left_out": len(others),
            "cpu_seconds": round(seconds, 1),
            "means": means,
        }
    if options.json is not None:
        options.json.write_text(json.dumps(numbers, indent=1))
    if options.output is not None:
        sheet = np.concatenate([to_uint8(row).numpy() for row in rows])
        Image.fromarray(sheet).save(options.output, quality=92)


if __name__ == "__main__":
    sys.exit(run_script(main))
