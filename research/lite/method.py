"""The lite base's training, as the trainer sees it: a network learns depth from synthetic and measured pictures."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import ClassVar, Generic, TypeVar, cast

import torch
from depth_loss import MEASURES, DepthJudge
from frames import Frame
from mixture import DepthBatch, Mixture
from torch import Tensor, nn
from torch.nn.functional import pad
from weights import save_networks

from spackle.bases.lite import LiteNet
from spackle.files import atomic_path
from spackle.formats.png import thumbnail
from spackle.training.method import PICTURED, Method
from spackle.training.ranks import Ranks
from spackle.training.trainer import samples_of_step

PICTURE_SIDE = 320  # pixels of a picture's longer side
Wanted = tuple[int, tuple[int, ...]]  # a step, and places in it
K = TypeVar("K")
V = TypeVar("V")
# Viridis at nine places: even steps to the eye, in grey and for the colour-blind too.
VIRIDIS = torch.tensor(
    [
        (68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 144, 140),
        (39, 173, 129), (93, 200, 99), (170, 220, 50), (253, 231, 37),
    ]
) / 255  # fmt: skip
UNKNOWN = 0.2  # grey of pixels without a value
ENDS = (0.02, 0.98)  # quantiles that have the first and the last colour


def colored(values: Tensor, low: float, high: float, known: Tensor | None = None) -> Tensor:
    """[H, W, 3] sRGB of values [H, W]; low and high are the ends of the colours, and what is beyond them."""
    place = ((values - low) / max(high - low, 1e-12)).clamp(0, 1) * (len(VIRIDIS) - 1)
    below = place.long().clamp_max(len(VIRIDIS) - 2)
    colors = torch.lerp(VIRIDIS[below], VIRIDIS[below + 1], (place - below)[..., None])
    return colors if known is None else torch.where(known[..., None], colors, UNKNOWN)


def ends(values: Tensor) -> tuple[float, float]:
    """The range of colours that shows values [N]."""
    low, high = torch.quantile(values.float(), torch.tensor(ENDS)).tolist()
    return low, high


def sheet(rows: Sequence[Sequence[Tensor]], side: int) -> Tensor:
    """[H, W, 3]: rows of pictures [h, w, 3], each at most `side` long; narrower rows are black at their end."""
    shown = [torch.cat([thumbnail(picture, side) for picture in row], dim=1) for row in rows]
    widest = max(row.shape[1] for row in shown)
    return torch.cat([pad(row, (0, 0, 0, widest - row.shape[1])) for row in shown])


class Prefetch(Generic[K, V]):
    """A function that begins with the next value before it is asked for it: only when, never what, depends on it."""

    def __init__(self, make: Callable[[K], V]) -> None:
        """Make nothing yet.

        Args:
            make: a key to its value, by nothing but the key.
        """
        self._make = make
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
        self._begun: tuple[K, Future[V]] | None = None

    def take(self, key: K, following: K) -> V:
        """The value of `key`; that of `following` is begun. Raises what `make` does."""
        found = self._begun
        future = found[1] if found and found[0] == key else self._worker.submit(self._make, key)
        value = future.result()
        self._begun = following, self._worker.submit(self._make, following)
        return value


class LiteMethod(Method):
    """Items are a step's places, drawn anew in each step. A validation item is a group of frames: each counts alike."""

    name: ClassVar[str] = "lite"
    columns: ClassVar[str] = "photo, predicted inverse depth, true inverse depth"
    remedy: ClassVar[str] = "leave out the files that are named there"
    aim: ClassVar[str] = "abs_rel"

    def __init__(
        self,
        mixture: Mixture,
        groups: Mapping[str, Sequence[Frame]],
        judge: DepthJudge,
        batch: int,
        ranks: Ranks,
        seed: int,
        digest: str,
    ) -> None:
        """`batch` pictures make a step of all processes together; `seed` is the run's."""
        self.mixture, self.groups, self.judge, self.ranks = mixture, groups, judge, ranks
        self.seed, self.digest = seed, digest
        self.items = self.items_a_step = batch
        self.at_once, self.validation_items = batch // ranks.count, len(groups)
        self.measures = (*MEASURES, *(f"{group}/{name}" for group in groups for name in ("abs_rel", "delta")))
        self._prefetch: Prefetch[Wanted, DepthBatch] = Prefetch(lambda wanted: mixture.batch(*wanted))

    def loss(self, network: nn.Module, step: int, items: Sequence[int]) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss [] of a step's pictures and its terms []; InputError where one cannot be read."""
        # The next pictures are drawn while the network learns from these.
        ranks = self.ranks
        following = samples_of_step(step + 1, self.items, self.items_a_step, self.seed, ranks.rank, ranks.count)
        batch = self._prefetch.take((step, tuple(items)), (step + 1, tuple(following)))
        return self.judge.total(network, batch)

    def measure(self, network: nn.Module, items: Sequence[int]) -> dict[str, list[float]]:
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

    def describe(self, found: Mapping[str, float]) -> str:
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
