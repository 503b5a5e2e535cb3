"""Training samples: views with holes and their targets, and crops of such views, which are stored in files."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import itertools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from safetensors.torch import load_file, save
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear, to_uint8
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.paper.training.ranks import rank, rank_count, wait_for_ranks
from spackle.paper.training.recipe import DataRecipe
from spackle.render import CpuRenderer
from spackle.render.protocol import TILE_PX, Rendering
from spackle.residual.features import CELL, ViewFeatures, cell_centers, hole_mask
from spackle.residual.initializer import InitialGaussians, initialize
from spackle.residual.network import Rim, find_rim, network_input
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import write_atomic
from spackle.runtime.progress import Progress

REACH_PX = 16  # aux Gaussians of a hole reach at most so many pixels beyond the hole
# Files store the tensors `EXACT` in float32, the tensors `EIGHT_BITS` in eight bits, and all others in half precision.
EXACT = (
    "camera.K",
    "camera.world_to_camera",
    "base.means",
    "rendering.alpha",
    "seeds.inverse_depth",
)
RIM_COLORS = ("rim.rgb", "rim.mirrored", "rim.exemplar", "rim.photo")
EIGHT_BITS = ("target", "rendering.rgb", "seeds.rgb", "base.opacities", "base.colors", *RIM_COLORS)
PARTS = ("base", "rendering", "rim", "seeds")  # fields of a sample that are dataclasses of tensors
GAUSSIANS_A_PIXEL = 1.35  # a crop keeps at most so many base Gaussians per pixel
HOLE_SHARE = (0.02, 0.85)  # least and greatest share of hole pixels in a crop
SAMPLES_VERSION = 7  # increase this whenever a recipe would give different samples
P = TypeVar("P")


@dataclasses.dataclass(frozen=True)
class Sample:
    """A view of frozen Gaussians with holes, and the view's target. No tensor requires gradients."""

    camera: Camera
    base: Gaussians  # in a crop only the Gaussians that contribute to `tiles`
    rendering: Rendering  # of the whole base
    seeds: InitialGaussians  # [h, w]: one for each 2×2 pixels
    rim: Rim  # [h, w]
    target: Tensor  # [H, W, 3] sRGB

    @staticmethod
    def of(
        base: Gaussians,
        rendering: Rendering,
        camera: Camera,
        photo_camera: Camera,
        photo: Tensor,
        target: Tensor,
    ) -> Sample:
        """A sample of a whole view, from its `rendering`, its `target` [H, W, 3] and the base's `photo` [h, w, 3]."""
        rendering, features = rendering.detach(), ViewFeatures.of(rendering)
        seeds = initialize(features, camera, photo_camera)
        rim, _ = find_rim(features, seeds, camera, photo_camera, photo)
        return Sample(camera, base.detach(), rendering, seeds, rim, target)

    @functools.cached_property
    def features(self) -> ViewFeatures:
        """The features of the view; the sample must be on the CPU."""
        return ViewFeatures.of(self.rendering)

    @property
    def hole(self) -> Tensor:
        """[H, W] bool: the hole, Q in eq. 6."""
        return hole_mask(self.rendering.alpha)

    @functools.cached_property
    def inputs(self) -> Tensor:
        """[1, C, h, w]: the network's input; the sample must be on the CPU."""
        return network_input(self.features, self.seeds, self.rim)

    @functools.cached_property
    def tiles(self) -> Tensor:
        """[ceil(H/16), ceil(W/16)] bool: tiles of the renderer that aux Gaussians can touch."""
        near = maximum_filter(self.hole, REACH_PX)
        return max_pool2d(near[None, None].float(), TILE_PX, ceil_mode=True)[0, 0] > 0

    def to(self, device: torch.device) -> Sample:
        """The sample's tensors on another device; the camera stays on the CPU."""
        move = functools.partial(Tensor.to, device=device, non_blocking=device.type != "cpu")
        parts = {name: _mapped(getattr(self, name), move) for name in PARTS}
        return dataclasses.replace(self, **parts, target=move(self.target))

    def crop(self, row: int, column: int, height: int, width: int) -> Sample:
        """Crop height × width cells, from the upper left cell (row, column)."""
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
        """Keep the base Gaussians that contribute most to `tiles`, at most `GAUSSIANS_A_PIXEL`."""
        with (
            torch.enable_grad()
        ):  # a Gaussian's contribution is the gradient with respect to its colour
            grey = torch.full_like(self.base.colors, 0.5).requires_grad_()
            scene = dataclasses.replace(self.base, colors=grey)
            drawn = CpuRenderer().render(scene, self.camera, tiles=self.tiles)
            (shown,) = torch.autograd.grad(drawn.rgb.sum(), grey)
        room = int(GAUSSIANS_A_PIXEL * self.camera.width * self.camera.height)
        kept = torch.zeros(len(grey), dtype=torch.bool)
        kept[shown[:, 0].topk(min(len(grey), room)).indices] = True
        return dataclasses.replace(self, base=self.base.select(kept & (shown[:, 0] > 0)))


def random_crops(sample: Sample, rng: np.random.Generator, count: int, cells: int) -> list[Sample]:
    """Up to `count` square crops around hole cells of a view, each with `cells` cells a side."""
    rows, columns = sample.camera.height // CELL, sample.camera.width // CELL
    if min(rows, columns) < cells:
        return []
    where = sample.features.mask[:rows, :columns].nonzero()
    crops: list[Sample] = []
    for _ in range(2 * count):  # two tries for each crop
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
    """Write a sample atomically."""
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
    del tensors["seeds.uv"]  # computed from the camera
    tensors["base.colors"] = linear_to_srgb(sample.base.colors)
    tensors |= {name: to_uint8(tensors[name]) for name in EIGHT_BITS}
    quats = sample.base.quats  # not normalised: the largest component becomes 127
    tensors["base.quats"] = (
        (127 * quats / quats.abs().amax(-1, keepdim=True)).round().to(torch.int8)
    )
    halved = [
        name
        for name, tensor in tensors.items()
        if tensor.dtype == torch.float32 and name not in EXACT
    ]
    tensors |= {name: tensors[name].half() for name in halved}
    write_atomic(path, save({name: tensor.contiguous() for name, tensor in tensors.items()}))


def load_sample(path: str | os.PathLike[str]) -> Sample:
    """Read a sample; InputError if its file is missing or broken."""
    with as_input_error(
        path, "not a training sample, or damaged: delete the file; the next run makes it again"
    ):
        parts: dict[str, dict[str, Any]] = {}
        for name, tensor in load_file(path).items():
            part, _, field = name.partition(".")
            value = tensor.float() / 255 if name in EIGHT_BITS else tensor
            parts.setdefault(part, {})[field] = (
                value.float() if value.dtype in (torch.float16, torch.int8) else value
            )
        lens, unit = parts["camera"], float(parts["seeds"].pop("unit"))
        camera = Camera(lens["K"], lens["world_to_camera"], *lens["size"].tolist())
        return Sample(
            camera=camera,
            base=Gaussians(**{**parts["base"], "colors": srgb_to_linear(parts["base"]["colors"])}),
            rendering=Rendering(**parts["rendering"]),
            seeds=InitialGaussians(cell_centers(camera), **parts["seeds"], unit=unit),
            rim=Rim(**parts["rim"]),
            target=parts["target"][""],
        )


def _mapped(part: P, function: Callable[[Tensor], Tensor]) -> P:
    """Apply a function to all tensors of a dataclass."""
    tensors = {name: value for name, value in vars(part).items() if isinstance(value, Tensor)}
    return dataclasses.replace(part, **{name: function(value) for name, value in tensors.items()})  # type: ignore[type-var]


class Source(NamedTuple):
    """A source of views with holes and targets."""

    share: float  # weight among all sources
    view: Callable[
        [np.random.Generator, int], Sample
    ]  # makes a view by its number; InputError for an unusable file
    names: Sequence[str]  # the names of the source and of its files, relative to their folder
    views: int | None = None  # number of views, numbered from 0; None: any number, drawn at random


def digest_of_samples(data: DataRecipe, sources: Sequence[Source]) -> str:
    """Twelve digits that identify the content of samples, whatever their number and paths."""
    others = dict.fromkeys(
        ("photos", "stereo", "pseudo", "cache", "views", "validation_views"), True
    )
    facts = data.model_dump(mode="json", exclude={**others, "rgbd": {"__all__": {"folder"}}})
    names = [name for source in sources for name in source.names]
    return short_digest((SAMPLES_VERSION, facts, [source.share for source in sources], names))


def short_digest(value: Any) -> str:
    """Twelve hexadecimal digits that identify a value by its `repr`."""
    return hashlib.sha256(repr(value).encode()).hexdigest()[:12]


def make_samples(
    data: DataRecipe,
    sources: Sequence[Source],
    folder: Path,
    seed: int,
    views: int,
    progress: Progress,
    warn: Callable[[str], None],
) -> list[Path]:
    """Make the samples of the first `views` views that a folder lacks; returns the files of all samples in order.

    `seed` determines the views; the processes of a run share the work. `warn` is called with the reason if a view
    cannot be made. InputError if no file can be written, or no view gave a sample.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if len(sources) == 1 and sources[0].views is not None:
        views = min(views, sources[0].views)
    shares = np.array([source.share for source in sources])

    def drawn(index: int) -> tuple[int, np.random.Generator]:
        """The source of a view, and the generator for the rest of the view."""
        rng = np.random.default_rng([seed, index])
        return int(rng.choice(len(sources), p=shares / shares.sum())), rng

    counts = [itertools.count() for _ in sources]
    places = [
        next(counts[drawn(index)[0]]) for index in range(views)
    ]  # numbers of the views in their sources
    mine = range(
        *(views * part // rank_count() for part in (rank(), rank() + 1))
    )  # one process reads a photo's views
    for done, index in enumerate(mine, 1):
        if _crop_files(folder, index) is None:
            choice, rng = drawn(index)
            source, place, crops = sources[choice], places[index], list[Sample]()
            try:
                view = source.view(rng, place if source.views is None else place % source.views)
                crops = random_crops(view, rng, data.crops, data.cells)
            except (InputError, ValueError) as error:
                warn(str(error))
            for number, crop in enumerate(crops):
                save_sample(crop, folder / f"{index:06d}-{number}.safetensors")
            write_atomic(
                folder / f"{index:06d}.done", f"{len(crops)}\n".encode()
            )  # written after all crops
        progress(done, len(mine))
    wait_for_ranks()
    files = [file for index in range(views) for file in _crop_files(folder, index) or ()]
    if not files:
        raise InputError(
            f"{folder}: none of {views} views gave a sample: photos must be readable and larger than "
            f"{2 * data.cells} pixels each way, and data.disparity must be large enough for holes"
        )
    return files


def _crop_files(folder: Path, index: int) -> list[Path] | None:
    """The files of a view's crops; None if they are not complete."""
    with contextlib.suppress(FileNotFoundError, ValueError):
        count = int((folder / f"{index:06d}.done").read_text())
        files = [folder / f"{index:06d}-{number}.safetensors" for number in range(count)]
        if all(file.is_file() for file in files):
            return files
    return None
