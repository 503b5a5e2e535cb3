"""Rebuild lite.safetensors, the shipped weights of the lite base: five training runs, and means of
weights.

    python research/lite/rebuild.py -o OUT data.photos=PHOTOS data.stereo=PAIRS \\
        data.rgbd.0.folder=KITCHEN data.rgbd.1.folder=OFFICE data.validation_stereo=OTHER_PAIRS

OUT gets a folder for each run, and lite.safetensors. The same command resumes a killed run.
KEY=VALUE override values in every run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from train import main as train
from weights import save_networks

from spackle.bases.lite import LiteNet, load_networks
from spackle.cli.script_command import run_script

SMALL = "network=lite0 data.scales=[1] optim.warmup=60"
RUNS = {  # name: initial weights, teacher, and values that override lite.yaml
    "one": ("", "", f"{SMALL} data.made=2000 "
            "data.shares.made=0.45 data.shares.stereo=0.33 data.shares.rgbd=0.22"),
    "two": ("one", "", f"{SMALL} data.made=4000 "
            "data.shares.made=0.45 data.shares.stereo=0.35 data.shares.rgbd=0.2"
            " optim.steps=1356 optim.min_lr=3e-4"),
    "three": ("one+two", "one+two", f"{SMALL} optim.steps=400 optim.lr=7e-4 optim.min_lr=7e-4"),
    "four": ("one+three", "one+three", f"{SMALL} data.seed=7 "
             "optim.steps=1350 optim.lr=4e-4 optim.min_lr=1e-5"),
    # Its schedule was planned for 5,800 steps; the shipped weights are from step 3,500, at a rate
    # of 3.7e-4.
    "larger": ("", "smaller", "data.seed=11 data.made=4500 data.guesses=1525 "
               "optim.steps=3500 optim.min_lr=3.7e-4"),
}  # fmt: skip
MEANS = {
    "one+two": {"one": 0.5, "two": 0.5},
    "one+three": {"one+two": 0.5, "three": 0.5},
    "smaller": {"four": 0.75, "one+three": 0.25},
}
RECIPE = Path(__file__).with_name("lite.yaml")


def mean(files: Mapping[Path, float]) -> LiteNet:
    """Average the networks of several files, weighted by their shares; each file holds one
    network.
    """
    networks = [load_networks(file)[0] for file in files]
    states = [network.state_dict() for network in networks]
    shares = list(files.values())
    networks[0].load_state_dict(
        {
            name: sum(share * state[name] for share, state in zip(shares, states, strict=True))
            for name in states[0]
        }
    )
    return networks[0]


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

    def file(name: str) -> Path:
        folder: Path = options.output
        if name not in MEANS:
            return folder / name / ("last.safetensors" if name == "larger" else "best.safetensors")
        path = folder / f"{name}.safetensors"
        if not path.is_file():
            save_networks([mean({file(part): share for part, share in MEANS[name].items()})], path)
        return path

    for name, (start, teacher, values) in RUNS.items():
        given = [
            f"{key}={file(of)}" for key, of in (("init", start), ("data.teacher", teacher)) if of
        ]
        words = [
            "--recipe",
            str(RECIPE),
            "-o",
            str(options.output / name),
            *given,
            *values.split(),
            *options.overrides,
        ]
        if status := train(words):
            return status
    save_networks(
        [*load_networks(file("smaller")), *load_networks(file("larger"))],
        options.output / "lite.safetensors",
    )
    print(options.output / "lite.safetensors")
    return 0


if __name__ == "__main__":
    sys.exit(run_script(main))
