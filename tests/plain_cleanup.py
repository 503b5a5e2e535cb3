"""Plain twins of the kernels that clean up depth maps: Python loops over lists, one pixel at a time."""

from __future__ import annotations

import heapq
import itertools
import math

import numpy as np

from spackle.bases import cleanup, edges, sky
from spackle.bases.edges import Bools, Edges, Floats, Sampled
from spackle.surface import EDGE


def plain_edges(inverse: Floats, known: Bools, focal: tuple[float, float]) -> Edges:
    """See `spackle.bases.edges.find_edges`."""
    step, across = _edges_by_rows(inverse, known, edges.STEEPEST / focal[0])
    columns, below = _edges_by_rows(inverse.T, known.T, edges.STEEPEST / focal[1])
    return Edges(np.maximum(step, columns.T), across, below.T)


def _edges_by_rows(inverse: Floats, known: Bools, steepest: float) -> tuple[Floats, Bools]:
    step, across = np.zeros(inverse.shape, np.float32), np.zeros(inverse.shape, bool)
    for y, (row, seen) in enumerate(zip(inverse, known, strict=True)):
        gaps = [
            b - a if p and q else None for (a, b), (p, q) in zip(*map(itertools.pairwise, (row, seen)), strict=True)
        ]
        for k, gap in enumerate(gaps):  # between pixels k and k + 1
            if gap is None or abs(gap) <= steepest * max(row[k], row[k + 1]):
                continue
            if _size(gaps, k - 1) > abs(gap) or _size(gaps, k + 1) >= abs(gap):
                continue
            rising = [None if g is None else g * np.sign(gap) for g in gaps]
            left, lefts = _side(rising[: k + 1][::-1])
            right, rights = _side(rising[k:])
            sides = [slope for slope in (left, right) if slope is not None] or [0.0]
            if max(sides) > edges.STANDS_OUT * abs(gap):
                continue
            first, last = k - lefts, k + rights
            rise = abs(row[last + 1] - row[first]) - np.mean(sides) * (last - first + 1)
            if rise <= EDGE * max(row[first], row[last + 1]):
                continue
            across[y, first : last + 1] = True
            step[y, first + 1 : last + 1] = np.maximum(step[y, first + 1 : last + 1], rise)
    return step, across


def _size(gaps: list, k: int) -> float:
    """The size of a gap; 0 where there is none."""
    return abs(gaps[k]) if 0 <= k < len(gaps) and gaps[k] is not None else 0.0


def _side(gaps: list) -> tuple[float | None, int]:
    """Gaps from a peak outwards: the slope beyond the edge, and how many gaps after the peak belong to it."""
    top, seen = gaps[0], []
    for gap in itertools.islice(gaps[1:], edges.REACH):
        halves = [n for n, g in enumerate([*seen], 1) if 2 * g < top]
        if gap is None or (halves and len(seen) + 1 > 2 * halves[0] + 1):
            break
        if gap > min([top, *seen]) + edges.SWELL * top:
            break
        seen.append(max(gap, 0))
        if gap <= 0:
            break
    if not seen:
        return (None, 0) if len(gaps) < 2 or gaps[1] is None else (top, 0)
    flattest = min(top, *seen)
    beyond = seen.index(flattest) + 2 if flattest < top else 1
    crowded = _size(gaps, beyond) > edges.FLAT * top
    for foot, gap in enumerate(seen[: max(beyond - 2, 0)]):
        if gap - flattest <= (edges.FLAT if crowded or foot == 0 else edges.FLAT / 2) * (top - flattest):
            return flattest, foot
    return flattest, max(beyond - 2, 0)


def plain_sample(inverse: Floats, known: Bools, found: Edges, height: int, width: int) -> Sampled:
    """See `spackle.bases.edges.sample`; for a map of another size than the photo's."""
    rows, columns = inverse.shape
    sound = known & (found.step == 0)
    slopes = (_flattest(inverse, sound, found.across), _flattest(inverse.T, sound.T, found.down.T).T)
    values, heights = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    state = np.zeros((height, width), np.uint8)
    for y, x in itertools.product(range(height), range(width)):
        v, u = (y + 0.5) * rows / height - 0.5, (x + 0.5) * columns / width - 0.5
        y0, x0 = (min(max(math.floor(p), 0), max(n - 2, 0)) for p, n in ((v, rows), (u, columns)))
        corners = [(r, c) for r in range(y0, min(y0 + 2, rows)) for c in range(x0, min(x0 + 2, columns))]
        weight = {(r, c): max(1 - abs(v - r), 0) * max(1 - abs(u - c), 0) for r, c in corners}
        seen = [corner for corner in corners if known[corner]]
        mass = sum(weight[corner] for corner in seen)
        plane = {
            (r, c): max(inverse[r, c] + slopes[0][r, c] * (u - c) + slopes[1][r, c] * (v - r), inverse[r, c] / 2)
            for r, c in seen
        }
        away = {(r, c): max(abs(u - c) * width / columns, abs(v - r) * height / rows) for r, c in seen if sound[r, c]}
        covered = bool(away) and min(away.values()) < 0.5 + 1e-6
        if mass < 0.5 * sum(weight.values()):
            if covered:
                state[y, x], values[y, x] = edges.SETTLED, plane[min(away, key=away.__getitem__)]
            continue
        split = any(found.across[r, c] for r, c in corners if c == x0 < columns - 1)
        split |= any(found.down[r, c] for r, c in corners if r == y0 < rows - 1)
        state[y, x] = edges.SETTLED
        if not split and not any(found.step[corner] for corner in seen):
            if len(seen) == 4:
                upper, lower = (inverse[r, x0] + (u - x0) * (inverse[r, x0 + 1] - inverse[r, x0]) for r in (y0, y0 + 1))
                values[y, x] = max(upper + (v - y0) * (lower - upper), min(inverse[c] for c in seen) / 2)
            else:
                values[y, x] = sum(weight[c] * plane[c] for c in seen) / mass
            continue
        if covered:
            values[y, x] = plane[min(away, key=away.__getitem__)]
        else:
            state[y, x], values[y, x] = edges.OPEN, sum(weight[c] * inverse[c] for c in seen) / mass
            spread = max(inverse[c] for c in seen) - min(inverse[c] for c in seen)
            heights[y, x] = max(spread, *(found.step[c] for c in seen))
    near = [[int((k + 0.5) * n / size) for k in range(size)] for n, size in ((rows, height), (columns, width))]
    across, down = (slope[np.ix_(*near)] for slope in slopes)
    return Sampled(values, state, heights, (across * columns / width, down * rows / height))


def _flattest(inverse: Floats, sound: Bools, edge: Bools) -> Floats:
    slope = np.zeros(inverse.shape)
    for y, x in itertools.product(*map(range, inverse.shape)):
        changes = []
        for pairs in ([(x - n - 1, x - n) for n in range(3)], [(x + n, x + n + 1) for n in range(3)]):
            for a, b in pairs:
                if a < 0 or b >= inverse.shape[1] or edge[y, a] or not (sound[y, a] and sound[y, b]):
                    break
                changes.append(inverse[y, b] - inverse[y, a])
        slope[y, x] = min(changes, key=abs) if changes else 0
    return slope


def plain_settle(sampled: Sampled, rgb: Floats) -> tuple[Floats, Bools, Bools]:
    """See `spackle.bases.edges.settle`; thirdly, where two paths are as good as equal."""
    height, width = sampled.state.shape
    depth, known = sampled.inverse_depth.astype(float), sampled.state != edges.HOLE
    origin, tied = _cheapest(sampled, rgb)
    pixels = [p for p in itertools.product(range(height), range(width)) if sampled.state[p] == edges.OPEN]
    for y, x in pixels:
        if (y, x) not in origin:
            known[y, x] = False
            continue
        v, u = origin[y, x]
        lean = sampled.slope[0][v, u] * (x - u) + sampled.slope[1][v, u] * (y - v)
        limit = edges.LEAN * sampled.inverse_depth[v, u]
        depth[y, x] = sampled.inverse_depth[v, u] + min(max(lean, -limit), limit)
    pixels = [p for p in pixels if known[p]]
    for _ in range(edges.VOTES):
        depth = _voted(depth, known, rgb, pixels)
    for _ in range(edges.RELAXATIONS):
        for y, x in pixels:
            means = []
            for a, b in (((y, x - 1), (y, x + 1)), ((y - 1, x), (y + 1, x))):
                inside = min(a) >= 0 and b[0] < height and b[1] < width and known[a] and known[b]
                if inside and max(abs(depth[a] - depth[y, x]), abs(depth[b] - depth[y, x])) < EDGE / 2 * depth[y, x]:
                    means.append((depth[a] + depth[b]) / 2)
            depth[y, x] = np.mean(means) if means else depth[y, x]
    return depth, known, tied


def _cheapest(sampled: Sampled, rgb: Floats) -> tuple[dict, Bools]:
    """The settled pixel that each open one is cheapest to reach from, by Dijkstra's algorithm, and the ties."""
    (height, width), tied = sampled.state.shape, np.zeros(sampled.state.shape, bool)
    starts = [(int(y), int(x)) for y, x in np.argwhere(sampled.state == edges.SETTLED)]
    cost, origin = dict.fromkeys(starts, 0.0), {p: p for p in starts}
    queue = [(0.0, p) for p in starts]
    while queue:
        total, (y, x) = heapq.heappop(queue)
        if total > cost[y, x]:
            continue
        for v, u in itertools.product((y - 1, y, y + 1), (x - 1, x, x + 1)):
            if not (0 <= v < height and 0 <= u < width) or sampled.state[v, u] != edges.OPEN:
                continue
            climb = abs(float(sampled.inverse_depth[v, u]) - float(sampled.inverse_depth[y, x])) / sampled.step[v, u]
            new = total + math.hypot(v - y, u - x) + edges.DEPTH_COST * climb
            new += edges.COLOR_COST * float(np.abs(rgb[v, u] - rgb[y, x]).sum())
            old = cost.get((v, u), math.inf)
            tied[v, u] |= abs(new - old) < 1e-3 and origin[v, u] != origin[y, x]
            if new < old:
                cost[v, u], origin[v, u] = new, origin[y, x]
                heapq.heappush(queue, (new, (v, u)))
    return origin, tied


def _voted(depth: Floats, known: Bools, rgb: Floats, pixels: list[tuple[int, int]]) -> Floats:
    result, size = depth.copy(), 2 * edges.VOTERS + 1
    for y, x in pixels:
        box = itertools.product(range(y - size // 2, y + size // 2 + 1), range(x - size // 2, x + size // 2 + 1))
        near = [(v, u) for v, u in box if 0 <= v < depth.shape[0] and 0 <= u < depth.shape[1] and known[v, u]]
        low, high = min(depth[p] for p in near), max(depth[p] for p in near)
        if high - low <= EDGE * high:
            continue
        votes = {p: (1 + (np.abs(rgb[p] - rgb[y, x]).sum() / edges.SAME_COLOR) ** 2) ** -2 for p in near}
        others = [p for p in near if (depth[p] > (low + high) / 2) != (depth[y, x] > (low + high) / 2)]
        if sum(votes.values()) < 2 * sum(votes[p] for p in others):
            result[y, x] = depth[max(others, key=lambda p: votes[p] / ((p[0] - y) ** 2 + (p[1] - x) ** 2))]
    return result


def plain_planes(inverse: Floats, known: Bools, tolerance: float) -> Floats:
    """See `spackle.bases.cleanup.smooth_noise`: least squares on each neighbourhood."""
    result, radius = inverse.copy(), cleanup.RADIUS
    for y, x in itertools.product(*map(range, inverse.shape)):
        if not known[y, x]:
            continue
        rows = range(max(y - radius, 0), min(y + radius + 1, inverse.shape[0]))
        columns = range(max(x - radius, 0), min(x + radius + 1, inverse.shape[1]))
        near = np.array([(1, u - x, v - y, inverse[v, u]) for v in rows for u in columns if known[v, u]], float)
        plane = np.array([inverse[y, x], 0, 0], float)
        for fit in range(cleanup.FITS):
            steep = 0 if fit else EDGE * np.abs(near[:, 1:3]).max(1)
            fits = near[np.abs(near[:, :3] @ plane - near[:, 3]) <= (tolerance + steep) * inverse[y, x]]
            if len(fits) < cleanup.ENOUGH or np.linalg.matrix_rank(fits[:, :3]) < 3:
                break
            plane = np.linalg.lstsq(fits[:, :3], fits[:, 3], rcond=None)[0]
        if abs(plane[0] - inverse[y, x]) <= tolerance * inverse[y, x]:
            result[y, x] = plane[0]
    return result


def plain_flood(rgb: Floats, first_row: Bools, candidates: Bools) -> Bools:
    """See `spackle.bases.sky._flood`: growing by one ring at a time."""
    found = np.zeros(candidates.shape, bool)
    found[0] = first_row
    while True:
        grown = found.copy()
        for y, x in np.argwhere(candidates & ~found):
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                inside = 0 <= v < found.shape[0] and 0 <= u < found.shape[1]
                grown[y, x] |= inside and found[v, u] and np.abs(rgb[y, x] - rgb[v, u]).sum() <= sky.SMOOTH
        if (grown == found).all():
            return found
        found = grown
