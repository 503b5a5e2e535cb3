"""A scene of any program, filled where given cameras see holes: the work of `spackle fill`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import torch

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.formats.ply import encode_ply
from spackle.formats.ply_append import append_to_ply
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import Encoder, encoder_for, load_scene
from spackle.pipeline import fill_as_planned
from spackle.render import Renderer, get_renderer
from spackle.results.fill_views import FillViewsOptions, choose_fill_views
from spackle.results.saved_scene import log_losses
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.scene_fill.fill import fillable_hole_ratio
from spackle.scene_fill.fill_plan import Background, FillPlan, plan_fill


def fill_saved_scene(
    scene_file: Path,
    output: Path,
    views: FillViewsOptions,
    reporter: Reporter,
    *,
    background: Background = "keep",
    device: str = "auto",
) -> None:
    """Fill a scene where views show holes, and write it with the new Gaussians.

    A PLY becomes a PLY whose first rows are those of the file, byte for byte.

    Args:
        scene_file: the scene, in any format that is read.
        output: the file to write; its suffix sets the format.
        views: which views are filled.
        reporter: says what was left out, how much was filled, and what was written.
        background: "keep": sky and empty space around the scene stay empty; "fill": they do not.
        device: of the network and the renderer.

    Raises:
        InputError: a file or option cannot be used, or no camera sees the scene.
    """
    encode = encoder_for(output)
    if os.path.realpath(output) == os.path.realpath(scene_file):
        raise InputError(f"{output}: this is the scene itself: give the output another name")
    views.check()

    with results_folder(output.parent, [output.name]):
        loaded = load_scene(scene_file)
        log_losses(loaded, reporter)
        chosen = choose_fill_views(loaded, views)
        for line in chosen.notes:
            reporter.log(line)

        renderer = get_renderer(device)
        plan = plan_fill(
            loaded.gaussians,
            chosen.cameras,
            renderer,
            background=background,
            photo_camera=chosen.photo_camera,
        )
        if not plan.sees_scene:
            problem = f"no camera sees the scene {scene_file.name}"
            raise InputError(f"{views.cameras or scene_file}: {problem}: give cameras of its world")
        with reporter.stage("fill") as progress:
            filled = fill_as_planned(
                loaded.gaussians, chosen.cameras, plan, renderer, progress=progress
            )
        before = _mean(plan.hole_ratios)
        after = _mean(_hole_ratios(filled, chosen.cameras, plan, renderer))
        write_atomic(output, encode_filled(loaded, filled, encode))

    aux_count = len(filled) - len(loaded.gaussians)
    holes = f"holes {before:.1%} -> {after:.2%} of {len(chosen.cameras)} views"
    kept = _mean(plan.background_ratios)
    if kept > 0:
        holes += f"; {kept:.1%} kept empty as background, which `background` fill fills, too"
    reporter.log(f"{output}: {len(loaded.gaussians):,} + {aux_count:,} Gaussians, {holes}")
    reporter.result(
        {"file": output, "gaussians": len(filled), "added": aux_count, "before": before,
         "after": after, "background": kept}
    )  # fmt: skip


def _mean(ratios: Sequence[float]) -> float:
    """The mean of the fractions of several views."""
    return sum(ratios) / len(ratios)


@torch.no_grad()
def _hole_ratios(
    gaussians: Gaussians, cameras: Sequence[Camera], plan: FillPlan, renderer: Renderer
) -> list[float]:
    """The share of each view's pixels that are still holes, 0..1.

    Emptiness that the plan keeps as background, such as sky, is no hole.
    """
    ratios = []
    for index, camera in enumerate(cameras):
        # [H, W] bool: the pixels that were to be filled; None: all.
        pixels = None if plan.fillable is None else plan.fillable[index]
        alpha = renderer.render(gaussians, camera).alpha
        ratios.append(fillable_hole_ratio(alpha, pixels))
    return ratios


def encode_filled(loaded: SceneFile, filled: Gaussians, encode: Encoder) -> bytes:
    """The bytes of a filled scene; of a PLY, the rows of the file and then the new ones.

    Args:
        loaded: the scene before the fill, as its file holds it.
        filled: its Gaussians, and then those that were added.
        encode: of the format to write.
    """
    count = len(loaded.gaussians)
    if encode is encode_ply and loaded.format == "PLY":
        aux = filled.select(slice(count, None)).with_harmonics_count(0)
        content = append_to_ply(loaded.path, aux)
        if content is not None:
            return content
    base_count = count if loaded.base_count is None else loaded.base_count
    return encode(dataclasses.replace(loaded, gaussians=filled, base_count=base_count))
