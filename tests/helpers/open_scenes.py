"""Scenes that are open to all sides, with parts missing that are known: what is a hole is known.

A scene is a set of opaque rectangles, sampled by flat Gaussians. Some of the Gaussians are taken
out; a pixel that only the whole scene covers is a hole, one that it leaves empty is background.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from spackle.core.camera import Camera, look_at
from spackle.core.gaussians import Gaussians, quat_from_matrix
from spackle.render import CpuRenderer
from spackle.residual.features import MASK_THRESHOLD, hole_mask

Vector = Sequence[float]


@dataclasses.dataclass(frozen=True)
class OpenScene:
    """A whole scene, the same with parts missing, and cameras; y points down."""

    name: str
    whole: Gaussians
    given: Gaussians  # without the missing parts
    cameras: list[Camera]

    def truth(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """[H, W] bool: the true holes, and the true background, as a camera sees them."""
        is_empty = hole_mask(CpuRenderer().render(self.given, camera).alpha)
        is_open = hole_mask(CpuRenderer().render(self.whole, camera).alpha, MASK_THRESHOLD)
        return is_empty & ~is_open, is_open


def rectangle(
    center: Vector, across: Vector, down: Vector, spacing: float, hue: Vector
) -> Gaussians:
    """Flat Gaussians on a rectangle of the half sides `across` and `down`, `spacing` apart."""
    half_across = torch.tensor(across, dtype=torch.float32)
    half_down = torch.tensor(down, dtype=torch.float32)
    counts = [max(2, round(2 * float(side.norm()) / spacing)) for side in (half_across, half_down)]
    s, t = torch.meshgrid(*(torch.linspace(-1, 1, count) for count in counts), indexing="ij")
    offsets = s.flatten()[:, None] * half_across + t.flatten()[:, None] * half_down
    means = torch.tensor(center, dtype=torch.float32) + offsets
    axis_x, axis_y = half_across / half_across.norm(), half_down / half_down.norm()
    axes = torch.stack([axis_x, axis_y, torch.linalg.cross(axis_x, axis_y)], dim=1)
    # A pattern of soft waves, so that a fill has something to continue.
    wave = 0.12 * (torch.sin(9 * means).sum(1, keepdim=True) + torch.sin(23 * means[:, :1]))
    steps = [
        2 * float(side.norm()) / count
        for side, count in zip((half_across, half_down), counts, strict=True)
    ]
    return Gaussians(
        means,
        quat_from_matrix(axes)[None].repeat(len(means), 1),
        torch.tensor([0.75 * steps[0], 0.75 * steps[1], 0.02 * spacing]).repeat(len(means), 1),
        torch.full((len(means),), 0.99),
        (torch.tensor(hue) + wave).clamp(0.02, 1),
    )


def block(center: Vector, half: Vector, spacing: float, hue: Vector) -> Gaussians:
    """The six faces of a box with the half sides `half`."""
    x, y, z = center
    a, b, c = half
    faces = []
    for sign in (-1, 1):
        faces.append(rectangle((x + sign * a, y, z), (0, b, 0), (0, 0, c), spacing, hue))
        faces.append(rectangle((x, y + sign * b, z), (a, 0, 0), (0, 0, c), spacing, hue))
        faces.append(rectangle((x, y, z + sign * c), (a, 0, 0), (0, b, 0), spacing, hue))
    return Gaussians.cat(faces)


def ring(
    count: int,
    distance: float,
    height: float,
    focal: float = 110,
    width: int = 128,
    target: Vector = (0.0, 0.0, 0.0),
    turn: tuple[float, float] = (0.0, 2 * math.pi),
) -> list[Camera]:
    """Cameras around a target, `height` above it, over a part of a turn."""
    cameras = []
    point = torch.tensor(target, dtype=torch.float64)
    closed = turn[1] - turn[0] > 6
    for index in range(count):
        part = index / count if closed else index / max(1, count - 1)
        angle = turn[0] + (turn[1] - turn[0]) * part
        offset = torch.tensor([math.sin(angle), 0.0, -math.cos(angle)], dtype=torch.float64)
        eye = point + distance * offset - torch.tensor([0.0, height, 0.0], dtype=torch.float64)
        lens = Camera.from_focal(focal, width, width * 3 // 4)
        cameras.append(dataclasses.replace(lens, world_to_camera=look_at(eye, point).float()))
    return cameras


def without(gaussians: Gaussians, center: Vector, radius: float) -> Gaussians:
    """The Gaussians outside of a ball."""
    return gaussians.select((gaussians.means - torch.tensor(center)).norm(dim=1) > radius)


def seen_from(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """The Gaussians that at least one camera sees, as a reconstruction from its photos has them."""
    is_seen = torch.zeros(len(gaussians), dtype=torch.bool)
    for camera in cameras:
        depth = CpuRenderer().render(gaussians, camera).depth
        uv, z = camera.project(gaussians.means)
        column = uv[:, 0].floor().long()
        row = uv[:, 1].floor().long()
        inside = (z > 0) & (column >= 0) & (column < camera.width)
        inside &= (row >= 0) & (row < camera.height)
        row, column = row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)
        is_seen |= inside & (z < 1.03 * depth[row, column])
    return gaussians.select(is_seen)


def cup(size: float = 1.0, count: int = 12, height: float = 1.0, hole: float = 0.25) -> OpenScene:
    """A box with a handle; a part of one side and of the lid is missing."""
    s = 0.035
    body = block((0, 0, 0), (0.5, 0.6, 0.5), s, (0.6, 0.3, 0.25))
    bars = [
        block((0.72, -0.3, 0), (0.22, 0.05, 0.08), s, (0.5, 0.3, 0.3)),
        block((0.72, 0.3, 0), (0.22, 0.05, 0.08), s, (0.5, 0.3, 0.3)),
        block((0.92, 0, 0), (0.05, 0.35, 0.08), s, (0.5, 0.3, 0.3)),
    ]
    whole = Gaussians.cat([body, *bars])
    given = without(without(whole, (0, 0.05, -0.5), hole), (0.1, -0.6, 0.1), hole)
    scene = OpenScene("cup", whole.scaled(size), given.scaled(size), [])
    cameras = ring(count, 2.6 * size, height * size, focal=130)
    return dataclasses.replace(scene, cameras=cameras)


def chair(
    count: int = 10, height: float = 1.0, crossbars: bool = False, hole: float = 0.13
) -> OpenScene:
    """A chair with a hole in its seat and one in its back."""
    s = 0.03
    wood = (0.5, 0.35, 0.2)
    parts = [
        block((0, 0, 0), (0.4, 0.03, 0.4), s, wood),
        block((0, -0.42, 0.38), (0.4, 0.38, 0.03), s, wood),
    ]
    parts += [
        block((x, 0.43, z), (0.035, 0.4, 0.035), s, wood)
        for x in (-0.36, 0.36)
        for z in (-0.36, 0.36)
    ]
    if crossbars:
        parts += [block((0, 0.6, z), (0.34, 0.03, 0.03), s, wood) for z in (-0.36, 0.36)]
        parts += [block((x, 0.6, 0), (0.03, 0.03, 0.34), s, wood) for x in (-0.36, 0.36)]
    whole = Gaussians.cat(parts)
    given = without(without(whole, (0.05, 0, -0.05), hole), (0.0, -0.4, 0.38), hole)
    return OpenScene("chair", whole, given, ring(count, 2.0, height, focal=130))


def table(
    count: int = 12, height: float = 1.2, hole: float = 0.25, floor: bool = False
) -> OpenScene:
    """A table with a hole in its top, where somebody has deleted what stood there."""
    s = 0.035
    parts = [block((0, 0, 0), (0.9, 0.04, 0.6), s, (0.55, 0.45, 0.3))]
    parts += [
        block((x, 0.45, z), (0.05, 0.42, 0.05), s, (0.4, 0.3, 0.2))
        for x in (-0.8, 0.8)
        for z in (-0.5, 0.5)
    ]
    if floor:
        parts.append(rectangle((0, 0.9, 0), (2.5, 0, 0), (0, 0, 2.5), 0.07, (0.3, 0.35, 0.3)))
    whole = Gaussians.cat(parts)
    given = without(whole, (0.2, 0, 0.1), hole)
    return OpenScene("table", whole, given, ring(count, 2.4, height, focal=130))


def street(
    novel: float = 0.35, both: bool = True, count: int = 8, seed: int = 0, high: float = 0.6
) -> OpenScene:
    """Ground with houses and posts and no sky, of which only what photos showed is left."""
    generator = torch.Generator().manual_seed(seed)

    def some(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=generator))

    parts = [rectangle((0, 1.6, 8), (14, 0, 0), (0, 0, 14), 0.16, (0.35, 0.4, 0.3))]
    for x in (-6.0, -1.0, 4.5):
        tall = some(1.5, 3.0)
        parts.append(
            block(
                (x + some(-1, 1), 1.6 - tall, some(8, 12)),
                (some(1, 2), tall, some(1, 2)),
                0.11,
                (0.6, some(0.2, 0.6), 0.4),
            )
        )
    for x in (-2.5, 2.0):
        parts.append(
            block((x + some(-1, 1), 0.2, some(4, 6)), (0.15, 1.4, 0.15), 0.07, (0.3, 0.3, 0.5))
        )
    whole = Gaussians.cat(parts)

    def along(xs: Sequence[float]) -> list[Camera]:
        cameras = []
        for x in xs:
            lens = Camera.from_focal(105, 128, 96)
            pose = look_at(torch.tensor([x, -high, -1.0]), torch.tensor([0.3 * x, -0.2, 8.0]))
            cameras.append(dataclasses.replace(lens, world_to_camera=pose.float()))
        return cameras

    photos = along([-1.5, 0.0, 1.5])
    given = seen_from(whole, photos)
    new = along(
        [
            -1.5 - 3 * novel,
            -0.75,
            0.75,
            1.5 + 3 * novel,
            *[(-1) ** k * some(1, 3) for k in range(count - 7)],
        ]
    )
    return OpenScene("street", whole, given, [*photos, *new] if both else new)


def houses_around(count: int = 10, hole: float = 0.8, close: bool = False) -> OpenScene:
    """A house on a lawn seen from all around, with a hole in a wall, the roof and the lawn."""
    parts = [
        rectangle((0, 1.0, 0), (7, 0, 0), (0, 0, 7), 0.12, (0.3, 0.45, 0.25)),
        block((0, -0.2, 0), (1.6, 1.2, 1.2), 0.09, (0.7, 0.6, 0.45)),
        block((3.0, 0.2, 1.5), (0.2, 0.8, 0.2), 0.07, (0.35, 0.25, 0.2)),
    ]
    whole = Gaussians.cat(parts)
    given = without(whole, (0.3, 0, -1.2), hole * 0.6)
    given = without(given, (-2.5, 1.0, -1.0), hole)
    given = without(given, (1.6, -0.2, 0.1), hole * 0.5)
    cameras = ring(count, 6.5, 1.5, focal=110)
    if close:
        # One looks at the lawn alone.
        cameras[0] = ring(1, 3.5, 3.0, focal=150, target=(0.0, 1.0, -2.0))[0]
    return OpenScene("house", whole, given, cameras)


def room(count: int = 8, hole: float = 0.7, border: bool = True) -> OpenScene:
    """A room seen from its middle, with parts of a wall and of the ceiling missing."""
    s = 0.1
    whole = Gaussians.cat(
        [
            rectangle((0, 1.2, 0), (3, 0, 0), (0, 0, 3), s, (0.4, 0.35, 0.3)),
            rectangle((0, -1.2, 0), (3, 0, 0), (0, 0, 3), s, (0.7, 0.7, 0.7)),
            *(rectangle((x, 0, 0), (0, 0, 3), (0, 1.2, 0), s, (0.6, 0.65, 0.5)) for x in (-3, 3)),
            *(rectangle((0, 0, z), (3, 0, 0), (0, 1.2, 0), s, (0.5, 0.55, 0.65)) for z in (-3, 3)),
            block((1.2, 0.7, 1.4), (0.5, 0.5, 0.4), 0.07, (0.5, 0.3, 0.2)),
        ]
    )
    given = without(whole, (0.4, 0.2, 3.0), hole)
    if border:
        given = without(given, (-3.0, 1.2, 1.0), hole)
    # The cameras stand near the middle, and look outwards.
    cameras = []
    for index in range(count):
        angle = 2 * math.pi * index / count
        direction = torch.tensor([math.sin(angle), 0.05, math.cos(angle)])
        lens = Camera.from_focal(80, 128, 96)
        pose = look_at(-0.5 * direction + torch.tensor([0.0, 0.1, 0.0]), 2 * direction)
        cameras.append(dataclasses.replace(lens, world_to_camera=pose.float()))
    return OpenScene("room", whole, given, cameras)
