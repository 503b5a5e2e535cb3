"""How long one training step takes, stage by stage, as a Markdown table.

    python benchmarks/train_step.py [--batch N] [--cells N] [--runs N] [--features squeezenet|resnet50|none]
                                    [--feature-size N] [--precision auto|fp32|bf16] [--device cpu|cuda]

The samples are made on the spot from scikit-image's photos; the feature network's weights are random, for they do not
change what a step costs. The first step, which warms up, does not count.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np
import skimage.data
import torch
from PIL import Image

from spackle.device import PRECISIONS, pick_dtype
from spackle.machine import hardware
from spackle.render import get_renderer
from spackle.residual.network import ResidualNet
from spackle.training.data import Cache
from spackle.training.features import FeatureNet, ResNet50, SqueezeNet
from spackle.training.method import Objective
from spackle.training.recipe import LossRecipe
from spackle.training.residual_method import complete_samples
from spackle.training.sample import load_sample
from spackle.training.sources import Composites

PHOTOS = ("astronaut", "coffee", "chelsea", "rocket")
STAGES = ("load", "network", "compose + render", "losses", "backward", "optimiser")
DISPARITY = (0.3, 0.3)


def make_samples(folder: Path, count: int, cells: int) -> list[Path]:
    """At least `count` samples, as training would cache them."""
    photos = []
    for name in PHOTOS:
        photos.append(folder / f"{name}.png")
        Image.fromarray(getattr(skimage.data, name)()).save(photos[-1])
    cache = Cache(folder / "cache", [Composites(photos, get_renderer(), DISPARITY)], [1.0], 0, 3, cells)
    files: list[Path] = []
    while len(files) < count:
        files = cache.fill(len(files) + 2, lambda done, total: None, print)
    return files


class Step:
    """One step after another, on the same network."""

    def __init__(self, judge: Objective) -> None:
        torch.manual_seed(0)
        self.judge = judge
        self.network = ResidualNet().to(judge.device, memory_format=torch.channels_last)
        self.optimizer = torch.optim.AdamW(self.network.parameters(), 1e-4)
        self.marks: list[float] = []
        self.network.register_forward_pre_hook(lambda *_: self.mark())
        self.network.register_forward_hook(lambda *_: self.mark())

    def mark(self) -> None:
        """The end of a stage."""
        if self.judge.device.type == "cuda":
            torch.cuda.synchronize()
        self.marks.append(time.perf_counter())

    def run(self, files: list[Path]) -> list[float]:
        """Milliseconds of each stage; putting the cues together counts as loading."""
        self.marks = []
        self.mark()
        samples = [load_sample(file) for file in files]
        batch = complete_samples(self.network, samples, self.judge.renderer, self.judge.precision)
        self.mark()
        loss, _ = self.judge.total(batch)
        self.mark()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.mark()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        self.mark()
        return [1e3 * (b - a) for a, b in itertools.pairwise(self.marks)]


def commit() -> str:
    """Of this checkout; with a + where files were changed since."""
    here = Path(__file__).parent
    done = subprocess.run(["git", "describe", "--always", "--dirty=+"], cwd=here, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--cells", type=int, default=96, help="along a crop's side, of 2×2 pixels")
    parser.add_argument("--runs", type=int, default=7, help="timed steps, of which the median counts")
    parser.add_argument("--features", choices=("squeezenet", "resnet50", "none"), default="squeezenet")
    parser.add_argument("--feature-size", type=int, help="the longer side that the feature network sees")
    parser.add_argument("--precision", choices=PRECISIONS, default="auto")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    options = parser.parse_args()
    device = torch.device(options.device)
    features: FeatureNet | None = None
    if options.features != "none":
        features = (SqueezeNet() if options.features == "squeezenet" else ResNet50()).to(device)
    dtype = pick_dtype(options.precision, device)
    judge = Objective(LossRecipe(feature_size=options.feature_size), features, get_renderer(), dtype, device)
    with tempfile.TemporaryDirectory() as folder:
        files = make_samples(Path(folder), options.batch, options.cells)
        step, picks = Step(judge), np.random.default_rng(0)
        order = [picks.permutation(len(files))[: options.batch] for _ in range(options.runs + 1)]
        times = [step.run([files[pick] for pick in picked]) for picked in order][1:]
    facts = ", ".join(f"{name} {value}" for name, value in hardware(device).items())
    print(f"{facts}; torch {torch.__version__}, commit {commit()}")
    size = f", at {options.feature_size} px" if options.feature_size else ""
    print(
        f"batch {options.batch} of {options.cells}×{options.cells} cells, {options.features}{size}, "
        f"{str(dtype).removeprefix('torch.')}, median of {options.runs}\n"
    )
    print("| stage | ms | share |\n|---|---|---|")
    total = statistics.median(map(sum, times))
    for name, column in zip(STAGES, zip(*times, strict=True), strict=True):
        middle = statistics.median(column)
        print(f"| {name} | {middle:.0f} | {middle / total:.0%} |")
    print(f"| total | {total:.0f} | |")


if __name__ == "__main__":
    main()
