"""Rebuild the shipped weights of the residual: four training runs, and means of their weights.

    python research/rebuild_residual.py -o OUT data.photos=PHOTOS data.stereo=PAIRS \\
        data.rgbd.0.folder=KITCHEN data.rgbd.1.folder=OFFICE loss.features_path=squeezenet_v1.0.npz

OUT gets a folder for each run, and residual.safetensors. The same command resumes a killed run.
KEY=VALUE override values in every run.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from safetensors.torch import load_file, save_file
from torch import Tensor

from spackle.cli.script_command import run_script
from spackle.runtime.errors import as_input_error
from spackle.runtime.folders import make_folder

RUNS = {  # name: initial weights, and values that override the recipe cpu
    "first": (
        "",
        "data.views=1200 optim.steps=2700 loss.color_blur=0 loss.perceptual=1 loss.gram=1",
    ),
    "second": (
        "first",
        "data.views=420 optim.steps=2000 optim.warmup=60 optim.lr=3e-4 optim.min_lr=2e-5",
    ),
    "third": ("mixed", "data.views=1524 optim.steps=4000"),
    "fourth": (
        "third",
        "data.views=1124 data.seed=1 optim.steps=2400 optim.lr=2e-4 optim.min_lr=1e-5",
    ),
}
MIXED = {"first": 0.35, "second": 0.65}  # the third run starts from a mean with these shares
SHIPPED = {"mixed": 0.1, "third": 0.4, "fourth": 0.5}


def mean(files: Mapping[Path, float]) -> dict[str, Tensor]:
    """The mean of files' weights, weighted by their shares, in float32.

    Raises:
        InputError: a file is damaged.
    """
    parts = []
    for file, share in files.items():
        with as_input_error(file, "no weights ({reason}): delete its run to train it again"):
            tensors = load_file(file)
        parts.append({name: share * tensor.float() for name, tensor in tensors.items()})
    return {name: sum((part[name] for part in parts[1:]), parts[0][name]) for name in parts[0]}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status of a failed run, else 0."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="a folder; runs in it go on"
    )
    parser.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help="of every run: where the data lies"
    )
    options = parser.parse_intermixed_args(arguments)
    make_folder(options.output)

    def file(name: str) -> Path:
        folder: Path = options.output
        return (
            folder / "mixed.safetensors" if name == "mixed" else folder / name / "best.safetensors"
        )

    for name, (start, values) in RUNS.items():
        if start == "mixed":
            save_file(mean({file(part): share for part, share in MIXED.items()}), file("mixed"))
        init = [f"init={file(start)}"] if start else []
        words = [
            "train",
            "--recipe",
            "cpu",
            "-o",
            options.output / name,
            *init,
            *values.split(),
            *options.overrides,
        ]
        if status := subprocess.run([sys.executable, "-m", "spackle", *map(str, words)]).returncode:
            return status
    shipped = mean({file(part): share for part, share in SHIPPED.items()})
    save_file(
        {name: tensor.half() for name, tensor in shipped.items()},
        options.output / "residual.safetensors",
    )
    print(options.output / "residual.safetensors")
    return 0


if __name__ == "__main__":
    sys.exit(run_script(main))
