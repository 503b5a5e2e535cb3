"""The paper's six evaluation datasets, and the search for their scenes in a folder."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets import posed_photos, stereo
from spackle.paper.evaluation.measurements import load_data
from spackle.runtime.errors import InputError

__all__ = ["DATASETS", "EvalDataset", "read_cases"]


@dataclasses.dataclass(frozen=True)
class EvalDataset:
    """The description of a dataset in its official layout (datasets.json)."""

    name: str  # for --dataset
    cases: Callable[
        [Mapping[str, Path]], list[Case]
    ]  # from scene names to folders; InputError for bad files
    title: str  # the name in the paper's tables
    terms: str  # terms of use, in a few words
    markers: Sequence[str]  # a folder is a scene if it holds one of these files or folders
    expected: str  # the files of a scene, for messages
    skip: Sequence[str] = ()  # names of folders without ground truth, or with the same photos again


_READERS = {
    "middlebury": stereo.middlebury_cases,
    "booster": stereo.booster_cases,
    "wildrgbd": posed_photos.wildrgbd_cases,
    "tanks": posed_photos.tanks_cases,
    "eth3d": posed_photos.eth3d_cases,
    "llff": posed_photos.llff_cases,
}
# In the order of the paper's tables.
DATASETS = {
    name: EvalDataset(name, _READERS[name], **facts)
    for name, facts in load_data("datasets.json").items()
}
MAX_DEPTH = 4  # of scenes below the root; the deepest official layout is root/train/balanced/SCENE


def read_cases(name: str, root: Path) -> list[Case]:
    """All cases of a dataset at or below `root`, in an order that depends on names alone.

    Raises:
        InputError: there is no such folder, no scene (the message names the expected files) or no photo; two scenes
            have the same name; or a scene's files are missing or damaged.
    """
    dataset = DATASETS[name]
    if not root.is_dir():
        raise InputError(f"{root}: no such folder: give the folder of the unpacked dataset {name}")
    if root.name in ("", ".."):  # a scene is named after its folder
        root = root.resolve()
    folders = sorted(_scenes(root, dataset), key=lambda folder: (folder.name, folder.as_posix()))
    if not folders:
        raise InputError(
            f"{root}: no scene of {name} in this folder or below: expected {dataset.expected}"
        )
    scenes: dict[str, Path] = {}
    for folder in folders:
        scene = posed_photos.category_and_scene(folder) if name == "wildrgbd" else folder.name
        other = scenes.setdefault(scene, folder)
        if other is not folder:
            raise InputError(
                f"{folder}: same scene name as {other}: give a folder with a single size or part"
            )
    if not (cases := dataset.cases(scenes)):
        raise InputError(
            f"{root}: the scenes of {name} have no photos with a pose: unpack the dataset again"
        )
    return cases


def _scenes(folder: Path, dataset: EvalDataset, depth: int = MAX_DEPTH) -> Iterator[Path]:
    """The scene folders at or below a folder; folders inside a scene are skipped."""
    if any((folder / marker).exists() for marker in dataset.markers):
        yield folder
    elif depth:
        with (
            contextlib.suppress(OSError),
            os.scandir(folder) as entries,
        ):  # the folder may be unreadable
            for entry in entries:
                if (
                    entry.is_dir()
                    and not entry.name.startswith(".")
                    and entry.name not in dataset.skip
                ):
                    yield from _scenes(folder / entry.name, dataset, depth - 1)
