"""How calm the targets of each inpainter are from view to view: `python benchmarks/flicker.py [--side N]`.

A picture of a box before a wall, whose geometry is known exactly, is seen along a path. What the holes uncover is the
wall. Each pixel of a hole is followed, by the wall's true depth, into the next view, and where that is
a hole too, the two targets are compared: mean absolute difference of sRGB, in units of 1/255. The same is done
between the target and the wall's true colour.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from spackle.bases.depth_map import DepthMap
from spackle.bases.lift import lift
from spackle.camera import Camera
from spackle.camera_path import TRAJECTORIES, DepthRange
from spackle.dataset.views import PathChoice, path_cameras, render_views, scene_completion
from spackle.inpaint import InpainterOptions, ViewStack, get_inpainter
from spackle.render import get_renderer
from spackle.residual import Completer

NEAR, FAR = 2.0, 5.0


def pattern(x: Tensor, y: Tensor) -> Tensor:
    """The wall's colour at world coordinates in metres, [..., 3]."""
    waves = [torch.sin(9 * x + 4 * y), torch.sin(7 * y - 2 * x), torch.cos(6 * x + 5 * y)]
    broad = torch.stack([0.15 * torch.sin(0.9 * x), 0.1 * torch.sin(1.3 * y), 0.15 * torch.cos(0.8 * x)], -1)
    return torch.tensor([0.35, 0.45, 0.6]) + 0.1 * torch.stack(waves, -1) + broad


def on_the_wall(camera: Camera) -> Tensor:
    """[H, W, 3] where the view's pixels meet the wall."""
    centers = camera.pixel_centers()
    ray = camera.unproject(centers, torch.ones(centers.shape[:-1])) - camera.position
    return camera.position + ray * ((FAR - camera.position[2]) / ray[..., 2])[..., None]


def scene(side: int) -> tuple[Tensor, DepthMap, Camera]:
    """A photo of the box before the wall, its depth and camera."""
    height, width = side * 3 // 4, side
    camera = Camera.from_focal(0.85 * side, width, height)
    points = on_the_wall(camera)
    box = torch.zeros(height, width, dtype=torch.bool)
    box[height // 4 : height * 3 // 4, width * 3 // 8 : width * 5 // 8] = True
    front = torch.tensor([0.75, 0.3, 0.2]) + 0.1 * torch.sin(20 * points[..., :1])
    depth = torch.where(box, NEAR, FAR)
    rgb = torch.where(box[..., None], front, pattern(points[..., 0], points[..., 1])).clamp(0, 1)
    return rgb, DepthMap(depth, depth > 0, None, None, "depth", Path("wall")), camera


def sample(image: Tensor, uv: Tensor) -> Tensor:
    """Bilinear colours [N, 3] of [H, W, 3] at pixels [N, 2]."""
    size = torch.tensor([image.shape[1], image.shape[0]])
    grid = (2 * uv / size - 1)[None, None]
    return grid_sample(image.permute(2, 0, 1)[None], grid, align_corners=False, padding_mode="border")[0, :, 0].T


def flicker(stack: ViewStack, targets: Tensor, order: list[int]) -> tuple[float, float]:
    """Mean difference between neighbours, and from the truth, in the holes."""
    between, truth, pixels, all_pixels = 0.0, 0.0, 0, 0
    for one, other in itertools.pairwise(order):
        points = on_the_wall(stack.cameras[one])[stack.mask[one]]
        colors = targets[one][stack.mask[one]]
        exact = pattern(points[:, 0], points[:, 1]).clamp(0, 1)
        truth, all_pixels = truth + float((colors - exact).abs().mean(-1).sum()), all_pixels + len(colors)
        uv, _ = stack.cameras[other].project(points)
        inside = sample(stack.mask[other][..., None].float().expand(-1, -1, 3), uv)[:, 0] > 0.999
        height, width = stack.mask.shape[1:]
        inside &= ((uv > 0.5) & (uv < torch.tensor([width, height]) - 0.5)).all(-1)
        if inside.any():
            difference = (colors[inside] - sample(targets[other], uv[inside])).abs().mean(-1)
            between, pixels = between + float(difference.sum()), pixels + int(inside.sum())
    return 255 * between / max(1, pixels), 255 * truth / max(1, all_pixels)


def by_view(stack: ViewStack) -> Tensor:
    """The paper's way of inference, each view completed by itself."""
    renderer = get_renderer()
    completer = Completer(stack.base, stack.photo_camera, renderer)
    shields = [completer.photo_guard()]
    with torch.no_grad():
        drawn = [completer.completed_view(view, shields)[1].rgb for view in stack.cameras]
    return torch.where(stack.mask[..., None], torch.stack(drawn), stack.rgb)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=384, help="pixels along the photo's longer side")
    parser.add_argument("--disparity", type=float, default=0.4)
    options = parser.parse_args()
    rgb, depth, camera = scene(options.side)
    prediction = lift(rgb, depth, camera)
    ways: dict[str, Callable[[ViewStack], Tensor]] = {"complete_view": by_view}
    for name in ("geometry", "opencv", "none"):
        ways[name] = get_inpainter(name, InpainterOptions(complete_scene=scene_completion(get_renderer()))).complete
    print(f"{'path':16}{'holes':>8}", *(f"{name:>24}" for name in ways))
    for kind in TRAJECTORIES:
        path = PathChoice(kind, options.disparity)
        cameras = path_cameras(path, camera, DepthRange.of(prediction.gaussians))
        stack = render_views(prediction.gaussians, camera, cameras, get_renderer())
        order = list(range(1, len(cameras)))
        numbers = [flicker(stack, way(stack), order) for way in ways.values()]
        cells = [f"{a:10.2f} between {b:5.1f} off" if math.isfinite(a) else "-" for a, b in numbers]
        print(f"{kind:16}{float(stack.mask.double().mean()):8.1%}", *cells)


if __name__ == "__main__":
    main()
