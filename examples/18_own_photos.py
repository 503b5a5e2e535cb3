"""Evaluate on photos of your own: a rectified stereo pair, or photos with known poses.

python examples/18_own_photos.py left.png right.png 995 0.193 2 10 results

The numbers are the focal length in pixels; then, in metres, the distance of the two cameras, the
nearest and the farthest depth. Instead of two depths, a scene.json may name a disparity
map or depth maps, which "rgbd" as the base needs. The guide on evaluation lists all keys.
"""

import json
import shutil
import sys
from pathlib import Path

from spackle.bases.settings import BaseSettings
from spackle.paper.evaluation.evaluate import evaluate
from spackle.paper.evaluation.options import EvaluateOptions
from spackle.runtime.progress import Reporter


def main(left: Path, right: Path, *numbers: str) -> None:
    focal_px, baseline_m, nearest_m, farthest_m = map(float, numbers[:4])
    results = Path(numbers[4])
    scene = results / "photos" / "garden"
    scene.mkdir(parents=True)
    shutil.copy(left, scene)
    shutil.copy(right, scene)
    description = {
        "left": left.name,
        "right": right.name,
        "focal_px": focal_px,
        "baseline_m": baseline_m,
        "depth_range": [nearest_m, farthest_m],
    }
    (scene / "scene.json").write_text(json.dumps(description))
    names = {"title": "My garden", "terms": "my photos, CC BY 4.0"}
    (results / "photos" / "about.json").write_text(json.dumps(names))

    options = EvaluateOptions(
        dataset="pairs",
        root=results / "photos",
        protocol="near-view",
        methods=("base", "spackle"),
        metrics=("psnr", "ssim"),
        base=BaseSettings(name="lite"),
    )
    evaluate(options, results / "evaluation", Reporter())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
