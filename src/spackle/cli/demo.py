"""`spackle demo`: complete a real photo, and compare it with the true second photo."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from rich.table import Table

from spackle.bases import BasePrediction
from spackle.bases.settings import BaseSettings
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo
from spackle.formats import save_ply, save_png
from spackle.formats.png import contact_sheet
from spackle.paper.evaluation.datasets.stereo import StereoPair, load_motorcycle
from spackle.paper.training.losses import hole_psnr
from spackle.pipeline import Pipeline, PipelineOptions, complete
from spackle.render import Renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.results.photo_folder import save_planned_video
from spackle.runtime.files import write_json
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.views import PathOptions

FILES = (
    "base.ply",
    "scene.ply",
    "video.mp4",
    "comparison.png",
    "right_view.png",
    "right_photo.png",
    "report.json",
)
DISPARITY = 0.3


def run_demo(output: Path, reporter: Reporter) -> None:
    """Complete the photo, write scene, video and pictures, and print the comparison with the true second photo.

    InputError if scikit-image is missing, or `output` cannot be written to.
    """
    pair = load_motorcycle()
    pipeline = Pipeline.open(
        PipelineOptions(
            base=BaseSettings(name="rgbd", depth=pair.depth),
            path=PathOptions(disparity=DISPARITY, overscan=0),
        )
    )
    renderer = pipeline.renderer
    with results_folder(output, FILES, locked=True):
        start = time.perf_counter()
        photo = Photo(
            pair.left, pair.left_camera.focal[0], FocalSource.CALIBRATION, Path("Motorcycle")
        )
        done = pipeline.complete(photo, reporter)
        scene, views = done.scene, done.views
        with reporter.stage("write"):
            save_ply(
                scene.base, output / "base.ply", camera=scene.camera, base_count=len(scene.base)
            )
            scene.save(output / "scene.ply")
        with reporter.stage("video") as step:
            save_planned_video(done, output / "video.mp4", renderer, step)
        with torch.no_grad():
            widest = [views.cameras[index] for index in views.measured.values()]
            drawn = [
                [renderer.render(parts, view) for view in widest]
                for parts in ([scene.base], scene.of_view(0))
            ]
        pictures = [[view.rgb for view in row] for row in drawn]
        save_png(
            contact_sheet(pictures, max(widest[0].width, widest[0].height)),
            output / "comparison.png",
        )
        before, after = (
            sum(hole_area_ratio(view.alpha) for view in row) / len(row) for row in drawn
        )
        with reporter.stage("truth"):
            scores = _compare_truth(done.predicted.prediction, pair, renderer, output)
        seconds = round(time.perf_counter() - start, 3)
        report: dict[str, Any] = {
            "disparity": DISPARITY,
            "base_gaussians": len(scene.base),
            "aux_gaussians": len(scene.aux),
            "hole_area_ratio": {"before": before, "after": after},
            "right_camera": scores,
            "residual": {"weights": pipeline.options.fill.weights_name},
            "seconds": {**reporter.seconds, "total": seconds},
        }
        write_json(report, output / "report.json")
        reporter.console.print(_table(scores))
        reporter.log(
            f"{len(scene.aux):,} aux Gaussians; holes at disparity ±{DISPARITY:g}: "
            f"{before:.1%} -> {after:.2%}; {seconds:.0f} s"
        )
        reporter.log(
            f"Look at {output / 'video.mp4'} and {output / 'comparison.png'}: above the base, below the completed scene"
        )
        reporter.result({"folder": output, **report})


@torch.no_grad()
def _compare_truth(
    prediction: BasePrediction, pair: StereoPair, renderer: Renderer, output: Path
) -> dict[str, Any]:
    """PSNR against the true right photo: of the base, of 2D inpainting, and of the scene with and without a network."""
    from skimage.restoration import inpaint_biharmonic

    before = renderer.render(prediction.gaussians, pair.right_camera)
    hole = hole_mask(before.alpha)
    flat = inpaint_biharmonic(
        before.rgb.numpy(), hole.numpy(), split_into_regions=True, channel_axis=-1
    )
    seeds, trained = (
        complete(prediction, [pair.right_camera], exact=True, network=network, renderer=renderer)
        for network in (None, "shipped")
    )
    after = trained.render(pair.right_camera, renderer)
    methods = {
        "base": before.rgb,
        "2D inpainting (biharmonic)": torch.from_numpy(flat).float().clamp(0, 1),
        "Spackle (initial Gaussians)": seeds.render(pair.right_camera, renderer).rgb,
        "Spackle (trained)": after.rgb,
    }
    save_png(after.rgb, output / "right_view.png")
    save_png(pair.right, output / "right_photo.png")
    return {
        "har_before": hole_area_ratio(before.alpha),
        "har_after": hole_area_ratio(after.alpha),
        "psnr": {
            name: {
                "in_hole": hole_psnr(image, pair.right, hole),
                "outside": hole_psnr(image, pair.right, ~hole),
            }
            for name, image in methods.items()
        },
    }


def _table(scores: dict[str, Any]) -> Table:
    table = Table(
        title=f"True right camera: {scores['har_before']:.1%} holes before, {scores['har_after']:.2%} after"
    )
    for header in ("PSNR against the true photo", "in the hole", "outside"):
        table.add_column(header)
    for name, psnr in scores["psnr"].items():
        table.add_row(name, f"{psnr['in_hole']:.2f} dB", f"{psnr['outside']:.2f} dB")
    return table
