"""The GPU renderer: gsplat behind the same protocol."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Sequence
from types import ModuleType
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from spackle.camera import Camera
from spackle.color import linear_to_srgb
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.render.projection_cache import Snapshot
from spackle.render.protocol import NEAR_PLANE, TILE, Rendering, paste, tile_grid

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))  # gsplat's order of a symmetric matrix' six values


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
        there = [tensor.to(device, torch.float32) for tensor in part.tensors]
        finite = torch.stack(
            [t.detach().isfinite() if t.ndim == 1 else t.detach().isfinite().all(-1) for t in there]
        ).all(0)
        usable = Gaussians(*(torch.where(finite if t.ndim == 1 else finite[:, None], t, 0) for t in there))
        return Material(usable.means, usable.covariances()[:, UPPER[0], UPPER[1]], usable.opacities, usable.colors)


class Projection(NamedTuple):
    """A set as C cameras see it."""

    radii: Tensor  # [C, N, 2] int; 0 where nothing is seen
    means2d: Tensor  # [C, N, 2] pixels; anything where nothing is seen, as the rest
    depths: Tensor  # [C, N]
    conics: Tensor  # [C, N, 3]


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

    def material(self, part: Gaussians) -> Material:
        """The set on the GPU."""
        entry = self._entry(part)
        return Material.of(part, self.device) if entry is None else entry.material

    def projection(self, part: Gaussians, key: Hashable, make: Callable[[Material], Projection]) -> Projection:
        """What `make` makes of the set's material; not again for the key of the last call. None is no such key."""
        entry = self._entry(part)
        if entry is None or key is None:
            return make(self.material(part))
        if entry.projection is None or entry.key != key:
            with torch.inference_mode(False):
                entry.key, entry.projection = key, make(entry.material)
        return entry.projection

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


EXTRA = "pip install 'spackle-nvs[cuda]'"


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
        """Draw Gaussians as a camera sees them; see `Renderer.render`. The result is float32."""
        sets = _listed(gaussians)
        grid = tile_grid(camera.height, camera.width)
        if tiles is not None and tuple(tiles.shape) != grid:
            raise ValueError(f"tiles has shape {tuple(tiles.shape)}, expected {grid}")
        wanted = None if tiles is None else tiles.to(self.device, torch.bool)
        drawn = self._draw(sets, [camera], eps2d, None if wanted is None else wanted[None])
        found = Rendering(drawn.rgb[0], drawn.depth[0], drawn.alpha[0])
        if wanted is not None:
            under = None if onto is None else Rendering(*(image.to(found.rgb) for image in onto.tensors))
            found = paste(found, wanted, under)
        return Rendering(*(image.to(sets[0].means.device) for image in found.tensors))

    def render_batch(
        self, gaussians: Gaussians | Sequence[Gaussians], cameras: Sequence[Camera], *, eps2d: float = 0.0
    ) -> list[Rendering]:
        """Views of cameras of one size in one call; see `render`."""
        if len({(camera.width, camera.height) for camera in cameras}) > 1:
            raise ValueError("cameras drawn in one call must have one size")
        if not cameras:
            return []
        sets = _listed(gaussians)
        drawn = self._draw(sets, cameras, eps2d, None)
        rgb, depth, alpha = (image.to(sets[0].means.device) for image in drawn.tensors)
        return [Rendering(*images) for images in zip(rgb, depth, alpha, strict=True)]

    def _draw(
        self, sets: Sequence[Gaussians], cameras: Sequence[Camera], eps2d: float, wanted: Tensor | None
    ) -> Rendering:
        """[C, …] images of all cameras, drawn where `wanted` [C, rows, columns] says; elsewhere they hold anything."""
        count, width, height = len(cameras), cameras[0].width, cameras[0].height
        rows, columns = tile_grid(height, width)
        parts = [self._store.material(part) for part in sets]
        seen = self._seen(sets, cameras, eps2d)
        radii = seen.radii
        if wanted is not None:
            radii = radii * _touching(seen.means2d.detach(), radii, wanted)[..., None]
        _, keys, ids = self._gsplat.isect_tiles(seen.means2d.detach(), radii, seen.depths.detach(), TILE, columns, rows)
        offsets = self._gsplat.isect_offset_encode(keys, count, columns, rows)
        opacities = torch.cat([part.opacities for part in parts])
        colors = torch.cat([part.colors for part in parts]).expand(count, -1, -1)
        drawn, alpha = self._gsplat.rasterize_to_pixels(
            seen.means2d, seen.conics, torch.cat([colors, seen.depths[..., None]], dim=-1),
            opacities.expand(count, -1).contiguous(), width, height, TILE,
            offsets.reshape(count, rows, columns), ids, masks=wanted,
        )  # fmt: skip
        alpha = alpha[..., 0]
        return Rendering(linear_to_srgb(drawn[..., :3]), drawn[..., 3] / torch.where(alpha > 0, alpha, 1), alpha)

    def _seen(self, sets: Sequence[Gaussians], cameras: Sequence[Camera], eps2d: float) -> Projection:
        """All sets as all cameras see them; what one camera sees of a set is remembered."""
        views = torch.stack([camera.world_to_camera.to(self.device, torch.float32) for camera in cameras])
        lenses = torch.stack([camera.K.to(self.device, torch.float32) for camera in cameras])
        size = cameras[0].width, cameras[0].height

        def project(part: Material) -> Projection:
            radii, means2d, depths, conics, _ = self._gsplat.fully_fused_projection(
                part.means, part.covariances, None, None, views, lenses, *size,
                eps2d=eps2d, near_plane=NEAR_PLANE, opacities=part.opacities,
            )  # fmt: skip
            return Projection(radii, means2d, depths, conics)

        own = cameras[0]
        numbers = (*own.K.flatten().tolist(), *own.world_to_camera.flatten().tolist())
        key = (eps2d, *size, *numbers) if len(cameras) == 1 else None
        parts = [self._store.projection(part, key, project) for part in sets]
        return parts[0] if len(parts) == 1 else Projection(*(torch.cat(field, 1) for field in zip(*parts, strict=True)))


def load_gsplat(device: torch.device) -> ModuleType:
    """The package, once its kernels are known to be there; see `GsplatRenderer` for what it raises."""
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError("--device cuda: PyTorch sees no NVIDIA GPU on this machine; use --device cpu")
    try:
        import gsplat
        from gsplat.cuda import _backend
    except ImportError as error:
        raise InputError(f"--device cuda: needs gsplat ({error}): {EXTRA}, or use --device cpu") from error
    except Exception as error:  # its kernels are built when it is first imported: compilers fail in many ways
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(f"--device cuda: gsplat's kernels cannot be built here: {reason}; use --device cpu") from error
    if _backend._C is None:
        raise InputError(
            "--device cuda: gsplat has no kernels here: it needs a CUDA toolkit (nvcc) or a wheel built for this "
            "PyTorch; use --device cpu"
        )
    package: ModuleType = gsplat
    return package


def _listed(gaussians: Gaussians | Sequence[Gaussians]) -> list[Gaussians]:
    """One set at least, if only an empty one."""
    return [gaussians] if isinstance(gaussians, Gaussians) else [*gaussians] or [Gaussians.empty()]


def _touching(means2d: Tensor, radii: Tensor, wanted: Tensor) -> Tensor:
    """[C, N] int: 1 for a Gaussian whose box meets a wanted tile, by sums over the tiles above and to the left."""
    rows, columns = wanted.shape[1:]
    before = torch.nn.functional.pad(wanted.int(), (1, 0, 1, 0)).cumsum(1).cumsum(2).flatten(1)  # [C, (rows+1)(cols+1)]
    size = means2d.new_tensor([columns, rows])
    radii = radii.to(means2d)

    def tile(place: Tensor) -> Tensor:  # of what is out of sight gsplat leaves the place as the memory was
        return place.nan_to_num(0, 0, 0).clamp_min(0).minimum(size).long()

    low, high = tile(((means2d - radii) / TILE).floor()), tile(((means2d + radii) / TILE).ceil())

    def at(x: Tensor, y: Tensor) -> Tensor:
        return before.gather(1, y * (columns + 1) + x)

    (left, top), (right, bottom) = low.unbind(-1), high.unbind(-1)
    return ((at(right, bottom) - at(left, bottom) - at(right, top) + at(left, top)) > 0).int()
