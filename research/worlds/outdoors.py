"""What streets, gardens and tracks share: daylight, cameras in the open, trees, cars, people."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.focal_length import focal_mm_to_px
from worlds.library import Library, Model
from worlds.lights import SKY_SHAPE, Lights, cloud_noise, sky_directions
from worlds.meshes import Material, Mesh, rotation_z
from worlds.outdoor_surfaces import outdoor_surfaces
from worlds.placing import Box
from worlds.surfaces import Surface
from worlds.viewpoints import Viewpoint, camera_axes

Rng = np.random.Generator
Bytes = NDArray[np.uint8]
CAR_PAINTS = (
    (0.85, 0.85, 0.84), (0.06, 0.06, 0.07), (0.55, 0.56, 0.58), (0.3, 0.31, 0.33),
    (0.5, 0.06, 0.05), (0.08, 0.16, 0.36), (0.1, 0.24, 0.17), (0.62, 0.56, 0.44),
    (0.75, 0.4, 0.1), (0.28, 0.45, 0.6),
)  # fmt: skip
FULL_DETAIL_M = 9.0  # trees nearer to the camera's usual place keep all their leaves
TRIANGLES_NEAR = 130_000  # of a model at most, up to this distance from the usual place
NEAR_M = 8.0
CLOUD_SIDE = 512  # pixels of the noise of clouds
KERB_M = 0.12  # height of pavements and gardens above roads
PEOPLE = (
    "female01 female02 female03 male01 male02 male03 boyStanding girlStanding holdingFemale01 "
    "holdingMale01 female-01-casual-clothing male-01-suit"
)


@dataclasses.dataclass
class Scene:
    """A place in the open while it is being built: its parts, and what stands where."""

    rng: Rng
    library: Library
    cache: Path
    parts: list[Mesh] = dataclasses.field(default_factory=list)
    pictures: dict[str, Bytes] = dataclasses.field(default_factory=dict)
    taken: list[Box] = dataclasses.field(default_factory=list)
    used: set[str] = dataclasses.field(default_factory=set)  # keys of models
    leaves: int = 0  # triangles of plants so far

    def surface(self, *kinds: str) -> Surface:
        """A random surface of one of these kinds."""
        kind = kinds[int(self.rng.integers(len(kinds)))]
        found = outdoor_surfaces(self.cache / "surfaces", kind)
        return found[int(self.rng.integers(len(found)))]

    def find(self, names: str) -> list[Model]:
        """The models with these names, separated by spaces."""
        table = _by_name(self.library)
        return [model for name in names.split() for model in table.get(name, ())]

    def is_free(self, box: Box, margin: float = 0.0) -> bool:
        """Whether nothing stands in a region, or within `margin` of it."""
        wider = dataclasses.replace(
            box, x0=box.x0 - margin, y0=box.y0 - margin, x1=box.x1 + margin, y1=box.y1 + margin
        )
        return not any(wider.meets(other) for other in self.taken)

    def away(self, x: float, y: float) -> float:
        """Metres to the camera's usual place, which is (0, 0); what is behind it counts as far."""
        distance = math.hypot(x, y)
        return distance if y > -4 else 3 * distance

    def put(
        self,
        models: Sequence[Model],
        x: float,
        y: float,
        z: float,
        angle: float,
        *,
        scale: float = 1.0,
        margin: float = 0.05,
        keep: float = 1.0,
        painted: bool = False,
        solid: bool = True,
    ) -> bool:
        """One of the models at a place, if it is free; returns whether it was.

        Args:
            models: one of these.
            x, y, z: of its middle, and of its lower side.
            angle: degrees; at 0 it looks towards −y.
            scale: of its size.
            margin: free space to other things.
            keep: share of its leaves that stay; see `thinned`.
            painted: whether it gets another colour, as cars do.
            solid: whether it takes its place from others; crowns of trees do not.
        """
        # Far from the camera models are simple ones, if there are.
        limit = TRIANGLES_NEAR / max(1.0, self.away(x, y) / NEAR_M) ** 2
        simple = [one for one in models if one.triangles * keep <= limit]
        if not simple:
            simple = sorted(models, key=lambda one: one.triangles)[:2]
        if not simple:
            return False
        models = simple
        model = models[int(self.rng.integers(len(models)))]
        width, depth, height = (side * scale for side in model.entry.size_m)
        turn = math.radians(angle)
        half_x = (abs(math.cos(turn)) * width + abs(math.sin(turn)) * depth) / 2
        half_y = (abs(math.sin(turn)) * width + abs(math.cos(turn)) * depth) / 2
        if not solid:
            half_x = half_y = 0.25
        region = Box(x - half_x, y - half_y, x + half_x, y + half_y, z, z + height)
        if not self.is_free(region, margin):
            return False
        self.taken.append(region)
        mesh = self.library.mesh(model)
        if keep < 1:
            mesh = thinned(mesh, keep, int(self.rng.integers(1 << 30)))
        if painted:
            mesh = repainted(self.rng, mesh)
        self.parts.append(mesh.moved(rotation_z(angle) * scale, (x, y, z)))
        self.used.add(model.entry.key)
        return True


@functools.lru_cache(4)
def _by_name(library: Library) -> dict[str, list[Model]]:
    """The models of a library by the part of their key after the mark."""
    table: dict[str, list[Model]] = {}
    for model in library.models:
        table.setdefault(model.entry.key.split("#")[-1], []).append(model)
    return table


def thinned(mesh: Mesh, keep: float, seed: int) -> Mesh:
    """A far tree: a random share of its small triangles, enlarged to cover as much as before.

    The method is that of Cook et al., Stochastic Simplification of Aggregate Detail (2007).
    Triangles larger than four times the median, as those of a trunk, all stay.
    """
    sides = mesh.corners[:, 1:] - mesh.corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    small = area < 4 * np.median(area)
    # Neighbours in the file are often of one leaf, so groups of four stay or go together.
    group = np.arange(mesh.count) // 4
    stays = np.random.default_rng(seed).random(mesh.count // 4 + 1)[group] < keep
    chosen = np.flatnonzero(stays | ~small)
    corners = mesh.corners[chosen]
    middle = corners.mean(1, keepdims=True)
    factor = np.where(small[chosen], keep**-0.5, 1.0)[:, None, None]
    return Mesh(
        (middle + (corners - middle) * factor).astype(np.float32),
        mesh.normals[chosen],
        mesh.uv[chosen],
        mesh.material[chosen],
        mesh.materials,
    )


def repainted(rng: Rng, mesh: Mesh) -> Mesh:
    """A car in another colour: its largest material without a picture gets a glossy paint."""
    sides = mesh.corners[:, 1:] - mesh.corners[:, :1]
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    total = np.bincount(mesh.material, area, minlength=len(mesh.materials))
    plain = [
        one.texture is None and one.opacity > 0.9 and max(one.color) > 0.12
        for one in mesh.materials
    ]
    total = np.where(plain, total, 0.0)
    if not total.any():
        return mesh
    body = mesh.materials[int(total.argmax())]
    red, green, blue = CAR_PAINTS[int(rng.integers(len(CAR_PAINTS)))]
    # Parts of the same colour are of the same sheet metal.
    skins = [
        dataclasses.replace(one, color=(red, green, blue), specular=0.05, roughness=0.06)
        if one.texture is None and np.allclose(one.color, body.color, atol=0.02)
        else one
        for one in mesh.materials
    ]
    return mesh.with_materials(skins)


def daylight(rng: Rng) -> Lights:
    """Sun and sky of a random hour: clear in most cases, grey, or low and warm in others."""
    azimuth = rng.uniform(0, 2 * math.pi)
    elevation = math.radians(rng.uniform(14, 62))
    sun = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ],
        np.float32,
    )
    overcast = rng.random() < 0.18
    sky = open_sky(rng, sun, overcast)
    # Irradiance of the sun, in units in which a white sky gives π; 0: behind clouds.
    warm = np.array([1.0, 0.9, 0.75]) ** rng.uniform(0.3, 1.6)
    strength = 0.0 if overcast else rng.uniform(6, 15) * math.sin(elevation) ** 0.3
    # Haze has the colour of the sky a little above the horizon.
    height = sky.shape[0]
    horizon = sky[int(0.42 * height) : int(0.47 * height)].mean((0, 1))
    return Lights(
        sky=sky,
        sun_direction=sun,
        sun_color=(warm * strength).astype(np.float32),
        sun_spread=float(rng.uniform(0.004, 0.01)),
        portals=np.zeros((0, 3, 3), np.float32),
        lamp_positions=np.zeros((0, 3), np.float32),
        lamp_radii=np.zeros(0, np.float32),
        lamp_colors=np.zeros((0, 3), np.float32),
        haze_m=float(1500 * 10 ** rng.uniform(0, 0.8)),
        haze_color=horizon.astype(np.float32),
    )


def open_sky(rng: Rng, sun: NDArray[np.float32], overcast: bool) -> NDArray[np.float32]:
    """[h, w, 3] a sky with clouds that get smaller towards the horizon, and far woods below.

    Args:
        rng: for all random choices.
        sun: [3] unit vector towards the sun.
        overcast: whether clouds cover all of it.
    """
    directions = sky_directions(SKY_SHAPE)
    up = directions[..., 2]
    zenith = np.array([0.16, 0.33, 0.8]) * rng.uniform(0.6, 1.0)
    horizon = np.array([0.72, 0.84, 1.0]) * rng.uniform(0.7, 1.0)
    rise = np.clip(up, 0, 1)[..., None]
    sky = horizon + (zenith - horizon) * rise**0.45
    glow = np.clip((directions * sun).sum(-1, keepdims=True), 0, 1)
    sky = sky + (0.5 * glow**6 + 1.5 * glow**80) * np.array([1.0, 0.9, 0.75])

    # Clouds lie on a plane: seen at a low angle they are far away, small and flat.
    noise = cloud_noise(rng, (CLOUD_SIDE, CLOUD_SIDE), 5, 7)
    scale = CLOUD_SIDE * rng.uniform(0.05, 0.12) / (np.clip(up, 0, 1) + 0.08)
    rows = (directions[..., 1] * scale).astype(np.int64) % CLOUD_SIDE
    columns = (directions[..., 0] * scale).astype(np.int64) % CLOUD_SIDE
    density = noise[rows, columns] - (-2.8 if overcast else rng.uniform(0.0, 1.6))
    cover = (np.clip(density * 1.4, 0, 1) * np.clip(up * 7, 0, 1))[..., None]
    # Thick parts are darker below; those near the sun shine.
    depth = 0.12 * (density - 2.8) if overcast else 0.3 * np.clip(density, 0, 2.2)
    shade = 1.15 - depth[..., None] + 0.8 * glow**12
    white = np.array([1.0, 1.0, 1.02]) * shade * (0.75 if overcast else 1.0)
    sky = sky + (white - sky) * cover

    # Woods at the horizon, pale with distance, and the ground below them.
    edge = 0.012 + 0.012 * np.abs(cloud_noise(rng, (1, SKY_SHAPE[1]), 60))
    wood = np.array([0.1, 0.14, 0.07]) * rng.uniform(0.7, 1.3)
    pale = rng.uniform(0.25, 0.6)
    wood = wood * (1 - pale) + pale * 0.6 * horizon
    grain = 1 + 0.2 * cloud_noise(rng, SKY_SHAPE, 120, 3)[..., None]
    ground = np.array([0.2, 0.22, 0.13]) * (1 - 0.3 * pale) + 0.15 * pale
    land = np.where(up[..., None] < -0.01, ground, wood * grain)
    sky = np.where((up < edge)[..., None], land, sky)
    return np.asarray(np.maximum(sky, 0.01), np.float32)


def held_camera(
    rng: Rng, eye: Sequence[float], azimuth: float, height: int, width: int, pitch: float = -0.03
) -> Viewpoint:
    """A camera at a point [3], held a little crooked, with 24 to 70 mm.

    Args:
        rng: for focal length, tilt and roll.
        eye: metres.
        azimuth: of the direction in which it looks, in radians.
        height, width: of the picture.
        pitch: mean tilt upwards in radians.
    """
    # Phones have 24 to 28 mm. The exponent makes short ones more frequent.
    focal_mm = 24 * (70 / 24) ** (rng.random() ** 1.8)
    camera = Camera.from_focal(focal_mm_to_px(focal_mm, width, height), width, height)
    tilt = float(np.clip(rng.normal(pitch, 0.06), -0.3, 0.2))
    roll = math.radians(rng.normal(0, 1.2))
    return Viewpoint(np.array(eye, np.float32), camera_axes(azimuth, tilt, roll), camera)


def eye_height(rng: Rng) -> float:
    """Metres above the ground: standing in most cases, sometimes stooping."""
    return float(rng.uniform(1.35, 1.75) if rng.random() < 0.8 else rng.uniform(0.6, 1.3))


DrawViewpoint = Callable[[Rng, int, int], Viewpoint]  # by height and width of the picture


def plain(color: Sequence[float], specular: float = 0.0, roughness: float = 1.0) -> Material:
    """A material of one colour."""
    red, green, blue = color
    return Material((float(red), float(green), float(blue)), None, specular, roughness)
