"""The first use on a processor: kernels are compiled for it, by a second process those that are needed last.

Numba compiles one kernel at a time in a process, so a thread would not help. What is compiled lies on disk, where the
first process finds it when it comes to it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import subprocess
import sys
from collections.abc import Callable, Iterator

import torch

from spackle._numba import is_compiled
from spackle.camera import Camera
from spackle.patches import match_patches
from spackle.render import Renderer, get_renderer, place_of
from spackle.render.blend import blend_tiles
from spackle.scene_fill import FillContext, OcclusionGuard, fill_scene
from spackle.scene_fill.occlusion_guard import free_factors
from spackle.surface import surface_gaussians

SIDE = 64  # pixels of the picture that the second process completes


@contextlib.contextmanager
def compiled_ahead(renderer: Renderer, log: Callable[[str], None]) -> Iterator[None]:
    """While the block runs, a second process compiles kernels of rendering and completion, unless they are there."""
    if place_of(renderer).type != "cpu" or is_compiled(blend_tiles):
        yield
        return
    log("first use: kernels are compiled for this processor, which takes about half a minute, once")
    quiet = subprocess.DEVNULL
    helper = subprocess.Popen([sys.executable, "-m", __name__], stdin=quiet, stdout=quiet, stderr=quiet)
    try:
        yield
    finally:
        helper.kill()
        helper.wait()


@torch.no_grad()
def compile_kernels() -> None:
    """Complete a small view, so that all kernels of this are compiled: first those that the other comes to last."""
    torch.set_num_threads(1)
    camera = Camera.from_focal(SIDE, SIDE, SIDE)
    aside = torch.eye(4)
    aside[0, 3] = -0.4
    moved = dataclasses.replace(camera, world_to_camera=aside)
    depth = torch.full((SIDE, SIDE), 2.0)
    depth[SIDE // 4 : -SIDE // 4, SIDE // 4 : -SIDE // 4] = 1.0
    rgb, hole = torch.rand(SIDE, SIDE, 3), depth < 2
    match_patches(rgb, hole, 1 / depth)
    shape = camera.pixel_centers().flatten(0, 1), 1 / depth.flatten(), torch.zeros(SIDE**2, 2)
    base = surface_gaussians(camera, *shape, 0.6, rgb.flatten(0, 1), torch.full((SIDE**2,), 0.9))
    guard = OcclusionGuard.of(get_renderer("cpu").render(base, camera), camera)
    free_factors(base, moved.position, [guard])
    assert len(fill_scene(FillContext(base, camera, get_renderer("cpu")), [moved, camera]).aux)


if __name__ == "__main__":
    compile_kernels()
