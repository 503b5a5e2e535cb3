"""Renderers turn Gaussians and a camera into colour, depth and opacity."""

import logging
from importlib import import_module

import torch

from spackle.render.cpu import CpuRenderer, touched_tiles
from spackle.render.protocol import TILE, Renderer
from spackle.runtime.errors import InputError

__all__ = ["TILE", "CpuRenderer", "Renderer", "device_of", "get_renderer", "touched_tiles"]

LOG = logging.getLogger("spackle")


def get_renderer(device: str = "auto") -> Renderer:
    """The renderer for a device: "cpu", "cuda", or "auto" for "cuda" if available.

    InputError if the device is unknown, or the renderer cannot run on this machine.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise InputError(f"--device {device}: unknown device; use auto, cpu or cuda")
    if device == "cuda" or (device == "auto" and torch.cuda.is_available()):
        try:
            gpu: Renderer = import_module("spackle.render.gsplat_backend").GsplatRenderer()
            return gpu
        except InputError as error:
            if device == "cuda":
                raise
            LOG.warning("rendering on the CPU: %s", error)
    return CpuRenderer()


def device_of(renderer: Renderer) -> torch.device:
    """The device of a renderer."""
    place: torch.device = getattr(renderer, "device", torch.device("cpu"))
    return place
