"""A scene of any program, filled where given cameras see holes: the work of `spackle fill`."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import torch

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.formats.ply import encode_ply
from spackle.formats.ply_append import append_to_ply
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import Encoder, encoder_for, load_scene
from spackle.pipeline import fill
from spackle.render import Renderer, get_renderer
from spackle.residual import hole_area_ratio
from spackle.results.saved_scene import log_losses, page_name
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.views import PathOptions


def fill_saved_scene(
    scene_file: Path,
    output: Path,
    cameras_file: Path,
    reporter: Reporter,
    *,
    device: str = "auto",
) -> None:
    """Fill a scene where the cameras of a file see holes, and write it with the new Gaussians.

    A PLY becomes a PLY whose first rows are those of the file, byte for byte.

    Args:
        scene_file: the scene, in any format that is read.
        output: the file to write; its suffix sets the format.
        cameras_file: the views, in the scene's world; the first one stands for a photo.
        reporter: says what was left out, how much was filled, and what was written.
        device: of the network and the renderer.

    Raises:
        InputError: a file cannot be used, or no camera sees the scene.
    """
    encode = encoder_for(output)
    if os.path.realpath(output) == os.path.realpath(scene_file):
        raise InputError(f"{output}: this is the scene itself: give the output another name")
    path = PathOptions(cameras=cameras_file).load()

    with results_folder(output.parent, [output.name]):
        loaded = load_scene(scene_file)
        log_losses(loaded, reporter)
        given = path.in_scene(loaded, page_name(scene_file))
        for line in given.notes:
            reporter.log(line)
        assert given.views is not None  # `cameras` gives them
        cameras = _in_world_of_file(given.views, loaded)

        renderer = get_renderer(device)
        before = _mean_hole_ratio(loaded.gaussians, cameras, renderer)
        if before == 1:
            problem = f"no camera sees the scene {scene_file.name}"
            raise InputError(f"{cameras_file}: {problem}: give cameras of its world")
        filled = fill(loaded.gaussians, cameras, renderer=renderer)
        after = _mean_hole_ratio(filled, cameras, renderer)
        write_atomic(output, _encoded(loaded, filled, encode))

    aux_count = len(filled) - len(loaded.gaussians)
    holes = f"holes {before:.1%} -> {after:.2%} of {len(cameras)} views"
    reporter.log(f"{output}: {len(loaded.gaussians):,} + {aux_count:,} Gaussians, {holes}")
    reporter.result(
        {"file": output, "gaussians": len(filled), "added": aux_count, "before": before,
         "after": after}
    )  # fmt: skip


def _in_world_of_file(views: list[Camera], scene: SceneFile) -> list[Camera]:
    """Cameras in the world of a scene's file.

    Those around a photo are in the world of the photo's camera, which may stand elsewhere.
    """
    if scene.camera is None:
        return views
    to_photo = scene.camera.world_to_camera.double()
    return [
        dataclasses.replace(view, world_to_camera=view.world_to_camera.double() @ to_photo)
        for view in views
    ]


@torch.no_grad()
def _mean_hole_ratio(gaussians: Gaussians, cameras: list[Camera], renderer: Renderer) -> float:
    """The mean share of the pixels of views that are holes, 0..1."""
    ratios = [float(hole_area_ratio(renderer.render(gaussians, view).alpha)) for view in cameras]
    return sum(ratios) / len(ratios)


def _encoded(loaded: SceneFile, filled: Gaussians, encode: Encoder) -> bytes:
    """The bytes of a filled scene; of a PLY, the rows of the file and then the new ones."""
    count = len(loaded.gaussians)
    if encode is encode_ply and loaded.format == "PLY":
        aux = filled.select(slice(count, None)).with_harmonics_count(0)
        content = append_to_ply(loaded.path, aux)
        if content is not None:
            return content
    base_count = count if loaded.base_count is None else loaded.base_count
    return encode(dataclasses.replace(loaded, gaussians=filled, base_count=base_count))
