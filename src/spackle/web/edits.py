"""Edits of a finished scene in a worker process: fill what views show open, or remove a thing.

The Gaussians of the scene that stay keep their numbers, and those that an edit adds come last.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from spackle.bases import DEFAULT_MAX_DISPARITY
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.trajectories import DepthRange, trajectory_cameras
from spackle.formats.ply_append import append_to_ply
from spackle.formats.ply_select import select_in_ply
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import load_scene
from spackle.pipeline import fill, remove
from spackle.render import Renderer
from spackle.residual import hole_area_ratio
from spackle.results.mask_files import read_mask
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.progress import Reporter
from spackle.scene import Scene
from spackle.scene_fill.removal import marked_gaussians

# Files of a job that edits a scene: the scene before, what the page shows of it, and the mask.
EDIT_SOURCE = "source.ply"
FORMER_PAGE = "former.json"
MASK_FILE = "mask.png"
REMOVED_FILE = "removed.ply"  # among the results: the scene without a thing, before the patch

# After a removal, so many views around the scene's camera are filled besides the present one.
VIEWS_AROUND = 8
# Long side of these views; finer ones would take longer, and the present one is as it is.
AROUND_SIDE_PX = 1024


def fill_views(
    source: Path, target: Path, cameras: Sequence[Camera], renderer: Renderer, reporter: Reporter
) -> dict[str, Any]:
    """Fill a scene where cameras see holes, and write it; returns the report.

    Args:
        source: the scene, a PLY of Spackle.
        target: the file to write: the rows of `source`, byte for byte, and then the new ones.
        cameras: the views, in the scene's world; the last one is the view on the screen.
        renderer: renders the scene.
        reporter: gets progress and a line about the result.
    """
    loaded = load_scene(source)
    with reporter.stage("fill-seen") as progress:
        filled = fill(
            loaded.gaussians,
            cameras,
            photo_camera=loaded.camera,
            renderer=renderer,
            progress=progress,
        )
    added = filled.select(slice(len(loaded.gaussians), None))
    write_atomic(target, _with_more(source, added))

    before = _hole_ratio(loaded.gaussians, cameras[-1], renderer)
    after = _hole_ratio(filled, cameras[-1], renderer)
    reporter.log(
        f"{loaded.path.name}: {len(added):,} Gaussians added in {len(cameras)} views, "
        f"holes of the present one {before:.1%} -> {after:.2%}"
    )
    return {"edit": "fill", "added": len(added), "removed": 0, "before": before, "after": after}


def remove_and_patch(
    source: Path,
    target: Path,
    mark: tuple[Camera, Tensor],
    renderer: Renderer,
    reporter: Reporter,
) -> dict[str, Any]:
    """Take a marked thing out of a scene, fill what it hid, and write both; returns the report.

    Args:
        source: the scene, a PLY of Spackle.
        target: the file of the patched scene; `REMOVED_FILE` beside it is the scene without the
            thing, whose Gaussians are the first ones of `target`.
        mark: a camera in the scene's world, and its mask [H, W] bool, true on the thing.
        renderer: renders the scene.
        reporter: gets progress and a line about the result.

    Raises:
        InputError: the mask marks nothing, or the whole scene.
    """
    camera, mask = mark
    loaded = load_scene(source)
    with reporter.stage("remove"):
        # What an earlier fill has made up behind the thing goes with it.
        marked = marked_gaussians(
            loaded.gaussians, [(camera, mask)], renderer, is_invented=loaded.is_added
        )
    removed_count = int(marked.sum())
    if removed_count == 0:
        raise InputError("nothing stands there: paint over the whole thing that is to go")
    if removed_count == len(marked):
        raise InputError("nothing would be left: paint over the thing alone")
    cameras = [camera, *_views_around(loaded)]
    with reporter.stage("patch") as progress:
        removal = remove(loaded.gaussians, marked, cameras, renderer=renderer, progress=progress)
    removed_file = target.with_name(REMOVED_FILE)
    left_rows = select_in_ply(source, removal.is_kept)
    assert left_rows is not None  # rows of a PLY of Spackle can be taken out
    write_atomic(removed_file, left_rows)
    added = removal.patched.select(slice(len(removal.edited), None))
    write_atomic(target, _with_more(removed_file, added))

    before = _hole_ratio(removal.edited, camera, renderer)
    after = _hole_ratio(removal.patched, camera, renderer)
    reporter.log(
        f"{loaded.path.name}: {removed_count:,} Gaussians removed, {len(added):,} added, "
        f"holes of the present view {before:.1%} -> {after:.2%}"
    )
    return {
        "edit": "remove",
        "added": len(added),
        "removed": removed_count,
        "before": before,
        "after": after,
    }


def sent_mask(path: Path, camera: Camera) -> Tensor:
    """The mask [H, W] bool that a client has sent for a camera's view.

    InputError if it is no picture of the view's shape, or marks nothing or everything. The message
    has no path of this server.
    """
    try:
        return read_mask(path, camera, "its camera")
    except InputError as error:
        raise InputError(str(error).replace(str(path), "mask")) from error


def _with_more(source: Path, added: Gaussians) -> bytes:
    """The bytes of a scene's PLY with more Gaussians after its own, which keep their bytes."""
    content = append_to_ply(source, added.with_harmonics_count(0))
    assert content is not None  # a PLY of Spackle has room for every Gaussian
    return content


def _views_around(loaded: SceneFile) -> list[Camera]:
    """The scene's own view, and views on a circle around it, as far as the page's camera goes."""
    scene = Scene.of_file(loaded)
    camera = scene.camera
    longest = max(camera.width, camera.height)
    if longest > AROUND_SIDE_PX:
        factor = AROUND_SIDE_PX / longest
        camera = camera.resized(round(camera.width * factor), round(camera.height * factor))
    disparity = DEFAULT_MAX_DISPARITY if loaded.disparity is None else loaded.disparity
    depths = DepthRange.of(scene.base, is_metric=scene.is_metric)
    return [camera, *trajectory_cameras("rotate", camera, disparity, depths, VIEWS_AROUND)]


@torch.no_grad()
def _hole_ratio(gaussians: Gaussians, camera: Camera, renderer: Renderer) -> float:
    """The share of a view's pixels that are holes, 0..1."""
    return float(hole_area_ratio(renderer.render(gaussians, camera).alpha))
