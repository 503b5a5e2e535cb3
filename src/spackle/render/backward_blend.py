"""The backward pass of blending: from gradients of an image to sums over pixels by Gaussian.

Each tile is drawn again in chunks of Gaussians. The Gaussians of a chunk are then visited back to
front, while the light of all Gaussians behind the current one is known.
"""

from __future__ import annotations

import math

import numpy as np

from spackle.render.blend import (
    ALPHA_MAX_F32,
    GAUSSIANS_PER_CHECK,
    PLANE_FLOATS,
    TRANSMITTANCE_STOP_F32,
    alpha_from_log2,
    is_full,
    touched_pixels,
)
from spackle.render.covariance import Numbers
from spackle.render.fast_math import srgb_slope
from spackle.render.project import Arrays, in_tile
from spackle.render.protocol import ALPHA_MIN, TILE_PX
from spackle.render.tile_lists import TileLists
from spackle.runtime.kernels import ONE, ZERO, Array, kernel, reordering_kernel

# Number of sums over a tile's pixels for one Gaussian. With the offset (dx, dy) from the centre,
# u = dx - slope·dy and v = ∂L/∂ln(alpha), they are the sums of v, v·u, v·u², v·dy, v·dy², v·u·dy,
# then the gradients of red, green, blue and depth.
SUMS = 10

# The images of a tile are planes of one flat buffer, with pixels in row order: the transmittance,
# the contribution of all Gaussians behind the current one to the loss, and the gradients of red,
# green, blue, depth and alpha.
BEHIND_PLANE = 1 * PLANE_FLOATS
GRADIENT_PLANES = 2 * PLANE_FLOATS
ALL_PLANES_FLOATS = 7 * PLANE_FLOATS

# While Gaussians are drawn again, a note is taken for each row of pixels: 16 alphas, then 16
# transmittances. The notes of a chunk fit into the second-level cache.
CHUNK_GAUSSIANS = 128
NOTE_FLOATS = 2 * TILE_PX
NOTES_FLOATS = CHUNK_GAUSSIANS * TILE_PX * NOTE_FLOATS

# A row whose log2 of alpha stays below this shows nothing of the Gaussian; 1e-3 is for rounding.
INVISIBLE_LOG2_ALPHA = np.float32(math.log2(ALPHA_MIN) - 1e-3)


@kernel
def backward_tiles(
    first: int, last: int, tiles: Array, lists: TileLists, entry_needs: Array, records: Array,
    images: Arrays, gradients: Arrays, rows_before: Array, sums: Array,
) -> None:  # fmt: skip
    """Sum gradients over the pixels of each tile, for each Gaussian in the tile's list.

    Args:
        first, last: the tiles `tiles[first]` to `tiles[last - 1]` are done.
        tiles: [K] numbers of tiles, row by row.
        lists: the E Gaussians of all tiles ("entries"), sorted front to back.
        entry_needs: [E] bool: the entries whose sums are wanted.
        records: [N, 12] float32: centre, ellipse, opacity, depth and colour of each Gaussian.
        images: the forward pass's rgb, depth, alpha and linear colour.
        gradients: of rgb [H, W, 3], depth [H, W] and alpha [H, W].
        rows_before: [T + 1] int64: where each tile's rows start in `sums`.
        sums: [M, 10] float32, zero at first: one row for each entry with `entry_needs`.
    """
    # Buffers for one tile, which are overwritten for the next one. First seven images of the tile,
    # 256 floats each: transmittance, contribution of what lies behind, and five gradients.
    planes = np.empty(ALL_PLANES_FLOATS, np.float32)
    # Then the alphas and transmittances of a chunk of Gaussians, and the place in `notes` where
    # those of each Gaussian start.
    notes = np.empty(NOTES_FLOATS, np.float32)
    note_starts = np.empty(CHUNK_GAUSSIANS, np.uint64)
    buffers = (planes, notes, note_starts)
    _, depth, _, _ = images
    columns = (depth.shape[1] + TILE_PX - 1) // TILE_PX  # of tiles
    for k in range(first, last):
        tile = tiles[k]
        left = (tile % columns) * TILE_PX
        top = (tile // columns) * TILE_PX

        # First the gradients of the tile's pixels are written to `planes`. From them, the second
        # step computes the sums of the tile's Gaussians.
        load_gradients(planes, left, top, images, gradients)
        entries = slice(lists.starts[tile], lists.starts[tile + 1])
        tile_sums = sums[rows_before[tile] : rows_before[tile + 1]]
        backward_tile(
            buffers, records, lists.ids[entries], entry_needs[entries], left, top, tile_sums
        )


@kernel
def load_gradients(planes: Array, left: int, top: int, images: Arrays, gradients: Arrays) -> None:
    """Turn gradients of a tile's images into gradients of its blended sums, the last five planes.

    Blending sums weighted linear colours, depths and alphas; the images have sRGB, and depth
    divided by alpha. Pixels outside of the image get zeros.

    Args:
        planes: seven images of the tile, 256 floats each, one after the other. The last five are
            written: the gradients of red, green, blue, depth and alpha.
        left, top: the tile's first pixel in the image.
        images: rgb [H, W, 3], depth [H, W], alpha [H, W], linear colour [H, W, 3].
        gradients: of rgb, depth and alpha.
    """
    rgb, depth, alpha, linear = images
    rgb_grad, depth_grad, alpha_grad = gradients
    for i in range(GRADIENT_PLANES, GRADIENT_PLANES + 5 * PLANE_FLOATS):
        planes[i] = ZERO

    for row in range(min(TILE_PX, depth.shape[0] - top)):
        for column in range(min(TILE_PX, depth.shape[1] - left)):
            i = GRADIENT_PLANES + row * TILE_PX + column
            y = top + row
            x = left + column
            # The five planes are the gradients of red, green, blue, depth (3) and alpha (4).
            for channel in range(3):
                slope = srgb_slope(linear[y, x, channel], rgb[y, x, channel])
                planes[i + channel * PLANE_FLOATS] = rgb_grad[y, x, channel] * slope
            planes[i + 4 * PLANE_FLOATS] = alpha_grad[y, x]
            # depth = sum / alpha, so that alpha changes it, too.
            if alpha[y, x] > ZERO:
                depth_sum_grad = depth_grad[y, x] / alpha[y, x]
                planes[i + 3 * PLANE_FLOATS] = depth_sum_grad
                planes[i + 4 * PLANE_FLOATS] -= depth_sum_grad * depth[y, x]


@kernel
def backward_tile(
    buffers: Arrays,
    records: Array,
    ids: Array,
    entry_needs: Array,
    left: int,
    top: int,
    sums: Array,
) -> None:
    """Sum gradients over the pixels of one tile, for the Gaussians in its list that need them.

    The forward pass keeps no alphas. So the tile is drawn again in chunks of 128 Gaussians, with
    notes of all alphas, and the Gaussians of each chunk are then visited back to front.

    Args:
        buffers: (planes, notes, note_starts). `planes` are seven images of the tile, 256 floats
            each: transmittance, contribution of what lies behind, and the gradients of red, green,
            blue, depth and alpha. These five are an input; everything else is overwritten here.
            `notes` is space for alphas and transmittances of one chunk, and `note_starts` [128] for
            the place in it where each Gaussian's notes start.
        records: [N, 12] float32: centre, ellipse, opacity, depth and colour of each Gaussian.
        ids: [n] indices of the tile's Gaussians, front to back.
        entry_needs: [n] bool: those whose sums are wanted.
        left, top: the tile's first pixel in the image.
        sums: [m, 10] float32, zero at first: one row for each Gaussian whose sums are wanted.
    """
    planes, notes, note_starts = buffers
    chunks = (len(ids) + CHUNK_GAUSSIANS - 1) // CHUNK_GAUSSIANS

    # Front to back: draw all chunks but the last one, to know the transmittance in front of each.
    # At first it is 1. The notes of this round are overwritten, as there is space for one chunk.
    chunk_transmittance = np.empty((chunks, PLANE_FLOATS), np.float32)
    planes[:PLANE_FLOATS] = ONE
    planes[BEHIND_PLANE : BEHIND_PLANE + PLANE_FLOATS] = ZERO  # nothing is behind the last one
    for chunk in range(chunks):
        chunk_transmittance[chunk] = planes[:PLANE_FLOATS]
        if chunk < chunks - 1:
            part = ids[chunk * CHUNK_GAUSSIANS : (chunk + 1) * CHUNK_GAUSSIANS]
            redraw_chunk(planes, notes, records, part, left, top, note_starts)

    # Back to front: draw each chunk once more, which writes its `notes`, and then visit its
    # Gaussians from the last to the first, which reads them. `row` counts down to the row of `sums`
    # for each Gaussian that needs sums.
    row = len(sums)
    for chunk in range(chunks - 1, -1, -1):
        planes[:PLANE_FLOATS] = chunk_transmittance[chunk]
        part = ids[chunk * CHUNK_GAUSSIANS : (chunk + 1) * CHUNK_GAUSSIANS]
        drawn = redraw_chunk(planes, notes, records, part, left, top, note_starts)
        for k in range(len(part) - 1, -1, -1):
            if row == 0:  # no Gaussian further in front needs sums
                return
            need = entry_needs[chunk * CHUNK_GAUSSIANS + k]
            if need:
                row -= 1
            # Gaussians behind the last drawn one are hidden: their sums stay 0.
            if k < drawn:
                # Without need, no sums are written, and any row will do.
                own_sums = sums[row if need else 0]
                record = records[part[k]]
                step_back(planes, notes, note_starts[k], record, left, top, need, own_sums)


@kernel
def redraw_chunk(
    planes: Array, notes: Array, records: Array, ids: Array, left: int, top: int, note_starts: Array
) -> int:
    """Draw up to 128 Gaussians of a tile again, noting alpha and transmittance of each pixel.

    The backward pass needs both in reverse order. A row of pixels in which a Gaussian is too faint
    to be drawn gets no note.

    Args:
        planes: the tile's flat buffer, whose first 256 floats, the transmittances in front of the
            chunk, become those behind it.
        notes: written here: for each row of each Gaussian 16 alphas, then 16 transmittances.
        records: [N, 12] float32: centre, ellipse, opacity, depth and colour of each Gaussian.
        ids: [n] indices of the Gaussians to draw, front to back.
        left, top: the tile's first pixel in the image.
        note_starts: [128]: where each Gaussian's notes start in `notes`, written here.

    Returns:
        The number of Gaussians that were drawn until the tile was full.
    """
    note_start = np.uint64(0)
    for k in range(len(ids)):
        note_starts[k] = note_start
        x, y, slope, across, fall, peak, _, half_height, _, _, _, _ = in_tile(
            records[ids[k]], left, top
        )
        # At the offset (dx, dy) from the centre, log2 of alpha is
        # peak - fall·dy² - across·(dx - slope·dy)². In a row it is a parabola around x + slope·dy.
        first, last = touched_pixels(y, half_height)
        for row in range(first, last):
            dy = np.float32(row) - y
            row_peak = peak - fall * dy * dy
            if row_peak < INVISIBLE_LOG2_ALPHA:
                continue
            parabola = (across, x + slope * dy)  # its rate and its centre
            redraw_row(planes, np.uint64(row * TILE_PX), notes, note_start, row_peak, parabola)
            note_start += np.uint64(NOTE_FLOATS)
        if k % GAUSSIANS_PER_CHECK == GAUSSIANS_PER_CHECK - 1 and is_full(planes):
            return k + 1
    return len(ids)


@kernel
def redraw_row(
    planes: Array,
    offset: np.uint64,
    notes: Array,
    note_start: np.uint64,
    peak: np.float32,
    parabola: Numbers,
) -> None:
    """Draw a row of 16 pixels of a Gaussian again, and note alphas and transmittances.

    The forward pass keeps neither; the backward pass needs them in reverse order.

    Args:
        planes: the tile's flat buffer, whose first 256 floats are the transmittances; those of the
            row are changed.
        offset: where the row starts in a plane of 256 floats.
        notes: at `note_start`, 16 alphas (0 where nothing is drawn) and 16 transmittances are
            written.
        note_start: where the row's note starts.
        peak: largest log2 of alpha in the row.
        parabola: (rate, centre): log2 of alpha at pixel x is peak - rate·(x - centre)².
    """
    rate, center = parabola
    for x in range(TILE_PX):
        pixel = offset + np.uint64(x)  # its place in each plane
        note = note_start + np.uint64(x)  # the place of its alpha; its transmittance is 16 behind
        distance = np.float32(x) - center
        alpha = alpha_from_log2(peak - rate * distance * distance)
        transmittance = planes[pixel]
        after = transmittance * (ONE - alpha)
        full = after <= TRANSMITTANCE_STOP_F32
        planes[pixel] = ZERO if full else after
        notes[note] = ZERO if full else alpha
        notes[note + np.uint64(TILE_PX)] = transmittance


@kernel
def step_back(
    planes: Array,
    notes: Array,
    note_start: np.uint64,
    record: Array,
    left: int,
    top: int,
    need: bool,
    sums: Array,
) -> None:
    """Step back over a Gaussian: add it to what lies behind, and sum its gradients if needed.

    A tile's Gaussians are visited back to front. After its visit, a Gaussian counts as a part of
    what lies behind those that are visited later.

    Args:
        planes: seven images of the tile, 256 floats each: transmittance, contribution of what lies
            behind (changed here), gradients of red, green, blue, depth and alpha.
        notes: alphas and transmittances: 16 of each for each row in which a Gaussian is drawn.
        note_start: where this Gaussian's notes start in `notes`.
        record: [12] the Gaussian's centre, ellipse, opacity, depth and colour.
        left, top: the tile's first pixel in the image.
        need: whether the sums are wanted.
        sums: [10]: the Gaussian's sums, to which those of this tile are added if `need`. With
            dx and dy the offset from the centre, u = dx - slope·dy, and v = ∂L/∂ln(alpha): of v,
            v·u, v·u², v·dy, v·dy², v·u·dy; then the gradients of red, green, blue and depth.
    """
    # At the offset (dx, dy) from the centre, log2 of alpha is peak - fall·dy² - across·u².
    x, y, slope, _, fall, peak, _, half_height, depth, red, green, blue = in_tile(record, left, top)
    color_and_depth = (red, green, blue, depth)
    first, last = touched_pixels(y, half_height)
    for row in range(first, last):
        dy = np.float32(row) - y
        # Where a row is too faint to be drawn, `redraw_chunk` has taken no note.
        if peak - fall * dy * dy < INVISIBLE_LOG2_ALPHA:
            continue
        offset = np.uint64(row * TILE_PX)
        if need:
            v, vu, vuu, red_grad, green_grad, blue_grad, depth_grad = step_back_and_sum_row(
                planes, offset, notes, note_start, x + slope * dy, color_and_depth
            )
            sums[0] += v
            sums[1] += vu
            sums[2] += vuu
            sums[3] += v * dy
            sums[4] += v * dy * dy
            sums[5] += vu * dy
            sums[6] += red_grad
            sums[7] += green_grad
            sums[8] += blue_grad
            sums[9] += depth_grad
        else:
            step_back_row(planes, offset, notes, note_start, color_and_depth)
        note_start += np.uint64(NOTE_FLOATS)


@kernel
def step_back_row(
    planes: Array, offset: np.uint64, notes: Array, note_start: np.uint64, color_and_depth: Numbers
) -> None:
    """Add a row of a Gaussian, whose own gradient nobody needs, to what lies behind.

    A tile's Gaussians are visited back to front. After its visit, a Gaussian counts as a part of
    what lies behind those that are visited later. So in each of the row's 16 pixels, its own
    contribution to the loss is added to that of all that lies behind: its weight (alpha ·
    transmittance) times the sum of red, green, blue, depth and 1 (for alpha), each multiplied by
    its gradient.

    Args:
        planes: seven images of the tile, 256 floats each, one after the other: transmittance,
            contribution of what lies behind (changed here), gradients of red, green, blue, depth
            and alpha.
        offset: where the row starts in each plane.
        notes: from `note_start` on, 16 alphas and then 16 transmittances of the row.
        note_start: where the row's note starts.
        color_and_depth: the Gaussian's red, green, blue and depth.
    """
    red, green, blue, depth = color_and_depth
    for x in range(TILE_PX):
        pixel = offset + np.uint64(x)  # its place in each plane
        red_place = pixel + np.uint64(GRADIENT_PLANES)  # of red's gradient, in `planes`
        red_grad = planes[red_place]
        green_grad = planes[red_place + np.uint64(PLANE_FLOATS)]
        blue_grad = planes[red_place + np.uint64(2 * PLANE_FLOATS)]
        depth_grad = planes[red_place + np.uint64(3 * PLANE_FLOATS)]
        alpha_grad = planes[red_place + np.uint64(4 * PLANE_FLOATS)]
        # What one unit of this Gaussian's weight adds to the loss.
        value = red * red_grad + green * green_grad + blue * blue_grad
        value += depth * depth_grad + alpha_grad

        note = note_start + np.uint64(x)  # the place of the pixel's alpha
        alpha = notes[note]
        transmittance = notes[note + np.uint64(TILE_PX)]  # behind the row's 16 alphas
        planes[pixel + np.uint64(BEHIND_PLANE)] += alpha * transmittance * value


@reordering_kernel
def step_back_and_sum_row(
    planes: Array,
    offset: np.uint64,
    notes: Array,
    note_start: np.uint64,
    center: np.float32,
    color_and_depth: Numbers,
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]:
    """Add a row of 16 pixels of a Gaussian to what lies behind, and sum its gradients over them.

    A tile's Gaussians are visited back to front. After its visit, a Gaussian counts as a part of
    what lies behind those that are visited later.

    Args:
        planes: seven images of the tile, 256 floats each, one after the other: transmittance,
            contribution of what lies behind (changed here), gradients of red, green, blue, depth
            and alpha.
        offset: where the row starts in each plane.
        notes: from `note_start` on, 16 alphas and then 16 transmittances of the row.
        note_start: where the row's note starts.
        center: the Gaussian's middle in this row, in pixels of the tile.
        color_and_depth: its red, green, blue and depth.

    Returns:
        The sums of v, v·u and v·u², with v = ∂L/∂ln(alpha) and u = x - center; then the gradients
        of red, green, blue and depth.
    """
    red, green, blue, depth = color_and_depth
    sum_v = ZERO
    sum_vu = ZERO
    sum_vuu = ZERO
    sum_red = ZERO
    sum_green = ZERO
    sum_blue = ZERO
    sum_depth = ZERO
    for x in range(TILE_PX):
        pixel = offset + np.uint64(x)  # its place in each plane
        red_place = pixel + np.uint64(GRADIENT_PLANES)  # of red's gradient, in `planes`
        red_grad = planes[red_place]
        green_grad = planes[red_place + np.uint64(PLANE_FLOATS)]
        blue_grad = planes[red_place + np.uint64(2 * PLANE_FLOATS)]
        depth_grad = planes[red_place + np.uint64(3 * PLANE_FLOATS)]
        alpha_grad = planes[red_place + np.uint64(4 * PLANE_FLOATS)]
        # What one unit of this Gaussian's weight adds to the loss.
        value = (
            red * red_grad + green * green_grad + blue * blue_grad + depth * depth_grad + alpha_grad
        )
        note = note_start + np.uint64(x)  # the place of the pixel's alpha
        alpha = notes[note]
        transmittance = notes[note + np.uint64(TILE_PX)]  # behind the row's 16 alphas
        behind = planes[pixel + np.uint64(BEHIND_PLANE)]
        weight = alpha * transmittance
        planes[pixel + np.uint64(BEHIND_PLANE)] = behind + weight * value

        # A larger alpha shows more of this Gaussian and less of those behind; a clamped alpha has
        # no gradient.
        log_alpha_grad = alpha * (transmittance * value - behind / (ONE - alpha))
        v = log_alpha_grad if alpha < ALPHA_MAX_F32 else ZERO
        u = np.float32(x) - center
        sum_v += v
        sum_vu += v * u
        sum_vuu += v * u * u
        sum_red += weight * red_grad
        sum_green += weight * green_grad
        sum_blue += weight * blue_grad
        sum_depth += weight * depth_grad
    return sum_v, sum_vu, sum_vuu, sum_red, sum_green, sum_blue, sum_depth


@kernel
def collect_sums(first_row: int, last_row: int, sum_rows: Array, sums: Array, table: Array) -> None:
    """Add the gradients that all tiles give to a Gaussian in the Gaussian's row of the table.

    Several threads do this at once, each for its own rows of the table, so that no two threads
    write to one row. Each thread therefore looks through all rows of `sums`.

    Args:
        first_row, last_row: this thread's rows of the table, first_row..last_row (exclusive).
        sum_rows: [M]: the row of the table to which each row of `sums` belongs.
        sums: [M, 10] float32, in the order of tiles: for a Gaussian in a tile, the sums over the
            tile's pixels from which its gradients follow.
        table: [G, 10] float32, zero at first.
    """
    for k in range(len(sum_rows)):
        row = sum_rows[k]
        if first_row <= row < last_row:
            for s in range(SUMS):
                table[row, s] += sums[k, s]
