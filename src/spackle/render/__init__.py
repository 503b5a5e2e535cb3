"""Renderers: Gaussians and a camera in, an image, its depth and its opacity out."""

from spackle.errors import InputError
from spackle.render.cpu import CpuRenderer
from spackle.render.pipeline import touched_tiles
from spackle.render.protocol import TILE, Renderer

__all__ = ["TILE", "CpuRenderer", "Renderer", "get_renderer", "touched_tiles"]


def get_renderer(device: str = "auto") -> Renderer:
    """The renderer for a device: "cpu", or "auto" for the best one that there is.

    Raises:
        InputError: where this version has no renderer for the device.
    """
    if device in ("auto", "cpu"):
        return CpuRenderer()
    if device == "cuda":
        raise InputError("--device cuda: this version has no CUDA renderer yet; use --device cpu")
    raise InputError(f"--device {device}: unknown device; use auto or cpu")
