"""Compare the lite base's depth, and two guesses that need no photo, with measured depth, as a
Markdown table.

    python research/lite/benchmark.py --stereo FOLDER --rgbd FOLDER --unit 0.001 \
        [--rooms FOLDER] [--last 0.2] [--weights FILE] [--outlines] [--pictures PNG] \
        [--standing PHOTOS]

Each --stereo is a folder of scenes, which have a scene.json, or a calib.txt as in ETH3D and
Middlebury 2014. Each --rgbd is a folder of NAME.color.jpg and NAME.depth.png, with its --unit in
metres; --last uses only the last share of its frames, those that `lite.yaml` does not train on.
Each --rooms is a folder of furnished rooms of `research/worlds`, of which the photos are used.
Each guess is aligned by the best scale and shift (`depth_loss.py`). --outlines adds a table of
lite's depth edges within 2 pixels of the true ones (`outlines.py`). --standing makes 40 synthetic
streets with standing objects, with textures cut from PHOTOS, and measures the error within objects
(`standing.py`). The last line is the time for a photo of 640×480, median of 9 runs.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from depth_loss import DepthScore, score_depth, vertical_ramp
from frames import JUDGED_SIDE, Frame, Measured, of_camera, of_scenes, reduced
from made_rooms import judged_rooms
from outlines import TRUE_RATIO, OutlineCounts, compare_outlines
from standing import StandingScore, labelled_scene, score_standing
from synthetic_scenes import PhotoDraw
from task import colored, ends
from torch import Tensor
from torch.nn.functional import interpolate

from spackle.bases.lite import LiteBase
from spackle.cli.script_command import run_script
from spackle.core.photo import load_photo
from spackle.formats import save_png
from spackle.formats.png import contact_sheet
from spackle.paper.evaluation.datasets.stereo import pair_of_2014
from spackle.paper.training.measured_photos import find_photo_files
from spackle.paper.training.recipe import RgbdFolder
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_writable

GUESSES = ("constant", "ramp", "lite")
STREETS, STREETS_SEED = 40, 202


def frames_of(arguments: argparse.Namespace) -> Iterator[tuple[str, list[Frame]]]:
    """Yield groups of frames with their names."""
    for folder in arguments.stereo:
        with as_input_error(folder, "cannot read the folder of --stereo: {reason}", OSError):
            content = sorted(folder.iterdir())
        plain = [
            scene for scene in content if not (scene / "scene.json").is_file() and scene.is_dir()
        ]
        # An empty folder has no scenes of either kind, and `of_scenes` says so.
        if len(plain) < len(content) or not content:
            yield folder.name, [file.read(JUDGED_SIDE) for file in of_scenes(folder, "--stereo")]
        for scene in plain:
            case = pair_of_2014(scene)
            assert case.read_depth is not None
            known = case.read_depth()
            yield (
                scene.name,
                [reduced(load_photo(case.photo).rgb, known.depth, known.valid, JUDGED_SIDE)],
            )
    for folder, unit in zip(arguments.rgbd, arguments.unit, strict=True):
        files: list[Measured] = of_camera(
            RgbdFolder(folder=folder, focal_px=1.0, unit_m=unit), arguments.last
        )[1]
        yield folder.name, [file.read(JUDGED_SIDE) for file in files]
    for folder in arguments.rooms:
        yield folder.name, [room.read(JUDGED_SIDE) for room in judged_rooms(folder)]


def guesses(base: LiteBase, frame: Frame) -> dict[str, Tensor]:
    """All guesses of a frame's inverse depth [H, W], by name."""
    height, width = frame.inverse_depth.shape
    seen = base.inverse_depth(frame.rgb.permute(1, 2, 0))[None, None]
    seen = interpolate(seen, size=(height, width), mode="bilinear", align_corners=False)[0, 0]
    return dict(
        zip(GUESSES, (torch.ones(height, width), vertical_ramp(height, width), seen), strict=True)
    )


def score(frame: Frame, guess: Tensor) -> DepthScore:
    return score_depth(guess, 1 / frame.inverse_depth.where(frame.valid, 1.0), frame.valid)


def outline_cells(counts: OutlineCounts) -> str:
    """The table cells of a set's outlines: at the best strength, and F1 at the true strength."""
    best = counts.best
    numbers = (
        f"{best.ratio:g}",
        f"{best.precision:.3f}",
        f"{best.recall:.3f}",
        f"{best.f1:.3f}",
        f"{counts.at(TRUE_RATIO).f1:.3f}",
        f"{counts.overlap:.3f}",
    )
    return " | ".join(numbers)


def standing(base: LiteBase, photos: Path) -> str:
    """The table's line on synthetic streets with standing objects."""
    draw = PhotoDraw(find_photo_files(photos, "--standing"), print)
    scores: dict[str, list[StandingScore]] = {guess: [] for guess in GUESSES[1:]}
    for number in range(STREETS):
        frame, owner = labelled_scene(np.random.default_rng([STREETS_SEED, number]), draw, 320, 448)
        each = guesses(base, frame)
        for guess, found in scores.items():
            found.append(score_standing(each[guess], frame, owner))
    cells = []
    for guess, found in scores.items():
        things = sum(one.things for one in found)
        within, off = (
            sum(getattr(s, n) * s.things for s in found) / things for n in ("within", "abs_rel")
        )
        cells.append(f"{guess} {within:.4f} (AbsRel {off:.3f})")
    return f"{STREETS} made streets, {things} standing things, error within: {', '.join(cells)}"


def seconds(base: LiteBase, runs: int = 9) -> float:
    """Median seconds from the pixels of a 640×480 photo to its inverse depth."""
    photo, times = torch.rand(480, 640, 3), []
    for _ in range(runs + 1):
        start = time.perf_counter()
        base.inverse_depth(photo)
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--stereo", type=Path, action="append", default=[])
    parser.add_argument("--rgbd", type=Path, action="append", default=[])
    parser.add_argument("--unit", type=float, action="append", default=[])
    parser.add_argument("--rooms", type=Path, action="append", default=[])
    parser.add_argument("--last", type=float, default=0.2)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--outlines", action="store_true")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--standing", type=Path)
    arguments = parser.parse_args()
    if len(arguments.rgbd) != len(arguments.unit):
        folders = " ".join(map(str, arguments.rgbd))
        raise InputError(f"--rgbd {folders}: has {len(arguments.unit)} --unit: give one for each")
    if arguments.standing:
        find_photo_files(arguments.standing, "--standing")  # before all else, which takes minutes
    if arguments.pictures:
        check_writable(arguments.pictures)
        if not (arguments.stereo or arguments.rgbd or arguments.rooms):
            raise InputError("--pictures: of nothing: give --stereo, --rgbd or --rooms")
    base = LiteBase.load(arguments.weights)

    print(
        "| set | frames | constant | ramp | lite | against the better | δ < 1.25: constant | ramp "
        "| lite |"
    )
    print("|---|---" + "|---:" * 7 + "|")
    rows = []
    outlines: dict[str, OutlineCounts] = {}
    for name, frames in frames_of(arguments):
        found: dict[str, list[DepthScore]] = {guess: [] for guess in GUESSES}
        shown = range(0, len(frames), max(1, len(frames) // 3))[:3]
        for number, frame in enumerate(frames):
            each = guesses(base, frame)
            for guess in GUESSES:
                found[guess].append(score(frame, each[guess]))
            if arguments.outlines:
                counts = compare_outlines(each["lite"], frame.inverse_depth, frame.valid)
                outlines[name] = outlines[name] + counts if name in outlines else counts
            if number in shown:
                seen, true = each["lite"], frame.inverse_depth
                known = colored(true, *ends(true[frame.valid]), frame.valid)
                rows.append(
                    [frame.rgb.permute(1, 2, 0), colored(seen, *ends(seen[frame.valid])), known]
                )
        errors = [statistics.mean(s.abs_rel for s in found[guess]) for guess in GUESSES]
        deltas = [statistics.mean(s.delta for s in found[guess]) for guess in GUESSES]
        cells = [
            *(f"{e:.4f}" for e in errors),
            f"{errors[2] / min(errors[:2]) - 1:+.1%}",
            *(f"{d:.1%}" for d in deltas),
        ]
        print(f"| {name} | {len(frames)} | {' | '.join(cells)} |", flush=True)
    if outlines:
        print(
            f"\n| set | true edges | best strength | precision | recall | F1 | "
            f"F1 at {TRUE_RATIO:g} | overlap |"
        )
        print("|---" + "|---:" * 7 + "|")
        for name, counts in outlines.items():
            print(f"| {name} | {counts.true} | {outline_cells(counts)} |", flush=True)
    if arguments.standing:
        print(f"\n{standing(base, arguments.standing)}", flush=True)
    print(f"\n640×480: {seconds(base):.3f} s on {torch.get_num_threads()} threads")
    if arguments.pictures:
        save_png(contact_sheet(rows, 320), arguments.pictures)


if __name__ == "__main__":
    sys.exit(run_script(main))
