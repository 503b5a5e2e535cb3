"""What streets, gardens and tracks share: daylight, cameras in the open, trees, cars, people.

All coordinates are metres with z up. Angles of models are degrees, counterclockwise from above; at
0° a model looks towards −y.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.focal_length import focal_mm_to_px
from worlds.library import Library, Model
from worlds.lights import SKY_SHAPE, Lights, cloud_noise, direction_to_sun, sky_directions
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
# The camera's usual place is (0, 0), from where it looks towards +y.
FULL_DETAIL_M = 9.0  # trees nearer to that place keep all their leaves
# A model has at most `TRIANGLES_NEAR` triangles up to `NEAR_M` from that place; beyond, the limit
# falls with the square of the distance, as the model's size in the picture does.
TRIANGLES_NEAR = 130_000
NEAR_M = 8.0
CLOUD_SIDE = 512  # pixels of the square picture of noise from which clouds are made
KERB_M = 0.12  # height of pavements and gardens above roads
# Models' names, separated by spaces, as `Scene.find` takes them.
PEOPLE = (
    "female01 female02 female03 male01 male02 male03 boyStanding girlStanding holdingFemale01 "
    "holdingMale01 female-01-casual-clothing male-01-suit"
)


@dataclasses.dataclass
class Scene:
    """A place in the open while it is being built: its parts, and what stands where."""

    rng: Rng  # for all random choices
    library: Library
    cache: Path  # its folder `surfaces` keeps the pictures of made surfaces
    parts: list[Mesh] = dataclasses.field(default_factory=list)
    # Textures that are no files, by the name that materials give.
    pictures: dict[str, Bytes] = dataclasses.field(default_factory=dict)
    taken: list[Box] = dataclasses.field(default_factory=list)  # where nothing else may stand
    used: set[str] = dataclasses.field(default_factory=set)  # keys of the models in it
    leaves: int = 0  # triangles of plants so far

    def surface(self, *kinds: str) -> Surface:
        """A random made surface of one of these kinds, each as likely as often it is given."""
        kind = kinds[int(self.rng.integers(len(kinds)))]
        surfaces = outdoor_surfaces(self.cache / "surfaces", kind)
        return surfaces[int(self.rng.integers(len(surfaces)))]

    def find(self, names: str) -> list[Model]:
        """The library's models with these names, separated by spaces; others are left out.

        A name is the part of a model's key after the mark #.
        """
        table = _by_name(self.library)
        return [model for name in names.split() for model in table.get(name, ())]

    def is_free(self, box: Box, margin: float = 0.0) -> bool:
        """Whether nothing stands in a region, or within `margin` metres of its four sides.

        With a negative margin, things may reach that far into the region.
        """
        wider = dataclasses.replace(
            box, x0=box.x0 - margin, y0=box.y0 - margin, x1=box.x1 + margin, y1=box.y1 + margin
        )
        return not any(wider.meets(other) for other in self.taken)

    def distance_to_camera(self, x: float, y: float) -> float:
        """Metres from a point to the camera's usual place (0, 0); three times that behind it.

        The camera looks towards +y and stands up to 3 m before or behind its usual place, so that
        things with y < −4 m are behind it.
        """
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
        kept_share: float = 1.0,
        painted: bool = False,
        solid: bool = True,
    ) -> bool:
        """Add one of the models at a place if the place is free; returns whether it was added.

        Args:
            models: one of these is chosen; nothing is added if there are none.
            x, y: of its middle in metres.
            z: of its lower side.
            angle: degrees, counterclockwise from above; at 0 it looks towards −y.
            scale: factor of its size.
            margin: free space to other things in metres; negative: how far it may reach into them.
            kept_share: share of its small triangles that stay, such as leaves; see `thinned`.
            painted: whether it gets another colour, as cars do; see `repainted`.
            solid: whether it takes up the whole box around it. If not, as with a tree, whose crown
                is above, it takes up a square of half a metre around its middle.
        """
        # Far from the camera, only models with few triangles are used: up to a limit, or the two
        # with the fewest if all have more.
        limit = TRIANGLES_NEAR / max(1.0, self.distance_to_camera(x, y) / NEAR_M) ** 2
        simple = [one for one in models if one.triangles * kept_share <= limit]
        if not simple:
            simple = sorted(models, key=lambda one: one.triangles)[:2]
        if not simple:
            return False
        model = simple[int(self.rng.integers(len(simple)))]
        width, depth, height = (side * scale for side in model.entry.size_m)
        # Half the sides of the box around the turned model, which lie along x and y.
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
        if kept_share < 1:
            mesh = thinned(mesh, kept_share, int(self.rng.integers(1 << 30)))
        if painted:
            mesh = repainted(self.rng, mesh)
        self.parts.append(mesh.moved(rotation_z(angle) * scale, (x, y, z)))
        self.used.add(model.entry.key)
        return True


@functools.lru_cache(4)
def _by_name(library: Library) -> dict[str, list[Model]]:
    """The models of a library by the part of their key after the mark #."""
    table: dict[str, list[Model]] = {}
    for model in library.models:
        table.setdefault(model.entry.key.split("#")[-1], []).append(model)
    return table


def thinned(mesh: Mesh, kept_share: float, seed: int) -> Mesh:
    """The model of a tree with fewer leaves, for far away: a random share of its small triangles.

    Those that stay are enlarged, so that they cover as much as all did before. Triangles larger
    than four times the median, as those of a trunk, all stay as they are. The method is that of
    Cook et al., Stochastic Simplification of Aggregate Detail (2007).

    Args:
        mesh: the model.
        kept_share: share of the small triangles that stay, above 0 to 1.
        seed: decides which.
    """
    areas = _double_areas(mesh)
    small = areas < 4 * np.median(areas)
    # Neighbours in the file are often of one leaf, so groups of four stay or go together.
    group = np.arange(mesh.count) // 4
    group_stays = np.random.default_rng(seed).random(mesh.count // 4 + 1) < kept_share
    chosen = np.flatnonzero(group_stays[group] | ~small)
    corners = mesh.corners[chosen]
    middle = corners.mean(1, keepdims=True)
    # The root, because areas grow with the square of lengths.
    enlargement = np.where(small[chosen], kept_share**-0.5, 1.0)[:, None, None]
    return Mesh(
        (middle + (corners - middle) * enlargement).astype(np.float32),
        mesh.normals[chosen],
        mesh.uv[chosen],
        mesh.material[chosen],
        mesh.materials,
    )


def _double_areas(mesh: Mesh) -> NDArray[np.float32]:
    """[F] twice the area of each triangle in m²."""
    sides = mesh.corners[:, 1:] - mesh.corners[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1))


def repainted(rng: Rng, mesh: Mesh) -> Mesh:
    """The model of a car in another random colour, with glossy paint.

    The paint is on the material with the largest area, and on all of its colour. Materials with a
    picture, transparent ones (glass) and dark ones (tyres) are left as they are; if a model has no
    others, so is the model.
    """
    areas = np.bincount(mesh.material, _double_areas(mesh), minlength=len(mesh.materials))
    can_be_sheet_metal = [
        one.texture is None and one.opacity > 0.9 and max(one.color) > 0.12
        for one in mesh.materials
    ]
    areas = np.where(can_be_sheet_metal, areas, 0.0)
    if not areas.any():
        return mesh
    body = mesh.materials[int(areas.argmax())]
    red, green, blue = CAR_PAINTS[int(rng.integers(len(CAR_PAINTS)))]
    materials = [
        dataclasses.replace(one, color=(red, green, blue), specular=0.05, roughness=0.06)
        if one.texture is None and np.allclose(one.color, body.color, atol=0.02)
        else one
        for one in mesh.materials
    ]
    return mesh.with_materials(materials)


def daylight(rng: Rng) -> Lights:
    """Sun, sky and haze of a random hour, and no lamps; in 18 % of cases clouds hide the sun."""
    azimuth = rng.uniform(0, 2 * math.pi)
    elevation = math.radians(rng.uniform(14, 62))
    sun = direction_to_sun(azimuth, elevation)
    overcast = rng.random() < 0.18
    sky = open_sky(rng, sun, overcast)
    # The sun's colour, from nearly white to orange.
    warm = np.array([1.0, 0.9, 0.75]) ** rng.uniform(0.3, 1.6)
    # Irradiance of the sun, in units in which a white sky gives π; 0: behind clouds. A low sun is
    # weaker, because its light comes through more air.
    strength = 0.0 if overcast else rng.uniform(6, 15) * math.sin(elevation) ** 0.3
    # Haze has the colour of the sky 5 to 14 degrees above the horizon, which is at half its height.
    height_px = sky.shape[0]
    horizon = sky[int(0.42 * height_px) : int(0.47 * height_px)].mean((0, 1))
    return Lights(
        sky=sky,
        sun_direction=sun,
        sun_color=(warm * strength).astype(np.float32),
        sun_spread=float(rng.uniform(0.004, 0.01)),
        portals=np.zeros((0, 3, 3), np.float32),
        lamp_positions=np.zeros((0, 3), np.float32),
        lamp_radii=np.zeros(0, np.float32),
        lamp_colors=np.zeros((0, 3), np.float32),
        haze_m=float(1500 * 10 ** rng.uniform(0, 0.8)),  # 1.5 to 9.5 km
        haze_color=horizon.astype(np.float32),
    )


def open_sky(rng: Rng, sun: NDArray[np.float32], overcast: bool) -> NDArray[np.float32]:
    """[h, w, 3] a sky's linear radiance: clouds, haze around the sun, woods at the horizon, ground.

    A white surface under a white sky has 1. Pixels are those of `lights.sky_directions`; [h, w] is
    `lights.SKY_SHAPE`. The lower half is what is seen where nothing else is: the ground.

    Args:
        rng: for all random choices.
        sun: [3] unit vector towards the sun.
        overcast: whether clouds cover all of it.
    """
    directions = sky_directions(SKY_SHAPE)
    sine = np.clip(directions[..., 2:], 0, 1)  # [h, w, 1] of the elevation; 0 below the horizon
    sun_cosine = np.clip((directions * sun).sum(-1, keepdims=True), 0, 1)  # [h, w, 1]

    # Clear sky: from blue at the zenith to pale at the horizon. Pale colours reach far up, hence
    # the exponent below 1.
    zenith = np.array([0.16, 0.33, 0.8]) * rng.uniform(0.6, 1.0)
    horizon = np.array([0.72, 0.84, 1.0]) * rng.uniform(0.7, 1.0)
    sky = horizon + (zenith - horizon) * sine**0.45
    # The air around the sun shines: broadly (power 6), and close to it (power 80).
    sky = sky + (0.5 * sun_cosine**6 + 1.5 * sun_cosine**80) * np.array([1.0, 0.9, 0.75])

    clouds = _open_clouds(rng, directions, sun_cosine, overcast)
    sky = sky + (clouds.color - sky) * clouds.cover
    sky = _with_far_land(rng, sky, directions[..., 2:], horizon)
    # Nothing is quite black.
    return np.asarray(np.maximum(sky, 0.01), np.float32)


class _Clouds(NamedTuple):
    """Clouds in each direction of a sky."""

    color: NDArray[np.float64]  # [h, w, 3] linear radiance
    cover: NDArray[np.float64]  # [h, w, 1] share of the sky that they hide


def _open_clouds(
    rng: Rng,
    directions: NDArray[np.float32],
    sun_cosine: NDArray[np.float32],
    overcast: bool,
) -> _Clouds:
    """Random clouds, single ones or, if `overcast`, a closed cover.

    Args:
        rng: for all random choices.
        directions: [h, w, 3] unit vectors.
        sun_cosine: [h, w, 1] cosine of the angle to the sun; 0 for more than 90 degrees.
        overcast: whether they cover all of the sky.
    """
    # Clouds lie on a plane, which a ray meets at the point (x, y) / up: low clouds are far, small
    # and flat. 0.08 is added to `up`, so that the horizon is not infinitely far.
    up = np.clip(directions[..., 2], 0, 1)  # [h, w] sine of the elevation
    noise = cloud_noise(rng, (CLOUD_SIDE, CLOUD_SIDE), spots_across=5, octaves=7)
    pixels_per_unit = CLOUD_SIDE * rng.uniform(0.05, 0.12)  # of the plane, which is 1 above the eye
    scale = pixels_per_unit / (up + 0.08)
    rows = (directions[..., 1] * scale).astype(np.int64) % CLOUD_SIDE
    columns = (directions[..., 0] * scale).astype(np.int64) % CLOUD_SIDE

    # There are clouds where the noise exceeds a limit. It has a mean of 0 and a deviation of 1, so
    # −2.8 is exceeded nearly everywhere, and 1.6 seldom.
    limit = -2.8 if overcast else rng.uniform(0.0, 1.6)
    density = noise[rows, columns] - limit
    # They are closed from a density of 0.7 (1 / 1.4) on. Haze hides those below 8 degrees, whose
    # sine is 1 / 7, more and more.
    cover = np.clip(density * 1.4, 0, 1) * np.clip(up * 7, 0, 1)

    # Thick parts are darker below; those near the sun shine. The mean density of a closed cover is
    # 2.8; its thinner parts are brighter than the mean.
    thickness = density - 2.8 if overcast else np.clip(density, 0, 2.2)
    darkening = (0.12 if overcast else 0.3) * thickness
    brightness = 1.15 - darkening[..., None] + 0.8 * sun_cosine**12
    less_light = 0.75 if overcast else 1.0  # a closed cover lets less light through
    color = np.array([1.0, 1.0, 1.02]) * brightness * less_light
    return _Clouds(color, cover[..., None])


def _with_far_land(
    rng: Rng,
    sky: NDArray[np.float64],
    up: NDArray[np.float32],
    horizon: NDArray[np.float64],
) -> NDArray[np.float64]:
    """[h, w, 3] the sky with woods at the horizon, and the ground below them.

    Args:
        rng: for all random choices.
        sky: [h, w, 3] linear radiance.
        up: [h, w, 1] sine of the elevation.
        horizon: [3] colour of the clear sky at the horizon.
    """
    # The sine of the elevation up to which woods reach in each column: 0.012 (0.7 degrees) and
    # more, with 60 hills around the horizon.
    hills = np.abs(cloud_noise(rng, (1, SKY_SHAPE[1]), spots_across=60))[..., None]
    wood_top = 0.012 + 0.012 * hills

    # Both are paler than near ones, because air lies before them: the woods get a share of 60 % of
    # the horizon's colour, the ground one of grey.
    wood = np.array([0.1, 0.14, 0.07]) * rng.uniform(0.7, 1.3)
    paleness = rng.uniform(0.25, 0.6)
    wood = wood * (1 - paleness) + paleness * 0.6 * horizon
    treetops = 1 + 0.2 * cloud_noise(rng, SKY_SHAPE, spots_across=120, octaves=3)[..., None]
    ground = np.array([0.2, 0.22, 0.13]) * (1 - 0.3 * paleness) + 0.15 * paleness

    land = np.where(up < -0.01, ground, wood * treetops)  # from 0.6 degrees below the horizon
    return np.where(up < wood_top, land, sky)


def held_camera(
    rng: Rng, eye: Sequence[float], azimuth: float, height: int, width: int, pitch: float = -0.03
) -> Viewpoint:
    """A camera in a hand: a little crooked, with a focal length of 24 to 70 mm.

    Args:
        rng: for focal length, tilt and roll.
        eye: [3] where it is, in metres.
        azimuth: of the direction in which it looks, in radians: 0 is +x, π / 2 is +y.
        height, width: of the picture in pixels.
        pitch: mean tilt upwards in radians; people hold a camera a little downwards.
    """
    # As of a picture on 35 mm film. Phones have 24 to 28 mm; the exponent makes short ones more
    # frequent.
    focal_mm = 24 * (70 / 24) ** (rng.random() ** 1.8)
    camera = Camera.from_focal(focal_mm_to_px(focal_mm, width, height), width, height)
    tilt = float(np.clip(rng.normal(pitch, 0.06), -0.3, 0.2))
    roll = math.radians(rng.normal(0, 1.2))
    return Viewpoint(np.array(eye, np.float32), camera_axes(azimuth, tilt, roll), camera)


def eye_height(rng: Rng) -> float:
    """Metres of a camera above the ground: of one who stands in 80 %, of one who stoops in 20 %."""
    return float(rng.uniform(1.35, 1.75) if rng.random() < 0.8 else rng.uniform(0.6, 1.3))


def plain(color: Sequence[float], specular: float = 0.0, roughness: float = 1.0) -> Material:
    """A material of one sRGB colour [3] without a picture.

    Args:
        color: 0 to 1.
        specular: share of light that is mirrored when looked at straight on.
        roughness: 0: a mirror, 1: chalk.
    """
    red, green, blue = color
    return Material((float(red), float(green), float(blue)), None, specular, roughness)
