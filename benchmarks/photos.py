"""Photos without depth, completed by the lite base: a contact sheet to look at.

    python benchmarks/photos.py OUT.png PHOTO... [--disparity 0.3] [--weights FILE] [--side 448]

A row for each photo: the photo, its inverse depth as the network says, the base's Gaussians alone at one end of a swipe
(holes are red), the completed scene there and at the other end.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import torch
from method import colored, ends, sheet
from torch import Tensor
from torch.nn.functional import interpolate

from spackle import get_renderer, hole_area_ratio, hole_mask
from spackle.bases.lite.base import LiteBase
from spackle.formats import save_png
from spackle.image import load_photo, resize_photo
from spackle.render.protocol import Rendering
from spackle.scene import complete, scene_path

RED = torch.tensor([0.85, 0.1, 0.1])
FRAMES = 60


def with_holes(view: Rendering) -> Tensor:
    """A view whose holes are red."""
    return torch.where(hole_mask(view.alpha)[..., None], RED, view.rgb)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("photos", type=Path, nargs="+")
    parser.add_argument("--disparity", type=float, default=0.3)
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--side", type=int, default=448)
    arguments = parser.parse_args()
    base, renderer, rows = LiteBase.load(arguments.weights), get_renderer(), []
    print("| photo | seconds: base | completion | HAR before | after |")
    print("|---|---:|---:|---:|---:|")
    for path in arguments.photos:
        photo = resize_photo(load_photo(path))
        start = time.perf_counter()
        prediction = base.predict(photo)
        lifted = time.perf_counter()
        path_ = scene_path(prediction.gaussians, prediction.camera, "swipe", arguments.disparity, FRAMES)
        scene = complete(prediction, path_, renderer=renderer)
        done = time.perf_counter()
        left, right = path_[0], path_[-1]
        alone = renderer.render(prediction.gaussians, left)
        after = [scene.render(camera, renderer) for camera in (left, right)]
        depth = interpolate(base.inverse_depth(photo.rgb)[None, None], size=photo.rgb.shape[:2], mode="bilinear")[0, 0]
        print(
            f"| {path.stem} | {lifted - start:.2f} | {done - lifted:.2f} | {hole_area_ratio(alone.alpha):.1%} "
            f"| {hole_area_ratio(after[0].alpha):.2%} |",
            flush=True,
        )
        views = [with_holes(alone), *(view.rgb for view in after)]  # their sides are even
        views = [view[: photo.height, : photo.width] for view in views]
        rows.append([photo.rgb, colored(depth, *ends(depth)), *views])
    save_png(sheet(rows, arguments.side), arguments.output)


if __name__ == "__main__":
    main()
