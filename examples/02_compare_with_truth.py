"""How good is what was made up? Complete the view of a second camera that truly took a photo.

python examples/02_compare_with_truth.py OUT
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from torch import Tensor

import spackle
from spackle.bases.lift import lift
from spackle.evaluation.datasets.stereo import load_motorcycle
from spackle.formats import save_gray_png, save_png


def psnr(image: Tensor, truth: Tensor, where: Tensor) -> float:
    """Peak signal-to-noise ratio in dB of images [H, W, 3] in 0..1 over a mask [H, W]."""
    return float(-10 * torch.log10(((image - truth)[where] ** 2).mean()))


def main(folder: Path) -> None:
    """Print a small table, and save the views to look at."""
    folder.mkdir(parents=True, exist_ok=True)
    pair = load_motorcycle()
    prediction = lift(pair.left, pair.depth, pair.left_camera)
    scene = spackle.complete(prediction, [pair.right_camera], exact=True)

    renderer = spackle.get_renderer()
    with torch.no_grad():
        before = renderer.render(scene.base, pair.right_camera)
        after = renderer.render([scene.base, scene.aux], pair.right_camera)
    hole = spackle.hole_mask(before.alpha)

    print(f"holes: {spackle.hole_area_ratio(before.alpha):.1%} -> {spackle.hole_area_ratio(after.alpha):.2%}")
    print("                in the hole   outside")
    for name, image in (("base alone", before.rgb), ("with Spackle", after.rgb)):
        print(f"{name:<15} {psnr(image, pair.right, hole):8.2f} dB {psnr(image, pair.right, ~hole):6.2f} dB")

    pictures = {"1_photo": pair.left, "2_base": before.rgb, "3_spackle": after.rgb, "4_truth": pair.right}
    for name, image in pictures.items():
        save_png(image, folder / f"{name}.png")
    save_gray_png(hole.float(), folder / "hole.png")
    print(f"Look at the pictures in {folder}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "motorcycle"))
