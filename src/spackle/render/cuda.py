"""The GPU renderer: gsplat behind the same protocol."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Hashable, Iterator, Sequence
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from spackle.camera import Camera
from spackle.color import linear_to_srgb
from spackle.device import MemoryShort, memory_is_short
from spackle.errors import InputError, reason_in_a_line
from spackle.gaussians import Gaussians, quat_to_matrix
from spackle.render.project import FINITE
from spackle.render.projection_cache import Snapshot
from spackle.render.protocol import NEAR_PLANE, TILE, Rendering, paste, tile_grid

VERSIONS = ("1.5.3", "1.6")  # of gsplat, from and before: others do not build, or have another largest alpha
INSTALL = "pip install 'spackle-nvs[cuda]'"
MOST_ENTRIES = 2**31 - 1  # of tile lists, which gsplat's rasteriser counts in int32


@dataclasses.dataclass(frozen=True)
class Material:
    """A set on the GPU, float32."""

    means: Tensor  # [N, 3]
    covariances: Tensor  # [N, 6]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3] linear

    @staticmethod
    def of(part: Gaussians, device: torch.device) -> Material:
        """Bring a set there; what is not finite becomes a transparent point: to take it out would wait for the GPU."""
        there = [tensor.to(device, torch.float32, non_blocking=True) for tensor in part.tensors]
        finite = torch.stack(
            [t.detach().isfinite() if t.ndim == 1 else t.detach().isfinite().all(-1) for t in there]
        ).all(0)
        usable = Gaussians(*(torch.where(finite if t.ndim == 1 else finite[:, None], t, 0) for t in there))
        return Material(usable.means, upper_covariances(usable), usable.opacities, usable.colors)


def upper_covariances(part: Gaussians) -> Tensor:
    """[N, 6], Σ's xx, xy, xz, yy, yz, zz, by products of numbers: autocast and TF32 round products of matrices."""
    x, y, z = (quat_to_matrix(part.quats) * part.scales[:, None, :]).unbind(1)
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    return torch.stack([(a * b).sum(-1) for a, b in pairs], dim=-1)


class Projection(NamedTuple):
    """A set as a camera sees it."""

    radii: Tensor  # [N, 2] int; 0 where nothing is seen
    means2d: Tensor  # [N, 2] pixels; anything where nothing is seen, as the rest
    depths: Tensor  # [N]
    conics: Tensor  # [N, 3]


@dataclasses.dataclass
class _Entry:
    snapshot: Snapshot
    material: Material
    key: Hashable = None
    projection: Projection | None = None


class SetStore:
    """Each set's material, and its last projection: a scene travels once, and is projected once a camera.

    Both go when the set's tensors go. A set that asks for a gradient is not remembered: it changes at every step.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._entries = WeakTensorKeyDictionary()

    def seen(
        self, part: Gaussians, key: Hashable, project: Callable[[Material], Projection]
    ) -> tuple[Material, Projection]:
        """The set on the GPU, and what `project` makes of it; not made again for the key of the last call."""
        entry = self._entry(part)
        if entry is None:
            material = Material.of(part, self.device)
            return material, project(material)
        if entry.projection is None or entry.key != key:
            with torch.inference_mode(False):
                entry.key, entry.projection = key, project(entry.material)
        return entry.material, entry.projection

    def _entry(self, part: Gaussians) -> _Entry | None:
        """What is remembered of a set, made where it is new or has changed; None for one that must not be."""
        if any(tensor.requires_grad for tensor in part.tensors) or not Snapshot.possible(part.tensors):
            return None
        entry: _Entry | None = self._entries.get(part.means)  # type: ignore[no-untyped-call]
        if entry is None or not entry.snapshot.shows(part.tensors):
            with torch.inference_mode(False):  # who asks next may want gradients of something drawn with it
                entry = _Entry(Snapshot(part.tensors), Material.of(part, self.device))
            self._entries[part.means] = entry
        return entry


class GsplatRenderer:
    """Classic 3D Gaussian splatting by gsplat on an NVIDIA GPU; a `Renderer`.

    Gaussians may lie on the processor or on the GPU: the images come back to where the first set lies. What asks for
    no gradient is remembered on the GPU as long as its tensors live: a scene travels there once, and is projected once
    for a camera however often some of its tiles are drawn again with more sets.
    """

    def __init__(self, device: str | torch.device = "cuda") -> None:
        """Load gsplat.

        Raises:
            InputError: no GPU, no gsplat, or one that cannot be built here.
        """
        self.device = torch.device(device)
        self._gsplat = load_gsplat(self.device)
        self._store = SetStore(self.device)

    def render(
        self,
        gaussians: Gaussians | Sequence[Gaussians],
        camera: Camera,
        *,
        eps2d: float = 0.0,
        tiles: Tensor | None = None,
        onto: Rendering | None = None,
    ) -> Rendering:
        """Draw Gaussians as a camera sees them; see `Renderer.render`. The result is float32.

        Raises:
            MemoryShort: the GPU's memory is too small.
        """
        sets = [gaussians] if isinstance(gaussians, Gaussians) else gaussians
        return self.render_batch([sets], [camera], eps2d=eps2d, tiles=[tiles], onto=[onto])[0]

    def render_batch(
        self,
        scenes: Sequence[Sequence[Gaussians]],
        cameras: Sequence[Camera],
        *,
        eps2d: float = 0.0,
        tiles: Sequence[Tensor | None] | None = None,
        onto: Sequence[Rendering | None] | None = None,
    ) -> list[Rendering]:
        """`render` of several views of one size, whose results it gives bit for bit; waits for the GPU once.

        Raises:
            ValueError: tiles that are not those of the view, or views of several sizes.
            MemoryShort: the GPU's memory is too small.
        """
        width, height = cameras[0].width, cameras[0].height
        if any((camera.width, camera.height) != (width, height) for camera in cameras):
            raise ValueError("views that are drawn together must be of one size")
        grid = tile_grid(height, width)
        chosen = tiles or [None] * len(cameras)
        for grid_of in chosen:
            if grid_of is not None and tuple(grid_of.shape) != grid:
                raise ValueError(f"tiles has shape {tuple(grid_of.shape)}, expected {grid}")
        wanted = [None if t is None else t.to(self.device, torch.bool, non_blocking=True) for t in chosen]
        count = sum(len(part) for parts in scenes for part in parts)
        with _enough_memory(f"{count:,} Gaussians at {width}×{height}"):
            drawn = self._draw(scenes, cameras, eps2d, wanted)
            results = []
            for view, parts, here, under in zip(drawn, scenes, wanted, onto or [None] * len(cameras), strict=True):
                if here is not None:
                    kept = [] if under is None else [t.to(view.rgb, non_blocking=True) for t in under.tensors]
                    view = paste(view, here, Rendering(*kept) if kept else None)
                results.append(view.to(parts[0].means.device if len(parts) else torch.device("cpu")))
        return results

    def touched_tiles(self, gaussians: Gaussians, camera: Camera, eps2d: float = 0.0) -> Tensor:
        """[rows, columns] bool on the GPU, see `spackle.render.touched_tiles`; tiles that boxes touch, more or less."""
        rows, columns = tile_grid(camera.height, camera.width)
        corners = torch.zeros((rows + 1) * (columns + 1), dtype=torch.int32, device=self.device)
        if len(gaussians):
            (numbers,) = self._numbers([camera])
            _, seen = self._seen(gaussians, camera, *numbers, eps2d)
            there = (seen.radii > 0).all(-1).int()
            left, top, right, bottom = _boxes(seen.means2d.detach(), seen.radii, rows, columns)
            for y, x, sign in ((top, left, 1), (bottom, right, 1), (top, right, -1), (bottom, left, -1)):
                corners.index_add_(0, y * (columns + 1) + x, sign * there)
        return corners.view(rows + 1, columns + 1).cumsum(0).cumsum(1)[:rows, :columns] > 0

    def _draw(
        self,
        scenes: Sequence[Sequence[Gaussians]],
        cameras: Sequence[Camera],
        eps2d: float,
        wanted: Sequence[Tensor | None],
    ) -> list[Rendering]:
        """Images drawn where `wanted` [rows, columns] says; elsewhere they hold anything."""
        width, height = cameras[0].width, cameras[0].height
        rows, columns = tile_grid(height, width)
        materials: list[Material] = []
        seen: list[Projection] = []
        boxes: list[Tensor] = []
        images: list[Tensor] = []
        for k, (parts, numbers) in enumerate(zip(scenes, self._numbers(cameras), strict=True)):
            for part in parts:
                if not len(part):  # gsplat 1.5.3 divides by the number of Gaussians
                    continue
                material, projection = self._seen(part, cameras[k], *numbers, eps2d)
                here, radii = wanted[k], projection.radii
                if here is not None:
                    radii = radii * _touching(projection.means2d.detach(), radii, here)[:, None]
                materials.append(material)
                seen.append(projection)
                boxes.append(radii)
                images.append(torch.full((len(part),), k, device=self.device))
        if not seen:
            black = torch.zeros(len(cameras), height, width, 5, device=self.device)
            return [Rendering(image[..., :3], image[..., 3], image[..., 4]) for image in black]
        means2d, depths, conics = (torch.cat(field) for field in list(zip(*seen, strict=True))[1:])
        of = torch.cat(images)
        _, keys, ids = self._gsplat.isect_tiles(
            means2d.detach(), torch.cat(boxes), depths.detach(), TILE, columns, rows,
            packed=True, n_images=len(cameras), image_ids=of, gaussian_ids=of,
        )  # fmt: skip
        if len(ids) > MOST_ENTRIES:
            raise MemoryError(f"out of memory: {len(ids):,} entries in the lists of tiles")
        masks = None
        if any(here is not None for here in wanted):
            every = torch.ones(rows, columns, dtype=torch.bool, device=self.device)
            masks = torch.stack([every if here is None else here for here in wanted])
        colors = torch.cat([torch.cat([material.colors for material in materials]), depths[:, None]], dim=-1)
        drawn, alphas = self._gsplat.rasterize_to_pixels(
            means2d, conics, colors, torch.cat([material.opacities for material in materials]), width, height, TILE,
            self._gsplat.isect_offset_encode(keys, len(cameras), columns, rows), ids, masks=masks, packed=True,
        )  # fmt: skip
        return [
            Rendering(linear_to_srgb(image[..., :3]), image[..., 3] / torch.where(alpha > 0, alpha, 1), alpha)
            for image, alpha in zip(drawn, alphas[..., 0], strict=True)
        ]

    def _numbers(self, cameras: Sequence[Camera]) -> list[tuple[Hashable, Tensor, Tensor]]:
        """Of each camera its numbers as a key, extrinsics [1, 4, 4] and intrinsics [1, 3, 3]: one upload for all."""
        keys = [(*c.world_to_camera.flatten().tolist(), *c.K.flatten().tolist()) for c in cameras]
        there = torch.tensor(keys, dtype=torch.float32).to(self.device, non_blocking=True)
        views, lenses = there[:, :16].reshape(-1, 1, 4, 4), there[:, 16:].reshape(-1, 1, 3, 3)
        return list(zip(keys, views, lenses, strict=True))

    def _seen(
        self, part: Gaussians, camera: Camera, numbers: Hashable, view: Tensor, lens: Tensor, eps2d: float
    ) -> tuple[Material, Projection]:
        """A set as a camera sees it, which is remembered."""

        def project(material: Material) -> Projection:
            found = self._gsplat.fully_fused_projection(
                material.means, material.covariances, None, None, view, lens, camera.width, camera.height,
                eps2d=eps2d, near_plane=NEAR_PLANE, far_plane=FINITE, opacities=material.opacities,
            )  # fmt: skip
            return Projection(*(field[0] for field in found[:4]))

        return self._store.seen(part, (eps2d, camera.width, camera.height, numbers), project)


@contextlib.contextmanager
def _enough_memory(what: str) -> Iterator[None]:
    """Turn a shortage of memory into one `MemoryShort` line."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not memory_is_short(error):
            raise
        raise MemoryShort(
            f"--device cuda: the GPU's memory is too small to draw {what}: close other programs, make the picture "
            "smaller, or use --device cpu"
        ) from error


def load_gsplat(device: torch.device) -> ModuleType:
    """The package, once its kernels are known to be there; see `GsplatRenderer` for what it raises."""
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch sees no NVIDIA GPU on this machine; use --device cpu")
    try:
        import gsplat

        check_version(gsplat.__version__)
        from gsplat.cuda import _backend
    except InputError:
        raise
    except Exception as error:  # its kernels are built when this is first imported: compilers fail in many ways
        if isinstance(error, ModuleNotFoundError) and error.name == "gsplat":
            raise InputError(f"--device cuda: needs gsplat: {INSTALL}, or use --device cpu") from error
        reason = reason_in_a_line(error)
        raise InputError(f"--device cuda: gsplat's kernels cannot be built here: {reason}; use --device cpu") from error
    if _backend._C is None:
        raise InputError(
            "--device cuda: gsplat has no kernels here: it needs a CUDA toolkit (nvcc) or a wheel built for this "
            "PyTorch; use --device cpu"
        )
    package: ModuleType = gsplat
    return package


def check_version(found: str) -> None:
    """InputError for a gsplat that would not do."""
    numbers = [int(part) for part in found.split("+")[0].split(".") if part.isdigit()]
    low, high = ([int(part) for part in version.split(".")] for version in VERSIONS)
    if not low <= numbers < high:
        raise InputError(
            f"--device cuda: gsplat {found} does not build here or draws otherwise: {INSTALL} takes one from "
            f"{VERSIONS[0]} on and before {VERSIONS[1]}; or use --device cpu"
        )


def _touching(means2d: Tensor, radii: Tensor, wanted: Tensor) -> Tensor:
    """[N] int: 1 for a Gaussian whose box meets a wanted tile, by sums over the tiles above and to the left."""
    rows, columns = wanted.shape
    before = torch.nn.functional.pad(wanted.int(), (1, 0, 1, 0)).cumsum(0).cumsum(1).flatten()  # [(rows+1)(columns+1)]
    left, top, right, bottom = _boxes(means2d, radii, rows, columns)

    def at(x: Tensor, y: Tensor) -> Tensor:
        return before[y * (columns + 1) + x]

    return ((at(right, bottom) - at(left, bottom) - at(right, top) + at(left, top)) > 0).int()


def _boxes(means2d: Tensor, radii: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The tiles of each box, [N] long: left and top, right and bottom (exclusive)."""

    def tile(place: Tensor) -> tuple[Tensor, Tensor]:  # of what is out of sight gsplat leaves the place as it was
        x, y = place.nan_to_num(0, 0, 0).unbind(-1)
        return x.clamp(0, columns).long(), y.clamp(0, rows).long()

    return *tile(((means2d - radii) / TILE).floor()), *tile(((means2d + radii) / TILE).ceil())
