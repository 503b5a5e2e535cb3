"""A base of your own: any class with a name that turns a photo into Gaussians.

python examples/04_own_base.py photo.jpg out

On the command line, in the folder of this file: `--base 04_own_base:Street`, for `spackle predict`,
`dataset build`, `evaluate` and `bench`.
"""

import sys
from collections.abc import Callable
from pathlib import Path

import torch

import spackle
from spackle.bases.depth import lift_rgbd


class Street:
    """Depth from 20 m at the top of the photo to 2 m at the bottom, in place of a network."""

    name = "street"

    def predict(
        self, photo: spackle.Photo, progress: Callable[[int, int], None] | None = None
    ) -> spackle.BasePrediction:
        """Turn the photo into Gaussians."""
        metres = torch.linspace(20, 2, photo.height)[:, None].repeat(1, photo.width)
        depth = spackle.DepthMap(metres, metres > 0, None, None, "depth", photo.path)
        return lift_rgbd(photo.rgb, depth, photo.camera)


def main(photo: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scene = spackle.predict(photo, base=Street(), disparity=0.1)
    scene.save(out / "scene.ply")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
