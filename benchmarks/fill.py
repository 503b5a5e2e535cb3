"""What fills holes, measured on stereo pairs: right views against the true right photo, wide views by themselves.

    python benchmarks/fill.py PAIRS --features squeezenet_v1.0.npz [--niqe niqe_pris_params.npz] [--fills A,B,...]
        [--scenes WORD,...] [--per-scene] [-o FOLDER]

PAIRS holds one folder a scene: a left and a right photo, a disparity map and a `scene.json` (see
`spackle.training.sources.load_pair`). The left photo is lifted by its true depth, and each fill of `FILLS`, or of a
file of residual weights (a name that ends in .safetensors), completes the right camera's view and two paths. A Markdown
row a fill has means over the scenes, medians of the seconds. -o FOLDER gets pictures of each scene side by side: holes,
each fill, truth.

In the right camera's view; the hole is where the base's opacity is below 0.95 (HAR: its share of the view):
- distance: SqueezeNet 1.0 at conv1, fire3, fire5 and fire9; outside of the hole the view is replaced by the truth; mean
  over the layers of the squared difference of unit feature vectors, cells weighted by the share that is hole. 0 to 2.
- texture: Gram matrices of the same vectors with the same weights; the Frobenius norm of their difference over that of
  the truth's, mean over the layers.
- sharpness: mean magnitude of the grey gradient (central differences) over the truth's, in the hole eroded by 3 pixels.
- PSNR in the hole; outside, as the change against the base; and of the completed scene against the base at the photo's
  camera. HAR: after / before.

At the ends (farthest to both sides) of `swipe` and `rotate-forward` of 60 frames at disparity 0.3, as one scene:
- border: where two neighbours in a row lie on either side of the photo's left or right border, or two in a column of
  the top or bottom one, by the depth of the seeds' completion, without a step of depth (5 %) between them: the mean
  grey difference across within 2 pixels to either side, over that of 3 to 20 pixels beside it.
- NIQE of these views, over the photo's (/ photo) and over that of the base's view at the photo's camera with both sides
  made even (/ render): resampling alone costs something that no fill gets back. Means over scenes before the ratio.
- flicker: mean difference in 255ths between each fifth frame of rotate-forward and the next, followed by the
  fill's depth, where both show the same (2 %) and the base has a hole.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from spackle import Camera, Rendering, get_renderer, hole_area_ratio, hole_mask
from spackle.bases.lift import lift
from spackle.bases.protocol import BasePrediction
from spackle.evaluation.metrics import GREY, sharpness
from spackle.evaluation.niqe import NiqeModel, load_niqe, niqe
from spackle.inpaint.opencv import RADIUS, OpenCV
from spackle.residual.network import load_residual
from spackle.scene import complete, scene_path
from spackle.training.features import FeatureNet, load_features
from spackle.training.losses import covered, hole_psnr
from spackle.training.sources import load_pair

Draw = Callable[[Camera], Rendering]
Fill = Callable[[BasePrediction, Sequence[Camera], bool], Draw]  # the last: the views are these and none between them

RENDERER = get_renderer()
DISPARITY, FRAMES = 0.3, 60
LAYERS = ("conv1", "fire3", "fire5", "fire9")
NEAR, BESIDE, STEP = 2, 20, 0.05  # pixels; relative
PAIRS, SAME = range(0, FRAMES - 1, 5), 0.02
SECONDS, NIQE = ("s a view", "s a path"), ("NIQE", "NIQE photo", "NIQE render")


def base_alone(prediction: BasePrediction, cameras: Sequence[Camera], exact: bool) -> Draw:
    return lambda camera: RENDERER.render(prediction.gaussians, camera)


def telea(prediction: BasePrediction, cameras: Sequence[Camera], exact: bool) -> Draw:
    """Each view by itself, in 2D."""

    def draw(camera: Camera) -> Rendering:
        view = RENDERER.render(prediction.gaussians, camera)
        filled = OpenCV("fill opencv:").inpaint(view.rgb, hole_mask(view.alpha), RADIUS)
        return Rendering(filled, view.depth, torch.ones_like(view.alpha))

    return draw


def completed(prediction: BasePrediction, cameras: Sequence[Camera], exact: bool, **choices: Any) -> Draw:
    """The scene of these views."""
    return complete(prediction, cameras, exact=exact, **choices).render


FILLS: dict[str, Fill] = {
    "none": base_alone,
    "seeds": lambda *view: completed(*view, network=None, fill="network"),
    "network": lambda *view: completed(*view, fill="network"),
    "exemplar": lambda *view: completed(*view, fill="exemplar"),
    "lama": lambda *view: completed(*view, fill="lama"),
    "opencv": telea,
}


def find_fill(name: str) -> Fill:
    """A fill of `FILLS`, or of a file of residual weights with the exemplar's texture."""
    if not name.endswith(".safetensors"):
        return FILLS[name]
    network = load_residual(Path(name))
    return lambda *view: completed(*view, network=network, fill="exemplar")


class Perception:
    """Distance and texture by a frozen SqueezeNet."""

    def __init__(self, network: FeatureNet) -> None:
        self.network, self.maps = network, dict[str, Tensor]()
        for layer in LAYERS:
            network.get_submodule(layer).register_forward_hook(
                lambda _, __, output, layer=layer: self.maps.update({layer: output.relu()})
            )

    def compare(self, rgb: Tensor, truth: Tensor, hole: Tensor) -> dict[str, float]:
        """Of views [H, W, 3] in a hole [H, W]."""
        self.network(torch.stack([torch.where(hole[..., None], rgb, truth), truth]).movedim(-1, 1))
        distances, textures = [], []
        for both in (self.maps[layer] for layer in LAYERS):  # [2, C, h, w]
            unit = (both / both.norm(dim=1, keepdim=True).clamp_min(1e-10)).flatten(2)
            weight = covered(hole[None], both)[0, 0].flatten()
            weight /= weight.sum()
            distances.append(float(((unit[0] - unit[1]).square().sum(0) * weight).sum()))
            ours, theirs = (vectors * weight @ vectors.T for vectors in unit)
            textures.append(float((ours - theirs).norm() / theirs.norm()))
        return {"distance": float(np.mean(distances)), "texture": float(np.mean(textures))}


class Pair:
    """A stereo pair: its lifted left photo, and what all fills share."""

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        self.left, self.right, depth, camera, self.beside = load_pair(folder)
        self.prediction = lift(self.left, depth, camera)
        self.base = base_alone(self.prediction, [], True)
        self.before = self.base(self.beside)
        self.hole = hole_mask(self.before.alpha)
        self.paths = {
            kind: scene_path(self.prediction.gaussians, camera, kind, DISPARITY, FRAMES)
            for kind in ("swipe", "rotate-forward")
        }
        self.crossings = {kind: [self._crossings(end) for end in ends(path)] for kind, path in self.paths.items()}

    def _crossings(self, camera: Camera) -> list[Tensor]:
        """Where neighbours (in rows: [H, W − 1], in columns: [W, H − 1]) lie on both sides of the photo's border."""
        depth = FILLS["seeds"](self.prediction, [camera], True)(camera).depth
        photo = self.prediction.camera
        uv, _ = photo.project(camera.unproject(camera.pixel_centers(), depth))
        found = []
        for axis, size in enumerate((photo.width, photo.height)):
            inside, z = (uv[..., axis] >= 0) & (uv[..., axis] < size), depth.log()
            inside, z = (inside, z) if axis == 0 else (inside.T, z.T)
            found.append((inside[:, 1:] != inside[:, :-1]) & ((z[:, 1:] - z[:, :-1]).abs() < STEP))
        return found

    def measure(self, fill: Fill, perception: Perception, model: NiqeModel | None) -> tuple[dict[str, float], Tensor]:
        """Numbers by their columns, and the right camera's view."""
        began = time.perf_counter()
        draw = fill(self.prediction, [self.beside], True)
        view = draw(self.beside)
        seconds = [time.perf_counter() - began]
        photo = self.prediction.camera
        numbers = perception.compare(view.rgb, self.right, self.hole)
        numbers["sharpness"] = sharpness(view.rgb, self.right, self.hole)
        numbers["PSNR"] = hole_psnr(view.rgb, self.right, self.hole)
        outside = [hole_psnr(rgb, self.right, ~self.hole) for rgb in (view.rgb, self.before.rgb)]
        numbers["outside"] = outside[0] - outside[1]
        everywhere = torch.ones(photo.height, photo.width, dtype=torch.bool)
        numbers["photo"] = min(hole_psnr(draw(photo).rgb, self.base(photo).rgb, everywhere), 100.0)
        numbers["HAR"] = hole_area_ratio(view.alpha) / hole_area_ratio(self.before.alpha)
        wide: list[Tensor] = []
        for kind, path in self.paths.items():
            began = time.perf_counter()
            draw = fill(self.prediction, path, False)
            views = [draw(end).rgb for end in ends(path)]
            seconds.append(time.perf_counter() - began)
            numbers[f"border {kind.replace('_', '-')}"] = border(views, self.crossings[kind])
            wide += views
        if model is not None:
            pictures = ([*wide], [self.left], [self.base(photo.even()).rgb])
            numbers |= {n: float(np.mean([niqe(rgb, model) for rgb in p])) for n, p in zip(NIQE, pictures, strict=True)}
        numbers["flicker"] = self.flicker(draw)
        return numbers | dict(zip(SECONDS, (seconds[0], float(np.mean(seconds[1:]))), strict=True)), view.rgb

    def flicker(self, draw: Draw) -> float:
        """Along rotate-forward, in 255ths."""
        path, changes = self.paths["rotate-forward"], []
        for index in PAIRS:
            camera, following = path[index], path[index + 1]
            one, other, hole = draw(camera), draw(following), hole_mask(self.base(camera).alpha)
            uv, z = following.project(camera.unproject(camera.pixel_centers(), one.depth))
            grid = (uv / torch.tensor([following.width, following.height]) * 2 - 1)[None]
            there = torch.cat([other.rgb, other.depth[..., None]], dim=-1).movedim(-1, 0)[None]
            there = F.grid_sample(there, grid, align_corners=False)[0].movedim(0, -1)
            same = hole & (grid[0].abs() < 1).all(-1) & ((there[..., 3] / z - 1).abs() < SAME)
            changes.append((there[..., :3] - one.rgb)[same].abs().mean(-1))
        return 255 * float(torch.cat(changes).mean())


def ends(path: Sequence[Camera]) -> list[Camera]:
    """The views farthest to the left and to the right."""
    across = [float(camera.position[0]) for camera in path]
    return [path[int(np.argmin(across))], path[int(np.argmax(across))]]


def border(views: Sequence[Tensor], crossings: Sequence[Sequence[Tensor]]) -> float:
    """Mean grey difference across the crossings over that beside them; of all views together."""
    sums = torch.zeros(2, 2, dtype=torch.float64)  # near, beside: (differences, their number)
    for rgb, found in zip(views, crossings, strict=True):
        for picture, crossing in zip((rgb @ GREY, (rgb @ GREY).T), found, strict=True):
            steps = (picture[:, 1:] - picture[:, :-1]).abs()
            reach = [F.max_pool1d(crossing.float(), 2 * r - 1, 1, r - 1) > 0 for r in (NEAR, BESIDE)]
            for row, where in zip(sums, (reach[0], reach[1] & ~reach[0]), strict=True):
                row += torch.stack([steps[where].double().sum(), where.sum()])
    near, beside = (sums[:, 0] / sums[:, 1]).tolist()
    return float(near / beside)


def print_table(title: str, rows: dict[str, dict[str, float]]) -> None:
    columns = list(next(iter(rows.values())))
    print(f"\n| {title} | {' | '.join(columns)} |\n|---{'|---' * len(columns)}|")
    for name, row in rows.items():
        print(f"| {name} | {' | '.join(f'{row[column]:.3f}' for column in columns)} |", flush=True)


def summary(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Over scenes: means, medians of seconds, NIQE also as ratios of means."""
    table = {k: [row[k] for row in rows] for k in rows[0]}
    mean = {k: float((np.median if k in SECONDS else np.nanmean)(values)) for k, values in table.items()}
    if NIQE[0] in mean:
        view, photo, render = (mean.pop(k) for k in NIQE)
        mean |= {"NIQE": view, "/ photo": view / photo, "/ render": view / render}
    return mean


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="PAIRS")
    parser.add_argument("--features", type=Path, required=True, help="SqueezeNet 1.0's weights")
    parser.add_argument("--niqe", type=Path, help="NIQE's pristine model")
    parser.add_argument("--fills", default="seeds,network", help=f"of {', '.join(FILLS)}, or FILE.safetensors")
    parser.add_argument("--scenes", default="", help="words, one of which a scene's name has to have")
    parser.add_argument("--per-scene", action="store_true", help="a table for each scene as well")
    parser.add_argument("-o", "--output", type=Path, help="a folder for pictures")
    chosen = parser.parse_args()
    network = load_features("squeezenet", chosen.features)
    assert network is not None
    perception, model = Perception(network), load_niqe(chosen.niqe) if chosen.niqe else None
    fills = {name: find_fill(name) for name in chosen.fills.split(",")}
    folders = [path.parent for path in sorted(chosen.folder.glob("*/scene.json"))]
    folders = [path for path in folders if any(word in path.name for word in chosen.scenes.split(","))]
    if not folders:
        parser.error(f"{chosen.folder}: no folder with a scene.json in it")
    rows: dict[str, list[dict[str, float]]] = {name: [] for name in fills}
    for folder in folders:
        pair, pictures = Pair(folder), []
        for name, fill in fills.items():
            numbers, view = pair.measure(fill, perception, model)
            rows[name].append(numbers)
            pictures.append(view)
        if chosen.per_scene:
            print_table(pair.name, {name: found[-1] for name, found in rows.items()})
        if chosen.output:
            chosen.output.mkdir(parents=True, exist_ok=True)
            sheet = torch.cat([pair.before.rgb, *pictures, pair.right], dim=1)
            Image.fromarray((255 * sheet.clamp(0, 1)).round().byte().numpy()).save(chosen.output / f"{pair.name}.png")
    print_table(f"mean of {len(folders)}", {name: summary(found) for name, found in rows.items()})


if __name__ == "__main__":
    main()
