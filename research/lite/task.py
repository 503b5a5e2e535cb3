"""The lite base's task for the training loop: a network learns depth from pictures with depth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, cast

import torch
from depth_loss import MEASURES, DepthJudge
from frames import JUDGED_SIDE, LEARNED_SIDE, Frame, read_all
from made_rooms import Rooms
from mixture import DepthBatch, Drawn, GuessedPhotos, Kept, Mixture, Source
from recipe import LiteFiles, LiteRecipe
from synthetic_scenes import SyntheticScenes, Warn
from torch import Tensor, nn
from weights import first_network, freeze, save_networks

from spackle.bases.lite import LiteBase, LiteNet
from spackle.formats.png import contact_sheet
from spackle.paper.training.ranks import rank, wait_for_ranks
from spackle.paper.training.residual import CACHE, MAX_PICTURED_ITEMS
from spackle.paper.training.task import Task
from spackle.runtime.device import pick_dtype
from spackle.runtime.folders import make_folder
from spackle.runtime.progress import Progress, Reporter

PICTURE_SIDE_PX = 320  # pixels of a picture's longer side
# Nine colours of Viridis, which is perceptually uniform, also in grey and for colour-blind readers.
VIRIDIS = torch.tensor(
    [
        (68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 144, 140),
        (39, 173, 129), (93, 200, 99), (170, 220, 50), (253, 231, 37),
    ]
) / 255  # fmt: skip
UNKNOWN = 0.2  # grey of pixels without a value
ENDS = (0.02, 0.98)  # quantiles that get the first and the last colour
GROUP_MEASURES = ("abs_rel", "delta")  # the measures that are also reported of each group


def colored(values: Tensor, low: float, high: float, known: Tensor | None = None) -> Tensor:
    """[H, W, 3] sRGB: values as colours from dark blue to yellow.

    Args:
        values: [H, W].
        low, high: values up to `low` get the first colour, those from `high` on the last one.
        known: [H, W] bool: all other pixels get grey; None: all are known.
    """
    # In the list of colours: 1.3 is 30 % of the way from the second colour to the third.
    place = ((values - low) / max(high - low, 1e-12)).clamp(0, 1) * (len(VIRIDIS) - 1)
    below = place.long().clamp_max(len(VIRIDIS) - 2)
    colors = torch.lerp(VIRIDIS[below], VIRIDIS[below + 1], (place - below)[..., None])
    return colors if known is None else torch.where(known[..., None], colors, UNKNOWN)


def ends(values: Tensor) -> tuple[float, float]:
    """The values of [N] that get the first and the last colour."""
    low, high = torch.quantile(values.float(), torch.tensor(ENDS)).tolist()
    return low, high


class LiteTask(Task):
    """Trains the lite base; items are indices in a batch, validation items are groups of frames."""

    name: ClassVar[str] = "lite"
    selection_measure: ClassVar[str] = "abs_rel"

    def __init__(self, recipe: LiteRecipe, device: torch.device) -> None:
        """Find a recipe's files, without making scenes or reading frames.

        InputError if they cannot be used.
        """
        self.recipe = recipe
        self.device = device
        self.files = LiteFiles.of(recipe.data)
        self.network: nn.Module = freeze(first_network(recipe), recipe.optim.frozen)
        self.digest = self.files.digest
        # Batches are drawn at random, without end: a step uses all items there are.
        self.items = recipe.optim.batch
        self.items_per_step = recipe.optim.batch

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Make missing scenes and guesses, and read the frames.

        Args:
            output: the run's folder; scenes and guesses lie in its subfolder unless the recipe
                names a cache.
            reporter: shows progress.

        Returns:
            What the run's summary says of its data.
        """
        recipe = self.recipe
        files = self.files
        log = reporter.log
        sources = self._training_sources(recipe.data.cache or output / CACHE, reporter)
        self.groups_of_frames = {
            group.name: [frame for _, frame in read_all(group.files, JUDGED_SIDE, log)]
            for group in files.groups
        }

        # How many frames there are of each source, and of each validation group.
        counts = {
            "made": recipe.data.made if files.photos else 0,
            "stereo": len(files.stereo),
            "rgbd": len(files.rgbd),
        }
        if files.photos_to_guess:
            counts["guessed"] = len(files.photos_to_guess)
        if files.worlds:
            counts["room views"] = len(files.worlds)
        group_counts = {name: len(frames) for name, frames in self.groups_of_frames.items()}
        log(f"to learn from: {_listed(counts)}; to be judged by: {_listed(group_counts)}")

        height, width = recipe.data.size
        precision = pick_dtype(recipe.optim.precision, self.device)
        self.judge = DepthJudge(recipe.loss, height * width, precision, self.device)
        self.mixture = Mixture(
            [source for source, _ in sources],
            [share for _, share in sources],
            recipe.data.size,
            recipe.run.seed,
            recipe.data.scales,
        )
        self.validation_items = len(group_counts)
        of_groups = [f"{group}/{name}" for group in group_counts for name in GROUP_MEASURES]
        self.measures = (*MEASURES, *of_groups)
        return {"samples": {"train": counts, "validation": group_counts, "digest": self.digest}}

    def _training_sources(self, cache: Path, reporter: Reporter) -> list[tuple[Source, float]]:
        """All sources of training frames, with their relative shares; missing files are made.

        Args:
            cache: gets a folder of synthetic scenes and one of guesses.
            reporter: shows progress.
        """
        data = self.recipe.data
        files = self.files
        log = reporter.log

        def make(
            count: int, what: str, folder: Path, fill: Callable[[Progress, Warn], None]
        ) -> None:
            """Make files in the first process; all other processes wait for the files."""
            if rank() == 0:
                make_folder(folder)
                log(f"{count} {what} in {folder}")
                with reporter.stage(what) as progress:
                    fill(progress, log)
            wait_for_ranks()

        sources: list[tuple[Source, float]] = []
        if files.photos:
            folder = cache / f"lite-{files.scenes_digest}"
            scenes = SyntheticScenes(folder, files.photos, data.size, data.seed, data.made)
            make(data.made, "synthetic scenes", folder, scenes.fill)
            sources.append((Drawn(scenes), data.shares.made))
        if files.stereo:
            sources.append((Kept(read_all(files.stereo, LEARNED_SIDE, log)), data.shares.stereo))
        if files.rgbd:
            sources.append((Kept(read_all(files.rgbd, LEARNED_SIDE, log)), data.shares.rgbd))
        if files.photos_to_guess:
            folder = cache / f"guesses-{files.guesses_digest}"
            guesses = GuessedPhotos(folder, files.photos_to_guess)

            def fill_guesses(progress: Progress, warn: Warn) -> None:
                """Make missing guesses; the teacher is loaded only in the process that does so."""
                teacher = LiteBase.load(data.teacher, device=str(self.device))
                guesses.fill(teacher, progress, warn)

            make(len(files.photos_to_guess), "guesses", folder, fill_guesses)
            sources.append((guesses, data.shares.guessed))
        if files.worlds:
            sources.append((Rooms(files.worlds), data.shares.worlds))
        return sources

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Groups of weights for the optimiser, one for each factor on the learning rate.

        The pretrained encoder has a factor of its own; frozen weights are in no group.
        """
        weights_by_factor: dict[float, list[Tensor]] = {}
        for name, weight in self.network.named_parameters():
            if weight.requires_grad:
                factor = self.recipe.optim.encoder_rate if name.startswith("encoder.") else 1.0
                weights_by_factor.setdefault(factor, []).append(weight)
        return [
            {"params": weights, "lr_scale": factor} for factor, weights in weights_by_factor.items()
        ]

    def load_batch(
        self, step: int | None, items: Sequence[int]
    ) -> DepthBatch | list[tuple[str, list[Frame]]]:
        """A step's pictures, or groups of validation frames with their names.

        Args:
            step: number of the training step; None: validation.
            items: indices in the step's batch, or of validation groups.

        Raises:
            InputError: a file cannot be read.
        """
        if step is None:
            groups = list(self.groups_of_frames.items())
            return [groups[item] for item in items]
        return self.mixture.batch(step, items)

    def loss(self, network: nn.Module, batch: DepthBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of a batch and its terms []."""
        return self.judge.total(network, batch)

    def measure(
        self, network: nn.Module, batch: Sequence[tuple[str, list[Frame]]]
    ) -> dict[str, list[float]]:
        """Measure a network on groups of validation frames.

        Args:
            network: the network.
            batch: the groups: their names, and their frames.

        Returns:
            For each name in MEASURES a list, with the mean over the frames of each group. Also, to
            show how each group fares, its main scores: "NAME/abs_rel" and "NAME/delta", with the
            group's name, are lists of one value.
        """
        values: dict[str, list[float]] = {name: [] for name in MEASURES}
        for group, frames in batch:
            frame_scores = [self.judge.measure(network, frame) for frame in frames]
            for name in MEASURES:
                mean = sum(scores[name] for scores in frame_scores) / len(frame_scores)
                values[name].append(mean)
                if name in GROUP_MEASURES:
                    values[f"{group}/{name}"] = [mean]
        return values

    @torch.no_grad()
    def draw_picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: photos of a few validation frames, with two pictures beside each.

        These are the predicted and the true inverse depth.
        """
        per_group = max(1, MAX_PICTURED_ITEMS // self.validation_items)
        rows = []
        for group in self.groups_of_frames.values():
            step = max(1, len(group) // per_group)  # frames are evenly spaced in their group
            for frame in group[::step][:per_group]:
                photo = frame.rgb.permute(1, 2, 0)
                predicted = self.judge.predict(network, frame)
                low, high = ends(predicted[frame.valid])
                predicted_picture = colored(predicted, low, high)
                true = frame.inverse_depth
                low, high = ends(true[frame.valid])
                true_picture = colored(true, low, high, frame.valid)
                rows.append([photo, predicted_picture, true_picture])
        return contact_sheet(rows, PICTURE_SIDE_PX)

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the weights in eight bits, for `spackle predict --base lite`."""
        save_networks([cast(LiteNet, network)], path)


def _listed(counts: Mapping[str, int]) -> str:
    """Counts with their names in a line: "40 made, 2 stereo"."""
    return ", ".join(f"{count} {name}" for name, count in counts.items())
