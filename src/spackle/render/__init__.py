"""Renderers turn Gaussians and a camera into colour, depth and opacity; nothing else splats.

Read `protocol.py` first: it says what a renderer takes and returns. `reference.py` is the shortest
renderer, and slow: it is the formula. `cpu.py` and `gsplat_backend.py` are those that people use.
The CPU's work is divided so: `project.py` (Gaussians become ellipses in the image), `tile_lists.py`
(which tile shows which Gaussians), `blend.py` (pixels), `drawing.py` (these three in a row),
`gradients.py` (the way back). Before it, `view_colors.py` gives Gaussians the colours that the
camera sees. `screen_blend.py` blends ellipses that are given in the image.
"""

import logging
from typing import get_args

import torch

from spackle.render.cpu import CpuRenderer
from spackle.render.drawing import touched_tiles
from spackle.render.gsplat_backend import GsplatRenderer
from spackle.render.protocol import TILE_PX, Renderer
from spackle.runtime.declared_options import DeviceName
from spackle.runtime.errors import InputError, check_name

__all__ = ["TILE_PX", "CpuRenderer", "Renderer", "get_renderer", "touched_tiles"]

LOG = logging.getLogger("spackle")


def get_renderer(device: str = "auto") -> Renderer:
    """The renderer for a device: "cpu", "cuda", or "auto" for "cuda" if available.

    With "auto", a GPU that cannot be used is reported in the log, and the CPU renders.

    Raises:
        InputError: the device is unknown, or "cuda" cannot render on this machine.
    """
    check_name("device", device, get_args(DeviceName))

    if device == "cuda" or (device == "auto" and torch.cuda.is_available()):
        try:
            return GsplatRenderer()
        except InputError as error:
            if device == "cuda":
                raise
            LOG.warning("rendering on the CPU: %s", error)
    return CpuRenderer()
