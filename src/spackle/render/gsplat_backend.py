"""The GPU renderer, by gsplat."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from types import ModuleType
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb
from spackle.core.gaussians import Gaussians, quat_to_matrix
from spackle.render.project import FINITE
from spackle.render.protocol import NEAR_PLANE, TILE, Rendering, check_tiles, paste, tile_grid
from spackle.runtime.device import report_memory_shortage
from spackle.runtime.errors import InputError, as_input_error

INSTALL = "pip install 'spackle-nvs[cuda]'"
MOST_ENTRIES = 2**31 - 1  # in the lists of tiles, which gsplat counts in int32


@dataclasses.dataclass(frozen=True)
class Material:
    """A set of Gaussians on the GPU in float32, as input of gsplat."""

    means: Tensor  # [N, 3]
    covariances: Tensor  # [N, 6]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, 3] linear

    @staticmethod
    def of(part: Gaussians, device: torch.device) -> Material:
        """Upload a set; Gaussians that are not finite become transparent."""
        there = [tensor.to(device, torch.float32, non_blocking=True) for tensor in part.tensors]
        finite = torch.stack(
            [t.detach().isfinite().unsqueeze(-1).flatten(1).all(1) for t in there]
        ).all(0)
        usable = Gaussians(
            *(torch.where(finite if t.ndim == 1 else finite[:, None], t, 0) for t in there)
        )
        return Material(usable.means, upper_covariances(usable), usable.opacities, usable.colors)


def upper_covariances(part: Gaussians) -> Tensor:
    """[N, 6]: xx, xy, xz, yy, yz, zz of Σ; matrix products would be rounded by autocast and TF32."""
    x, y, z = (quat_to_matrix(part.quats) * part.scales[:, None, :]).unbind(1)
    pairs = ((x, x), (x, y), (x, z), (y, y), (y, z), (z, z))
    return torch.stack([(a * b).sum(-1) for a, b in pairs], dim=-1)


class SetStore:
    """Cache of sets on the GPU; an entry lives as long as the set's means. Sets with gradients are not cached."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._kept = WeakTensorKeyDictionary()

    def material(self, part: Gaussians) -> Material:
        """The set on the GPU; it is uploaded again if a tensor was replaced or changed in place."""
        if any(
            t.requires_grad or t.is_inference() for t in part.tensors
        ):  # inference tensors have no version counter
            return Material.of(part, self.device)
        others, state = part.tensors[1:], [(t._version, t.data_ptr()) for t in part.tensors]
        kept = self._kept.get(part.means)  # type: ignore[no-untyped-call]
        if (
            kept is None
            or kept[1] != state
            or any(a is not b for a, b in zip(kept[0], others, strict=True))
        ):
            with torch.inference_mode(False):  # a later caller may need gradients
                kept = self._kept[part.means] = others, state, Material.of(part, self.device)
        material: Material = kept[2]
        return material


class GsplatRenderer:
    """Classic 3D Gaussian splatting by gsplat on an NVIDIA GPU; a `Renderer`.

    Gaussians may be on the CPU or on the GPU; images are on the device of the first set. Sets without gradients stay on
    the GPU as long as their tensors exist.
    """

    def __init__(self, device: str | torch.device = "cuda") -> None:
        """Load gsplat; InputError if there is no GPU or no gsplat, or gsplat's kernels cannot be built."""
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
        """See `Renderer.render`; the result is float32. NotEnoughMemory if the GPU's memory is too small."""
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
        """Render several views of one size in one batch, with the same bits as `render`.

        ValueError if the views differ in size, or `tiles` do not fit. NotEnoughMemory if the GPU's memory is too small.
        """
        width, height = cameras[0].width, cameras[0].height
        if any((camera.width, camera.height) != (width, height) for camera in cameras):
            raise ValueError("views that are drawn together must be of one size")
        wanted: list[Tensor | None] = [None] * len(cameras)
        for index, each in enumerate(tiles or []):
            if each is not None:
                check_tiles(each, height, width)
                wanted[index] = each.to(self.device, torch.bool, non_blocking=True)
        count = sum(len(part) for parts in scenes for part in parts)
        what = f"to draw {count:,} Gaussians at {width}×{height} on the GPU"
        with report_memory_shortage("make the picture smaller", "use --device cpu", what=what):
            drawn = self._draw(scenes, cameras, eps2d, wanted)
            results = []
            for view, parts, here, under in zip(
                drawn, scenes, wanted, onto or [None] * len(cameras), strict=True
            ):
                if here is not None:
                    kept = (
                        []
                        if under is None
                        else [t.to(view.rgb, non_blocking=True) for t in under.tensors]
                    )
                    view = paste(view, here, Rendering(*kept) if kept else None)
                results.append(
                    view.to(parts[0].means.device if len(parts) else torch.device("cpu"))
                )
        return results

    def _draw(
        self,
        scenes: Sequence[Sequence[Gaussians]],
        cameras: Sequence[Camera],
        eps2d: float,
        wanted: Sequence[Tensor | None],
    ) -> list[Rendering]:
        """Draw the tiles `wanted` [rows, columns]; other pixels are undefined."""
        width, height = cameras[0].width, cameras[0].height
        rows, columns = tile_grid(height, width)
        materials: list[Material] = []
        seen: list[
            Any
        ] = []  # for each set: number of the view, radii [N, 2], means2d [N, 2], depths, conics [N, 3]
        for k, (parts, (view, lens)) in enumerate(
            zip(scenes, self._matrices(cameras), strict=True)
        ):
            for part in parts:
                if not len(part):  # gsplat 1.5.3 divides by the number of Gaussians
                    continue
                material = self._store.material(part)
                found = self._gsplat.fully_fused_projection(
                    material.means, material.covariances, None, None, view, lens, width, height,
                    eps2d=eps2d, near_plane=NEAR_PLANE, far_plane=FINITE, opacities=material.opacities,
                )  # fmt: skip
                materials.append(material)
                seen.append(
                    (
                        torch.full((len(part),), k, device=self.device),
                        *(field[0] for field in found[:4]),
                    )
                )
        if not seen:
            black = torch.zeros(len(cameras), height, width, 5, device=self.device)
            return [Rendering(image[..., :3], image[..., 3], image[..., 4]) for image in black]
        of, radii, means2d, depths, conics = (torch.cat(field) for field in zip(*seen, strict=True))
        _, keys, ids = self._gsplat.isect_tiles(
            means2d.detach(), radii, depths.detach(), TILE, columns, rows,
            packed=True, n_images=len(cameras), image_ids=of, gaussian_ids=of,
        )  # fmt: skip
        if len(ids) > MOST_ENTRIES:
            raise MemoryError(f"out of memory: {len(ids):,} entries in the lists of tiles")
        masks = None
        if any(here is not None for here in wanted):
            every = torch.ones(rows, columns, dtype=torch.bool, device=self.device)
            masks = torch.stack([every if here is None else here for here in wanted])
        colors = torch.cat(
            [torch.cat([material.colors for material in materials]), depths[:, None]], dim=-1
        )
        drawn, alphas = self._gsplat.rasterize_to_pixels(
            means2d, conics, colors, torch.cat([material.opacities for material in materials]), width, height, TILE,
            self._gsplat.isect_offset_encode(keys, len(cameras), columns, rows), ids, masks=masks, packed=True,
        )  # fmt: skip
        return [
            Rendering(
                linear_to_srgb(image[..., :3]),
                image[..., 3] / torch.where(alpha > 0, alpha, 1),
                alpha,
            )
            for image, alpha in zip(drawn, alphas[..., 0], strict=True)
        ]

    def _matrices(self, cameras: Sequence[Camera]) -> Iterator[tuple[Tensor, Tensor]]:
        """Extrinsics [1, 4, 4] and intrinsics [1, 3, 3] of each camera, in one upload."""
        numbers = [
            (*c.world_to_camera.flatten().tolist(), *c.K.flatten().tolist()) for c in cameras
        ]
        there = torch.tensor(numbers, dtype=torch.float32).to(self.device, non_blocking=True)
        return zip(
            there[:, :16].reshape(-1, 1, 4, 4), there[:, 16:].reshape(-1, 1, 3, 3), strict=True
        )


def load_gsplat(device: torch.device) -> ModuleType:
    """Import gsplat with its kernels, which are built at the first import; see `GsplatRenderer` for errors."""
    if device.type == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--device cuda: PyTorch sees no NVIDIA GPU on this machine; use --device cpu"
        )
    with as_input_error(
        "--device cuda", f"gsplat cannot be used ({{reason}}): {INSTALL}, or use --device cpu"
    ):
        import gsplat

        if not gsplat.__version__.startswith("1.5."):  # another version may clamp alpha elsewhere
            raise RuntimeError(f"its version is {gsplat.__version__}, not 1.5")
        from gsplat.cuda import _backend

        if _backend._C is None:
            raise RuntimeError(
                "it has no kernels: it needs a CUDA toolkit (nvcc) or a wheel built for this PyTorch"
            )
    package: ModuleType = gsplat
    return package
