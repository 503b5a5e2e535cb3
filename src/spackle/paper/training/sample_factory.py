"""Make the training samples of a recipe that are missing, by several processes if there are."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from spackle.paper.training.ranks import rank, rank_count, wait_for_ranks
from spackle.paper.training.recipe import DataRecipe
from spackle.paper.training.samples import Sample, random_crops, save_sample
from spackle.residual.features import CELL
from spackle.runtime.digests import sealed, unsealed
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.progress import Progress
from spackle.runtime.tensor_digests import stated_digest

SAMPLES_VERSION = 8  # increase this whenever a recipe would give different samples


class Source(NamedTuple):
    """A source of views with holes and targets."""

    share: float  # weight among all sources
    # Makes a view by its number; InputError for an unusable file.
    view: Callable[[np.random.Generator, int], Sample]
    # What identifies its views: the source's name, and its files' names relative to their folder.
    names: Sequence[str]
    views: int | None = None  # number of views, numbered from 0; None: any number, drawn at random
    # Place, digest and configuration of each dataset that the views come from, for run.json.
    datasets: Sequence[Mapping[str, Any]] = ()


def digest_of_samples(data: DataRecipe, sources: Sequence[Source]) -> str:
    """Twelve digits that identify the samples that a recipe gives.

    Settings that determine a sample's content count, and so do the names of the sources' files.
    Where the files lie and how many samples there are does not count, so that a run with moved
    files or more samples uses the samples that exist already.
    """
    paths_and_numbers = ("photos", "stereo", "pseudo", "cache", "views", "validation_views")
    excluded: dict[str, Any] = dict.fromkeys(paths_and_numbers, True)
    # Pydantic's way to say: of all elements of `rgbd`, the depth cameras, leave out the folder.
    excluded["rgbd"] = {"__all__": {"folder"}}
    settings = data.model_dump(mode="json", exclude=excluded)
    names = [name for source in sources for name in source.names]
    shares = [source.share for source in sources]
    return short_digest((SAMPLES_VERSION, settings, shares, names))


def short_digest(value: Any) -> str:
    """Twelve hexadecimal digits that identify a value by its `repr`."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


def make_samples(
    data: DataRecipe,
    sources: Sequence[Source],
    folder: Path,
    seed: int,
    views: int,
    progress: Progress,
    warn: Callable[[str], None],
) -> list[Path]:
    """Make the samples of the first `views` views that a folder lacks; returns all samples' files
    in order.

    The processes of a run share the work, and wait for each other.

    Args:
        data: how many crops are cut from a view, and how large.
        sources: where views come from, each with its share.
        folder: for the files.
        seed: determines the views.
        views: how many views; fewer, if the only source has fewer.
        progress: called with (views done, all views) of this process.
        warn: called with the reason if a view cannot be made.

    Raises:
        InputError: a file cannot be written, or no view gave a sample.
    """
    folder.mkdir(parents=True, exist_ok=True)
    # A single limited source must not begin again: its views would be there twice.
    if len(sources) == 1 and sources[0].views is not None:
        views = min(views, sources[0].views)
    planned_views = _plan_views(sources, seed, views)

    # Each process makes a range of neighbouring views, because neighbours share a photo.
    _warn_of_old_files(folder, warn)
    first = views * rank() // rank_count()
    stop = views * (rank() + 1) // rank_count()
    for index in range(first, stop):
        is_complete = _crop_files(folder, index) is not None
        if not is_complete:
            crops: list[Sample] = []
            try:
                crops = _make_crops(data, planned_views[index], seed, index, sources)
            except (InputError, ValueError) as error:
                warn(str(error))
            for number, crop in enumerate(crops):
                save_sample(crop, _crop_file(folder, index, number))
            # Written after all crops, so that its presence proves that they are complete.
            write_atomic(_count_file(folder, index), sealed(b"%d\n" % len(crops)))
        progress(index - first + 1, stop - first)
    wait_for_ranks()

    files = [file for index in range(views) for file in _crop_files(folder, index) or ()]
    if not files:
        raise InputError(
            f"{folder}: none of {views} views gave a sample: photos must be readable and larger "
            f"than {CELL * data.cells} pixels each way, and data.disparity must be large enough "
            "for holes"
        )
    return files


def _warn_of_old_files(folder: Path, warn: Callable[[str], None]) -> None:
    """Warn if a folder has samples of an older version, in which damage cannot be noticed."""
    first_file = min(folder.glob("*-0.safetensors"), default=None)
    if first_file is None or rank() != 0:
        return
    # A damaged file is reported when it is read.
    with contextlib.suppress(Exception):
        if stated_digest(first_file) is None:
            warn(f"{folder}: samples of an older version, without digests that would show damage")


class _PlannedView(NamedTuple):
    """Which source a view comes from, and which number it has there."""

    source_index: int
    number: int


def _plan_views(sources: Sequence[Source], seed: int, views: int) -> list[_PlannedView]:
    """Draw the sources of the first `views` views; returns each view's source and number there.

    A source is drawn with a probability equal to its share, and numbers its own views from 0.
    """
    counts = [0] * len(sources)
    planned = []
    for index in range(views):
        source_index, _ = _draw_source(sources, seed, index)  # the random generator is not needed
        planned.append(_PlannedView(source_index, counts[source_index]))
        counts[source_index] += 1
    return planned


def _draw_source(
    sources: Sequence[Source], seed: int, index: int
) -> tuple[int, np.random.Generator]:
    """The index of a view's source, and the random generator for the rest of the view."""
    shares = np.array([source.share for source in sources])
    rng = np.random.default_rng([seed, index])
    return int(rng.choice(len(sources), p=shares / shares.sum())), rng


def _make_crops(
    data: DataRecipe, planned: _PlannedView, seed: int, index: int, sources: Sequence[Source]
) -> list[Sample]:
    """The crops of the view `index`.

    `planned` names the source that the view comes from, and the view's number in this source.
    """
    # The source is known already. It is drawn again because this leaves the random generator in the
    # state from which the view is to be made.
    _, rng = _draw_source(sources, seed, index)
    source = sources[planned.source_index]
    number = planned.number
    if source.views is not None:
        number %= source.views  # a limited source begins again after its last view
    view = source.view(rng, number)
    assert data.crops is not None  # whole views are no crops, and are not made here
    return random_crops(view, rng, count=data.crops, cells=data.cells)


def _crop_file(folder: Path, index: int, number: int) -> Path:
    """The file of one crop of a view."""
    return folder / f"{index:06d}-{number}.safetensors"


def _count_file(folder: Path, index: int) -> Path:
    """The file that holds the number of a view's crops."""
    return folder / f"{index:06d}.done"


def _crop_files(folder: Path, index: int) -> list[Path] | None:
    """The files of a view's crops, perhaps none; None if the crops are not complete."""
    # The file with the number of crops is written last, so that it is missing after a killed run.
    try:
        # A damaged number would leave crops out. Older files may have another text after it.
        content = unsealed(_count_file(folder, index).read_bytes())
        count = int(content.split()[0])
    except (FileNotFoundError, ValueError, IndexError):
        return None
    files = [_crop_file(folder, index, number) for number in range(count)]
    return files if all(file.is_file() for file in files) else None
