"""The scoreboard: measure the quality of lifted and completed scenes on stereo pairs.

    python benchmarks/scoreboard.py PAIRS --features squeezenet_v1.0.npz [--small 4] \\
        [-o NOW.json] [--against OLD.json]
    python benchmarks/scoreboard.py PAIRS ... --without "far bias" --without "network+texture"
    python benchmarks/scoreboard.py PAIRS ... --ledger > ledger.md
    python benchmarks/scoreboard.py --photos FOLDER [--without NAME] -o sheet.jpg

PAIRS has one folder per scene: two photos, a disparity map and a `scene.json`
(`spackle.paper.training.measured_photos.load_pair`). The left photo is lifted by its true depth,
and the right camera's view is completed and compared with the right photo. PAIRS may also be a
folder of photos. A fifth of the width is then cut off at each side of a photo, its middle is lifted
by lite's depth for the whole photo, and the view to complete is the whole photo.

The hole is where the lifted photo's opacity in the view is below 0.95; the band is within 8 pixels
of the hole.

distance ↓    SqueezeNet 1.0 at conv1, fire3, fire5 and fire9: mean squared difference of unit
              feature vectors over the cells, weighted by the fraction that is hole; outside the
              hole the view is replaced by the truth. 0 to 2
texture ↓     Frobenius norm of the difference of the vectors' Gram matrices, over that of the
              truth's matrices
sharpness     mean gradient magnitude in grey over the truth's, at least 3 pixels inside the hole;
              1 is best
PSNR ↑        in the hole; band ↑: in the band; elsewhere ↑: outside both; in dB
seam ↓        mean grey difference within 2 pixels of the photo's former border, over that at
              3 to 20 pixels from it
photo ↑       PSNR of the completed scene at the photo's own camera against the photo, in dB
agreement ↑   the same against the lifted photo, at most 100 dB
HAR ↓         the hole that is left, in percent of the view
base, aux     thousands of Gaussians; s lift and s fill: CPU seconds of all threads

--small N lifts by depth maps of 1/N of the side, in 256 steps of inverse depth, as phones store
them. --without runs once more with a mechanism of `MECHANISMS` switched off, or several joined by
+; hole and band stay those of the default. --ledger does this with each mechanism and prints the
changes. --against compares with another run's file: up : down counts the scenes whose figure rose
and fell, p is the p-value of a two-sided sign test. --photos completes some photos with `lite` and
writes a sheet with a row for each photo: at the left and the right end of its camera path, the
lifted photo and the result of each run.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

import spackle
from spackle import Camera, get_renderer, hole_area_ratio, hole_mask
from spackle.bases.depth import lift_rgbd
from spackle.bases.lite import MAX_DEPTH_RATIO
from spackle.cli.script_command import check_picture_file, run_script
from spackle.core.filters import maximum_filter
from spackle.core.hole_filling import FAR_SIDE_BIAS, fill_from_far_side
from spackle.core.photo import load_photo, resize_photo
from spackle.core.trajectories import leftmost_and_rightmost
from spackle.depth.depth_map import DepthMap
from spackle.depth.units import RELATIVE_NEAR_M, near_inverse_depth
from spackle.lifting.edges import Edges
from spackle.lifting.silhouettes import Layers
from spackle.paper.evaluation.metrics import GREY_WEIGHTS, sharpness
from spackle.paper.training.feature_networks import FeatureNet, load_features
from spackle.paper.training.losses import covered_fraction, hole_psnr
from spackle.paper.training.measured_photos import StereoPair, load_pair
from spackle.runtime.errors import InputError, as_input_error
from spackle.runtime.files import check_writable, list_files

Row = dict[str, float]  # the figures of a scene, by name
Rows = dict[str, Row]  # the rows of scenes, by name
Replace = Callable[[Any], Any]  # from a function or constant to its replacement

LAYERS = ("conv1", "fire3", "fire5", "fire9")
BAND_PX = 8
# for seams: pixels, pixels, relative depth step above which there is no seam
NEAR, BESIDE, STEP = (
    2,
    20,
    0.05,
)
STEPS = 255  # of inverse depth in a phone's map
DIGITS = dict.fromkeys(("distance", "texture", "seam", "HAR"), 3)  # other figures have 2
SECONDS = ("s lift", "s fill")
PHOTOS, PHOTO_HEIGHT = 8, 256  # of photos on a sheet
PHOTO_ENDINGS = (".jpg", ".jpeg", ".png")
CUT_PHOTOS = 24  # photos of a folder that are used with cut sides
DEFAULT = "default"
RENDERER = get_renderer()


def first(own: Any) -> Any:
    """Replace a function by one that returns its first argument."""
    return lambda given, *more, **named: given


def unbiased(own: Any) -> Any:
    """`fill_from_far_side` without preference for the farther side of a rim."""
    return lambda *given, far_bias=None, **named: own(*given, far_bias=0.0, **named)


def filled_from_around(own: Any) -> Any:
    """`fill_around` that treats holes beyond the photo's border like other holes."""
    return lambda cues, across, uv, known, inside, *cameras: fill_from_far_side(
        cues.inverse_depth, cues.rgb.permute(2, 0, 1), known, far_bias=FAR_SIDE_BIAS * inside
    )


def no_edges(own: Any) -> Any:
    return lambda depth, known, focal: Edges(
        np.zeros_like(depth), np.zeros_like(known), np.zeros_like(known)
    )


def one_surface(own: Any) -> Any:
    """`find_layers` that assumes a single surface in each pixel."""

    def layers(*images: Any) -> Layers:
        found: Layers = own(*images)
        return Layers(
            found.ring, np.zeros_like(found.alpha), *(np.stack([image, image]) for image in images)
        )

    return layers


# Mechanisms of lifting and of completion that can be switched off: names in the package, and their
# replacements.
LIFT: dict[str, dict[str, Replace]] = {
    "smoothed": {"smooth_inverse_depth": first},
    "edges": {"find_edges": no_edges},
    "two layers": {"find_layers": one_surface},
    "colour fit": {"splats._correct_colors": first},
    "blended opacities": {"blended_opacities": first},
}
FILL: dict[str, dict[str, Replace]] = {
    "far bias": {"fill_from_far_side": unbiased},
    "network": {"shipped_network": lambda own: lambda: None},
    "texture": {"open_texture": lambda own: lambda fill: None},
    "half texture": {"_gain_to_surroundings": lambda own: lambda *given: 0.5 * own(*given)},
    "sharpened": {"sharpen_for_overlap": first},
    "beyond_border": {"fill_around": filled_from_around},
    "in proportion": {
        "_gain_to_surroundings": lambda own: (
            lambda texture, view: torch.ones_like(view.features.alpha)
        )
    },
    "in front": {"view_completion.NEARER_SURFACE_RATIO": lambda own: math.inf},
    "extended": {"continue_border": lambda own: lambda view, structure: structure},
}
MECHANISMS = (*FILL, *LIFT)


def holders(target: str) -> list[ModuleType]:
    """Modules of the package that have an object under this name; `home.name` selects the module
    `home`'s object.

    LookupError unless it is a single object, so that removed or renamed mechanisms do not pass
    unnoticed.
    """
    home, _, name = target.rpartition(".")
    modules = [
        m for n, m in list(sys.modules.items()) if n.startswith("spackle.") and name in vars(m)
    ]
    things = {id(vars(m)[name]) for m in modules if home in ("", m.__name__.rpartition(".")[2])}
    if len(things) != 1:
        raise LookupError(
            f"{target}: the package has {len(things)} things of that name: mend "
            f"benchmarks/scoreboard.py"
        )
    return [m for m in modules if id(vars(m)[name]) in things]


@contextlib.contextmanager
def switched_off(run: str, *stages: dict[str, dict[str, Replace]]) -> Iterator[None]:
    """Switch off those mechanisms of a run that belong to some stages."""
    with contextlib.ExitStack() as stack:
        for stage in stages:
            for target, replace in [
                item for name in run.split("+") for item in stage.get(name, {}).items()
            ]:
                modules, name = holders(target), target.rpartition(".")[2]
                other = replace(vars(modules[0])[name])
                for module in modules:
                    stack.enter_context(mock.patch.object(module, name, other))
        yield


class Perception:
    """Measures distance and texture by a frozen SqueezeNet."""

    def __init__(self, network: FeatureNet) -> None:
        self.network, self.maps = network, dict[str, Tensor]()
        for layer in LAYERS:
            network.get_submodule(layer).register_forward_hook(
                lambda _, __, output, layer=layer: self.maps.update({layer: output.relu()})
            )

    def compare(self, rgb: Tensor, truth: Tensor, hole: Tensor) -> Row:
        """Compare views [H, W, 3] inside a hole [H, W]."""
        self.network(torch.stack([torch.where(hole[..., None], rgb, truth), truth]).movedim(-1, 1))
        distances, textures = [], []
        for both in (self.maps[layer] for layer in LAYERS):  # [2, C, h, w]
            unit = (both / both.norm(dim=1, keepdim=True).clamp_min(1e-10)).flatten(2)
            weight = covered_fraction(hole[None], both)[0, 0].flatten()
            weight /= weight.sum()
            distances.append(float(((unit[0] - unit[1]).square().sum(0) * weight).sum()))
            ours, theirs = (vectors * weight @ vectors.T for vectors in unit)
            textures.append(float((ours - theirs).norm() / theirs.norm()))
        return {"distance": float(np.mean(distances)), "texture": float(np.mean(textures))}


class Pair:
    """A stereo pair with the hole, band and former border in the right camera's view, which all
    runs share.
    """

    def __init__(self, place: Path, small: int) -> None:
        pair = load_pair(place) if place.is_dir() else load_cut(place)
        self.left, self.right = pair.left, pair.right
        self.camera, self.beside = pair.left_camera, pair.right_camera
        self.depth = smaller(pair.depth, small) if small > 1 else pair.depth
        prediction = lift_rgbd(self.left, self.depth, self.camera)
        self.hole = hole_mask(RENDERER.render(prediction.gaussians, self.beside).alpha)
        self.near = maximum_filter(self.hole, BAND_PX)
        without_network = spackle.complete(
            prediction, [self.beside], exact=True, network=None, fill="network"
        )
        depth_beside = without_network.render(self.beside).depth
        self.crossings = crossings(depth_beside, self.beside, self.camera)

    def measure(self, run: str, perception: Perception | None) -> Row:
        """The figures of a run."""
        began = time.process_time()
        with switched_off(run, LIFT):
            prediction = lift_rgbd(self.left, self.depth, self.camera)
        lifted = time.process_time()
        with switched_off(run, FILL):
            scene = spackle.complete(prediction, [self.beside], exact=True, fill="exemplar")
        seconds = (lifted - began, time.process_time() - lifted)
        view, photo = scene.render(self.beside), scene.render(self.camera).rgb
        everywhere = torch.ones(photo.shape[:2], dtype=torch.bool)
        row = perception.compare(view.rgb, self.right, self.hole) if perception else {}
        row["sharpness"] = sharpness(view.rgb, self.right, self.hole)
        row["PSNR"] = hole_psnr(view.rgb, self.right, self.hole)
        row["seam"] = seam(view.rgb, self.crossings)
        row["band"] = hole_psnr(view.rgb, self.right, self.near & ~self.hole)
        row["elsewhere"] = hole_psnr(view.rgb, self.right, ~self.near)
        row["photo"] = hole_psnr(photo, self.left, everywhere)
        base = RENDERER.render(prediction.gaussians, self.camera).rgb
        row["agreement"] = min(hole_psnr(photo, base, everywhere), 100.0)
        row["HAR"] = 100 * hole_area_ratio(view.alpha)
        row |= {"base": len(scene.base) / 1000, "aux": len(scene.aux) / 1000}
        return row | dict(zip(SECONDS, seconds, strict=True))


def load_cut(file: Path) -> StereoPair:
    """A photo and its middle three fifths as a pair: the middle is the left photo."""
    photo = resize_photo(load_photo(file))
    inverse, side = spackle.LiteBase.load().inverse_depth(photo.rgb), photo.width // 5
    inverse = F.interpolate(inverse[None, None], (photo.height, photo.width), mode="bilinear")[0, 0]
    middle = slice(side, photo.width - side)
    depth = RELATIVE_NEAR_M / (inverse[:, middle] / near_inverse_depth(inverse.flatten())).clamp(
        1 / MAX_DEPTH_RATIO, 1
    )
    cut = photo.camera.cropped(side, 0, depth.shape[1], photo.height)
    known = DepthMap(depth, depth > 0, None, None, "disparity", file)
    left = photo.rgb[:, middle].contiguous()
    return StereoPair(left, photo.rgb, known, left_camera=cut, right_camera=photo.camera)


def smaller(depth: DepthMap, times: int) -> DepthMap:
    """A depth map with sides `times` times smaller: the mean known inverse depth in each cell, in
    256 steps.
    """
    valid = depth.valid.float()
    sums = F.avg_pool2d(
        torch.stack([valid / depth.depth.where(depth.valid, torch.ones(())), valid]), times
    )
    known = sums[1] > 0
    inverse = sums[0] / sums[1].where(known, torch.ones(()))
    low, high = inverse[known].min(), inverse[known].max()
    step = float(high - low) / STEPS
    stepped = low + ((inverse - low) / step).round() * step
    small = (1 / stepped).where(known, torch.zeros(()))
    return dataclasses.replace(
        depth, depth=small, valid=known, K=None, quantum=step, quantity="disparity"
    )


def crossings(depth: Tensor, camera: Camera, photo: Camera) -> list[Tensor]:
    """Whether the photo's border passes between neighbours in rows [H, W − 1] and in columns [W, H
    − 1].
    """
    uv, _ = photo.project(camera.unproject(camera.pixel_centers(), depth))
    found = []
    for axis, size in enumerate((photo.width, photo.height)):
        inside, z = (uv[..., axis] >= 0) & (uv[..., axis] < size), depth.log()
        inside, z = (inside, z) if axis == 0 else (inside.T, z.T)
        found.append((inside[:, 1:] != inside[:, :-1]) & ((z[:, 1:] - z[:, :-1]).abs() < STEP))
    return found


def seam(rgb: Tensor, crossings: Sequence[Tensor]) -> float:
    """Mean grey difference across the crossings, over that beside them; NaN if there are no
    crossings.
    """
    # rows near and beside, columns sum of differences and their number
    sums = torch.zeros(2, 2, dtype=torch.float64)
    for picture, crossing in zip(
        (rgb @ GREY_WEIGHTS, (rgb @ GREY_WEIGHTS).T), crossings, strict=True
    ):
        steps = (picture[:, 1:] - picture[:, :-1]).abs()
        reach = [F.max_pool1d(crossing.float(), 2 * r - 1, 1, r - 1) > 0 for r in (NEAR, BESIDE)]
        for row, where in zip(sums, (reach[0], reach[1] & ~reach[0]), strict=True):
            row += torch.stack([steps[where].double().sum(), where.sum()])
    means = sums[:, 0] / sums[:, 1]
    return float(means[0] / means[1])


def text(measure: str, value: float, sign: str = "") -> str:
    return f"{value:{sign}.{DIGITS.get(measure, 2)}f}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return "\n".join(
        f"| {' | '.join(row)} |" for row in (head, ["---", *["---:"] * (len(head) - 1)], *rows)
    )


def table(rows: Rows) -> str:
    """A table with a row for each scene and one for the mean."""
    measures = list(next(iter(rows.values())))
    every = rows | {"mean": {m: change(m, rows, rows)[0] for m in measures}}
    return markdown(
        ["", *measures], [[n, *(text(m, r[m]) for m in measures)] for n, r in every.items()]
    )


def change(measure: str, before: Rows, now: Rows) -> tuple[float, float, int, int]:
    """A measure's means before and now over the scenes that have both, and the numbers of rises and
    falls.
    """
    pairs = np.array(
        [(before[name][measure], now[name][measure]) for name in now if name in before]
    ).reshape(-1, 2)
    old, new = pairs[~np.isnan(pairs).any(1)].T
    before_mean, mean = (float(part.mean()) if len(part) else math.nan for part in (old, new))
    return before_mean, mean, int((new > old).sum()), int((new < old).sum())


def sign_test(up: int, down: int) -> float:
    """The probability of a split at least as uneven if up and down are equally likely."""
    ways = sum(math.comb(up + down, k) for k in range(min(up, down) + 1))
    return min(1.0, ways / 2.0 ** (up + down - 1))


def comparison(before: Rows, now: Rows) -> str:
    """A table with a row for each measure."""
    known = next(iter(before.values()), {})
    changes = {m: change(m, before, now) for m in next(iter(now.values())) if m in known}
    rows = [
        [
            m,
            text(m, old),
            text(m, new),
            text(m, new - old, "+"),
            f"{up} : {down}",
            f"{sign_test(up, down):.2f}",
        ]
        for m, (old, new, up, down) in changes.items()
    ]
    moved = [m for m, (*_, up, down) in changes.items() if m not in SECONDS and up + down]
    shared_scenes = set(before) & set(now)
    changed_metrics = ", ".join(moved) or "nothing"
    note = f"{len(shared_scenes)} scenes; but for the seconds {changed_metrics} changed."
    return f"{markdown(['', 'before', 'now', 'change', 'up : down', 'p'], rows)}\n\n{note}"


def ledger(runs: dict[str, Rows]) -> str:
    """A table of the default's means, and of their changes in each run without a mechanism."""
    default = runs[DEFAULT]
    measures = [m for m in next(iter(default.values())) if m not in SECONDS]
    rows = [["(nothing)", *(text(m, change(m, default, default)[0]) for m in measures)]]
    for name in [name for name in runs if name != DEFAULT]:
        changes = [(m, *change(m, default, runs[name])) for m in measures]
        rows.append(
            [
                name,
                *(f"{text(m, new - old, '+')} ({up}:{down})" for m, old, new, up, down in changes),
            ]
        )
    return markdown(["without", *measures], rows)


def pictures_in(folder: Path, most: int) -> list[Path]:
    """At most `most` photos of a folder, evenly spaced in the order of names.

    Raises:
        InputError: the folder cannot be read, or has no photo.
    """
    files = list_files(folder, PHOTO_ENDINGS)
    if not files:
        raise InputError(
            f"{folder}: has no photo ({', '.join(PHOTO_ENDINGS)}): give a folder of photos, or as "
            "PAIRS one of folders with a scene.json"
        )
    indices = sorted({round(i) for i in np.linspace(0, len(files) - 1, most)})
    return [files[index] for index in indices]


def read_figures(file: Path, small: int) -> dict[str, Rows]:
    """The figures of another run by mechanism and scene, as `-o` has written them.

    Args:
        file: what `-o` has written.
        small: how many times smaller a side of its depth maps has to be.

    Raises:
        InputError: the file cannot be used, or its depth maps have another size.
    """
    with as_input_error(file, "no figures ({reason}): give a file that -o has written"):
        figures = json.loads(file.read_text())
        file_small = figures["small"]
        runs: dict[str, Rows] = figures["runs"]
        _ = runs[DEFAULT]
    if file_small != small:
        raise InputError(
            f"{file}: its depth maps are {file_small} times smaller, not {small}: give "
            f"--small {file_small}"
        )
    return runs


def sheet(folder: Path, runs: Sequence[str]) -> Image.Image:
    """A picture with a row for each photo of a folder.

    A row shows the left and then the right end of the photo's path: the lifted photo with its
    holes, and the result of each run, which is the name of a mechanism that is switched off.
    """
    base = spackle.LiteBase.load()
    rows = []
    for file in pictures_in(folder, PHOTOS):
        pictures = []
        for run in runs:
            with switched_off(run, LIFT, FILL):
                scene = spackle.predict(file, base=base, disparity=0.15, fill="exemplar")
            # The lifted photo is shown once, beside the run with all mechanisms.
            sets = [[scene.base, scene.aux]]
            if run == DEFAULT:
                sets.insert(0, [scene.base])
            ends = leftmost_and_rightmost(
                scene.camera.even(), scene.disparity or 0.0, scene.depth_range
            )
            pictures.append([[RENDERER.render(part, end).rgb for part in sets] for end in ends])
        # From run, end, picture to end, run, picture.
        ordered = [
            picture for end in zip(*pictures, strict=True) for group in end for picture in group
        ]
        rows.append(np.concatenate([thumbnail(rgb) for rgb in ordered], axis=1))
    width = max(row.shape[1] for row in rows)
    return Image.fromarray(
        np.concatenate([np.pad(row, ((0, 4), (0, width - row.shape[1]), (0, 0))) for row in rows])
    )


def thumbnail(rgb: Tensor) -> np.ndarray:
    """Resize to [PHOTO_HEIGHT, w, 3] bytes."""
    picture = Image.fromarray((255 * rgb.clamp(0, 1)).round().byte().numpy())
    return np.asarray(
        picture.resize((round(picture.width * PHOTO_HEIGHT / picture.height), PHOTO_HEIGHT))
    )


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?", metavar="PAIRS")
    parser.add_argument(
        "--features", type=Path, help="SqueezeNet 1.0's weights; distance and texture need them"
    )
    parser.add_argument(
        "--small", type=int, default=1, help="how many times smaller a side of the depth maps is"
    )
    parser.add_argument(
        "--scenes", default="", help="words, one of which a scene's name has to have"
    )
    parser.add_argument(
        "--without", action="append", default=[], help=f"NAME+...: {', '.join(MECHANISMS)}"
    )
    parser.add_argument("--ledger", action="store_true", help="a run without each of these")
    parser.add_argument(
        "--photos", type=Path, help="a folder of photos to complete by lite, in place of pairs"
    )
    parser.add_argument(
        "-o", "--output", type=Path, help="a file for the figures, or for the sheet of the photos"
    )
    parser.add_argument("--against", type=Path, help="compare with these figures")
    chosen = parser.parse_args(arguments)
    names = [DEFAULT, *(MECHANISMS if chosen.ledger else ()), *chosen.without]
    for name in {part for run in names[1:] for part in run.split("+")} - {*MECHANISMS}:
        parser.error(f"--without {name!r}: choose of {', '.join(MECHANISMS)}")
    if chosen.photos:
        output = chosen.output or Path("sheet.jpg")
        check_picture_file(output)
        sheet(chosen.photos, names).save(output)
        return
    if chosen.output is not None:
        check_writable(chosen.output)
    folder = chosen.folder or Path()
    folders = [path.parent for path in sorted(folder.glob("*/scene.json"))] or pictures_in(
        folder, CUT_PHOTOS
    )
    names_there = ", ".join(path.name for path in folders)
    folders = [
        path for path in folders if any(word in path.name for word in chosen.scenes.split(","))
    ]
    if not folders:
        raise InputError(f"--scenes {chosen.scenes}: in no scene's name: there are {names_there}")
    before = read_figures(chosen.against, chosen.small) if chosen.against else None
    network = load_features("squeezenet", chosen.features) if chosen.features else None
    perception = Perception(network) if network else None
    runs: dict[str, Rows] = {name: {} for name in names}
    for folder in folders:
        pair = Pair(folder, chosen.small)
        for name, rows in runs.items():
            rows[folder.name] = pair.measure(name, perception)
            print(
                folder.name,
                name,
                *(f"{m} {text(m, v)}" for m, v in rows[folder.name].items()),
                file=sys.stderr,
            )
        if chosen.output:
            chosen.output.write_text(
                json.dumps({"small": chosen.small, "runs": runs}, indent=1) + "\n"
            )
    print(table(runs[DEFAULT]))
    if len(runs) > 1:
        print(f"\n{ledger(runs)}")
    if before:
        print(f"\n{comparison(before[DEFAULT], runs[DEFAULT])}")


if __name__ == "__main__":
    sys.exit(run_script(main))
