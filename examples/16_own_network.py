"""Your own residual network: it names its inputs, and changes the Gaussians that fill a hole.

python examples/16_own_network.py photo.jpg out.mp4

To train and use it on the command line, in the folder of this file:

spackle train --recipe quick -o run data.photos=photos network=16_own_network:SmallNet
spackle predict photo.jpg --residual run/best.safetensors --residual-network 16_own_network:SmallNet

`spackle evaluate` and `spackle bench` take the same two options.
"""

import sys
from pathlib import Path
from typing import cast

from torch import Tensor, nn

import spackle
from spackle.residual import ResidualNet


class SmallNet(ResidualNet):
    """Two convolutions: from a view's inputs [B, 9, h, w] to 14 deltas for each cell of 2×2
    pixels.
    """

    inputs = ("rgb", "alpha", "mask", "initial")  # 3 + 1 + 1 + 4 channels
    local = False

    def __init__(self) -> None:
        super().__init__()
        self.first = nn.Conv2d(9, 32, 3, padding=1)
        self.last = nn.Conv2d(32, 14, 3, padding=1)
        # Without training, the initial Gaussians stay as they are.
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(cast(Tensor, self.last.bias))

    def forward(self, features: Tensor) -> Tensor:
        deltas: Tensor = self.last(self.first(features).relu())
        return deltas


def main(photo: Path, out: Path) -> None:
    prediction = spackle.LiteBase.load().predict(spackle.load_photo(photo))
    base_alone = spackle.complete(prediction, [], fill="none")
    cameras = base_alone.path("swipe", disparity=0.15)
    scene = spackle.complete(prediction, cameras, network=SmallNet())
    scene.save_video(out, "swipe", disparity=0.15)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
