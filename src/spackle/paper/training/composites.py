"""Photos with known depth, made from photos without: cut-outs of some photos in front of another.

Depth and outlines are exact, because they are chosen at random; only the combination is not real.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from spackle.core.camera import Camera
from spackle.core.focal_length import focal_mm_to_px
from spackle.core.photo import load_photo
from spackle.depth.depth_map import DepthMap
from spackle.paper.training.measured_photos import pick_random

COMPOSITE_SIZE_PX = (336, 448)  # height, width; swapped in half of the composites
FOCAL_MM_RANGE = (20.0, 50.0)  # 35 mm equivalent, from wide angle to a normal lens
BACKGROUND_DEPTH_M = (3.0, 8.0)  # range of the depth of the farthest plane
MIN_DEPTH_M = 0.7
# Range of the ratio of a cut-out's inverse depth to the largest inverse depth that it hides.
CUTOUT_NEARNESS = (1.15, 4.0)
CUTOUT_COUNT = (1, 4)  # least and greatest number of cut-outs of a composite
CUTOUT_AREA = (0.01, 0.35)  # least and greatest share of the image that a cut-out may cover

DrawPhoto = Callable[[np.random.Generator], Tensor]  # gives a random photo [H, W, 3] sRGB


def draw_composite(
    rng: np.random.Generator, photos: Sequence[Path]
) -> tuple[Tensor, DepthMap, Camera]:
    """Make a random composite of photos.

    Returns:
        The composite [H, W, 3] sRGB, its depth, and a camera with a random focal length. InputError
        if a photo cannot be read.
    """
    is_landscape = rng.random() < 0.5
    height, width = COMPOSITE_SIZE_PX if is_landscape else COMPOSITE_SIZE_PX[::-1]

    def draw_photo(rng: np.random.Generator) -> Tensor:
        """A random one of the photos, [h, w, 3] sRGB."""
        return load_photo(pick_random(rng, photos)).rgb

    rgb, inverse_depth = compose_cutouts(rng, draw_photo, height, width)
    focal_px = focal_mm_to_px(rng.uniform(*FOCAL_MM_RANGE), width, height)
    all_known = torch.ones_like(inverse_depth, dtype=torch.bool)
    depth = DepthMap(
        depth=1.0 / inverse_depth,
        valid=all_known,
        K=None,  # no intrinsics: the camera below has them
        quantum=None,  # depth in floating point has no quantisation step
        quantity="depth",
        path=Path("composite"),  # no file, but messages need a name
    )
    return rgb, depth, Camera.from_focal(focal_px, width, height)


def compose_cutouts(
    rng: np.random.Generator, draw_photo: DrawPhoto, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """Put cut-outs of random photos in front of another photo.

    Args:
        rng: source of all random choices.
        draw_photo: gives a random photo [h, w, 3] sRGB of any size.
        height: of the result, in pixels.
        width: of the result, in pixels.

    Returns:
        The image [H, W, 3] sRGB, and its inverse depth [H, W] in 1/m.
    """
    rgb = random_crop(rng, draw_photo(rng), height, width)
    inverse_depth = random_background(rng, height, width)
    min_count, max_count = CUTOUT_COUNT
    min_area, max_area = CUTOUT_AREA  # fractions of the image
    for _ in range(rng.integers(min_count, max_count + 1)):
        picture = random_crop(rng, draw_photo(rng), height, width)
        coverage = random_outline(rng, picture)  # [H, W] in 0..1
        inside = coverage > 0.5

        # A speck would be no surface, and a huge cut-out would leave nothing of the background.
        area = float(inside.float().mean())
        if not min_area < area < max_area:
            continue

        # The cut-out must lie in front of everything that it hides. Nearness is inverse depth, 1/m.
        hidden_nearness = float(inverse_depth[inside].max())
        nearness = hidden_nearness * rng.uniform(*CUTOUT_NEARNESS)
        if nearness > 1 / MIN_DEPTH_M:
            continue

        # Slightly tilted, because surfaces are seldom parallel to the picture.
        plane = nearness * (1 + random_ramp(rng, height, width, max_value=0.1))
        rgb = torch.lerp(rgb, picture, coverage[..., None])
        inverse_depth = torch.where(inside, plane, inverse_depth)
    return rgb, inverse_depth


def random_crop(rng: np.random.Generator, photo: Tensor, height: int, width: int) -> Tensor:
    """A random part [height, width, 3] of a photo [h, w, 3], mirrored in half of all cases.

    The photo is first resized, so that it is 1 to 1.5 times as large as it must be for the part.
    """
    photo_height, photo_width = photo.shape[:2]
    least_scale = max(height / photo_height, width / photo_width)
    scale = least_scale * rng.uniform(1.0, 1.5)
    # The maximum guards against rounding: the photo must not become smaller than the part.
    resized_height = max(height, math.ceil(photo_height * scale))
    resized_width = max(width, math.ceil(photo_width * scale))
    resized = interpolate(
        photo.permute(2, 0, 1)[None],
        size=(resized_height, resized_width),
        mode="bicubic",
        antialias=True,
    )[0].clamp(0, 1)  # [3, H, W]; bicubic weights overshoot

    top = int(rng.integers(0, resized_height - height + 1))
    left = int(rng.integers(0, resized_width - width + 1))
    part = resized[:, top : top + height, left : left + width].permute(1, 2, 0)
    if rng.random() < 0.5:
        part = part.flip(1)
    return part.contiguous()


def random_background(rng: np.random.Generator, height: int, width: int) -> Tensor:
    """Inverse depth [H, W] in 1/m of a wall, in some cases with the ground or a second wall."""
    wall_nearness = 1.0 / rng.uniform(*BACKGROUND_DEPTH_M)  # inverse depth of its middle, 1/m
    # The wall is turned, so that its sides differ by up to 30 % from its middle.
    plane = wall_nearness * (1 + random_ramp(rng, height, width, max_value=0.3))

    has_ground = rng.random() < 0.5
    if has_ground:
        # The inverse depth of the ground grows linearly below the horizon.
        rows = (torch.arange(height) + 0.5) / height  # 0 at the upper edge, 1 at the lower one
        # The lower the camera stands above the ground, the greater is the slope.
        slope = wall_nearness * rng.uniform(1.5, 4.0)
        horizon = rng.uniform(0.2, 0.6)  # from a little below the upper edge to the middle
        ground = slope * (rows - horizon)[:, None].clamp_min(0)  # [H, 1]
        plane = torch.maximum(plane, ground.expand(height, width))

    # A second wall may be turned much more. Where it is nearer, it hides the first one, so that the
    # two meet in a corner.
    has_second_wall = rng.random() < 0.3
    if has_second_wall:
        second_wall = wall_nearness * (1 + random_ramp(rng, height, width, max_value=1.0))
        plane = torch.maximum(plane, second_wall)
    # Parts of a turned wall would lie very far away. Nothing lies beyond twice the depth of the
    # first wall, that is, below half its inverse depth.
    return plane.clamp(0.5 * wall_nearness, 1 / MIN_DEPTH_M)


def random_ramp(rng: np.random.Generator, height: int, width: int, max_value: float) -> Tensor:
    """A linear ramp [H, W] of random direction and slope, within ±`max_value`, 0 in the middle."""
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij"
    )
    # Both slopes add up in a corner, so each gets half of the greatest value.
    x_slope = rng.uniform(-max_value, max_value) / 2
    y_slope = rng.uniform(-max_value, max_value) / 2
    return x_slope * x + y_slope * y


def random_outline(rng: np.random.Generator, picture: Tensor) -> Tensor:
    """A mask [H, W] in 0..1 of random shape, with an edge about one pixel wide.

    A field [H, W] that is positive inside gives the shape. It is the region of a colour, a blob or
    a bar, with an irregular outline.

    Args:
        rng: source of all random choices.
        picture: [H, W, 3] sRGB, which is cut out.
    """
    height, width = picture.shape[:2]
    # Noise makes the outline irregular, in waves of a tenth to a third of the width.
    cloud = smooth_noise(rng, height, width, rng.uniform(0.1, 0.35))
    # The shape's centre lies anywhere but near the upper edge: what stands in front stands below.
    center_y = rng.uniform(0.1, 1.0) * height
    center_x = rng.uniform(0.0, 1.0) * width
    # Pixel coordinates [H, W] relative to the centre.
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dy = y - center_y
    dx = x - center_x

    # The shape is in 35 % of cases the region of a colour, in 40 % a blob, in 25 % a bar.
    kind = rng.random()
    if kind < 0.35:
        field = color_region(rng, picture, int(center_y), int(center_x), dx, dy) + 0.1 * cloud
    elif kind < 0.75:
        # An ellipse; with much noise it gets arms and holes.
        radius_y = rng.uniform(0.08, 0.4) * height
        radius_x = rng.uniform(0.08, 0.4) * width
        blob = 1 - (dx / radius_x) ** 2 - (dy / radius_y) ** 2
        field = blob + rng.uniform(0.0, 0.8) * cloud
    else:
        field = random_bar(rng, width, dx, dy) + 0.2 * cloud

    # The mean over 3×3 pixels makes the edge soft.
    inside = (field > 0).float()[None, None]
    return avg_pool2d(inside, 3, stride=1, padding=1, count_include_pad=False)[0, 0]


def color_region(
    rng: np.random.Generator, picture: Tensor, row: int, column: int, dx: Tensor, dy: Tensor
) -> Tensor:
    """A field [H, W], positive where a picture has a colour similar to the colour at a pixel.

    field = 1 - (colour difference)² / tolerance - (distance from the pixel)² / radius²

    The outline thus follows real objects of the picture, and the region stays compact. Tolerance
    and radius are random.

    Args:
        rng: source of all random choices.
        picture: [H, W, 3] sRGB.
        row: of the pixel; beyond the last row, the last row counts.
        column: of the pixel; beyond the last column, the last column counts.
        dx: horizontal distance [H, W] of all pixels from this pixel.
        dy: vertical distance [H, W] of all pixels from this pixel.
    """
    height, width = picture.shape[:2]
    # Means over 9×9 pixels, because texture must not decide.
    smooth = avg_pool2d(
        picture.permute(2, 0, 1)[None], 9, stride=1, padding=4, count_include_pad=False
    )[0]  # [3, H, W]
    color = smooth[:, min(row, height - 1), min(column, width - 1)]
    squared_difference = ((smooth - color[:, None, None]) ** 2).sum(0)  # [H, W]
    tolerance = rng.uniform(0.01, 0.04)  # a difference of 0.06 to 0.12 in each channel
    unlikeness = squared_difference / tolerance
    radius = rng.uniform(0.15, 0.5) * width  # pixels
    remoteness = (dx**2 + dy**2) / radius**2
    return 1 - unlikeness - remoteness


def random_bar(rng: np.random.Generator, width: int, dx: Tensor, dy: Tensor) -> Tensor:
    """A field [H, W], positive inside a bar across the picture; most bars are nearly upright.

    Args:
        rng: source of all random choices.
        width: of the picture in pixels.
        dx: horizontal distance [H, W] of the pixels from a point on the bar's middle line.
        dy: vertical distance [H, W].
    """
    angle = rng.uniform(-0.4, 0.4)  # radians from upright
    is_level = rng.random() < 0.25
    if is_level:
        angle += math.pi / 2
    distance = (dx * math.cos(angle) + dy * math.sin(angle)).abs()  # from the middle line
    half_thickness = rng.uniform(0.008, 0.06) * width  # pixels: from a pole to a trunk
    return 1 - distance / half_thickness


def smooth_noise(rng: np.random.Generator, height: int, width: int, feature_size: float) -> Tensor:
    """Smooth noise [H, W] of about ±1, with features of `feature_size` times the width."""
    rows = max(2, round(height / (feature_size * width)))
    columns = max(2, round(1 / feature_size))
    coarse = torch.from_numpy(rng.standard_normal((1, 1, rows, columns)).astype(np.float32))
    return interpolate(coarse, size=(height, width), mode="bicubic", align_corners=True)[0, 0]
