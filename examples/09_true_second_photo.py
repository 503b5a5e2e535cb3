"""Compare a completed view with a photo that a second camera took from the same position.

python examples/09_true_second_photo.py out

The pair is Middlebury's Motorcycle, which comes with scikit-image: pip install 'spackle-nvs[demo]'.
"""

import sys
from pathlib import Path

import spackle
from spackle.bases.depth import lift_rgbd
from spackle.formats import save_png
from spackle.paper.evaluation.datasets.stereo import load_motorcycle
from spackle.paper.evaluation.metrics import psnr


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    pair = load_motorcycle()
    prediction = lift_rgbd(pair.left, pair.depth, pair.left_camera)
    scene = spackle.complete(prediction, [pair.right_camera], exact=True)

    before = spackle.get_renderer().render(scene.base, pair.right_camera)
    after = scene.render(pair.right_camera)
    hole = spackle.hole_mask(before.alpha)
    print(
        f"holes: {spackle.hole_area_ratio(before.alpha):.1%} -> "
        f"{spackle.hole_area_ratio(after.alpha):.2%}"
    )
    for name, view in (("base", before.rgb), ("completed", after.rgb)):
        inside, outside = psnr(view, pair.right, hole), psnr(view, pair.right, ~hole)
        print(f"{name}: {inside:.2f} dB in the hole, {outside:.2f} dB outside")
        save_png(view, out / f"{name}.png")
    save_png(pair.right, out / "truth.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
