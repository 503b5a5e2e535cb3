"""Posed photos of one scene: choice of frames, second views, and cases."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from spackle.core.camera import Camera
from spackle.paper.evaluation.case import Case, Points, SecondView
from spackle.paper.evaluation.datasets.colmap import Model

MAX_NEAR = 3  # a photo has at most this number of near second views
BASELINES = (
    0.05,
    0.25,
)  # distance of the cameras over the photo's middle depth; Middlebury's pairs have 0.05 to 0.2
MAX_TURN = 30.0  # the greatest angle between the optical axes, in degrees
MIN_SHARED = 0.3  # the least fraction of the photo's points that a near view sees too
T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Posed:
    """A photo with its pose."""

    name: str
    photo: Path
    camera: Camera  # in the scene's world, float64
    depth: float  # middle depth of the photo's content; NaN if unknown
    ids: NDArray[Any] | None = None  # ids of the points that the photo sees
    points: Callable[[], Points] | None = None  # positions of these points in the photo
    bounds: tuple[float, float] | None = None  # nearest and farthest depth


def posed_by(scene: Path, model: Model, photos: Sequence[Path]) -> list[Posed]:
    """Join the views of a scene's model with their photo files, in the same order."""
    posed = []
    for view, photo in zip(model.views, photos, strict=True):
        z = model.points(view).z
        middle = float(z.median()) if len(z) else math.nan
        points = partial(model.points, view) if len(view.ids) else None
        posed.append(
            Posed(f"{scene.name}/{photo.stem}", photo, view.camera, middle, view.ids, points)
        )
    return posed


def make_cases(views: Sequence[Posed], wanted: Iterable[int] | None = None) -> list[Case]:
    """Make a case of each wanted photo; all others become second views in the case's frame, the nearest camera first.

    At most three second views count as near: the nearest views that qualify. A view qualifies if its camera is 5 % to
    25 % of the photo's middle depth away, is turned by at most 30°, and sees at least 30 % of the photo's points. If
    points are unknown, each camera must instead see the middle of the other's view. A photo may have no near view.

    Args:
        views: all photos of a scene.
        wanted: indices of the photos that become cases; None: all.
    """
    if not views:
        return []
    poses = torch.stack([view.camera.world_to_camera for view in views])
    eyes = torch.stack([view.camera.position for view in views]).numpy()
    axes = poses[:, 2, :3].numpy()
    cameras = [view.camera.to(dtype=torch.float32) for view in views]
    cases = []
    for index in range(len(views)) if wanted is None else wanted:
        view = views[index]
        apart = np.linalg.norm(eyes - eyes[index], axis=1)
        fits = (apart >= BASELINES[0] * view.depth) & (apart <= BASELINES[1] * view.depth)
        fits &= axes @ axes[index] >= math.cos(math.radians(MAX_TURN))
        order = sorted(
            set(range(len(views))) - {index}, key=lambda k: (float(apart[k]), views[k].name)
        )
        near = set(
            itertools.islice(
                (k for k in order if fits[k] and _sees_the_same(view, views[k])), MAX_NEAR
            )
        )
        moved = (poses @ torch.linalg.inv(poses[index])).float()
        placed = [
            dataclasses.replace(one, world_to_camera=pose)
            for one, pose in zip(cameras, moved, strict=True)
        ]
        seconds = tuple(
            SecondView(views[k].name, views[k].photo, placed[k], k in near) for k in order
        )
        camera = dataclasses.replace(cameras[index], world_to_camera=torch.eye(4))
        cases.append(Case(view.name, view.photo, camera, None, view.points, view.bounds, seconds))
    return cases


def _sees_the_same(view: Posed, other: Posed) -> bool:
    if view.ids is not None and other.ids is not None:
        return len(np.intersect1d(view.ids, other.ids, assume_unique=True)) >= MIN_SHARED * max(
            1, len(view.ids)
        )
    for one, two in (
        (view.camera, other),
        (other.camera, view),
    ):  # each camera must see the middle of the other image
        size = torch.tensor([two.camera.width, two.camera.height], dtype=torch.float64)
        uv, z = one.project(
            two.camera.unproject(size / 2, torch.tensor(two.depth, dtype=torch.float64))
        )
        if not bool(
            (z > 0) & (uv >= 0).all() & (uv <= torch.tensor([one.width, one.height])).all()
        ):
            return False
    return True


def spread(
    scenes: Sequence[str], frames: Callable[[str], Sequence[int]], count: int
) -> dict[str, Sequence[int]]:
    """Choose `count` frames, or all if there are fewer, spread evenly over the scenes and over the frames of a scene.

    Scenes take turns to give one frame each, until there are `count` frames; scenes without further frames are skipped.
    If there are more scenes than `count`, categories take turns to give one scene each (names are CATEGORY/SCENE).

    Args:
        scenes: names, in order; the scenes of a category are neighbours.
        frames: returns a scene's frames in order; called only for scenes that are used.

    Returns:
        The scenes that are used, in order, each with its frames in order.
    """
    categories = (
        list(names) for _, names in itertools.groupby(scenes, lambda name: name.partition("/")[0])
    )
    held = {scene: frames(scene) for scene in _in_turn(categories)[:count]}
    shares = collections.Counter(_in_turn([scene] * len(held[scene]) for scene in held)[:count])
    return {scene: spaced(held[scene], shares[scene]) for scene in scenes if scene in shares}


def spaced(items: Sequence[T], count: int) -> list[T]:
    """Choose `count` evenly spaced items: the middle item of each of `count` equal parts."""
    return [items[(2 * k + 1) * len(items) // (2 * count)] for k in range(count)]


def _in_turn(lists: Iterable[Sequence[str]]) -> list[str]:
    """The first items of all lists, then the second items, and so on."""
    return [item for items in itertools.zip_longest(*lists) for item in items if item is not None]
