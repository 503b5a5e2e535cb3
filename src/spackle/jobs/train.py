"""`spackle train`: a recipe to weights."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from spackle.bases.sharp.precision import pick_dtype
from spackle.errors import InputError
from spackle.jobs.inputs import make_folder, results_folder
from spackle.jobs.machine import hardware, versions, without_nan
from spackle.jobs.progress import Reporter
from spackle.jobs.report import write_report
from spackle.jobs.stopping import asked_to_stop
from spackle.render import get_renderer
from spackle.residual.network import ResidualNet
from spackle.residual.weights import load_residual
from spackle.training.checkpoint import (
    BEST,
    LAST,
    LOGS,
    NEWEST,
    PREVIOUS,
    RUN,
    Checkpoint,
    Progress,
    check_same_run,
    load_checkpoint,
    remove_run,
)  # fmt: skip
from spackle.training.data import SampleFiles, Supply
from spackle.training.features import load_features
from spackle.training.logs import NoLogs, open_logs
from spackle.training.loop import Trainer, Watch
from spackle.training.ranks import Ranks, joined_ranks
from spackle.training.recipe import DeviceName, Recipe, plain
from spackle.training.recipe_file import load_recipe
from spackle.training.validation import Judge

CACHE = "cache"  # in the output, where the recipe names no other place


def train_recipe(
    path: Path, overrides: Sequence[str], output: Path, reporter: Reporter, *, overwrite: bool = False
) -> str:
    """Train as a recipe says, or go on with a run; one of several processes where torchrun started them.

    Args:
        path: the recipe.
        overrides: `key=value` on top of it.
        output: a folder for all results.
        reporter: the first process speaks through it.
        overwrite: start anew where `output` holds a run; the samples in it stay.

    Returns:
        Why the run ended: "steps", "patience" or "stopped", as `Trainer.run` has it.

    Raises:
        InputError: a recipe, file or folder that cannot be used, a loss that is no number.
    """
    recipe = load_recipe(path, overrides)
    kind = _device_kind(recipe.run.device)
    with joined_ranks(kind) as ranks:
        if recipe.optim.batch % ranks.count:
            raise InputError(f"optim.batch={recipe.optim.batch} cannot be divided between {ranks.count} processes")
        device = torch.device(kind, ranks.local) if kind == "cuda" else torch.device(kind)
        with results_folder(output, (NEWEST, PREVIOUS, BEST, LAST, RUN) if ranks.first else ()):
            return _Job(recipe, output, reporter if ranks.first else _silent(), ranks, device, overwrite).run()


@dataclasses.dataclass(frozen=True)
class _Job:
    """A run and where it takes place."""

    recipe: Recipe
    output: Path
    reporter: Reporter
    ranks: Ranks
    device: torch.device
    overwrite: bool

    def run(self) -> str:
        """Everything that can be refused is refused before long work begins."""
        loss, renderer = self.recipe.loss, get_renderer()
        features = load_features(loss.features if loss.perceptual else "none", loss.features_path, self.device)
        judge = Judge(loss, features, renderer, pick_dtype(self.recipe.optim.precision, self.device), self.device)
        network = _first_network(self.recipe)
        supply = Supply.of(self.recipe.data, renderer)
        checkpoint = self._checkpoint(supply.digest)
        samples = self._samples(supply)
        self.ranks.wait()  # nobody looks for checkpoints any more
        if self.overwrite and self.ranks.first:
            remove_run(self.output)
        name = features.name if features else "none"
        return self._train(network, judge, samples, checkpoint, {"features": name, "samples": _counts(samples)})

    def _checkpoint(self, digest: str) -> Checkpoint | None:
        """The one to go on from."""
        if self.overwrite:
            return None
        checkpoint, problem = load_checkpoint(self.output)
        if checkpoint is None:
            return None
        check_same_run(checkpoint, plain(self.recipe), digest, self.output)
        if problem:
            self.reporter.say(f"{problem}: going on from the one before it")
        self.reporter.say(f"{self.output}: going on from step {checkpoint.progress.step}")
        return checkpoint

    def _samples(self, supply: Supply) -> SampleFiles:
        """Made by the first process, found by the others."""
        folder = self.recipe.data.cache or self.output / CACHE
        passed = _PassedOver(self.reporter)
        if not self.ranks.first:
            self.ranks.wait()
            return supply.samples(folder, _nothing, _nothing, passed.add)
        make_folder(folder)
        seconds: dict[str, float] = {}
        self.reporter.say(f"samples of {supply.data.views + supply.data.validation_views} views in {folder}")
        with self.reporter.stage("samples", seconds) as step:
            samples = supply.samples(folder, step, step, passed.add)
        passed.sum_up()
        self.reporter.say(f"{len(samples.train)} samples to learn from, {len(samples.validation)} to be judged by")
        self.ranks.wait()
        return samples

    def _train(
        self,
        network: ResidualNet,
        judge: Judge,
        samples: SampleFiles,
        checkpoint: Checkpoint | None,
        facts: dict[str, Any],
    ) -> str:
        """The loop, with everything that it talks to."""
        recipe, ranks = self.recipe, self.ranks
        start = checkpoint.progress.step if checkpoint else 0
        facts |= {"precision": str(judge.precision).removeprefix("torch."), "processes": ranks.count}
        facts |= {"recipe": plain(recipe), "versions": versions(), "hardware": hardware(self.device)}
        logs = open_logs(self.output / LOGS, start, self.reporter.say) if ranks.first else NoLogs()

        def write(progress: Progress, ended: str | None = None) -> None:
            write_report(without_nan({**facts, "ended": ended, **dataclasses.asdict(progress)}), self.output / RUN)

        def validated(progress: Progress) -> None:
            self.reporter.say(_summary(progress))
            write(progress)

        with (
            contextlib.closing(logs),
            self.reporter.steps("train", start, recipe.optim.steps) as tell,
            asked_to_stop(alone=ranks.count == 1) as stop,
        ):
            watch = Watch(lambda step, numbers: tell(step, f"loss {numbers['loss']:.4f}"), validated, write, stop)
            trainer = Trainer(recipe, samples, network, judge, self.output, logs, watch, ranks)
            if checkpoint:
                trainer.resume(checkpoint)
            why = trainer.run()
        if ranks.first:
            write(trainer.progress, why)
            self.reporter.say(f"{_END[why]}, step {trainer.progress.step} -> {self.output}")
        return why


_END = {
    "steps": "all steps are done",
    "patience": "no improvement any more",
    "stopped": "stopped; the same command goes on from here",
}


class _PassedOver:
    """Views that could not be made: each reason is said once."""

    def __init__(self, reporter: Reporter) -> None:
        self.reporter, self.views, self.reasons = reporter, 0, set[str]()

    def add(self, line: str) -> None:
        reason = line.partition("passed over: ")[2]
        self.views += 1
        if reason not in self.reasons:
            self.reasons.add(reason)
            self.reporter.say(f"passed over: {reason}")

    def sum_up(self) -> None:
        if self.views:
            self.reporter.say(f"{self.views} views were passed over, for {len(self.reasons)} reasons (above)")


def _first_network(recipe: Recipe) -> ResidualNet:
    """The weights that a run starts from, by its seed or from a file."""
    if recipe.init is not None:
        return load_residual(recipe.init)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.run.seed)
        return ResidualNet()


def _device_kind(name: DeviceName) -> str:
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("run.device=cuda: torch finds no GPU here; use run.device=cpu")
    return ("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name


def _summary(progress: Progress) -> str:
    """The last validation in a line."""
    found = progress.history[-1]
    best = "the best so far" if progress.stale == 0 else f"best {progress.best:.4f} at step {progress.best_step}"
    psnr = f", {found['hole_psnr']:.2f} dB in the hole" if "hole_psnr" in found else ""
    return (
        f"step {progress.step}: validation loss {found['loss']:.4f} ({best}){psnr}, "
        f"holes {found['har_before']:.1%} -> {found['har_after']:.2%}"
    )


def _counts(samples: SampleFiles) -> dict[str, Any]:
    return {"train": len(samples.train), "validation": len(samples.validation), "digest": samples.digest}


def _silent() -> Reporter:
    return Reporter(console=Console(quiet=True))


def _nothing(done: int, total: int) -> None:
    """Nobody is told."""
