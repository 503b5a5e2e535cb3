"""How much light falls on each place of a world, on a grid of small cells on its surfaces.

The light is kept in the world, not in a picture, so all views of a world agree. Cells are about
five pixels wide. Each cell sends rays over its hemisphere; where they end, coarse cells tell how
bright that surface is, and these have gathered light from each other several times. Light of
windows and lamps is sampled directly. Sunlight has sharp shadows, and is left to the picture.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from spackle.runtime.kernels import kernel
from worlds.caster import NUDGE_M, World
from worlds.lights import Lights

Floats = NDArray[np.float32]
Longs = NDArray[np.int64]
BASE_CELL_M = 0.01  # width of cells at level 0; each level doubles it
CELL_PX = 5.0  # width of a cell in the photo
MAX_LEVEL = 9  # cells of 5 m
# Coarse cells all have one width. Their level is this number, which no fine cell has.
COARSE_LEVEL = 20
GATHER_RAYS = 32  # of a fine cell
COARSE_RAYS = 24  # of a coarse cell
PORTAL_RAYS = 16  # of a cell towards the windows
LAMP_RAYS = 4  # of a cell towards each lamp
BOUNCES = 6  # how often light goes from coarse cells to coarse cells
COARSE_SAMPLES = 12  # places at which sunlight is looked for, for each coarse cell on average
EMPTY = -1  # a free place of a hash table, and the number of "no cell"
MAX_RAY_RATIO = 4.0  # a ray may be this many times as bright as the mean of its cell
# How the light of cells is smoothed against noise: rounds of (distance to the neighbours in cells,
# share by which their light may differ before they count less). Gathered light has noise of about a
# fifth, and varies slowly, so it gets more rounds and farther neighbours; direct light has less
# noise. The first round takes neighbours of any light, so that single outliers vanish.
ANY = 1e3
GATHERED_ROUNDS = ((1, ANY), (2, 0.6), (3, 0.5), (1, 0.5))
DIRECT_ROUNDS = ((1, ANY), (2, 0.4), (1, 0.4))
CHUNK = 400_000  # rays at once


@dataclasses.dataclass(frozen=True)
class Cells:
    """C cubes in which surfaces lie, in a hash table, and a point of a surface for each.

    A cell has a level, which tells its width, a place, and the one of six directions (±x, ±y, ±z)
    that the surface's normal is nearest to. So the two sides of a thin wall are two cells.
    """

    table: Longs  # [2^k] keys of cells at places by their hash, EMPTY where free; see `_key`
    slots: Longs  # [2^k] the number, 0 to C - 1, of the cell whose key stands at this place
    position: Floats  # [C, 3] a point of a surface in the cell
    normal: Floats  # [C, 3] the surface's unit normal there


@dataclasses.dataclass(frozen=True)
class _RayEnds:
    """Where R rays from each of N points end, M of them on a surface."""

    positions: Floats  # [M, 3]
    normals: Floats  # [M, 3] flat unit normals, towards the point
    triangles: NDArray[np.int32]  # [M]
    missed: NDArray[np.bool_]  # [N · R] rays that end on no surface; those of a point in a row


@dataclasses.dataclass(frozen=True)
class Irradiance:
    """Light on the surfaces of a world, without direct sunlight."""

    cells: Cells  # C fine ones
    light: Floats  # [C, 3] irradiance of the fine cells
    coarse: Cells  # D coarse ones
    coarse_light: Floats  # [D, 3] irradiance, with sunlight
    coarse_m: float  # width of coarse cells in metres
    eye: Floats  # [3] the photo's camera; fine cells are wider the farther they are from it
    angle: float  # width of a fine cell over its distance from the eye
    mean: Floats  # [3] the mean of `light`, which stands where no cell is known

    def at(self, positions: Floats, normals: Floats) -> Floats:
        """[N, 3] irradiance at points [N, 3] with unit normals [N, 3]."""
        result = np.zeros_like(positions)
        levels = cell_levels(positions, self.eye, self.angle)
        _interpolate(
            self.cells.table,
            self.cells.slots,
            self.cells.position,
            self.cells.normal,
            self.light,
            positions,
            normals,
            levels,
            np.float32(BASE_CELL_M),
            self.mean,
            result,
        )
        return result

    def roughly_at(self, positions: Floats, normals: Floats) -> Floats:
        """[N, 3] irradiance of coarse cells, with sunlight, for what is seen in reflections."""
        result = np.zeros_like(positions)
        levels = np.full(len(positions), COARSE_LEVEL, np.float32)
        _interpolate(
            self.coarse.table,
            self.coarse.slots,
            self.coarse.position,
            self.coarse.normal,
            self.coarse_light,
            positions,
            normals,
            levels,
            np.float32(self.coarse_m / 2.0**COARSE_LEVEL),
            self.mean,
            result,
        )
        return result


def cell_levels(positions: Floats, eye: Floats, angle: float) -> Floats:
    """[N] levels of cells at points [N, 3], with which cells look equally wide from the eye.

    They are no whole numbers. `eye` is [3]; `angle` is a cell's width over its distance from it.
    """
    distance = np.linalg.norm(positions - eye, axis=1)
    levels = np.log2(np.maximum(distance * angle / BASE_CELL_M, 1e-6))
    return np.asarray(np.clip(levels, 0, MAX_LEVEL - 1), np.float32)


def solve(
    world: World,
    lights: Lights,
    rng: np.random.Generator,
    positions: Floats,
    normals: Floats,
    eye: Floats,
    focal_px: float,
    coarse_m: float,
) -> Irradiance:
    """Light on all surfaces that some views see.

    What views see is divided into fine cells. The light on them comes directly from windows and
    lamps, and from the surfaces around, which are divided into coarse cells.

    Args:
        world, lights: the world.
        rng: for the directions of rays.
        positions, normals: [N, 3] points that the views see, and their unit normals.
        eye: [3] the photo's camera.
        focal_px: the photo's focal length.
        coarse_m: width of coarse cells in metres.
    """
    angle = CELL_PX / focal_px
    levels = cell_levels(positions, eye, angle)
    cells = _cells(positions, normals, levels, BASE_CELL_M, both_levels=True)

    # Coarse cells are needed where rays of fine cells end.
    ends = _gather(world, rng, cells.position, cells.normal, GATHER_RAYS)
    coarse_base_m = coarse_m / 2.0**COARSE_LEVEL  # the level then makes cells `coarse_m` wide
    coarse_levels = np.full(len(ends.positions), COARSE_LEVEL, np.float32)
    coarse = _cells(ends.positions, ends.normals, coarse_levels, coarse_base_m, both_levels=False)
    cell_of_end = _find(coarse, ends.positions, ends.normals, coarse_base_m)

    # Light on coarse cells.
    albedo = _coarse_albedo(world, coarse, cell_of_end, ends.triangles)
    coarse_direct = _direct(world, lights, rng, coarse.position, coarse.normal)
    coarse_direct += _sunlight(world, lights, rng, ends, cell_of_end, len(coarse.position))
    coarse_light = _bounced(world, lights, rng, coarse, coarse_base_m, albedo, coarse_direct)

    # Fine cells gather from coarse ones. Rays that end nowhere have the number EMPTY, which is −1:
    # the last row of `reflected`, where nothing shines.
    cell_of_ray = np.full(len(ends.missed), EMPTY, np.int64)
    cell_of_ray[~ends.missed] = cell_of_end
    reflected = np.concatenate([albedo * coarse_light, np.zeros((1, 3), np.float32)])
    gathered = _calm_mean(reflected[cell_of_ray.reshape(len(cells.position), GATHER_RAYS)])
    gathered = gathered + math.pi * lights.ambient
    gathered += _sky_light(lights, cells.normal, ends.missed, GATHER_RAYS)
    gathered = _smoothed(cells, gathered.astype(np.float32), GATHERED_ROUNDS)
    direct = _direct(world, lights, rng, cells.position, cells.normal)
    direct = _smoothed(cells, direct, DIRECT_ROUNDS)
    total = gathered + direct
    return Irradiance(
        cells=cells,
        light=total.astype(np.float32),
        coarse=coarse,
        coarse_light=coarse_light.astype(np.float32),
        coarse_m=coarse_m,
        eye=eye.astype(np.float32),
        angle=angle,
        mean=total.mean(0).astype(np.float32),
    )


def _bounced(
    world: World,
    lights: Lights,
    rng: np.random.Generator,
    coarse: Cells,
    base_m: float,
    albedo: Floats,
    direct: Floats,
) -> Floats:
    """[C, 3] irradiance of coarse cells, which light each other several times.

    Args:
        world, lights: the world.
        rng: for the directions of rays.
        coarse: the C cells.
        base_m: width in metres that cells of level 0 would have; those of COARSE_LEVEL, which all
            are, are 2^COARSE_LEVEL times as wide.
        albedo: [C, 3] share of light that they reflect.
        direct: [C, 3] irradiance from windows, lamps and the sun.
    """
    ends = _gather(world, rng, coarse.position, coarse.normal, COARSE_RAYS)
    has_missed = ends.missed.reshape(-1, COARSE_RAYS)
    cell_of_ray = np.full(len(ends.missed), EMPTY, np.int64)
    cell_of_ray[~ends.missed] = _find(coarse, ends.positions, ends.normals, base_m)
    table = cell_of_ray.reshape(-1, COARSE_RAYS)  # [C, R] the cell that each ray meets
    # Surfaces that no view's rays have met have no cell. They shine as the mean of all cells, whose
    # number is C: the last row of `reflected`.
    table = np.where(table >= 0, table, len(coarse.position))

    sky = _sky_light(lights, coarse.normal, ends.missed, COARSE_RAYS)
    light = direct + sky
    mean_reflected = _mean(albedo * light)
    for _ in range(BOUNCES):
        reflected = np.concatenate([albedo * light, mean_reflected[None]])
        gathered = reflected[table] * (~has_missed)[..., None]
        light = direct + sky + gathered.mean(1) + math.pi * lights.ambient
        mean_reflected = _mean(albedo * light)
    return light


def _calm_mean(light: Floats) -> Floats:
    """[N, 3] the mean over rays [N, R, 3], without single rays that outshine all others.

    A ray that happens to end in a patch of sunlight would make a bright spot of its cell.
    """
    brightness = light.sum(-1)
    limit = MAX_RAY_RATIO * brightness.mean(1, keepdims=True)
    scale = np.minimum(1, limit / np.maximum(brightness, 1e-9))
    return np.asarray((light * scale[..., None]).mean(1), np.float32)


def _mean(values: Floats) -> Floats:
    """[3] the mean of values [N, 3]; 0 if there are none."""
    return np.asarray(values.sum(0) / max(1, len(values)), np.float32)


def _cells(
    positions: Floats, normals: Floats, levels: Floats, base_m: float, *, both_levels: bool
) -> Cells:
    """The cells in which points lie; the point nearest a cell's middle stands for the cell.

    Args:
        positions, normals: [N, 3] the points, and their unit normals.
        levels: [N] the level of each point's cell; `base_m` is the width at level 0.
        base_m: metres.
        both_levels: whether each point gets a cell of the next level, too, because light is
            interpolated between the two.
    """
    # A power of two, at least 1.6 times as large as the number of points, so that two cells seldom
    # have the same place.
    room = 1 << max(10, int(len(positions) * 1.6).bit_length())
    table = np.full(room, EMPTY, np.int64)
    slots = np.zeros(room, np.int64)
    best = np.full(room, np.inf, np.float32)
    chosen = np.zeros(room, np.int64)
    count = _insert(
        table, slots, best, chosen, positions, normals, levels, np.float32(base_m), both_levels
    )
    return Cells(table, slots, positions[chosen[:count]], normals[chosen[:count]])


def _find(cells: Cells, positions: Floats, normals: Floats, base_m: float) -> Longs:
    """[N] the numbers of the coarse cells in which points lie; EMPTY for none.

    Args:
        cells: the coarse cells.
        positions, normals: [N, 3] the points, and their unit normals.
        base_m: width in metres of a coarse cell, divided by 2^COARSE_LEVEL.
    """
    result = np.zeros(len(positions), np.int64)
    _lookup(cells.table, cells.slots, positions, normals, np.float32(base_m), result)
    return result


def _gather(
    world: World, rng: np.random.Generator, positions: Floats, normals: Floats, rays: int
) -> _RayEnds:
    """Send `rays` rays from each point, more along the normal than sideways.

    `positions` and `normals` are [N, 3]. The result has the ends of the rays.
    """
    # Empty arrays come first, because there may be no points, or no surface around them.
    ends: list[Floats] = [np.zeros((0, 3), np.float32)]
    end_normals: list[Floats] = [np.zeros((0, 3), np.float32)]
    triangles: list[NDArray[np.int32]] = [np.zeros(0, np.int32)]
    missed: list[NDArray[np.bool_]] = [np.zeros(0, bool)]
    step = max(1, CHUNK // rays)  # points at once
    for first in range(0, len(positions), step):
        part = slice(first, first + step)
        directions = hemisphere(rng, normals[part], rays).reshape(-1, 3)
        origins = np.repeat(positions[part] + NUDGE_M * 4 * normals[part], rays, 0)
        hits = world.first_hits(origins, directions)
        met = hits.triangle >= 0
        _, flat = world.normals(hits, directions)
        ends.append((origins + hits.distance[:, None] * directions)[met])
        end_normals.append(flat[met])
        triangles.append(hits.triangle[met])
        missed.append(~met)
    return _RayEnds(
        positions=np.concatenate(ends).astype(np.float32),
        normals=np.concatenate(end_normals),
        triangles=np.concatenate(triangles),
        missed=np.concatenate(missed),
    )


def hemisphere(rng: np.random.Generator, normals: Floats, rays: int) -> Floats:
    """[N, rays, 3] unit vectors around unit normals [N, 3].

    Their density is proportional to the cosine of the angle to the normal, so the mean light of
    rays is the irradiance over π. The rays of one point are spread evenly, by a spiral that is
    turned at random.
    """
    # Points that are spread evenly in a disc, lifted to the hemisphere above it, have this density.
    number = (np.arange(rays) + rng.random((len(normals), 1))) / rays
    turn = rng.random((len(normals), 1)) * 2 * math.pi
    azimuth = turn + np.arange(rays) * 2.399963  # the golden angle
    radius = np.sqrt(number)
    x = radius * np.cos(azimuth)
    y = radius * np.sin(azimuth)
    z = np.sqrt(np.maximum(0, 1 - number))
    first, second = tangents(normals)
    return np.asarray(
        x[..., None] * first[:, None]
        + y[..., None] * second[:, None]
        + z[..., None] * normals[:, None],
        np.float32,
    )


def tangents(normals: Floats) -> tuple[Floats, Floats]:
    """Two unit vectors [N, 3] at right angles to unit normals [N, 3] and to each other."""
    # Duff et al., Building an orthonormal basis, revisited (2017).
    x, y, z = normals[:, 0], normals[:, 1], normals[:, 2]
    sign = np.where(z >= 0, 1.0, -1.0).astype(np.float32)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1 + sign * x * x * a, sign * b, -sign * x], -1)
    second = np.stack([b, sign + y * y * a, -y], -1)
    return first.astype(np.float32), second.astype(np.float32)


def _coarse_albedo(
    world: World, coarse: Cells, cell_of_end: Longs, triangles: NDArray[np.int32]
) -> Floats:
    """[C, 3] mean linear colour of the surfaces in coarse cells.

    Args:
        world: has the colours.
        coarse: the C cells.
        cell_of_end: [M] the cell in which each ray ends.
        triangles: [M] the triangle on which it ends.
    """
    material = world.mesh.material[triangles]
    number = np.maximum(world.texture[material], 0)
    textured = world.texture[material] >= 0
    means = np.where(textured[:, None], world.pyramids.mean[number], 1.0)
    colors = world.color[material] * means
    count = len(coarse.position)
    weights = np.bincount(cell_of_end, minlength=count)
    sums = [np.bincount(cell_of_end, colors[:, k], minlength=count) for k in range(3)]
    return (np.stack(sums, -1) / np.maximum(weights, 1)[:, None]).astype(np.float32)


def _direct(
    world: World, lights: Lights, rng: np.random.Generator, positions: Floats, normals: Floats
) -> Floats:
    """[N, 3] irradiance from windows and lamps."""
    total = np.zeros((len(positions), 3), np.float32)
    step = max(1, CHUNK // PORTAL_RAYS)
    for first in range(0, len(positions), step):
        part = slice(first, first + step)
        total[part] += _from_portals(world, lights, rng, positions[part], normals[part])
        for number in range(len(lights.lamp_positions)):
            total[part] += _from_lamp(world, lights, rng, positions[part], normals[part], number)
    return total


def _from_portals(
    world: World, lights: Lights, rng: np.random.Generator, positions: Floats, normals: Floats
) -> Floats:
    """[N, 3] irradiance from the sky through the windows, at points [N, 3] with unit normals.

    Each window is a grid of parts, with a ray to a random point of each part. The irradiance is the
    sum of radiance · cosine at the point · cosine at the window · area / distance².
    """
    count = len(lights.portals)
    total = np.zeros((len(positions), 3), np.float32)
    if not count:
        return total
    each = max(9, PORTAL_RAYS // count)  # rays to a window, at least 3 × 3
    grid = math.ceil(math.sqrt(each))
    for corner, side, other in lights.portals:
        # Only points on the window's inner side get light from it.
        area_normal = np.cross(side, other)
        area = float(np.linalg.norm(area_normal))
        area_normal = area_normal / area
        facing = (((positions - (corner + side / 2 + other / 2)) @ area_normal) > 0.0).nonzero()[0]
        if not len(facing):
            continue

        # For each of F points, a place in each part of the window: shares of its two sides.
        parts = grid * grid
        number = np.arange(parts)
        a = (number % grid + rng.random((len(facing), parts))) / grid
        b = (number // grid + rng.random((len(facing), parts))) / grid
        # [F, parts, 3] these places, and the ways to them.
        targets = corner + a[..., None] * side + b[..., None] * other
        ways = (targets - positions[facing, None]).astype(np.float32)
        distance = np.linalg.norm(ways, axis=-1)
        directions = ways / np.maximum(distance, 1e-6)[..., None]
        cosine = (directions * normals[facing, None]).sum(-1)
        other_cosine = -(directions @ area_normal.astype(np.float32))
        use = (cosine > 0) & (other_cosine > 0)

        # Which ways are open. Rays begin a little in front of the surface.
        origins = np.broadcast_to(
            (positions[facing] + NUDGE_M * 4 * normals[facing])[:, None], ways.shape
        )
        open_way = np.zeros(use.shape, bool)
        # A curtain outside of the window's plane blocks as well, so the ray goes on a little.
        open_way[use] = ~world.blocked(origins[use], directions[use], distance[use] + 0.3)
        # Nearer than 5 cm, the sum would be grainy.
        weight = cosine * other_cosine * area / np.maximum(distance, 0.05) ** 2 / parts
        weight = np.where(open_way, weight, 0.0)
        radiance = lights.sky_radiance(directions.reshape(-1, 3)).reshape(*use.shape, 3)
        total[facing] += (weight[..., None] * radiance).sum(1).astype(np.float32)
    return total


def _from_lamp(
    world: World,
    lights: Lights,
    rng: np.random.Generator,
    positions: Floats,
    normals: Floats,
    number: int,
) -> Floats:
    """[N, 3] irradiance from the lamp with this number, a ball.

    The lamp's own body does not shade it: rays end at one and a half times the ball's radius.
    """
    # [N, LAMP_RAYS, 3] random points of the ball's surface, and the ways to them.
    radius = float(lights.lamp_radii[number])
    jitter = rng.standard_normal((len(positions), LAMP_RAYS, 3))
    jitter *= radius / np.maximum(np.linalg.norm(jitter, axis=-1, keepdims=True), 1e-6)
    ways = lights.lamp_positions[number] + jitter - positions[:, None]
    distance = np.linalg.norm(ways, axis=-1)
    directions = (ways / np.maximum(distance, 1e-6)[..., None]).astype(np.float32)
    cosine = np.maximum((directions * normals[:, None]).sum(-1), 0)
    reach = distance - 1.5 * radius
    use = (cosine > 0) & (reach > 0)
    origins = np.broadcast_to((positions + NUDGE_M * 4 * normals)[:, None], ways.shape)
    open_way = use.copy()
    open_way[(cosine > 0) & (reach <= 0)] = True  # within the lamp's shade
    open_way[use] = ~world.blocked(
        origins[use].astype(np.float32), directions[use], reach[use].astype(np.float32)
    )
    # Light falls with the square of the distance, but not without end close to the lamp.
    falloff = np.where(open_way, cosine / np.maximum(distance, 2 * radius) ** 2, 0.0).mean(1)
    return np.asarray(falloff[:, None] * lights.lamp_colors[number], np.float32)


def _sunlight(
    world: World,
    lights: Lights,
    rng: np.random.Generator,
    ends: _RayEnds,
    cell_of_end: Longs,
    count: int,
) -> Floats:
    """[count, 3] mean irradiance from the sun on coarse cells, at a few points of each.

    Args:
        world, lights: the world.
        rng: chooses points, and directions within the sun's disc.
        ends: where the rays of fine cells end; some of these points are taken.
        cell_of_end: [M] the coarse cell in which each lies.
        count: number of coarse cells.
    """
    total = np.zeros((count, 3), np.float32)
    if not lights.sun_color.any() or not count:
        return total
    # Cells at which many rays end matter more, and get more samples.
    chosen = rng.integers(len(ends.positions), size=COARSE_SAMPLES * count)
    spread = rng.standard_normal((len(chosen), 3)) * lights.sun_spread / 2
    directions = lights.sun_direction + spread
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cosines = sun_on(
        world, directions.astype(np.float32), ends.positions[chosen], ends.normals[chosen]
    )
    cells = cell_of_end[chosen]
    sample_counts = np.bincount(cells, minlength=count)
    mean_cosines = np.bincount(cells, cosines, minlength=count) / np.maximum(sample_counts, 1)
    return np.asarray(mean_cosines[:, None] * lights.sun_color, np.float32)


def sun_on(world: World, directions: Floats, positions: Floats, normals: Floats) -> Floats:
    """[N] cosine towards the sun where it shines, 0 in shadow.

    Args:
        world: whose surfaces give shadow.
        directions: [3] or [N, 3] unit vectors towards the sun.
        positions, normals: [N, 3] points and their unit normals.
    """
    directions = np.ascontiguousarray(np.broadcast_to(directions, positions.shape))
    cosine = (directions * normals).sum(1)
    lit = np.zeros(len(positions), np.float32)
    facing = np.flatnonzero(cosine > 0)
    origins = positions[facing] + NUDGE_M * 4 * normals[facing]
    far = np.full(len(facing), 1e4, np.float32)
    blocked = world.blocked(origins, directions[facing], far)
    lit[facing[~blocked]] = cosine[facing[~blocked]]
    return lit


def _sky_light(lights: Lights, normals: Floats, missed: NDArray[np.bool_], rays: int) -> Floats:
    """[N, 3] irradiance of the open sky, from the share of rays that end nowhere.

    A room with windows gets its sky through them, by `_from_portals`, and here nothing.

    Args:
        lights: the sky and the windows.
        normals: [N, 3] of the points.
        missed: [N · rays] rays that end nowhere.
        rays: of each point.
    """
    if len(lights.portals):
        return np.zeros((len(normals), 3), np.float32)
    openness = missed.reshape(-1, rays).mean(1)  # [N] share of each point's rays
    upper_half = lights.sky[: lights.sky.shape[0] // 2].mean((0, 1))  # [3] its mean radiance
    # Walls see land as well, which is darker: they get 60 %.
    sky_share = 0.6 + 0.4 * np.maximum(normals[:, 2], 0)
    return np.asarray(math.pi * (openness * sky_share)[:, None] * upper_half, np.float32)


def _smoothed(cells: Cells, light: Floats, rounds: tuple[tuple[int, float], ...]) -> Floats:
    """[C, 3] the light of cells, averaged with neighbours of the same surface, against noise.

    Args:
        cells: the cells.
        light: [C, 3] irradiance.
        rounds: for each round the distance to the neighbours in cells, and the share by which
            their light may differ before they count less.
    """
    base = np.float32(BASE_CELL_M)
    for stride, tolerance in rounds:
        result = light.copy()
        _smooth(
            cells.table, cells.slots, cells.position, cells.normal, light, base, stride,
            np.float32(tolerance), result,
        )  # fmt: skip
        light = result
    return light


COORDINATE_BITS = 18  # of each of a cell's three coordinates in its key
OFFSET = 1 << (COORDINATE_BITS - 1)  # of cell coordinates, so that they are not negative
COORDINATE_MASK = (1 << COORDINATE_BITS) - 1
POSITIVE = 0x7FFFFFFFFFFFFFFF  # all bits of 64 but the sign
HASH_FACTOR = 0x1E3779B97F4A7C15  # odd, with irregular bits: near keys get far places


@kernel
def _key(level: int, x: int, y: int, z: int, side: int) -> int:
    """One number for a cell.

    Its bits are the level, three coordinates (18 bits each), and the side (the last 3 bits).

    Args:
        level: of the cell.
        x, y, z: its place, in widths of a cell.
        side: the direction that the surface's normal is nearest to, see `_side_of_normal`.
    """
    key = (level << COORDINATE_BITS) | (x + OFFSET)
    key = (key << COORDINATE_BITS) | (y + OFFSET)
    key = (key << COORDINATE_BITS) | (z + OFFSET)
    return (key * 8 + side) & POSITIVE


@kernel
def _side_of_normal(x: float, y: float, z: float) -> int:
    """Which of six directions a normal is nearest to: 0 to 5 stand for +x, −x, +y, −y, +z, −z."""
    a = abs(x)
    b = abs(y)
    c = abs(z)
    if a >= b and a >= c:
        return 0 if x >= 0 else 1
    if b >= c:
        return 2 if y >= 0 else 3
    return 4 if z >= 0 else 5


@kernel
def _place_of_key(table: Longs, key: int) -> int:
    """The place of a key in a hash table `table` [2^k], or the free place where it belongs."""
    mask = len(table) - 1
    mixed = key * HASH_FACTOR
    place = (mixed >> 20) & mask  # the upper bits are mixed best
    # Where another key stands already, the next place is taken.
    while table[place] != EMPTY and table[place] != key:
        place = (place + 1) & mask
    return place


@kernel
def _insert(
    table: Longs,
    slots: Longs,
    best: Floats,
    chosen: Longs,
    positions: Floats,
    normals: Floats,
    levels: Floats,
    base: float,
    both_levels: bool,
) -> int:
    """Fill a hash table with the cells in which points lie; returns the number C of cells.

    A cell is a cube of one level, with one of six directions of the surface in it (see `Cells`).
    Cells are numbered from 0 in the order in which points need them. The point that is nearest to a
    cell's middle stands for the cell.

    Args:
        table: [2^k] output: keys of cells; EMPTY (−1) at first.
        slots: [2^k] output: the number of the cell whose key stands at this place of `table`.
        best: [2^k] output, by cell number: the squared distance of the nearest point to the cell's
            middle, in widths of the cell; infinite at first.
        chosen: [2^k] output, by cell number: the index of that point.
        positions, normals: [N, 3] the points, and their unit normals.
        levels: [N] the level of the cell in which each point lies; fractions are cut off.
        base: width of a cell at level 0; each level doubles it.
        both_levels: whether each point also gets a cell of the next level.
    """
    count = 0
    for n in range(positions.shape[0]):
        low = int(levels[n])
        side = _side_of_normal(normals[n, 0], normals[n, 1], normals[n, 2])
        for step in range(2 if both_levels else 1):
            size = base * 2.0 ** (low + step)
            x = np.floor(positions[n, 0] / size)
            y = np.floor(positions[n, 1] / size)
            z = np.floor(positions[n, 2] / size)
            key = _key(low + step, int(x), int(y), int(z), side)
            place = _place_of_key(table, key)
            if table[place] == EMPTY:
                table[place] = key
                slots[place] = count
                count += 1

            # From the cell's middle to the point, in widths of the cell.
            cell = slots[place]
            dx = positions[n, 0] / size - x - 0.5
            dy = positions[n, 1] / size - y - 0.5
            dz = positions[n, 2] / size - z - 0.5
            squared_distance = dx * dx + dy * dy + dz * dz
            if squared_distance < best[cell]:
                best[cell] = squared_distance
                chosen[cell] = n
    return count


@kernel
def _lookup(
    table: Longs, slots: Longs, positions: Floats, normals: Floats, base: float, result: Longs
) -> None:
    """Write the numbers of coarse cells in which points lie; EMPTY (−1) for none.

    Args:
        table, slots: [2^k] the hash table of the cells, see `Cells`.
        positions, normals: [N, 3] the points, and their unit normals.
        base: width of a coarse cell, divided by 2^COARSE_LEVEL.
        result: [N] output.
    """
    size = base * 2.0**COARSE_LEVEL
    for n in range(positions.shape[0]):
        key = _key(
            COARSE_LEVEL,
            int(np.floor(positions[n, 0] / size)),
            int(np.floor(positions[n, 1] / size)),
            int(np.floor(positions[n, 2] / size)),
            _side_of_normal(normals[n, 0], normals[n, 1], normals[n, 2]),
        )
        place = _place_of_key(table, key)
        result[n] = slots[place] if table[place] == key else EMPTY


@kernel
def _interpolate(
    table: Longs,
    slots: Longs,
    cell_position: Floats,
    cell_normal: Floats,
    light: Floats,
    positions: Floats,
    normals: Floats,
    levels: Floats,
    base: float,
    fallback: Floats,
    result: Floats,
) -> None:
    """Write the light at points: a mean over the eight nearest cells of each of two levels.

    Coarse cells have only one level. Cells count less the farther they are, the farther their point
    is from the plane through the given point, and the more the normals differ.

    Args:
        table, slots: [2^k] the hash table of C cells, see `Cells`.
        cell_position, cell_normal: [C, 3] a point of a surface in each cell, and its unit normal.
        light: [C, 3] irradiance of the cells.
        positions, normals: [N, 3] the points, and their unit normals.
        levels: [N] no whole numbers: the nearer of two levels counts more.
        base: width of a cell at level 0.
        fallback: [3] the light where there is no cell.
        result: [N, 3] output.
    """
    for n in range(positions.shape[0]):
        low = int(levels[n])
        fraction = levels[n] - low
        # The point and its normal.
        px = positions[n, 0]
        py = positions[n, 1]
        pz = positions[n, 2]
        nx = normals[n, 0]
        ny = normals[n, 1]
        nz = normals[n, 2]
        red = 0.0
        green = 0.0
        blue = 0.0
        weights = 0.0
        steps = 1 if low == COARSE_LEVEL else 2
        for step in range(steps):
            level = low + step
            size = base * 2.0**level
            share = 1.0
            if steps == 2:
                share = fraction if step == 1 else 1.0 - fraction
            share += 1e-3  # so that a point whose cells are all of one level finds them
            # The middles of eight cells surround the point. (x0, y0, z0) is the place of the one
            # with the smallest coordinates; places are numbered in widths of a cell.
            gx = px / size - 0.5
            gy = py / size - 0.5
            gz = pz / size - 0.5
            x0 = np.floor(gx)
            y0 = np.floor(gy)
            z0 = np.floor(gz)
            for corner in range(8):
                i = corner & 1
                j = (corner >> 1) & 1
                k = corner >> 2
                wx = gx - x0 if i == 1 else 1.0 - gx + x0
                wy = gy - y0 if j == 1 else 1.0 - gy + y0
                wz = gz - z0 if k == 1 else 1.0 - gz + z0
                near = wx * wy * wz + 1e-3
                # A slanted surface may lie in cells of two or three directions.
                for axis in range(3):
                    along = nx if axis == 0 else (ny if axis == 1 else nz)
                    if abs(along) < 0.25:
                        continue
                    side = 2 * axis if along >= 0 else 2 * axis + 1
                    key = _key(level, int(x0) + i, int(y0) + j, int(z0) + k, side)
                    place = _place_of_key(table, key)
                    if table[place] != key:
                        continue
                    cell = slots[place]
                    agree = (
                        nx * cell_normal[cell, 0]
                        + ny * cell_normal[cell, 1]
                        + nz * cell_normal[cell, 2]
                    )
                    if agree <= 0.1:
                        continue
                    # From the point's plane to the cell's point, in widths of the cell.
                    plane = (
                        abs(
                            (px - cell_position[cell, 0]) * nx
                            + (py - cell_position[cell, 1]) * ny
                            + (pz - cell_position[cell, 2]) * nz
                        )
                        / size
                    )
                    weight = share * near * agree**4 / (1.0 + 30.0 * plane * plane)
                    red += weight * light[cell, 0]
                    green += weight * light[cell, 1]
                    blue += weight * light[cell, 2]
                    weights += weight
        if weights > 1e-9:
            result[n, 0] = red / weights
            result[n, 1] = green / weights
            result[n, 2] = blue / weights
        else:
            result[n, 0] = fallback[0]
            result[n, 1] = fallback[1]
            result[n, 2] = fallback[2]


@kernel
def _smooth(
    table: Longs,
    slots: Longs,
    cell_position: Floats,
    cell_normal: Floats,
    light: Floats,
    base: float,
    stride: int,
    tolerance: float,
    result: Floats,
) -> None:
    """Write the mean light of each cell and its 26 neighbours of the same level and direction.

    Neighbours count less if they lie out of the cell's plane, face another way, or differ in their
    light by more than `tolerance` (as a share); so edges and shadows stay.

    Args:
        table, slots: [2^k] the hash table of C cells, see `Cells`.
        cell_position, cell_normal: [C, 3] a point of a surface in each cell, and its unit normal.
        light: [C, 3] irradiance of the cells.
        base: width of a cell at level 0.
        stride: distance to the neighbours, in cells.
        tolerance: share by which their light may differ.
        result: [C, 3] output.
    """
    for place in range(table.shape[0]):
        key = table[place]
        if key == EMPTY:
            continue
        cell = slots[place]
        # Back from the key to the direction, the coordinates and the level; see `_key`.
        side = key & 7
        rest = key >> 3
        z = (rest & COORDINATE_MASK) - OFFSET
        y = ((rest >> COORDINATE_BITS) & COORDINATE_MASK) - OFFSET
        x = ((rest >> (2 * COORDINATE_BITS)) & COORDINATE_MASK) - OFFSET
        level = rest >> (3 * COORDINATE_BITS)
        size = base * 2.0**level
        red = 0.0
        green = 0.0
        blue = 0.0
        weights = 0.0
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    other = _place_of_key(
                        table, _key(level, x + stride * i, y + stride * j, z + stride * k, side)
                    )
                    if table[other] == EMPTY:
                        continue
                    near = slots[other]
                    agree = (
                        cell_normal[cell, 0] * cell_normal[near, 0]
                        + cell_normal[cell, 1] * cell_normal[near, 1]
                        + cell_normal[cell, 2] * cell_normal[near, 2]
                    )
                    if agree < 0.7:
                        continue
                    plane = abs(
                        (cell_position[near, 0] - cell_position[cell, 0]) * cell_normal[cell, 0]
                        + (cell_position[near, 1] - cell_position[cell, 1]) * cell_normal[cell, 1]
                        + (cell_position[near, 2] - cell_position[cell, 2]) * cell_normal[cell, 2]
                    ) / (size * stride)
                    # The difference of their light over the difference that is tolerated.
                    own_light = light[cell, 0] + light[cell, 1] + light[cell, 2]
                    near_light = light[near, 0] + light[near, 1] + light[near, 2]
                    ratio = abs(own_light - near_light) / (
                        tolerance * (own_light + near_light) / 2 + 1e-6
                    )
                    weight = agree**4 / (1.0 + 30.0 * plane * plane) / (1.0 + ratio**4)
                    red += weight * light[near, 0]
                    green += weight * light[near, 1]
                    blue += weight * light[near, 2]
                    weights += weight
        result[cell, 0] = red / weights
        result[cell, 1] = green / weights
        result[cell, 2] = blue / weights
