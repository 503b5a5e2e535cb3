"""Measure the flicker in a clip's holes: `python benchmarks/clip.py [--side N] [--frames N]` (needs
scikit-image).

A camera moves through the Middlebury Motorcycle scene, in front of which a painted board stands or
passes by. The scene's geometry is known, so each frame has its depth, and each completed view has a
true view with the true motion of everything that the board hid. A hole's pixel, followed by that
motion into the previous view, should have the same
colour there: its flicker is the mean absolute difference in sRGB. "Alone" completes each frame by
itself, "carried" is what `spackle predict` renders. "Seen" is the same figure for visible pixels, a
lower bound. All are in units of 1/255. The method uses its own optical flow; the true motion and
the true views serve for the measurement only.
"""

from __future__ import annotations

import argparse
import collections
import dataclasses
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from spackle.bases.depth import lift_rgbd
from spackle.cli.script_command import run_script
from spackle.clips.complete import ClipCompleter, CompletedView
from spackle.clips.flow import inside, pixel_grid, sample
from spackle.core.camera import Camera
from spackle.core.color import srgb_to_linear
from spackle.core.gaussians import Gaussians
from spackle.core.surfels import make_surfels
from spackle.depth.depth_map import DepthMap
from spackle.inpaint.plain import OpenCV
from spackle.paper.evaluation.datasets.stereo import load_motorcycle
from spackle.render import get_renderer
from spackle.render.protocol import Rendering
from spackle.residual.architectures import shipped_network
from spackle.runtime.errors import InputError
from spackle.scene_fill import FillContext, fill_scene

BOARD_M, FOCUS_M = 1.5, 3.0
DISPARITY = 0.3
PATH = 4  # the clip is the beginning of a camera path this many times as long
Truth = tuple[Camera, Rendering]
Sums = dict[str, list[Tensor]]  # for each figure, its pixels in each frame
SAME_DEPTH = 0.02  # relative difference of depth up to which two views see the same surface
# Simulated errors of a depth network, which vary between frames: scale, shift (over the median),
# waves.
SCALE_NOISE, SHIFT_NOISE, WAVE_NOISE = 0.05, 0.02, 0.01


class World(NamedTuple):
    """The scene of a clip."""

    still: Gaussians
    board: Gaussians  # at its position in the first frame
    camera: Camera


Eye = tuple[float, float, float]
CLIPS: dict[
    str, tuple[Eye, float]
] = {  # in metres: where the camera ends, how far the board moves right
    "pan past a board": ((0.20, 0.0, 0.0), 0.0),
    "walk towards it": ((0.0, 0.0, 0.25), 0.0),
    "a board passes": ((0.0, 0.0, 0.0), 0.40),
    "both move": ((-0.10, 0.03, 0.1), 0.25),
}


def load_world(side: int) -> World:
    """Motorcycle's left photo, `side` pixels wide, completed for cameras all around; and the
    board.
    """
    from skimage.transform import resize

    pair = load_motorcycle()
    step = pair.left.shape[1] / side
    height = round(pair.left.shape[0] / step)
    left = (255 * pair.left).round().byte().numpy()
    rgb = torch.from_numpy(resize(left, (height, side), anti_aliasing=True)).float()
    rows, columns = (((torch.arange(n) + 0.5) * step).long() for n in (height, side))
    camera = Camera.from_focal(float(pair.left_camera.focal[0]) / step, side, height)
    still = lift_rgbd(rgb, depth_map(pair.depth.depth[rows][:, columns]), camera).gaussians
    around = [
        moved(camera, (x, y, z)) for x in (-0.8, 0.8, 0.0) for y in (-0.8, 0.4) for z in (-0.4, 0.4)
    ]
    aux = fill_scene(FillContext(still, camera, get_renderer()), around, exact=True).aux
    return World(Gaussians.cat([still, aux]), board(camera), camera)


def depth_map(depth: Tensor) -> DepthMap:
    """A depth map from depth [H, W] in metres, where 0 means unknown."""
    return DepthMap(depth, depth > 0, None, None, "depth", Path("clip"))


def board(camera: Camera) -> Gaussians:
    """A board in the left half of the picture, painted with stripes."""
    height, width = camera.height, camera.width
    uv = camera.pixel_centers()[height // 4 : height * 3 // 4, width // 5 : width * 2 // 5].reshape(
        -1, 2
    )
    x, y = (uv / width).unbind(-1)
    paint = [
        0.7 + 0.2 * torch.sin(90 * x),
        0.35 + 0.2 * torch.sin(60 * y),
        0.25 + 0.1 * torch.sin(70 * (x + y)),
    ]
    flat = torch.full((len(uv),), 1 / BOARD_M)
    colors = srgb_to_linear(torch.stack(paint, -1))
    return make_surfels(
        camera, uv, flat, torch.zeros(len(uv), 2), 0.7, colors, torch.full((len(uv),), 0.99)
    )


def moved(camera: Camera, eye: Eye) -> Camera:
    """The camera at another position, looking at the same point."""
    return camera.looking(torch.tensor(eye), torch.tensor([0.0, 0.0, FOCUS_M]))


def said_depth(depth: Tensor, dice: torch.Generator) -> Tensor:
    """True depth [H, W] with errors like a network's: another scale, shift and dents in each
    frame.
    """
    rolls = torch.randn(2, generator=dice)
    waves = torch.randn(1, 1, 4, 6, generator=dice)
    waves = torch.nn.functional.interpolate(waves, size=depth.shape, mode="bicubic")[0, 0]
    inverse = (1 / depth) * (SCALE_NOISE * rolls[0] + WAVE_NOISE * waves).exp()
    return 1 / (inverse + SHIFT_NOISE * float(inverse.median()) * rolls[1]).clamp_min(
        0.1 * float(inverse.median())
    )


def play(
    world: World, clip: str, frames: int, noisy: bool, steady: bool
) -> Iterator[tuple[CompletedView, Truth]]:
    """Yield each frame's completed view and true view."""
    renderer, dice = get_renderer(), torch.Generator().manual_seed(0)
    path, flow, network = PATH * frames, OpenCV("this").flow, shipped_network()
    completer = ClipCompleter(
        trajectory="rotate",
        disparity=DISPARITY,
        frame_count=path,
        renderer=renderer,
        flow=flow,
        align=steady,
        network=network,
    )
    for index in range(frames):
        part, ((x, y, z), board_m) = index / max(1, frames - 1), CLIPS[clip]
        shift = torch.eye(4)
        shift[0, 3] = board_m * part
        scene, camera = (
            [world.still, world.board.transform(shift)],
            moved(world.camera, (part * x, part * y, part * z)),
        )
        taken = renderer.render(scene, camera)
        depth = said_depth(taken.depth, dice) if noisy else taken.depth
        own = dataclasses.replace(camera, world_to_camera=torch.eye(4))
        drawn = completer.add(taken.rgb, lift_rgbd(taken.rgb, depth_map(depth), own))
        pose = drawn.camera.world_to_camera @ camera.world_to_camera
        truth = dataclasses.replace(drawn.camera, world_to_camera=pose)
        yield drawn, (truth, renderer.render(scene, truth))


def true_flow(now: Truth, was: Truth) -> tuple[Tensor, Tensor]:
    """Flow [H, W, 2] of static surfaces from a true view to the previous one; [H, W] bool: where
    both see the same.
    """
    (camera, view), (camera_before, before) = now, was
    grid = pixel_grid(view.depth)
    uv, z = camera_before.project(camera.unproject(grid, view.depth))
    seen = sample(before.depth[..., None], uv)[..., 0]
    return uv - grid, ((seen / z - 1).abs() < SAME_DEPTH) & (view.alpha > 0.99)


def mean(parts: list[Tensor]) -> float:
    """The mean over all pixels of all frames."""
    return float(torch.cat([part.flatten().double() for part in parts]).mean())


def judge(world: World, clip: str, frames: int, noisy: bool) -> Sums:
    """Measure a clip completed both ways, "carried" and "alone"."""
    sums: Sums = collections.defaultdict(list)
    past: dict[str, tuple[CompletedView, Truth]] = {}
    # Exact depth needs no alignment between frames, so one run gives both.
    steady = [noisy, False] if noisy else [False]
    for runs in zip(*(play(world, clip, frames, noisy, way) for way in steady), strict=True):
        now = {"carried": runs[0], "alone": runs[-1]}
        sums["holes"].append(runs[0][0].hole)
        for name, (drawn, (_, truth)) in now.items():
            view = drawn.independent_rendering if name == "alone" else drawn.rendering
            sums[f"{name} off"].append(
                (view.rgb - truth.rgb)[drawn.hole & (truth.alpha > 0.99)].square()
            )
            if past:
                compare(sums, name, now[name], past[name])
        past = now
    return sums


def flicker(view: Tensor, earlier: Tensor, flow: Tensor, chosen: Tensor) -> float | None:
    """Mean absolute sRGB difference between a view [H, W, 3] and an earlier view warped by the flow
    [H, W, 2].

    The mean is over the pixels `chosen` [H, W]; None if there are none.
    """
    uv = pixel_grid(flow) + flow
    chosen = chosen & inside(uv, *chosen.shape)
    return (
        float((view - sample(earlier, uv)).abs().mean(-1)[chosen].mean())
        if bool(chosen.any())
        else None
    )


def compare(
    sums: Sums, name: str, now: tuple[CompletedView, Truth], was: tuple[CompletedView, Truth]
) -> None:
    """Add the flicker of a view's holes and of its visible pixels to `sums`."""
    (drawn, truth), (earlier, before) = now, was
    flow, same = true_flow(truth, before)
    held = sample(earlier.hole[..., None].float(), pixel_grid(flow) + flow)[..., 0]
    view, view_before = (
        d.independent_rendering if name == "alone" else d.rendering for d in (drawn, earlier)
    )
    for kind, chosen in (
        ("hole", drawn.hole & (held > 0.999)),
        ("seen", ~drawn.hole & (held < 0.001)),
    ):
        value = flicker(view.rgb, view_before.rgb, flow, chosen & same)
        if value is not None:
            sums[f"{name} {kind}"].append(torch.full((int((chosen & same).sum()),), 255 * value))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--side", type=int, default=384, help="pixels along the frame's longer side"
    )
    parser.add_argument("--frames", type=int, default=24)
    options = parser.parse_args()
    for name in ("side", "frames"):
        if getattr(options, name) < 1:
            raise InputError(f"--{name} {getattr(options, name)}: must be at least 1")
    world = load_world(options.side)
    # PSNR in the holes
    heads = (
        "depth",
        "holes",
        "seen",
        "alone",
        "carried",
        "ratio",
        "alone dB",
        "carried dB",
    )
    print(f"{'clip':18}", *(f"{head:>10}" for head in heads))
    for noisy in (False, True):
        for clip in CLIPS:
            sums = judge(world, clip, options.frames, noisy)
            alone, carried = mean(sums["alone hole"]), mean(sums["carried hole"])
            figures: tuple[float, ...] = (
                mean(sums["carried seen"]),
                alone,
                carried,
                carried / alone,
            )
            figures += tuple(
                -10 * math.log10(mean(sums[f"{name} off"])) for name in ("alone", "carried")
            )
            cells = [
                "noisy" if noisy else "exact",
                f"{mean(sums['holes']):.1%}",
                *(f"{value:.2f}" for value in figures),
            ]
            print(f"{clip:18}", *(f"{cell:>10}" for cell in cells), flush=True)


if __name__ == "__main__":
    sys.exit(run_script(main))
