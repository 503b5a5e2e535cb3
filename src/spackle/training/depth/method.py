"""The lite base's training, as the loop sees it: a network learns depth from made and measured pictures."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar, cast

import torch
from torch import Tensor, nn

from spackle.bases.lite.network import LiteNet
from spackle.formats import atomic_path
from spackle.training.ahead import Ahead
from spackle.training.depth.augment import Frame
from spackle.training.depth.export import save_networks
from spackle.training.depth.judging import MEASURES, DepthJudge
from spackle.training.depth.mixture import DepthBatch, Mixture
from spackle.training.depth.pictures import colored, ends, sheet
from spackle.training.method import MethodName
from spackle.training.ranks import Ranks
from spackle.training.schedule import samples_of_step
from spackle.training.validation import PICTURED

PICTURE_SIDE = 320  # pixels of a picture's longer side
Wanted = tuple[int, tuple[int, ...]]  # a step, and places in it


@dataclasses.dataclass(frozen=True)
class LiteMethod:
    """Items are a step's places: what stands there is drawn anew in each step. What is judged is a group of frames."""

    mixture: Mixture
    groups: Mapping[str, Sequence[Frame]]
    judge: DepthJudge
    batch: int  # pictures of a step, of all processes together
    ranks: Ranks
    seed: int  # of the run
    digest: str

    name: ClassVar[MethodName] = "lite"
    columns: ClassVar[str] = "photo, predicted inverse depth, true inverse depth"
    remedy: ClassVar[str] = "leave out the files that are named there"
    aim: ClassVar[str] = "abs_rel"

    @property
    def items(self) -> int:
        """One for each picture of a step."""
        return self.batch

    @property
    def judged_items(self) -> int:
        """Groups: each counts as much as another, however many frames it has."""
        return len(self.groups)

    @property
    def items_a_step(self) -> int:
        """All of them."""
        return self.batch

    @property
    def at_once(self) -> int:
        """A process' share of a step."""
        return self.batch // self.ranks.count

    @property
    def measures(self) -> Sequence[str]:
        """Means over groups, and each group's own score."""
        return (*MEASURES, *(f"{group}/{name}" for group in self.groups for name in ("abs_rel", "delta")))

    def loss(self, network: nn.Module, step: int, items: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of a step's pictures and its terms []; InputError where one cannot be read."""
        # The next pictures are drawn while the network learns from these.
        ranks = self.ranks
        following = samples_of_step(step + 1, self.items, self.items_a_step, self.seed, ranks.rank, ranks.count)
        batch = self._ahead.take((step, tuple(items)), (step + 1, tuple(following)))
        return self.judge.total(network, batch)

    def judged(self, network: nn.Module, items: Sequence[int]) -> dict[str, list[float]]:
        """`MEASURES` of groups, and their scores by name."""
        found: dict[str, list[float]] = {name: [] for name in MEASURES}
        for item in items:
            group, frames = list(self.groups.items())[item]
            each = [self.judge.measure(network, frame) for frame in frames]
            means = {name: sum(one[name] for one in each) / len(each) for name in MEASURES}
            for name, mean in means.items():
                found[name].append(mean)
            found |= {f"{group}/{name}": [means[name]] for name in ("abs_rel", "delta")}
        return found

    def words(self, found: Mapping[str, float]) -> str:
        """Beside the guess without a photo, and group by group."""
        groups = ", ".join(f"{group} {found[f'{group}/abs_rel']:.4f}" for group in self.groups)
        return f", a vertical ramp has {found['ramp_abs_rel']:.4f}; {groups}; loss {found['loss']:.4f}"

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[H, W, 3] sRGB: of a few judged frames the photo, and its inverse depth as predicted and as it is."""
        each, rows = max(1, PICTURED // len(self.groups)), []
        chosen = [group[:: max(1, len(group) // each)][:each] for group in self.groups.values()]
        for frame in itertools.chain(*chosen):
            predicted, true = self.judge.predict(network, frame), frame.inverse_depth
            guess = colored(predicted, *ends(predicted[frame.valid]))
            rows.append([frame.rgb.permute(1, 2, 0), guess, colored(true, *ends(true[frame.valid]), frame.valid)])
        return sheet(rows, PICTURE_SIDE)

    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Write where a step's pictures come from."""
        names = {place: self.mixture.name(step, place) for place in items}
        with atomic_path(folder / f"pictures-{self.ranks.rank}.json") as temporary:
            temporary.write_text(json.dumps({"step": step, "pictures": names}, indent=1) + "\n", encoding="utf-8")

    def export(self, network: nn.Module, path: Path) -> None:
        """Weights in eight bits, for `spackle predict --base lite`."""
        save_networks([cast(LiteNet, network)], path)

    @functools.cached_property
    def _ahead(self) -> Ahead[Wanted, DepthBatch]:
        return Ahead(lambda wanted: self.mixture.batch(*wanted))
