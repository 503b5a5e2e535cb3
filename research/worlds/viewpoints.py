"""Cameras as people hold them, and second cameras along the package's trajectories."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.core.focal_length import focal_mm_to_px
from spackle.core.trajectories import SHARP_TRAJECTORIES, DepthRange, trajectory_cameras
from worlds.caster import World
from worlds.placing import Place

Rng = np.random.Generator
Floats = NDArray[np.float32]
CANDIDATES = 14  # cameras from which the best is taken
PROBE = (18, 24)  # rays of a candidate
SECOND_VIEWS = 6
PATH_FRAMES = 24
DISPARITIES = (0.1, 0.6)  # of the second cameras; the paper's settings are 0.3 to 0.5
MIN_NEAR_M = 0.22  # nearer things fill the picture with blur


@dataclasses.dataclass(frozen=True)
class Viewpoint:
    """The photo's camera in a room: its place, and its axes as OpenCV has them."""

    eye: Floats  # [3]
    axes: Floats  # [3, 3] rows: right, down and forward in the room
    camera: Camera  # at the origin of its own coordinates

    def rays(self, view: Camera, pixels: Floats) -> tuple[Floats, Floats]:
        """Origins and directions [N, 3] in the room, of depth 1, through pixels [N, 2].

        Args:
            view: a camera in the photo's coordinates.
            pixels: x and y; pixel centres lie at half-integers.
        """
        inverse = np.linalg.inv(view.K.double().numpy())
        rotation = view.world_to_camera[:3, :3].double().numpy()
        shift = view.world_to_camera[:3, 3].double().numpy()
        homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], 1)
        directions = homogeneous @ inverse.T @ rotation @ self.axes
        center = self.eye + (-rotation.T @ shift) @ self.axes
        origins = np.broadcast_to(center, directions.shape)
        return (
            np.ascontiguousarray(origins, np.float32),
            np.ascontiguousarray(directions, np.float32),
        )


# Draws a random camera: called with a generator, and the picture's height and width in pixels.
DrawViewpoint = Callable[[Rng, int, int], Viewpoint]


def pixel_grid(height: int, width: int) -> Floats:
    """[H · W, 2] x and y of all pixel centres, row by row."""
    y, x = np.mgrid[:height, :width] + 0.5
    return np.stack([x.reshape(-1), y.reshape(-1)], -1).astype(np.float32)


def best_viewpoint(
    world: World, candidates: Sequence[Viewpoint], near_m: float
) -> Viewpoint | None:
    """The camera that shows the most surfaces at the most depths; None if all are blocked.

    Args:
        world: what they see.
        candidates: at least one.
        near_m: a camera is blocked by things that are nearer than this, in metres.
    """
    scores = [_score(world, candidate, near_m) for candidate in candidates]
    best = int(np.argmax(scores))
    return candidates[best] if scores[best] > 0 else None


def indoor_viewpoint(place: Place, rng: Rng, height: int, width: int) -> Viewpoint:
    """A camera at some height, held a little crooked, that looks at a thing or across the room.

    Args:
        place: the room.
        rng: draws all of it.
        height, width: of the picture in pixels.
    """
    # 24 to 70 mm; phones have 24 to 28 mm. The exponent makes short ones more frequent.
    focal_mm = 24 * (70 / 24) ** (rng.random() ** 1.6)
    camera = Camera.from_focal(focal_mm_to_px(focal_mm, width, height), width, height)
    # Standing, sitting, or close to the floor.
    eye_height = float(
        rng.choice(
            [rng.uniform(1.3, 1.7), rng.uniform(0.8, 1.3), rng.uniform(0.35, 0.8)],
            p=[0.6, 0.3, 0.1],
        )
    )
    edge = 0.25
    x = rng.uniform(edge, place.width - edge)
    y = rng.uniform(edge, place.depth - edge)
    if rng.random() < 0.6:  # from a wall or corner, as one does to get the room into the picture
        if rng.random() < 0.5:
            x = edge if rng.random() < 0.5 else place.width - edge
        else:
            y = edge if rng.random() < 0.5 else place.depth - edge
    eye = np.array([x, y, min(eye_height, place.height - 0.3)])

    target = np.array([place.width / 2, place.depth / 2, 0.8])
    if place.things and rng.random() < 0.75:
        box = place.things[int(rng.integers(len(place.things)))].box
        target = np.array([(box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2, (box.z0 + box.z1) / 2])
        # People look less far up or down than at the thing's own middle.
        target[2] = 0.5 * target[2] + 0.5 * (eye[2] - 0.25)
    target = target + rng.normal(0, 0.25, 3)
    forward = target - eye
    # Angles in radians; nobody looks steeply up or down.
    flat = max(float(np.hypot(forward[0], forward[1])), 0.3)
    pitch = np.clip(math.atan2(forward[2], flat), -0.6, 0.2)
    azimuth = math.atan2(forward[1], forward[0])
    roll = math.radians(rng.normal(0, 1.5))
    return Viewpoint(eye.astype(np.float32), camera_axes(azimuth, float(pitch), roll), camera)


def close_viewpoint(place: Place, rng: Rng, height: int, width: int) -> Viewpoint:
    """A camera close to a thing in a room, as one photographs a meal, a shelf or a toy.

    Args:
        place: the room, with its things.
        rng: draws all of it.
        height, width: of the picture in pixels.
    """
    focal_mm = rng.uniform(26, 75)  # as of a picture on 35 mm film
    camera = Camera.from_focal(focal_mm_to_px(focal_mm, width, height), width, height)
    # In most pictures a thing that stands on another one: tables and shelves hold many.
    raised = [thing for thing in place.things if thing.box.z0 > 0.3]
    chosen = raised if raised and rng.random() < 0.7 else place.things
    target = np.array([place.width / 2, place.depth / 2, 0.5])
    if chosen:
        box = chosen[int(rng.integers(len(chosen)))].box
        target = np.array([(box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2, (box.z0 + box.z1) / 2])

    # 0.5 to 1.8 m away to any side, a little above the thing, within the room.
    away = rng.uniform(0.5, 1.8)
    side = rng.uniform(0, 2 * math.pi)
    above = rng.uniform(-0.1, 0.7) * away
    edge = 0.1  # metres to a wall
    eye = np.array(
        [
            np.clip(target[0] + away * math.cos(side), edge, place.width - edge),
            np.clip(target[1] + away * math.sin(side), edge, place.depth - edge),
            np.clip(target[2] + above, 0.15, place.height - 0.3),
        ]
    )
    # The thing is not in the picture's middle.
    forward = target + rng.normal(0, 0.12 * away, 3) - eye
    flat = max(float(np.hypot(forward[0], forward[1])), 0.1)
    pitch = np.clip(math.atan2(forward[2], flat), -1.0, 0.3)
    azimuth = math.atan2(forward[1], forward[0])
    roll = math.radians(rng.normal(0, 3.0))
    return Viewpoint(eye.astype(np.float32), camera_axes(azimuth, float(pitch), roll), camera)


def camera_axes(azimuth: float, pitch: float, roll: float) -> Floats:
    """[3, 3] unit vectors of a camera in a world with z up: rows right, down and forward.

    Args:
        azimuth: of the direction in which it looks, from x towards y, in radians.
        pitch: how far it looks upwards, in radians.
        roll: how far it is turned clockwise around that direction, in radians.
    """
    forward = np.array(
        [math.cos(pitch) * math.cos(azimuth), math.cos(pitch) * math.sin(azimuth), math.sin(pitch)]
    )
    right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
    down = np.cross(forward, right)
    cosine = math.cos(roll)
    sine = math.sin(roll)
    rolled_right = cosine * right + sine * down
    rolled_down = cosine * down - sine * right
    return np.stack([rolled_right, rolled_down, forward]).astype(np.float32)


def _score(world: World, viewpoint: Viewpoint, near_m: float) -> float:
    """How much a camera shows, without a unit: more for many surfaces at many depths.

    It is −1 if the camera sees too little, or stands in a thing or before one that is nearer than
    `near_m` metres, and −0.5 if one thing fills much of its picture.
    """
    rows, columns = PROBE
    camera = viewpoint.camera.resized(columns, rows)
    origins, directions = viewpoint.rays(camera, pixel_grid(rows, columns))
    hits = world.first_hits(origins, directions)
    depth = hits.distance[hits.triangle >= 0]
    if len(depth) < 0.5 * rows * columns or np.quantile(depth, 0.01) < near_m:
        return -1.0
    # One thing fills the picture if 30 % of it are nearer than a limit: 0.7 m in rooms, where
    # `near_m` is MIN_NEAR_M, 0.4 m close to things, 2.4 m in the open.
    filled_m = 0.7 + 3 * (near_m - MIN_NEAR_M)
    if np.quantile(depth, 0.3) < filled_m:
        return -0.5

    # Four measures, weighted by eye so that each decides about as often as the others:
    # the entropy of the materials' shares of the picture, about 1 to 3; ...
    materials = world.mesh.material[hits.triangle[hits.triangle >= 0]]
    counts = np.bincount(materials)
    shares = counts[counts > 0] / len(materials)
    variety = float(-(shares * np.log(shares)).sum())
    # ... near and far things together, of which more than 0.7 (a factor of 2) is no better; ...
    spread = min(float(np.log(depth).std()), 0.7)
    # ... some distance, so that not one wall is seen from close by, of which 4 m are enough; ...
    distance_m = min(float(np.median(depth)), 4.0)
    # ... and not too much sky, as a share of the picture.
    sky = 1 - len(depth) / (rows * columns)
    return variety + 1.5 * spread + 0.3 * distance_m - 2 * sky


def second_cameras(
    rng: Rng, world: World, viewpoint: Viewpoint, depth: Floats
) -> tuple[list[Camera], list[str]]:
    """Six cameras along trajectories of the package, and what each is; none inside of a thing.

    Args:
        rng: chooses trajectories, disparities and frames.
        world: to look for obstacles.
        viewpoint: the photo's.
        depth: [N] known depths of the photo.
    """
    # The quantiles and the least focus that `spackle predict` uses.
    near, focus = np.quantile(depth, [0.001, 0.1])
    depth_range = DepthRange(near=float(near), focus=max(2.0, float(focus)))
    cameras: list[Camera] = []
    names: list[str] = []
    while len(cameras) < SECOND_VIEWS:
        kind = SHARP_TRAJECTORIES[int(rng.integers(len(SHARP_TRAJECTORIES)))]
        disparity = float(rng.uniform(*DISPARITIES))
        frame = int(rng.integers(PATH_FRAMES))
        if kind == "swipe" and rng.random() < 0.5:
            frame = 0 if rng.random() < 0.5 else PATH_FRAMES - 1  # its ends, as the paper has them
        # A path that runs into a thing is shortened.
        for _ in range(6):
            (camera,) = trajectory_cameras(
                kind, viewpoint.camera, disparity, depth_range, PATH_FRAMES, only=frame
            )
            if _is_free(world, viewpoint, camera):
                break
            disparity *= 0.6
        cameras.append(dataclasses.replace(camera, world_to_camera=camera.world_to_camera.float()))
        names.append(f"{kind} {disparity:.2f} {frame}/{PATH_FRAMES}")
    return cameras, names


def _is_free(world: World, viewpoint: Viewpoint, camera: Camera) -> bool:
    """Whether a second camera can be reached in a straight line, and has some room in front."""
    step = camera.position.double().numpy() @ viewpoint.axes
    length = float(np.linalg.norm(step))
    if length < 1e-6:
        return True
    origin = viewpoint.eye[None].astype(np.float32)
    direction = (step / length)[None].astype(np.float32)
    if world.blocked(origin, direction, np.array([length + 0.1], np.float32))[0]:
        return False
    # A few rays of the camera tell whether something stands close in front of it.
    small = camera.resized(12, 9)
    origins, directions = viewpoint.rays(small, pixel_grid(9, 12))
    hits = world.first_hits(origins, directions)
    return bool(np.quantile(hits.distance, 0.02) > 0.5 * MIN_NEAR_M)
