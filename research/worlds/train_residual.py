"""Train the residual as `spackle train` does, with true second views of made worlds among its data.

    PYTHONPATH=src:research python -m worlds.train_residual --recipe cpu -o OUT \\
        worlds.folder=WORLDS worlds.validation=OTHERS data.photos=PHOTOS ...

The recipe is one of `spackle train`; `worlds.KEY=VALUE` are keys of `WorldViews`. OUT gets the same
files, and the same command resumes a run.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field

from spackle.paper.training.measured_photos import find_files
from spackle.paper.training.recipe import (
    MAY_CHANGE_ON_RESUME,
    Count,
    DataRecipe,
    Recipe,
    RecipePart,
    load_recipe,
)
from spackle.paper.training.residual import CACHE, ResidualTask, StoredCrops
from spackle.paper.training.sample_factory import SAMPLES_VERSION, make_samples, short_digest
from spackle.paper.training.train import train
from spackle.render import Renderer
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Reporter
from worlds.second_views import BASES, Base, second_view_source

INTERRUPTED = 130  # the exit status of a run that was stopped by a signal
VIEWS_VERSION = 1  # increases whenever the same worlds would give other training views


class WorldViews(RecipePart):
    """Second views of worlds as training data."""

    folder: Annotated[Path, MAY_CHANGE_ON_RESUME]  # of archives, with its subfolders
    validation: Annotated[Path, MAY_CHANGE_ON_RESUME]  # archives that the run does not learn from
    validation_views: Count = 6  # of each archive: the first world's
    bases: Annotated[tuple[Base, ...], Field(min_length=1)] = BASES  # in turn, one a world
    share: Annotated[float, Field(gt=0, lt=1)] = 0.4  # of all crops


class WorldsRecipe(Recipe):
    """A recipe of the residual, with worlds."""

    worlds: WorldViews


class WorldsTask(ResidualTask):
    """Trains the residual on crops of all usual sources and of second views of worlds."""

    def __init__(self, recipe: WorldsRecipe, device: torch.device) -> None:
        """Find the files of a recipe, without making samples; InputError if they cannot be used."""
        super().__init__(recipe, device)
        if recipe.data.crops is None:
            raise InputError("data.crops=null: views of worlds are cut into crops: set data.crops")
        self.worlds = recipe.worlds
        self.archives = find_archives(recipe.worlds.folder, "worlds.folder")
        self.held_archives = find_archives(recipe.worlds.validation, "worlds.validation")
        shared = {file.name for file in self.archives} & {file.name for file in self.held_archives}
        if shared:
            raise InputError(
                f"worlds.validation: holds {min(shared)}, as worlds.folder does: give each archive "
                "to one of them"
            )
        self.usual_digest = self.digest  # of the crops of the usual sources
        names = [file.name for file in (*self.archives, *self.held_archives)]
        settings = (VIEWS_VERSION, recipe.worlds.bases, recipe.worlds.share)
        self.digest = short_digest((self.usual_digest, settings, names))

    def _make_crops(self, output: Path, reporter: Reporter) -> None:
        """Make the crops that do not exist yet: those of the usual sources, then of the worlds."""
        # The folder of the usual crops is that of `spackle train`, which knows no worlds.
        own_digest = self.digest
        self.digest = self.usual_digest
        super()._make_crops(output, reporter)
        self.digest = own_digest
        assert isinstance(self.training, StoredCrops)
        assert isinstance(self.validation, StoredCrops)

        folder = self.recipe.data.cache or output / CACHE
        make = functools.partial(
            make_world_crops, self.recipe.data, self.worlds.bases, folder, self.renderer, reporter
        )
        training = make(self.archives)
        validation = make(self.held_archives, views=self.worlds.validation_views)
        share = self.worlds.share
        self.training = StoredCrops(mixed(self.training.files, training, share))
        self.validation = StoredCrops(mixed(self.validation.files, validation, share))


def make_world_crops(
    data: DataRecipe,
    bases: Sequence[Base],
    folder: Path,
    renderer: Renderer,
    reporter: Reporter,
    archives: Sequence[Path],
    views: int | None = None,
) -> list[Path]:
    """Make the crops of archives of worlds that do not exist yet; returns the files of all of them.

    Args:
        data: how many crops are cut from a view, and how large.
        bases: as of `second_view_source`.
        folder: gets a folder for each archive, so that more archives leave the others as they are.
        renderer: renders the views.
        reporter: shows progress.
        archives: of worlds.
        views: only the first views of each archive; None: all.
    """
    settings = (SAMPLES_VERSION, VIEWS_VERSION, data.crops, data.cells, tuple(bases))
    crops_folder = folder / short_digest(settings)
    files: list[Path] = []
    with reporter.stage("worlds") as progress:
        for done, archive in enumerate(archives, 1):
            source = second_view_source(archive, bases, renderer)
            assert source.views is not None
            files += make_samples(
                data=data,
                sources=[source],
                folder=crops_folder / archive.stem,
                seed=0,  # decides where crops lie; the views are the worlds'
                views=views or source.views,
                progress=lambda done, count: None,
                warn=reporter.detail,  # views that were refused
            )
            progress(done, len(archives))
    return files


def find_archives(folder: Path, key: str) -> list[Path]:
    """The archives of worlds below a folder, sorted; InputError, which names `key`, without any."""
    return find_files(folder, key, (".tar",), "archives worlds-NNNNN.tar")


def mixed(usual: Sequence[Path], worlds: Sequence[Path], share: float) -> list[Path]:
    """Files of which the fraction `share` are of `worlds`; each file is there at least once.

    Of the kind that is too few, all files are repeated in turn.
    """
    # Either all files of `usual`, and as many of `worlds` as they need, or the other way round.
    usual_count = max(len(usual), round(len(worlds) * (1 - share) / share))
    world_count = max(len(worlds), round(len(usual) * share / (1 - share)))
    return [
        *itertools.islice(itertools.cycle(usual), usual_count),
        *itertools.islice(itertools.cycle(worlds), world_count),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recipe", type=Path, required=True, help="as of `spackle train`")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, help="a folder; a run in it goes on"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="start anew where the folder holds a run"
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="worlds.share=0.5")
    options = parser.parse_intermixed_args(arguments)
    try:
        recipe = load_recipe(WorldsRecipe, options.recipe, options.overrides)
        ended = train(recipe, WorldsTask, options.output, Reporter(), options.overwrite)
    except InputError as error:
        if str(error):  # empty if another process reports the error
            print(f"error: {error}", file=sys.stderr)
        return 2
    return INTERRUPTED if ended == "stopped" else 0


if __name__ == "__main__":
    sys.exit(main())
