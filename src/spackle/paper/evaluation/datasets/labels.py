"""What tables and figures call a dataset's scenes, which need not be those of the dataset.

Scenes that somebody made in the layout of a dataset bring a file about.json. It lies with the
scenes, so that no table, figure or report of them can show them under the dataset's name.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from spackle.depth.calibration import read_short_text
from spackle.paper.evaluation.datasets.dataset import EvalDataset
from spackle.paper.evaluation.paper_numbers import PAPER_IMAGE_COUNTS
from spackle.runtime.errors import InputError, as_input_error

ABOUT_FILE = "about.json"


@dataclasses.dataclass(frozen=True)
class Label:
    """What results say about their scenes."""

    title: str  # in tables and figures, such as "LLFF" or "Rendered fern"
    terms: str  # of use of the pictures, in a few words
    about: str = ""  # half a sentence about scenes that are not the dataset's


def read_label(dataset: EvalDataset, scenes: Sequence[Path]) -> Label:
    """What results call these scenes: the dataset's title, or that of the scenes' own about.json.

    about.json has the texts "title" and "about", and may have "terms".

    Args:
        dataset: in whose layout the scenes are.
        scenes: their folders.

    Raises:
        InputError: an about.json is damaged or takes the name of one of the paper's datasets, or
            scenes have different labels.
    """
    labels = {_label_of_scene(dataset, scene): scene for scene in scenes}
    if len(labels) > 1:
        first, second, *_ = labels.items()
        raise InputError(
            f"{second[1]}: scene of {second[0].title!r}, but {first[1]} of {first[0].title!r}: "
            "evaluate each by itself"
        )
    (label,) = labels
    return label


def _label_of_scene(dataset: EvalDataset, scene: Path) -> Label:
    """The label of one scene's folder; see `read_label`."""
    path = scene / ABOUT_FILE
    if not path.is_file():
        return Label(title=dataset.title, terms=dataset.terms)
    with as_input_error(path, 'needs the texts "title" and "about": {reason}'):
        texts = json.loads(read_short_text(path))
        title = str(texts["title"])
        label = Label(title=title, terms=str(texts.get("terms", "")), about=str(texts["about"]))
    # The paper's numbers for a dataset stand beside results with its title.
    if title in PAPER_IMAGE_COUNTS:
        raise InputError(f"{path}: {title} is a dataset of the paper: choose another title")
    return label
