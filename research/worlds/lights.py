"""What shines in a world: sun, sky, windows and lamps.

Brightness is in one unit throughout: a white sky has radiance 1, and lights a horizontal
white plane under the open sky with irradiance π.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from worlds.pictures import srgb_to_linear

Floats = NDArray[np.float32]
SKY_SHAPE = (512, 1024)  # rows from the zenith to the nadir, columns around the horizon


@dataclasses.dataclass(frozen=True)
class Lights:
    """All light sources of a world."""

    sky: Floats  # [h, w, 3] radiance around the horizon; row 0 is the zenith
    sun_direction: Floats  # [3] unit vector towards the sun
    sun_color: Floats  # [3] irradiance on a plane that faces the sun; 0: no sun
    sun_spread: float  # radius of the sun's disc, as a tangent
    portals: Floats  # [P, 3, 3] windows: a corner, one side and the other side; sky comes in there
    lamp_positions: Floats  # [L, 3]
    lamp_radii: Floats  # [L] metres
    lamp_colors: Floats  # [L, 3] irradiance at one metre
    ambient: float = 0.0  # radiance that comes from everywhere; stands for what is not built
    haze_m: float = math.inf  # distance after which haze has replaced 63 % of a surface's light
    haze_color: Floats = dataclasses.field(default_factory=lambda: np.zeros(3, np.float32))  # [3]

    def sky_radiance(self, directions: Floats) -> Floats:
        """[N, 3] the sky's radiance from unit directions [N, 3], by the nearest pixel."""
        rows, columns = sky_pixels(directions, self.sky.shape[:2])
        return self.sky[rows.astype(np.int64), columns.astype(np.int64)]

    def sky_smooth(self, directions: Floats) -> Floats:
        """[N, 3] the sky's radiance, bilinear between pixels, for what a camera sees."""
        height, width = self.sky.shape[:2]
        rows, columns = sky_pixels(directions, (height, width))
        y = np.clip(rows - 0.5, 0, height - 1)
        x = columns - 0.5
        y0 = np.floor(y).astype(np.int64)
        x0 = np.floor(x).astype(np.int64)
        y1 = np.minimum(y0 + 1, height - 1)
        fy = (y - y0)[:, None]
        fx = (x - x0)[:, None]
        left = x0 % width
        right = (x0 + 1) % width
        above = self.sky[y0, left] * (1 - fx) + self.sky[y0, right] * fx
        below = self.sky[y1, left] * (1 - fx) + self.sky[y1, right] * fx
        return np.asarray(above * (1 - fy) + below * fy, np.float32)


def sky_pixels(directions: Floats, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Row and column [N] of directions [N, 3] in a sky of [h, w] pixels, as fractions."""
    height, width = shape
    elevation = np.arcsin(np.clip(directions[:, 2], -1, 1))
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    rows = np.clip((0.5 - elevation / math.pi) * height, 0, height - 1e-3)
    columns = np.clip((azimuth / (2 * math.pi) + 0.5) * width, 0, width - 1e-3)
    return rows.astype(np.float32), columns.astype(np.float32)


def sky_directions(shape: tuple[int, int]) -> Floats:
    """[h, w, 3] the unit direction of each pixel of a sky."""
    height, width = shape
    y, x = np.mgrid[:height, :width] + 0.5
    elevation = (0.5 - y / height) * math.pi
    azimuth = (x / width - 0.5) * 2 * math.pi
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1).astype(
        np.float32
    )


def direction_to_sun(azimuth: float, elevation: float) -> Floats:
    """[3] the unit vector towards the sun, with z up.

    Azimuth is the angle from x towards y, elevation that above the horizon, both in radians.
    """
    return np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ],
        np.float32,
    )


def made_sky(
    rng: np.random.Generator, sun_direction: Floats, backdrop: NDArray[np.uint8] | None
) -> Floats:
    """[h, w, 3] a sky: a gradient with clouds, a glow around the sun, and land below the horizon.

    Args:
        rng: the source of all random choices.
        sun_direction: [3] unit vector towards the sun, or towards the brightest part of a grey sky.
        backdrop: [H, W, 3] an outdoor photo that stands at the horizon; None: hills and trees.
    """
    directions = sky_directions(SKY_SHAPE)
    up = directions[..., 2:]
    grey = rng.uniform(0, 1) ** 0.7  # 0: clear, 1: overcast

    # From blue at the zenith to pale at the horizon, with a wide and a narrow glow around the sun,
    # and clouds.
    zenith = np.array([0.25, 0.45, 0.85]) * rng.uniform(0.6, 1.1)
    horizon = np.array([0.85, 0.92, 1.0]) * rng.uniform(0.9, 1.3)
    overcast = np.array([0.9, 0.93, 1.0]) * rng.uniform(0.7, 1.2)
    clear = horizon + (zenith - horizon) * np.clip(up, 0, 1) ** 0.5
    sky = clear * (1 - grey) + overcast * grey * (0.6 + 0.4 * np.clip(up, 0, 1))
    glow = np.clip((directions * sun_direction).sum(-1, keepdims=True), 0, 1)
    sky = sky + (0.8 * glow**8 + 2.0 * glow**60) * (1 - 0.7 * grey) * np.array([1.0, 0.92, 0.8])
    clouds = cloud_noise(rng, SKY_SHAPE, spots_across=4)[..., None]
    cloudiness = np.clip((clouds - rng.uniform(-0.5, 1.0)) * 0.8, 0, 1) * np.clip(up * 4, 0, 1)
    sky = sky * (1 - cloudiness) + cloudiness * np.array([1.05, 1.05, 1.08])

    # Land: two rows of hills, and the ground.
    # The upper end of the hills in each column, as a sine of the elevation: 0.03 is 1.7 degrees.
    hilliness = 0.08 * rng.random()
    hills = np.abs(cloud_noise(rng, (1, SKY_SHAPE[1]), spots_across=24))[..., None]
    skyline = 0.03 + hilliness * hills
    ground_color = srgb_to_linear(rng.uniform([0.25, 0.3, 0.15], [0.5, 0.5, 0.4]))
    far_color = ground_color * 0.6 + 0.15
    texture = 1 + 0.35 * cloud_noise(rng, SKY_SHAPE, spots_across=40)[..., None]
    land = np.where(up < -0.02, ground_color * texture, far_color * texture)
    sky = np.where(up < skyline, land, sky)
    if backdrop is not None:
        sky = _with_backdrop(rng, sky, backdrop)
    return np.asarray(np.maximum(sky, 0.01), np.float32)


def _with_backdrop(
    rng: np.random.Generator, sky: NDArray[np.float64], photo: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """The sky with a photo around the horizon, repeated and mirrored."""
    height, width = sky.shape[:2]
    rows = int(height * rng.uniform(0.28, 0.4))  # 50 to 72 degrees high
    columns = width // 4
    y = (np.arange(rows) * photo.shape[0] / rows).astype(int)
    x = (np.arange(columns) * photo.shape[1] / columns).astype(int)
    small = srgb_to_linear(photo[y][:, x, :3] / 255) * rng.uniform(0.9, 1.6)
    # Four times around the horizon, every other time mirrored, so that there is no seam. The upper
    # and lower border of 12 rows fade.
    strip = np.concatenate([small, small[:, ::-1]] * 2, 1)
    top = height // 2 - int(rows * rng.uniform(0.45, 0.65))
    fade = np.clip(np.minimum(np.arange(rows), rows - 1 - np.arange(rows)) / 12, 0, 1)
    weight = fade[:, None, None]
    result = sky.copy()
    part = result[top : top + rows]
    result[top : top + rows] = part * (1 - weight) + strip * weight
    return result


def cloud_noise(
    rng: np.random.Generator, shape: tuple[int, int], spots_across: int, octaves: int = 5
) -> NDArray[np.float64]:
    """[h, w] smooth noise of mean 0 and deviation 1 with spots of several sizes.

    The noise repeats along both sides.

    Args:
        rng: the source of all random choices.
        shape: height and width of the result.
        spots_across: how many of the largest spots lie side by side across the width.
        octaves: how many sizes of spots there are; each is half as large as the one before.
    """
    height, width = shape
    total = np.zeros(shape)
    columns = spots_across
    strength = 1.0
    for _ in range(octaves):
        rows = min(height, max(1, columns * height // width))
        spots = rng.standard_normal((rows, min(width, columns)))
        total += strength * _stretched(spots, shape)
        # Smaller spots are weaker.
        strength *= 0.55
        columns *= 2
    return np.asarray((total - total.mean()) / max(float(total.std()), 1e-9))


def _stretched(values: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """[h, w] a small repeating grid of values, smoothly enlarged."""
    result = values
    for axis, size in enumerate(shape):
        count = result.shape[axis]
        place = np.arange(size) * count / size
        index = np.floor(place).astype(int)
        fraction = place - index
        fraction = fraction * fraction * (3 - 2 * fraction)  # smooth at both ends
        fraction = fraction.reshape([-1 if k == axis else 1 for k in range(2)])
        first = np.take(result, index % count, axis)
        second = np.take(result, (index + 1) % count, axis)
        result = first * (1 - fraction) + second * fraction
    return result
