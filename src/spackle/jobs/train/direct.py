"""`spackle train --method direct-ft`: SHARP's own decoder, on a dataset that the same SHARP has made."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

from spackle.bases.sharp.checkpoint import Owner, owner_of, read_checkpoint_tensors
from spackle.bases.sharp.tuning import TunableSharp
from spackle.digest import weights_digest
from spackle.downloads import check_recorded, installed
from spackle.errors import InputError
from spackle.jobs.train.judge import feature_name, judge_of
from spackle.jobs.train.plan import Place, Start, parameters
from spackle.training.direct_ft import DirectFt
from spackle.training.method import MethodName
from spackle.training.pseudo_photos import VIEWS_AT_ONCE, PseudoPhotos, only_dataset
from spackle.training.recipe import Recipe
from spackle.training.validation import Judge


@dataclasses.dataclass(frozen=True)
class DirectPlan:
    """A checkpoint and a dataset that belong together; the network is not loaded."""

    place: Place[Recipe]
    judge: Judge
    owner: Owner
    photos: PseudoPhotos

    name: ClassVar[MethodName] = "direct-ft"

    @staticmethod
    def of(place: Place[Recipe], checkpoint: Path | None) -> DirectPlan:
        """Look at the files.

        Args:
            place: whose recipe has no data but data.pseudo.
            checkpoint: SHARP's; the downloaded one where None.

        Raises:
            InputError: a recipe, checkpoint or dataset that cannot be used.
        """
        judge, recipe, least = judge_of(place), place.recipe, VIEWS_AT_ONCE * place.ranks.count
        if recipe.optim.batch % least:
            raise InputError(
                f"optim.batch={recipe.optim.batch}: with --method direct-ft each process takes {VIEWS_AT_ONCE} views "
                f"of a photo at a time: give a multiple of {least}"
            )
        if recipe.init is not None:
            raise InputError(f"init={recipe.init}: --method direct-ft starts from SHARP's checkpoint: leave it out")
        data = only_dataset(recipe.data)
        owner = _owner(checkpoint)
        return DirectPlan(place, judge, owner, PseudoPhotos.of(recipe.data, data, owner.sha256))

    @property
    def digest(self) -> str:
        """The dataset's."""
        return self.photos.digest

    def start(self) -> Start:
        """Load SHARP."""
        recipe, judge = self.place.recipe, self.judge
        base = TunableSharp.load(self.owner.path, judge.precision, judge.device)
        decoder = base.network.gaussian_decoder().let_learn()
        counts = parameters(base.network)
        method = DirectFt(base, self.owner, self.photos, judge, recipe.optim.batch, recipe.run.seed)
        self.place.reporter.say(
            f"{method.items} photos to learn from, {method.judged_items} to be judged by; "
            f"{counts['learn']:,} weights of SHARP learn, {counts['stay']:,} stay"
        )
        samples = {"train": method.items, "validation": method.judged_items, "digest": self.digest}
        weights = {"file": self.owner.path.name, "sha256": self.owner.sha256}
        facts = {"features": feature_name(judge), "samples": samples, "parameters": counts, "checkpoint": weights}
        return Start(method, decoder, facts)


def _owner(checkpoint: Path | None) -> Owner:
    """The checkpoint that learns, held to its record where it was downloaded."""
    path = checkpoint or installed("sharp")
    if path is None:
        raise InputError(
            "--method direct-ft: no weights of SHARP on this machine: `spackle weights get sharp` downloads them "
            "(2.8 GB, for research only), -c FILE takes a local copy"
        )
    read_checkpoint_tensors(path)  # refuses what is none, and reads no numbers yet
    if owner_of(path) is not None:
        raise InputError(f"-c {path}: a decoder that was trained already: give the checkpoint that it was trained on")
    record = check_recorded(path)
    return Owner(path, weights_digest(path) if record is None else record.sha256)
