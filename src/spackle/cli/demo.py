"""`spackle demo`: a real photo, completed, and held against the true second photo."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from rich.table import Table
from torch import Tensor

from spackle.bases.open import open_base
from spackle.bases.protocol import BasePrediction
from spackle.bases.settings import BaseSettings
from spackle.camera import Camera
from spackle.cli.first_use import compiled_ahead
from spackle.cli.photo import save_views
from spackle.evaluation.datasets.stereo import StereoPair, load_motorcycle
from spackle.evaluation.metrics import sharpness
from spackle.files import write_json
from spackle.folders import results_folder
from spackle.formats import save_ply, save_png
from spackle.image import Photo
from spackle.pipeline import Options, Pipeline, complete
from spackle.progress import Reporter
from spackle.render import Renderer, get_renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.residual.network import shipped_network
from spackle.scene import Scene
from spackle.training.losses import hole_psnr
from spackle.views import PathOptions

FILES = ("base.ply", "scene.ply", "video.mp4", "comparison.png", "right_view.png", "right_photo.png", "report.json")
DISPARITY = 0.3
MARGIN = 8  # pixels between the pictures of the comparison


def run_demo(output: Path, reporter: Reporter) -> dict[str, Any]:
    """Complete the photo, write scene, video and pictures, and print the comparison with the truth.

    InputError where scikit-image is missing, or `output` cannot be written to.
    """
    pair, renderer, network = load_motorcycle(), get_renderer(), shipped_network()
    options = Options(BaseSettings("rgbd", pair.depth), PathOptions(disparity=DISPARITY))
    pipeline = Pipeline(options, open_base(options.base), network, renderer)
    with results_folder(output, FILES, alone=True), compiled_ahead(renderer, reporter.log):
        start = time.perf_counter()
        photo = Photo(pair.left, pair.left_camera.focal[0], "calibration", Path("Motorcycle"))
        done = pipeline.complete(photo, reporter)
        scene, views = done.scene, done.views
        with reporter.stage("write"):
            save_ply(scene.base, output / "base.ply", camera=scene.camera, base_count=len(scene.base))
            scene.save(output / "scene.ply")
        with reporter.stage("video") as step:
            save_views(done, output / "video.mp4", renderer, step)
        sides = [views.cameras[index] for index in views.measured.values()]
        holes = _compare_sides(scene, sides, pair, renderer, output / "comparison.png")
        with reporter.stage("truth"):
            scores = _compare_truth(done.prediction, pair, renderer, output)
        report: dict[str, Any] = {
            "disparity": DISPARITY,
            "base_gaussians": len(scene.base),
            "aux_gaussians": len(scene.aux),
            "hole_area_ratio": holes,
            "right_camera": scores,
            "residual": {"weights": options.fill.weights},
            "seconds": {**reporter.seconds, "total": round(time.perf_counter() - start, 3)},
        }
        write_json(report, output / "report.json")
        reporter.console.print(_table(scores))
        reporter.log(
            f"{len(scene.aux):,} aux Gaussians; holes at disparity ±{DISPARITY:g}: "
            f"{holes['before']:.1%} -> {holes['after']:.2%}; {time.perf_counter() - start:.0f} s"
        )
        reporter.log(f"Look at {output / 'comparison.png'} and {output / 'video.mp4'}")
        reporter.result({"folder": output, **report})
        return report


@torch.no_grad()
def _compare_sides(
    scene: Scene, sides: Sequence[Camera], pair: StereoPair, renderer: Renderer, path: Path
) -> dict[str, float]:
    """comparison.png, and the mean HAR of the path's two extremes before and after."""
    before = [renderer.render(scene.base, camera) for camera in sides]
    after = [scene.render(camera, renderer) for camera in sides]
    rows = [
        [("base, left", before[0].rgb), ("base, right", before[1].rgb)],
        [("Spackle, left", after[0].rgb), ("Spackle, right", after[1].rgb)],
    ]
    _save_sheet(("photo", pair.left), rows, path)
    return {
        name: sum(hole_area_ratio(view.alpha) for view in views) / 2
        for name, views in (("before", before), ("after", after))
    }


@torch.no_grad()
def _compare_truth(prediction: BasePrediction, pair: StereoPair, renderer: Renderer, output: Path) -> dict[str, Any]:
    """The view of the true right camera against the true right photo, beside 2D inpainting."""
    from skimage.restoration import inpaint_biharmonic

    camera = pair.right_camera
    before = renderer.render(prediction.gaussians, camera)
    networks = {"Spackle (seeds)": None, "Spackle (trained)": shipped_network()}
    views = {
        name: complete(prediction, [camera], exact=True, network=network, renderer=renderer).render(camera, renderer)
        for name, network in networks.items()
        if network is not None or "seeds" in name
    }
    after = list(views.values())[-1]
    hole = hole_mask(before.alpha)
    flat = inpaint_biharmonic(before.rgb.numpy(), hole.numpy(), split_into_regions=True, channel_axis=-1)
    inpainted = torch.from_numpy(np.clip(flat, 0, 1).astype(np.float32))
    save_png(after.rgb, output / "right_view.png")
    save_png(pair.right, output / "right_photo.png")
    methods = {"base": before.rgb, "2D inpainting (biharmonic)": inpainted}
    methods |= {name: view.rgb for name, view in views.items()}
    return {
        "har_before": hole_area_ratio(before.alpha),
        "har_after": hole_area_ratio(after.alpha),
        "psnr": {
            name: {"in_hole": hole_psnr(image, pair.right, hole), "outside": hole_psnr(image, pair.right, ~hole)}
            for name, image in methods.items()
        },
        "ssim": {name: _ssim(image, pair.right, hole) for name, image in methods.items()},
        "sharpness": {name: sharpness(image, pair.right, hole) for name, image in methods.items()},
    }


def _ssim(image: Tensor, truth: Tensor, where: Tensor) -> float:
    """Structural similarity of sRGB images [H, W, 3], its mean over a mask [H, W]."""
    from skimage.metrics import structural_similarity

    pictures = image.numpy(), truth.numpy()
    _, similarity = structural_similarity(*pictures, channel_axis=-1, data_range=1, full=True)  # type: ignore[no-untyped-call]
    return float(similarity[where.numpy()].mean())


def _table(scores: dict[str, Any]) -> Table:
    title = f"True right camera: {scores['har_before']:.1%} holes before, {scores['har_after']:.2%} after"
    table = Table(title=title, caption="sharpness: gradients over the true photo's; PSNR prefers fog")
    for header in ("against the true photo", "hole: PSNR", "SSIM", "sharpness", "outside"):
        table.add_column(header, justify="left" if header.startswith("against") else "right")
    for name, score in scores["psnr"].items():
        psnr, outside = (f"{score[where]:.2f} dB" for where in ("in_hole", "outside"))
        table.add_row(name, psnr, f"{scores['ssim'][name]:.3f}", f"{scores['sharpness'][name]:.2f}", outside)
    return table


def _save_sheet(first: tuple[str, Tensor], rows: list[list[tuple[str, Tensor]]], path: Path) -> None:
    """One picture on the left, rows of pictures beside it, each with its name."""
    height, width = rows[0][0][1].shape[:2]
    columns = len(rows[0]) + 1
    sheet = Image.new(
        "RGB", (columns * (width + MARGIN) - MARGIN, len(rows) * (height + MARGIN) - MARGIN), (255, 255, 255)
    )
    draw = ImageDraw.Draw(sheet)

    def place(name: str, image: Tensor, x: int, y: int) -> None:
        sheet.paste(Image.fromarray((image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()), (x, y))
        box = draw.textbbox((x + 8, y + 6), name, font_size=22)
        draw.rectangle((box[0] - 4, box[1] - 3, box[2] + 4, box[3] + 3), fill=(0, 0, 0))
        draw.text((x + 8, y + 6), name, fill=(255, 255, 255), font_size=22)

    place(*first, 0, (sheet.height - first[1].shape[0]) // 2)
    for r, row in enumerate(rows):
        for c, (name, image) in enumerate(row):
            place(name, image, (c + 1) * (width + MARGIN), r * (height + MARGIN))
    save_png(torch.from_numpy(np.array(sheet)), path)
