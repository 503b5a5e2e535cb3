"""The datasets of the evaluation, and the search for their scenes in a folder.

To add a dataset: write a file in this folder that defines an `EvalDataset` (dataset.py says what
that is; eth3d.py is the shortest), and add a line to `_ALL_DATASETS` below. A dataset that another
package defines needs no line: its name is `package.module:NAME`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from spackle.paper.evaluation.case import Case
from spackle.paper.evaluation.datasets.booster import BOOSTER
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.datasets.eth3d import ETH3D
from spackle.paper.evaluation.datasets.llff import LLFF
from spackle.paper.evaluation.datasets.middlebury import MIDDLEBURY
from spackle.paper.evaluation.datasets.pairs import PAIRS
from spackle.paper.evaluation.datasets.photos import PHOTOS
from spackle.paper.evaluation.datasets.tanks import TANKS
from spackle.paper.evaluation.datasets.wildrgbd import WILDRGBD
from spackle.runtime.errors import InputError
from spackle.runtime.plugins import check_name_or_plugin, is_plugin, load_plugin

__all__ = ["DATASETS", "EvalDataset", "find_dataset", "find_scenes", "read_cases"]

# The paper's six datasets, in the order of its tables, and the user's own photos. A further dataset
# is a further line here.
_ALL_DATASETS = (
    MIDDLEBURY,
    BOOSTER,
    WILDRGBD,
    TANKS,
    ETH3D,
    LLFF,
    PAIRS,
    PHOTOS,
)
DATASETS: dict[str, EvalDataset] = {dataset.name: dataset for dataset in _ALL_DATASETS}

# How many levels of folders below the root are searched for scenes; the deepest published layout is
# root/train/balanced/SCENE.
MAX_SCENE_DEPTH = 4


def find_dataset(name: str) -> EvalDataset:
    """A dataset by its name: a key of `DATASETS`, or `package.module:NAME` of another package.

    InputError if there is no such dataset.
    """
    check_name_or_plugin("dataset", name, DATASETS)
    if not is_plugin(name):
        return DATASETS[name]
    dataset = load_plugin(name, "dataset")
    if not isinstance(dataset, EvalDataset):
        raise InputError(
            f"`dataset` {name}: no dataset: give an EvalDataset of "
            "spackle.paper.evaluation.datasets"
        )
    return dataset


def read_cases(name: str, root: Path) -> list[Case]:
    """All cases (input photos with what is known about them) of a dataset's scenes in a folder.

    Args:
        name: of the dataset, see `find_dataset`.
        root: the folder of the unpacked dataset, or a folder of it.

    Returns:
        The cases, in an order that depends on names alone.

    Raises:
        InputError: there is no such folder, no scene (the message names the expected files) or no
            photo; two scenes have the same name; or a scene's files are missing or damaged.
    """
    cases = find_dataset(name).read_cases(find_scenes(name, root))
    if not cases:
        raise InputError(
            f"{root}: the scenes of {name} have no photos with a pose: unpack the dataset again"
        )
    return cases


def find_scenes(name: str, root: Path) -> dict[str, Path]:
    """The folders of a dataset's scenes, by the scene's name, in an order that depends on names.

    Args:
        name: of the dataset, see `find_dataset`.
        root: the folder of the unpacked dataset, or a folder of it.

    Raises:
        InputError: there is no such folder or no scene (the message names the expected files), or
            two scenes have the same name.
    """
    dataset = find_dataset(name)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder: give the folder of the unpacked dataset {name}")
    if root.name in ("", ".."):  # scenes are named after folders, so the path must end with a name
        root = root.resolve()

    # Sorted, because the order in which a system lists folders is arbitrary.
    folders = sorted(
        _scene_folders(root, dataset), key=lambda folder: (folder.name, folder.as_posix())
    )
    if not folders:
        raise InputError(
            f"{root}: no scene of {name} in this folder or below: expected {dataset.expected}"
        )

    # Two folders with one name are the same scene in two sizes, or a mistake.
    scenes: dict[str, Path] = {}
    for folder in folders:
        scene = dataset.scene_name(folder)
        if scene in scenes:
            raise InputError(
                f"{folder}: same scene name as {scenes[scene]}: give a folder with a single size "
                "or part"
            )
        scenes[scene] = folder
    return scenes


def _scene_folders(
    folder: Path, dataset: EvalDataset, depth: int = MAX_SCENE_DEPTH
) -> Iterator[Path]:
    """The folders of scenes at or below a folder; nothing is searched inside a scene.

    Args:
        folder: where to search.
        dataset: says what a scene's folder holds, and which folders are not searched.
        depth: how many levels of folders below `folder` are searched.
    """
    if any(True for marker in dataset.markers for _ in folder.glob(marker)):
        yield folder
        return
    if depth == 0:
        return

    # A folder that cannot be read has no scenes.
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            is_hidden = entry.name.startswith(".")
            if entry.is_dir() and not is_hidden and entry.name not in dataset.skipped_folders:
                yield from _scene_folders(folder / entry.name, dataset, depth - 1)
