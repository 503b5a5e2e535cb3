"""The GPU renderer, by gsplat."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import ModuleType

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.render.project import MAX_FINITE
from spackle.render.protocol import (
    TILE_PX,
    Renderer,
    Rendering,
    as_sets,
    check_tiles,
    common_size,
    near_plane,
    paste,
    tile_grid,
)
from spackle.render.view_colors import seen_colors
from spackle.runtime.device import report_memory_shortage
from spackle.runtime.errors import InputError, as_input_error

INSTALL_ADVICE = "pip install 'spackle-nvs[cuda]'"
GSPLAT_VERSION = "1.5"  # of the interface; another version may also clamp alpha elsewhere
MAX_LIST_ENTRIES = 2**31 - 1  # in the lists of tiles, which gsplat counts in int32


@dataclasses.dataclass(frozen=True)
class DeviceGaussians:
    """A set of Gaussians on the GPU in float32, as input of gsplat."""

    means: Tensor  # [N, 3]
    covariances: Tensor  # [N, 6]: xx, xy, xz, yy, yz, zz
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3] linear RGB
    harmonics: Tensor | None  # [N, K, 3], by which the view changes the colours

    @staticmethod
    def of(gaussians: Gaussians, device: torch.device) -> DeviceGaussians:
        """Upload a set of Gaussians; those with a number that is not finite become transparent."""
        fields = [
            tensor.to(device, torch.float32, non_blocking=True) for tensor in gaussians.tensors
        ]
        finite = Gaussians(*fields).finite_rows
        cleaned_fields = []
        for field in fields:
            further_axes = [1] * (field.ndim - 1)  # so that `finite` holds for all of a Gaussian
            is_kept = finite.reshape(-1, *further_axes)  # [N], [N, 1] or [N, 1, 1]
            cleaned_fields.append(torch.where(is_kept, field, 0))
        cleaned = Gaussians(*cleaned_fields)
        return DeviceGaussians(
            means=cleaned.means,
            covariances=upper_covariances(cleaned),
            opacities=cleaned.opacities,
            colors=cleaned.colors,
            harmonics=cleaned.harmonics,
        )

    def colors_seen_by(self, camera: Camera) -> Tensor:
        """Linear RGB [N, 3] as a camera sees it."""
        if self.harmonics is None:
            return self.colors
        return seen_colors(self.means, self.colors, self.harmonics, camera)


def upper_covariances(gaussians: Gaussians) -> Tensor:
    """[N, 6]: the upper triangles xx, xy, xz, yy, yz, zz of the covariances Σ = (R S)(R S)ᵀ."""
    factor = quat_to_matrix(gaussians.quats) * gaussians.scales[:, None, :]  # R S, [N, 3, 3]
    x, y, z = factor.unbind(1)  # its rows, [N, 3] each
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    # Not a matrix product, which autocast and TF32 would round.
    return torch.stack([(a * b).sum(-1) for a, b in pairs], dim=-1)


@dataclasses.dataclass(frozen=True)
class CachedUpload:
    """A set on the GPU, and what tells whether the set has changed since it was uploaded."""

    other_fields: tuple[Tensor, ...]  # the set's tensors without the means, which are the key
    versions: list[tuple[int, int]]  # of each tensor: count of changes in place, memory address
    on_device: DeviceGaussians


class UploadCache:
    """Sets of Gaussians that were uploaded to the GPU, by the tensor of their means.

    An entry lives as long as this tensor. Sets with gradients are not cached.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._uploads = WeakTensorKeyDictionary()

    def upload(self, gaussians: Gaussians) -> DeviceGaussians:
        """The Gaussians on the GPU, uploaded only if a tensor is new or was changed in place.

        Sets with gradients are uploaded every time.
        """
        # PyTorch counts the changes of a tensor, but not of those made in inference mode.
        if any(tensor.requires_grad or tensor.is_inference() for tensor in gaussians.tensors):
            return DeviceGaussians.of(gaussians, self.device)

        means, *other_fields = gaussians.tensors
        versions = [(tensor._version, tensor.data_ptr()) for tensor in gaussians.tensors]
        cached: CachedUpload | None = self._uploads.get(means)  # type: ignore[no-untyped-call]
        if cached is not None and cached.versions == versions:
            pairs = zip(cached.other_fields, other_fields, strict=True)
            if all(old is new for old, new in pairs):
                return cached.on_device

        # A later caller may need gradients, which tensors made in inference mode cannot have.
        with torch.inference_mode(False):
            on_device = DeviceGaussians.of(gaussians, self.device)
        self._uploads[means] = CachedUpload(tuple(other_fields), versions, on_device)
        return on_device


@dataclasses.dataclass(frozen=True)
class ProjectedBatch:
    """The n Gaussians of a batch of views, one view after the other, as gsplat projects them."""

    view_index: Tensor  # [n] int64: the view that shows the Gaussian
    radii: Tensor  # [n, 2] int32: half sizes in pixels; 0 for an invisible Gaussian
    centers: Tensor  # [n, 2] pixels
    depths: Tensor  # [n]
    conics: Tensor  # [n, 3]: xx, xy, yy of the inverse projected covariance
    opacities: Tensor  # [n]
    colors: Tensor  # [n, 3] linear RGB


class GsplatRenderer(Renderer):
    """Classic 3D Gaussian splatting by gsplat on an NVIDIA GPU.

    Gaussians may be on the CPU or on the GPU; images are on the device of the first set. Sets
    without gradients stay on the GPU as long as their tensors exist.
    """

    def __init__(self, device: str | torch.device = "cuda") -> None:
        """Load gsplat.

        InputError if there is no GPU or no gsplat, or gsplat's kernels cannot be built.
        """
        self.device = torch.device(device)
        self._gsplat = load_gsplat(self.device)
        self._uploads = UploadCache(self.device)

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        previous_rendering: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them, in float32.

        Args:
            gaussians: one set, or several sets that are drawn together as if they were one.
                Gradients reach tensors that require them.
            camera: the view.
            eps2d: added to the diagonal of each projected covariance, in pixels².
            tiles: [ceil(H/16), ceil(W/16)] bool: the tiles of 16×16 pixels to draw; None: all.
            previous_rendering: where all other tiles are copied from; None: they are black.

        Raises:
            NotEnoughMemory: the GPU's memory is too small.
        """
        renderings = self.render_batch(
            [as_sets(gaussians)],
            [camera],
            eps2d=eps2d,
            tiles=[tiles],
            previous_renderings=[previous_rendering],
        )
        return renderings[0]

    def render_batch(
        self,
        scenes: Sequence[Sequence[Gaussians]],
        cameras: Sequence[Camera],
        *,
        eps2d: float = 0.0,
        tiles: Sequence[Tensor | None] | None = None,
        previous_renderings: Sequence[Rendering | None] | None = None,
    ) -> list[Rendering]:
        """Draw several views of one size at once; each has the bits that `render` would give.

        Args:
            scenes: for each view, the sets of Gaussians that it shows.
            cameras: one for each view. ValueError if they differ in width or height.
            eps2d: added to the diagonal of each projected covariance, in pixels².
            tiles: for each view [rows, columns] bool, the tiles of 16×16 pixels to draw, or None
                for all; None: all tiles of all views. ValueError if a shape does not fit.
            previous_renderings: for each view a rendering from which the other tiles are copied,
                or None for black; None: black for all views.

        Raises:
            NotEnoughMemory: the GPU's memory is too small.
        """
        width, height = common_size(cameras)
        device_tiles: list[Tensor | None] = []
        for view_tiles in tiles or [None] * len(cameras):
            if view_tiles is not None:
                check_tiles(view_tiles, height, width)
                view_tiles = view_tiles.to(self.device, torch.bool, non_blocking=True)
            device_tiles.append(view_tiles)

        count = sum(len(gaussians) for sets in scenes for gaussians in sets)
        purpose = f"to draw {count:,} Gaussians at {width}×{height} on the GPU"
        with report_memory_shortage("make the picture smaller", "use `device` cpu", what=purpose):
            drawn = self._draw(scenes, cameras, eps2d, device_tiles)
            views = zip(
                drawn,
                scenes,
                device_tiles,
                previous_renderings or [None] * len(cameras),
                strict=True,
            )
            return [
                self._finished(rendering, sets, view_tiles, previous_rendering)
                for rendering, sets, view_tiles, previous_rendering in views
            ]

    def _finished(
        self,
        rendering: Rendering,
        sets: Sequence[Gaussians],
        tiles: Tensor | None,
        previous_rendering: Rendering | None,
    ) -> Rendering:
        """A drawn view in which all other tiles are filled, on the device of the view's first set.

        Where `tiles` [rows, columns] bool is false, nothing was drawn. There, pixels come from
        `previous_rendering`, or are black if it is None. If `tiles` is None, all tiles were drawn.
        A view without sets comes back on the CPU.
        """
        if tiles is not None:
            if previous_rendering is not None:
                previous_rendering = Rendering(
                    *(
                        image.to(rendering.rgb, non_blocking=True)
                        for image in previous_rendering.tensors
                    )
                )
            rendering = paste(rendering, tiles, previous_rendering)
        target = sets[0].means.device if len(sets) else torch.device("cpu")
        return rendering.to(target)

    def _draw(
        self,
        scenes: Sequence[Sequence[Gaussians]],
        cameras: Sequence[Camera],
        eps2d: float,
        tiles: Sequence[Tensor | None],
    ) -> list[Rendering]:
        """Draw views of one size on the GPU; pixels outside of a view's `tiles` are undefined.

        `tiles` has for each view [rows, columns] bool on the GPU, or None for all tiles.
        """
        width, height = cameras[0].width, cameras[0].height
        rows, columns = tile_grid(height, width)
        batch = self._project(scenes, cameras, eps2d)
        if batch is None:  # no Gaussians: colour, depth and alpha are 0
            black = torch.zeros(len(cameras), height, width, 5, device=self.device)
            return [Rendering(image[..., :3], image[..., 3], image[..., 4]) for image in black]

        # Lists of the Gaussians that each tile of each view shows, sorted by depth. `gaussian_ids`
        # are required but not read, so that any tensor of this length will do.
        _, list_keys, ids = self._gsplat.isect_tiles(
            batch.centers.detach(), batch.radii, batch.depths.detach(), TILE_PX, columns, rows,
            packed=True, n_images=len(cameras),
            image_ids=batch.view_index, gaussian_ids=batch.view_index,
        )  # fmt: skip
        if len(ids) > MAX_LIST_ENTRIES:
            raise MemoryError(f"out of memory: {len(ids):,} entries in the lists of tiles")
        list_starts = self._gsplat.isect_offset_encode(list_keys, len(cameras), columns, rows)

        masks = None
        if any(view_tiles is not None for view_tiles in tiles):
            all_tiles = torch.ones(rows, columns, dtype=torch.bool, device=self.device)
            masks = torch.stack([all_tiles if mask is None else mask for mask in tiles])

        # Depth is blended as a fourth colour.
        channels = torch.cat([batch.colors, batch.depths[:, None]], dim=-1)  # [n, 4]
        images, alphas = self._gsplat.rasterize_to_pixels(
            batch.centers, batch.conics, channels, batch.opacities, width, height, TILE_PX,
            list_starts, ids, masks=masks, packed=True,
        )  # fmt: skip
        renderings = []
        for image, alpha in zip(images, alphas[..., 0], strict=True):  # [H, W, 4] and [H, W]
            depth = image[..., 3] / torch.where(alpha > 0, alpha, 1)
            renderings.append(Rendering(linear_to_srgb(image[..., :3]), depth, alpha))
        return renderings

    def _project(
        self, scenes: Sequence[Sequence[Gaussians]], cameras: Sequence[Camera], eps2d: float
    ) -> ProjectedBatch | None:
        """Upload and project the Gaussians of all views; None if there are none."""
        width, height = cameras[0].width, cameras[0].height
        extrinsics, intrinsics = self._upload_cameras(cameras)
        parts: list[ProjectedBatch] = []
        for view, sets in enumerate(scenes):
            near = near_plane(sets, cameras[view])
            for gaussians in sets:
                if not len(gaussians):  # gsplat 1.5.3 divides by the number of Gaussians
                    continue
                uploaded = self._uploads.upload(gaussians)
                # The covariances are given instead of the quaternions and scales (None, None).
                # Results have a first axis for cameras, of which there is one in each call.
                radii, centers, depths, conics, _ = self._gsplat.fully_fused_projection(
                    uploaded.means, uploaded.covariances, None, None,
                    extrinsics[view], intrinsics[view], width, height,
                    eps2d=eps2d, near_plane=near, far_plane=MAX_FINITE,
                    opacities=uploaded.opacities,
                )  # fmt: skip
                parts.append(
                    ProjectedBatch(
                        view_index=torch.full((len(gaussians),), view, device=self.device),
                        radii=radii[0],
                        centers=centers[0],
                        depths=depths[0],
                        conics=conics[0],
                        opacities=uploaded.opacities,
                        colors=uploaded.colors_seen_by(cameras[view]),
                    )
                )
        if not parts:
            return None
        names = [field.name for field in dataclasses.fields(ProjectedBatch)]
        return ProjectedBatch(
            **{name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        )

    def _upload_cameras(self, cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
        """World to camera [V, 1, 4, 4] and intrinsics [V, 1, 3, 3] of V cameras, in one upload."""
        # The 16 numbers of the first matrix, then the nine of the second.
        numbers = [
            [*camera.world_to_camera.flatten().tolist(), *camera.K.flatten().tolist()]
            for camera in cameras
        ]
        uploaded = torch.tensor(numbers, dtype=torch.float32).to(self.device, non_blocking=True)
        extrinsics = uploaded[:, :16].reshape(-1, 1, 4, 4)
        intrinsics = uploaded[:, 16:].reshape(-1, 1, 3, 3)
        return extrinsics, intrinsics


def load_gsplat(device: torch.device) -> ModuleType:
    """Import gsplat with its kernels, which are built at the first import.

    Raises:
        InputError: PyTorch sees no GPU, gsplat is missing or of another version, or it has no
            kernels, because they could not be built here.
    """
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "`device` cuda: PyTorch sees no NVIDIA GPU on this machine; use `device` cpu"
        )
    problem = f"gsplat cannot be used ({{reason}}): {INSTALL_ADVICE}, or use `device` cpu"
    with as_input_error("`device` cuda", problem):
        import gsplat

        if not gsplat.__version__.startswith(f"{GSPLAT_VERSION}."):
            raise RuntimeError(f"its version is {gsplat.__version__}, not {GSPLAT_VERSION}")
        from gsplat.cuda import _backend

        if _backend._C is None:
            raise RuntimeError(
                "it has no kernels: "
                "it needs a CUDA toolkit (nvcc) or a wheel built for this PyTorch"
            )
    package: ModuleType = gsplat
    return package
