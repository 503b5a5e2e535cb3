"""What tables and figures call the scenes of an evaluation, which need not be those of the dataset.

Scenes that somebody made, in the layout of a dataset or as photos of their own, bring a file
about.json. It lies with the scenes, so that no table, figure or report of them can show them under
another name.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from spackle.depth.calibration import read_short_text
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.paper_numbers import PAPER_IMAGE_COUNTS
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.validation import validated

ABOUT_FILE = "about.json"
MAX_TITLE_LENGTH = 60  # characters, so that it fits into the tables
MAX_TEXT_LENGTH = 300  # characters
ONE_LINE = r"^[^\x00-\x1f\x7f]*$"  # no line breaks or other control characters


class _AboutFile(BaseModel):
    """The content of an about.json."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: Annotated[str, Field(min_length=1, max_length=MAX_TITLE_LENGTH, pattern=ONE_LINE)]
    about: Annotated[str, Field(max_length=MAX_TEXT_LENGTH, pattern=ONE_LINE)] = ""
    terms: Annotated[str, Field(max_length=MAX_TEXT_LENGTH, pattern=ONE_LINE)] = ""


@dataclasses.dataclass(frozen=True)
class Label:
    """What results say about their scenes."""

    title: str  # in tables and figures, such as "LLFF" or "Rendered fern"
    terms: str  # of use of the pictures, in a few words
    about: str = ""  # half a sentence about scenes that are not the dataset's


def read_label(dataset: EvalDataset, scenes: Sequence[Path], root: Path) -> Label:
    """What results call these scenes: the title in their about.json, or else the dataset's.

    about.json has the text "title", and may have "about" and "terms". It lies in each scene's
    folder, or in the folder of all scenes. A dataset without a title has that folder's name.

    Args:
        dataset: in whose layout the scenes are.
        scenes: their folders.
        root: the folder of all scenes.

    Raises:
        InputError: an about.json is damaged, the title is that of one of the paper's datasets, or
            scenes have different labels.
    """
    # All labels that occur, each with a scene that has it, for the message.
    labels = {_label_of_scene(dataset, scene, root): scene for scene in scenes}
    label, *other_labels = labels
    if other_labels:
        other = other_labels[0]
        raise InputError(
            f"{labels[other]}: scene of {other.title!r}, but {labels[label]} of {label.title!r}: "
            "evaluate each by itself"
        )
    return label


def _label_of_scene(dataset: EvalDataset, scene: Path, root: Path) -> Label:
    """The label of one scene's folder; see `read_label`."""
    # A scene's own file goes before the one of all scenes.
    for folder in (scene, root):
        path = folder / ABOUT_FILE
        if path.is_file():
            with as_input_error(path, "not JSON: {reason}"):
                content = json.loads(read_short_text(path))
            about = validated(_AboutFile, content, path)
            _check_title(about.title, path)
            return Label(title=about.title, terms=about.terms, about=about.about)
    if dataset.title:
        return Label(title=dataset.title, terms=dataset.terms)
    # Photos of one's own, which are no published dataset, are named after their folder.
    title = root.resolve().name
    _check_title(title, root)
    return Label(title=title, terms=dataset.terms)


def _check_title(title: str, where: Path) -> None:
    """InputError for the title of one of the paper's datasets, whose numbers would stand beside."""
    if title.lower() in [papers_title.lower() for papers_title in PAPER_IMAGE_COUNTS]:
        raise InputError(
            f"{where}: {title} is a dataset of the paper: choose another title in {ABOUT_FILE}"
        )
