"""Training samples: views with holes and their targets, and crops of such views, which are stored
in files.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear, to_uint8
from spackle.core.filters import maximum_filter
from spackle.core.gaussians import Gaussians
from spackle.render import CpuRenderer
from spackle.render.protocol import TILE_PX, Rendering
from spackle.residual.completion import CellChoice, moved
from spackle.residual.features import CELL, ViewFeatures, cell_centers, hole_mask
from spackle.residual.initializer import InitialGaussians
from spackle.runtime.errors import as_input_error
from spackle.runtime.files import write_atomic
from spackle.runtime.tensor_digests import read_signed_tensors, signed_tensors
from spackle.scene_fill.view_completion import FarRim, SceneViewCompletion

HOLE_REACH_PX = 16  # aux Gaussians, which fill a hole, reach at most so many pixels beyond the hole
# The names of a sample's tensors in its file, and their places in a `Sample`. Two prefixes are
# older than the present names of the fields.
FIELDS_BY_FILE_NAME = {
    **{
        f"base.{name}": f"base.{name}"
        for name in ("means", "quats", "scales", "opacities", "colors")
    },
    **{f"rendering.{name}": f"rendering.{name}" for name in ("rgb", "depth", "alpha")},
    **{f"seeds.{name}": f"initial.{name}" for name in ("inverse_depth", "slope", "rgb")},
    "rim.rgb": "surroundings.rim_rgb",
    "rim.mirrored": "surroundings.mirrored_rgb",
    "rim.distance": "surroundings.rim_distance",
    "rim.exemplar": "surroundings.patch_rgb",
    "rim.mismatch": "surroundings.patch_mismatch",
    "rim.beyond": "surroundings.beyond_photo",
    "rim.photo": "surroundings.photo_rgb",
}
# Files store these tensors in float32, the next ones in eight bits, and all others in half
# precision.
FLOAT32_TENSORS = (
    "camera.K",
    "camera.world_to_camera",
    "base.means",
    "rendering.alpha",
    "seeds.inverse_depth",
)
EIGHT_BIT_TENSORS = (
    "target",
    "rendering.rgb",
    "seeds.rgb",
    "base.opacities",
    "base.colors",
    "rim.rgb",
    "rim.mirrored",
    "rim.exemplar",
    "rim.photo",
)
MAX_GAUSSIANS_PER_PIXEL = 1.35  # a crop keeps at most so many base Gaussians for each of its pixels
HOLE_RATIO_RANGE = (0.02, 0.85)  # least and greatest fraction of hole pixels in a crop
Part = TypeVar("Part")


@dataclasses.dataclass(frozen=True)
class HoleSurroundings:
    """The inputs of networks that take long to compute: what lies around the holes of a view, for
    each cell [h, w].

    A cell is a block of 2×2 pixels. Colours are sRGB; outside of holes they are the cell's own.
    """

    rim_rgb: Tensor  # [h, w, 3] at the far rim of the cell's hole
    mirrored_rgb: Tensor  # [h, w, 3] at the cell's mirror image beyond the rim
    rim_distance: Tensor  # [h, w] cells to the rim; 0 outside of holes
    patch_rgb: Tensor  # [h, w, 3] of patches elsewhere in the view that match the hole
    patch_mismatch: Tensor  # [h, w] how badly the patches match; 0 outside of holes
    beyond_photo: Tensor  # [h, w] bool: hole cells that the photo's camera does not see
    photo_rgb: Tensor  # [h, w, 3] of the photo at the cell's initial Gaussian


@dataclasses.dataclass(frozen=True)
class Sample:
    """A view of frozen Gaussians with holes, and the view's target. No tensor requires
    gradients.

    What networks get as input is computed by `view`, when it is asked for, as in evaluation.
    """

    base: Gaussians  # in a crop only the Gaussians that contribute to `tiles`
    view: SceneViewCompletion  # the completion of the base's view
    target: Tensor  # [H, W, 3] sRGB, what the completed view should look like

    @staticmethod
    def of(
        base: Gaussians,
        rendering: Rendering,
        camera: Camera,
        photo_camera: Camera,
        photo: Tensor,
        target: Tensor,
    ) -> Sample:
        """A sample of a whole view.

        Args:
            base: the Gaussians predicted from a photo.
            rendering: the base, as the view shows it.
            camera: of the view.
            photo_camera: of the photo.
            photo: [H', W', 3] sRGB.
            target: [H, W, 3] sRGB, what the completed view should look like.
        """
        view = SceneViewCompletion(
            rendering.detach(), camera, photo_camera, get_photo=lambda: photo
        )
        return Sample(base.detach(), view, target)

    @staticmethod
    def of_parts(
        base: Gaussians,
        rendering: Rendering,
        camera: Camera,
        initial: InitialGaussians,
        surroundings: HoleSurroundings,
        target: Tensor,
    ) -> Sample:
        """A sample of a crop, whose initial Gaussians and surroundings are those of its whole view.

        A crop could not compute them, because it lacks what lies around it.
        """
        # The camera of the photo is not stored, so the crop's own camera takes its place. It is
        # never used, because every part that depends on it is set below.
        view = SceneViewCompletion(rendering, camera, photo_camera=camera)
        view.initial = initial
        view.far_rim = FarRim(
            surroundings.rim_rgb, surroundings.mirrored_rgb, surroundings.rim_distance
        )
        view.patch_colors = surroundings.patch_rgb
        view.patch_mismatch = surroundings.patch_mismatch
        view.beyond_photo = surroundings.beyond_photo
        view.photo_colors = surroundings.photo_rgb
        return Sample(base, view, target)

    @property
    def camera(self) -> Camera:
        """The camera of the view."""
        return self.view.camera

    @property
    def rendering(self) -> Rendering:
        """The view of the whole base."""
        return self.view.rendering

    @property
    def initial(self) -> InitialGaussians:
        """[h, w]: the first guess of what fills each cell of 2×2 pixels."""
        return self.view.initial

    @property
    def features(self) -> ViewFeatures:
        """The rendered view, averaged in cells of 2×2 pixels."""
        return self.view.features

    @property
    def surroundings(self) -> HoleSurroundings:
        """The inputs of networks that a crop cannot compute by itself, for h×w cells."""
        view = self.view
        return HoleSurroundings(
            rim_rgb=view.far_rim.rgb,
            mirrored_rgb=view.far_rim.mirrored,
            rim_distance=view.far_rim.distance,
            patch_rgb=view.patch_colors,
            patch_mismatch=view.patch_mismatch,
            beyond_photo=view.beyond_photo,
            photo_rgb=view.photo_colors,
        )

    @functools.cached_property
    def _network_inputs(self) -> dict[tuple[str, ...], Tensor]:
        """The inputs that were computed so far, by the names of their parts."""
        return {}

    def network_input(self, names: tuple[str, ...]) -> Tensor:
        """[1, C, h, w]: the named inputs of a network, kept for the next call."""
        if names not in self._network_inputs:
            self._network_inputs[names] = self.view.network_input(names)
        return self._network_inputs[names]

    def chosen_cells(self, choice: CellChoice) -> Tensor:
        """[n] int64: numbers of the cells that get a new Gaussian, row by row; kept for the next
        call.
        """
        if choice not in self._chosen_cells:
            self._chosen_cells[choice] = self.view.chosen_cells(choice).flatten().nonzero()[:, 0]
        return self._chosen_cells[choice]

    @functools.cached_property
    def _chosen_cells(self) -> dict[CellChoice, Tensor]:
        """The numbers of cells that were chosen so far, by the way of choosing."""
        return {}

    @property
    def hole(self) -> Tensor:
        """[H, W] bool: the hole, the pixels that the base leaves uncovered."""
        return hole_mask(self.rendering.alpha)

    @functools.cached_property
    def tiles(self) -> Tensor:
        """[ceil(H/16), ceil(W/16)] bool: the renderer's tiles that may change.

        A tile of 16×16 pixels may change if it is near the hole, which aux Gaussians fill. In a
        view whose hole has fewer than 64 cells, the least opaque cells outside get aux Gaussians,
        too, and the tiles near these may change.
        """
        height, width = self.rendering.alpha.shape
        cells = self.view.chosen_cells("masked")
        cell_pixels = cells.repeat_interleave(CELL, 0).repeat_interleave(CELL, 1)
        filled = self.hole | cell_pixels[:height, :width]
        near_filled = maximum_filter(filled, HOLE_REACH_PX)
        return max_pool2d(near_filled[None, None].float(), TILE_PX, ceil_mode=True)[0, 0] > 0

    def to(self, device: torch.device) -> Sample:
        """The sample on another device, with all that was computed so far."""
        return moved(self, device)

    def crop(self, row: int, column: int, height: int, width: int) -> Sample:
        """Cut out height × width cells of 2×2 pixels, from the upper left cell (row, column).

        Of the base's Gaussians only those stay that can be seen in the crop.
        """
        top = CELL * row
        left = CELL * column
        pixels = (slice(top, top + CELL * height), slice(left, left + CELL * width))
        cells = (slice(row, row + height), slice(column, column + width))
        camera = self.camera.cropped(left, top, CELL * width, CELL * height)

        # Copies instead of views into the whole images, whose memory can then be freed.
        def cut_pixels(image: Tensor) -> Tensor:
            return image[pixels].clone()

        def cut_cells(grid: Tensor) -> Tensor:
            return grid[cells].clone()

        initial = _map_tensors(self.initial, cut_cells)
        crop = Sample.of_parts(
            base=self.base,
            rendering=_map_tensors(self.rendering, cut_pixels),
            camera=camera,
            initial=dataclasses.replace(initial, uv=cell_centers(camera)),
            surroundings=_map_tensors(self.surroundings, cut_cells),
            target=cut_pixels(self.target),
        )
        return crop._with_visible_base()

    def _with_visible_base(self) -> Sample:
        """The sample with only the base Gaussians that contribute most to the picture.

        At most `MAX_GAUSSIANS_PER_PIXEL` times the number of pixels are kept. Contributions count
        only in the renderer's tiles that Gaussians in the hole can touch, because training renders
        nothing else.
        """
        # A Gaussian's contribution is the gradient of the picture's sum by the Gaussian's colour.
        # It does not depend on the colours, so any will do: here all are the same grey.
        with torch.enable_grad():
            grey = torch.full_like(self.base.colors, 0.5).requires_grad_()
            scene = dataclasses.replace(self.base, colors=grey)
            rendering = CpuRenderer().render(scene, self.camera, tiles=self.tiles)
            (color_gradient,) = torch.autograd.grad(rendering.rgb.sum(), grey)
        contribution = color_gradient[:, 0]  # [N]

        max_count = int(MAX_GAUSSIANS_PER_PIXEL * self.camera.width * self.camera.height)
        is_kept = torch.zeros(len(grey), dtype=torch.bool)
        is_kept[contribution.topk(min(len(grey), max_count)).indices] = True
        return dataclasses.replace(self, base=self.base.select(is_kept & (contribution > 0)))


def random_crops(sample: Sample, rng: np.random.Generator, count: int, cells: int) -> list[Sample]:
    """Up to `count` square crops around hole cells of a view, each with `cells` cells of 2×2 pixels
    a side.

    Crops with almost no hole, or with almost nothing else, are left out.
    """
    rows = sample.camera.height // CELL
    columns = sample.camera.width // CELL
    if min(rows, columns) < cells:
        return []
    hole_cells = sample.features.mask[:rows, :columns].nonzero()  # [n, 2]
    if not len(hole_cells):
        return []

    crops: list[Sample] = []
    for _ in range(2 * count):  # two tries for each crop
        if len(crops) == count:
            break
        # A hole cell at a random place of the crop, as far as the crop stays within the view.
        row, column = hole_cells[rng.integers(len(hole_cells))].tolist()
        shift_down, shift_right = rng.integers(0, cells, size=2)
        top = min(max(row - int(shift_down), 0), rows - cells)
        left = min(max(column - int(shift_right), 0), columns - cells)
        hole = sample.hole[CELL * top : CELL * (top + cells), CELL * left : CELL * (left + cells)]
        if HOLE_RATIO_RANGE[0] < float(hole.float().mean()) < HOLE_RATIO_RANGE[1]:
            crops.append(sample.crop(top, left, cells, cells))
    return crops


def save_sample(sample: Sample, path: Path) -> None:
    """Write a sample to a safetensors file; a killed run leaves the whole file or none."""
    tensors = {
        "camera.K": sample.camera.K,
        "camera.world_to_camera": sample.camera.world_to_camera,
        "camera.size": torch.tensor([sample.camera.width, sample.camera.height]),
        "target": sample.target,
        # "seeds" is the format's name for the initial Gaussians.
        "seeds.unit": torch.tensor(sample.initial.unit, dtype=torch.float64),
    }
    for name_in_file, field in FIELDS_BY_FILE_NAME.items():
        part, _, name = field.partition(".")  # such as "base", "means"
        tensors[name_in_file] = getattr(getattr(sample, part), name)

    # Colours of Gaussians are linear. As sRGB, eight bits have the finest steps in the dark, where
    # the eye sees small differences.
    tensors["base.colors"] = linear_to_srgb(sample.base.colors)
    for name in EIGHT_BIT_TENSORS:
        tensors[name] = to_uint8(tensors[name])

    # A quaternion of any length describes the same rotation, so its largest component becomes 127,
    # the greatest number in int8.
    quats = sample.base.quats
    largest_component = quats.abs().amax(-1, keepdim=True)
    tensors["base.quats"] = (127 * quats / largest_component).round().to(torch.int8)

    # Half precision is enough for everything that is not a position, a camera or an opacity.
    for name, tensor in tensors.items():
        if tensor.dtype == torch.float32 and name not in FLOAT32_TENSORS:
            tensors[name] = tensor.half()
    tensors = {name: tensor.contiguous() for name, tensor in tensors.items()}
    write_atomic(path, signed_tensors(tensors))


def load_sample(path: str | os.PathLike[str]) -> Sample:
    """Read a sample; InputError if its file is missing or broken."""
    with as_input_error(
        path, "not a training sample, or damaged: delete the file; the next run makes it again"
    ):
        stored_tensors = read_signed_tensors(path)
        tensors = {name: _to_float(name, tensor) for name, tensor in stored_tensors.items()}
        tensors["base.colors"] = srgb_to_linear(tensors["base.colors"])
        width, height = tensors["camera.size"].tolist()
        camera = Camera(
            tensors["camera.K"], tensors["camera.world_to_camera"], width=width, height=height
        )

        # The tensors by the sample's parts ("base", "rendering", …) and their fields.
        fields: dict[str, dict[str, Tensor]] = {}
        for name_in_file, field in FIELDS_BY_FILE_NAME.items():
            part, _, name = field.partition(".")
            fields.setdefault(part, {})[name] = tensors[name_in_file]
        return Sample.of_parts(
            base=Gaussians(**fields["base"]),
            rendering=Rendering(**fields["rendering"]),
            camera=camera,
            initial=InitialGaussians(
                uv=cell_centers(camera),
                **fields["initial"],
                # "seeds" is the format's name for the initial Gaussians.
                unit=float(tensors["seeds.unit"]),
            ),
            surroundings=HoleSurroundings(**fields["surroundings"]),
            target=tensors["target"],
        )


def _to_float(name: str, tensor: Tensor) -> Tensor:
    """A tensor of a sample's file, from the file's compact dtype to the dtype of a sample.

    Eight-bit colours and opacities become float32 in 0..1; half precision becomes float32.
    """
    if name in EIGHT_BIT_TENSORS:
        return tensor.float() / 255
    # Quaternions are int8; their length does not matter.
    if tensor.dtype in (torch.float16, torch.int8):
        return tensor.float()
    # The size of the camera and masks stay integers and bools.
    return tensor


def _map_tensors(part: Part, function: Callable[[Tensor], Tensor]) -> Part:
    """A copy of a dataclass, with a function applied to all its tensors."""
    changed = {
        name: function(value) for name, value in vars(part).items() if isinstance(value, Tensor)
    }
    return dataclasses.replace(part, **changed)  # type: ignore[type-var]
