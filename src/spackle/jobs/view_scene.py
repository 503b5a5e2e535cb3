"""A scene's file as the page takes it."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import torch

from spackle.camera import Camera
from spackle.errors import InputError
from spackle.formats.scene_files import SceneFile, at_origin
from spackle.gaussians import Gaussians
from spackle.image import DEFAULT_FOCAL_MM, check_file, film_to_pixels
from spackle.jobs.options import PredictOptions
from spackle.jobs.render import DEFAULT_SIZE
from spackle.viewer import PageScene, page_scene

MAGIC = b"ply"
WRITTEN_ONLY = (".spz", ".splat", ".sog", ".glb", ".html")


def is_scene(path: Path) -> bool:
    """Whether a file claims to be a scene, by its name or by its first bytes.

    Raises:
        InputError: there is no such file, or nothing in it.
    """
    check_file(path, "photo or scene")
    if path.suffix.lower() in WRITTEN_ONLY:
        raise InputError(f"{path}: {path.suffix} files are written, not read: give the scene.ply that it was made of")
    with open(path, "rb") as file:
        return path.suffix.lower() == ".ply" or file.read(len(MAGIC)) == MAGIC


def page_of(scene: SceneFile, options: PredictOptions) -> PageScene:
    """A loaded scene, of ours or of others: where no camera is stored, a usual lens looks along z.

    Raises:
        InputError: a scene that cannot be seen from its camera.
    """
    path, gaussians, camera = scene.path, scene.gaussians, _lens(scene.camera, options)
    if not at_origin(camera):
        gaussians = gaussians.transform(camera.world_to_camera)  # the page's eye starts at the origin
        camera = dataclasses.replace(camera, world_to_camera=torch.eye(4))
    base, aux = _parts(gaussians, len(gaussians) if scene.base_count is None else scene.base_count)
    try:
        return page_scene(name_of(path), base, aux, camera, scene.disparity)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{name_of(path)}: ')}") from error
    except ValueError as error:
        raise InputError(f"{path}: cannot be looked at: {error}: give the lens with --fov") from error


def name_of(path: Path) -> str:
    """What people call a scene: the folder's name where every scene has the same one."""
    path = path.absolute()
    return path.parent.name if path.name in ("scene.ply", "base.ply") and path.parent.name else path.stem


def _parts(gaussians: Gaussians, count: int) -> tuple[Gaussians, Gaussians]:
    """The base and what completion added."""
    return gaussians.select(slice(0, count)), gaussians.select(slice(count, None))


def _lens(stored: Camera | None, options: PredictOptions) -> Camera:
    """The stored camera; a lens that a person gives beats it, and without either it is as `spackle render` has it."""
    width, height = (stored.width, stored.height) if stored else DEFAULT_SIZE
    focal = _given_focal(options, width)
    if focal is None and stored is not None:
        return stored
    camera = Camera.from_focal(focal or film_to_pixels(DEFAULT_FOCAL_MM, width, height), width, height)
    return camera if stored is None else dataclasses.replace(camera, world_to_camera=stored.world_to_camera)


def _given_focal(options: PredictOptions, width: int) -> float | None:
    """In pixels, as a person gave it; InputError where it makes no sense."""
    focal_px, fov = options.focal_px, options.fov
    if focal_px is not None and fov is not None:
        raise InputError("--focal-px and --fov are given together: give one of them")
    if focal_px is not None and not (math.isfinite(focal_px) and focal_px > 0):
        raise InputError(f"--focal-px must be a positive number, got {focal_px:g}")
    if fov is None:
        return focal_px
    if not 0 < fov < 180:
        raise InputError(f"--fov must lie between 0 and 180 degrees, got {fov:g}")
    return width / 2 / math.tan(math.radians(fov) / 2)
