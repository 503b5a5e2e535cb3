"""`spackle.inpaint.exemplar` once more, for a GPU: all cells of a hole at once, one torch operation at a time.

The same search with the same chances; matches differ where rounding decides between two that fit alike.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, pad

from spackle.filters import blurred
from spackle.inpaint.exemplar import (
    COARSEST,
    DEPTH_WEIGHT,
    FADING,
    FAINTEST_CELL,
    FAINTEST_VOTE,
    FAR,
    JUMPS,
    LEAST_COST,
    LEAST_SPREAD,
    MIRRORS,
    OFFSET_WEIGHT,
    RADIUS,
    ROUNDS,
    SAME_SURFACE,
    SIDE,
    TONE_CELLS,
    TONE_WEIGHT,
    Exemplar,
    halved,
)

BITS = 0xFFFFFFFF


@dataclasses.dataclass(frozen=True)
class _DenseLevel:
    """The picture at one size, h × w cells."""

    rgb: Tensor  # [h, w, 3]; in the hole where the search begins
    traits: Tensor  # [h, w, 4] tone and depth, each in roots of the cost
    hole: Tensor  # [h, w] bool
    weights: Tensor  # [h + 6, w + 6] of a cell in a patch; 0 beyond the picture


@dataclasses.dataclass(frozen=True)
class _DenseMatches:
    """What the n cells of a level's hole look like."""

    rgb: Tensor  # [h, w, 3], the hole painted
    numbers: Tensor  # [h, w] of each cell in the lists below; -1 outside of the hole
    places: Tensor  # [n, 3] source, row, column of the patch's centre
    costs: Tensor  # [n]


def dense_exemplar(guess: Tensor, hole: Tensor, inverse_depth: Tensor) -> Exemplar:
    """See `exemplar`, which this gives but for rounding."""
    levels = _pyramid(guess.detach().float(), hole, inverse_depth.detach().float())
    matches = None
    for number in reversed(range(len(levels))):
        matches = _fit(levels[number], matches, number)
    mismatch = guess.new_zeros(hole.shape)
    places = torch.full((*hole.shape, 3), -1, dtype=torch.int32, device=guess.device)
    if matches is None:
        return Exemplar(levels[0].rgb, mismatch, places)
    mismatch[hole], places[hole] = matches.costs.sqrt(), matches.places.int()
    return Exemplar(matches.rgb, mismatch, places)


def _pyramid(guess: Tensor, hole: Tensor, inverse_depth: Tensor) -> list[_DenseLevel]:
    """The finest level first. The hole starts as what is mirrored at its rim, where that is the same surface."""
    log, known = inverse_depth.clamp_min(1e-9).log(), ~hole
    count = known.sum().clamp_min(1)
    mean = torch.where(known, log, 0).sum() / count
    depth = log / (torch.where(known, log - mean, 0).square().sum() / count).sqrt().clamp_min(LEAST_SPREAD)
    levels: list[_DenseLevel] = []
    rgb, tone = guess, guess
    while True:
        number, near = len(levels), dense_nearest_known(hole)
        own = torch.stack(torch.meshgrid(*(torch.arange(n, device=hole.device) for n in hole.shape), indexing="ij"))
        if not number:
            rgb = _mirrored(rgb, hole, depth, near, own)
        tones = TONE_WEIGHT * blurred(tone, max(TONE_CELLS / 2**number, 0.5))
        inside = (near - own).float().norm(dim=0)
        weights = pad((FADING**inside).clamp_min(float(FAINTEST_CELL)), (RADIUS,) * 4)
        levels.append(_DenseLevel(rgb, torch.cat([tones, DEPTH_WEIGHT * depth[..., None]], dim=-1), hole, weights))
        coarse_hole = avg_pool2d(hole[None].float(), 2, ceil_mode=True)[0] > 0
        if min(hole.shape) < 2 * COARSEST or bool(coarse_hole.all() | ~hole.any()):
            return levels
        rgb, tone, depth = halved(rgb), halved(tone), halved(depth[..., None])[..., 0]
        hole = coarse_hole


def dense_nearest_known(hole: Tensor) -> Tensor:
    """[2, h, w] row and column of the nearest known cell, nearly always; see `nearest_known`.

    Cells ask others ever nearer for theirs (jump flooding, Rong and Tan 2006).
    """
    height, width = hole.shape
    own = torch.stack(torch.meshgrid(*(torch.arange(n, device=hole.device) for n in hole.shape), indexing="ij"))
    near = torch.where(hole, -FAR, own)
    apart = (near - own).square().sum(0)
    jump = 1 << max(0, math.ceil(math.log2(max(height, width))) - 1)
    for step in [jump >> k for k in range(jump.bit_length())] + [1]:
        wide = pad(near, (step,) * 4, value=-FAR)
        for dy in (0, step, 2 * step):
            for dx in (0, step, 2 * step):
                theirs = wide[:, dy : dy + height, dx : dx + width]
                distance = (theirs - own).square().sum(0)
                nearer = distance < apart
                near, apart = torch.where(nearer, theirs, near), torch.where(nearer, distance, apart)
    return near


def _mirrored(rgb: Tensor, hole: Tensor, depth: Tensor, near: Tensor, own: Tensor) -> Tensor:
    """What lies as far beyond the nearest known cell as a cell lies before it, if its depth is alike."""
    height, width = hole.shape
    v, u = 2 * near - own
    inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
    v, u = v.clamp(0, height - 1), u.clamp(0, width - 1)
    alike = hole & inside & ~hole[v, u] & ((depth[v, u] - depth).abs() < SAME_SURFACE)
    return torch.where(alike[..., None], rgb[v, u], rgb)


def _fit(level: _DenseLevel, coarse: _DenseMatches | None, number: int) -> _DenseMatches | None:
    """Search and vote in turn; None where there is no hole, or no patch for it."""
    hole = level.hole
    usable = max_pool2d(hole[None].float(), SIDE, stride=1, padding=RADIUS)[0] == 0
    usable[:RADIUS] = usable[-RADIUS:] = False
    usable[:, :RADIUS] = usable[:, -RADIUS:] = False
    cells, pool = hole.nonzero(), usable.nonzero()
    if not len(cells) or not len(pool):
        return None
    search = _Search(level, cells, pool, usable)
    places = search.first(coarse)
    rgb, costs = level.rgb, torch.zeros(len(cells), device=hole.device)
    if coarse is not None:
        rgb = search.voted(rgb, places, costs, torch.ones_like(costs[0]))
    for turn in range(ROUNDS):
        search.look_at(rgb)
        costs = search.cost(places)
        for jump in JUMPS:
            seed = ((number * ROUNDS + turn) * len(JUMPS) + jump) * 7919
            places, costs = search.better(places, costs, jump, seed)
        rgb = search.voted(rgb, places, costs, costs.mean().clamp_min(LEAST_COST))
    return _DenseMatches(rgb, search.numbers, places, costs)


class _Search:
    """A level's hole, and all that is looked at for its cells."""

    def __init__(self, level: _DenseLevel, cells: Tensor, pool: Tensor, usable: Tensor) -> None:
        self.height, self.width = usable.shape
        self.y, self.x = cells.unbind(-1)
        self.n, self.pool = torch.arange(len(cells), device=cells.device), pool
        self.numbers = torch.full_like(usable, -1, dtype=torch.int64)
        self.numbers[self.y, self.x] = self.n
        self.rgb, self.traits, self.valid = (
            torch.stack([grid, grid.flip(1)]) for grid in (level.rgb, level.traits, usable)
        )
        steps = torch.arange(-RADIUS, RADIUS + 1, device=cells.device)
        self.dy, self.dx = (grid.flatten() for grid in torch.meshgrid(steps, steps, indexing="ij"))
        self.around = (self.y[:, None] + self.dy + RADIUS, self.x[:, None] + self.dx + RADIUS)  # in padded grids
        self.weights = level.weights[self.around]  # [n, 49]
        self.mass = self.weights.sum(1)
        self.own = level.traits[self.y, self.x]
        self.offset = OFFSET_WEIGHT / max(self.height, self.width) ** 2
        self.fellows = pad(self.numbers, (RADIUS,) * 4, value=-1)[self.around]  # [n, 49]

    def first(self, coarse: _DenseMatches | None) -> Tensor:
        """Matches [n, 3]: the parent's, twice as far; or any."""
        pick = self.pool[_hash(self.n) % len(self.pool)]
        places = torch.cat([torch.zeros_like(pick[:, :1]), pick], dim=1)
        if coarse is None:
            return places
        rows, columns = coarse.numbers.shape
        k = coarse.numbers[(self.y // 2).clamp_max(rows - 1), (self.x // 2).clamp_max(columns - 1)]
        m, v, u = coarse.places[k.clamp_min(0)].unbind(-1)
        # A mirrored picture's cells begin at the other side.
        row, column = 2 * v + self.y % 2, 2 * u + self.x % 2 + m * (self.width - 2 * columns)
        good = (k >= 0) & self.fits(m, row, column)
        return torch.where(good[:, None], torch.stack([m, row, column], dim=1), places)

    def fits(self, m: Tensor, v: Tensor, u: Tensor) -> Tensor:
        """Whether there are patches at these places."""
        inside = (v >= 0) & (v < self.height) & (u >= 0) & (u < self.width)
        return inside & self.valid[m, v.clamp(0, self.height - 1), u.clamp(0, self.width - 1)]

    def look_at(self, rgb: Tensor) -> None:
        """Colours around each cell, against which patches are held."""
        self.patches = pad(rgb.permute(2, 0, 1), (RADIUS,) * 4).permute(1, 2, 0)[self.around]  # [n, 49, 3]

    def cost(self, places: Tensor) -> Tensor:
        """Of the patches at places [n, 3] that are there, for each cell."""
        m, v, u = places.unbind(-1)
        total = (self.own - self.traits[m, v, u]).square().sum(-1)
        across = self.x - torch.where(m > 0, self.width - 1 - u, u)
        total = total + self.offset * ((self.y - v).square() + across.square())
        found = self.rgb[m[:, None], v[:, None] + self.dy, u[:, None] + self.dx]
        return total + (self.weights * (self.patches - found).square().sum(-1)).sum(1) / self.mass

    def better(self, before: Tensor, worth: Tensor, jump: int, seed: int) -> tuple[Tensor, Tensor]:
        """Better matches: the neighbours', any, and some ever nearer to the best."""
        places, costs = before, worth

        def attempt(m: Tensor, v: Tensor, u: Tensor, there: Tensor) -> None:
            nonlocal places, costs
            tried = torch.stack([m, v, u], dim=1)
            found = torch.where(there, self.cost(torch.where(there[:, None], tried, places)), torch.inf)
            good = found < costs
            places, costs = torch.where(good[:, None], tried, places), torch.where(good, found, costs)

        for dy, dx in ((jump, 0), (-jump, 0), (0, jump), (0, -jump)):
            v, u = self.y + dy, self.x + dx
            inside = (v >= 0) & (v < self.height) & (u >= 0) & (u < self.width)
            k = self.numbers[v.clamp(0, self.height - 1), u.clamp(0, self.width - 1)]
            m, v, u = before[k.clamp_min(0)].unbind(-1)
            attempt(m, v - dy, u - dx, inside & (k >= 0) & self.fits(m, v - dy, u - dx))
        chance = _hash(self.n * 9781 + seed)
        v, u = self.pool[chance % len(self.pool)].unbind(-1)
        chance = _hash(chance)
        m = chance % MIRRORS
        attempt(m, v, torch.where(m > 0, self.width - 1 - u, u), torch.ones_like(m, dtype=torch.bool))
        reach = max(self.height, self.width) // 4
        while reach >= 1:
            chance, span = _hash(chance), 2 * reach + 1
            m, v, u = places.unbind(-1)
            v, u = v + chance % span - reach, u + (chance >> 12) % span - reach
            attempt(m, v, u, self.fits(m, v, u))
            reach //= 4
        return places, costs

    def voted(self, rgb: Tensor, places: Tensor, costs: Tensor, mean: Tensor) -> Tensor:
        """Colours: the mean of what all patches over a cell say, the better ones counting more."""
        there, k = self.fellows >= 0, self.fellows.clamp_min(0)
        m, v, u = places[k].unbind(-1)
        # A patch lies within its source, so this is there.
        found = self.rgb[m, torch.where(there, v - self.dy, 0), torch.where(there, u - self.dx, 0)]
        weight = there * ((-costs / mean).exp() + float(FAINTEST_VOTE))[k]
        painted = rgb.clone()
        painted[self.y, self.x] = (weight[..., None] * found).sum(1) / weight.sum(1, keepdim=True)
        return painted


def _hash(value: Tensor) -> Tensor:
    """Numbers of 32 bits that look random, as int64."""
    value = value & BITS
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        value = ((value ^ (value >> shift)) * factor) & BITS
    return value ^ (value >> 16)
