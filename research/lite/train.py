"""Trains the network of the lite base: depth from one photo, learned from synthetic scenes and measured frames.

    python research/lite/train.py --recipe research/lite/lite.yaml -o OUT data.photos=PHOTOS data.stereo=PAIRS ...

OUT gets what `spackle train` leaves; the same command goes on with a run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from depth_loss import DepthJudge
from frames import JUDGED_SIDE, LEARNED_SIDE, read_all
from method import LiteMethod
from mixture import Drawn, GuessedPhotos, Kept, Mixture, Source
from recipe import LiteFiles, LiteRecipe
from synthetic_scenes import SyntheticScenes
from weights import first_network, freeze

from spackle.bases.lite import LiteBase, LiteNet
from spackle.errors import InputError
from spackle.files import make_folder
from spackle.progress import Reporter
from spackle.training.method import CACHE, Plan, RunContext, Start, parameters
from spackle.training.recipe import load_recipe
from spackle.training.run import train
from spackle.training.trainer import adamw

INTERRUPTED = 130  # the exit status of a run that somebody has stopped


def plan_lite(context: RunContext[LiteRecipe]) -> Plan:
    """Find a recipe's files, make no scene and read no frame yet; InputError where they cannot be used."""
    files = LiteFiles.of(context.recipe.data)
    network = first_network(context.recipe)
    return Plan(LiteMethod.name, files.digest, lambda: _start(context, network, files))


def _start(context: RunContext[LiteRecipe], network: LiteNet, files: LiteFiles) -> Start:
    """Make the scenes that are missing, and read the frames."""
    recipe, log, shares = context.recipe, context.reporter.log, context.recipe.data.shares
    freeze(network, recipe.optim.frozen)
    sources: list[Source] = []
    parts: list[float] = []
    if files.photos:
        sources.append(Drawn(_make_scenes(context, files)))
        parts.append(shares.made)
    for measured, share in ((files.stereo, shares.stereo), (files.rgbd, shares.rgbd)):
        if measured:
            sources.append(Kept(read_all(measured, LEARNED_SIDE, log)))
            parts.append(share)
    if files.guessed:
        sources.append(_make_guesses(context, files))
        parts.append(shares.guessed)
    groups = {group.name: [frame for _, frame in read_all(group.files, JUDGED_SIDE, log)] for group in files.groups}
    counts = {"made": recipe.data.made if files.photos else 0, "stereo": len(files.stereo), "rgbd": len(files.rgbd)}
    counts |= {"guessed": len(files.guessed)} if files.guessed else {}
    judged = {name: len(frames) for name, frames in groups.items()}
    log(f"to learn from: {_listed(counts)}; to be judged by: {_listed(judged)}")

    height, width = recipe.data.size
    judge = DepthJudge(recipe.loss, height * width, context.precision, context.device)
    mixture = Mixture(sources, parts, recipe.data.size, recipe.run.seed, recipe.data.scales)
    method = LiteMethod(mixture, groups, judge, recipe.optim.batch, context.ranks, recipe.run.seed, files.digest)
    facts = {
        "samples": {"train": counts, "validation": judged, "digest": files.digest},
        "parameters": parameters(network),
    }
    # The encoder, which comes with weights of its own, learns at a rate of its own; those of one rate are one group.
    groups_of: dict[float, list[object]] = {}
    for name, weight in network.named_parameters():
        if weight.requires_grad:
            scale = recipe.optim.encoder_rate if name.startswith("encoder.") else 1.0
            groups_of.setdefault(scale, []).append(weight)
    optimizer = adamw([{"params": weights, "lr_scale": scale} for scale, weights in groups_of.items()], recipe)
    return Start(method, network, facts, optimizer)


def _make_guesses(context: RunContext[LiteRecipe], files: LiteFiles) -> GuessedPhotos:
    """The first process makes them, the others find them."""
    data, reporter = context.recipe.data, context.reporter
    folder = (data.cache or context.output / CACHE) / f"guesses-{files.guesses_digest}"
    guesses = GuessedPhotos(folder, files.guessed)
    if context.ranks.first:
        make_folder(folder)
        reporter.log(f"guesses of {len(files.guessed)} photos in {folder}")
        with reporter.stage("guesses") as step:
            guesses.fill(LiteBase.load(data.teacher, device=str(context.device)), step, reporter.log)
    context.ranks.wait()
    return guesses


def _make_scenes(context: RunContext[LiteRecipe], files: LiteFiles) -> SyntheticScenes:
    """The first process makes them, the others find them."""
    data, reporter = context.recipe.data, context.reporter
    folder = (data.cache or context.output / CACHE) / f"lite-{files.scenes_digest}"
    scenes = SyntheticScenes(folder, files.photos, data.size, data.seed, data.made)
    if context.ranks.first:
        make_folder(folder)
        reporter.log(f"{data.made} synthetic scenes in {folder}")
        with reporter.stage("synthetic scenes") as step:
            scenes.fill(step, reporter.log)
    context.ranks.wait()
    return scenes


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {name}" for name, count in counts.items())


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipe", type=Path, required=True, help="a YAML file")
    parser.add_argument("-o", "--output", type=Path, required=True, help="a folder; a run in it goes on")
    parser.add_argument("--overwrite", action="store_true", help="start anew where the folder holds a run")
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="in place of the recipe's: optim.steps=100")
    options = parser.parse_intermixed_args(arguments)
    try:
        recipe = load_recipe(LiteRecipe, options.recipe, options.overrides)
        ended = train(recipe, plan_lite, options.output, Reporter(), options.overwrite)
    except InputError as error:
        if str(error):  # else another process speaks
            print(f"error: {error}", file=sys.stderr)
        return 2
    return INTERRUPTED if ended == "stopped" else 0


if __name__ == "__main__":
    sys.exit(main())
