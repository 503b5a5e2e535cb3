"""Masks in picture files: white marks what is meant."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.image_files import read_image
from spackle.runtime.errors import InputError

LARGEST_16_BIT = 65_535
WHITE_SHARE = 0.5  # of full brightness: a pixel that is brighter is marked
# Sizes that were rounded in another way differ a little in shape.
SAME_SHAPE_TOLERANCE = 0.01


def read_mask(path: Path, camera: Camera, camera_name: str) -> Tensor:
    """[H, W] bool: the pixels of a camera that a mask's file marks.

    White is marked, black and transparent pixels are not. A mask of another size and the same shape
    is scaled.

    Args:
        path: a picture in grey, in colours with or without transparency, or in two colours.
        camera: whose view the mask belongs to.
        camera_name: what the user calls the camera, for messages.

    Raises:
        InputError: the file cannot be read, has another shape than the camera's view, or marks
            nothing or everything.
    """
    brightness = read_image(path, _brightness)
    height, width = brightness.shape
    shape_ratio = (width / height) / (camera.width / camera.height)
    if abs(shape_ratio - 1) > SAME_SHAPE_TOLERANCE:
        size = f"{camera.width}×{camera.height}"
        raise InputError(
            f"{path}: the mask has {width}×{height} pixels, and {camera_name} has {size}: "
            "give a mask of the same shape"
        )
    if (width, height) != (camera.width, camera.height):
        scaled = Image.fromarray(brightness).resize(
            (camera.width, camera.height), Image.Resampling.BILINEAR
        )
        brightness = np.asarray(scaled)
    mask = torch.from_numpy(brightness > WHITE_SHARE)
    if not bool(mask.any()):
        raise InputError(f"{path}: the mask marks nothing: paint what is to go in white")
    if bool(mask.all()):
        raise InputError(f"{path}: the mask marks everything: paint what is to stay in black")
    return mask


def _brightness(image: Image.Image) -> NDArray[np.float32]:
    """[H, W] brightness of an image's pixels, 0..1; 0 where they are transparent."""
    # Pillow would cut numbers of more than 8 bits off at 255.
    if image.mode.startswith("I") or image.mode == "F":
        numbers = np.asarray(image, np.float32)
        return numbers / np.float32(LARGEST_16_BIT)
    pixels = np.asarray(image.convert("RGBA"), np.float32) / np.float32(255)
    # People paint in any bright colour, such as red: the brightest channel decides.
    result: NDArray[np.float32] = pixels[..., :3].max(axis=-1) * pixels[..., 3]
    return result
