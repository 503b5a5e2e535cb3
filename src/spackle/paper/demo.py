"""The work of `spackle demo`: complete a real photo, and compare with its true second photo."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from spackle.bases import BasePrediction
from spackle.bases.settings import BaseSettings
from spackle.core.focal_length import FocalSource
from spackle.core.photo import Photo
from spackle.formats import save_ply, save_png
from spackle.formats.png import contact_sheet
from spackle.paper.evaluation.datasets.stereo import StereoPair, load_motorcycle
from spackle.paper.training.losses import hole_psnr
from spackle.pipeline import CompletedPhoto, Pipeline, PipelineOptions, complete
from spackle.render import Renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.results.photo_folder import save_planned_video
from spackle.runtime.files import write_json
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.views import PathOptions

RESULT_FILES = (
    "base.ply",
    "scene.ply",
    "video.mp4",
    "comparison.png",
    "right_view.png",
    "right_photo.png",
    "report.json",
)
DISPARITY = 0.3  # size of the camera's movement: the smallest of the paper's large ones


def run_demo(output: Path, reporter: Reporter) -> None:
    """Complete Middlebury's Motorcycle photo, and compare with the true right photo.

    Writes the scene, its video, pictures and a report, and prints the comparison.

    Raises:
        InputError: scikit-image, which brings the photos, is missing, or the folder `output` cannot
            be written to.
    """
    pair = load_motorcycle()
    pipeline = Pipeline.open(
        PipelineOptions(
            base=BaseSettings(name="rgbd", depth=pair.depth),
            path=PathOptions(disparity=DISPARITY, overscan=0),
        )
    )
    renderer = pipeline.renderer
    with results_folder(output, RESULT_FILES, locked=True):
        start = time.perf_counter()
        focal_px = pair.left_camera.focal[0]
        photo = Photo(pair.left, focal_px, FocalSource.CALIBRATION, Path("Motorcycle"))
        completed = pipeline.complete(photo, reporter)
        scene = completed.scene

        with reporter.stage("write"):
            save_ply(
                scene.base, output / "base.ply", camera=scene.camera, base_count=len(scene.base)
            )
            scene.save(output / "scene.ply")
        with reporter.stage("video") as progress:
            save_planned_video(completed, output / "video.mp4", renderer, progress)
        _save_comparison(completed, renderer, output / "comparison.png")
        with reporter.stage("truth"):
            scores = _compare_truth(completed.predicted.prediction, pair, renderer, output)
        seconds = round(time.perf_counter() - start, 3)

        assert scene.report is not None
        before = scene.report.hole_ratio_before
        after = scene.report.hole_ratio_after
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
            f"Look at {output / 'video.mp4'} and {output / 'comparison.png'}: "
            "above the base, below the completed scene"
        )
        reporter.result({"folder": output, **report})


@torch.no_grad()
def _save_comparison(completed: CompletedPhoto, renderer: Renderer, path: Path) -> None:
    """Write a picture of the leftmost and rightmost view: above the base, below the scene."""
    scene = completed.scene
    views = completed.views
    widest_views = [views.cameras[index] for index in views.reported_views.values()]
    rows: list[list[Tensor]] = []  # of pictures [H, W, 3] sRGB
    for gaussians in ([scene.base], scene.of_view(0)):
        rows.append([renderer.render(gaussians, view).rgb for view in widest_views])
    long_side = max(widest_views[0].width, widest_views[0].height)
    save_png(contact_sheet(rows, long_side), path)


@torch.no_grad()
def _compare_truth(
    prediction: BasePrediction, pair: StereoPair, renderer: Renderer, output: Path
) -> dict[str, Any]:
    """Compare four ways to draw the right camera's view with the true right photo.

    The ways are the base alone, its view inpainted as an image, and the scene, completed without
    and with the network. The completed view and the photo are written to `output`.

    Returns:
        Holes before and after completion, and for each way the PSNR in dB in the hole and outside.
    """
    from skimage.restoration import inpaint_biharmonic

    base_view = renderer.render(prediction.gaussians, pair.right_camera)
    hole = hole_mask(base_view.alpha)  # [H, W] bool
    inpainted = inpaint_biharmonic(
        base_view.rgb.numpy(), hole.numpy(), split_into_regions=True, channel_axis=-1
    )
    views = [pair.right_camera]
    untrained = complete(prediction, views, exact=True, network=None, renderer=renderer)
    trained = complete(prediction, views, exact=True, network="shipped", renderer=renderer)
    untrained_view = untrained.render(pair.right_camera, renderer)
    trained_view = trained.render(pair.right_camera, renderer)
    save_png(trained_view.rgb, output / "right_view.png")
    save_png(pair.right, output / "right_photo.png")

    pictures = {
        "base": base_view.rgb,
        "2D inpainting (biharmonic)": torch.from_numpy(inpainted).float().clamp(0, 1),
        "Spackle (initial Gaussians)": untrained_view.rgb,
        "Spackle (trained)": trained_view.rgb,
    }
    psnr = {
        name: {
            "in_hole": hole_psnr(picture, pair.right, hole),
            "outside": hole_psnr(picture, pair.right, ~hole),
        }
        for name, picture in pictures.items()
    }
    return {
        "har_before": hole_area_ratio(base_view.alpha),
        "har_after": hole_area_ratio(trained_view.alpha),
        "psnr": psnr,
    }


def _table(scores: dict[str, Any]) -> Table:
    """The result of `_compare_truth` for the terminal."""
    holes = f"{scores['har_before']:.1%} holes before, {scores['har_after']:.2%} after"
    table = Table(title=f"True right camera: {holes}")
    for header in ("PSNR against the true photo", "in the hole", "outside"):
        table.add_column(header)
    for name, psnr in scores["psnr"].items():
        table.add_row(name, f"{psnr['in_hole']:.2f} dB", f"{psnr['outside']:.2f} dB")
    return table
