"""The paper's six evaluation datasets, and the search for their scenes in a folder."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from pathlib import Path

from spackle.errors import InputError
from spackle.evaluation.case import Case, EvalDataset, has_any
from spackle.evaluation.datasets import posed_photos, stereo
from spackle.evaluation.rows import load_data

__all__ = ["DATASETS", "read_cases"]

FACTS = load_data("datasets.json")  # in the order of the paper's tables


def _called(folder: Path, dataset: str) -> bool:
    """Whether a folder's name contains the name of one of a dataset's scenes."""
    return not set(FACTS[dataset]["scenes"]).isdisjoint(re.split(r"[_\-. ]", folder.name.lower()))


def _is_tanks(folder: Path) -> bool:
    other = has_any(folder, posed_photos.LLFF_BOUNDS) or _called(folder, "llff")
    return has_any(folder, "sparse", "dense/sparse") and (_called(folder, "tanks") or not other)


def _is_llff(folder: Path) -> bool:
    return has_any(folder, posed_photos.LLFF_BOUNDS, "sparse") and not _called(folder, "tanks")


def _is_wildrgbd(folder: Path) -> bool:
    return has_any(folder, "rgb") and has_any(folder, "cam_poses.txt", "metadata", "masks")


_READERS = {
    "middlebury": (stereo.is_middlebury, stereo.middlebury_cases),
    "booster": (lambda folder: has_any(folder, "camera_00"), stereo.booster_cases),
    "wildrgbd": (_is_wildrgbd, posed_photos.wildrgbd_cases),
    "tanks": (_is_tanks, posed_photos.tanks_cases),
    "eth3d": (posed_photos.is_eth3d, posed_photos.eth3d_cases),
    "llff": (_is_llff, posed_photos.llff_cases),
}
DATASETS = {
    name: EvalDataset(name, facts["title"], facts["terms"], facts["expected"], *_READERS[name], facts.get("skip", ()))
    for name, facts in FACTS.items()
}
MAX_DEPTH = 4  # of scenes below the root; the deepest official layout is root/train/balanced/SCENE
MAX_FOLDERS = 100_000  # how many folders are searched for scenes; WildRGB-D has 23,000
GUESS_FOLDERS = 300  # how many folders are searched to guess which dataset it is instead


def read_cases(name: str, root: Path) -> list[Case]:
    """All cases of a dataset at or below `root`, in an order that depends on names alone.

    Raises:
        InputError: there is no such folder, no scene of the dataset in it (the message names the expected files), two
            scenes have the same name, or a scene's files are missing or damaged.
    """
    dataset = DATASETS[name]
    if not root.is_dir():
        raise InputError(f"{root}: no such folder: give the one that {name} was unpacked in")
    if root.name in ("", ".."):  # a scene is named after its folder
        root = root.resolve()
    folders = sorted(_walk(root, dataset, MAX_FOLDERS), key=lambda folder: (folder.name, folder.as_posix()))
    if not folders:
        # Guess the dataset with most scenes there. Later datasets have more distinctive files, so they win ties.
        counts = {one.name: sum(1 for _ in _walk(root, one, GUESS_FOLDERS)) for one in reversed(DATASETS.values())}
        likely = max(counts, key=lambda name: counts[name])
        hint = f"; this looks like {likely}" if counts[likely] else ""
        raise InputError(f"{root}: no scene of {name} at or below it: expected {dataset.expected}{hint}")
    scenes: dict[str, Path] = {}
    for folder in folders:
        scene = posed_photos.category_and_scene(folder) if name == "wildrgbd" else folder.name
        other = scenes.setdefault(scene, folder)
        if other is not folder:
            raise InputError(f"{folder}: {other} has the same scene name: give the folder of one size or part alone")
    return dataset.cases(scenes)


def _walk(root: Path, dataset: EvalDataset, budget: int) -> Iterator[Path]:
    """Scene folders in breadth-first order; folders inside a scene are skipped."""
    level = [root]
    for depth in range(MAX_DEPTH + 1):
        below: list[Path] = []
        for folder in level:
            if dataset.is_scene(folder):
                yield folder
            elif depth < MAX_DEPTH and budget > 0:
                budget -= 1
                with contextlib.suppress(OSError), os.scandir(folder) as entries:  # the folder may be unreadable
                    names = [entry.name for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
                    below += [folder / name for name in sorted(names) if name not in dataset.skip]
        level = below
