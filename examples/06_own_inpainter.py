"""Your own inpainter paints the widest views, and the painted colours become Gaussians.

python examples/06_own_inpainter.py photo.jpg out
"""

import sys
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

import spackle
from spackle.inpaint.plain import PlainInpainter
from spackle.scene_fill.texture import painted_texture


class MeanColor(PlainInpainter):
    """Fills every hole with the mean of the visible colours, in place of a diffusion model."""

    name, version = "mean", "1"

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Fill the holes [V, H, W] of views [V, H, W, 3]."""
        return torch.where(hole[..., None], rgb[~hole].mean(dim=0), rgb)


def main(photo: Path, out: Path) -> None:
    prediction = spackle.LiteBase.load().predict(spackle.load_photo(photo))
    scene = spackle.Scene(
        prediction.gaussians, prediction.gaussians.select(slice(0)), prediction.camera
    )
    texture = partial(painted_texture, MeanColor())
    context = spackle.FillContext(scene.base, scene.camera, spackle.get_renderer(), texture=texture)
    filled = spackle.fill_scene(context, scene.path("swipe", disparity=0.15))
    spackle.Scene(scene.base, filled.aux, scene.camera, disparity=0.15).save_video(out, "swipe")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
