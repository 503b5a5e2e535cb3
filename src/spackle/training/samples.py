"""Training samples: views with holes and their truth, crops of them, and their files.

Each view is made once and read many times: `make_samples` writes the crops of all views into a folder.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from safetensors.torch import load_file, save
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.camera import Camera
from spackle.color import linear_to_srgb, srgb_to_linear, to_bytes
from spackle.errors import InputError, reading
from spackle.files import write_whole
from spackle.filters import greatest_around
from spackle.gaussians import Gaussians
from spackle.progress import Step
from spackle.render import CpuRenderer
from spackle.render.protocol import TILE, Rendering
from spackle.residual.base_values import Seeds, make_seeds
from spackle.residual.network import Rim, find_rim
from spackle.residual.view_features import CELL, ViewFeatures, cell_centers, hole_mask
from spackle.training.recipe import DataRecipe
from spackle.training.train import rank, rank_count, wait_for_ranks

REACH_PX = 16  # aux Gaussians of a hole reach no farther than this beyond it
# Of a sample's file: half precision is enough for most of it, and eight bits are for sRGB of a pixel or a cell.
EXACT = ("camera.K", "camera.world_to_camera", "base.means", "rendering.alpha", "seeds.inverse_depth")
RIM_COLORS = ("rim.rgb", "rim.mirrored", "rim.exemplar", "rim.photo")
EIGHT_BITS = ("target", "rendering.rgb", "seeds.rgb", "base.opacities", "base.colors", *RIM_COLORS)
PARTS = ("base", "rendering", "rim", "seeds")  # of a sample, each a dataclass of tensors
GAUSSIANS_A_PIXEL = 1.35  # of the base in a crop, at most
# A crop's file has per pixel so many Gaussians of 26 bytes, 8-bit colours of rendering and target, alpha in float32 and
# depth in float16; per cell 8-bit colours of seed and rim, 5 times 3 of them, and 13 bytes of their other fields.
PIXEL_BYTES, CELL_BYTES, HEADER_BYTES = 26 * GAUSSIANS_A_PIXEL + 2 * 3 + 4 + 2, 5 * 3 + 13, 4096
HOLE_SHARE = (0.02, 0.85)  # of a crop's pixels, for the crop to teach something
SAMPLES_VERSION = 7  # goes up whenever the same recipe would make other samples
P = TypeVar("P")


@dataclasses.dataclass(frozen=True)
class Sample:
    """A view of frozen Gaussians with holes, and its target. Nothing here wants gradients."""

    camera: Camera
    base: Gaussians  # those that touch the tiles around the holes
    rendering: Rendering  # of the whole base
    seeds: Seeds  # a grid, one for each 2×2 pixels
    rim: Rim  # likewise
    target: Tensor  # [H, W, 3] sRGB

    @staticmethod
    def of(
        base: Gaussians, rendering: Rendering, camera: Camera, photo_camera: Camera, photo: Tensor, target: Tensor
    ) -> Sample:
        """A whole view: frozen Gaussians, their rendering from `camera`, and the truth `target` [H, W, 3] sRGB.

        `photo_camera` is that of the base's `photo` [h, w, 3] sRGB.
        """
        rendering, features = rendering.detach(), ViewFeatures.of(rendering)
        seeds = make_seeds(features, camera, photo_camera)
        rim, _ = find_rim(features, seeds, camera, photo_camera, photo)
        return Sample(camera, base.detach(), rendering, seeds, rim, target)

    @functools.cached_property
    def features(self) -> ViewFeatures:
        """The view's cells; for a sample on the processor."""
        return ViewFeatures.of(self.rendering)

    @property
    def hole(self) -> Tensor:
        """[H, W] bool, Q of the paper's loss."""
        return hole_mask(self.rendering.alpha)

    @property
    def tiles(self) -> Tensor:
        """[ceil(H/16), ceil(W/16)] bool: the renderer's tiles that aux Gaussians can touch."""
        near = greatest_around(self.hole, REACH_PX)
        return max_pool2d(near[None, None].float(), TILE, ceil_mode=True)[0, 0] > 0

    def to(self, device: torch.device) -> Sample:
        """The same on another device, except for the camera, whose numbers are read by the host."""
        move = functools.partial(Tensor.to, device=device, non_blocking=device.type != "cpu")
        parts = {name: _mapped(getattr(self, name), move) for name in PARTS}
        return dataclasses.replace(self, **parts, target=move(self.target))

    def crop(self, row: int, column: int, height: int, width: int) -> Sample:
        """The part of a view whose upper left cell is (row, column), height × width cells."""
        top, left = CELL * row, CELL * column
        pixels = (slice(top, top + CELL * height), slice(left, left + CELL * width))
        cells = (slice(row, row + height), slice(column, column + width))
        camera = self.camera.cropped(left, top, CELL * width, CELL * height)

        def cut(grid: Tensor) -> Tensor:
            return grid[cells].clone()

        return Sample(
            camera=camera,
            base=self.base,
            rendering=_mapped(self.rendering, lambda t: t[pixels].clone()),
            seeds=dataclasses.replace(_mapped(self.seeds, cut), uv=cell_centers(camera)),
            rim=_mapped(self.rim, cut),
            target=self.target[pixels].clone(),
        )._with_visible_base()

    def _with_visible_base(self) -> Sample:
        """The sample with only those base Gaussians that contribute to the tiles that matter.

        If there are more than `GAUSSIANS_A_PIXEL`, those that contribute most are kept.
        """
        with torch.enable_grad():  # the gradient of grey Gaussians' brightness says how much of each shows
            grey = torch.full_like(self.base.colors, 0.5).requires_grad_()
            scene = dataclasses.replace(self.base, colors=grey)
            drawn = CpuRenderer().render(scene, self.camera, tiles=self.tiles)
            (shown,) = torch.autograd.grad(drawn.rgb.sum(), grey)
        room = int(GAUSSIANS_A_PIXEL * self.camera.width * self.camera.height)
        kept = torch.zeros(len(grey), dtype=torch.bool)
        kept[shown[:, 0].topk(min(len(grey), room)).indices] = True
        return dataclasses.replace(self, base=self.base.select(kept & (shown[:, 0] > 0)))


def random_crops(sample: Sample, rng: np.random.Generator, count: int, cells: int) -> list[Sample]:
    """Up to `count` square crops of `cells` cells around hole cells of a view."""
    rows, columns = sample.camera.height // CELL, sample.camera.width // CELL  # whole cells only
    if min(rows, columns) < cells:
        return []
    where = sample.features.mask[:rows, :columns].nonzero()
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
    """Write a sample, whole or not at all; `disk_needed` knows how large it can be."""
    camera = sample.camera
    tensors = {
        "camera.K": camera.K,
        "camera.world_to_camera": camera.world_to_camera,
        "camera.size": torch.tensor([camera.width, camera.height]),
        "target": sample.target,
    }
    for part in PARTS:
        tensors |= {f"{part}.{name}": value for name, value in vars(getattr(sample, part)).items()}
    tensors["seeds.unit"] = torch.tensor(sample.seeds.unit, dtype=torch.float64)
    del tensors["seeds.uv"]  # the camera's
    tensors["base.colors"] = linear_to_srgb(sample.base.colors)
    tensors |= {name: to_bytes(tensors[name]) for name in EIGHT_BITS}
    quats = sample.base.quats  # of any length: the largest component becomes 127
    tensors["base.quats"] = (127 * quats / quats.abs().amax(-1, keepdim=True)).round().to(torch.int8)
    halved = [name for name, tensor in tensors.items() if tensor.dtype == torch.float32 and name not in EXACT]
    tensors |= {name: tensors[name].half() for name in halved}
    write_whole(path, save({name: tensor.contiguous() for name, tensor in tensors.items()}))


def load_sample(path: str | os.PathLike[str]) -> Sample:
    """Read a sample; InputError for a missing or broken file."""
    with reading(path, "no training sample, or damaged: delete it, and it is made anew"):
        parts: dict[str, dict[str, Any]] = {}
        for name, tensor in load_file(path).items():
            part, _, field = name.partition(".")
            value = tensor.float() / 255 if name in EIGHT_BITS else tensor
            parts.setdefault(part, {})[field] = value.float() if value.dtype in (torch.float16, torch.int8) else value
        lens, unit = parts["camera"], float(parts["seeds"].pop("unit"))
        camera = Camera(lens["K"], lens["world_to_camera"], *lens["size"].tolist())
        return Sample(
            camera=camera,
            base=Gaussians(**{**parts["base"], "colors": srgb_to_linear(parts["base"]["colors"])}),
            rendering=Rendering(**parts["rendering"]),
            seeds=Seeds(cell_centers(camera), **parts["seeds"], unit=unit),
            rim=Rim(**parts["rim"]),
            target=parts["target"][""],
        )


def _mapped(part: P, function: Callable[[Tensor], Tensor]) -> P:
    """A dataclass with a function applied to its tensors."""
    tensors = {name: value for name, value in vars(part).items() if isinstance(value, Tensor)}
    return dataclasses.replace(part, **{name: function(value) for name, value in tensors.items()})  # type: ignore[type-var]


class Source(NamedTuple):
    """A source of views with holes and truth, and its share of the samples."""

    share: float  # among all sources, which need not add up to 1
    view: Callable[[np.random.Generator, int], Sample]  # the view of a number; InputError for a file that is no use
    names: Sequence[str]  # of the source and of its files, relative to their folder
    views: int | None = None  # how many it has, numbered from 0; None: drawn, without end


def digest_of_samples(data: DataRecipe, sources: Sequence[Source]) -> str:
    """Twelve digits that identify the samples' content, wherever the files are and however many are made."""
    facts = data.model_dump(mode="json")
    for name in ("photos", "stereo", "pseudo", "cache", "views", "validation_views"):
        facts.pop(name)
    for camera in facts["rgbd"]:
        camera.pop("folder")
    names = [name for source in sources for name in source.names]
    return short_digest((SAMPLES_VERSION, facts, [source.share for source in sources], names))


def short_digest(value: Any) -> str:
    """Twelve hexadecimal digits that identify a recipe's data."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


def make_samples(
    data: DataRecipe,
    sources: Sequence[Source],
    folder: Path,
    seed: int,
    views: int,
    progress: Step,
    warn: Callable[[str], None],
) -> list[Path]:
    """The sample files of a folder's first views, in order; the processes share the work of making missing ones.

    Many recipes may share the folder. `seed` decides the views, fewer if the only source has no more. `progress` is
    called with the views that this process has done and their number, `warn` with the reason for each view without a
    sample. InputError where nothing can be written, or no view has a hole to learn from.
    """
    folder.mkdir(parents=True, exist_ok=True)
    views = _at_most(views, sources)
    shares = np.array([source.share for source in sources])

    def drawn(index: int) -> tuple[int, np.random.Generator]:
        """Draw a view's source, and the random numbers for it."""
        rng = np.random.default_rng([seed, index])
        return int(rng.choice(len(sources), p=shares / shares.sum())), rng

    places, counts = list[tuple[int, int]](), [0] * len(sources)  # of each view: its source, and its number there
    for index in range(views):
        choice = drawn(index)[0]
        places.append((choice, counts[choice]))
        counts[choice] += 1
    mine = range(*(views * part // rank_count() for part in (rank(), rank() + 1)))  # one process reads a photo's views
    for done, index in enumerate(mine, 1):
        if _crop_files(folder, index) is None:
            (choice, place), rng, crops = places[index], drawn(index)[1], list[Sample]()
            source = sources[choice]
            try:
                view = source.view(rng, place if source.views is None else place % source.views)
                crops = random_crops(view, rng, data.crops, data.cells)
            except (InputError, ValueError) as error:
                warn(str(error))
            for number, crop in enumerate(crops):
                save_sample(crop, folder / f"{index:06d}-{number}.safetensors")
            write_whole(folder / f"{index:06d}.done", f"{len(crops)}\n".encode())  # last: it vouches for the crops
        progress(done, len(mine))
    wait_for_ranks()
    files = [file for index in range(views) for file in _crop_files(folder, index) or ()]
    if not files:
        raise InputError(
            f"{folder}: none of {views} views gave a sample: photos must be readable, larger than "
            f"{2 * data.cells} pixels each way, and seen from aside (data.disparity)"
        )
    return files


def disk_needed(data: DataRecipe, sources: Sequence[Source], folder: Path, views: int) -> int:
    """Maximum number of bytes that the missing samples of a folder's first views will take."""
    missing = sum(_crop_files(folder, index) is None for index in range(_at_most(views, sources)))
    return missing * data.crops * (data.cells**2 * int(CELL**2 * PIXEL_BYTES + CELL_BYTES) + HEADER_BYTES)


def _at_most(views: int, sources: Sequence[Source]) -> int:
    """The recipe's number of views, or fewer if the only source has fewer."""
    alone = sources[0].views if len(sources) == 1 else None
    return views if alone is None else min(views, alone)


def _crop_files(folder: Path, index: int) -> list[Path] | None:
    """The files of a view's crops; None if they have not been made."""
    with contextlib.suppress(FileNotFoundError, ValueError):
        count = int((folder / f"{index:06d}.done").read_text())
        files = [folder / f"{index:06d}-{number}.safetensors" for number in range(count)]
        if all(file.is_file() for file in files):
            return files
    return None
