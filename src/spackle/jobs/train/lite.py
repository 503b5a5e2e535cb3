"""`spackle train --method lite`: depth from one photo, learned from made scenes and measured frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

from spackle.bases.lite.base import LiteBase
from spackle.bases.lite.network import LiteNet
from spackle.jobs.train.plan import Place, Start, parameters
from spackle.output_folder import make_folder
from spackle.training.depth.files import LiteFiles
from spackle.training.depth.frames import JUDGED_SIDE, LEARNED_SIDE, read_all
from spackle.training.depth.guessed import GuessedPhotos
from spackle.training.depth.judging import DepthJudge
from spackle.training.depth.made import MadeScenes
from spackle.training.depth.method import LiteMethod
from spackle.training.depth.mixture import Drawn, Kept, Mixture, Source
from spackle.training.depth.recipe import LiteRecipe
from spackle.training.depth.start import first_network, freeze
from spackle.training.method import MethodName

CACHE = "cache"  # in the output, where the recipe names no other place


@dataclasses.dataclass(frozen=True)
class LitePlan:
    """Files were found, no scene is made and no frame read."""

    place: Place[LiteRecipe]
    network: LiteNet
    files: LiteFiles

    name: ClassVar[MethodName] = "lite"

    @staticmethod
    def of(place: Place[LiteRecipe]) -> LitePlan:
        """Look for a recipe's files; InputError where they cannot be used."""
        files = LiteFiles.of(place.recipe.data)
        return LitePlan(place, first_network(place.recipe), files)

    @property
    def digest(self) -> str:
        """Of all files by name."""
        return self.files.digest

    def start(self) -> Start:
        """Make the scenes that are missing, and read the frames."""
        place, recipe, files = self.place, self.place.recipe, self.files
        freeze(self.network, recipe.optim.frozen)
        say, shares = place.reporter.say, recipe.data.shares
        sources: list[Source] = []
        parts: list[float] = []
        if files.photos:
            sources.append(Drawn(self._scenes()))
            parts.append(shares.made)
        for measured, share in ((files.stereo, shares.stereo), (files.rgbd, shares.rgbd)):
            if measured:
                sources.append(Kept(read_all(measured, LEARNED_SIDE, say)))
                parts.append(share)
        if files.guessed:
            sources.append(self._guesses())
            parts.append(shares.guessed)
        groups = {group.name: [frame for _, frame in read_all(group.files, JUDGED_SIDE, say)] for group in files.groups}
        counts = {"made": recipe.data.made if files.photos else 0, "stereo": len(files.stereo), "rgbd": len(files.rgbd)}
        counts |= {"guessed": len(files.guessed)} if files.guessed else {}
        judged = {name: len(frames) for name, frames in groups.items()}
        say(f"to learn from: {_listed(counts)}; to be judged by: {_listed(judged)}")

        height, width = recipe.data.size
        judge = DepthJudge(recipe.loss, height * width, place.precision, place.device)
        mixture = Mixture(sources, parts, recipe.data.size, recipe.run.seed, recipe.data.scales)
        method = LiteMethod(mixture, groups, judge, recipe.optim.batch, place.ranks, recipe.run.seed, self.digest)
        samples = {"train": counts, "validation": judged, "digest": self.digest}
        rate = recipe.optim.encoder_rate
        return Start(
            method,
            self.network,
            {"samples": samples, "parameters": parameters(self.network)},
            pace=lambda name: rate if name.startswith("encoder.") else 1.0,
        )

    def _guesses(self) -> GuessedPhotos:
        """Made by the first process, found by the others."""
        place, data = self.place, self.place.recipe.data
        folder = (data.cache or place.output / CACHE) / f"guesses-{self.files.guesses_digest}"
        guesses = GuessedPhotos(folder, self.files.guessed)
        if place.ranks.first:
            make_folder(folder)
            place.reporter.say(f"guesses of {len(self.files.guessed)} photos in {folder}")
            with place.reporter.stage("guesses", {}) as step:
                guesses.fill(LiteBase.load(data.teacher, device=str(place.device)), step, place.reporter.say)
        place.ranks.wait()
        return guesses

    def _scenes(self) -> MadeScenes:
        """Made by the first process, found by the others."""
        place, data = self.place, self.place.recipe.data
        folder = (data.cache or place.output / CACHE) / f"lite-{self.files.scenes_digest}"
        scenes = MadeScenes(folder, self.files.photos, data.size, data.seed, data.made)
        if place.ranks.first:
            make_folder(folder)
            place.reporter.say(f"{data.made} made scenes in {folder}")
            with place.reporter.stage("made scenes", {}) as step:
                scenes.fill(step, place.reporter.say)
        place.ranks.wait()
        return scenes


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
