"""Pictures of a world: linear colour, depth and normals at the photo's camera and beside it.

Colour has smooth edges: pixels at outlines and at borders of sunlight are the mean of several
rays. Depth, normal and validity are those of the one surface in the middle of the pixel.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from spackle.core.camera import Camera
from worlds.caster import NUDGE_M, Hits, World
from worlds.irradiance import Irradiance, solve, sun_on
from worlds.lights import Lights
from worlds.viewpoints import Viewpoint, pixel_grid

Rng = np.random.Generator
Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]
EDGE_RAYS = 4  # further rays of a pixel at an edge
EDGE_COSINE = 0.93  # neighbours of one surface have normals at less than 22 degrees
EDGE_RATIO = 0.02  # neighbours of one surface are this near to each other's plane, in depths
# Width in rooms, in metres, of the coarse cells of light: light that surfaces send to each other is
# kept on cells of one width; what a picture shows, on fine cells of about five of its pixels.
COARSE_M = 0.22
SHINY = 0.35  # surfaces rougher than this show no reflections
GLASS_SHINE = 0.1  # share of light that panes reflect; it comes from the room's mean
MAX_RADIANCE = 12.0  # brighter rays would make edges hard again
# Values of the validity mask.
UNSURE = 0  # seen through glass
VALID = 1  # a surface
FAR = 2  # the sky


@dataclasses.dataclass(frozen=True)
class View:
    """What a camera sees."""

    camera: Camera  # in the photo's coordinates
    radiance: Floats  # [H, W, 3] linear, in units of a white sky
    depth: Floats  # [H, W] metres along the camera's axis, inf for the sky
    normal: Floats  # [H, W, 3] unit vectors in this camera's axes, 0 for the sky
    valid: NDArray[np.uint8]  # [H, W] 1: a surface; 2: the sky; 0: seen through glass


@dataclasses.dataclass
class _Traced:
    """Rays of a camera, and the surfaces where they end."""

    camera: Camera
    origins: Floats  # [N, 3]
    directions: Floats  # [N, 3] of depth 1
    hits: Hits
    smooth: Floats  # [N, 3] unit normals for shading, 0 for the sky
    flat: Floats  # [N, 3] unit normals of the triangles, 0 for the sky
    positions: Floats  # [N, 3] where they end; for the sky the origin


def render(
    rng: Rng,
    world: World,
    lights: Lights,
    viewpoint: Viewpoint,
    cameras: list[Camera],
    coarse_m: float,
) -> list[View]:
    """The views of a world from several cameras, in their order, all with the same light.

    Args:
        rng: directions of rays.
        world: the triangles, in metres.
        lights: what shines on them: sky, sun, windows, lamps.
        viewpoint: the photo's camera, and where it is in the world.
        cameras: the views' cameras, in the photo's coordinates.
        coarse_m: width in metres of the coarse cells, which have one width everywhere, and on which
            surfaces light each other. What the views show is kept on fine cells, which are about
            five pixels wide in the photo.
    """
    traced = [_traced_at_centers(world, viewpoint, camera) for camera in cameras]
    # The light is found once, on all surfaces that any view sees. The photo's eye and focal length
    # tell how wide a fine cell is there.
    met = [one.hits.triangle >= 0 for one in traced]
    focal_px = viewpoint.camera.focal[0]
    irradiance = solve(
        world,
        lights,
        rng,
        np.concatenate([one.positions[m] for one, m in zip(traced, met, strict=True)]),
        np.concatenate([one.smooth[m] for one, m in zip(traced, met, strict=True)]),
        viewpoint.eye,
        focal_px,
        coarse_m,
    )
    return [_view_of_rays(rng, world, lights, irradiance, viewpoint, one) for one in traced]


def _traced_at_centers(world: World, viewpoint: Viewpoint, camera: Camera) -> _Traced:
    """The rays through the middles of a camera's pixels, row by row, and where they end.

    Args:
        world: the triangles.
        viewpoint: the photo's camera, and where it is in the world.
        camera: in the photo's coordinates.
    """
    origins, directions = viewpoint.rays(camera, pixel_grid(camera.height, camera.width))
    return _traced(world, camera, origins, directions)


def _traced(world: World, camera: Camera, origins: Floats, directions: Floats) -> _Traced:
    """Where rays end, and the surfaces there."""
    hits = world.first_hits(origins, directions)
    smooth, flat = world.normals(hits, directions)
    reach = np.where(hits.triangle >= 0, hits.distance, 0.0)[:, None]
    positions = (origins + reach * directions).astype(np.float32)
    return _Traced(camera, origins, directions, hits, smooth, flat, positions)


def _view_of_rays(
    rng: Rng,
    world: World,
    lights: Lights,
    irradiance: Irradiance,
    viewpoint: Viewpoint,
    middle: _Traced,
) -> View:
    """A camera's view, coloured by the rays through its pixels and by more rays at edges.

    Args:
        rng: places of the further rays in the pixels at edges.
        world, lights, irradiance: the world and its light.
        viewpoint: the photo's camera, and where it is in the world.
        middle: the rays through the middles of the view's pixels.
    """
    camera = middle.camera
    shape = (camera.height, camera.width)
    suns = _points_of_sun(lights)
    colors, sunlit = _shaded(world, lights, irradiance, camera, middle, suns[0])

    # Pixels at edges become the mean of several rays. Very bright ones are limited, because a
    # single one would decide the mean.
    edges = _edges(middle, sunlit, shape).reshape(-1)
    chosen = np.flatnonzero(edges)
    if len(chosen):
        total = np.minimum(colors[chosen], MAX_RADIANCE)
        centers = pixel_grid(*shape)[chosen]
        for number in range(EDGE_RAYS):
            # One ray in each quarter of the pixel.
            quarter = np.array([number % 2, number // 2 % 2]) / 2 - 0.5
            pixels = centers + quarter + rng.random((len(chosen), 2)) / 2
            rays = viewpoint.rays(camera, pixels.astype(np.float32))
            more = _traced(world, camera, *rays)
            extra, _ = _shaded(world, lights, irradiance, camera, more, suns[1 + number])
            total += np.minimum(extra, MAX_RADIANCE)
        colors[chosen] = total / (EDGE_RAYS + 1)

    # Normals in this camera's axes.
    found = middle.hits.triangle >= 0
    rotation = camera.world_to_camera[:3, :3].numpy() @ viewpoint.axes
    normal = (middle.smooth @ rotation.T).astype(np.float32)
    valid = np.where(found, VALID, FAR).astype(np.uint8)
    valid[(middle.hits.transmittance < 1) & found] = UNSURE
    # A ray has depth one, so distances along it are depths.
    return View(
        camera,
        colors.reshape(*shape, 3),
        middle.hits.distance.reshape(shape),
        normal.reshape(*shape, 3),
        valid.reshape(shape),
    )


def _points_of_sun(lights: Lights) -> Floats:
    """[1 + EDGE_RAYS, 3] unit directions to the middle of the sun and around it."""
    # Two directions at right angles to the sun's.
    across = np.cross(lights.sun_direction, [0.0, 0.0, 1.0])
    across = across / max(float(np.linalg.norm(across)), 1e-6)
    upwards = np.cross(across, lights.sun_direction)
    # Points on a circle of 0.7 of the sun's radius, which halves its disc. The turn of 0.4 steps
    # keeps them off the vertical and the horizontal.
    angles = 2 * np.pi * (np.arange(EDGE_RAYS) + 0.4) / EDGE_RAYS
    around = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * upwards
    points = lights.sun_direction + 0.7 * lights.sun_spread * np.concatenate(
        [0 * around[:1], around]
    )
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True), np.float32)


def _edges(middle: _Traced, sunlit: Floats, shape: tuple[int, int]) -> Bools:
    """[H, W] pixels with another surface or other sunlight beside them.

    Args:
        middle: the rays through the middles of all pixels.
        sunlit: [H · W] cosine towards the sun, 0 in shadow.
        shape: height and width.
    """
    triangle = middle.hits.triangle.reshape(shape)
    depth = np.where(triangle >= 0, middle.hits.distance.reshape(shape), 1e6)
    normal = middle.flat.reshape(*shape, 3)
    position = middle.positions.reshape(*shape, 3)
    lit = sunlit.reshape(shape) > 0
    glass = middle.hits.transmittance.reshape(shape)
    edges = np.zeros(shape, bool)
    # Each pixel is compared with the one below it, then with the one to its right.
    for axis in (0, 1):
        one = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        other = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        # Another surface: turned another way, or away from the plane of this one.
        turned = (normal[one] * normal[other]).sum(-1) < EDGE_COSINE
        apart = np.abs(((position[one] - position[other]) * normal[one]).sum(-1))
        away = apart > EDGE_RATIO * np.minimum(depth[one], depth[other])
        differs = (triangle[one] < 0) != (triangle[other] < 0)
        both_sky = (triangle[one] < 0) & (triangle[other] < 0)
        shade = lit[one] != lit[other]
        pane = glass[one] != glass[other]  # the border of a pane
        edge = ((turned | away) & ~both_sky) | differs | shade | pane
        edges[one] |= edge
        edges[other] |= edge
    return edges


def _shaded(
    world: World,
    lights: Lights,
    irradiance: Irradiance,
    camera: Camera,
    traced: _Traced,
    sun_direction: Floats,
) -> tuple[Floats, Floats]:
    """Linear colour [N, 3] of rays, and [N] the cosine towards the sun where it shines.

    Args:
        world, lights, irradiance: the world and its light.
        camera: the rays' camera.
        traced: the rays.
        sun_direction: [3] to one point of the sun's disc; all rays of a pixel take different ones.
    """
    hits = traced.hits
    count = len(hits.triangle)
    colors = np.zeros((count, 3), np.float32)
    sunlit = np.zeros(count, np.float32)
    lengths = np.linalg.norm(traced.directions, axis=1)
    unit = (traced.directions / lengths[:, None]).astype(np.float32)
    found = np.flatnonzero(hits.triangle >= 0)
    open_sky = np.flatnonzero(hits.triangle < 0)
    colors[open_sky] = lights.sky_smooth(unit[open_sky])
    if len(found):
        part = hits.select(found)
        normals = traced.smooth[found]
        positions = traced.positions[found]
        towards = -unit[found]
        facing = np.clip((normals * towards).sum(1), 0.05, 1)
        # A pixel covers more of a surface that is seen at a grazing angle.
        footprint = part.distance * lengths[found] / camera.focal[0] / np.sqrt(facing)
        albedo = world.albedo(part, footprint.astype(np.float32))
        light = irradiance.at(positions, normals)
        if lights.sun_color.any():
            flat = traced.flat[found]
            # The flat normal decides whether light may come, the smooth one how much.
            seen = sun_on(world, sun_direction, positions + NUDGE_M * flat, normals)
            sunlit[found] = seen
            light = light + seen[:, None] * lights.sun_color
        # A matt surface reflects its irradiance / π in all directions; lamps shine besides.
        material = world.mesh.material[part.triangle]
        glow = world.emission[material][:, None] * world.color[material]
        shaded = albedo * light / np.pi + glow
        shaded = _with_reflections(
            world, lights, irradiance, shaded, positions, normals, towards, material
        )
        if np.isfinite(lights.haze_m):
            # Haze takes the light of far surfaces, and gives that of the sky near the horizon. At
            # a distance of `haze_m` metres 1/e of a surface's light is left.
            clear = np.exp(-part.distance * lengths[found] / lights.haze_m)[:, None]
            shaded = shaded * clear + (1 - clear) * lights.haze_color
        colors[found] = shaded
    # Panes darken what is behind them, and mirror some of the room.
    transmittance = hits.transmittance[:, None]  # [N, 1] of the panes
    colors = colors * transmittance + (1 - transmittance) * GLASS_SHINE * irradiance.mean / np.pi
    return colors.astype(np.float32), sunlit


def _with_reflections(
    world: World,
    lights: Lights,
    irradiance: Irradiance,
    colors: Floats,
    positions: Floats,
    normals: Floats,
    towards: Floats,
    material: NDArray[np.int32],
) -> Floats:
    """Colours [N, 3] with what shiny surfaces mirror.

    Args:
        world, lights, irradiance: the world and its light.
        colors: [N, 3] linear, without reflections.
        positions, normals: [N, 3] the points, and their unit normals.
        towards: [N, 3] unit vectors to the eye.
        material: [N] of the points.
    """
    specular = world.specular[material]
    roughness = world.roughness[material]
    shiny = np.flatnonzero((specular > 0.01) & (roughness < SHINY))
    if not len(shiny):
        return colors
    n = normals[shiny]
    v = towards[shiny]
    blur = roughness[shiny]
    # One mirrored ray; what it meets is blurred by the roughness. Spread rays would need to be
    # many, or leave grain.
    cosine = (n * v).sum(1, keepdims=True)
    direction = (2 * cosine * n - v).astype(np.float32)
    above = (direction * n).sum(1) > 0.01
    # Schlick's approximation of Fresnel's formula: at a grazing angle everything is mirrored.
    share = specular[shiny] + (1 - specular[shiny]) * np.clip(1 - cosine[:, 0], 0, 1) ** 5
    # Rough surfaces scatter most of it, and fade out at the limit.
    share = share * (1 - blur / SHINY)
    origins = positions[shiny] + _off_surface(n)
    mirrored = world.first_hits(origins.astype(np.float32), direction)
    seen = np.flatnonzero((mirrored.triangle >= 0) & above)
    light = np.zeros((len(shiny), 3), np.float32)
    if len(seen):
        part = mirrored.select(seen)
        where = (origins[seen] + part.distance[:, None] * direction[seen]).astype(np.float32)
        side, _ = world.normals(part, direction[seen])
        # A rough surface blurs what it mirrors, the more the farther away that is.
        width = 0.005 + (0.002 + 0.6 * blur[seen]) * part.distance  # metres
        own = world.albedo(part, width.astype(np.float32))
        number = world.mesh.material[part.triangle]
        glow = world.emission[number][:, None] * world.color[number]
        light[seen] = own * irradiance.roughly_at(where, side) / np.pi + glow
    sky = np.flatnonzero((mirrored.triangle < 0) & above)
    # The glow around the sun is limited: it would make single pixels sparkle.
    light[sky] = np.minimum(lights.sky_smooth(direction[sky]), 3.0)
    result = colors.copy()
    weight = share[:, None]
    result[shiny] = colors[shiny] * (1 - weight) + light * weight
    return result


def _off_surface(normals: Floats) -> Floats:
    """[N, 3] a small step off a surface."""
    return (NUDGE_M * 4 * normals).astype(np.float32)
