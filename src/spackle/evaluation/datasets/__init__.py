"""The paper's six evaluation datasets, each read from its official folders."""

from __future__ import annotations

import difflib

from spackle.errors import InputError
from spackle.evaluation.case import EvalDataset
from spackle.evaluation.datasets.reconstructions import Eth3d, Llff, Tanks
from spackle.evaluation.datasets.stereo import Booster, Middlebury
from spackle.evaluation.datasets.wildrgbd import WildRgbd

__all__ = ["DATASETS", "get_dataset"]

_ALL: tuple[EvalDataset, ...] = (Middlebury(), Booster(), WildRgbd(), Tanks(), Eth3d(), Llff())
DATASETS: dict[str, EvalDataset] = {dataset.name: dataset for dataset in _ALL}  # in the order of the paper's tables


def get_dataset(name: str) -> EvalDataset:
    """A dataset by its name as it is typed; InputError with the nearest name otherwise."""
    if name in DATASETS:
        return DATASETS[name]
    near = difflib.get_close_matches(name.lower(), DATASETS, n=1)
    hint = f"did you mean {near[0]}?" if near else f"give one of {', '.join(DATASETS)}"
    raise InputError(f"dataset {name!r} is not known: {hint}")
