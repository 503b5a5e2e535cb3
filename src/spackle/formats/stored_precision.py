"""How well a written file keeps the Gaussians: it is read again, and compared with the scene.

Formats that round values to few bits suit scenes of some metres. A scene in millimetres, or one
with very near and very far parts, may lose what it consists of.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from spackle.core.gaussians import Gaussians
from spackle.formats.compressed_ply import file_order
from spackle.formats.gaussian_columns import MAX_SCALE, MIN_SCALE
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import load_scene
from spackle.formats.spz import spz_grid

# Formats that round positions or sizes; the others keep them as floats.
ROUNDING_SUFFIXES = (".spz", ".sog", ".compressed.ply")

# A Gaussian counts as lost if its place is wrong by more than its own standard deviation along its
# middle axis, or its size by more than half. Below that, a scene only looks a little rougher.
MAX_MOVE = 1.0
MAX_LOG_SIZE_CHANGE = float(np.log(1.5))


def count_coarse(scene: SceneFile, output: Path) -> int:
    """Return how many Gaussians of a scene a written file shows at a wrong place or size.

    Those that SPZ moves nearer, because they lie beyond its grid, do not count: they are shrunk
    likewise, and look the same from the photo's place.

    Args:
        scene: the scene that was written.
        output: the file.

    Raises:
        InputError: the file cannot be read.
    """
    if not output.name.lower().endswith(ROUNDING_SUFFIXES):
        return 0
    original = scene.gaussians
    if output.name.lower().endswith(".compressed.ply"):
        original = original.select(torch.from_numpy(file_order(scene)))
    stored = load_scene(output).gaussians

    # In which order the axes stand does not matter; the thinnest is often too thin to be seen.
    sizes = _sorted_log_sizes(original)
    resized = (_sorted_log_sizes(stored) - sizes)[:, 1:].abs().amax(dim=1) > MAX_LOG_SIZE_CHANGE
    distance = (stored.means.double() - original.means.double()).norm(dim=1)
    is_coarse = resized | (distance > MAX_MOVE * sizes[:, 1].exp())
    if output.name.lower().endswith(".spz"):
        is_coarse &= original.means.abs().amax(dim=1) <= spz_grid(original).end
    return int(is_coarse.sum())


def _sorted_log_sizes(gaussians: Gaussians) -> Tensor:
    """Return the logarithms [N, 3], float64, of the scales of each Gaussian, smallest first."""
    scales = gaussians.scales.double().clamp(MIN_SCALE, MAX_SCALE)
    return scales.log().sort(dim=1).values
