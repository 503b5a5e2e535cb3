"""The paper's whole experiment in miniature, on two cores in minutes, without a download.

    python benchmarks/reproduce.py -o reproduction

Each command that a reader would type is printed and run; docs/reproduction.md has them at the
paper's size. Each of the
six datasets is replaced by one scene in its layout: one is real (scikit-image's Motorcycle), five
are synthetic, made from scikit-image's other pictures. SHARP is replaced by a network of its
architecture for 512² pixels, with random weights, fitted to the synthetic scenes' depth; it
predicts nearly the same depth for all photos.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from random_weights import deterministic_weights
from safetensors.torch import load_file, save_file
from skimage import data as pictures
from torch.nn.functional import grid_sample, interpolate, unfold

from spackle.bases.sharp.base import expected_shapes, load_network, resize_to_square
from spackle.bases.sharp.encoder import MICRO_SIZE, WINDOW_COUNT
from spackle.paper.evaluation.datasets import stereo

WIDTH, HEIGHT = 192, 144
# the focal length assumed for photos without metadata
FOCAL = math.hypot(WIDTH, HEIGHT) * 30 / math.hypot(36, 24)
WALL, OBJECT = 4.0, 2.2  # depths of a synthetic scene's two surfaces, in metres
SIZE, LOW = 1.1, 0.1  # the object's size, and how far its middle is below the photo's, in metres
EYES = (0.0, 0.35, -0.35)  # eyes' positions to the right, in metres; the first is the photo's
BASELINE = EYES[1]
RANKS, VIEWS, STEPS = 2, 6, 40
PICTURED = ("middlebury", "wildrgbd", "tanks")  # datasets in the figures
Array = NDArray[Any]


class Scene(NamedTuple):
    """An object in front of a wall, both flat and facing the camera, each showing a picture of
    scikit-image.
    """

    wall: str
    front: str

    def seen(self, eye: float = 0.0) -> tuple[Array, Array]:
        """Photo [H, W, 3] and depth [H, W] from an eye `eye` metres to the right."""
        y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        right, down = (x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL
        u, v = (OBJECT * right + eye) / SIZE, (OBJECT * down - LOW) / SIZE
        inside = u**4 + v**4 < 0.5**4
        wall, front = (
            painted(self.wall, (WALL * right + eye) / 8, WALL * down / 6),
            painted(self.front, u, v),
        )
        return np.where(inside[..., None], front, wall), np.where(inside, OBJECT, WALL).astype(
            np.float32
        )


def painted(name: str, u: Array, v: Array) -> Array:
    """Colours [H, W, 3] of a picture at (u, v); (0, 0) is its middle, ±½ its border."""
    picture = (
        torch.from_numpy(np.atleast_3d(getattr(pictures, name)())[..., :3].copy())
        .float()
        .movedim(-1, 0)
    )
    place = torch.from_numpy(2 * np.stack([u, v], -1)).float()
    colors = grid_sample(picture[None], place[None], padding_mode="border", align_corners=False)[0]
    return colors.expand(3, -1, -1).movedim(0, -1).round().byte().numpy()


SCENES = {
    "booster": Scene("brick", "coffee"),
    "wildrgbd": Scene("gravel", "chelsea"),
    "tanks": Scene("rocket", "astronaut"),
    "eth3d": Scene("coffee", "rocket"),
    "llff": Scene("grass", "astronaut"),
}
WALLS = ["astronaut", "chelsea", "coffee", "brick", "rocket", "gravel"]
LEARNED = [Scene(wall, front) for wall, front in zip(WALLS, WALLS[1:] + WALLS[:1], strict=True)]


# The six datasets ---------------------------------------------------------------------------------


def save(path: Path, image: Array) -> None:
    """Write a picture; missing folders are created."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def middlebury(scene: Path) -> None:
    """Write the Motorcycle at half of scikit-image's size, with a scene.json."""
    left, right, disparity = pictures.stereo_motorcycle()
    save(scene / "left.png", np.asarray(Image.fromarray(left).reduce(2)))
    save(scene / "right.png", np.asarray(Image.fromarray(right).reduce(2)))
    np.save(scene / "disparity.npy", disparity[::2, ::2] / 2)
    facts = {"left": "left.png", "right": "right.png", "disparity": "disparity.npy"}
    pixels = {
        "focal_px": stereo.MOTORCYCLE_FOCAL_PX,
        "cx": stereo.MOTORCYCLE_CX_PX,
        "cy": stereo.MOTORCYCLE_CY_PX,
    }
    pixels["doffs_px"] = stereo.MOTORCYCLE_DOFFS_PX
    facts |= {name: value / 2 for name, value in pixels.items()} | {
        "baseline_m": stereo.MOTORCYCLE_BASELINE_M
    }
    (scene / "scene.json").write_text(json.dumps(facts))


def booster(scene: Path, made: Scene) -> None:
    """Write a scene as in Booster, with OpenCV's calibration: millimetres, pixel centres at
    integers.
    """
    photo, depth = made.seen()
    save(scene / "camera_00" / "im0.png", photo)
    save(scene / "camera_02" / "im0.png", made.seen(BASELINE)[0])
    np.save(scene / "disp_00.npy", FOCAL * BASELINE / depth)
    numbers = f"{FOCAL} 0 {WIDTH / 2 - 0.5} 0 0 {FOCAL} {HEIGHT / 2 - 0.5} 0 0 0 1 0"
    matrix = f"<rows>3</rows><cols>4</cols><data>{numbers}</data>"
    sides = f"<proj_matL>{matrix}</proj_matL><proj_matR>{matrix}</proj_matR>"
    text = f"<opencv_storage>{sides}<baselineLR>{1000 * BASELINE}</baselineLR></opencv_storage>"
    (scene / "calib_00-02.xml").write_text(text)


def wildrgbd(scene: Path, made: Scene, scale: float = 0.2) -> None:
    """Write a scene as in WildRGB-D, scaled to a hand-held object, with depth in millimetres."""
    poses = ""
    for number, eye in enumerate(EYES):
        photo, depth = made.seen(eye)
        save(scene / "rgb" / f"{number:05d}.png", photo)
        save(
            scene / "depth" / f"{number:05d}.png", (1000 * scale * depth).round().astype(np.uint16)
        )
        poses += f"{number} 1 0 0 {scale * eye} 0 1 0 0 0 0 1 0 0 0 0 1\n"
    (scene / "cam_poses.txt").write_text(poses)
    K = [FOCAL, 0, 0, 0, FOCAL, 0, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, 1]  # column by column
    (scene / "metadata").write_text(json.dumps({"w": WIDTH, "h": HEIGHT, "K": K}))


def colmap(photos: Path, model: Path, made: Scene, above: str = "") -> None:
    """Write photos and a COLMAP model as text, with a point at every eighth pixel of the first
    photo.
    """
    depth, images = made.seen()[1][4::8, 4::8], ""
    v, u = np.mgrid[4:HEIGHT:8, 4:WIDTH:8] + 0.5
    points = np.stack(
        [(u - WIDTH / 2) * depth / FOCAL, (v - HEIGHT / 2) * depth / FOCAL, depth], -1
    ).reshape(-1, 3)
    for number, eye in enumerate(EYES, 1):
        save(photos / f"{number:03d}.jpg", made.seen(eye)[0])
        where = FOCAL * (points[:, :2] - [eye, 0]) / points[:, 2:] + [WIDTH / 2, HEIGHT / 2]
        seen = [
            f"{x} {y} {k}" for k, (x, y) in enumerate(where) if 0 <= x < WIDTH and 0 <= y < HEIGHT
        ]
        images += f"{number} 1 0 0 0 {-eye} 0 0 1 {above}{number:03d}.jpg\n{' '.join(seen)}\n"
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text(
        f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {FOCAL} {WIDTH / 2} {HEIGHT / 2}\n"
    )
    (model / "images.txt").write_text(images)
    (model / "points3D.txt").write_text(
        "".join(f"{k} {x} {y} {z} 0 0 0 0.1\n" for k, (x, y, z) in enumerate(points))
    )


def llff(scene: Path, made: Scene) -> None:
    """Write a scene as in LLFF: for each photo the columns down, right, backwards, eye and lens,
    then bounds.
    """
    rows = []
    for number, eye in enumerate(EYES):
        save(scene / "images_4" / f"image{number:03d}.png", made.seen(eye)[0])
        pose = [[0, 1, 0, eye, HEIGHT], [1, 0, 0, 0, WIDTH], [0, 0, -1, 0, FOCAL]]
        rows.append([*np.ravel(pose), OBJECT, WALL])
    np.save(scene / "poses_bounds.npy", np.array(rows))


def make_data(data: Path, photos: Path) -> None:
    """Write the six datasets, and photos for training."""
    middlebury(data / "middlebury" / "Motorcycle")
    booster(data / "booster" / "train" / "balanced" / "Table", SCENES["booster"])
    wildrgbd(data / "wildrgbd" / "bowl" / "scenes" / "scene_000", SCENES["wildrgbd"])
    truck, pipes, undistorted = (
        data / "tanks" / "Truck",
        data / "eth3d" / "pipes",
        "dslr_images_undistorted/",
    )
    colmap(truck / "images", truck / "sparse" / "0", SCENES["tanks"])
    colmap(
        pipes / "images" / undistorted,
        pipes / "dslr_calibration_undistorted",
        SCENES["eth3d"],
        undistorted,
    )
    llff(data / "llff" / "fern", SCENES["llff"])
    for number, made in enumerate(LEARNED):
        save(photos / f"{number}.png", made.seen()[0])


@torch.no_grad()
def fit_sharp(random: Path, fitted: Path) -> None:
    """Fit random weights to the depth of synthetic scenes; deltas start at zero, opacities near
    one.

    The tokens of the whole image get low-frequency position embeddings. All of the decoder is
    zeroed but the path from these tokens to the disparities, which is thus linear and nearly the
    same for all photos.
    """
    weights, grid, depths = (
        load_file(random),
        MICRO_SIZE.tokens_per_side,
        "monodepth_model.monodepth_predictor.",
    )
    across = (np.arange(grid) + 0.5) * math.pi / grid
    waves = sorted(((m, n) for m in range(grid) for n in range(grid)), key=sum)[
        : MICRO_SIZE.embed_width
    ]
    places = np.stack(
        [np.outer(np.cos(m * across), np.cos(n * across)).ravel() for m, n in waves], -1
    )
    weights[f"{depths}encoder.image_encoder.pos_embed"][0, 1:] += 30 * torch.from_numpy(places)
    parts = ("decoder", "head", "encoder.upsample_latent0", "encoder.upsample2")
    closed = ("prediction_head.", *(f"{depths}{part}." for part in parts))
    for name in [name for name in weights if name.startswith(closed)]:
        weights[name].zero_()
        if name.endswith((".out_conv.weight", ".deconv.weight")):
            weights[name] += torch.eye(MICRO_SIZE.depth_width)[..., None, None]
    for layer, tap in (
        ("0", 1),
        ("1", slice(None)),
        ("2", 1),
        ("4", 0),
    ):  # channel 0: the nearer surface
        weights[f"{depths}head.{layer}.weight"][0, 0, tap, tap] = 1.0
    weights[f"{depths}head.4.weight"][1, 0] = 0.97  # channel 1: the surface behind
    weights["prediction_head.texture_prediction_head.bias"][-2:] = (
        6.0  # the opacities, before their sigmoid
    )
    save_file(weights, fitted)
    encoder: Any = load_network(fitted, torch.float32).monodepth_model.monodepth_predictor.encoder
    seen, wanted = [], []
    for photo, depth in (scene.seen() for scene in (*SCENES.values(), *LEARNED)):
        coarsest = encoder(
            2 * resize_to_square(torch.from_numpy(photo) / 255, MICRO_SIZE.side) - 1, WINDOW_COUNT
        )[-1]
        seen.append(unfold(coarsest, 3, padding=1)[0].T)
        disparity = resize_to_square(
            FOCAL / WIDTH / torch.from_numpy(depth)[..., None], MICRO_SIZE.side
        )
        wanted.append(interpolate(disparity, coarsest.shape[-2:], mode="area").flatten())
    known, truth = torch.cat(seen).double(), torch.cat(wanted).double()
    ridge = 1e-5 * len(truth) * torch.eye(known.shape[1]).double()
    kernel = torch.linalg.solve(known.T @ known + ridge, known.T @ (truth - truth.mean()))
    weights[f"{depths}decoder.convs.4.weight"][0] = kernel.float().view(-1, 3, 3)
    weights[f"{depths}decoder.fusions.4.out_conv.bias"][0] = truth.mean().float()
    save_file(weights, fitted)
    off = (known @ kernel + truth.mean() - truth).var() / truth.var()
    print(f"{fitted.name}: explains {1 - float(off):.0%} of the made scenes' disparity", flush=True)


# The paper's chain --------------------------------------------------------------------------------


def commands() -> list[str]:
    """The command lines, from photos to tables and figures."""
    sharp, residual = (
        "--base sharp -c sharp.safetensors",
        "--residual sharp-decoder/best.safetensors",
    )
    few = (
        f"data.pseudo=pseudo data.validation_views={VIEWS} loss.features=none "
        "run.validate_every=10 optim.warmup=4"
    )
    train = f"torchrun --nproc-per-node {RANKS} --no-python spackle train --recipe"
    crops = f"optim.steps={STEPS} optim.batch=4 data.views=30 data.crops=2 data.cells=32"
    # high rates for few steps
    fast = f"optim.steps={STEPS // 2} optim.batch=8 optim.lr=4e-3 optim.min_lr=4e-4"
    methods = "--methods base,paper,spackle,direct-ft,dense --direct-ft direct-ft/best.safetensors"
    lines = [
        f"spackle dataset build photos -o pseudo {sharp} --views {VIEWS} --inpainter exemplar "
        f"--disparity 0.3 0.6",
        "spackle dataset verify pseudo",
        f"{train} paper -o unet network=unet {few} {crops}",
        f"{train} paper -o sharp-decoder network=sharp-decoder init=sharp.safetensors {few} "
        f"{crops}",
        f"{train} direct_ft --method direct-ft -o direct-ft -c sharp.safetensors {few} {fast}",
    ]
    measured, pictured = [], []
    for name in ("middlebury", *SCENES):
        photos = f"data/{name} --dataset {name} {sharp} {residual}"
        lines += [
            f"spackle evaluate {photos} {methods} -o runs/{name}-large",
            f"spackle evaluate {photos} {methods} --protocol near-view -o runs/{name}-near",
            f"spackle bench {photos} --runs 1 -o runs/{name}-bench",
        ]
        measured += [f"runs/{name}-{kind}" for kind in ("large", "near", "bench")]
        if name in PICTURED:
            lines.append(
                f"spackle evaluate {photos} {methods} --disparity 0.6 -o runs/{name}-figure"
            )
            pictured.append(f"runs/{name}-figure")
    lines.append(f"spackle tables {' '.join(measured)} -o tables --html")
    return [*lines, f"spackle figures {' '.join(pictured)} -o figures"]


def run(out: Path, line: str) -> None:
    """Print a command line and run it in the folder of results; its output goes to log.txt
    there.
    """
    print(f"$ {line}", flush=True)
    began, words = time.monotonic(), shlex.split(line)
    with (out / "log.txt").open("a") as log:
        programs = Path(sys.executable).parent
        # torchrun starts spackle
        environment = os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
        command = [programs / words[0], *words[1:]]
        if subprocess.run(command, cwd=out, stdout=log, stderr=log, env=environment).returncode:
            sys.exit(f"this command failed: {out / 'log.txt'} says why")
    print(f"  {time.monotonic() - began:.0f} s", flush=True)


def main() -> None:
    """Make the data and the weights, and run all commands."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("reproduction"), help="a folder, which is new"
    )
    out, began = parser.parse_args().output.absolute(), time.monotonic()
    if out.exists():
        parser.error(f"{out}: is there already: give another folder with -o")
    make_data(out / "data", out / "photos")
    save_file(deterministic_weights(expected_shapes(MICRO_SIZE)), out / "random.safetensors")
    fit_sharp(out / "random.safetensors", out / "sharp.safetensors")
    for line in commands():
        run(out, line)
    print(
        f"{time.monotonic() - began:.0f} s: tables and report.html in {out / 'tables'}, figures in "
        f"{out / 'figures'}"
    )


if __name__ == "__main__":
    main()
