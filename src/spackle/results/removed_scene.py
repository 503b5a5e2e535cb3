"""A scene of any program without a thing in it: the work of `spackle fill --remove`."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.formats.ply import encode_ply
from spackle.formats.ply_select import select_in_ply
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import SCENE_ENCODERS, Encoder, encoder_for, load_scene
from spackle.pipeline import Removal, remove
from spackle.render import Renderer, get_renderer
from spackle.residual.features import hole_mask
from spackle.results.fill_views import FillViewsOptions, choose_fill_views, named_camera
from spackle.results.filled_scene import encode_filled
from spackle.results.mask_files import read_mask
from spackle.results.saved_scene import log_losses
from spackle.runtime.errors import InputError
from spackle.runtime.files import write_atomic
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Reporter
from spackle.scene_fill.fill_plan import Background
from spackle.scene_fill.removal import marked_gaussians

EDIT_NAME = "_removed"  # before the suffix of the file with the edit alone


@dataclasses.dataclass(frozen=True, kw_only=True)
class RemovalOptions:
    """What is taken out of a scene."""

    remove: tuple[Path, ...] = ()  # masks, each in the view of a camera
    # Names or indices of these cameras in the file of cameras, as many as masks; none: each mask is
    # in the view of the scene's own camera.
    camera: tuple[str, ...] = ()
    box: str | None = None  # "x0,y0,z0,x1,y1,z1": two opposite corners, in the scene's world

    @property
    def is_given(self) -> bool:
        """Whether anything is to be taken out."""
        return bool(self.remove or self.camera or self.box is not None)

    def check(self, background: Background = "keep") -> None:
        """InputError for options that cannot be, or do not fit together.

        `background` is the option of a fill, which a removal does not have.
        """
        if background == "fill":
            raise InputError(
                "`background` fill: a removal fills what the thing hid, and nothing else: "
                "leave it out, and fill the result once more"
            )
        if self.box is not None:
            corners_of(self.box)
        if self.camera and not self.remove:
            raise InputError(
                f"`camera` {self.camera[0]} needs `remove`, a mask in the view of this camera"
            )
        if self.camera and len(self.camera) != len(self.remove):
            raise InputError(
                f"`camera` is given {len(self.camera)} times and `remove` {len(self.remove)} times:"
                " give each mask its camera, in the same order"
            )
        if len(self.remove) > 1 and not self.camera:
            raise InputError(
                f"`remove` is given {len(self.remove)} times: give each mask its `camera`"
            )


def remove_from_saved_scene(
    scene_file: Path,
    output: Path,
    removal: RemovalOptions,
    views: FillViewsOptions,
    reporter: Reporter,
    *,
    device: str = "auto",
) -> None:
    """Take a thing out of a scene, fill what it hid, and write both results.

    The file `output` is the patched scene; NAME_removed beside it is the scene without the thing.
    Of a PLY, the rows that stay keep their bytes in both.

    Args:
        scene_file: the scene, in any format that is read.
        output: the file to write; its suffix sets the format.
        removal: what is taken out.
        views: the views in which holes are filled.
        reporter: says how much was taken out and filled.
        device: of the network and the renderer.

    Raises:
        InputError: a file or option cannot be used, or nothing or everything would go.
    """
    removal.check()
    views.check()
    encode = encoder_for(output)
    edit_file = edit_name(output)
    for file in (output, edit_file):
        if os.path.realpath(file) == os.path.realpath(scene_file):
            raise InputError(f"{file}: this is the scene itself: give the output another name")

    with results_folder(output.parent, [output.name, edit_file.name]):
        loaded = load_scene(scene_file)
        log_losses(loaded, reporter)
        renderer = get_renderer(device)
        marks = _read_marks(loaded, removal, views)
        marked = _marked(loaded, marks, removal.box, renderer)
        chosen = choose_fill_views(loaded, views)
        for line in chosen.notes:
            reporter.log(line)

        # The cameras of the masks see best what the thing hid.
        mask_cameras = [camera for camera, _ in marks]
        others = [view for view in chosen.cameras if not _is_among(view, mask_cameras)]
        cameras = [*mask_cameras, *others]
        with reporter.stage("fill") as progress:
            removed = remove(
                loaded.gaussians, marked, cameras, renderer=renderer, progress=progress
            )
        edited = _edited_scene(loaded, removed, edit_file)
        write_atomic(edit_file, _encoded_edit(loaded, removed, edited, encode))
        write_atomic(output, encode_filled(edited, removed.patched, encode))

    opened, open_still = _hole_ratios(loaded.gaussians, removed, cameras, renderer)
    removed_count = int(marked.sum())
    added_count = len(removed.patched) - len(removed.edited)
    reporter.log(
        f"{output}: {removed_count:,} Gaussians out, {added_count:,} in, "
        f"uncovered {opened:.1%} -> {open_still:.2%} of {len(cameras)} views; "
        f"{edit_file.name} has the scene without the patch"
    )
    reporter.result(
        {"file": output, "edit": edit_file, "gaussians": len(removed.patched),
         "removed": removed_count, "added": added_count, "before": opened, "after": open_still}
    )  # fmt: skip


def edit_name(output: Path) -> Path:
    """The file of the edit beside a patched scene, such as filled_removed.ply for filled.ply."""
    name = output.name
    for suffix in SCENE_ENCODERS:
        if name.lower().endswith(suffix):
            stem = name[: len(name) - len(suffix)]
            return output.with_name(stem + EDIT_NAME + name[len(stem) :])
    return output.with_name(output.stem + EDIT_NAME + output.suffix)


def corners_of(box: str) -> Tensor:
    """[2, 3] the smallest and the largest coordinates of a box, from x0,y0,z0,x1,y1,z1.

    InputError for anything else, or a box without volume.
    """
    try:
        numbers = [float(number) for number in box.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
        raise InputError(f"`box` {box}: give two opposite corners as six numbers x0,y0,z0,x1,y1,z1")
    corners = torch.tensor(numbers, dtype=torch.float64).reshape(2, 3).sort(dim=0).values
    if bool((corners[0] == corners[1]).any()):
        raise InputError(f"`box` {box}: its corners share a coordinate, so it holds nothing")
    return corners


def _read_marks(
    scene: SceneFile, removal: RemovalOptions, views: FillViewsOptions
) -> list[tuple[Camera, Tensor]]:
    """The cameras of the masks, in the scene's world, and the masks [H, W] bool."""
    marks = []
    for index, mask_file in enumerate(removal.remove):
        if removal.camera:
            if views.cameras is None:
                raise InputError(
                    f"`camera` {removal.camera[index]}: "
                    "give the file that has this camera as `cameras`"
                )
            name = removal.camera[index]
            camera = named_camera(scene, views.cameras, name)
            camera_name = f"camera {name} of {views.cameras.name}"
        else:
            if scene.camera is None:
                raise InputError(
                    f"{scene.path}: has no camera of its own: give `cameras`, a file of cameras, "
                    f"and `camera`, the one in whose view {mask_file.name} is"
                )
            camera = scene.camera
            camera_name = f"the camera of {scene.path.name}"
        marks.append((camera, read_mask(mask_file, camera, camera_name)))
    return marks


def _marked(
    scene: SceneFile, marks: Sequence[tuple[Camera, Tensor]], box: str | None, renderer: Renderer
) -> Tensor:
    """[N] bool: the Gaussians to take out; InputError if there are none, or all."""
    gaussians = scene.gaussians
    marked = torch.zeros(len(gaussians), dtype=torch.bool)
    sources = []
    if marks:
        sources.append("the masks" if len(marks) > 1 else "the mask")
        # What a former fill has made up behind the thing is made up anew, now that more is seen.
        marked |= marked_gaussians(gaussians, marks, renderer, is_invented=scene.is_added)
    if box is not None:
        sources.append("`box`")
        smallest, largest = corners_of(box)
        means = gaussians.means.double()
        marked |= ((means >= smallest) & (means <= largest)).all(dim=-1)
    source = " and ".join(sources)
    if not bool(marked.any()):
        problem = f"{source} marks no Gaussian"
        raise InputError(f"{scene.path}: {problem}: check that the camera sees the scene there")
    if bool(marked.all()):
        raise InputError(f"{scene.path}: {source} marks the whole scene: nothing would be left")
    return marked


def _is_among(camera: Camera, others: Sequence[Camera]) -> bool:
    """Whether a camera is one of several: of the same pose, lens and size."""
    return any(
        torch.equal(camera.world_to_camera, other.world_to_camera)
        and torch.equal(camera.K, other.K)
        and (camera.width, camera.height) == (other.width, other.height)
        for other in others
    )


def _edited_scene(loaded: SceneFile, removed: Removal, edit_file: Path) -> SceneFile:
    """A scene without what was taken out, as the file `edit_file` holds it."""
    base_count = loaded.base_count
    if base_count is not None:
        base_count = int(removed.is_kept[:base_count].sum())
    return dataclasses.replace(
        loaded, path=edit_file, gaussians=removed.edited, base_count=base_count
    )


def _encoded_edit(loaded: SceneFile, removed: Removal, edited: SceneFile, encode: Encoder) -> bytes:
    """The bytes of a scene without what was taken out; of a PLY, the rows of the file."""
    if encode is encode_ply and loaded.format == "PLY":
        content = select_in_ply(loaded.path, removed.is_kept)
        if content is not None:
            return content
    return encode(edited)


@torch.no_grad()
def _hole_ratios(
    before: Gaussians, removed: Removal, cameras: Sequence[Camera], renderer: Renderer
) -> tuple[float, float]:
    """The mean shares of views that the removal has uncovered, and that are open still, 0..1."""
    opened = 0.0
    open_still = 0.0
    for camera in cameras:
        was_solid = ~hole_mask(renderer.render(before, camera).alpha)
        uncovered = was_solid & hole_mask(renderer.render(removed.edited, camera).alpha)
        still = uncovered & hole_mask(renderer.render(removed.patched, camera).alpha)
        opened += float(uncovered.float().mean()) / len(cameras)
        open_still += float(still.float().mean()) / len(cameras)
    return opened, open_still
