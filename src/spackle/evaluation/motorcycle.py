"""Middlebury's Motorcycle inside scikit-image: a photo with measured depth, and the true photo beside it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.bases.depth_map import DepthMap
from spackle.camera import Camera
from spackle.errors import InputError

# Middlebury's calibration of the pair at a quarter of its size, as scikit-image ships it.
FOCAL_PX, CX, CY = 994.978, 311.193, 254.877
DOFFS_PX, BASELINE_M = 31.086, 0.193001


@dataclasses.dataclass(frozen=True)
class StereoPair:
    """A photo with its measured depth, and what a second camera truly saw."""

    left: Tensor  # [H, W, 3] sRGB
    right: Tensor  # [H, W, 3] sRGB
    depth: DepthMap
    left_camera: Camera
    right_camera: Camera


def load_motorcycle() -> StereoPair:
    """The Motorcycle pair inside scikit-image.

    Raises:
        InputError: where scikit-image is not installed.
    """
    try:
        from skimage.data import stereo_motorcycle
    except ImportError as error:
        raise InputError("the demo's photo is inside scikit-image: pip install 'spackle-nvs[demo]'") from error
    left, right, disparity = stereo_motorcycle()  # type: ignore[no-untyped-call]
    height, width = disparity.shape
    valid = np.isfinite(disparity)
    depth = np.where(valid, FOCAL_PX * BASELINE_M / (np.where(valid, disparity, 0) + DOFFS_PX), 0)
    K = torch.tensor([[FOCAL_PX, 0, CX], [0, FOCAL_PX, CY], [0, 0, 1]])
    beside = torch.eye(4)
    beside[0, 3] = -BASELINE_M
    right_K = K + torch.tensor([[0, 0, DOFFS_PX], [0, 0, 0], [0, 0, 0]])
    return StereoPair(
        left=torch.from_numpy(left.astype(np.float32) / 255),
        right=torch.from_numpy(right.astype(np.float32) / 255),
        depth=DepthMap(
            torch.from_numpy(depth.astype(np.float32)),
            torch.from_numpy(valid),
            K,
            None,
            "disparity",
            Path("Motorcycle"),
        ),
        left_camera=Camera(K, torch.eye(4), width, height),
        right_camera=Camera(right_K, beside, width, height),
    )
