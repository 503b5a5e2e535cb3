"""Synthetic scenes of SHARP's size for benchmarks, views of them with holes, and the measured
commit.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import torch
from torch import Tensor

import spackle
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import MAX_DISPARITY, DepthRange, leftmost_and_rightmost
from spackle.render import Renderer
from spackle.residual import hole_area_ratio
from spackle.runtime.errors import InputError

SIDE = 1536  # pixels a side, as in SHARP
CELL = 2
HOLES = 0.05  # share of a view
HALVINGS = 14  # of the range in which `find_view` searches
CLOSE = 0.01  # relative tolerance of the share that it finds
# Boxes in front of the wall: left, top, right, bottom as fractions of the image, and depth in
# metres. They cover less than a tenth of it, so that camera paths look at the wall.
BOXES = (
    (0.15, 0.20, 0.30, 0.40, 3.5),
    (0.60, 0.35, 0.80, 0.55, 3.0),
    (0.35, 0.70, 0.50, 0.80, 4.0),
)
WALL_M = 6.0
BEHIND = 1.02  # ratio of the second layer's depth to the first's
SPREAD_PX = 1.3


def photo_scene(side: int = SIDE) -> tuple[Gaussians, Camera]:
    """Two layers of (side/2)² Gaussians, aligned with the pixels of a photo, over smooth but varied
    depths.

    Opacities are between 0.04 and 0.99, so that more Gaussians are rendered than a surface would
    need.
    """
    generator = torch.Generator().manual_seed(0)
    camera, uv, xs, ys, grid = _pixels(side)
    n = grid * grid
    layers = []
    for layer in range(2):
        waves = 1.5 * torch.sin(9 * xs / grid) * torch.cos(7 * ys / grid)
        z = 3 + 2 * layer + waves + 0.05 * torch.rand(grid, grid, generator=generator)
        scales = (
            (0.6 + 0.8 * torch.rand(n, 3, generator=generator)) * z.reshape(n, 1) / camera.focal[0]
        )
        quats = torch.randn(n, 4, generator=generator)
        opacities = 0.04 + 0.95 * torch.rand(n, generator=generator)
        colors = torch.rand(n, 3, generator=generator)
        layers.append(
            Gaussians(camera.unproject(uv, z).reshape(n, 3), quats, scales, opacities, colors)
        )
    return Gaussians.cat(layers), camera


def holed_scene(side: int = SIDE, height: int | None = None) -> tuple[Gaussians, Camera]:
    """Boxes in front of a wall, as two layers of (side/2)² Gaussians, and the photo's camera.

    Only views from the side have holes.

    `side` is the photo's width in pixels; `height`, by default the same, is its height. As in
    SHARP, the grid of Gaussians is square whatever the photo's shape is.
    """
    camera, uv, xs, ys, grid = _pixels(side, height)
    n = grid * grid
    depth = torch.full((grid, grid), WALL_M)
    for left, top, right, bottom, metres in BOXES:
        rows = slice(int(top * grid), int(bottom * grid))
        columns = slice(int(left * grid), int(right * grid))
        depth[rows, columns] = metres

    # Colours vary in waves, of another length for red, green and blue.
    hues = (0.4, 0.45, 0.55)
    waves = [
        0.5 + hue * torch.sin(20 * k * xs / grid + 3 * depth + k * ys / 9) / 2
        for k, hue in enumerate(hues, 1)
    ]
    colors = torch.stack(waves, dim=-1).reshape(n, 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    opacities = torch.full((n,), 0.99)
    layers = []
    for z in (depth, BEHIND * depth):
        scales = (SPREAD_PX * z.reshape(n, 1) / camera.focal[0]).expand(n, 3).contiguous()
        means = camera.unproject(uv, z).reshape(n, 3)
        layers.append(Gaussians(means, quats, scales, opacities, colors))
    return Gaussians.cat(layers), camera


def _pixels(side: int, height: int | None = None) -> tuple[Camera, Tensor, Tensor, Tensor, int]:
    """The photo's camera; its cells' centres [g, g, 2], their columns and rows [g, g], and g, the
    cells a side.
    """
    height = height or side
    grid = side // CELL
    ys, xs = torch.meshgrid(torch.arange(grid), torch.arange(grid), indexing="ij")
    pixels_of_cell = torch.tensor([side / grid, height / grid])
    uv = (torch.stack([xs, ys], dim=-1) + 0.5) * pixels_of_cell
    return Camera.from_focal(1.2 * side, side, height), uv, xs, ys, grid


def find_view(
    base: Gaussians, camera: Camera, renderer: Renderer, share: float = HOLES
) -> tuple[float, Camera]:
    """The disparity at which the right view has this share of holes, and the view.

    It is found by bisection, because holes grow with the disparity.

    Raises:
        InputError: there is no such view.
    """
    even_camera = camera.even()
    depths = DepthRange.of(base, is_metric=True)
    low = 0.0
    high = MAX_DISPARITY
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        _, view = leftmost_and_rightmost(even_camera, middle, depths)
        hole_ratio = hole_area_ratio(renderer.render(base, view).alpha)
        if hole_ratio < share:
            low = middle
        else:
            high = middle
        if abs(hole_ratio / share - 1) < CLOSE:
            return middle, view
    raise InputError(f"no view up to disparity {MAX_DISPARITY:g} has {share:.0%} holes")


def commit() -> str:
    """The commit of the checkout that this package runs from, with a + if files have changed; else
    "unknown".
    """
    git = ["git", "-C", str(Path(spackle.__file__).parent)]
    try:  # fails if the package is installed inside another project, which does not track it
        subprocess.run(
            [*git, "ls-files", "--error-unmatch", "__init__.py"], capture_output=True, check=True
        )
        found = [*git, "describe", "--always", "--dirty=+", "--exclude=*"]
        return subprocess.run(found, capture_output=True, check=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
