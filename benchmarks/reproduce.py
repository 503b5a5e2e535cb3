"""The paper's whole experiment in miniature, on two cores in minutes, without a download.

    python benchmarks/reproduce.py -o reproduction

Each command that a reader would type is printed and run; docs/reproduction.md has them at the
paper's size. What is shown:

- Real photos come first: Middlebury's Motorcycle with its measured depth (base `rgbd`), and three
  photos of scikit-image with depth by the package's own small networks (base `lite`).
- The layouts of the paper's other datasets hold rendered scenes, which are called so everywhere.
- SHARP's weights cannot be had without a download. Where the experiment trains SHARP itself, or a
  network that starts from it, a stand-in takes its place, which is called so everywhere, too.
"""

from __future__ import annotations

import argparse
import os
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import dataset_layouts as layouts
import numpy as np
import rendered_scenes
import torch
from PIL import Image
from reproduced_claims import FILE as CLAIMS_FILE
from reproduced_claims import claims_of_folder
from sharp_stand_in import write_stand_in
from skimage import data as pictures

from spackle.cli.script_command import run_script
from spackle.paper.training.feature_networks import load_features
from spackle.runtime.errors import InputError
from spackle.runtime.folders import make_folder

WIDTH = 480  # of rendered photos, in pixels
SIDE = 320  # long side of the views in tables, in pixels; figures show the photos' full size
MAX_PHOTO_SIDE = 480  # long side of scikit-image's photos, in pixels
TRAINING_SIDE = 224  # long side of the training photos, in pixels

# Photos that are evaluated, and those from which the training set is made.
SHOWN_PHOTOS = ("astronaut", "coffee", "chelsea")
TRAINING_PHOTOS = (*SHOWN_PHOTOS, "rocket", "camera", "clock")

RANKS = 2  # processes of a training, one for each core
VIEWS = 6  # of a training photo
STEPS = 40  # of a training
AT_ONCE = 2  # evaluations that run side by side, one for each core


class Set(NamedTuple):
    """A folder of scenes in the layout of a dataset, and the base that evaluates it."""

    name: str  # of its folder
    layout: str  # a dataset that `spackle evaluate` reads
    base: str
    has_second_photos: bool = True
    in_figure: bool = False


SETS = (
    Set("motorcycle", "middlebury", "rgbd", in_figure=True),
    Set("photos", "photos", "lite", has_second_photos=False, in_figure=True),
    Set("still_life", "booster", "rgbd", in_figure=True),
    Set("toy_truck", "wildrgbd", "rgbd", in_figure=True),
    Set("yard", "tanks", "rgbd"),
    Set("hall", "eth3d", "rgbd"),
    Set("fern", "llff", "lite"),  # LLFF has bounds of the depth, but no depth
)
# Sets on which the stand-in of SHARP is compared with its fine-tuned self.
STAND_IN_SETS = ("motorcycle", "still_life", "toy_truck")

# For each rendered set: how its layout is written, and how many photos it has.
WRITERS = {
    "still_life": (layouts.write_booster, 2),
    "toy_truck": (layouts.write_wildrgbd, 3),
    "yard": (layouts.write_tanks, 3),
    "hall": (layouts.write_eth3d, 3),
    "fern": (layouts.write_llff, 3),
}
LAYOUT_TITLES = {
    "booster": "Booster",
    "wildrgbd": "WildRGB-D",
    "tanks": "Tanks and Temples",
    "eth3d": "ETH3D",
    "llff": "LLFF",
}


# --- data


def make_data(data: Path, training_photos: Path) -> None:
    """Write the sets, and the photos from which the training set is made."""
    layouts.write_middlebury(data / "motorcycle")
    for name in SHOWN_PHOTOS:
        layouts.save_image(data / "photos" / f"{name}.png", photo(name, MAX_PHOTO_SIDE))
    about = "three photos that scikit-image brings"
    layouts.write_about(data / "photos", "Photos of scikit-image", about)
    for name in TRAINING_PHOTOS:
        layouts.save_image(training_photos / f"{name}.png", photo(name, TRAINING_SIDE))

    for one in SETS:
        if one.name not in WRITERS:
            continue
        began = time.monotonic()
        write, count = WRITERS[one.name]
        scene = rendered_scenes.SCENES[one.name]()
        write(data / one.name, layouts.render_frames(scene, WIDTH, count))
        title = scene.name.capitalize()
        layout = LAYOUT_TITLES[one.layout]
        layouts.write_about(data / one.name, title, f"rendered, in {layout}'s layout")
        print(f"{title}: {count} photos in {time.monotonic() - began:.0f} s", flush=True)


def photo(name: str, max_side: int) -> np.ndarray:
    """A photo of scikit-image, [H, W, 3] bytes, with at most this long side in pixels."""
    image = Image.fromarray(getattr(pictures, name)()).convert("RGB")
    image.thumbnail((max_side, max_side), Image.Resampling.LANCZOS)
    return np.asarray(image)


# --- the paper's chain


def training_commands() -> list[str]:
    """The command lines from training photos to a trained residual and a fine-tuned stand-in."""
    stand_in = "--base sharp -c sharp_stand_in.safetensors"
    few = (
        f"data.pseudo=pseudo data.validation_views={VIEWS} data.views=30 loss.features=none "
        "run.validate_every=10 optim.warmup=4"
    )
    train = f"torchrun --nproc-per-node {RANKS} --no-python spackle train --recipe"
    # A high rate for direct FT, because few steps replace thousands.
    fast = f"optim.steps={STEPS // 2} optim.batch=8 optim.lr=4e-3 optim.min_lr=4e-4"
    return [
        f"spackle dataset build training_photos -o pseudo {stand_in} --views {VIEWS} "
        "--inpainter exemplar --disparity 0.3 0.6",
        "spackle dataset verify pseudo",
        f"{train} paper -o residual init=sharp_stand_in.safetensors {few} optim.steps={STEPS} "
        "optim.batch=4",
        f"{train} direct_ft --method direct-ft -o direct-ft -c sharp_stand_in.safetensors {few} "
        f"{fast}",
    ]


class Evaluations(NamedTuple):
    """Command lines of evaluations, and the folders of their results."""

    lines: list[str]  # in any order
    timed_lines: list[str]  # of benchmarks, which need the machine for themselves
    measured: list[str]  # for tables
    pictured: list[str]  # for figures


def evaluation_commands(features: Path | None) -> Evaluations:
    """The command lines that evaluate all sets, with and without the stand-in of SHARP.

    Args:
        features: weights of the network behind the perceptual distance; None: those that `spackle
            weights get squeezenet` has downloaded, and without them there is no distance.
    """
    near_view = "--protocol near-view"
    if features is not None:
        near_view += f" --features {shlex.quote(str(features))}"
    evaluations = Evaluations([], [], [], [])
    for one in SETS:
        words = f"data/{one.name} --dataset {one.layout} --base {one.base}"
        # A scene gives one photo to complete; the others are compared with.
        limit = "" if one.name == "photos" else " --limit 1"
        methods = "--methods base,paper-initial,paper,spackle"
        _add(evaluations, f"evaluate {words}{limit} {methods} --side {SIDE}", f"{one.name}-large")
        if one.has_second_photos:
            near = f"{near_view} {methods},dense --side {SIDE}"
            _add(evaluations, f"evaluate {words}{limit} {near}", f"{one.name}-near")
        if one.in_figure:
            figure = f"--disparity 0.6 {methods}"
            _add(evaluations, f"evaluate {words}{limit} {figure}", f"{one.name}-figure")

    stand_in = (
        "--base sharp -c sharp_stand_in.safetensors --residual residual/best.safetensors "
        "--direct-ft direct-ft/best.safetensors"
    )
    for one in SETS:
        if one.name not in STAND_IN_SETS:
            continue
        words = f"data/{one.name} --dataset {one.layout} {stand_in} --limit 1"
        methods = f"--methods base,paper-initial,paper,direct-ft --side {SIDE}"
        _add(evaluations, f"evaluate {words} {methods}", f"{one.name}-stand-in-large")
        near = f"{near_view} {methods}"
        _add(evaluations, f"evaluate {words} {near}", f"{one.name}-stand-in-near")
        figure = f"--disparity 0.6 {methods}"
        _add(evaluations, f"evaluate {words} {figure}", f"{one.name}-stand-in-figure")

    # Times of the paper's method with a base that has a network, and with one that has none.
    for one in SETS[:2]:
        folder = f"runs/{one.name}-bench"
        words = f"data/{one.name} --dataset {one.layout} --base {one.base} --limit 1"
        evaluations.timed_lines.append(f"spackle bench {words} --side {SIDE} --runs 1 -o {folder}")
        evaluations.measured.append(folder)
    return evaluations


def _add(evaluations: Evaluations, words: str, name: str) -> None:
    """Add a command line whose results go to runs/NAME, for tables or, by the name, for figures."""
    folder = f"runs/{name}"
    evaluations.lines.append(f"spackle {words} -o {folder}")
    folders = evaluations.pictured if name.endswith("-figure") else evaluations.measured
    folders.append(folder)


def commands(features: Path | None) -> list[list[str]]:
    """All command lines in groups; those of a group do not depend on each other.

    Args:
        features: as in `evaluation_commands`.
    """
    evaluations = evaluation_commands(features)
    joined = [
        f"spackle tables {' '.join(evaluations.measured)} -o tables --html",
        f"spackle figures {' '.join(evaluations.pictured)} -o figures --rows 8",
    ]
    alone = [*training_commands()]
    timed = evaluations.timed_lines
    return [*([line] for line in alone), evaluations.lines, *([line] for line in timed), joined]


# --- running


class Runner:
    """Runs command lines in the folder of results; each has its output in a file of log/."""

    def __init__(self, folder: Path) -> None:
        """Use this folder, which exists."""
        self.folder = folder
        self.logs = folder / "log"
        self.logs.mkdir()
        self.count = 0
        self.lock = threading.Lock()

    def run_group(self, lines: Sequence[str]) -> None:
        """Run lines, two at a time; exit if one fails."""
        workers = min(AT_ONCE, len(lines))
        with ThreadPoolExecutor(workers) as pool:
            # A process that shares the machine has one core.
            threads = max(1, (os.cpu_count() or 1) // workers)
            failures = [
                log for log in pool.map(lambda line: self._run(line, threads), lines) if log
            ]
        if failures:
            sys.exit(f"a command failed: {', '.join(map(str, failures))} says why")

    def _run(self, line: str, threads: int) -> Path | None:
        """Run a line with so many threads, and print it; returns its log if it failed."""
        with self.lock:
            self.count += 1
            log = self.logs / f"{self.count:02d}.txt"
        words = shlex.split(line)
        programs = Path(sys.executable).parent
        # torchrun starts spackle, so the programs have to be on the path.
        environment = os.environ | {
            "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
            "OMP_NUM_THREADS": str(threads),
            "NUMBA_NUM_THREADS": str(threads),
        }
        began = time.monotonic()
        with log.open("w") as file:
            done = subprocess.run(
                [programs / words[0], *words[1:]],
                cwd=self.folder,
                stdout=file,
                stderr=file,
                env=environment,
            )
        print(f"$ {line}\n  {time.monotonic() - began:.0f} s", flush=True)
        return log if done.returncode else None


def main() -> None:
    """Make the data and the stand-in, and run all commands."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("reproduction"), help="a folder, which is new"
    )
    parser.add_argument(
        "--features",
        type=Path,
        metavar="FILE",
        help="SqueezeNet's weights for the perceptual distance, if not downloaded",
    )
    arguments = parser.parse_args()
    out = arguments.output.absolute()
    features = None if arguments.features is None else arguments.features.absolute()
    began = time.monotonic()
    if out.exists():
        raise InputError(f"{out}: is there already: give another folder with -o")
    if features is not None:
        load_features("squeezenet", features)  # an error now is better than one after minutes
    make_folder(out)

    make_data(out / "data", out / "training_photos")
    photos = [
        torch.from_numpy(photo(name, TRAINING_SIDE) / 255).float() for name in TRAINING_PHOTOS
    ]
    write_stand_in(out / "sharp_stand_in.safetensors", photos)
    runner = Runner(out)
    for lines in commands(features):
        runner.run_group(lines)
    claims = claims_of_folder(out)
    (out / CLAIMS_FILE).write_text(claims, encoding="utf-8")
    print(claims)
    print(
        f"{time.monotonic() - began:.0f} s, {cpu_seconds():.0f} of the processor: tables and "
        f"report.html in {out / 'tables'}, figures in {out / 'figures'}"
    )


def cpu_seconds() -> float:
    """Seconds that this process and its finished children have kept a core busy."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


if __name__ == "__main__":
    sys.exit(run_script(main))
