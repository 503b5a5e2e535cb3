"""The costs of `spackle.core.patch_search` by NumPy, for all patches of a cell at once."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.lib.stride_tricks import sliding_window_view as windows

from spackle.core.filters import gaussian_blur
from spackle.core.patch_matching import _build_pyramid
from spackle.core.patch_search import PATCH_RADIUS, PATCH_SIDE, CostInputs, score_match

INNER = slice(PATCH_RADIUS, -PATCH_RADIUS)


def as_tensors(argument: Any) -> Any:
    """A kernel's argument with tensors in place of NumPy's arrays, of the same memory."""
    if isinstance(argument, np.ndarray):
        return torch.from_numpy(argument)
    if isinstance(argument, CostInputs):
        return CostInputs(*map(as_tensors, argument))
    return argument


class Subject:
    """A random picture with holes, in the arrays that the kernels take, and the costs by the
    module's formula.
    """

    def __init__(self, height: int, width: int) -> None:
        rgb = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(0))
        hole = torch.zeros(height, width, dtype=torch.bool)
        hole[height // 3 : height // 2, width // 3 : width // 2] = hole[-height // 5 :, -3:] = True
        z = torch.linspace(-1.5, 0, width) + 0.1 * rgb[..., 0]
        level = _build_pyramid(rgb, hole, z.exp())[0]
        self.rgb = level.rgb
        level_rgb, level_traits = level.rgb.numpy(), level.traits.numpy()
        self.hole, self.cells = hole.numpy(), hole.nonzero().numpy().astype(np.int32)
        self.numbers = np.where(hole, hole.flatten().cumsum(0).view_as(hole) - 1, -1).astype(
            np.int32
        )
        usable = np.pad(
            ~windows(self.hole, (PATCH_SIDE, PATCH_SIDE)).any(axis=(2, 3)), PATCH_RADIUS
        )
        self.pool = np.argwhere(usable).astype(np.int32)
        grids = (level_rgb, level_traits, usable)
        self.sources, traits, self.valid = (np.stack([grid, grid[:, ::-1]]) for grid in grids)
        self.padded = np.pad(level_rgb, [(PATCH_RADIUS, PATCH_RADIUS)] * 2 + [(0, 0)])
        step = 0.05 / max(height, width) ** 2
        self.inputs = CostInputs(
            self.padded,
            level.weights.numpy(),
            level_traits,
            self.sources,
            traits,
            np.float32(step),
        )
        tones = 2**0.5 * gaussian_blur(rgb, 4.0).permute(2, 0, 1).numpy()
        marks = [
            0.15 * z[None] / z[~hole].std(correction=0),
            tones,
            step**0.5 * np.indices(hole.shape),
        ]
        self.marks = np.stack([np.concatenate(marks)[..., ::way] for way in (1, -1)])
        every = np.argwhere(self.valid).astype(np.int32)
        self.places = every[:: len(every) // len(self.cells)][: len(self.cells)]
        self.costs = np.empty(len(self.cells), np.float32)
        arrays = (self.cells, self.places, self.inputs, self.costs)
        score_match(len(self.cells), *map(as_tensors, arrays))

    def formula(self, y: int, x: int) -> np.ndarray:
        """Costs [2, height, width] of all patches and mirrored patches; infinite for patches that
        touch the hole.
        """
        cells = np.argwhere(np.ones((PATCH_SIDE, PATCH_SIDE))) + np.array([y, x]) - PATCH_RADIUS
        deep = np.hypot(*(cells[:, None] - np.argwhere(~self.hole)).T).min(0)
        weights = np.where(((cells >= 0) & (cells < self.hole.shape)).all(1), 0.8**deep, 0).reshape(
            PATCH_SIDE, PATCH_SIDE
        )
        patch = self.padded[y : y + PATCH_SIDE, x : x + PATCH_SIDE].transpose(2, 0, 1)
        fit = (
            weights * (windows(self.sources, (PATCH_SIDE, PATCH_SIDE), axis=(1, 2)) - patch) ** 2
        ).sum((-3, -2, -1))
        total = ((self.marks - self.marks[0, :, y, x][:, None, None]) ** 2).sum(1)
        total[:, INNER, INNER] += fit / weights.sum()
        return np.where(self.valid, total, np.inf)

    def expected(self) -> list[float]:
        return [
            self.formula(*cell)[tuple(place)]
            for cell, place in zip(self.cells, self.places, strict=True)
        ]
