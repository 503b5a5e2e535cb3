"""The lite base's task for the training loop: a network learns depth from synthetic and measured
pictures.
"""

from __future__ import annotations

import itertools
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


def colored(values: Tensor, low: float, high: float, known: Tensor | None = None) -> Tensor:
    """[H, W, 3] sRGB of values [H, W]; values up to `low` get the first colour, values from `high`
    the last colour.
    """
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
        """Find a recipe's files, without making scenes or reading frames; InputError if they cannot
        be used.
        """
        self.recipe, self.device, self.files = recipe, device, LiteFiles.of(recipe.data)
        self.network: nn.Module = freeze(first_network(recipe), recipe.optim.frozen)
        self.digest = self.files.digest
        self.items = self.items_per_step = recipe.optim.batch

    def prepare(self, output: Path, reporter: Reporter) -> dict[str, Any]:
        """Make missing scenes and guesses, and read the frames."""
        recipe, files, log, shares = self.recipe, self.files, reporter.log, self.recipe.data.shares
        cache = recipe.data.cache or output / CACHE
        sources: list[tuple[Source, float]] = []

        def make(what: str, folder: Path, fill: Callable[[Progress, Warn], None]) -> None:
            """Make files in the first process; all other processes wait for the files."""
            if rank() == 0:
                make_folder(folder)
                log(f"{what} in {folder}")
                with reporter.stage(what.split(" ", 1)[1]) as step:
                    fill(step, log)
            wait_for_ranks()

        if files.photos:
            data, folder = recipe.data, cache / f"lite-{files.scenes_digest}"
            scenes = SyntheticScenes(folder, files.photos, data.size, data.seed, data.made)
            make(f"{data.made} synthetic scenes", folder, scenes.fill)
            sources.append((Drawn(scenes), shares.made))
        for measured, share in ((files.stereo, shares.stereo), (files.rgbd, shares.rgbd)):
            if measured:
                sources.append((Kept(read_all(measured, LEARNED_SIDE, log)), share))
        if files.guessed:
            folder = cache / f"guesses-{files.guesses_digest}"
            guesses, teacher = GuessedPhotos(folder, files.guessed), recipe.data.teacher
            device = str(self.device)
            make(
                f"{len(files.guessed)} guesses",
                folder,
                lambda step, warn: guesses.fill(LiteBase.load(teacher, device=device), step, warn),
            )
            sources.append((guesses, shares.guessed))
        if files.worlds:
            sources.append((Rooms(files.worlds), shares.worlds))
        self.groups_of_frames = {
            group.name: [frame for _, frame in read_all(group.files, JUDGED_SIDE, log)]
            for group in files.groups
        }
        counts = {
            "made": recipe.data.made if files.photos else 0,
            "stereo": len(files.stereo),
            "rgbd": len(files.rgbd),
        }
        counts |= {"guessed": len(files.guessed)} if files.guessed else {}
        counts |= {"room views": len(files.worlds)} if files.worlds else {}
        judged = {name: len(frames) for name, frames in self.groups_of_frames.items()}
        log(f"to learn from: {_listed(counts)}; to be judged by: {_listed(judged)}")

        height, width = recipe.data.size
        precision = pick_dtype(recipe.optim.precision, self.device)
        self.judge = DepthJudge(recipe.loss, height * width, precision, self.device)
        each, parts = zip(*sources, strict=True)
        self.mixture = Mixture(each, parts, recipe.data.size, recipe.run.seed, recipe.data.scales)
        self.validation_items = len(judged)
        self.measures = (
            *MEASURES,
            *(f"{group}/{name}" for group in judged for name in ("abs_rel", "delta")),
        )
        return {"samples": {"train": counts, "validation": judged, "digest": self.digest}}

    def parameter_groups(self) -> list[dict[str, Any]]:
        """One group of weights for each rate: the pretrained encoder has its own."""
        found: dict[float, list[Tensor]] = {}
        for name, weight in self.network.named_parameters():
            if weight.requires_grad:
                scale = self.recipe.optim.encoder_rate if name.startswith("encoder.") else 1.0
                found.setdefault(scale, []).append(weight)
        return [{"params": weights, "lr_scale": scale} for scale, weights in found.items()]

    def load_batch(
        self, step: int | None, items: Sequence[int]
    ) -> DepthBatch | list[tuple[str, list[Frame]]]:
        """A step's pictures, or groups of validation frames by name; InputError if a file cannot be
        read.
        """
        if step is None:
            return [list(self.groups_of_frames.items())[item] for item in items]
        return self.mixture.batch(step, items)

    def loss(self, network: nn.Module, batch: DepthBatch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of a batch and its terms []."""
        return self.judge.total(network, batch)

    def measure(
        self, network: nn.Module, batch: Sequence[tuple[str, list[Frame]]]
    ) -> dict[str, list[float]]:
        """`MEASURES` of groups, and scores of each group by its name."""
        found: dict[str, list[float]] = {name: [] for name in MEASURES}
        for group, frames in batch:
            each = [self.judge.measure(network, frame) for frame in frames]
            means = {name: sum(one[name] for one in each) / len(each) for name in MEASURES}
            for name, mean in means.items():
                found[name].append(mean)
            found |= {f"{group}/{name}": [means[name]] for name in ("abs_rel", "delta")}
        return found

    @torch.no_grad()
    def draw_picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: for a few validation frames the photo, and predicted and true inverse
        depth.
        """
        each, rows = max(1, MAX_PICTURED_ITEMS // self.validation_items), []
        chosen = [
            group[:: max(1, len(group) // each)][:each] for group in self.groups_of_frames.values()
        ]
        for frame in itertools.chain(*chosen):
            predicted, true = self.judge.predict(network, frame), frame.inverse_depth
            guess = colored(predicted, *ends(predicted[frame.valid]))
            rows.append(
                [
                    frame.rgb.permute(1, 2, 0),
                    guess,
                    colored(true, *ends(true[frame.valid]), frame.valid),
                ]
            )
        return contact_sheet(rows, PICTURE_SIDE_PX)

    def export(self, network: nn.Module, path: Path) -> None:
        """Write the weights in eight bits, for `spackle predict --base lite`."""
        save_networks([cast(LiteNet, network)], path)


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())
