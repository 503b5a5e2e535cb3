"""What a file of this folder defines for its dataset: an `EvalDataset`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from spackle.paper.evaluation.case import Case, SecondViews


def folder_name(folder: Path) -> str:
    """The usual name of a scene: that of its folder."""
    return folder.name


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvalDataset:
    """A dataset in the layout of files in which it is published.

    A scene is a folder of photos of one place; a case is an input photo with what is known about
    it.
    """

    name: str  # for the option `dataset`
    # In tables; for the paper's datasets their name in the paper's tables. "": each folder has a
    # title of its own, see labels.py.
    title: str
    terms: str  # terms of use, in a few words
    # A folder is a scene if it holds one of these files or folders, or a match of a pattern such as
    # "*.jpg".
    markers: Sequence[str]
    expected: str  # the files of a scene, for messages
    # From scene names to scene folders, both sorted, to cases; InputError for bad files.
    read_cases: Callable[[Mapping[str, Path]], list[Case]]
    # Names of folders that are not searched: without ground truth, or with the same photos again.
    skipped_folders: Sequence[str] = ()
    # Which second photos of a case near views use, unless the user chooses.
    second_views: SecondViews = "spread"
    # From a scene's folder to a name that no other scene has.
    scene_name: Callable[[Path], str] = folder_name
