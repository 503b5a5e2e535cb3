"""The GPU renderer: gsplat behind the same protocol."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import ModuleType

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from spackle.camera import Camera
from spackle.color import linear_to_srgb
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.render.paste import paste
from spackle.render.protocol import NEAR_PLANE, TILE
from spackle.rendering import Rendering

UPPER = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))  # gsplat's order of a symmetric matrix' six values
EXTRA = "pip install 'spackle-nvs[cuda]'"


class GsplatRenderer:
    """Classic 3D Gaussian splatting by gsplat on an NVIDIA GPU; a `Renderer`.

    Gaussians may lie on the processor or on the GPU: the images come back to where the first set lies. What asks for
    no gradient is kept on the GPU as long as its tensors live, so that a scene travels there once.
    """

    def __init__(self, device: str | torch.device = "cuda") -> None:
        """Load gsplat.

        Raises:
            InputError: no GPU, no gsplat, or one that cannot be built here.
        """
        self.device = torch.device(device)
        self._gsplat = load_gsplat(self.device)
        self._there = WeakTensorKeyDictionary()

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
        sets, home = self._upload(gaussians)
        grid = (-(-camera.height // TILE), -(-camera.width // TILE))
        if tiles is not None and tuple(tiles.shape) != grid:
            raise ValueError(f"tiles has shape {tuple(tiles.shape)}, expected {grid}")
        wanted = None if tiles is None else tiles.to(self.device, torch.bool)
        found = _first(self._draw(sets, [camera], eps2d, None if wanted is None else wanted[None]))
        if wanted is not None:
            under = None if onto is None else Rendering(*(t.to(found.rgb) for t in (onto.rgb, onto.depth, onto.alpha)))
            found = paste(found, wanted, under)
        return Rendering(*(image.to(home) for image in (found.rgb, found.depth, found.alpha)))

    def render_batch(
        self, gaussians: Gaussians | Sequence[Gaussians], cameras: Sequence[Camera], *, eps2d: float = 0.0
    ) -> list[Rendering]:
        """Views of cameras of one size in one call; see `render`."""
        if len({(camera.width, camera.height) for camera in cameras}) > 1:
            raise ValueError("cameras drawn in one call must have one size")
        if not cameras:
            return []
        sets, home = self._upload(gaussians)
        rgb, depth, alpha = (image.to(home) for image in dataclasses.astuple(self._draw(sets, cameras, eps2d, None)))
        return [Rendering(*images) for images in zip(rgb, depth, alpha, strict=True)]

    def _upload(self, gaussians: Gaussians | Sequence[Gaussians]) -> tuple[Gaussians, torch.device]:
        """All sets as one on the GPU, and where the first one lies."""
        sets = [gaussians] if isinstance(gaussians, Gaussians) else [*gaussians]
        home = sets[0].means.device if sets else torch.device("cpu")
        there = [Gaussians(*(self._on_device(tensor) for tensor in part.tensors)) for part in sets]
        return _usable(
            there[0] if len(there) == 1 else Gaussians.cat([Gaussians.empty().to(self.device), *there])
        ), home

    def _on_device(self, tensor: Tensor) -> Tensor:
        own = tensor.device.type == self.device.type and self.device.index in (None, tensor.device.index)
        if own or tensor.requires_grad or tensor.is_inference():
            return tensor.to(self.device, torch.float32)
        there: Tensor
        version, there = self._there.get(tensor, (None, tensor))  # type: ignore[no-untyped-call]
        if version != tensor._version:  # new, or changed in place
            there = tensor.to(self.device, torch.float32)
            self._there[tensor] = (tensor._version, there)
        return there

    def _draw(self, part: Gaussians, cameras: Sequence[Camera], eps2d: float, wanted: Tensor | None) -> Rendering:
        """[C, …] images of all cameras, drawn where `wanted` [C, rows, columns] says; elsewhere they hold anything."""
        count, width, height = len(cameras), cameras[0].width, cameras[0].height
        rows, columns = -(-height // TILE), -(-width // TILE)
        views = torch.stack([camera.world_to_camera.to(self.device, torch.float32) for camera in cameras])
        lenses = torch.stack([camera.K.to(self.device, torch.float32) for camera in cameras])
        covariances = part.covariances()[:, UPPER[0], UPPER[1]]
        opacities = part.opacities
        radii, means2d, depths, conics, _ = self._gsplat.fully_fused_projection(
            part.means, covariances, None, None, views, lenses, width, height,
            eps2d=eps2d, near_plane=NEAR_PLANE, opacities=opacities,
        )  # fmt: skip
        if wanted is not None:
            radii = radii * _touching(means2d.detach(), radii, wanted)[..., None]
        _, keys, ids = self._gsplat.isect_tiles(means2d.detach(), radii, depths.detach(), TILE, columns, rows)
        offsets = self._gsplat.isect_offset_encode(keys, count, columns, rows)
        colors = torch.cat([part.colors.expand(count, -1, -1), depths[..., None]], dim=-1)
        drawn, alpha = self._gsplat.rasterize_to_pixels(
            means2d, conics, colors, opacities.expand(count, -1).contiguous(), width, height, TILE,
            offsets.reshape(count, rows, columns), ids, masks=wanted,
        )  # fmt: skip
        alpha = alpha[..., 0]
        return Rendering(linear_to_srgb(drawn[..., :3]), drawn[..., 3] / torch.where(alpha > 0, alpha, 1), alpha)


def load_gsplat(device: torch.device) -> ModuleType:
    """The package, once its kernels are known to be there.

    Raises:
        InputError: no GPU, no gsplat, or one that cannot be built here.
    """
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


def _usable(part: Gaussians) -> Gaussians:
    """The same, with those that are not finite made transparent points: to take them out would wait for the GPU."""
    finite = torch.stack(
        [(t.detach().isfinite() if t.ndim == 1 else t.detach().isfinite().all(-1)) for t in part.tensors]
    )
    keep = finite.all(0)
    return Gaussians(*(torch.where(keep if t.ndim == 1 else keep[:, None], t, 0) for t in part.tensors))


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


def _first(rendering: Rendering) -> Rendering:
    return Rendering(rendering.rgb[0], rendering.depth[0], rendering.alpha[0])
