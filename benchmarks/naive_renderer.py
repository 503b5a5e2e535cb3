"""A naive renderer, as the baseline for ours: tile by tile, Gaussian by Gaussian, pixel by
pixel.
"""

from __future__ import annotations

import math
from typing import Any

import numba
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.paper.evaluation.bench import EndStage
from spackle.render.covariance import projected_covariance
from spackle.render.drawing import GAUSSIANS_PER_CHUNK, TILES_PER_CHUNK
from spackle.render.project import KernelCamera
from spackle.render.protocol import (
    ALPHA_MAX,
    ALPHA_MIN,
    TILE_PX,
    TRANSMITTANCE_STOP,
    near_plane,
)
from spackle.runtime.device import parallel_for_chunks

Array = npt.NDArray[Any]
Arrays = tuple[Array, ...]  # means, quats, scales, opacities and colours of a scene


def naive_render(scene: Gaussians, camera: Camera, lap: EndStage = lambda name: None) -> Tensor:
    """[H, W, 3] sRGB of Gaussians without harmonics, with `eps2d` 0.

    Depth and alpha are computed too, as in ours. `lap` is called with the name of each step when it
    ends.
    """
    tensors = tuple(tensor.numpy() for tensor in scene.tensors)
    view = KernelCamera.of(camera, 0.0, near_plane([scene], camera))
    # Of each Gaussian: the centre's u and v, depth, and the inverse covariance; and its pixels'
    # left, right, top and bottom, which stay 0 if it is not drawn.
    splats = np.empty((len(scene), 6), np.float32)
    boxes = np.zeros((len(scene), 4), np.int32)
    parallel_for_chunks(
        lambda a, b: naive_project(a, b, tensors, view, splats, boxes),
        len(scene),
        GAUSSIANS_PER_CHUNK,
    )
    lap("project")
    order = np.argsort(splats[:, 2], kind="stable")
    lap("sort")
    starts, ids = naive_bin(order, boxes, *view.tiles)
    lap("bin")
    images = np.zeros((view.height, view.width, 5), np.float32)
    parallel_for_chunks(
        lambda a, b: naive_blend(a, b, tensors, splats, boxes, starts, ids, images),
        len(starts) - 1,
        TILES_PER_CHUNK,
    )
    lap("blend")
    return torch.from_numpy(images[..., :3])


@numba.njit(nogil=True, cache=True)
def naive_project(
    first: int, last: int, scene: Arrays, view: KernelCamera, splats: Array, boxes: Array
) -> None:
    """Write centre, depth and inverse covariance [N, 6], and pixel boxes [N, 4], of the Gaussians
    first..last.
    """
    means, quats, scales, opacities, _ = scene
    lens = view.lens  # fx, fy, cx, cy, ...
    pose = view.pose
    for i in range(first, last):
        # The centre in the camera's frame.
        x, y, z = (
            pose[:, 0] * means[i, 0]
            + pose[:, 1] * means[i, 1]
            + pose[:, 2] * means[i, 2]
            + pose[:, 3]
        )
        splats[i, 2] = z
        if z < view.near or opacities[i] < ALPHA_MIN:
            continue
        xx, xy, yy, det = projected_covariance(
            x / z, y / z, 1 / z, quats[i], scales[i], lens, pose, view.eps2d
        )
        if det <= 0:
            continue
        u = lens[0] * x / z + lens[2]
        v = lens[1] * y / z + lens[3]
        splats[i, 0] = u
        splats[i, 1] = v
        splats[i, 3] = yy / det
        splats[i, 4] = -xy / det
        splats[i, 5] = xx / det

        # The box in which alpha is at least ALPHA_MIN.
        reach = 2 * math.log(opacities[i] / ALPHA_MIN)  # squared Mahalanobis distance
        half_width = math.sqrt(reach * xx)
        half_height = math.sqrt(reach * yy)
        boxes[i, 0] = max(0, math.floor(u - half_width))
        boxes[i, 1] = min(view.width, math.floor(u + half_width) + 1)
        boxes[i, 2] = max(0, math.floor(v - half_height))
        boxes[i, 3] = min(view.height, math.floor(v + half_height) + 1)


@numba.njit(nogil=True, cache=True)
def naive_bin(order: Array, boxes: Array, rows: int, columns: int) -> tuple[Array, Array]:
    """Make the list of Gaussians of each tile, front to back."""
    starts = np.zeros(rows * columns + 1, np.int64)
    for i in order:
        for row in range(boxes[i, 2] // TILE_PX, (boxes[i, 3] + TILE_PX - 1) // TILE_PX):
            for column in range(boxes[i, 0] // TILE_PX, (boxes[i, 1] + TILE_PX - 1) // TILE_PX):
                starts[row * columns + column + 1] += 1
    starts = np.cumsum(starts)
    ends, ids = starts.copy(), np.empty(starts[-1], np.int32)
    for i in order:
        for row in range(boxes[i, 2] // TILE_PX, (boxes[i, 3] + TILE_PX - 1) // TILE_PX):
            for column in range(boxes[i, 0] // TILE_PX, (boxes[i, 1] + TILE_PX - 1) // TILE_PX):
                ids[ends[row * columns + column]] = i
                ends[row * columns + column] += 1
    return starts, ids


@numba.njit(nogil=True, fastmath=True, cache=True)
def naive_blend(
    first: int,
    last: int,
    scene: Arrays,
    splats: Array,
    boxes: Array,
    starts: Array,
    ids: Array,
    images: Array,
) -> None:
    """Blend the tiles first..last into [H, W, 5], which is zero before: sRGB, depth and alpha."""
    opacities, colors = scene[3], scene[4]
    height, width, _ = images.shape
    columns = (width + TILE_PX - 1) // TILE_PX
    for tile in range(first, last):
        top, left = tile // columns * TILE_PX, tile % columns * TILE_PX
        bottom, right = min(top + TILE_PX, height), min(left + TILE_PX, width)
        full = np.zeros((TILE_PX, TILE_PX), np.bool_)
        for k in range(starts[tile], starts[tile + 1]):
            i = ids[k]
            for py in range(max(top, boxes[i, 2]), min(bottom, boxes[i, 3])):
                for px in range(max(left, boxes[i, 0]), min(right, boxes[i, 1])):
                    if full[py - top, px - left]:
                        continue
                    dx, dy = (
                        np.float32(px + 0.5) - splats[i, 0],
                        np.float32(py + 0.5) - splats[i, 1],
                    )
                    square = splats[i, 3] * dx * dx + splats[i, 5] * dy * dy
                    power = np.float32(-0.5) * square - splats[i, 4] * dx * dy
                    alpha = min(np.float32(ALPHA_MAX), opacities[i] * np.exp(power))
                    if alpha < np.float32(ALPHA_MIN):
                        continue
                    pixel = images[py, px]
                    light = np.float32(1) - pixel[4]
                    if light * (np.float32(1) - alpha) <= np.float32(TRANSMITTANCE_STOP):
                        full[py - top, px - left] = True
                        continue
                    weight = alpha * light
                    pixel[0] += weight * colors[i, 0]
                    pixel[1] += weight * colors[i, 1]
                    pixel[2] += weight * colors[i, 2]
                    pixel[3] += weight * splats[i, 2]
                    pixel[4] += weight
        for py in range(top, bottom):
            for px in range(left, right):
                pixel = images[py, px]
                pixel[3] = pixel[3] / pixel[4] if pixel[4] > 0 else np.float32(0)
                for channel in range(3):
                    value = min(max(pixel[channel], np.float32(0)), np.float32(1))
                    power = np.float32(1.055) * value ** np.float32(1 / 2.4) - np.float32(0.055)
                    pixel[channel] = (
                        np.float32(12.92) * value if value <= np.float32(0.0031308) else power
                    )
