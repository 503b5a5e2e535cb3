"""Trained residual weights beside the seeds alone, on stereo pairs whose right photo is the truth, as Markdown tables.

    python benchmarks/residual.py FOLDER --features squeezenet_v1.0.npz [--residual FILE] [--pictures OUT] [--no-swipes]

FOLDER holds one folder a scene, as for `benchmarks/stereo_pairs.py`. The first table completes the right camera's view:
the perceptual distance in the hole (see `spackle.training.distance.hole_distance`: SqueezeNet's conv1, fire4, fire8 and
fire9), PSNR in the hole and outside of it. The second completes a whole swipe in one scene and looks at its ends: the
share of holes before and after. --pictures draws base, seeds, trained and truth side by side.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import torch
from torch import Tensor

from spackle import Completer, Gaussians, get_renderer, hole_area_ratio, hole_mask
from spackle.bases.lift import lift
from spackle.formats import save_png
from spackle.residual import ResidualNet
from spackle.residual.network import SHIPPED, load_residual
from spackle.scene import scene_path
from spackle.training.features import FeatureNet, load_features
from spackle.training.losses import hole_distance, hole_psnr
from spackle.training.sources import load_pair

DISPARITIES = (0.3, 0.4, 0.5)
FRAMES = 60
PAIR_COLUMNS = ["scene", "HAR", "distance: seeds", "trained", "hole PSNR: seeds", "trained"]
PAIR_COLUMNS += ["outside: base", "seeds", "trained", "HAR after / before"]


class Scene:
    """A pair, lifted, with a completer for each way of filling."""

    def __init__(self, folder: Path, network: ResidualNet) -> None:
        self.name, self.renderer = folder.name, get_renderer()
        left, self.right, depth, self.camera, self.beside = load_pair(folder)
        self.base = lift(left, depth, self.camera).gaussians
        ways = {"seeds": None, "trained": network}
        self.ways = {k: Completer(self.base, self.camera, self.renderer, net) for k, net in ways.items()}

    def pair(self, features: FeatureNet) -> tuple[list[float], list[Tensor]]:
        """Numbers of the right camera's view, and its pictures."""
        before = self.renderer.render(self.base, self.beside)
        hole = hole_mask(before.alpha)
        views = {name: way.completed_view(self.beside, rendering=before)[1] for name, way in self.ways.items()}
        both = [view.rgb for view in views.values()]
        numbers = [hole_area_ratio(before.alpha)]
        numbers += [hole_distance(features, rgb, self.right, hole) for rgb in both]
        numbers += [hole_psnr(rgb, self.right, hole) for rgb in both]
        numbers += [hole_psnr(rgb, self.right, ~hole) for rgb in (before.rgb, *both)]
        numbers += [hole_area_ratio(views["trained"].alpha) / hole_area_ratio(before.alpha)]
        return numbers, [before.rgb, *both, self.right]

    def swipe(self, disparity: float) -> tuple[float, float]:
        """HAR before and after at the ends of a swipe, completed in one scene with the trained weights."""
        path = scene_path(self.base, self.camera, "swipe", disparity, FRAMES)
        aux = self.ways["trained"].complete_scene(path)

        def share(gaussians: list[Gaussians]) -> float:
            ends = (self.renderer.render(gaussians, end).alpha for end in (path[0], path[-1]))
            return sum(hole_area_ratio(alpha) for alpha in ends) / 2

        return share([self.base]), share([self.base, aux])


def row_of(name: str, values: Sequence[float]) -> str:
    """A Markdown row."""
    return f"| {name} | {' | '.join(f'{value:.4f}' if value < 1 else f'{value:.2f}' for value in values)} |"


def print_table(columns: Sequence[str], rows: Iterable[tuple[str, list[float]]]) -> list[float]:
    """Markdown, each row as soon as it is there; prints and returns the mean of each column."""
    print(f"\n| {' | '.join(columns)} |\n{'|---' * len(columns)}|", flush=True)
    values = []
    for name, row in rows:
        values.append(row)
        print(row_of(name, row), flush=True)
    mean: list[float] = torch.tensor(values, dtype=torch.float64).mean(0).tolist()
    print(row_of("mean", mean), flush=True)
    return mean


@torch.no_grad()
def main() -> None:
    """Both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--features", type=Path, required=True, help="SqueezeNet 1.0's weights")
    parser.add_argument("--residual", type=Path, default=SHIPPED)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--no-swipes", action="store_true", help="the first table alone, in a minute or two")
    arguments = parser.parse_args()
    features = load_features("squeezenet", arguments.features)
    network = load_residual(arguments.residual)
    assert features is not None
    scenes = [Scene(path.parent, network) for path in sorted(arguments.folder.glob("*/scene.json"))]

    def pairs() -> Iterator[tuple[str, list[float]]]:
        for scene in scenes:
            numbers, pictures = scene.pair(features)
            if arguments.pictures:
                arguments.pictures.mkdir(parents=True, exist_ok=True)
                save_png(torch.cat(pictures, dim=1), arguments.pictures / f"{scene.name}.png")
            yield scene.name, numbers

    def swipes() -> Iterator[tuple[str, list[float]]]:
        for scene in scenes:
            yield scene.name, [value for disparity in DISPARITIES for value in scene.swipe(disparity)]

    mean = print_table(PAIR_COLUMNS, pairs())
    print(f"\nPerceptual distance in the hole: {mean[2] / mean[1] - 1:+.1%} against the seeds.", flush=True)
    if not arguments.no_swipes:
        print_table(["scene", *(f"{d:g} {when}" for d in DISPARITIES for when in ("before", "after"))], swipes())


if __name__ == "__main__":
    main()
