"""The paper's own method, as the loop sees it: a residual network learns to complete cached samples."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor, nn

from spackle.residual.compose import compose
from spackle.training.cache import load_sample
from spackle.training.checkpoint import export_weights
from spackle.training.data import SampleFiles
from spackle.training.method import MethodName
from spackle.training.step import Batch
from spackle.training.validation import PICTURED, Judge
from spackle.training.view_method import ViewMethod


@dataclasses.dataclass(frozen=True)
class ResidualMethod(ViewMethod):
    """Items are samples, of one size; all of a step go through the network together."""

    samples: SampleFiles
    judge: Judge
    batch: int  # samples of a step, of all processes together
    processes: int = 1

    name: ClassVar[MethodName] = "residual"
    columns: ClassVar[str] = "base, seeds, completed, truth"
    remedy: ClassVar[str] = "delete the samples in the cache and run again"

    @property
    def digest(self) -> str:
        """The samples'."""
        return self.samples.digest

    @property
    def items(self) -> int:
        """Samples to learn from."""
        return len(self.samples.train)

    @property
    def judged_items(self) -> int:
        """Samples to be judged by."""
        return len(self.samples.validation)

    @property
    def items_a_step(self) -> int:
        """One batch."""
        return self.batch

    @property
    def at_once(self) -> int:
        """A process' share of it."""
        return self.batch // self.processes

    def complete(self, network: nn.Module, step: int, items: Sequence[int]) -> Batch:
        """Samples to learn from, completed; InputError where one cannot be read."""
        return self._complete(network, [self.samples.train[item] for item in items])

    def complete_judged(self, network: nn.Module, items: Sequence[int]) -> Batch:
        """Samples to be judged by, likewise."""
        return self._complete(network, [self.samples.validation[item] for item in items])

    def _complete(self, network: nn.Module, files: Sequence[Path]) -> Batch:
        return self.judge.complete(network, [load_sample(file) for file in files])

    @torch.no_grad()
    def picture(self, network: nn.Module) -> Tensor:
        """[n·H, 4·W, 3] sRGB: for each sample the base, the seeds alone, the completed view and the truth."""
        files, rows = self.samples.validation, []
        samples = [load_sample(file) for file in files[:: max(1, len(files) // PICTURED)][:PICTURED]]
        completed = self.judge.complete(network, samples)
        for sample, rgb in zip(samples, completed.rgb, strict=True):
            seeds = compose(sample.seeds.select(sample.cues.mask), None, sample.camera)
            sets = [sample.base, seeds]
            alone = self.judge.renderer.render(sets, sample.camera, tiles=sample.tiles, onto=sample.rendering)
            rows.append(torch.cat([sample.rendering.rgb, alone.rgb, rgb.cpu(), sample.target], dim=1))
        return torch.cat(rows)

    def keep(self, step: int, items: Sequence[int], folder: Path) -> None:
        """Copy samples to a folder."""
        for item in items:
            shutil.copy(self.samples.train[item], folder / self.samples.train[item].name)

    def export(self, network: nn.Module, path: Path) -> None:
        """Weights in half precision, for `spackle predict --residual`."""
        export_weights(network, path)
