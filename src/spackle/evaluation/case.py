"""What a dataset is to an evaluation: photos, and what is known beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from torch import Tensor

from spackle.bases.depth_maps import DepthMap
from spackle.camera import Camera


@dataclasses.dataclass(frozen=True)
class SecondView:
    """A true photo of the same scene from elsewhere."""

    name: str
    photo: Path
    camera: Camera  # on any grid of the photo's shape; the world is the input photo's camera, in the dataset's lengths


@dataclasses.dataclass(frozen=True)
class Points:
    """Some pixels of the input photo whose depth is known."""

    uv: Tensor  # [n, 2] pixels of the case's camera, centres at half-integers
    z: Tensor  # [n] depth along the optical axis, lengths as the dataset has them


@dataclasses.dataclass(frozen=True)
class Case:
    """An input photo, and what is known about it. Nothing is read before it is asked for."""

    name: str  # no two of a dataset share it; slashes divide scene and view
    photo: Path
    camera: Camera | None = None  # on any grid of the photo's shape; None where only the photo itself tells its lens
    depth: Callable[[], DepthMap] | None = None  # of the stored photo's size or shape, lengths as the dataset has them
    points: Callable[[], Points] | None = None
    bounds: tuple[float, float] | None = None  # nearest and farthest depth of the view, where no more is known
    seconds: tuple[SecondView, ...] = ()
    metric: bool = False  # the dataset's lengths are metres
    problem: str | None = None  # why it cannot be used, where that is seen before its turn: of itself, not of the rest


class EvalDataset(Protocol):
    """A dataset in its official folders."""

    name: str  # as it is typed
    title: str  # as the paper's tables have it
    terms: str  # of use, in a few words
    paper_images: int  # how many the paper evaluates on

    def cases(self, root: Path) -> Sequence[Case]:
        """All inputs, in an order that depends on names alone.

        Raises:
            InputError: folders that are not this dataset's; says what was expected where.
        """
        ...
