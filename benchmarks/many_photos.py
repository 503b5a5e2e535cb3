"""What a run over very many photos costs beside the work on each photo.

    python benchmarks/many_photos.py [--photos 1000] [--ray-photos 300] [-o FOLDER]

Photos of 64×48 pixels and a base that does next to nothing leave what `spackle predict` itself
adds: processes, files and messages. They go through one process, two workers and, if Ray is
installed, one and two workers of a Ray cluster on this machine.

Prints a table, and writes many_photos.json and memory.svg: the memory of the command's own process
over the run. Time is that of processors, to which other programs on a busy machine add little. It
is read from Linux's /proc.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image

import spackle
from spackle.cli.script_command import run_script
from spackle.paper.evaluation.plots import MATPLOTLIB_SETTINGS
from spackle.results.results_file import RESULTS_NAME
from spackle.runtime.errors import InputError
from spackle.runtime.folders import make_folder

PHOTO_SIZE = (64, 48)  # width and height in pixels
GAUSSIAN_COUNT = 48
DEPTH_M = 3.0
WARM_COUNT = 100  # photos after which caches are full; costs are those of the photos behind them
POLL_SECONDS = 0.1  # between two looks at the processes
BYTES_PER_MB = 1e6
MS_PER_S = 1000
FIGURE_INCHES = (7.0, 2.2)
MARGIN = 1.2  # height of the axes over the highest value


class Flat:
    """A base that places a few Gaussians on a wall, without a look at the photo."""

    name = "flat"

    def predict(
        self, photo: spackle.Photo, progress: Callable[[int, int], None] | None = None
    ) -> spackle.BasePrediction:
        """The Gaussians, on a diagonal of the photo."""
        side = torch.linspace(-1, 1, GAUSSIAN_COUNT)
        depth = torch.full((GAUSSIAN_COUNT,), DEPTH_M)
        gaussians = spackle.Gaussians(
            means=torch.stack([side, 0.5 * side, depth], dim=1),
            quats=torch.tensor([1.0, 0, 0, 0]).repeat(GAUSSIAN_COUNT, 1),
            scales=torch.full((GAUSSIAN_COUNT, 3), 0.5),
            opacities=torch.full((GAUSSIAN_COUNT,), 0.9),
            colors=torch.full((GAUSSIAN_COUNT, 3), 0.5),
        )
        return spackle.BasePrediction(gaussians, photo.camera, notes={})


class Sample(NamedTuple):
    """What a run has used when a number of photos was done."""

    photo_count: int
    all_seconds: float  # of processor time, in all processes of the run
    command_seconds: float  # the same, in the command's own process
    command_mb: float  # memory (RSS) of this process


class ProcessFacts(NamedTuple):
    """A line of Linux's /proc about a process."""

    parent: int
    start: str  # tells two processes of one number apart
    seconds: float  # of processor time
    memory_mb: float


def process_facts() -> dict[int, ProcessFacts]:
    """The processes of this machine, by their numbers."""
    facts = {}
    for folder in Path("/proc").iterdir():
        if not folder.name.isdecimal():
            continue
        try:
            text = (folder / "stat").read_text()
        except OSError:  # it has just ended
            continue
        # The fields behind the name, which may have spaces: see proc_pid_stat(5).
        fields = text.rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])  # in user and in system mode
        pages = int(fields[21])
        facts[int(folder.name)] = ProcessFacts(
            parent=int(fields[1]),
            start=fields[19],
            seconds=ticks / os.sysconf("SC_CLK_TCK"),
            memory_mb=pages * os.sysconf("SC_PAGE_SIZE") / BYTES_PER_MB,
        )
    return facts


def family_of(number: int, facts: Mapping[int, ProcessFacts]) -> set[int]:
    """A process and all that it has started, directly or not."""
    family = {number}
    size = 0
    while len(family) > size:
        size = len(family)
        family |= {child for child, fact in facts.items() if fact.parent in family}
    return family


def write_photos(folder: Path, count: int) -> Path:
    """Write photos of noise into a new folder, and return it."""
    folder.mkdir()
    width, height = PHOTO_SIZE
    noise = np.random.default_rng(0)
    for number in range(count):
        pixels = noise.integers(0, 256, (height, width, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{number:06d}.png")
    return folder


def samples_of(photos: Path, out: Path, options: Sequence[str]) -> list[Sample]:
    """Run `spackle predict` over a folder of photos; a sample for each growth of results.jsonl."""
    words = ["predict", str(photos), "-o", str(out), "--base", "many_photos:Flat"]
    words += ["--fill", "none", "--disparity", "0.1", "--no-render", "--threads", "1"]
    source = Path(spackle.__file__).parents[1]
    command = [sys.executable, "-m", "spackle", *words, *options]
    process = subprocess.Popen(
        command,
        cwd=Path(__file__).parent,  # where the command finds the base
        env=os.environ | {"PYTHONPATH": str(source)},
        stderr=subprocess.DEVNULL,
    )

    results = out / RESULTS_NAME
    samples: list[Sample] = []
    read_bytes = 0
    photo_count = 0
    # Of every process that was seen, so that those which have ended count, too.
    seconds_of: dict[tuple[int, str], float] = {}
    while process.poll() is None:
        time.sleep(POLL_SECONDS)
        if not results.exists():
            continue
        with results.open("rb") as file:
            file.seek(read_bytes)
            added = file.read()
        read_bytes += len(added)
        facts = process_facts()
        # A process that has ended has no memory, until its parent asks for its exit code.
        if process.pid not in facts or not facts[process.pid].memory_mb:
            break
        for number in family_of(process.pid, facts):
            seconds_of[number, facts[number].start] = facts[number].seconds
        if not added:
            continue
        photo_count += added.count(b"\n")
        own = facts[process.pid]
        samples.append(Sample(photo_count, sum(seconds_of.values()), own.seconds, own.memory_mb))
    if process.wait():
        raise SystemExit(f"the command failed: {' '.join(command)}")
    return samples


def table_row(title: str, samples: Sequence[Sample]) -> str:
    """A row of the table: milliseconds a photo, and memory."""
    early = next(sample for sample in samples if sample.photo_count >= WARM_COUNT)
    late = samples[-1]
    photo_count = late.photo_count - early.photo_count
    all_ms = MS_PER_S * (late.all_seconds - early.all_seconds) / photo_count
    command_ms = MS_PER_S * (late.command_seconds - early.command_seconds) / photo_count
    cells = [title, str(late.photo_count), f"{all_ms:.1f}", f"{command_ms:.1f}"]
    cells += [f"{early.command_mb:.0f}", f"{late.command_mb:.0f}"]
    return f"| {' | '.join(cells)} |"


def draw_memory(runs: Mapping[str, Sequence[Sample]], file: Path) -> None:
    """Write an SVG image of the command's memory against the photos that are done."""
    import matplotlib as mpl
    from matplotlib import pyplot

    with mpl.rc_context(MATPLOTLIB_SETTINGS):
        # A panel for each run, because their lines would hide each other.
        figure, panels = pyplot.subplots(
            ncols=len(runs), sharey=True, squeeze=False, figsize=FIGURE_INCHES, layout="constrained"
        )
        for axes, (title, samples) in zip(panels[0], runs.items(), strict=True):
            counts = [sample.photo_count for sample in samples]
            axes.plot(counts, [sample.command_mb for sample in samples])
            axes.set_title(title)
            axes.set_xlim(0, counts[-1])
            axes.set_xticks([0, counts[-1]])
        highest = max(sample.command_mb for samples in runs.values() for sample in samples)
        panels[0, 0].set_ylim(0, MARGIN * highest)
        panels[0, 0].set_ylabel("MB of the command")
        figure.supxlabel("photos done", fontsize="medium")
        figure.savefig(file, metadata={"Date": None})  # equal numbers make equal bytes
        pyplot.close(figure)


def main() -> None:
    """Measure each engine, and print its row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", type=int, default=1000)
    parser.add_argument("--ray-photos", type=int, default=300, help="for Ray; 0 for none")
    parser.add_argument("-o", "--output", type=Path, default=Path("many-photos"))
    options = parser.parse_args()
    if options.photos < 1:
        raise InputError(f"--photos {options.photos}: must be at least 1")
    make_folder(options.output)

    engines: dict[str, tuple[int, list[str]]] = {
        "one process": (options.photos, []),
        "2 workers": (options.photos, ["--workers", "2"]),
    }
    if options.ray_photos and importlib.util.find_spec("ray") is not None:
        for count in (1, 2):
            words = ["--ray", "local", "--workers", str(count)]
            engines[f"Ray, {count} worker{'s' * (count > 1)}"] = (options.ray_photos, words)

    print("| | photos | ms a photo | ms of the command | MB at 100 | MB at the end |")
    print("|---|---|---|---|---|---|")
    runs: dict[str, list[Sample]] = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for number, (title, (photo_count, words)) in enumerate(engines.items()):
            photos = place / f"photos-{photo_count}"
            if not photos.exists():
                write_photos(photos, photo_count)
            runs[title] = samples_of(photos, place / f"out-{number}", words)
            print(table_row(title, runs[title]), flush=True)
            # After each engine, because a later one may fail, such as Ray on a busy machine.
            (options.output / "many_photos.json").write_text(json.dumps(runs, indent=1))
            draw_memory(runs, options.output / "memory.svg")


if __name__ == "__main__":
    sys.exit(run_script(main))
