"""A scene from a photo and its depth map.

python examples/02_depth_map.py photo.png depth.png out
"""

import sys
from pathlib import Path

import numpy as np

import spackle


def main(photo: Path, depth: Path, out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    scene = spackle.predict(photo, depth, fov=60, disparity=0.2)  # a 16-bit PNG has millimetres
    scene.save(out / "scene.ply")

    # The depth can also be an array or a tensor [H, W] in metres; 0 and NaN mean unknown.
    metres = scene.depth_map().numpy()
    again = spackle.predict(photo, np.where(metres > 0, metres, np.nan), fov=60, disparity=0.2)
    print(
        f"{len(scene.base):,} Gaussians from the file, {len(again.base):,} from the scene's own "
        f"depth"
    )


if __name__ == "__main__":
    main(*(Path(word) for word in sys.argv[1:4]))
