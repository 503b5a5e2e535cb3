"""Renderers: Gaussians and a camera in, an image, its depth and its opacity out."""

import logging

import torch

from spackle.errors import InputError
from spackle.render.cpu import CpuRenderer
from spackle.render.cuda import GsplatRenderer
from spackle.render.pipeline import touched_tiles
from spackle.render.protocol import TILE, Renderer

__all__ = ["TILE", "CpuRenderer", "GsplatRenderer", "Renderer", "get_renderer", "touched_tiles"]

LOG = logging.getLogger("spackle")


def get_renderer(device: str = "auto") -> Renderer:
    """The renderer for a device: "cpu", "cuda", or "auto" for the best one on this machine.

    Raises:
        InputError: an unknown device, or a renderer that cannot run here.
    """
    if device == "cuda":
        return GsplatRenderer()
    if device not in ("auto", "cpu"):
        raise InputError(f"--device {device}: unknown device; use auto, cpu or cuda")
    if device == "auto" and torch.cuda.is_available():
        try:
            return GsplatRenderer()
        except InputError as error:
            LOG.warning("rendering on the processor: %s", error)
    return CpuRenderer()
