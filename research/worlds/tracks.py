"""Race tracks from the second set of models, seen by a person beside or on the road.

A place of a track is drawn, and what lies farther than the eye reaches is left out. Cars stand or
drive on the road. The game's pictures of the ground are coarse, so they get finer grain.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from spackle.runtime.errors import InputError
from worlds.library import Library
from worlds.lights import cloud_noise
from worlds.meshes import Material, Mesh, joined
from worlds.outdoors import daylight, held_camera
from worlds.pictures import load_picture
from worlds.plans import OpenPlan
from worlds.torcs import CAR, TRACK
from worlds.viewpoints import Viewpoint

Rng = np.random.Generator
Floats = NDArray[np.float32]
Bytes = NDArray[np.uint8]
REACH_M = 700.0  # triangles that begin farther away are left out
ROAD_WORDS = ("asphalt", "road", "tarmac", "-rd", "concrete-p", "track", "asf", "rsa_n", "dirt")
NO_ROAD_WORDS = ("barrier", "wall", "curb", "shadow", "raceline", "grass", "side", "people")
SMOOTH_WORDS = ("tree", "arbor", "forest", "bush", "sky", "people", "spec", "logo", "sign")
FLAT_COSINE = 0.9  # a road rises by less than 26 degrees
FINE_PX = 1024  # pictures of the ground are enlarged to this width


def track(rng: Rng, library: Library) -> OpenPlan:
    """A place at a race track, with its light.

    Raises:
        InputError: the drawn track has no road.
    """
    tracks = [model for model in library.models if model.entry.category == TRACK]
    cars = [model for model in library.models if model.entry.category == CAR]
    model = tracks[int(rng.integers(len(tracks)))]
    mesh = library.mesh(model)
    road = road_triangles(mesh, model.entry.name)
    if not len(road):
        raise InputError(f"{model.entry.key}: no picture is that of a road: leave this track out")

    # The middle of a random part of the road becomes the origin.
    corners = mesh.corners[road]
    middle = corners[int(rng.integers(len(corners)))].mean(0)
    direction = _direction(corners, middle)
    near = np.linalg.norm(mesh.corners.mean(1) - middle, axis=1) < REACH_M
    part = Mesh(
        mesh.corners[near] - middle,
        mesh.normals[near],
        mesh.uv[near],
        mesh.material[near],
        mesh.materials,
    )
    part, pictures = _refined(part)
    parts = [part]
    used = {model.entry.key}
    across = np.array([-direction[1], direction[0]])
    local = (corners - middle)[np.linalg.norm((corners - middle)[:, :, :2].mean(1), axis=1) < 120]
    width = _half_width(local, across)
    for _ in range(int(rng.integers(2, 9))):
        away = rng.uniform(6, 35) * rng.choice([1, 1, 1, -1])
        side = rng.uniform(-0.7, 0.7) * width
        car = cars[int(rng.integers(len(cars)))] if cars else None
        place = _on_road(local, direction * away + across * side)
        if car is None or place is None:
            continue
        heading = _direction(local, place[0])
        if heading @ direction < 0:
            heading = -heading
        parts.append(_standing(library.mesh(car), *place, heading))
        used.add(car.entry.key)

    def draw(own: Rng, height: int, width_px: int) -> Viewpoint:
        """A camera on the road or at its side, which looks along it or at the other side."""
        offset = own.uniform(-1.0, 1.0) * width if own.random() < 0.5 else 0.0
        if own.random() < 0.5:
            offset = own.choice([-1, 1]) * (width + own.uniform(0.5, 4.0))
        point = across * offset + direction * own.uniform(-4, 4)
        ground = _ground_height(part, point)
        tall = own.uniform(1.3, 1.75) if own.random() < 0.8 else own.uniform(0.6, 1.3)
        eye = (float(point[0]), float(point[1]), ground + float(tall))
        azimuth = math.atan2(direction[1], direction[0]) + own.normal(0, 0.35)
        if offset and own.random() < 0.6:
            azimuth += math.copysign(own.uniform(0.1, 0.8), -offset)
        return held_camera(own, eye, azimuth, height, width_px)

    return OpenPlan(
        kind="track",
        mesh=joined(parts),
        pictures=pictures,
        lights=daylight(rng),
        draw_viewpoint=draw,
        models=tuple(sorted(used)),
        coarse_m=1.5,
    )


def road_triangles(mesh: Mesh, name: str) -> NDArray[np.int64]:
    """The indices of triangles that are road, by the names of their pictures and their slope.

    `name` is the track's; pictures in the library begin with it.
    """
    is_road = np.array([_is_road(one, name) for one in mesh.materials], bool)
    sides = mesh.corners[:, 1:].astype(np.float64) - mesh.corners[:, :1]
    normal = np.cross(sides[:, 0], sides[:, 1])
    flat = np.abs(normal[:, 2]) > FLAT_COSINE * np.linalg.norm(normal, axis=1)
    return np.flatnonzero(is_road[mesh.material] & flat)


def _is_road(material: Material, track_name: str) -> bool:
    """Whether a material's picture is that of a road, by its name without the track's."""
    if material.texture is None:
        return False
    name = Path(material.texture).name.removeprefix(f"{track_name}-").lower()
    if any(word in name for word in NO_ROAD_WORDS):
        return False
    return any(word in name for word in ROAD_WORDS)


def _direction(corners: Floats, place: NDArray[np.floating]) -> NDArray[np.float64]:
    """[2] unit vector along the road at a place [3], from its triangles [R, 3, 3] around it."""
    points = corners.reshape(-1, 3)[:, :2].astype(np.float64)
    away = np.linalg.norm(points - place[:2], axis=1)
    nearby = points[away < max(25.0, float(np.sort(away)[min(8, len(away) - 1)]))]
    spread = np.cov((nearby - nearby.mean(0)).T) + 1e-6 * np.eye(2)
    _, axes = np.linalg.eigh(spread)
    return np.asarray(axes[:, 1], np.float64)


def _half_width(corners: Floats, across: NDArray[np.float64]) -> float:
    """Half of the road's width at the origin, from its triangles [R, 3, 3]."""
    points = corners.reshape(-1, 3)[:, :2]
    near = points[np.linalg.norm(points, axis=1) < 15]
    if not len(near):
        return 4.0
    return float(np.clip(np.quantile(np.abs(near @ across), 0.8), 2.5, 9.0))


def _on_road(
    corners: Floats, point: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The place [3] on the road at x and y, and the road's upward normal [3]; None beside it."""
    triangle, weights = _under(corners, point)
    if triangle is None:
        return None
    points = corners[triangle].astype(np.float64)
    normal = np.cross(points[1] - points[0], points[2] - points[0])
    normal *= np.sign(normal[2]) / np.linalg.norm(normal)
    return weights @ points, normal


def _under(corners: Floats, point: NDArray[np.float64]) -> tuple[int | None, NDArray[np.float64]]:
    """The highest triangle of [F, 3, 3] below or above x and y, and the weights of its corners."""
    flat = corners[:, :, :2].astype(np.float64)
    a = flat[:, 1] - flat[:, 0]
    b = flat[:, 2] - flat[:, 0]
    p = point - flat[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = np.where(np.abs(area) < 1e-9, np.inf, area)
    u = (p[:, 0] * b[:, 1] - p[:, 1] * b[:, 0]) / area
    v = (a[:, 0] * p[:, 1] - a[:, 1] * p[:, 0]) / area
    inside = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1) & np.isfinite(area))
    if not len(inside):
        return None, np.zeros(3)
    best = int(inside[0])
    return best, np.array([1 - u[best] - v[best], u[best], v[best]])


def _ground_height(mesh: Mesh, point: NDArray[np.float64]) -> float:
    """Height of the ground at x and y: the highest nearly level triangle within 3 m of z = 0."""
    boxes = mesh.corners[:, :, :2]
    over = (boxes.min(1) <= point).all(1) & (boxes.max(1) >= point).all(1)
    candidates = mesh.corners[over]
    heights = [0.0]
    for corners in candidates:
        triangle, weights = _under(corners[None], point)
        if triangle is None:
            continue
        height = float(weights @ corners[:, 2])
        if abs(height) < 3:
            heights.append(height)
    return max(heights[1:], default=0.0)


def _standing(
    mesh: Mesh,
    place: NDArray[np.float64],
    normal: NDArray[np.float64],
    heading: NDArray[np.float64],
) -> Mesh:
    """A car on the road.

    Args:
        mesh: looks towards −y.
        place: [3] where it stands.
        normal: [3] of the road there, upwards.
        heading: [2] where it drives.
    """
    forward = np.array([*heading, 0.0])
    forward -= (forward @ normal) * normal
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, normal)
    # The columns are where the model's x, y and z go: its right is −x, its front −y.
    turn = np.stack([-right, -forward, normal], 1)
    return mesh.moved(turn, place.tolist())


def _refined(mesh: Mesh) -> tuple[Mesh, dict[str, Bytes]]:
    """The mesh with finer pictures of the ground and of walls, and these pictures by name."""
    pictures: dict[str, Bytes] = {}
    skins = []
    used = set(np.unique(mesh.material).tolist())
    for number, material in enumerate(mesh.materials):
        # Files give grass and trees the shine of glass.
        material = dataclasses.replace(material, specular=0.0, color=(1.0, 1.0, 1.0))
        if number in used and material.texture is not None and _wants_grain(material.texture):
            name = f"fine-{Path(material.texture).name}"
            pictures[name] = fine_picture(material.texture)
            material = dataclasses.replace(material, texture=name)
        skins.append(material)
    return mesh.with_materials(skins), pictures


def _wants_grain(texture: str) -> bool:
    """Whether a picture is of ground or walls: not of trees, people or letters."""
    name = Path(texture).name.lower()
    return not any(word in name for word in SMOOTH_WORDS) and load_picture(texture).shape[2] == 3


@functools.lru_cache(128)
def fine_picture(file: str) -> Bytes:
    """[H, W, 3] a picture enlarged to FINE_PX, with grain that it would have if it were sharp."""
    small = load_picture(file)
    height, width = small.shape[:2]
    factor = max(1, FINE_PX // max(height, width))
    if factor == 1:
        return small
    size = (width * factor, height * factor)
    large = np.asarray(Image.fromarray(small).resize(size, Image.Resampling.BICUBIC), np.float32)
    rng = np.random.default_rng(len(file))
    shape = (size[1], size[0])
    grain = 0.55 * rng.standard_normal(shape) + cloud_noise(rng, shape, max(8, size[0] // 6), 3)
    fine = large * (1 + 0.09 * grain.astype(np.float32))[..., None]
    return np.asarray(np.clip(fine, 0, 255), np.uint8)
