"""Your own residual network: it names its inputs, and changes the Gaussians that fill a hole.

python examples/16_own_network.py photo.jpg out.mp4

To train it, put the class into a module of yours, and give its name to a recipe:
spackle train --recipe cpu -o run network=my_package.my_module:SmallNet
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

    name = "my_package.my_module:SmallNet"
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
