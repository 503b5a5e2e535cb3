"""How well `spackle fill` tells holes from background, on made scenes whose holes are known.

    python benchmarks/fill_background.py          # a Markdown table, in two minutes on one core

Each scene is made of rectangles, of which some parts are missing (tests/helpers/open_scenes.py). A
pixel that only the whole scene covers is a hole; one that it leaves empty, too, is background. The
numbers of `scene_fill/background.py` were chosen on the default scenes of that file. The rules for
regions that one side of the picture cuts, and for specks, were made after a look at the scenes
here, so this is no independent test of them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import torch

import spackle
from spackle.cli.script_command import run_script
from spackle.render import CpuRenderer
from spackle.residual.features import hole_mask
from spackle.runtime.errors import InputError
from spackle.scene_fill.fill_plan import plan_fill

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from helpers.open_scenes import (
    OpenScene,
    chair,
    cup,
    houses_around,
    room,
    street,
    table,
)

RENDERER = CpuRenderer()

# Other scenes than those of the numbers' choice, by what the table calls them.
SCENES: dict[str, Callable[[], OpenScene]] = {
    "cup, 7 views": lambda: cup(count=7, height=0.4),
    "chair, 16 views from low": lambda: chair(count=16, height=0.5, hole=0.16),
    "chair with crossbars, 6 views": lambda: chair(count=6, height=1.3, crossbars=True),
    "table, 8 views from above": lambda: table(count=8, height=2.0, hole=0.35),
    "table, 5 views from low": lambda: table(count=5, height=0.9),
    "street, 3 photos and 7 new views": lambda: street(seed=3, count=10, novel=0.8),
    "street, new views only": lambda: street(seed=5, both=False, novel=0.5, high=1.4),
    "house, 16 views": lambda: houses_around(count=16, hole=1.1),
    "house, 6 views": lambda: houses_around(count=6, hole=0.5),
    "room, 12 views": lambda: room(count=12, hole=0.5),
}


@torch.no_grad()
def row(name: str, scene: OpenScene) -> str:
    """A line of the table: shares of pixels in all views of a scene."""
    plan = plan_fill(scene.given, scene.cameras, RENDERER)
    filled = spackle.fill(scene.given, scene.cameras, network=None)
    again = spackle.fill(filled, scene.cameras, network=None)

    holes = planned_holes = open_holes = background = planned_background = covered = 0
    worst = 1e-9
    for index, camera in enumerate(scene.cameras):
        before = RENDERER.render(scene.given, camera)
        after = RENDERER.render(filled, camera)
        is_hole, is_background = scene.truth(camera)
        is_empty = hole_mask(before.alpha)
        pixels = None if plan.fillable is None else plan.fillable[index]
        is_planned = is_empty if pixels is None else is_empty & pixels
        holes += int(is_hole.sum())
        planned_holes += int((is_hole & is_planned).sum())
        open_holes += int((is_hole & hole_mask(after.alpha)).sum())
        background += int(is_background.sum())
        planned_background += int((is_background & is_planned).sum())
        covered += int((is_background & ~hole_mask(after.alpha)).sum())
        change = (before.rgb - after.rgb)[~is_empty].square().mean()
        worst = max(worst, float(change))

    planned = planned_holes + planned_background
    cells = [
        name,
        f"{planned_holes / holes:.0%}" if holes else "no hole",
        f"{planned_holes / planned:.0%}" if planned else "nothing filled",
        f"{1 - open_holes / holes:.0%}" if holes else "",
        f"{1 - covered / background:.2%}" if background else "no background",
        f"{-10 * torch.tensor(worst).log10():.0f} dB",
        f"{len(filled) - len(scene.given)} / {len(again) - len(filled)}",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("words", nargs="*", help="only scenes with one of these in their names")
    words = parser.parse_args().words
    for word in words:
        if not any(word in name for name in SCENES):
            raise InputError(f"{word}: in no scene's name: there are {', '.join(SCENES)}")

    print(
        "| scene | recall | precision | holes closed | background left empty | "
        "what was seen, worst view | added / by a second fill |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, make in SCENES.items():
        if not words or any(word in name for word in words):
            print(row(name, make()), flush=True)


if __name__ == "__main__":
    sys.exit(run_script(main))
