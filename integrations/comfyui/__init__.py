"""Spackle's nodes for ComfyUI: copy or link this folder into ComfyUI/custom_nodes, and install
Spackle beside ComfyUI.

ComfyUI's type IMAGE is [B, H, W, 3] sRGB in 0..1, and MASK is [B, H, W] in 0..1; depth is a grey
IMAGE. ComfyUI's type SPLAT is a batch of N Gaussians with linear scales, quaternions wxyz and
spherical harmonics of sRGB.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from spackle import Photo, Scene, get_renderer, hole_mask
from spackle import complete as complete_scene
from spackle.bases import BasePrediction
from spackle.bases.open import OpenedBase, open_base
from spackle.bases.settings import AUTO, AUTO_NETWORKS, BaseSettings
from spackle.core.camera import Camera
from spackle.core.color import linear_to_srgb, srgb_to_linear
from spackle.core.focal_length import resolve_focal_length
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import MAX_DISPARITY, TRAJECTORIES, TrajectoryKind
from spackle.depth.units import (
    RELATIVE_FAR_M,
    RELATIVE_KINDS,
    RELATIVE_NEAR_M,
    StoredDepth,
    relative_depth,
)
from spackle.formats.gaussian_columns import SH_C0
from spackle.views import DEFAULT_FRAME_COUNT

FILLS = ("auto", "network", "exemplar", "lama", "none")
FORMATS = (".ply", ".spz", ".sog", ".glb", ".splat", ".html")
DISPARITY = ("FLOAT", {"default": 0.2, "min": 0.0, "max": MAX_DISPARITY, "step": 0.01})
TRAJECTORY = (list(TRAJECTORIES), {"default": "rotate-forward"})


class LoadBase:
    """Loads a base, which turns an image into Gaussians."""

    CATEGORY, FUNCTION = "Spackle", "load"
    RETURN_TYPES: ClassVar = ("SPACKLE_BASE",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """`checkpoint` is a file of the base's weights; if empty, the download of `spackle weights
        get` is used.
        """
        names = [AUTO, *AUTO_NETWORKS]
        return {
            "required": {"name": (names,)},
            "optional": {"checkpoint": ("STRING", {"default": ""})},
        }

    def load(self, name: str, checkpoint: str = "") -> tuple[OpenedBase]:
        """InputError if the base is not installed, or the checkpoint does not hold the base's
        weights.
        """
        return (
            open_base(BaseSettings(name=name, checkpoint=Path(checkpoint) if checkpoint else None)),
        )


class PredictScene:
    """Predicts the Gaussians of the first image, without filling holes."""

    CATEGORY, FUNCTION = "Spackle", "predict"
    RETURN_TYPES: ClassVar = ("SPACKLE_SCENE",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """`fov` 0 means a 30 mm lens; `depth`, a relative map from `near` to `far` metres, replaces
        the base.
        """
        metres = {"min": 0.01, "max": 1000.0, "step": 0.1}
        optional = {
            "depth": ("IMAGE",),
            "depth_kind": (list(RELATIVE_KINDS),),
            "near": ("FLOAT", {"default": RELATIVE_NEAR_M, **metres}),
            "far": ("FLOAT", {"default": RELATIVE_FAR_M, **metres}),
            "fov": ("FLOAT", {"default": 0.0, "min": 0.0, "max": 170.0}),
        }
        return {"required": {"image": ("IMAGE",), "base": ("SPACKLE_BASE",)}, "optional": optional}

    def predict(
        self,
        image: Tensor,
        base: OpenedBase,
        depth: Tensor | None = None,
        depth_kind: Any = RELATIVE_KINDS[0],
        near: float = RELATIVE_NEAR_M,
        far: float = RELATIVE_FAR_M,
        fov: float = 0.0,
    ) -> tuple[Scene]:
        """InputError if the base cannot use the image."""
        rgb = image[0, ..., :3].detach().float().cpu().clamp(0, 1)
        height, width = rgb.shape[:2]
        lens = resolve_focal_length(
            "image", width, height, {}, focal_px=None, focal_mm=None, fov=fov or None
        )
        photo = Photo(rgb, *lens, Path("image"))
        if depth is not None:
            greys = depth[0].detach().float().cpu().mean(dim=-1).numpy()
            # of 8 bits
            eighth = 1 / 255 if np.allclose(255 * greys, np.round(255 * greys), atol=0.01) else None
            stored = StoredDepth(greys, Path("depth"))
            given = relative_depth(stored, depth_kind, near, far, eighth)
            base = open_base(BaseSettings(depth=given))
        prediction, _ = base.predict(photo)
        scene = Scene(
            prediction.gaussians,
            Gaussians.empty(),
            prediction.camera,
            is_metric=prediction.is_metric,
        )
        return (scene,)


class CompleteScene:
    """Fills the holes that a camera path uncovers."""

    CATEGORY, FUNCTION = "Spackle", "complete"
    RETURN_TYPES: ClassVar = ("SPACKLE_SCENE",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """`disparity` is the size of the camera movement; 0.3 is large."""
        given = {"scene": ("SPACKLE_SCENE",), "trajectory": TRAJECTORY, "disparity": DISPARITY}
        return {"required": {**given, "fill": (list(FILLS),)}}

    def complete(
        self, scene: Scene, trajectory: TrajectoryKind, disparity: float, fill: Any
    ) -> tuple[Scene]:
        """Add Gaussians in the holes; base Gaussians do not change."""
        cameras = scene.path(trajectory, disparity)
        prediction = BasePrediction(scene.base, scene.camera, {}, is_metric=scene.is_metric)
        made = complete_scene(prediction, cameras, fill=fill)
        return (dataclasses.replace(made, disparity=disparity),)


class RenderView:
    """Renders views along a path: images, masks of remaining holes, and depth, with near surfaces
    in white.
    """

    CATEGORY, FUNCTION = "Spackle", "render"
    RETURN_TYPES: ClassVar = ("IMAGE", "MASK", "IMAGE")
    RETURN_NAMES: ClassVar = ("image", "holes", "depth")

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """`frames` is the number of views in the batch."""
        frames = ("INT", {"default": DEFAULT_FRAME_COUNT, "min": 1, "max": 1000})
        given = {
            "scene": ("SPACKLE_SCENE",),
            "trajectory": TRAJECTORY,
            "disparity": DISPARITY,
            "frames": frames,
        }
        return {"required": given}

    def render(
        self, scene: Scene, trajectory: TrajectoryKind, disparity: float, frames: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Images [frames, H, W, 3], masks [frames, H, W] and depth [frames, H, W, 3]."""
        cameras = scene.path(trajectory, disparity, frames)
        renderer = get_renderer()
        views = [scene.render(camera, renderer) for camera in cameras]
        inverse = torch.stack(
            [torch.where(view.alpha > 0, 1 / view.depth.clamp(min=1e-6), 0.0) for view in views]
        )
        grey = inverse / inverse.amax().clamp(min=1e-12)
        holes = torch.stack([hole_mask(view.alpha).float() for view in views])
        return (
            torch.stack([view.rgb for view in views]).cpu(),
            holes.cpu(),
            grey[..., None].expand(-1, -1, -1, 3).cpu(),
        )


class ToSplat:
    """Converts a scene into the type SPLAT of ComfyUI's nodes."""

    CATEGORY, FUNCTION = "Spackle", "convert"
    RETURN_TYPES: ClassVar = ("SPLAT",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """The SPLAT has base and aux Gaussians."""
        return {"required": {"scene": ("SPACKLE_SCENE",)}}

    def convert(self, scene: Scene) -> tuple[Any]:
        """A batch with one set, with x right, y down, z forward from the photo's camera."""
        from comfy_api.latest import Types  # ComfyUI's own

        means, quats, scales, opacities, colors = (
            t.detach().float().cpu() for t in scene.gaussians.with_harmonics_count(0).tensors
        )
        harmonics = (linear_to_srgb(colors) - 0.5) / SH_C0
        quats = torch.nn.functional.normalize(quats, dim=-1)
        return (
            Types.SPLAT(
                means[None],
                scales[None],
                quats[None],
                opacities[None, :, None],
                harmonics[None, :, None],
            ),
        )


class FromSplat:
    """Converts Gaussians of other nodes into a scene, so that its holes can be filled."""

    CATEGORY, FUNCTION = "Spackle", "convert"
    RETURN_TYPES: ClassVar = ("SPACKLE_SCENE",)

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """The camera is at the origin and looks along z; `fov` 0 means a 30 mm lens."""
        side = {"min": 16, "max": 8192}
        size = {
            "width": ("INT", {"default": 1280, **side}),
            "height": ("INT", {"default": 720, **side}),
        }
        fov = ("FLOAT", {"default": 0.0, "min": 0.0, "max": 170.0})
        return {"required": {"splat": ("SPLAT",), **size, "fov": fov}}

    def convert(self, splat: Any, width: int, height: int, fov: float) -> tuple[Scene]:
        """The first set of a batch, with colours of degree 0."""
        count = splat.positions.shape[1] if splat.counts is None else int(splat.counts[0])
        parts = (splat.positions, splat.rotations, splat.scales, splat.opacities, splat.sh)
        means, quats, scales, opacities, harmonics = (
            part[0, :count].detach().float().cpu() for part in parts
        )
        colors = srgb_to_linear((0.5 + SH_C0 * harmonics[:, 0]).clamp(0, 1))
        lens, _ = resolve_focal_length(
            "splat", width, height, {}, focal_px=None, focal_mm=None, fov=fov or None
        )
        base = Gaussians(means, quats, scales, opacities[:, 0], colors)
        return (Scene(base, Gaussians.empty(), Camera.from_focal(lens, width, height)),)


class SaveScene:
    """Writes the scene into ComfyUI's output folder, and returns the view of the photo's camera."""

    CATEGORY, FUNCTION, OUTPUT_NODE = "Spackle", "save", True
    RETURN_TYPES: ClassVar = ("STRING", "IMAGE")
    RETURN_NAMES: ClassVar = ("file", "image")

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """Files are named NAME_00001.FORMAT, NAME_00002.FORMAT, ..."""
        name = ("STRING", {"default": "spackle"})
        return {"required": {"scene": ("SPACKLE_SCENE",), "name": name, "format": (list(FORMATS),)}}

    def save(self, scene: Scene, name: str, format: str) -> dict[str, Any]:
        """Write a new file; existing files are kept."""
        folder, stem = _output_folder(), Path(name).name or "spackle"
        count = next(
            k for k in range(1, 100_000) if not (folder / f"{stem}_{k:05d}{format}").exists()
        )
        file = folder / f"{stem}_{count:05d}{format}"
        scene.export(file)
        image = scene.render(scene.camera.even()).rgb.clamp(0, 1).cpu()[None]
        return {"ui": {"text": [str(file)]}, "result": (str(file), image)}


@functools.cache
def _output_folder() -> Path:
    import folder_paths  # ComfyUI's own

    return Path(folder_paths.get_output_directory())


NODES = (LoadBase, PredictScene, CompleteScene, RenderView, ToSplat, FromSplat, SaveScene)
TITLES = (
    "load base",
    "predict scene",
    "complete for a path",
    "render views",
    "to splat",
    "from splat",
    "save scene",
)
NODE_CLASS_MAPPINGS = {f"Spackle{node.__name__}": node for node in NODES}
NODE_DISPLAY_NAME_MAPPINGS = {
    name: f"Spackle: {title}" for name, title in zip(NODE_CLASS_MAPPINGS, TITLES, strict=True)
}
