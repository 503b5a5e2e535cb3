"""Samples made once and read many times: one safetensors file each."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from spackle.camera import Camera
from spackle.errors import InputError
from spackle.formats import atomic_path
from spackle.gaussians import Gaussians
from spackle.render.protocol import Rendering
from spackle.residual.hole_features import CELL, Cues
from spackle.residual.seeds import Rim, Seeds
from spackle.training.sample import Sample
from spackle.training.sources import Source

# Half precision is enough for these, and halves what is read at every step. Not for positions.
HALVED: tuple[str, ...] = ("base.quats", "base.scales", "base.opacities", "base.colors")
HALVED += ("rendering.rgb", "rendering.depth", "rendering.alpha", "cues.rgb", "cues.inverse_depth", "cues.alpha")
HALVED += ("seeds.slope", "seeds.rgb", "rim.rgb", "rim.mirrored", "rim.distance")
HOLE_SHARE = (0.02, 0.85)  # of a crop's pixels, for the crop to teach something


def random_crops(sample: Sample, rng: np.random.Generator, count: int, cells: int) -> list[Sample]:
    """Up to `count` square crops of `cells` cells around hole cells of a view."""
    rows, columns = sample.camera.height // CELL, sample.camera.width // CELL  # whole cells only
    if min(rows, columns) < cells:
        return []
    where = sample.cues.mask[:rows, :columns].nonzero()
    crops: list[Sample] = []
    for _ in range(2 * count):  # a second chance for each
        if not len(where) or len(crops) == count:
            break
        row, column = where[rng.integers(len(where))].tolist()
        shift = rng.integers(0, cells, size=2)
        top = min(max(row - int(shift[0]), 0), rows - cells)
        left = min(max(column - int(shift[1]), 0), columns - cells)
        hole = sample.hole[CELL * top : CELL * (top + cells), CELL * left : CELL * (left + cells)]
        if HOLE_SHARE[0] < float(hole.float().mean()) < HOLE_SHARE[1]:
            crops.append(sample.crop(top, left, cells, cells))
    return crops


def save_sample(sample: Sample, path: Path) -> None:
    """Write a sample, whole or not at all; colours of the truth with 8 bits."""
    camera, seeds = sample.camera, sample.seeds
    tensors: dict[str, Tensor] = {
        "camera.K": camera.K,
        "camera.world_to_camera": camera.world_to_camera,
        "camera.size": torch.tensor([camera.width, camera.height]),
        "target": (sample.target * 255).round().to(torch.uint8),
        "valid": sample.valid,
        "seeds.unit": torch.tensor(seeds.unit, dtype=torch.float64),
    }
    for part in ("base", "rendering", "cues", "rim"):
        value = getattr(sample, part)
        tensors |= {f"{part}.{f.name}": getattr(value, f.name) for f in dataclasses.fields(value)}
    tensors |= {f"seeds.{name}": getattr(seeds, name) for name in ("uv", "inverse_depth", "slope", "rgb")}
    tensors |= {name: tensors[name].half() for name in tensors if name in HALVED}
    with atomic_path(path) as temporary:
        temporary.write_bytes(save({name: tensor.contiguous() for name, tensor in tensors.items()}))


def load_sample(path: str | os.PathLike[str]) -> Sample:
    """Read a sample.

    Raises:
        InputError: a missing or broken file.
    """
    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  # it is no dict
        tensors |= {name: tensors[name].float() for name in HALVED}

        def part(name: str) -> dict[str, Tensor]:
            return {key[len(name) + 1 :]: value for key, value in tensors.items() if key.startswith(name + ".")}

        lens, seeds = part("camera"), part("seeds")
        width, height = lens["size"].tolist()
        return Sample(
            camera=Camera(lens["K"], lens["world_to_camera"], width, height),
            base=Gaussians(**part("base")),
            rendering=Rendering(**part("rendering")),
            seeds=Seeds(seeds["uv"], seeds["inverse_depth"], seeds["slope"], seeds["rgb"], float(seeds["unit"])),
            cues=Cues(**part("cues")),
            rim=Rim(**part("rim")),
            target=tensors["target"].float() / 255,
            valid=tensors["valid"],
        )
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: no training sample, or damaged: delete it, and it is made anew") from error


@dataclasses.dataclass(frozen=True)
class Cache:
    """A folder of samples, numbered by the view that they are crops of."""

    folder: Path
    sources: Sequence[Source]
    shares: Sequence[float]  # of each source
    seed: int
    crops: int  # of a view, at most
    cells: int  # along a crop's side

    def fill(self, views: int, progress: Callable[[int, int], None], warn: Callable[[str], None]) -> list[Path]:
        """Make what is missing of the first views; returns the samples' files in order.

        Photos that cannot be used are passed over and named.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        files: list[Path] = []
        for index in range(views):
            files += self._view(index, warn)
            progress(index + 1, views)
        return files

    def _view(self, index: int, warn: Callable[[str], None]) -> list[Path]:
        marker = self.folder / f"{index:06d}.done"
        files = self._made(index, marker)
        if files is None:
            rng = np.random.default_rng([self.seed, index])
            source = self.sources[rng.choice(len(self.sources), p=np.array(self.shares) / sum(self.shares))]
            crops: list[Sample] = []
            try:
                crops = random_crops(source.view(rng), rng, self.crops, self.cells)
            except (InputError, ValueError) as error:
                warn(f"view {index} ({source.name}) passed over: {error}")
            for number, crop in enumerate(crops):
                save_sample(crop, self._file(index, number))
            with atomic_path(marker) as temporary:
                temporary.write_text(f"{len(crops)}\n")
            files = [self._file(index, number) for number in range(len(crops))]
        return files

    def _made(self, index: int, marker: Path) -> list[Path] | None:
        """The samples of a view that was made before, or None where one of them is missing."""
        try:
            files = [self._file(index, number) for number in range(int(marker.read_text()))]
        except (FileNotFoundError, ValueError):
            return None
        return files if all(file.is_file() for file in files) else None

    def _file(self, index: int, number: int) -> Path:
        return self.folder / f"{index:06d}-{number}.safetensors"


def digest_of(value: object) -> str:
    """Twelve hexadecimal digits that tell one recipe's data from another's."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]
