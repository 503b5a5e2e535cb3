"""How clean the outlines of a lifted photo are from beside: on stereo pairs, and on made scenes with exact geometry.

    python benchmarks/silhouettes.py [PAIRS] [--scenes WORD,...] [--made WORD,...] [--small N] [-o FOLDER]

PAIRS holds one folder a scene, see `spackle.training.sources.load_pair`. The left photo is lifted by its true depth:
- band: PSNR of the right camera's view against the right photo within 8 pixels of the holes, without them.
- elsewhere: outside of the band and the holes.
- photo: PSNR at the photo's own camera against the photo.
- Gaussians: of the base, in thousands; s: seconds of the lift, the best of three.

Made scenes (`SCENES`: poles, pipes, balls, leaves, boards before a wall, all reddish before a greenish one) have
antialiased photos and a depth for each pixel's centre. One view of each of the four trajectories at disparity 0.3 and
at 0.5 is completed by the seeds and compared with the ray-traced truth, where the photo shows what is there or hides
it (--made none leaves them out):
- band, photo: as above, of the base alone.
- ghost: of the wall's pixels that the things hid in the photo, or that lay within 3 pixels of them, the share whose
  colour is nearer to the things' than to the wall's there.
- spike: share of the wall's pixels, at least 2 from any thing, that show a depth nearer than the middle between them.

Both are per mille of the pixels that the base covers; "filled" ones are of its holes, and the seeds' doing. --small N
gives the lift maps of a side N times smaller, as networks do, those of pairs in 256 steps of inverse depth, as phones
do. -o FOLDER gets pictures: completed view above, truth below.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from spackle import Camera, Rendering, get_renderer, hole_mask
from spackle.bases.depth_map import DepthMap
from spackle.bases.lift import lift
from spackle.bases.protocol import BasePrediction
from spackle.camera_path import DepthRange, TrajectoryKind, view_at
from spackle.color import linear_to_srgb
from spackle.scene import complete
from spackle.training.losses import dilate, hole_psnr
from spackle.training.sources import load_pair

sys.path.insert(0, str(Path(__file__).parents[1] / "research/lite"))
from ray_tracer import BOX, CYLINDER, ELLIPSOID, SHEET, Solid, trace

BAND_PX = 8
WIDTH, HEIGHT, FOCAL = 480, 360, 420.0
RAYS = 3  # along a pixel's side; odd
DISPARITIES = (0.3, 0.5)
FRAMES = 9
VIEWS: dict[TrajectoryKind, int] = {"swipe": 0, "shake": 7, "rotate": 3, "rotate-forward": 2}  # left, up, both, right
RIM_PX, CLEAR_PX = 3, 2
THING, WALL = (0.62, 0.22, 0.14), (0.45, 0.66, 0.52)  # linear RGB, about which the textures vary
RENDERER = get_renderer()


def bands(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Where a view of this opacity [H, W] has the band around its holes, and neither band nor hole."""
    hole = hole_mask(alpha)
    near = dilate(hole[None], 2 * BAND_PX + 1)[0]
    return near & ~hole, ~near


def timed_lift(rgb: Tensor, depth: DepthMap, camera: Camera) -> tuple[BasePrediction, dict[str, float]]:
    """The base of a photo, and its own numbers."""
    seconds = []
    for _ in range(3):
        began = time.perf_counter()
        base = lift(rgb, depth, camera)
        seconds.append(time.perf_counter() - began)
    everywhere = torch.ones(rgb.shape[:2], dtype=torch.bool)
    photo = hole_psnr(RENDERER.render(base.gaussians, camera).rgb, rgb, everywhere)
    return base, {"photo": photo, "Gaussians": len(base.gaussians) / 1000, "s": min(seconds)}


def measure_pair(folder: Path, times: int, output: Path | None) -> dict[str, float]:
    """Of a stereo pair."""
    left, right, depth, camera, beside = load_pair(folder)
    if times > 1:
        depth = as_phones_do(RENDERER.render(lift(left, depth, camera).gaussians, camera).depth, times, depth)
    base, numbers = timed_lift(left, depth, camera)
    view = RENDERER.render(base.gaussians, beside)
    psnr = [hole_psnr(view.rgb, right, part) for part in bands(view.alpha)]
    if output:
        save(torch.cat([view.rgb, right], dim=1), output / f"{folder.name}.png")
    return dict(zip(("band", "elsewhere"), psnr, strict=True)) | numbers


@dataclasses.dataclass(frozen=True)
class Truth:
    """A made scene as a camera sees it."""

    rgb: Tensor  # [H, W, 3] sRGB
    cover: Tensor  # [H, W] share of a pixel that the things cover
    things: Tensor  # [H, W, 3] linear RGB of the things; 0 where there are none
    wall: Tensor  # [H, W, 3] linear RGB of the wall, also behind the things
    depth: Tensor  # [H, W] z of whatever the pixel's centre shows
    behind: Tensor  # [H, W] z of the wall there


class MadeScene:
    """Things before a wall, and their pictures."""

    def __init__(self, things: list[Solid], seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.skins = np.stack([skin(rng, THING), skin(rng, WALL), skin(rng, THING, leaves=True)])
        lean = turn(0.25) @ np.diag([9.0, 7.0, 1.0])
        self.layers = (things, [Solid(SHEET, place(0, 0, 4.5), lean.astype(np.float32), 1, (5.0, 4.0))])
        self.camera = Camera.from_focal(FOCAL, WIDTH, HEIGHT)

    def see(self, camera: Camera) -> Truth:
        """Ray-trace a view."""
        steps = (torch.arange(RAYS * WIDTH) + 0.5) / RAYS, (torch.arange(RAYS * HEIGHT) + 0.5) / RAYS
        colors, near = zip(*(self._layer(solids, camera, *steps) for solids in self.layers), strict=True)
        hit = (near[0] < near[1])[..., None].float()
        things, cover, wall = pooled(colors[0] * hit), pooled(hit), pooled(colors[1])
        mixed = things + pooled(colors[1] * (1 - hit))
        centers = torch.arange(WIDTH) + 0.5, torch.arange(HEIGHT) + 0.5
        _, depth = zip(*(self._layer(solids, camera, *centers) for solids in self.layers), strict=True)
        own = things / cover.clamp_min(1e-6)
        return Truth(linear_to_srgb(mixed), cover[..., 0], own, wall, torch.minimum(*depth), depth[1])

    def _layer(self, solids: Sequence[Solid], camera: Camera, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Colours [H, W, 3] and z [H, W] of the nearest of some solids, inf where there is none."""
        world = camera.world_to_camera.double().numpy()
        seen = [
            dataclasses.replace(
                s,
                center=(world[:3, :3] @ s.center + world[:3, 3]).astype(np.float32),
                axes=(world[:3, :3] @ s.axes).astype(np.float32),
            )
            for s in solids
        ]
        y, x = torch.meshgrid((v - camera.K[1, 2]) / FOCAL, (u - camera.K[0, 2]) / FOCAL, indexing="ij")
        rays = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).float().numpy()
        light = (world[:3, :3] @ np.array([-0.4, -0.7, -0.6])).astype(np.float32)
        found = trace(seen, self.skins, rays, light / np.linalg.norm(light), 0.6, np.zeros_like(rays))
        return torch.from_numpy(found[0]).reshape(*x.shape, 3), torch.from_numpy(found[1]).reshape(x.shape)


def pooled(samples: Tensor) -> Tensor:
    """[R·H, R·W, C] to [H, W, C], by a tent as wide as two pixels: about what a lens and a sensor do."""
    tent = 1 - (torch.arange(2 * RAYS - 1) + 1.0 - RAYS).abs() / RAYS
    kernel = (tent / tent.sum()).expand(samples.shape[-1], 1, 1, -1)
    grid = F.pad(samples.movedim(-1, 0)[None], (RAYS // 2,) * 4, mode="replicate")
    grid = F.conv2d(grid, kernel, stride=(1, RAYS), groups=samples.shape[-1])
    return F.conv2d(grid, kernel.transpose(2, 3), stride=(RAYS, 1), groups=samples.shape[-1])[0].movedim(0, -1)


def skin(rng: np.random.Generator, color: Sequence[float], leaves: bool = False, side: int = 256) -> np.ndarray:
    """[S, S, 4] linear RGB that varies about a colour, and coverage; of leaves: ovals with gaps between them."""
    picture = torch.zeros(1, 3, side, side)
    for cells, share in ((4, 0.3), (16, 0.35), (64, 0.35)):
        noise = torch.from_numpy(rng.uniform(-1, 1, (1, 3, cells, cells)).astype(np.float32))
        noise = 0.8 * noise.mean(1, keepdim=True) + 0.2 * noise
        picture += share * F.interpolate(noise, (side, side), mode="bicubic", align_corners=False)
    picture = torch.tensor(color)[:, None, None] * (1 + 0.9 * picture[0])
    coverage = torch.full((1, side, side), 0.0 if leaves else 1.0)
    y, x = torch.meshgrid(torch.arange(side) / side, torch.arange(side) / side, indexing="ij")
    for cx, cy, way in rng.uniform(0, 1, (22, 3)) if leaves else ():
        across, along = (x - cx) * math.cos(6 * way) + (y - cy) * math.sin(6 * way), 0.0
        along = (y - cy) * math.cos(6 * way) - (x - cx) * math.sin(6 * way)
        coverage[0][(across / 0.035) ** 2 + (along / 0.11) ** 2 < 1] = 1.0
    return torch.cat([picture.clamp(0.02, 1), coverage]).movedim(0, -1).contiguous().numpy()


def turn(yaw: float, roll: float = 0.0) -> np.ndarray:
    """[3, 3] around the vertical, after a roll in the picture."""
    c, s, a, b = math.cos(yaw), math.sin(yaw), math.cos(roll), math.sin(roll)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.array([[a, -b, 0], [b, a, 0], [0, 0, 1]])


def place(x: float, y: float, z: float) -> np.ndarray:
    """[3] of pixels from the photo's middle, and metres away."""
    return np.array([x * z / FOCAL, y * z / FOCAL, z], np.float32)


Floats3 = Sequence[float]


def thing(kind: int, at: Floats3, size: Floats3, yaw: float = 0, roll: float = 0, skin: int = 0) -> Solid:
    """A solid at (x, y, z), see `place`, of half lengths in pixels as seen from there."""
    axes = turn(yaw, roll) @ np.diag(np.array(size) * at[2] / FOCAL)
    return Solid(kind, place(*at), axes.astype(np.float32), skin, (1.0, 1.0), casts=False)


QUARTER = math.pi / 2
SCENES: dict[str, list[Solid]] = {
    "poles": [
        thing(CYLINDER, (x, 0, z), (w, 400, w), 0, roll)
        for x, z, w, roll in (
            (-190, 1.6, 2.5, 0.05), (-110, 2.2, 5, -0.1), (-20, 1.8, 1.2, 0), (70, 2, 8, 0.2), (170, 2.6, 1.8, -0.4),
        )
    ],
    "pipes": [
        thing(CYLINDER, (0, y, z), (w, 400, w), 0, QUARTER + roll)
        for y, z, w, roll in ((-130, 2.6, 14, 0.06), (-60, 1.8, 22, -0.1), (30, 2.1, 9, 0.3), (120, 1.6, 30, 0.02))
    ],
    "balls": [
        thing(ELLIPSOID, at, (w, w, w))
        for *at, w in (
            (-150, -70, 1.8, 55), (0, 60, 1.5, 70), (60, -110, 2.4, 30), (160, 20, 2.1, 60), (-150, 100, 2.6, 24),
        )
    ],
    "leaves": [
        thing(SHEET, at, (90, 90, 1), yaw, roll, skin=2)
        for at, yaw, roll in (((-140, -60, 1.7), 0.3, 0.2), ((20, 70, 2.0), -0.5, 1.0), ((150, -70, 2.4), 0.2, -0.6))
    ],
    "boards": [
        thing(kind, at, size, yaw, roll)
        for kind, at, size, yaw, roll in (
            (SHEET, (-150, -20, 1.9), (70, 110, 1), 1.0, 0.1),
            (BOX, (0, 60, 1.7), (40, 55, 30), 0.7, 0.0),
            (SHEET, (60, -110, 2.3), (60, 40, 1), -0.9, 0.4),
            (BOX, (170, 40, 2.2), (25, 90, 25), -0.5, 0.15),
        )
    ],
}  # fmt: skip


def small(depth: Tensor, times: int) -> Tensor:
    """A map of a side so many times smaller, each pixel the mean inverse depth of those that it covers."""
    return 1 / F.avg_pool2d(1 / depth[None], times)[0]


def as_phones_do(depth: Tensor, times: int, stored: DepthMap) -> DepthMap:
    """A portrait photo's map: without gaps, a side so many times smaller, 256 steps of inverse depth."""
    inverse = 1 / small(depth, times)
    step = float(inverse.max() - inverse.min()) / 255
    inverse = inverse.min() + ((inverse - inverse.min()) / step).round() * step
    valid = torch.ones_like(inverse, dtype=torch.bool)
    return dataclasses.replace(stored, depth=1 / inverse, valid=valid, K=None, quantum=step, quantity="disparity")


def measure_made(name: str, times: int, output: Path | None) -> dict[str, float]:
    """Of a made scene."""
    scene = MadeScene(SCENES[name], list(SCENES).index(name))
    truth = scene.see(scene.camera)
    depth = small(truth.depth, times)
    given = DepthMap(depth, torch.ones_like(depth, dtype=torch.bool), None, None, "depth", Path(name))
    base, numbers = timed_lift(truth.rgb, given, scene.camera)
    reach, found = DepthRange.of(base.gaussians), []
    for disparity in DISPARITIES:
        views = [view_at(kind, scene.camera, disparity, reach, n, FRAMES) for kind, n in VIEWS.items()]
        whole = complete(base, views, exact=True, network=None, fill="network")
        for number, camera in enumerate(views):
            new, before, view = scene.see(camera), RENDERER.render(base.gaussians, camera), whole.render(camera)
            band = hole_psnr(before.rgb, new.rgb, bands(before.alpha)[0])
            hole = hole_mask(before.alpha)
            parts = (artefacts(truth, scene.camera, new, camera, view, part) for part in (~hole, hole))
            found.append([band, *(number for part in parts for number in part)])
            if output:
                save(torch.cat([view.rgb, new.rgb]), output / f"{name}-{disparity}-{number}.png")
    band, *counts = np.array(found).T
    shares = [1000 * part.sum() / whole.sum() for part, whole in zip(counts[::2], counts[1::2], strict=True)]
    names = ("ghost", "spike", "ghost filled", "spike filled")
    return {"band": band.mean()} | dict(zip(names, shares, strict=True)) | numbers


def artefacts(photo: Truth, own: Camera, truth: Truth, camera: Camera, view: Rendering, part: Tensor) -> list[float]:
    """Numbers of ghost pixels and of the strip where they can be, of spike pixels and of the wall's; in a part."""
    rgb, wall = view.rgb, (truth.cover == 0) & part
    uv, _ = own.project(camera.unproject(camera.pixel_centers(), truth.behind))
    grid = (uv / torch.tensor([WIDTH, HEIGHT]) * 2 - 1)[None].float()
    rim = dilate(photo.cover[None] > 0, 2 * RIM_PX + 1)[None].float()
    wall &= (grid[0].abs() < 1).all(-1)
    strip = wall & (F.grid_sample(rim, grid, align_corners=False)[0, 0] > 0.5)
    color = linear_to_srgb((truth.things * truth.cover[..., None]).sum((0, 1)) / truth.cover.sum())
    ghost = strip & ((rgb - color).abs().sum(-1) < (rgb - linear_to_srgb(truth.wall)).abs().sum(-1))
    clear = wall & ~dilate(truth.cover[None] > 0, 2 * CLEAR_PX + 1)[0]
    nearest = 1 / truth.depth[truth.cover > 0.99].quantile(0.98)
    spike = clear & (1 / view.depth.clamp_min(1e-6) > (nearest + 1 / truth.behind) / 2)
    return [float(part.sum()) for part in (ghost, strip, spike, clear)]


def save(rgb: Tensor, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * rgb.clamp(0, 1)).round().byte().numpy()).save(path)


def table(title: str, names: Sequence[str], measure: Callable[[str], dict[str, float]]) -> None:
    """Markdown, each row as soon as it is there, and the mean of each column."""
    rows: list[dict[str, float]] = []
    for name in names:
        rows.append(measure(name))
        if len(rows) == 1:
            print(f"\n| {title} | {' | '.join(rows[0])} |\n|---{'|---' * len(rows[0])}|")
        print(f"| {name} | {' | '.join(f'{v:.2f}' for v in rows[-1].values())} |", flush=True)
    print(f"| mean | {' | '.join(f'{np.mean([row[k] for row in rows]):.2f}' for k in rows[0])} |", flush=True)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", metavar="PAIRS")
    parser.add_argument("--scenes", default="", help="words, one of which a pair's name has to have")
    parser.add_argument("--made", default="", help="words, one of which a made scene's name has to have")
    parser.add_argument("--small", type=int, default=1, help="how many times smaller a side of the depth maps is")
    parser.add_argument("-o", "--output", type=Path, help="a folder for pictures")
    chosen = parser.parse_args()
    if chosen.folder:
        pairs = {path.parent.name: path.parent for path in sorted(chosen.folder.glob("*/scene.json"))}
        names = [name for name in pairs if any(word in name for word in chosen.scenes.split(","))]
        if not names:
            parser.error(f"{chosen.folder}: no folder with a scene.json in it")
        table("pair", names, lambda name: measure_pair(pairs[name], chosen.small, chosen.output))
    names = [name for name in SCENES if any(word in name for word in chosen.made.split(","))]
    if names:
        table("made", names, lambda name: measure_made(name, chosen.small, chosen.output))


if __name__ == "__main__":
    main()
