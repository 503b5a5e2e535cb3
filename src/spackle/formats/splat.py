"""`.splat`, the plain format of antimatter15's viewer: 32 bytes a Gaussian and nothing else."""

from __future__ import annotations

import numpy as np

from spackle.formats.columns import Columns
from spackle.gaussians import Gaussians

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def encode_splat(gaussians: Gaussians) -> bytes:
    """Gaussians, in their order and axes, as a .splat file: rounded to bytes are colours, opacities and rotations.

    Raises:
        ValueError: where a Gaussian is not finite.
    """
    columns = Columns.of(gaussians)
    rows = np.empty(len(gaussians), ROW)
    rows["means"] = columns.means
    rows["scales"] = np.exp(columns.log_scales)
    rows["rgba"][:, :3] = np.round(columns.srgb * 255)
    rows["rgba"][:, 3] = np.round(columns.opacities * 255)
    rows["quats"] = np.clip(np.round(columns.quats * 128 + 128), 0, 255)
    return rows.tobytes()
