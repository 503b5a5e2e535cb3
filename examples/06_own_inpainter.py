"""Your own inpainter paints the widest views, and the painted colours become Gaussians.

python examples/06_own_inpainter.py photo.jpg out.mp4

On the command line, in the folder of this file, and in training data and evaluations:

spackle predict photo.jpg --fill 06_own_inpainter:MeanColor
spackle dataset build photos -o data --base lite --inpainter 06_own_inpainter:MeanColor
spackle evaluate pairs --dataset pairs --methods inpaint2d --inpainter 06_own_inpainter:MeanColor
"""

import sys
from pathlib import Path

import torch
from torch import Tensor

import spackle
from spackle.inpaint.plain import PlainInpainter


class MeanColor(PlainInpainter):
    """Fills every hole with the mean of the visible colours, in place of a diffusion model."""

    name, version = "mean", "1"

    def paint(self, rgb: Tensor, hole: Tensor, inverse_depth: Tensor) -> Tensor:
        """Fill the holes [V, H, W] of views [V, H, W, 3]."""
        return torch.where(hole[..., None], rgb[~hole].mean(dim=0), rgb)


def main(photo: Path, video: Path) -> None:
    scene = spackle.predict(
        photo, base="lite", fill=f"{__name__}:MeanColor", trajectory="swipe", disparity=0.15
    )
    scene.save_video(video, "swipe")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
