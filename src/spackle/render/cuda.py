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
    """A set as a camera sees it."""

    radii: Tensor  # [1, N, 2] int; 0 where nothing is seen
    means2d: Tensor  # [1, N, 2] pixels; anything where nothing is seen, as the rest
    depths: Tensor  # [1, N]
    conics: Tensor  # [1, N, 3]


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
        """What `make` makes of the set's material; not again for the key of the last call."""
        entry = self._entry(part)
        if entry is None:
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
        sets = [gaussians] if isinstance(gaussians, Gaussians) else [*gaussians] or [Gaussians.empty()]
        grid = tile_grid(camera.height, camera.width)
        if tiles is not None and tuple(tiles.shape) != grid:
            raise ValueError(f"tiles has shape {tuple(tiles.shape)}, expected {grid}")
        wanted = None if tiles is None else tiles.to(self.device, torch.bool)
        drawn = self._draw(sets, camera, eps2d, wanted)
        if wanted is not None:
            under = None if onto is None else Rendering(*(image.to(drawn.rgb) for image in onto.tensors))
            drawn = paste(drawn, wanted, under)
        return Rendering(*(image.to(sets[0].means.device) for image in drawn.tensors))

    def _draw(self, sets: Sequence[Gaussians], camera: Camera, eps2d: float, wanted: Tensor | None) -> Rendering:
        """Images drawn where `wanted` [rows, columns] says; elsewhere they hold anything."""
        width, height = camera.width, camera.height
        rows, columns = tile_grid(height, width)
        parts = [self._store.material(part) for part in sets]
        seen = self._seen(sets, camera, eps2d)
        radii = seen.radii
        if wanted is not None:
            radii = radii * _touching(seen.means2d.detach(), radii, wanted)[..., None]
        _, keys, ids = self._gsplat.isect_tiles(seen.means2d.detach(), radii, seen.depths.detach(), TILE, columns, rows)
        offsets = self._gsplat.isect_offset_encode(keys, 1, columns, rows)
        opacities = torch.cat([part.opacities for part in parts])[None]
        colors = torch.cat([part.colors for part in parts])[None]
        drawn, alpha = self._gsplat.rasterize_to_pixels(
            seen.means2d, seen.conics, torch.cat([colors, seen.depths[..., None]], dim=-1), opacities, width, height,
            TILE, offsets.reshape(1, rows, columns), ids, masks=None if wanted is None else wanted[None],
        )  # fmt: skip
        drawn, alpha = drawn[0], alpha[0, ..., 0]
        return Rendering(linear_to_srgb(drawn[..., :3]), drawn[..., 3] / torch.where(alpha > 0, alpha, 1), alpha)

    def _seen(self, sets: Sequence[Gaussians], camera: Camera, eps2d: float) -> Projection:
        """All sets as a camera sees them; what it sees of a set is remembered."""
        view = camera.world_to_camera.to(self.device, torch.float32)[None]
        lens = camera.K.to(self.device, torch.float32)[None]

        def project(part: Material) -> Projection:
            radii, means2d, depths, conics, _ = self._gsplat.fully_fused_projection(
                part.means, part.covariances, None, None, view, lens, camera.width, camera.height,
                eps2d=eps2d, near_plane=NEAR_PLANE, opacities=part.opacities,
            )  # fmt: skip
            return Projection(radii, means2d, depths, conics)

        numbers = (*camera.K.flatten().tolist(), *camera.world_to_camera.flatten().tolist())
        key = (eps2d, camera.width, camera.height, *numbers)
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
        install = "pip install 'spackle-nvs[cuda]'"
        raise InputError(f"--device cuda: needs gsplat ({error}): {install}, or use --device cpu") from error
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


def _touching(means2d: Tensor, radii: Tensor, wanted: Tensor) -> Tensor:
    """[1, N] int: 1 for a Gaussian whose box meets a wanted tile, by sums over the tiles above and to the left."""
    rows, columns = wanted.shape
    before = torch.nn.functional.pad(wanted.int(), (1, 0, 1, 0)).cumsum(0).cumsum(1).flatten()  # [(rows+1)(columns+1)]
    size = means2d.new_tensor([columns, rows])
    radii = radii.to(means2d)

    def tile(place: Tensor) -> Tensor:  # of what is out of sight gsplat leaves the place as the memory was
        return place.nan_to_num(0, 0, 0).clamp_min(0).minimum(size).long()

    low, high = tile(((means2d - radii) / TILE).floor()), tile(((means2d + radii) / TILE).ceil())

    def at(x: Tensor, y: Tensor) -> Tensor:
        return before[y * (columns + 1) + x]

    (left, top), (right, bottom) = low.unbind(-1), high.unbind(-1)
    return ((at(right, bottom) - at(left, bottom) - at(right, top) + at(left, top)) > 0).int()
