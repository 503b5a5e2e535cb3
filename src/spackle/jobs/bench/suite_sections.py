"""The suite's sections with what they work on: scenes, photos, weights, renderers."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from spackle.bases.lift import lift
from spackle.bases.sharp import SharpBase
from spackle.digest import weights_digest
from spackle.errors import InputError
from spackle.evaluation.suite import limits, scaling
from spackle.evaluation.suite import renderer as drawing
from spackle.evaluation.suite.clock import CPU
from spackle.evaluation.suite.completion import completion_section
from spackle.evaluation.suite.gpu import gpu_view_section
from spackle.evaluation.suite.scenes import SIDE, holed_scene
from spackle.evaluation.suite.sharp import sharp_section
from spackle.evaluation.suite.tables import GPU_LIMITS, LIMITS
from spackle.evaluation.suite.training import BATCH, CELLS, training_section
from spackle.evaluation.suite.values import Found
from spackle.evaluation.suite.video import FRAMES, video_section
from spackle.jobs.bench.suite_options import SuiteOptions
from spackle.jobs.demo import load_motorcycle
from spackle.render import CpuRenderer, GsplatRenderer, Renderer
from spackle.residual import ResidualNet
from spackle.residual.network import load_residual

NO_SHARP = "no weights: -c FILE names some, --base sharp takes those that are installed"


@dataclasses.dataclass(frozen=True)
class Sections:
    """All sections by their names, for one set of options."""

    options: SuiteOptions

    def run(self, name: str) -> Found:
        """Measure one.

        Raises:
            InputError: it cannot be run here, and why.
        """
        calls: dict[str, Callable[[], Found]] = {
            LIMITS: lambda: self._limits(CPU),
            "renderer": lambda: drawing.renderer_section(self.options.runs, self.options.side),
            "scaling": lambda: scaling.scaling_section(self.options.runs, self.options.side),
            "completion": lambda: self._completion(CpuRenderer(), CPU),
            "photo": self._photo,
            "video": self._video,
            "sharp": lambda: self._sharp(CPU),
            "training": lambda: self._training(CPU),
        }
        on_gpu: dict[str, Callable[[torch.device], Found]] = {
            GPU_LIMITS: self._limits,
            "gpu-view": lambda device: gpu_view_section(self.options.runs, GsplatRenderer(device), self.options.side),
            "gpu-completion": lambda device: self._completion(GsplatRenderer(device), device),
            "gpu-sharp": self._sharp,
            "gpu-training": self._training,
        }
        if name in calls:
            return calls[name]()
        if self.options.gpu_problem:
            raise InputError(self.options.gpu_problem)
        try:
            return on_gpu[name](torch.device("cuda"))
        except RuntimeError as error:  # a card that is too small, or a driver that is too old: the rest goes on
            raise InputError(f"{type(error).__name__}: {(str(error).splitlines() or [''])[0][:200]}") from error

    def inputs(self, name: str) -> dict[str, Any] | None:
        """What decides a section's figures besides the suite's configuration; None: without it nothing can be run."""
        if name in ("sharp", "gpu-sharp"):
            if self._checkpoint is None:
                return None
            base = self.options.base
            settings = {"precision": base.precision, "low_memory": base.low_memory, "runs": self.options.base_runs}
            variants = {"compiled": self.options.compiled, "windows": list(self.options.windows)}
            return {"weights": weights_digest(self._checkpoint), **settings, **variants}
        if name in ("completion", "photo", "gpu-completion"):
            return {"compiled": self.options.compiled}
        return {}

    @functools.cached_property
    def _network(self) -> ResidualNet | None:
        file = self.options.base.residual_file
        return None if file is None else load_residual(file)

    @property
    def _checkpoint(self) -> Path | None:
        return self.options.base.base_files.get("checkpoint") if self.options.sharp else None

    @property
    def _small(self) -> bool:
        """A run at less than the full size is for trying things out: everything is small, then."""
        return self.options.side < SIDE

    def _limits(self, device: torch.device) -> Found:
        side = limits.SIDE * self.options.side // SIDE if self._small else limits.SIDE
        megabytes = limits.COPY_MB * self.options.side / SIDE if self._small else limits.COPY_MB
        return limits.limits_section(self.options.runs, device, side, megabytes)

    def _completion(self, renderer: Renderer, device: torch.device) -> Found:
        base, camera = holed_scene(self.options.side)
        return self._complete(base, camera, renderer, device)

    def _photo(self) -> Found:
        pair = load_motorcycle()
        prediction = lift(pair.left, pair.depth, pair.left_camera)
        return self._complete(prediction.gaussians, prediction.camera, CpuRenderer(), CPU)

    def _complete(self, base: Any, camera: Any, renderer: Renderer, device: torch.device) -> Found:
        more: dict[str, Any] = {"compiled": self.options.compiled, "device": device}
        return completion_section(self.options.runs, base, camera, renderer, self._network, **more)

    def _video(self) -> Found:
        pair = load_motorcycle()
        frames = FRAMES if not self._small else 4
        lifting = functools.partial(lift, pair.left, pair.depth, pair.left_camera)
        return video_section(self.options.runs, lifting, CpuRenderer(), self._network, frames)

    def _sharp(self, device: torch.device) -> Found:
        path = self._checkpoint
        if path is None:
            raise InputError(NO_SHARP)
        base = self.options.base
        loaded = SharpBase.load(path, precision=base.precision, low_memory=base.low_memory, device=device)
        compiled, windows = self.options.compiled, self.options.windows
        return sharp_section(self.options.base_runs, loaded, device, compiled=compiled, windows=windows)

    def _training(self, device: torch.device) -> Found:
        batch, cells = (BATCH, CELLS) if not self._small else (2, 32)
        renderer = CpuRenderer() if device.type == "cpu" else GsplatRenderer(device)
        return training_section(self.options.runs, renderer, batch=batch, cells=cells, device=device)
