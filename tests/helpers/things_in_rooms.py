"""Scenes made of whole surfaces: things in front of walls and on floors, each known by itself.

Unlike the scene of a photo, such a scene has the backs of things, and the wall and the floor behind
them. World: x right, y down, z forward, metres.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians, quat_from_matrix
from spackle.render import CpuRenderer

SURFEL_OPACITY = 0.99
OVERLAP = 0.7  # standard deviation of a surfel, in distances to its neighbour
FLATNESS = 0.02  # thickness of a surfel, in its other standard deviations


@dataclasses.dataclass(frozen=True)
class Room:
    """A room and a thing in it."""

    background: Gaussians
    thing: Gaussians
    camera: Camera

    @property
    def scene(self) -> Gaussians:
        """The background's Gaussians, then those of the thing."""
        return Gaussians.cat([self.background, self.thing])

    @property
    def is_thing(self) -> Tensor:
        """[N] bool, of the scene's Gaussians."""
        own = torch.zeros(len(self.background) + len(self.thing), dtype=torch.bool)
        own[len(self.background) :] = True
        return own

    def mask(self, camera: Camera | None = None) -> Tensor:
        """[H, W] bool: where the thing is what a camera sees, by default the room's."""
        camera = camera or self.camera
        both = CpuRenderer().render(self.scene, camera).depth
        alone = CpuRenderer().render(self.thing, camera)
        return (alone.alpha > 0.5) & ((both - alone.depth).abs() < 0.02 * both)


def pattern(points: Tensor, color: tuple[float, float, float]) -> Tensor:
    """Linear colours [N, 3] of points [N, 3]: waves of ±0.1 in sRGB around a colour."""
    x, y, z = points.unbind(-1)
    waves = [torch.sin(9 * x + 4 * y), torch.sin(8 * y + 5 * z), torch.cos(7 * z + 6 * x)]
    return srgb_to_linear(torch.tensor(color) + 0.1 * torch.stack(waves, dim=-1))


def surfels(
    points: Tensor, normals: Tensor, spacing: float, color: tuple[float, float, float]
) -> Gaussians:
    """Flat Gaussians at points [N, 3] with normals [N, 3], `spacing` apart."""
    helper = torch.where(
        normals[:, :1].abs() < 0.9, torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0])
    )
    across = torch.nn.functional.normalize(torch.linalg.cross(normals, helper), dim=-1)
    along = torch.linalg.cross(normals, across)
    axes = torch.stack([across, along, normals], dim=-1)
    sigma = OVERLAP * spacing
    return Gaussians(
        points,
        quat_from_matrix(axes),
        torch.tensor([sigma, sigma, FLATNESS * sigma]).expand(len(points), 3).clone(),
        torch.full((len(points),), SURFEL_OPACITY),
        pattern(points, color),
    )


def rectangle(
    center: tuple[float, float, float],
    across: tuple[float, float, float],
    along: tuple[float, float, float],
    spacing: float,
    color: tuple[float, float, float],
) -> Gaussians:
    """A rectangle with two half sides `across` and `along`, which are vectors."""
    u = torch.tensor(across, dtype=torch.float32)
    v = torch.tensor(along, dtype=torch.float32)
    columns, rows = (max(2, math.ceil(2 * float(side.norm()) / spacing)) for side in (u, v))
    a = (torch.arange(columns) + 0.5) / columns * 2 - 1
    b = (torch.arange(rows) + 0.5) / rows * 2 - 1
    points = (
        torch.tensor(center) + a[None, :, None] * u + b[:, None, None] * v
    ).reshape(-1, 3)  # fmt: skip
    normal = torch.nn.functional.normalize(torch.linalg.cross(u, v), dim=0)
    return surfels(points, normal.expand_as(points).clone(), spacing, color)


def sphere(
    center: tuple[float, float, float],
    radius: float,
    spacing: float,
    color: tuple[float, float, float] = (0.8, 0.3, 0.2),
) -> Gaussians:
    """A ball's whole surface."""
    count = math.ceil(4 * math.pi * radius**2 / spacing**2)
    index = torch.arange(count) + 0.5
    height = 1 - 2 * index / count  # Fibonacci's spiral: even on the ball
    angle = math.pi * (1 + 5**0.5) * index
    ring = (1 - height**2).sqrt()
    normals = torch.stack([ring * angle.cos(), height, ring * angle.sin()], dim=-1)
    return surfels(torch.tensor(center) + radius * normals, normals, spacing, color)


def box(
    center: tuple[float, float, float],
    half: tuple[float, float, float],
    spacing: float,
    color: tuple[float, float, float] = (0.8, 0.5, 0.2),
    turn_degrees: float = 25.0,
) -> Gaussians:
    """A box's faces without the bottom, which nobody has seen, turned around the vertical."""
    c, s = math.cos(math.radians(turn_degrees)), math.sin(math.radians(turn_degrees))
    axes = [(c, 0.0, -s), (0.0, 1.0, 0.0), (s, 0.0, c)]
    faces = []
    for k in range(3):
        first, second = (k + 1) % 3, (k + 2) % 3
        across = tuple(half[first] * a for a in axes[first])
        along = tuple(half[second] * a for a in axes[second])
        for side in (-1.0, 1.0):
            if k == 1 and side > 0:
                continue
            middle = tuple(m + side * half[k] * a for m, a in zip(center, axes[k], strict=True))
            faces.append(rectangle(middle, across, along, spacing, color))  # type: ignore[arg-type]
    return Gaussians.cat(faces)


def room(
    thing: Gaussians,
    *,
    wall_depth: float = 5.0,
    floor_height: float | None = 1.0,
    width: int = 160,
    height: int = 120,
    focal: float = 150.0,
    pitch: float = 0.15,
    spacing: float = 0.03,
) -> Room:
    """A thing in front of a wall, and on a floor if `floor_height` is given (y points down).

    Args:
        pitch: how far down the camera looks, as the tangent of the angle.
    """
    wall = rectangle(
        (0, 0, wall_depth), (4, 0, 0), (0, 3, 0), spacing * 1.2, (0.2, 0.4, 0.7)
    )  # fmt: skip
    parts = [wall]
    if floor_height is not None:
        below = wall.select(wall.means[:, 1] < floor_height)
        floor = rectangle(
            (0, floor_height, wall_depth / 2 + 0.3), (4, 0, 0), (0, 0, wall_depth / 2 - 0.3),
            spacing * 0.8, (0.4, 0.55, 0.35),
        )  # fmt: skip
        parts = [below, floor]
    camera = Camera.from_focal(focal, width, height).looking(
        torch.zeros(3), torch.tensor([0.0, pitch, 1.0])
    )
    return Room(Gaussians.cat(parts), thing, camera)
