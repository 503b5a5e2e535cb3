"""Compare weights of the residual on true second photos: stereo pairs, and second views of worlds.

    PYTHONPATH=src:research python -m worlds.judge_residual WEIGHTS... --pairs PAIRS \\
        --worlds WORLDS --features squeezenet_v1.0.npz [--sheet sheet.png]

A photo is lifted to Gaussians, the base, and rendered at a second camera; the true photo from there
tells what belongs in the holes. Each view is completed by itself, as the method `spackle` of
`spackle evaluate` does it: a residual network completes smooth colours, and texture is copied from
patches elsewhere in the view; --alone leaves out this copying. PSNR and distance
(`spackle.paper.training.losses.hole_distance`) are measured in the hole. WEIGHTS are files,
"shipped" for the package's own, or "initial" for a completion without a network. The first ones are
those that all are compared with.
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
from spackle.cli.script_command import run_script
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
from spackle.runtime.files import check_writable
from spackle.scene_fill import FillContext, fill_view
from spackle.scene_fill.texture import exemplar_texture
from worlds.second_views import DEPTH_KINDS, PHOTO_VIEW, as_colors, base_of_world, is_usable
from worlds.shards import read_view, world_keys

PAIR_FILES = "*/scene.json"  # in a folder of stereo pairs
ARCHIVES = "worlds-*.tar"  # in a folder of made rooms
# The numbers of the second views of a world that are judged: two of six, numbered from 1.
JUDGED_VIEWS = (1, 4)
# Least share of a view that its hole has: figures of a few pixels would count as much as others.
MIN_HOLE = 0.01
SHEET_SIDE_PX = 448  # longer side of a picture on the sheet


class JudgedView(NamedTuple):
    """A view to complete, and what it should show."""

    group: str  # views of one group share rows of the table, such as "pairs"
    base: BasePrediction  # the Gaussians of a photo
    camera: Camera  # beside the photo's: what it sees of the base has holes
    truth: Tensor  # [H, W, 3] sRGB, the true photo from there


class HoleFigures(NamedTuple):
    """How well a completed view shows the truth in its hole."""

    psnr: float  # dB, higher is better
    distance: float  # of SqueezeNet's features, lower is better


class Completion(NamedTuple):
    """A completed view."""

    rgb: Tensor  # [H, W, 3] sRGB
    hole: Tensor  # [H, W] bool, the pixels that were completed


class Judgement(NamedTuple):
    """What `judge` finds. Views with a hole below `MIN_HOLE` are in neither part."""

    figures: dict[str, list[list[HoleFigures]]]  # by group: for each view, for each network
    pictures: list[list[Tensor]]  # for each view: the base's rendering, completed views, the truth


def files_in(folder: Path, pattern: str) -> list[Path]:
    """The sorted files in a folder whose names match a pattern; InputError if there are none."""
    files = sorted(folder.glob(pattern))
    if not files:
        raise InputError(f"{folder}: has no {pattern}: give another folder")
    return files


def views_of_pairs(files: Sequence[Path]) -> Iterator[JudgedView]:
    """The right cameras' views of stereo pairs, each given by its file scene.json."""
    for file in files:
        pair = load_pair(file.parent)
        base = lift_rgbd(pair.left, pair.depth, pair.left_camera)
        yield JudgedView("pairs", base, pair.right_camera, pair.right)


def views_of_worlds(archives: Sequence[Path]) -> Iterator[JudgedView]:
    """Second views of the first worlds of archives of rooms.

    Of each archive the first world's photo is lifted by its true depth, the second's by true depth
    with wrong outlines, the third's by the depth that `lite` guesses (`DEPTH_KINDS`); each kind is
    a group of its own.
    """
    renderer = get_renderer()
    for archive in archives:
        # One world for each kind; an archive may have fewer worlds than there are kinds.
        for number, (key, kind) in enumerate(zip(world_keys(archive), DEPTH_KINDS, strict=False)):
            try:
                photo = read_view(archive, key, PHOTO_VIEW)
                base = base_of_world(photo, kind, np.random.default_rng(number))
            except ValueError as error:  # in most cases: `lite` guesses that near things are far
                print(f"{archive.name} {key}: left out: {error}", file=sys.stderr)
                continue
            for view_number in JUDGED_VIEWS:
                true_view = read_view(archive, key, view_number)
                if is_usable(base, true_view, renderer):
                    truth = as_colors(true_view.rgb)
                    yield JudgedView(f"worlds, {kind}", base, true_view.camera, truth)


@torch.no_grad()
def completed(view: JudgedView, network: ResidualNet | None, alone: bool) -> Completion:
    """The completed view, and the hole that it had before.

    Args:
        view: what to complete.
        network: completes smooth colours; None: they are completed without a network.
        alone: whether texture from patches is left out, so that the network is seen alone.
    """
    context = FillContext.of(
        view.base, get_renderer(), network, texture=None if alone else exemplar_texture
    )
    hole = hole_mask(context.renderer.render(context.base, view.camera).alpha)
    return Completion(fill_view(context, view.camera).rendering.rgb, hole)


def open_network(name: str) -> ResidualNet | None:
    """The network of a file or of the name "shipped"; None, no network, for "initial".

    Raises:
        InputError: the file has no weights of the residual.
    """
    if name == "initial":
        return None
    return load_residual(SHIPPED if name == "shipped" else Path(name))


def judge(
    views: Sequence[JudgedView],
    networks: Sequence[ResidualNet | None],
    features: FeatureNet,
    alone: bool,
) -> Judgement:
    """Figures and pictures of each view, completed by each network.

    Args:
        views: what to complete, and the truth.
        networks: of the residual; None: completes without a network.
        features: SqueezeNet's, by which distances are measured.
        alone: whether texture from patches is left out.
    """
    figures: dict[str, list[list[HoleFigures]]] = {}
    pictures = []
    for view in views:
        view_figures: list[HoleFigures] = []
        rendering = get_renderer().render(view.base.gaussians, view.camera).rgb
        shown = [rendering]
        for network in networks:
            rgb, hole = completed(view, network, alone)
            # All networks fill the same hole, so the first one decides for all.
            if float(hole.float().mean()) < MIN_HOLE:
                break
            psnr = hole_psnr(rgb, view.truth, hole)
            distance = hole_distance(features, rgb, view.truth, hole)
            view_figures.append(HoleFigures(psnr, distance))
            shown.append(rgb)
        if view_figures:
            figures.setdefault(view.group, []).append(view_figures)
            pictures.append([*shown, view.truth])
    return Judgement(figures, pictures)


def print_table(figures: dict[str, list[list[HoleFigures]]], names: Sequence[str]) -> None:
    """Print a Markdown table with a row for each group of views and each network.

    Its last column tells in how many views a network has less distance than the first network.

    Args:
        figures: by group: for each view, for each network.
        names: the networks', in the same order.
    """
    print(f"| | weights | distance | PSNR in the hole | views with less distance than {names[0]} |")
    print("|---|---|---|---|---|")
    for group, views in figures.items():
        psnr = np.array([[one.psnr for one in view] for view in views])  # [views, networks]
        distance = np.array([[one.distance for one in view] for view in views])
        is_less = distance < distance[:, :1]
        for index, name in enumerate(names):
            means = f"{distance[:, index].mean():.4f} | {psnr[:, index].mean():.3f}"
            print(f"| {group} | {name} | {means} | {is_less[:, index].sum()} of {len(views)} |")


def main(arguments: Sequence[str] | None = None) -> None:
    """Judge weights and print a table of them; InputError if the input cannot be used."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "weights",
        nargs="+",
        help="files with weights of the residual; shipped: the package's; initial: no network. "
        "The first are those that the others are compared with",
    )
    parser.add_argument(
        "--pairs", type=Path, help="a folder of stereo pairs, each a folder with a scene.json"
    )
    parser.add_argument(
        "--worlds", type=Path, help="a folder of archives of made rooms, worlds-NNNNN.tar"
    )
    parser.add_argument("--features", type=Path, required=True, help="SqueezeNet 1.0's weights")
    parser.add_argument(
        "--alone",
        action="store_true",
        help="copy no texture from elsewhere into holes",
    )
    parser.add_argument(
        "--sheet", type=Path, help="a PNG file: each view incomplete, completed by all, and true"
    )
    options = parser.parse_args(arguments)
    networks = [open_network(name) for name in options.weights]
    if options.pairs is None and options.worlds is None:
        raise InputError("--pairs or --worlds: give at least one of them")
    pairs = [] if options.pairs is None else files_in(options.pairs, PAIR_FILES)
    archives = [] if options.worlds is None else files_in(options.worlds, ARCHIVES)
    if options.sheet is not None:
        check_writable(options.sheet)
    features = load_features("squeezenet", options.features)
    assert features is not None  # None is only for the name "none"
    views = [*views_of_pairs(pairs), *views_of_worlds(archives)]
    figures, pictures = judge(views, networks, features, options.alone)
    print_table(figures, options.weights)
    if options.sheet:
        save_png(contact_sheet(pictures, SHEET_SIDE_PX), options.sheet)


if __name__ == "__main__":
    sys.exit(run_script(main))
