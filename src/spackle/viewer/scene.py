"""What the page needs to know of a scene."""

from __future__ import annotations

import dataclasses

import torch

from spackle.camera import Camera
from spackle.errors import InputError
from spackle.gaussians import Gaussians
from spackle.trajectory import TRAJECTORIES, DepthRange, TrajectoryKind, max_offset, trajectory
from spackle.viewer.layers import encode_layer

SAMPLES = 121  # of a path, between which the page goes straight
USUAL, FOREIGN = 0.3, 0.6  # disparities that a scene is good for if nobody says: a completed one, one of others
LEAST, MOST = 0.1, 1.0
BEYOND = 1.3  # how much farther than that the eye never goes


@dataclasses.dataclass(frozen=True)
class PageScene:
    """A scene as the page takes it."""

    description: dict[str, object]  # what becomes JSON
    files: dict[str, bytes]  # the layers, by the names that the description gives them


def page_scene(name: str, base: Gaussians, aux: Gaussians, camera: Camera, disparity: float | None = None) -> PageScene:
    """A scene for the page.

    The description's `paths` hold, for each trajectory, eye positions [SAMPLES, 3] in metres: the eye stands at
    still + disparity · moving, since what goes sideways grows with the disparity and what goes forward does not.

    Args:
        name: what the page calls it.
        base: what the photo shows.
        aux: what completion added; may be empty.
        camera: the photo's, at the world's origin.
        disparity: how far it was completed: up to there the eye follows the hand, and little farther.

    Raises:
        InputError: where no Gaussian stands in front of the camera.
    """
    if not bool((base.means[:, 2] > 0).any()):
        raise InputError(f"{name}: no Gaussian stands in front of the photo's camera: nothing can be shown")
    depths = DepthRange.of(base)
    free = min(max((USUAL if len(aux) else FOREIGN) if disparity is None else disparity, LEAST), MOST)
    files, layers = {}, []
    for layer, gaussians in {"base": base, "aux": aux}.items():
        encoded, file = encode_layer(gaussians), f"{layer}.splats"
        files[file] = encoded.data
        entry = {"name": layer, "file": file, "count": encoded.count}
        layers.append({**entry, "scaleLow": encoded.scale_low, "scaleStep": encoded.scale_step})
    description: dict[str, object] = {
        "name": name,
        "camera": {"K": camera.K.tolist(), "width": camera.width, "height": camera.height},
        "focus": depths.focus,
        "zNear": depths.near,
        "orbit": {"unit": max_offset(camera, 1.0, depths), "free": free, "limit": BEYOND * free},
        "paths": {kind: _path(kind, camera, depths) for kind in TRAJECTORIES},
        "layers": layers,
    }
    return PageScene(description, files)


def _path(kind: TrajectoryKind, camera: Camera, depths: DepthRange) -> dict[str, list[list[float]]]:
    """Eyes at disparity 0, and what a disparity of 1 adds to them."""
    still, wide = (_eyes(kind, camera, disparity, depths) for disparity in (0.0, 1.0))
    return {"still": _rounded(still), "moving": _rounded(wide - still)}


def _eyes(kind: TrajectoryKind, camera: Camera, disparity: float, depths: DepthRange) -> torch.Tensor:
    cameras = trajectory(kind, camera.to("cpu", torch.float64), disparity, depths, SAMPLES)
    return torch.stack([each.position for each in cameras])


def _rounded(eyes: torch.Tensor) -> list[list[float]]:
    """Nine digits are plenty, and keep the page small."""
    return [[float(f"{value:.9g}") + 0.0 for value in eye] for eye in eyes.tolist()]
