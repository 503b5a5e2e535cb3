"""`spackle demo`: complete a real photo, and compare it with the true second photo."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from rich.table import Table
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.settings import BaseSettings
from spackle.cli.photos import compiled_ahead
from spackle.evaluation.datasets.stereo import StereoPair, load_motorcycle
from spackle.evaluation.metrics import sharpness
from spackle.files import results_folder, write_json
from spackle.formats import save_ply, save_png
from spackle.image import Photo
from spackle.photo_results import save_views
from spackle.pipeline import Options, Pipeline, complete
from spackle.progress import Reporter
from spackle.render import Renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.residual.architectures import shipped_network
from spackle.training.losses import hole_psnr
from spackle.views import PathOptions

FILES = ("base.ply", "scene.ply", "video.mp4", "comparison.png", "right_view.png", "right_photo.png", "report.json")
DISPARITY = 0.3
MARGIN = 8  # pixels between the pictures of the comparison


def run_demo(output: Path, reporter: Reporter) -> None:
    """Complete the photo, write scene, video and pictures, and print the comparison with the truth.

    InputError if scikit-image is missing, or `output` cannot be written to.
    """
    pair = load_motorcycle()
    pipeline = Pipeline.open(Options(BaseSettings("rgbd", pair.depth), PathOptions(disparity=DISPARITY, overscan=0)))
    renderer = pipeline.renderer
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
        with torch.no_grad():
            drawn = {
                name: [renderer.render(parts, views.cameras[index]) for index in views.measured.values()]
                for name, parts in (("base", [scene.base]), ("Spackle", [scene.base, scene.aux]))
            }
        rows = [[(f"{name}, left", left.rgb), (f"{name}, right", right.rgb)] for name, (left, right) in drawn.items()]
        _save_sheet(("photo", pair.left), rows, output / "comparison.png")
        before, after = (sum(hole_area_ratio(view.alpha) for view in both) / len(both) for both in drawn.values())
        with reporter.stage("truth"):
            scores = _compare_truth(done.prediction, pair, renderer, output)
        seconds = round(time.perf_counter() - start, 3)
        report: dict[str, Any] = {
            "disparity": DISPARITY,
            "base_gaussians": len(scene.base),
            "aux_gaussians": len(scene.aux),
            "hole_area_ratio": {"before": before, "after": after},
            "right_camera": scores,
            "residual": {"weights": pipeline.options.fill.weights},
            "seconds": {**reporter.seconds, "total": seconds},
        }
        write_json(report, output / "report.json")
        reporter.console.print(_table(scores))
        reporter.log(
            f"{len(scene.aux):,} aux Gaussians; holes at disparity ±{DISPARITY:g}: "
            f"{before:.1%} -> {after:.2%}; {seconds:.0f} s"
        )
        reporter.log(f"Look at {output / 'comparison.png'} and {output / 'video.mp4'}")
        reporter.result({"folder": output, **report})


@torch.no_grad()
def _compare_truth(prediction: BasePrediction, pair: StereoPair, renderer: Renderer, output: Path) -> dict[str, Any]:
    """Compare the completed view of the true right camera, and 2D inpainting, with the true right photo."""
    from skimage.restoration import inpaint_biharmonic

    camera = pair.right_camera
    before = renderer.render(prediction.gaussians, camera)
    hole = hole_mask(before.alpha)
    flat = inpaint_biharmonic(before.rgb.numpy(), hole.numpy(), split_into_regions=True, channel_axis=-1)
    methods = {"base": before.rgb, "2D inpainting (biharmonic)": torch.from_numpy(flat).float().clamp(0, 1)}
    after, trained = before, shipped_network()
    networks = {"Spackle (seeds)": None, "Spackle (trained)": trained} if trained else {"Spackle (seeds)": None}
    for name, network in networks.items():
        scene = complete(prediction, [camera], exact=True, network=network, renderer=renderer)
        after = scene.render(camera, renderer)
        methods[name] = after.rgb
    save_png(after.rgb, output / "right_view.png")
    save_png(pair.right, output / "right_photo.png")
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
    table = Table(title=title, caption="sharpness: gradients relative to the true photo's; PSNR prefers blur")
    for header in ("against the true photo", "hole: PSNR", "SSIM", "sharpness", "outside"):
        table.add_column(header, justify="left" if header.startswith("against") else "right")
    for name, psnr in scores["psnr"].items():
        others = f"{scores['ssim'][name]:.3f}", f"{scores['sharpness'][name]:.2f}"
        table.add_row(name, f"{psnr['in_hole']:.2f} dB", *others, f"{psnr['outside']:.2f} dB")
    return table


def _save_sheet(first: tuple[str, Tensor], rows: list[list[tuple[str, Tensor]]], path: Path) -> None:
    """Save one picture on the left and rows of equally large pictures beside it, each labelled with its name."""
    height, width = (side + MARGIN for side in rows[0][0][1].shape[:2])
    sheet = Image.new("RGB", ((len(rows[0]) + 1) * width - MARGIN, len(rows) * height - MARGIN), "white")
    draw = ImageDraw.Draw(sheet)
    places = {(0, (sheet.height - first[1].shape[0]) // 2): first}
    places |= {((c + 1) * width, r * height): named for r, row in enumerate(rows) for c, named in enumerate(row)}
    for (x, y), (name, image) in places.items():
        sheet.paste(Image.fromarray((image.clamp(0, 1) * 255).round().to(torch.uint8).numpy()), (x, y))
        box = draw.textbbox((x + 8, y + 6), name, font_size=22)
        draw.rectangle((box[0] - 4, box[1] - 3, box[2] + 4, box[3] + 3), fill="black")
        draw.text((x + 8, y + 6), name, fill="white", font_size=22)
    save_png(torch.from_numpy(np.array(sheet)), path)
