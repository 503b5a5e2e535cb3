"""Blend Gaussians that are given in the image, with axes along its rows and columns.

Such a Gaussian is the product of a fall-off along its row and one along its column. That makes
blending several times cheaper than for `blend`; the rules are the same.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from spackle.render.blend import ALPHA_MIN_F32, weight_and_transmittance
from spackle.runtime.device import parallel_for_chunks
from spackle.runtime.kernels import HALF, ZERO, Array, inlined_kernel, kernel

# An alpha of 1 falls to the least drawn alpha at this number of standard deviations.
MAX_DRAWN_DEVIATIONS = np.sqrt(-2 * np.log(ALPHA_MIN_F32))

ROWS_PER_CHUNK = 128  # rows of the image that a thread blends at a time

# Rows are blended in runs of as many pixels as a vector register has. The state of a run is four
# times so many floats, one after the other: transmittances, then red, green and blue light.
RUN_PIXELS = 16
# Where red, green and blue begin in a run's state, and the size of the state. They are unsigned, so
# that no check for negative indices is compiled.
RUN_RED, RUN_GREEN, RUN_BLUE, RUN_FLOATS = (np.uint64(k * RUN_PIXELS) for k in range(1, 5))


def blend_screen_gaussians(spots: Array, colors: Tensor, height: int, width: int) -> Tensor:
    """The picture [H, W, 3] in linear RGB of N Gaussians, over black.

    Args:
        spots: [N, 5] float32, nearest first: centre x and y and standard deviations along x and y,
            in pixels, and opacity, at most 0.999.
        colors: [N, 3] float32 linear RGB.
        height, width: of the picture.
    """
    image = np.empty((height, width, 3), np.float32)
    color_array = colors.numpy()
    parallel_for_chunks(
        lambda start, stop: blend_rows(start, stop, spots, color_array, image),
        height,
        chunk_length=ROWS_PER_CHUNK,
    )
    return torch.from_numpy(image)


@kernel
def blend_rows(start: int, stop: int, spots: Array, colors: Array, image: Array) -> None:
    """Blend Gaussians into the rows start..stop of a picture.

    A row is blended in runs of 16 pixels, as many as a vector register has.

    Args:
        start, stop: the rows to draw.
        spots: [N, 5] float32, nearest first: centre x and y, standard deviations x and y, opacity.
        colors: [N, 3] float32 linear RGB.
        image: [H, W, 3] float32, whose rows start..stop are written.
    """
    width = image.shape[1]
    runs = (width + RUN_PIXELS - 1) // RUN_PIXELS  # in a row
    # The state of a run is 64 numbers (RUN_FLOATS): 16 transmittances, which start at 1, then 16
    # numbers each for red, green and blue. The state of a row is that of its runs from left to
    # right, and the rows follow one another.
    state = np.zeros(((stop - start) * runs, 4, RUN_PIXELS), np.float32)
    state[:, 0] = 1
    flat_state = state.reshape(-1)
    row_falloff = np.zeros(runs * RUN_PIXELS, np.float32)

    for n in range(len(spots)):
        u, v, spread_x, spread_y, opacity = spots[n]
        # The pixels top..bottom and left..right (exclusive) in which alpha can be large enough to
        # be drawn. Pixel centres lie at half-integers.
        top = max(int(np.ceil(v - MAX_DRAWN_DEVIATIONS * spread_y - HALF)), start)
        bottom = min(int(np.floor(v + MAX_DRAWN_DEVIATIONS * spread_y - HALF)) + 1, stop)
        left = max(int(np.ceil(u - MAX_DRAWN_DEVIATIONS * spread_x - HALF)), 0)
        right = min(int(np.floor(u + MAX_DRAWN_DEVIATIONS * spread_x - HALF)) + 1, width)
        if top >= bottom or left >= right:
            continue

        # The fall-off along the row is the same in all rows. Runs first_run..end_run (exclusive)
        # are blended as a whole. Therefore the fall-off must be 0 in those of their pixels that lie
        # outside of left..right.
        first_run = left // RUN_PIXELS
        end_run = (right - 1) // RUN_PIXELS + 1
        row_falloff[first_run * RUN_PIXELS : end_run * RUN_PIXELS] = 0
        for x in range(left, right):
            deviations_x = (np.float32(x) + HALF - u) / spread_x
            row_falloff[x] = np.exp(-HALF * deviations_x * deviations_x)

        for y in range(top, bottom):
            deviations_y = (np.float32(y) + HALF - v) / spread_y
            row_alpha = opacity * np.exp(-HALF * deviations_y * deviations_y)
            for run in range(first_run, end_run):
                # Where the run's state begins. Unsigned indices need no check for negative ones.
                offset = np.uint64((y - start) * runs + run) * RUN_FLOATS
                run_left = np.uint64(run * RUN_PIXELS)
                blend_run(flat_state, offset, row_falloff, run_left, row_alpha, colors[n])

    for y in range(start, stop):
        for x in range(width):
            run_index = (y - start) * runs + x // RUN_PIXELS
            for channel in range(3):  # after the transmittance, which has the index 0
                image[y, x, channel] = state[run_index, 1 + channel, x % RUN_PIXELS]


@inlined_kernel
def blend_run(
    flat_state: Array,
    offset: np.uint64,
    row_falloff: Array,
    left: np.uint64,
    row_alpha: np.float32,
    color: Array,
) -> None:
    """Blend a Gaussian into a run of 16 pixels; without branches, in vector registers.

    Args:
        flat_state: the states of all runs, changed in place.
        offset: where the run's state begins: 16 transmittances, then red, green and blue.
        row_falloff: [W] the Gaussian's fall-off along the row, 0..1.
        left: the run's first pixel in the row.
        row_alpha: the Gaussian's alpha at the row's middle.
        color: [3] linear RGB.
    """
    red = color[0]
    green = color[1]
    blue = color[2]
    for lane in range(RUN_PIXELS):
        i = offset + np.uint64(lane)
        alpha = row_alpha * row_falloff[left + np.uint64(lane)]
        alpha = alpha if alpha >= ALPHA_MIN_F32 else ZERO
        weight, after = weight_and_transmittance(alpha, flat_state[i])
        flat_state[i] = after
        flat_state[i + RUN_RED] += weight * red
        flat_state[i + RUN_GREEN] += weight * green
        flat_state[i + RUN_BLUE] += weight * blue
