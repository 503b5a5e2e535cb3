"""Race tracks from the second set of models, seen by a person beside or on the road.

A place on a track's road is drawn at random and becomes the origin; what lies farther than 700 m is
left out. Cars stand or drive on the road. The game's pictures of the ground and of walls have few
pixels, so they are enlarged and get *grain*: noise in place of the fine detail that they lack.

Lengths are in metres, z is up. Tracks lie as in their file, so a road has any direction.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.runtime.errors import InputError
from worlds.library import Library
from worlds.lights import cloud_noise
from worlds.meshes import Material, Mesh, joined
from worlds.outdoors import daylight, held_camera
from worlds.pictures import load_picture
from worlds.plans import OUTDOORS, WorldPlan
from worlds.torcs import CAR, TRACK
from worlds.viewpoints import Viewpoint

Rng = np.random.Generator
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
REACH_M = 700.0  # triangles whose middle is farther away are left out
CARS_REACH_M = 120.0  # cars are put on this part of the road, and the road is measured by it
# Parts of the names of pictures by which they are told apart: those of roads, and those that are
# not of roads in spite of such a word; those that get no grain, because they are not of ground or
# walls.
ROAD_WORDS = ("asphalt", "road", "tarmac", "-rd", "concrete-p", "track", "asf", "rsa_n", "dirt")
NO_ROAD_WORDS = ("barrier", "wall", "curb", "shadow", "raceline", "grass", "side", "people")
NO_GRAIN_WORDS = ("tree", "arbor", "forest", "bush", "sky", "people", "spec", "logo", "sign")
FLAT_COSINE = 0.9  # a road rises by less than 26 degrees
FINE_PX = 1024  # longer side to which pictures are enlarged, by a whole factor


class RoadPoint(NamedTuple):
    """A point on the road."""

    place: NDArray[np.float64]  # [3]
    normal: NDArray[np.float64]  # [3] of the road there, unit, upwards


class TrianglePoint(NamedTuple):
    """A point of a triangle."""

    triangle: int  # its number
    weights: NDArray[np.float64]  # [3] of its corners; their mean with these weights is the point


def track(rng: Rng, library: Library) -> WorldPlan:
    """A random place at a race track, with cars, its light, and a source of cameras.

    Args:
        rng: for all random choices; each camera is drawn by a generator of its own.
        library: the second set of models, from `worlds.torcs`: tracks and cars.

    Raises:
        InputError: the drawn track has no road.
    """
    tracks = [model for model in library.models if model.entry.category == TRACK]
    cars = [model for model in library.models if model.entry.category == CAR]
    model = tracks[int(rng.integers(len(tracks)))]
    mesh = library.mesh(model)
    road_numbers = road_triangles(mesh, model.entry.name)
    if not len(road_numbers):
        raise InputError(f"{model.entry.key}: no picture is that of a road: leave this track out")

    # The middle of a random triangle of the road becomes the origin.
    whole_road = mesh.corners[road_numbers]
    middle = whole_road[int(rng.integers(len(whole_road)))].mean(0)
    ahead = _along_road(whole_road, middle)
    near = np.linalg.norm(mesh.corners.mean(1) - middle, axis=1) < REACH_M
    surroundings = Mesh(
        mesh.corners[near] - middle,
        mesh.normals[near],
        mesh.uv[near],
        mesh.material[near],
        mesh.materials,
    )
    surroundings, pictures = _with_grain(surroundings)
    parts = [surroundings]
    used = {model.entry.key}

    # Two to eight cars, on the part of the road around the origin. Three of four stand ahead, where
    # the cameras look; all drive that way. Where a drawn place is not on the road, there is none.
    to_left = np.array([-ahead[1], ahead[0]])
    road = whole_road - middle
    road = road[np.linalg.norm(road[:, :, :2].mean(1), axis=1) < CARS_REACH_M]
    half_width = _half_width(road, to_left)
    for _ in range(int(rng.integers(2, 9))):
        distance = rng.uniform(6, 35) * rng.choice([1, 1, 1, -1])
        left = rng.uniform(-0.7, 0.7) * half_width
        car = cars[int(rng.integers(len(cars)))] if cars else None
        point = _on_road(road, ahead * distance + to_left * left)
        if car is None or point is None:
            continue
        heading = _along_road(road, point.place)
        # `_along_road` gives one of two opposite directions.
        if heading @ ahead < 0:
            heading = -heading
        parts.append(_car_on_road(library.mesh(car), point, heading))
        used.add(car.entry.key)

    return WorldPlan(
        OUTDOORS,
        kind="track",
        mesh=joined(parts),
        pictures=pictures,
        lights=daylight(rng),
        draw_viewpoint=functools.partial(_draw_viewpoint, surroundings, ahead, half_width),
        models=tuple(sorted(used)),
        coarse_m=1.5,  # more than the 1 m of streets, because places are larger
    )


def _draw_viewpoint(
    surroundings: Mesh,
    ahead: NDArray[np.float64],
    half_width: float,
    rng: Rng,
    height_px: int,
    width_px: int,
) -> Viewpoint:
    """A random camera near the origin, beside the road, on it or in its middle.

    It looks along the road; if it is off the middle, often a little towards the other side.

    Args:
        surroundings: the track around the origin, which lies in the middle of the road.
        ahead: [2] unit vector in x and y along the road.
        half_width: of the road in metres.
        rng: for all random choices.
        height_px, width_px: of the picture.
    """
    # Metres to the left of the road's middle. In half of all cases the camera is beside the road;
    # else anywhere on the road or, as often, in its middle.
    left = rng.uniform(-1.0, 1.0) * half_width if rng.random() < 0.5 else 0.0
    is_beside_road = rng.random() < 0.5
    if is_beside_road:
        left = rng.choice([-1, 1]) * (half_width + rng.uniform(0.5, 4.0))
    to_left = np.array([-ahead[1], ahead[0]])
    point = to_left * left + ahead * rng.uniform(-4, 4)  # [2] x and y

    # Metres of the eyes above the ground: of one who stands or, in 20 %, stoops.
    above = rng.uniform(1.3, 1.75) if rng.random() < 0.8 else rng.uniform(0.6, 1.3)
    ground = _ground_height(surroundings, point)
    eye = (float(point[0]), float(point[1]), ground + float(above))

    azimuth = math.atan2(ahead[1], ahead[0]) + rng.normal(0, 0.35)  # radians
    if left and rng.random() < 0.6:
        # Towards the other side: who stands to the left turns to smaller azimuths.
        azimuth += math.copysign(rng.uniform(0.1, 0.8), -left)
    return held_camera(rng, eye, azimuth, height_px, width_px)


def road_triangles(mesh: Mesh, name: str) -> NDArray[np.int64]:
    """[R] the numbers of a track's triangles that are road, by their pictures' names and slope.

    Args:
        mesh: the track.
        name: the track's name, with which the names of its pictures in the library begin.
    """
    is_road = np.array([_is_road(one, name) for one in mesh.materials], bool)
    sides = mesh.corners[:, 1:].astype(np.float64) - mesh.corners[:, :1]
    normal = np.cross(sides[:, 0], sides[:, 1])
    # Normals may look up or down.
    flat = np.abs(normal[:, 2]) > FLAT_COSINE * np.linalg.norm(normal, axis=1)
    return np.flatnonzero(is_road[mesh.material] & flat)


def _is_road(material: Material, track_name: str) -> bool:
    """Whether a material's picture is that of a road, by the words in the picture's name.

    The name begins with the track's name, which may have such words, too, and is left out.
    """
    if material.texture is None:
        return False
    name = Path(material.texture).name.removeprefix(f"{track_name}-").lower()
    if any(word in name for word in NO_ROAD_WORDS):
        return False
    return any(word in name for word in ROAD_WORDS)


def _along_road(road: Floats, place: NDArray[np.floating]) -> NDArray[np.float64]:
    """[2] unit vector in x and y along the road at a place, in one of its two directions.

    It is the direction in which the corners of the road's triangles near the place spread most.

    Args:
        road: [R, 3, 3] corners of its triangles.
        place: [3] a point of the road.
    """
    points = road.reshape(-1, 3)[:, :2].astype(np.float64)
    distance = np.linalg.norm(points - place[:2], axis=1)
    # Those within 25 m. If these are fewer than eight, because triangles are long, the eight
    # nearest.
    ninth_distance = float(np.sort(distance)[min(8, len(distance) - 1)])
    nearby = points[distance < max(25.0, ninth_distance)]
    # A little is added on the diagonal, so that points at one place have a direction, too.
    spread = np.cov((nearby - nearby.mean(0)).T) + 1e-6 * np.eye(2)
    _, axes = np.linalg.eigh(spread)  # columns, the one with the largest spread last
    return np.asarray(axes[:, 1], np.float64)


def _half_width(road: Floats, across: NDArray[np.float64]) -> float:
    """Half of the road's width at the origin in metres, roughly; between 2.5 and 9.

    Args:
        road: [R, 3, 3] corners of its triangles; its middle is near the origin.
        across: [2] unit vector across it.
    """
    points = road.reshape(-1, 3)[:, :2]
    near = points[np.linalg.norm(points, axis=1) < 15]
    if not len(near):
        return 4.0  # a usual one
    # Not the largest distance, so that a few corners of a wider place do not count.
    return float(np.clip(np.quantile(np.abs(near @ across), 0.8), 2.5, 9.0))


def _on_road(road: Floats, point: NDArray[np.float64]) -> RoadPoint | None:
    """The point of the road above or below x and y; None where there is no road.

    Args:
        road: [R, 3, 3] corners of its triangles.
        point: [2] x and y.
    """
    found = _triangle_at(road, point)
    if found is None:
        return None
    corners = road[found.triangle].astype(np.float64)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal *= np.sign(normal[2]) / np.linalg.norm(normal)
    return RoadPoint(found.weights @ corners, normal)


def _triangle_at(corners: Floats, point: NDArray[np.float64]) -> TrianglePoint | None:
    """The first triangle that lies above or below x and y, and its point there; None if none does.

    Args:
        corners: [F, 3, 3] of the triangles.
        point: [2] x and y.
    """
    flat = corners[:, :, :2].astype(np.float64)
    first_side = flat[:, 1] - flat[:, 0]
    second_side = flat[:, 2] - flat[:, 0]
    to_point = point - flat[:, 0]
    # Barycentric coordinates: the point is the first corner + u · first side + v · second side.
    area = _cross2(first_side, second_side)
    area = np.where(np.abs(area) < 1e-9, np.inf, area)  # upright triangles have no area from above
    u = _cross2(to_point, second_side) / area
    v = _cross2(first_side, to_point) / area
    inside = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1) & np.isfinite(area))
    if not len(inside):
        return None
    number = int(inside[0])
    weights = np.array([1 - u[number] - v[number], u[number], v[number]])
    return TrianglePoint(number, weights)


def _cross2(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """[N] signed areas of the parallelograms of vectors a and b, each [N, 2]."""
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _ground_height(mesh: Mesh, point: NDArray[np.float64]) -> float:
    """Height of the ground at x and y in metres: the highest surface within 3 m of z = 0, or 0.

    Bridges and trees are higher than 3 m, as a rule.

    Args:
        mesh: a track's part whose road passes through the origin.
        point: [2] x and y, a few metres from the origin.
    """
    # The triangles whose box in x and y has the point in it.
    flat = mesh.corners[:, :, :2]
    may_lie_there = (flat.min(1) <= point).all(1) & (flat.max(1) >= point).all(1)
    heights = []
    for corners in mesh.corners[may_lie_there]:
        found = _triangle_at(corners[None], point)
        if found is None:
            continue
        height = float(found.weights @ corners[:, 2])
        if abs(height) < 3:
            heights.append(height)
    return max(heights, default=0.0)


def _car_on_road(car: Mesh, point: RoadPoint, heading: NDArray[np.float64]) -> Mesh:
    """A car, turned and moved so that it stands on the road.

    Args:
        car: stands on z = 0 at the origin and looks towards −y.
        point: where it stands, and the road's normal there.
        heading: [2] unit vector in x and y, where it drives.
    """
    # The heading, tilted into the road's plane.
    forward = np.array([*heading, 0.0])
    forward -= (forward @ point.normal) * point.normal
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, point.normal)
    # The columns are where the model's x, y and z go: its right is −x, its front −y.
    turn = np.stack([-right, -forward, point.normal], 1)
    return car.moved(turn, point.place.tolist())


class _MeshWithPictures(NamedTuple):
    """A mesh, and pictures that were made for it."""

    mesh: Mesh
    pictures: dict[str, Bytes]  # by name; materials have these names as their texture


def _with_grain(mesh: Mesh) -> _MeshWithPictures:
    """A track whose pictures of the ground and of walls are enlarged and have grain.

    All materials become matt and white, because what a track's files say of them fits no picture.
    """
    pictures: dict[str, Bytes] = {}
    skins = []
    used = set(np.unique(mesh.material).tolist())
    for number, material in enumerate(mesh.materials):
        # Files give grass and trees the shine of glass, so all become matt. Their colours would
        # darken the pictures once more: white leaves pictures as they are, and makes the few
        # surfaces without a picture white.
        material = dataclasses.replace(material, specular=0.0, color=(1.0, 1.0, 1.0))
        if number in used and material.texture is not None and _may_get_grain(material.texture):
            name = f"fine-{Path(material.texture).name}"
            pictures[name] = fine_picture(material.texture)
            material = dataclasses.replace(material, texture=name)
        skins.append(material)
    return _MeshWithPictures(mesh.with_materials(skins), pictures)


def _may_get_grain(texture: str) -> bool:
    """Whether a picture's file is of ground or walls: not of trees, people, sky or letters.

    It is not if a word of its name says so, or if it has alpha, as leaves and fences do.
    """
    name = Path(texture).name.lower()
    if any(word in name for word in NO_GRAIN_WORDS):
        return False
    channels: int = load_picture(texture).shape[2]
    return channels == 3


@functools.lru_cache(128)
def fine_picture(file: str) -> Bytes:
    """[H, W, 3] a file's picture, enlarged, with noise in place of the fine detail that it lacks.

    It is enlarged by the greatest whole number with which its longer side is at most FINE_PX. A
    picture that is larger than half of that stays as it is.

    `file` is the path of a picture without alpha.
    """
    small = load_picture(file)
    height, width = small.shape[:2]
    factor = max(1, FINE_PX // max(height, width))
    if factor == 1:
        return small
    size = (width * factor, height * factor)
    large = np.asarray(Image.fromarray(small).resize(size, Image.Resampling.BICUBIC), np.float32)
    # Any seed serves that is the same at each call, wherever the pictures are kept.
    rng = np.random.default_rng(len(Path(file).name))
    shape = (size[1], size[0])
    # Noise from pixel to pixel, and stronger noise with spots of 6 pixels and less.
    pixel_noise = rng.standard_normal(shape)
    spots = cloud_noise(rng, shape, spots_across=max(8, size[0] // 6), octaves=3)
    grain = 0.55 * pixel_noise + spots
    # Both together have a deviation of about 1.1: pixels get about 10 % brighter or darker.
    fine = large * (1 + 0.09 * grain.astype(np.float32))[..., None]
    return np.asarray(np.clip(fine, 0, 255), np.uint8)
