"""Complete one view as in the paper, eqs. 2 to 7: `ViewCompletion` is the only place where this
happens.

Eq. 8 is `Gaussians.cat([base, aux])`, and eq. 9 the rendering of these Gaussians.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Literal, TypeVar, cast

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.render import Renderer
from spackle.render.protocol import Rendering
from spackle.residual.composer import compose
from spackle.residual.features import CELL, MASK_THRESHOLD, ViewFeatures, hole_mask
from spackle.residual.initializer import InitialGaussians, initialize, sample_photo
from spackle.residual.network import ResidualNet, predict_deltas
from spackle.runtime.device import Precision
from spackle.runtime.parallel_kernels import device_for_kernels

T = TypeVar("T")

MIN_AUX_GAUSSIANS = 64  # least number of aux Gaussians in a view (paper, "Training Details")
# Which cells of a view (2×2 pixels) get an aux Gaussian: "masked" are those in holes, the paper's
# method; "all" is the dense grid of the paper's table of mask-guided initialisation.
CellChoice = Literal["masked", "all"]
MIN_RELATIVE_DEPTH = 1e-4  # inverse depths below this fraction of the view's median are raised


class ViewCompletion:
    """Fills the holes of one rendered view with aux Gaussians, as the paper does (eqs. 2 to 7).

    Each step runs when its result is asked for.

        view = ViewCompletion(renderer.render(base, camera), camera, photo_camera)
        deltas = view.deltas(network)                 # eq. 5
        aux = view.gaussians(view.cells(), deltas)    # eq. 7

    The grid of a view has a cell for each 2×2 pixels: h = ceil(H/2) rows, w = ceil(W/2) columns.
    Each cell has an initial Gaussian, a first guess of what fills the hole; a network changes it by
    14 numbers, the deltas.

    A network names its inputs. To add inputs, extend `INPUT_CHANNELS` and `input` in a subclass,
    and make the subclass the network's `view_type`.
    """

    # The inputs that a network may name, with their numbers of channels.
    INPUT_CHANNELS: ClassVar[Mapping[str, int]] = {
        "rgb": 3,  # the rendered colour
        "depth": 1,  # the rendered depth
        "alpha": 1,  # the rendered opacity
        "mask": 1,  # 1 where a cell has a hole
        "initial": 4,  # depth and colour of the initial Gaussian
        "photo": 3,  # the photo's colour at the initial Gaussian
    }

    def __init__(
        self,
        rendering: Rendering,
        camera: Camera,
        photo_camera: Camera,
        get_photo: Callable[[], Tensor] | None = None,
        threshold: float = MASK_THRESHOLD,
    ) -> None:
        """Keep the view; nothing is computed yet.

        Args:
            rendering: the base's Gaussians rendered from the view (eqs. 2 and 3). All is computed
                on its device; if this is a GPU on which kernels do not run, on the processor.
            camera: of the view.
            photo_camera: of the photo from which the base was predicted.
            get_photo: returns the photo I of eq. 5, [H', W', 3] sRGB, of the size of its camera;
                called only for a network with "photo" among its inputs.
            threshold: τ_α of eq. 4: a pixel with a lower opacity is a hole.
        """
        self.rendering = rendering.to(device_for_kernels(rendering.alpha.device))
        self.camera = camera
        self.photo_camera = photo_camera
        self.threshold = threshold
        self._get_photo = get_photo

    @functools.cached_property
    def features(self) -> ViewFeatures:
        """The rendered view, averaged in cells."""
        return ViewFeatures.of(self.rendering, self.threshold)

    @property
    def mask(self) -> Tensor:
        """[h, w] bool: the cells with at least one hole pixel."""
        return self.features.mask

    def cells(self, at_least: int = 0) -> Tensor:
        """[h, w] bool: the cells of 2×2 pixels that get a new Gaussian (eqs. 4 and 7).

        These are the cells whose upper left pixel is a hole. Because one pixel of each cell
        decides, about HAR · h · w cells are chosen, as in the paper's tables; HAR is the fraction
        of hole pixels in the view. If fewer than `at_least`, the `at_least` least opaque cells are
        chosen instead.
        """
        hole = hole_mask(self.rendering.alpha, self.threshold)
        cells = hole[::CELL, ::CELL]
        if int(cells.count_nonzero()) >= at_least:
            return cells

        # A stable order makes the choice among equal opacities reproducible.
        by_opacity = self.features.alpha.flatten().argsort(stable=True)
        cells = torch.zeros_like(cells)
        cells.view(-1)[by_opacity[:at_least]] = True
        return cells

    def chosen_cells(self, choice: CellChoice) -> Tensor:
        """[h, w] bool: the cells of 2×2 pixels that get an aux Gaussian.

        Training and evaluation both call this function, so that they agree. "masked": the cells in
        holes, and at least 64 (the paper's "Training Details"); "all": every cell.
        """
        if choice == "all":
            return torch.ones_like(self.mask)
        return self.cells(at_least=MIN_AUX_GAUSSIANS)

    @functools.cached_property
    def initial(self) -> InitialGaussians:
        """The initial Gaussians of all cells."""
        return initialize(self.features, self.camera, self.photo_camera)

    @functools.cached_property
    def photo_colors(self) -> Tensor:
        """[h, w, 3] sRGB: for each cell, the photo's colour at the cell's initial Gaussian.

        The initial Gaussian is the first guess of what fills the cell. If it lies outside of what
        the photo shows, its own colour is taken.
        """
        if self._get_photo is None:
            raise ValueError('a network names the input "photo", but no photo was given')
        return sample_photo(
            self._get_photo(),
            self.initial.rgb,
            self.initial.inverse_depth,
            self.camera,
            self.photo_camera,
        )

    def input(self, name: str) -> Tensor:
        """[h, w, c] float32: the channels of one of the network's inputs, for each cell (2×2
        pixels).

        Colours are shifted from 0..1 to -0.5..0.5. Depths are log(inverse depth / median inverse
        depth of the view), so their unit does not matter.

        Args:
            name: "rgb", "depth", "alpha": what was rendered; "mask": where holes are; "initial":
                depth and colour of the initial Gaussians, the first guess of what fills a cell;
                "photo": the photo's colour at the initial Gaussians.
        """
        if name == "rgb":
            return self.features.rgb - 0.5
        if name == "depth":
            log_depth = self._log_depth(self.features.inverse_depth)
            visible = self.features.inverse_depth > 0
            return torch.where(visible, log_depth, 0.0)[..., None]
        if name == "alpha":
            return self.features.alpha[..., None]
        if name == "mask":
            return self.mask.to(self.features.alpha.dtype)[..., None]  # 1 in holes
        if name == "initial":
            log_depth = self._log_depth(self.initial.inverse_depth)
            return torch.cat([log_depth[..., None], self.initial.rgb - 0.5], dim=-1)
        if name == "photo":
            return self.photo_colors - 0.5
        raise ValueError(f"a network names the unknown input {name!r}")

    def _log_depth(self, inverse_depth: Tensor) -> Tensor:
        """[h, w] log(inverse depth / the view's median inverse depth), of inverse depths [h, w]."""
        median = self.initial.unit
        return (inverse_depth / median).clamp_min(MIN_RELATIVE_DEPTH).log()

    def network_input(self, names: Sequence[str]) -> Tensor:
        """[1, C, h, w] float32, without gradients: the channels of the named inputs in a row.

        `names` are those of `INPUT_CHANNELS`, which also says how many channels each has.
        """
        channels = torch.cat([self.input(name) for name in names], dim=-1)  # [h, w, C]
        return channels.permute(2, 0, 1)[None].detach()

    def deltas(
        self,
        network: ResidualNet | None,
        precision: Precision = "auto",
        *,
        cells: Tensor | None = None,
    ) -> Tensor | None:
        """[h, w, 14] float32: the network's changes of the initial Gaussians (the paper's eq. 5).

        The initial Gaussians are the first guess of what fills each cell of 2×2 pixels. The 14
        changes of each are those of its place in the picture (2), inverse depth (1), scales (3),
        quaternion (4), colour (3) and opacity (1). Without a network the result is None.

        Args:
            network: the residual network (f_res in the paper), on any device. Its `inputs` are
                names such as "rgb" or "mask", see `input`.
            precision: of its convolutions; auto is bfloat16 if the hardware multiplies it natively.
            cells: [h, w] bool: the cells that need deltas, all others get zeros; None: those with
                at least one hole pixel.
        """
        if network is None:
            return None
        if cells is None:
            cells = self.mask
        channels = self.network_input(network.inputs)  # [1, C, h, w]
        return predict_deltas(network, channels, cells, precision)

    def gaussians(self, cells: Tensor, deltas: Tensor | None) -> Gaussians:
        """One Gaussian for each of n cells of 2×2 pixels (the paper's eq. 7).

        Gradients reach the deltas.

        Args:
            cells: which cells, as a boolean grid [h, w] or row-major indices [n].
            deltas: [h, w, 14] the network's changes of the initial Gaussians (the first guess) of
                all cells; None: no changes.
        """
        chosen = self.initial.select(cells)
        if deltas is None:
            return compose(chosen, deltas=None, camera=self.camera)

        index = cells
        if cells.dtype == torch.bool:
            index = cells.flatten().nonzero()[:, 0]
        return compose(chosen, deltas.flatten(0, 1)[index], self.camera)


def moved(value: T, device: torch.device) -> T:
    """The same value with all its tensors on another device; cameras stay on the CPU.

    A view's completion takes along what it has computed so far. A value that is on the device
    already is returned as it is.

    Args:
        value: a tensor, a completion, a dataclass or dictionary with any of these; anything else is
            returned as it is.
        device: where the tensors go.
    """
    if isinstance(value, Tensor):
        return cast("T", value.to(device, non_blocking=device.type != "cpu"))
    if isinstance(value, dict):
        items = {key: moved(item, device) for key, item in value.items()}
        is_there = all(items[key] is item for key, item in value.items())
        return value if is_there else type(value)(items)
    has_fields = dataclasses.is_dataclass(value) or isinstance(value, ViewCompletion)
    if not has_fields or isinstance(value, (type, Camera)):
        return value
    fields = {name: moved(field, device) for name, field in vars(value).items()}
    if all(fields[name] is field for name, field in vars(value).items()):
        return value
    other = copy.copy(value)
    vars(other).update(fields)
    return other


def view_type_of(
    network: ResidualNet | None, default: type[ViewCompletion]
) -> type[ViewCompletion]:
    """The class that completes views for a network, and computes the inputs that it names.

    A network whose inputs need a class of their own states it as `view_type`; for all others, and
    without a network, the class is `default`, usually `ViewCompletion`.
    """
    if network is None or network.view_type is None:
        return default
    return network.view_type


@torch.no_grad()
def complete_view(
    base: Gaussians,
    camera: Camera,
    photo_camera: Camera,
    renderer: Renderer,
    network: ResidualNet | None,
    *,
    threshold: float = MASK_THRESHOLD,
    least: int = 0,
    rendering: Rendering | None = None,
    photo: Tensor | None = None,
    precision: Precision = "auto",
) -> Gaussians:
    """Gaussians that fill the holes of one view, as in the paper (𝒢̃_aug of eq. 7).

    The holes are where the base does not cover the view. There is one Gaussian for each cell of 2×2
    pixels whose first pixel is a hole.

    Args:
        base: the Gaussians predicted from a photo (𝒢_base), in the world's frame.
        camera: the view (v).
        photo_camera: the camera of the photo.
        renderer: draws Gaussians (ℛ).
        network: the residual network (f_res), on any device; None: holes are filled by the initial
            Gaussians, the first guess that a network would change.
        threshold: a pixel with a lower opacity is a hole (τ_α).
        least: the least number of cells to fill: if fewer are holes, the `least` least opaque cells
            are filled (the paper trains with 64).
        rendering: the base as the view shows it, if already available.
        photo: I of eq. 5, [H, W, 3] sRGB of the size of its camera, for a network that names the
            input "photo". None, if the Gaussians came without a photo: the base rendered from the
            photo's camera stands in.
        precision: of the network; auto is bfloat16 if the hardware multiplies it natively.
    """

    def get_photo() -> Tensor:
        """The photo [H, W, 3], sRGB; called only if the network asks for it."""
        if photo is not None:
            return photo
        return renderer.render(base, photo_camera).rgb

    if rendering is None:
        rendering = renderer.render(base, camera)  # eqs. 2 and 3
    view_type = view_type_of(network, ViewCompletion)
    view = view_type(rendering, camera, photo_camera, get_photo, threshold)
    cells = view.cells(least)  # eq. 4
    if not bool(cells.any()):
        return Gaussians.empty(base.means.device)
    deltas = view.deltas(network, precision, cells=cells)  # eq. 5
    return view.gaussians(cells, deltas).to(base.means.device)  # eq. 7
