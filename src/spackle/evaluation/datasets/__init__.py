"""The paper's six evaluation datasets, each read from its official folders."""

from __future__ import annotations

from spackle.errors import check_name
from spackle.evaluation.case import EvalDataset
from spackle.evaluation.datasets.posed_photos import Eth3d, Llff, Tanks, WildRgbd
from spackle.evaluation.datasets.stereo import Booster, Middlebury

__all__ = ["DATASETS", "get_dataset"]

_ALL: tuple[EvalDataset, ...] = (Middlebury(), Booster(), WildRgbd(), Tanks(), Eth3d(), Llff())
DATASETS: dict[str, EvalDataset] = {dataset.name: dataset for dataset in _ALL}  # in the order of the paper's tables


def get_dataset(name: str) -> EvalDataset:
    """A dataset by its name as it is typed; InputError with the nearest name otherwise."""
    check_name("dataset", name, DATASETS)
    return DATASETS[name]
