"""Train the residual as `spackle train` does, with true second views of made worlds among its data.

    PYTHONPATH=src:research python -m worlds.train_residual --recipe cpu -o OUT \\
        worlds.folder=WORLDS worlds.validation=OTHERS data.photos=PHOTOS ...

The recipe is one of `spackle train`, which names the usual sources of training views: photos,
stereo pairs, depth cameras. `worlds.KEY=VALUE` are keys of `WorldViews`. OUT gets the same files as
from `spackle train`, and the same command resumes a run.

Training views are cut into crops, which are stored in files. Files of the usual sources and of
worlds are then mixed.
"""

from __future__ import annotations

import functools
import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field

from spackle.cli.training_command import run_training_command
from spackle.paper.training.measured_photos import find_files
from spackle.paper.training.recipe import (
    MAY_CHANGE_ON_RESUME,
    Count,
    DataRecipe,
    Recipe,
    RecipePart,
)
from spackle.paper.training.residual import CACHE, ResidualTask, StoredCrops
from spackle.paper.training.sample_factory import SAMPLES_VERSION, make_samples, short_digest
from spackle.render import Renderer
from spackle.runtime.errors import InputError
from spackle.runtime.progress import Reporter
from worlds.second_views import DEPTH_KINDS, DepthKind, second_view_source

VIEWS_VERSION = 1  # increases whenever the same worlds would give other training views


class WorldViews(RecipePart):
    """Second views of worlds as training data."""

    # A folder of archives of worlds to learn from, and one of archives for validation alone; both
    # with their subfolders.
    folder: Annotated[Path, MAY_CHANGE_ON_RESUME]
    validation: Annotated[Path, MAY_CHANGE_ON_RESUME]
    validation_views: Count = 6  # of each archive: as many second views as its first world has
    # By what depths the worlds' photos are lifted, in turn, one for each world.
    bases: Annotated[tuple[DepthKind, ...], Field(min_length=1)] = DEPTH_KINDS
    share: Annotated[float, Field(gt=0, lt=1)] = 0.4  # of all files of crops, those of worlds


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
        # The digest that `ResidualTask` has set identifies the crops of the usual sources alone.
        # The own digest of this task identifies all data of a run, to which worlds belong.
        self.usual_digest = self.digest
        names = [file.name for file in (*self.archives, *self.held_archives)]
        settings = (VIEWS_VERSION, recipe.worlds.bases, recipe.worlds.share)
        self.digest = short_digest((self.usual_digest, settings, names))

    def _make_crops(self, output: Path, reporter: Reporter) -> None:
        """Make the crops that do not exist yet, and set `training` and `validation` to all of them.

        Args:
            output: the run's folder; crops lie in its subfolder unless the recipe names a cache.
            reporter: shows progress.
        """
        # First the usual crops. Their folder is named by their digest, so that it is the one that
        # `spackle train` uses, which knows no worlds.
        own_digest = self.digest
        self.digest = self.usual_digest
        super()._make_crops(output, reporter)
        self.digest = own_digest
        assert isinstance(self.training, StoredCrops)
        assert isinstance(self.validation, StoredCrops)

        # Then the worlds' crops.
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
    depth_kinds: Sequence[DepthKind],
    folder: Path,
    renderer: Renderer,
    reporter: Reporter,
    archives: Sequence[Path],
    views: int | None = None,
) -> list[Path]:
    """The files of all crops of second views of worlds; files that are missing are made.

    Args:
        data: how many crops are cut from a view, and how large.
        depth_kinds: by what depths the worlds' photos are lifted, in turn, one for each world.
        folder: gets a folder for each archive, so that crops of the others stay valid when an
            archive comes.
        renderer: renders the lifted photos at second cameras.
        reporter: shows progress, by archives, and says which views cannot be used.
        archives: of worlds.
        views: how many views of each archive, from its first on; None: all.
    """
    # What determines the content of crops; an archive's worlds have its name.
    settings = (SAMPLES_VERSION, VIEWS_VERSION, data.crops, data.cells, tuple(depth_kinds))
    crops_folder = folder / short_digest(settings)
    files: list[Path] = []
    with reporter.stage("worlds") as progress:
        for archives_done, archive in enumerate(archives, 1):
            source = second_view_source(archive, depth_kinds, renderer)
            assert source.views is not None  # an archive has a limited number
            # `make_samples` makes only those files that the folder lacks.
            files += make_samples(
                data=data,
                sources=[source],
                folder=crops_folder / archive.stem,
                seed=0,  # decides where crops lie; the worlds determine the views
                views=views or source.views,
                progress=lambda views_done, view_count: None,  # archives are counted instead
                warn=reporter.detail,  # called for views that cannot be used
            )
            progress(archives_done, len(archives))
    return files


def find_archives(folder: Path, key: str) -> list[Path]:
    """The archives of worlds below a folder, sorted.

    Args:
        folder: where to look, its subfolders included.
        key: the recipe's key that names the folder, for messages.

    Raises:
        InputError: there are none, or no such folder.
    """
    return find_files(folder, key, (".tar",), "archives worlds-NNNNN.tar")


def mixed(usual: Sequence[Path], worlds: Sequence[Path], share: float) -> list[Path]:
    """All files of `usual`, then all of `worlds`; one kind is repeated until the share is right.

    Args:
        usual: files of crops of the usual sources; at least one.
        worlds: files of crops of worlds; at least one.
        share: how much of the result shall be of `worlds`; above 0 and below 1.
    """
    # How many files of one kind give the right share together with all files of the other kind. The
    # kind that has fewer is repeated; the other kind has enough, and stays as it is.
    usual_needed = round(len(worlds) * (1 - share) / share)
    worlds_needed = round(len(usual) * share / (1 - share))
    usual_count = max(len(usual), usual_needed)
    world_count = max(len(worlds), worlds_needed)
    return [
        *itertools.islice(itertools.cycle(usual), usual_count),
        *itertools.islice(itertools.cycle(worlds), world_count),
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status: 0, 2 for bad input, 130 for a stopped run."""
    return run_training_command(
        WorldsRecipe,
        WorldsTask,
        arguments,
        description=__doc__,
        recipe_help="a recipe's name or file, as for `spackle train`",
        overrides_help="settings of the recipe, such as worlds.share=0.5",
    )


if __name__ == "__main__":
    sys.exit(main())
