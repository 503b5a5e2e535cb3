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
from spackle.paper.training.feature_networks import load_features
from spackle.paper.training.losses import hole_distance, hole_psnr
from spackle.pipeline import CompletedPhoto, Pipeline, PipelineOptions, complete
from spackle.render import Renderer
from spackle.residual import hole_area_ratio, hole_mask
from spackle.results.many_photos import say_if_kernels_compile
from spackle.results.photo_folder import save_planned_video
from spackle.runtime.files import write_json
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.views import PathOptions
from spackle.weights import installed_weights

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
    # The left photo and its measured depth become the scene. Overscan, a zoom that hides the fill
    # beyond the photo's border, is 0, because the comparison is to show all of the fill.
    pair = load_motorcycle()
    pipeline = Pipeline.open(
        PipelineOptions(
            base=BaseSettings(name="rgbd", depth=pair.depth),
            path=PathOptions(disparity=DISPARITY, overscan=0),
        )
    )
    renderer = pipeline.renderer
    # The demo is the first that most people run.
    say_if_kernels_compile(pipeline, reporter)
    with results_folder(output, RESULT_FILES, locked=True):
        start = time.perf_counter()
        photo = Photo(
            rgb=pair.left,
            focal_px=pair.left_camera.focal[0],
            focal_source=FocalSource.CALIBRATION,
            path=Path("Motorcycle"),  # no file, but a name for messages
        )
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
        total_seconds = round(time.perf_counter() - start, 3)

        assert scene.report is not None  # `Pipeline.complete` always makes one
        hole_ratio_before = scene.report.hole_ratio_before
        hole_ratio_after = scene.report.hole_ratio_after
        report: dict[str, Any] = {
            "disparity": DISPARITY,
            "base_gaussians": len(scene.base),
            "aux_gaussians": len(scene.aux),
            "hole_area_ratio": {"before": hole_ratio_before, "after": hole_ratio_after},
            "right_camera": scores,
            "residual": {"weights": pipeline.options.fill.weights_name},
            "seconds": {**reporter.seconds, "total": total_seconds},
        }
        write_json(report, output / "report.json")

        reporter.console.print(_table(scores))
        reporter.log(_explanation(scores))
        reporter.log(
            f"{len(scene.aux):,} aux Gaussians; holes at disparity ±{DISPARITY:g}: "
            f"{hole_ratio_before:.1%} -> {hole_ratio_after:.2%}; {total_seconds:.0f} s"
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
    # Of a trajectory the report measures the leftmost and the rightmost view.
    widest_views = [views.cameras[index] for index in views.reported_views.values()]
    rows: list[list[Tensor]] = []  # of pictures [H, W, 3] sRGB
    for gaussians in ([scene.base], [scene.base, scene.aux]):
        rows.append([renderer.render(gaussians, view).rgb for view in widest_views])
    long_side = max(widest_views[0].width, widest_views[0].height)
    save_png(contact_sheet(rows, long_side), path)


@torch.no_grad()
def _compare_truth(
    prediction: BasePrediction, pair: StereoPair, renderer: Renderer, output: Path
) -> dict[str, Any]:
    """Draw the right camera's view in four ways, and compare each with the true right photo.

    The four ways are: the base alone; the base's view, with holes inpainted as an image; the scene
    completed without the network; the scene completed with the network. The last one and the
    photo are written to `output`, as right_view.png and right_photo.png.

    Returns:
        "har_before" and "har_after", the view's share of holes before and after completion;
        "psnr", by the name of each way: the PSNR in dB "in_hole" and "outside" of the base's holes;
        and "distance" by the same names: the distance of SqueezeNet's features in the holes, empty
        if its weights are not on this machine.
    """
    # Imported here, because scikit-image is an optional package.
    from skimage.restoration import inpaint_biharmonic

    base_view = renderer.render(prediction.gaussians, pair.right_camera)
    hole = hole_mask(base_view.alpha)  # [H, W] bool
    inpainted = inpaint_biharmonic(
        base_view.rgb.numpy(), hole.numpy(), split_into_regions=True, channel_axis=-1
    )
    # Only this one view is rendered, so completion is exact: no hole of it may remain.
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
    # PSNR compares pixels, this distance what a network for pictures sees in them.
    distance: dict[str, float] = {}
    features_file = installed_weights("squeezenet")
    if features_file is not None:
        features = load_features("squeezenet", features_file)
        assert features is not None  # a network is named
        distance = {
            name: hole_distance(features, picture, pair.right, hole)
            for name, picture in pictures.items()
        }
    return {
        "har_before": hole_area_ratio(base_view.alpha),
        "har_after": hole_area_ratio(trained_view.alpha),
        "psnr": psnr,
        "distance": distance,
    }


def _table(scores: dict[str, Any]) -> Table:
    """The result of `_compare_truth`, the comparison with the true right photo, as a table.

    It has a row for each way to draw the view, the distance in the hole if it was measured, and the
    PSNR in dB in two columns.
    """
    distance = scores["distance"]
    holes = f"{scores['har_before']:.1%} holes before, {scores['har_after']:.2%} after"
    table = Table(title=f"True right camera: {holes}")
    table.add_column("against the true photo")
    if distance:
        table.add_column("distance in the hole ↓")
    table.add_column("PSNR in the hole ↑")
    table.add_column("PSNR outside ↑")
    for name, psnr in scores["psnr"].items():
        distances = [f"{distance[name]:.3f}"] if distance else []
        table.add_row(name, *distances, f"{psnr['in_hole']:.2f} dB", f"{psnr['outside']:.2f} dB")
    return table


def _explanation(scores: dict[str, Any]) -> str:
    """A line below the table: what the two measures reward, or how to get the second one."""
    if not scores["distance"]:
        return (
            "PSNR counts each pixel alone; `spackle weights get squeezenet` (0.7 MB) adds the "
            "distance of what a network for pictures sees, which shows where Spackle's helps."
        )
    return (
        "PSNR counts each pixel alone, so that a detail in a slightly wrong place costs more than "
        "none; the distance compares what a network for pictures sees."
    )
