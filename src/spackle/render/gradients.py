"""The gradient of a rendering.

Each tile is drawn again in chunks of Gaussians. The Gaussians of a chunk are then visited back to front. This gives
gradients of the projected Gaussians, from which the gradients of the Gaussians follow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from spackle.core.gaussians import Gaussians
from spackle.render.blend import (
    CHECK_EVERY,
    LIMIT,
    PLANE,
    STOP,
    TileLists,
    alpha_of,
    is_full,
    span_of,
    srgb_slope,
)
from spackle.render.cpu import BLEND_GRAIN, PROJECT_GRAIN, Drawing, as_array
from spackle.render.cpu import draw as draw_plainly
from spackle.render.project import (
    Arrays,
    KernelCamera,
    Numbers,
    factor,
    in_tile,
    jacobian,
    rotation,
    spread,
)
from spackle.render.protocol import ALPHA_MIN, TILE, Rendering, tile_mask
from spackle.runtime.device import parallel_for_chunks, thread_count
from spackle.runtime.kernels import ONE, ZERO, Array, kernel, reordering_kernel

FIELDS = 5  # tensors in a set of Gaussians

# Number of sums over a tile's pixels for one Gaussian: with u = x - centre and v = ∂L/∂ln(alpha), the sums of v, v·u,
# v·u², v·dy, v·dy², v·u·dy, then the gradients of red, green, blue and depth.
SUMS = 10

# The workspace is a flat buffer of planes with pixels in row order: the transmittance, the contribution of all
# Gaussians behind the current one, and the gradients of red, green, blue, depth and alpha.
BEHIND = 1 * PLANE
GRADIENTS = 2 * PLANE
WORKSPACE = 7 * PLANE

# Alphas and transmittances of a chunk of Gaussians, noted for the backward pass, fit into the second-level cache.
CHUNK = 128  # Gaussians
NOTE = 2 * TILE  # floats for one row of one Gaussian
NOTES = CHUNK * TILE * NOTE
INVISIBLE = np.float32(
    math.log2(ALPHA_MIN) - 1e-3
)  # log2 of alpha, below which a Gaussian draws nothing


def draw(
    sets: Sequence[Gaussians], view: KernelCamera, wanted: Array, onto: Rendering | None
) -> Rendering:
    """Draw like `spackle.render.cpu.draw`, with gradients."""
    under = [None] * 3 if onto is None else [image.float() for image in onto.tensors]
    fields = [t.to(device="cpu", dtype=torch.float32) for part in sets for t in part.tensors]
    return Rendering(*Draw.apply(view, wanted, *under, *fields))  # type: ignore[no-untyped-call]


class Draw(torch.autograd.Function):
    """Draws sets of Gaussians over three images; the sets are given as one flat sequence of tensors."""

    @staticmethod
    def forward(
        ctx: Any, view: KernelCamera, wanted: Array, *tensors: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw; `tensors` are rgb, depth and alpha of `onto` (or three None), then five float32 tensors per set."""
        under, fields = tensors[:3], [t for t in tensors[3:] if t is not None]
        sets = [Gaussians(*fields[k : k + FIELDS]) for k in range(0, len(fields), FIELDS)]
        onto = None if under[0] is None else Rendering(*under)  # type: ignore[arg-type]
        ctx.drawing, ctx.sizes = (
            draw_plainly(sets, view, wanted, onto, keep_linear=True),
            [len(part) for part in sets],
        )
        rendering: Rendering = ctx.drawing.rendering()
        ctx.save_for_backward(*rendering.tensors, *fields)
        return rendering.tensors

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Turn gradients of the three images into gradients of the tensors."""
        fields = ctx.saved_tensors[
            3:
        ]  # saved, because PyTorch raises an error if they were changed in place
        needs = ctx.needs_input_grad[2:]
        drawn = tile_mask(torch.from_numpy(ctx.drawing.wanted), *gradients[1].shape)
        under = [  # no gradient for pixels over which tiles were drawn
            torch.where(mask, 0, gradient) if need else None
            for mask, gradient, need in zip(
                (drawn[..., None], drawn, drawn), gradients, needs, strict=False
            )
        ]
        sets = [slice(k, k + FIELDS) for k in range(0, len(fields), FIELDS)]
        asking = np.array([any(needs[3:][part]) for part in sets], np.bool_)
        wanted = np.repeat(asking, ctx.sizes)
        rows = np.where(wanted, np.cumsum(wanted) - 1, -1).astype(np.int32)
        table = pixel_sums(
            ctx.drawing, tuple(as_array(g) for g in gradients), rows, int(wanted.sum())
        )
        results: list[Tensor | None] = []
        for part, size, asks in zip(sets, ctx.sizes, asking, strict=True):
            found = (
                set_gradients(fields[part], ctx.drawing.view, table[:size])
                if asks
                else [None] * FIELDS
            )
            results += [
                gradient if need else None
                for gradient, need in zip(found, needs[3:][part], strict=True)
            ]
            table = table[size if asks else 0 :]
        return None, None, *under, *results


def pixel_sums(drawing: Drawing, gradients: Arrays, rows: Array, count: int) -> Array:
    """Sums over pixels for each Gaussian that needs gradients: a table [count, SUMS] float32.

    `rows` [N] int32 has each Gaussian's row in the table, or -1. Sums of tiles are added in the order of tiles: the
    result does not depend on the number of threads.
    """
    lists, records, images = drawing.lists, drawing.splats.records, drawing.images
    entry_rows = rows[lists.ids]
    wanted = entry_rows >= 0
    slots = np.concatenate([[0], np.cumsum(wanted)])[lists.starts]
    tiles = np.flatnonzero(np.diff(slots))
    sums, table = np.zeros((slots[-1], SUMS), np.float32), np.zeros((count, SUMS), np.float32)

    def chunk(start: int, stop: int) -> None:
        backward_tiles(start, stop, tiles, lists, wanted, records, images, gradients, slots, sums)

    parallel_for_chunks(chunk, len(tiles), BLEND_GRAIN)
    shares, slot_rows = thread_count(), entry_rows[wanted]
    share = -(-count // shares)
    parallel_for_chunks(lambda a, b: collect_sums(a, b, share, slot_rows, sums, table), shares, 1)
    return table


def set_gradients(
    fields: Sequence[Tensor], view: KernelCamera, table: Array
) -> list[Tensor | None]:
    """The gradients of a set's five tensors, from sums over pixels."""
    scene, gradients = (
        tuple(as_array(t) for t in fields),
        tuple(np.zeros(t.shape, np.float32) for t in fields),
    )
    parallel_for_chunks(
        lambda a, b: project_backward(a, b, scene, view, table, gradients),
        len(table),
        PROJECT_GRAIN,
    )
    return [torch.from_numpy(g) for g in gradients]


@kernel
def replay_row(
    work: Array, offset: np.uint64, notes: Array, note: np.uint64, peak: np.float32, bell: Numbers
) -> None:
    """Draw a row of a Gaussian, and note each pixel's alpha (0 if nothing is drawn) and transmittance.

    `bell` has the rate and the centre of the Gaussian's fall-off in the row.
    """
    across, center = bell
    for x in range(TILE):
        i, n = offset + np.uint64(x), note + np.uint64(x)
        u = np.float32(x) - center
        alpha = alpha_of(peak - across * u * u)
        light = work[i]
        after = light * (ONE - alpha)
        full = after <= STOP
        work[i] = ZERO if full else after
        notes[n] = ZERO if full else alpha
        notes[n + np.uint64(TILE)] = light


@kernel
def replay(
    work: Array, notes: Array, records: Array, ids: Array, left: int, top: int, first_notes: Array
) -> int:
    """Draw a chunk of Gaussians again; `first_notes` [CHUNK] receives each Gaussian's first row in `notes`.

    Returns the number of Gaussians that were drawn until the tile was full.
    """
    note = np.uint64(0)
    for k in range(len(ids)):
        first_notes[k] = note
        x, y, slope, across, fall, height, _, half_height, _, _, _, _ = in_tile(
            records[ids[k]], left, top
        )
        first, last = span_of(y, half_height)
        for row in range(first, last):
            dy = np.float32(row) - y
            peak = height - fall * dy * dy
            if peak < INVISIBLE:
                continue
            replay_row(work, np.uint64(row * TILE), notes, note, peak, (across, x + slope * dy))
            note += np.uint64(NOTE)
        if k % CHECK_EVERY == CHECK_EVERY - 1 and is_full(work):
            return k + 1
    return len(ids)


@kernel
def pass_row(work: Array, offset: np.uint64, notes: Array, note: np.uint64, look: Numbers) -> None:
    """Step back over a row of a Gaussian without gradient; `look` has colour and depth."""
    red, green, blue, depth = look
    for x in range(TILE):
        i, n = offset + np.uint64(x), note + np.uint64(x)
        g = i + np.uint64(GRADIENTS)
        value = (
            red * work[g]
            + green * work[g + np.uint64(PLANE)]
            + blue * work[g + np.uint64(2 * PLANE)]
        )
        value += depth * work[g + np.uint64(3 * PLANE)] + work[g + np.uint64(4 * PLANE)]
        work[i + np.uint64(BEHIND)] += notes[n] * notes[n + np.uint64(TILE)] * value


@reordering_kernel
def gather_row(
    work: Array, offset: np.uint64, notes: Array, note: np.uint64, center: np.float32, look: Numbers
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]:
    """Step back over a row of a Gaussian; return its sums over pixels, those of SUMS that do not contain dy."""
    red, green, blue, depth = look
    sum_v, sum_vu, sum_vuu = ZERO, ZERO, ZERO
    sum_red, sum_green, sum_blue, sum_depth = ZERO, ZERO, ZERO, ZERO
    for x in range(TILE):
        i, n = offset + np.uint64(x), note + np.uint64(x)
        g = i + np.uint64(GRADIENTS)
        by_red, by_green, by_blue = (
            work[g],
            work[g + np.uint64(PLANE)],
            work[g + np.uint64(2 * PLANE)],
        )
        by_depth, by_alpha = work[g + np.uint64(3 * PLANE)], work[g + np.uint64(4 * PLANE)]
        value = red * by_red + green * by_green + blue * by_blue + depth * by_depth + by_alpha
        alpha, light, behind = notes[n], notes[n + np.uint64(TILE)], work[i + np.uint64(BEHIND)]
        weight = alpha * light
        work[i + np.uint64(BEHIND)] = behind + weight * value
        # A larger alpha shows more of this Gaussian and less of Gaussians behind; a clamped alpha has no gradient.
        slope = alpha * (light * value - behind / (ONE - alpha))
        v = slope if alpha < LIMIT else ZERO
        u = np.float32(x) - center
        sum_v += v
        sum_vu += v * u
        sum_vuu += v * u * u
        sum_red += weight * by_red
        sum_green += weight * by_green
        sum_blue += weight * by_blue
        sum_depth += weight * by_depth
    return sum_v, sum_vu, sum_vuu, sum_red, sum_green, sum_blue, sum_depth


@kernel
def walk_back(
    work: Array,
    notes: Array,
    note: np.uint64,
    record: Array,
    left: int,
    top: int,
    wanted: bool,
    sums: Array,
) -> None:
    """Step back over a Gaussian, whose saved values begin at `note`; if `wanted`, add its sums to `sums` [SUMS]."""
    x, y, slope, _, fall, height, _, half_height, depth, red, green, blue = in_tile(
        record, left, top
    )
    look, (first, last) = (red, green, blue, depth), span_of(y, half_height)
    for row in range(first, last):
        dy = np.float32(row) - y
        if height - fall * dy * dy < INVISIBLE:
            continue
        offset = np.uint64(row * TILE)
        if wanted:
            gifts = gather_row(work, offset, notes, note, x + slope * dy, look)
            v, vu, vuu, by_red, by_green, by_blue, by_depth = gifts
            sums[0] += v
            sums[1] += vu
            sums[2] += vuu
            sums[3] += v * dy
            sums[4] += v * dy * dy
            sums[5] += vu * dy
            sums[6] += by_red
            sums[7] += by_green
            sums[8] += by_blue
            sums[9] += by_depth
        else:
            pass_row(work, offset, notes, note, look)
        note += np.uint64(NOTE)


@kernel
def load_gradients(work: Array, left: int, top: int, images: Arrays, gradients: Arrays) -> None:
    """Turn gradients of a tile's rgb, depth and alpha into gradients of blended sums; 0 outside of the image."""
    rgb, depth, alpha, linear = images
    rgb_grad, depth_grad, alpha_grad = gradients
    for i in range(GRADIENTS, GRADIENTS + 5 * PLANE):
        work[i] = ZERO
    for row in range(min(TILE, depth.shape[0] - top)):
        for column in range(min(TILE, depth.shape[1] - left)):
            i, y, x = GRADIENTS + row * TILE + column, top + row, left + column
            for channel in range(3):
                slope = srgb_slope(linear[y, x, channel], rgb[y, x, channel])
                work[i + channel * PLANE] = rgb_grad[y, x, channel] * slope
            work[i + 4 * PLANE] = alpha_grad[y, x]
            if alpha[y, x] > ZERO:
                by_sum = depth_grad[y, x] / alpha[y, x]
                work[i + 3 * PLANE] = by_sum
                work[i + 4 * PLANE] -= by_sum * depth[y, x]


@kernel
def backward_tile(
    room: Arrays, records: Array, ids: Array, wanted: Array, left: int, top: int, sums: Array
) -> None:
    """Compute the gradients of a tile with the list `ids` [n], for the entries `wanted` [n] bool.

    Args:
        room: [WORKSPACE], filled by `load_gradients`; [NOTES]; and [CHUNK] for the start of each Gaussian's notes.
        sums: [m, SUMS], one row for each wanted entry.
    """
    work, notes, first_notes = room
    chunks = (len(ids) + CHUNK - 1) // CHUNK
    before = np.empty((chunks, PLANE), np.float32)  # transmittance before each chunk
    work[:PLANE] = ONE
    work[BEHIND : BEHIND + PLANE] = ZERO
    for chunk in range(chunks):
        before[chunk] = work[:PLANE]
        if chunk < chunks - 1:
            replay(
                work,
                notes,
                records,
                ids[chunk * CHUNK : (chunk + 1) * CHUNK],
                left,
                top,
                first_notes,
            )
    slot = len(sums)
    for chunk in range(chunks - 1, -1, -1):
        work[:PLANE] = before[chunk]
        part = ids[chunk * CHUNK : (chunk + 1) * CHUNK]
        drawn = replay(work, notes, records, part, left, top, first_notes)
        for k in range(len(part) - 1, -1, -1):
            if slot == 0:
                return
            asks = wanted[chunk * CHUNK + k]
            slot -= asks
            if k < drawn:
                own = sums[slot if asks else 0]
                walk_back(work, notes, first_notes[k], records[part[k]], left, top, asks, own)


@kernel
def backward_tiles(
    first: int, last: int, tiles: Array, lists: TileLists, wanted: Array, records: Array,
    images: Arrays, gradients: Arrays, slots: Array, sums: Array,
) -> None:  # fmt: skip
    """Compute the gradients of the tiles first..last of `tiles` [K], for the entries `wanted` [E] bool.

    `slots` [T + 1] int64 has the start of each tile's rows in `sums` [M, SUMS]; `sums` must be zero at first.
    """
    room = np.empty(WORKSPACE, np.float32), np.empty(NOTES, np.float32), np.empty(CHUNK, np.uint64)
    columns = (images[1].shape[1] + TILE - 1) // TILE
    for k in range(first, last):
        tile = tiles[k]
        left, top = (tile % columns) * TILE, (tile // columns) * TILE
        load_gradients(room[0], left, top, images, gradients)
        part, own = (
            slice(lists.starts[tile], lists.starts[tile + 1]),
            sums[slots[tile] : slots[tile + 1]],
        )
        backward_tile(room, records, lists.ids[part], wanted[part], left, top, own)


@kernel
def collect_sums(first: int, last: int, share: int, rows: Array, sums: Array, table: Array) -> None:
    """Add `sums` [M, SUMS] to the rows `rows` [M] of the table [G, SUMS], but only to rows first·share..last·share."""
    for slot in range(len(rows)):
        row = rows[slot]
        if first * share <= row < last * share:
            for s in range(SUMS):
                table[row, s] += sums[slot, s]


@kernel
def project_backward(
    start: int, stop: int, scene: Arrays, camera: KernelCamera, table: Array, gradients: Arrays
) -> None:
    """Compute the gradients of the Gaussians start..stop of a set, in float64, from `table` [N, SUMS].

    `scene` and `gradients` are the set's five arrays and their gradients. A Gaussian with a row of zeros is invisible
    and gets no gradients.
    """
    (means, quats, scales, opacities, _), lens, pose = scene, camera.lens, camera.pose
    means_grad, quats_grad, scales_grad, opacities_grad, colors_grad = gradients
    local, factor_grad, rotation_grad, jacobian_grad = (
        np.empty(3),
        np.empty((2, 3)),
        np.empty((3, 3)),
        np.empty((2, 3)),
    )
    for i in range(start, stop):
        row = table[i]
        if not row.any():
            continue
        colors_grad[i, 0], colors_grad[i, 1], colors_grad[i, 2] = row[6], row[7], row[8]
        opacities_grad[i] = row[0] / opacities[i]
        for a in range(3):
            local[a] = (
                pose[a, 0] * means[i, 0]
                + pose[a, 1] * means[i, 1]
                + pose[a, 2] * means[i, 2]
                + pose[a, 3]
            )
        nearness = 1.0 / local[2]
        j, r = (
            jacobian(local[0] * nearness, local[1] * nearness, nearness, lens),
            rotation(quats[i]),
        )
        u_grad, v_grad = splat_backward(
            row, factor(j, pose, r, scales[i]), camera.eps2d, factor_grad
        )
        factor_backward(
            j, pose, r, scales[i], factor_grad, (jacobian_grad, rotation_grad), scales_grad[i]
        )
        quat_backward(quats[i], rotation_grad, quats_grad[i])
        local_grad = point_backward(local, lens, jacobian_grad, u_grad, v_grad, row[9])
        for b in range(3):
            means_grad[i, b] = (
                pose[0, b] * local_grad[0] + pose[1, b] * local_grad[1] + pose[2, b] * local_grad[2]
            )


@kernel
def splat_backward(
    row: Array, factors: Numbers, eps2d: float, factor_grad: Array
) -> tuple[float, float]:
    """Turn sums over pixels into gradients of the factor M (written to `factor_grad`) and of the centre (returned).

    For a pixel at d from the centre, ∂ln(alpha)/∂centre = p and ∂ln(alpha)/∂Σ = ½ p pᵀ with p = Σ⁻¹ d
    = (A·u, D·dy - k·A·u), with A = Σyy/det, D = 1/Σyy and the slope k = Σxy/Σyy.
    """
    _, xy, yy, det = spread(factors, eps2d)
    across, fall = yy / det, 1.0 / yy
    skew = xy / yy * across
    grad_xx = across * across * row[2]
    grad_xy = across * fall * row[5] - across * skew * row[2]
    grad_yy = fall * fall * row[4] - 2.0 * fall * skew * row[5] + skew * skew * row[2]
    for k in range(3):
        m, n = factors[k], factors[3 + k]
        factor_grad[0, k] = grad_xx * m + grad_xy * n
        factor_grad[1, k] = grad_xy * m + grad_yy * n
    return across * row[1], fall * row[3] - skew * row[1]


@kernel
def factor_backward(
    j: Numbers,
    pose: Array,
    r: Numbers,
    scale: Array,
    factor_grad: Array,
    grads: Arrays,
    scale_grad: Array,
) -> None:
    """Turn the gradient of the factor M = J W R S into gradients of the Jacobian J, the rotation R and the scales."""
    jacobian_grad, rotation_grad = grads
    jacobian_grad[:, :] = 0.0
    for k in range(3):
        scale_grad[k] = 0.0
        for b in range(3):
            # Column b of J W is multiplied by component b of the axis.
            h0, h1 = j[0] * pose[0, b] + j[1] * pose[2, b], j[2] * pose[1, b] + j[3] * pose[2, b]
            along, axis = h0 * factor_grad[0, k] + h1 * factor_grad[1, k], r[3 * b + k]
            scale_grad[k] += along * axis
            rotation_grad[b, k] = along * scale[k]
            for a in range(2):
                for c in range(3):
                    jacobian_grad[a, c] += factor_grad[a, k] * scale[k] * axis * pose[c, b]


@kernel
def quat_backward(quat: Array, r: Array, grad: Array) -> None:
    """Turn the gradient of a rotation matrix into the gradient of the quaternion before normalisation."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    norm = 1.0 / max(math.sqrt(w * w + x * x + y * y + z * z), 1e-12)
    w, x, y, z = w * norm, x * norm, y * norm, z * norm
    gw = 2 * (x * (r[2, 1] - r[1, 2]) + y * (r[0, 2] - r[2, 0]) + z * (r[1, 0] - r[0, 1]))
    gx = 2 * (
        w * (r[2, 1] - r[1, 2]) + y * (r[0, 1] + r[1, 0]) + z * (r[0, 2] + r[2, 0])
    ) - 4 * x * (r[1, 1] + r[2, 2])
    gy = 2 * (
        w * (r[0, 2] - r[2, 0]) + x * (r[0, 1] + r[1, 0]) + z * (r[1, 2] + r[2, 1])
    ) - 4 * y * (r[0, 0] + r[2, 2])
    gz = 2 * (
        w * (r[1, 0] - r[0, 1]) + x * (r[0, 2] + r[2, 0]) + y * (r[1, 2] + r[2, 1])
    ) - 4 * z * (r[0, 0] + r[1, 1])
    along = gw * w + gx * x + gy * y + gz * z
    grad[0], grad[1] = (gw - along * w) * norm, (gx - along * x) * norm
    grad[2], grad[3] = (gy - along * y) * norm, (gz - along * z) * norm


@kernel
def point_backward(
    local: Array, lens: Array, jacobian_grad: Array, u_grad: float, v_grad: float, depth_grad: float
) -> tuple[float, float, float]:
    """The gradient of the centre in camera space, from the gradients of the pixel, the Jacobian and the depth."""
    x, y, z = local
    tx, ty = min(lens[5], max(lens[4], x / z)), min(lens[7], max(lens[6], y / z))
    fx, fy = lens[0] / z, lens[1] / z
    x_grad, y_grad = fx * u_grad, fy * v_grad
    z_grad = depth_grad - (x_grad * x + y_grad * y) / z
    z_grad -= (fx * jacobian_grad[0, 0] + fy * jacobian_grad[1, 1]) / z
    z_grad += (fx * tx * jacobian_grad[0, 2] + fy * ty * jacobian_grad[1, 2]) / z
    if lens[4] <= x / z <= lens[5]:
        x_grad -= fx / z * jacobian_grad[0, 2]
        z_grad += fx / z * tx * jacobian_grad[0, 2]
    if lens[6] <= y / z <= lens[7]:
        y_grad -= fy / z * jacobian_grad[1, 2]
        z_grad += fy / z * ty * jacobian_grad[1, 2]
    return x_grad, y_grad, z_grad
