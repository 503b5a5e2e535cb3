"""Seconds of each stage of `spackle dataset build`, on photos made on the spot: `python benchmarks/dataset.py`.

Each photo shows a few boxes before a wall, with exact depth (--base rgbd), or is given to random weights of SHARP's
full size (--base sharp), which show no scene but take their time.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from spackle.cli import main as spackle


def write_photo(folder: Path, number: int, width: int, height: int) -> None:
    """A photo of boxes before a wall, and its depth."""
    rng = np.random.default_rng(number)
    y, x = np.mgrid[:height, :width] / width
    depth = np.full((height, width), 6.0, np.float32)
    rgb = 0.5 + 0.2 * np.stack([np.sin(40 * x + 9 * y), np.cos(31 * y), np.sin(17 * (x + y))], axis=-1)
    for _ in range(4):
        left, top, side = rng.uniform(0, 0.8), rng.uniform(0, 0.6), rng.uniform(0.08, 0.3)
        box = (x > left) & (x < left + side) & (y > top) & (y < top + side)
        depth[box] = rng.uniform(1.5, 4)
        rgb[box] = rng.uniform(0, 1, 3) + 0.1 * np.sin(60 * x[box])[:, None]
    rgb += 0.03 * rng.standard_normal(rgb.shape)  # a photo's noise, which does not compress
    Image.fromarray(np.uint8(255 * rgb.clip(0, 1))).save(folder / "photos" / f"{number:04d}.jpg", quality=92)
    np.save(folder / "depth" / f"{number:04d}.npy", depth)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--size", default="640x480", help="COCO's")
    parser.add_argument("--base", choices=("rgbd", "sharp"), default="rgbd")
    parser.add_argument("--inpainter", default="geometry")
    parser.add_argument("--workers", default="1")
    parser.add_argument("--threads", default="2")
    options = parser.parse_args()
    width, height = (int(side) for side in options.size.split("x"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind in ("photos", "depth"):
            (folder / kind).mkdir()
        for number in range(options.count):
            write_photo(folder, number, width, height)
        words = ["dataset", "build", "--photos", f"{folder}/photos", "-o", f"{folder}/out", "--base", options.base]
        words += ["--inpainter", options.inpainter, "--workers", options.workers, "--threads", options.threads, "-v"]
        if options.base == "rgbd":
            words += ["--depth", f"{folder}/depth"]
        else:
            from spackle.jobs.weights import make_weights
            from spackle.progress import Reporter

            make_weights(folder / "sharp.safetensors", "full", Reporter())
            words += ["-c", f"{folder}/sharp.safetensors"]
        sys.argv = ["spackle", *words]
        print(f"{options.count} photos of {options.size}, 20 views each, {os.cpu_count()} cores", flush=True)
        spackle()


if __name__ == "__main__":
    main()
