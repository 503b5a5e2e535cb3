"""Compare weights of the residual on true second photos: stereo pairs, and second views of worlds.

    PYTHONPATH=src:research python -m worlds.judge_residual WEIGHTS... --pairs PAIRS \\
        --worlds WORLDS --features squeezenet_v1.0.npz [--sheet sheet.png]

Each view is completed by itself, as the method `spackle` of `spackle evaluate`; --alone leaves out
the texture from patches. PSNR and distance (`spackle.paper.training.losses.hole_distance`) are
measured in the hole. WEIGHTS "shipped" are the package's, and "initial" does without a network.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.depth import lift_rgbd
from spackle.core.camera import Camera
from spackle.formats.png import contact_sheet, save_png
from spackle.paper.training.feature_networks import FeatureNet, load_features
from spackle.paper.training.losses import hole_distance, hole_psnr
from spackle.paper.training.measured_photos import load_pair
from spackle.render import get_renderer
from spackle.residual.architectures import SHIPPED, load_residual
from spackle.residual.features import hole_mask
from spackle.residual.network import ResidualNet
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext, fill_view
from spackle.scene_fill.texture import exemplar_texture
from worlds.second_views import BASES, as_colors, base_of_world, second_view
from worlds.shards import read_view, world_keys

WORLDS_OF_ARCHIVE = 3  # one for each depth by which photos are lifted
JUDGED_VIEWS = (1, 4)
MIN_HOLE = 0.01  # share of a view; the figures of fewer pixels would count as much as all others
SHEET_SIDE_PX = 448  # longer side of a picture on the sheet


class JudgedView(NamedTuple):
    """A view to complete, and what it should show."""

    group: str
    base: BasePrediction
    camera: Camera
    truth: Tensor  # [H, W, 3] sRGB


def views_of_pairs(folder: Path) -> Iterator[JudgedView]:
    """The right cameras' views of all stereo pairs in a folder."""
    for file in sorted(folder.glob("*/scene.json")):
        pair = load_pair(file.parent)
        base = lift_rgbd(pair.left, pair.depth, pair.left_camera)
        yield JudgedView("pairs", base, pair.right_camera, pair.right)


def views_of_worlds(folder: Path) -> Iterator[JudgedView]:
    """Second views of the first worlds of all archives in a folder; each world has another base."""
    renderer = get_renderer()
    for archive in sorted(folder.glob("worlds-*.tar")):
        worlds = world_keys(archive)[:WORLDS_OF_ARCHIVE]
        for number, (key, kind) in enumerate(zip(worlds, BASES, strict=False)):
            try:
                photo = read_view(archive, key, 0)
                base = base_of_world(photo, kind, np.random.default_rng(number))
            except ValueError as error:  # a guess that takes near for far
                print(f"{archive.name} {key}: left out: {error}", file=sys.stderr)
                continue
            for view in JUDGED_VIEWS:
                truth = read_view(archive, key, view)
                try:
                    second_view(base, truth, renderer)
                except ValueError:  # no hole, or a base that does not fit
                    continue
                yield JudgedView(f"worlds, {kind}", base, truth.camera, as_colors(truth.rgb))


@torch.no_grad()
def completed(view: JudgedView, network: ResidualNet | None, alone: bool) -> tuple[Tensor, Tensor]:
    """The completed view [H, W, 3] sRGB, and its hole [H, W] bool before."""
    context = FillContext.of(
        view.base, get_renderer(), network, texture=None if alone else exemplar_texture
    )
    hole = hole_mask(context.renderer.render(context.base, view.camera).alpha)
    return fill_view(context, view.camera).rendering.rgb, hole


def open_network(name: str) -> ResidualNet | None:
    """The network of a file; InputError if it has no weights of the residual."""
    if name == "initial":
        return None
    return load_residual(SHIPPED if name == "shipped" else Path(name))


def judge(
    views: Sequence[JudgedView],
    networks: Sequence[ResidualNet | None],
    features: FeatureNet,
    alone: bool,
) -> tuple[dict[str, list[list[tuple[float, float]]]], list[list[Tensor]]]:
    """PSNR and distance in the holes, by group, for each view and network; and pictures.

    The pictures of a view are the base's rendering, the completed views, and the truth.
    """
    figures: dict[str, list[list[tuple[float, float]]]] = {}
    pictures = []
    for view in views:
        row: list[tuple[float, float]] = []
        rendering = get_renderer().render(view.base.gaussians, view.camera).rgb
        shown = [rendering]
        for network in networks:
            rgb, hole = completed(view, network, alone)
            if float(hole.float().mean()) < MIN_HOLE:
                break
            distance = hole_distance(features, rgb, view.truth, hole)
            row.append((hole_psnr(rgb, view.truth, hole), distance))
            shown.append(rgb)
        if row:
            figures.setdefault(view.group, []).append(row)
            pictures.append([*shown, view.truth])
    return figures, pictures


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("weights", nargs="+", help="files, shipped or initial")
    parser.add_argument("--pairs", type=Path, help="a folder of scenes, each with a scene.json")
    parser.add_argument("--worlds", type=Path, help="a folder of archives worlds-NNNNN.tar")
    parser.add_argument("--features", type=Path, required=True, help="SqueezeNet 1.0's weights")
    parser.add_argument("--alone", action="store_true", help="without texture from patches")
    parser.add_argument("--sheet", type=Path, help="a file for the pictures")
    options = parser.parse_args(arguments)
    try:
        networks = [open_network(name) for name in options.weights]
        features = load_features("squeezenet", options.features)
        assert features is not None
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    views: list[JudgedView] = []
    if options.pairs:
        views += views_of_pairs(options.pairs)
    if options.worlds:
        views += views_of_worlds(options.worlds)
    figures, pictures = judge(views, networks, features, options.alone)

    print("| | weights | distance | PSNR in the hole | views with less distance |")
    print("|---|---|---|---|---|")
    for group, rows in figures.items():
        values = np.array(rows)  # [views, weights, 2]
        for index, name in enumerate(options.weights):
            psnr, distance = values[:, index].mean(0)
            fewer = int((values[:, index, 1] < values[:, 0, 1]).sum())
            print(f"| {group} | {name} | {distance:.4f} | {psnr:.3f} | {fewer} of {len(rows)} |")
    if options.sheet:
        save_png(contact_sheet(pictures, SHEET_SIDE_PX), options.sheet)
    return 0


if __name__ == "__main__":
    sys.exit(main())
