"""The .splat format of antimatter15's viewer: 32 bytes for each Gaussian, and no header."""

from __future__ import annotations

import numpy as np

from spackle.formats.gaussian_columns import MAX_SCALE, MIN_SCALE, GaussianColumns
from spackle.formats.quantization import codes_to_fractions
from spackle.formats.scene_content import DecodedScene, SceneFile

# One Gaussian in the file. A quaternion's component c in -1..1 is stored as 128 + 128 c.
SPLAT_ROW = np.dtype(
    [("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)]
)


def encode_splat(scene: SceneFile) -> bytes:
    """Encode a scene as a .splat file; the order of the Gaussians and the axes stay the same.

    Colours, opacities and rotations are rounded to bytes; colours cannot change with the view.

    Raises:
        ValueError: a Gaussian is not finite.
    """
    columns = GaussianColumns.from_gaussians(scene.gaussians).without_harmonics()
    rgba = np.concatenate([columns.srgb, columns.opacities[:, None]], axis=1)  # [N, 4]

    rows = np.empty(len(scene.gaussians), SPLAT_ROW)
    rows["means"] = columns.means
    rows["scales"] = np.exp(columns.log_scales)
    rows["rgba"] = np.round(rgba * 255)
    # The component 1 would become 256, which a byte cannot hold.
    rows["quats"] = np.clip(np.round(columns.quats * 128 + 128), 0, 255)
    return rows.tobytes()


def decode_splat(data: bytes) -> DecodedScene:
    """Decode a .splat file.

    Raises:
        ValueError: the file ends within a Gaussian.
    """
    if len(data) % SPLAT_ROW.itemsize:
        raise ValueError(
            f"{len(data)} bytes, which is no multiple of {SPLAT_ROW.itemsize}, those of a Gaussian"
        )
    rows = np.frombuffer(data, SPLAT_ROW)
    rgba = codes_to_fractions(rows["rgba"], 255)  # [N, 4]
    # NaN scales stay NaN, and `to_gaussians` refuses them.
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(np.clip(rows["scales"], MIN_SCALE, MAX_SCALE))
    # A byte b of a rotation stands for the component (b - 128) / 128.
    columns = GaussianColumns(
        means=rows["means"],
        quats=codes_to_fractions(rows["quats"], 128) - 1,
        log_scales=log_scales,
        opacities=rgba[:, 3],
        srgb=rgba[:, :3],
    )
    return DecodedScene(columns=columns, format="splat")
