"""`spackle export`: a scene file to the formats that other viewers read, and to what the page shows."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Sequence
from pathlib import Path

from rich.filesize import decimal

from spackle.errors import InputError
from spackle.files import check_writable, write_whole
from spackle.folders import results_folder
from spackle.formats.ply import PlyFile
from spackle.formats.scene_files import Encoder, SceneFile, encoder_of
from spackle.formats.spz import LARGEST, spz_grid
from spackle.progress import Reporter
from spackle.scene import Scene
from spackle.viewer import PageScene, single_html

PAGE: dict[str, Encoder] = {".html": lambda scene: single_html(page_of(Scene.of_file(scene), scene.path))}


def export_scene(scene: Path, outputs: Sequence[Path], reporter: Reporter) -> None:
    """Write a PLY in the formats that the outputs' names end in, each file whole or not at all.

    Raises InputError for a scene or name that cannot be used, and for a scene too large for a format.
    """
    encoders = [encoder_of(output, PAGE) for output in outputs]
    with contextlib.ExitStack() as folders:
        for output in outputs:
            folders.enter_context(results_folder(output.parent, [output.name]))
        _export(scene, outputs, encoders, reporter)


def _export(scene: Path, outputs: Sequence[Path], encoders: Sequence[Encoder], reporter: Reporter) -> None:
    targets = [check_writable(output) for output in outputs]
    twice = [output for output, target in zip(outputs, targets, strict=True) if targets.count(target) > 1]
    if twice:
        raise InputError(f"{twice[0]}: named twice: give each output once")
    if os.path.realpath(scene) in map(str, targets):
        raise InputError(f"{scene}: is the scene itself, and would be lost: give the output another name")
    file, size = PlyFile(scene), os.path.getsize(scene)
    loaded = file.scene()
    if rest := sum(name.startswith("f_rest_") for element in file.elements for name, _ in element.fields):
        reporter.log(
            f"{scene}: {rest} spherical harmonics of each Gaussian are left out: its colour is that of degree 0"
        )
    for output, encoder in zip(outputs, encoders, strict=True):
        start = time.perf_counter()
        try:
            write_whole(output, encoder(loaded))
        except InputError as error:
            raise error if str(output) in str(error) else InputError(f"{output}: {error}") from error
        _say(reporter, loaded, output, size, time.perf_counter() - start)


def _say(reporter: Reporter, scene: SceneFile, output: Path, before: int, seconds: float) -> None:
    """One line about a file, and one about what its format could not hold."""
    size = os.path.getsize(output)
    factor = f"{before / size:.1f} times smaller than" if size < before else f"{size / before:.1f} times the size of"
    if 0.95 < size / before < 1.05:
        factor = "as large as"
    reporter.log(f"{output}: {len(scene.gaussians):,} Gaussians, {decimal(size)}, {factor} the PLY, {seconds:.1f} s")
    result = {"file": output, "gaussians": len(scene.gaussians), "bytes": size, "seconds": round(seconds, 3)}
    bits, far = spz_grid(scene.gaussians) if output.name.lower().endswith(".spz") else (0, 0)
    if far:
        reach = f"{LARGEST / 2**bits:,.0f} m"
        reporter.log(f"{output}: {far:,} Gaussians beyond {reach} were drawn nearer, as the photo's eye sees them")
    reporter.result({**result, "drawn_nearer": far})


def page_of(scene: Scene, path: Path) -> PageScene:
    """The scene of a file for the page; InputError, naming the file, if it cannot be seen."""
    name = name_of(path)
    try:
        return scene.page(name)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{name}: ')}") from error
    except ValueError as error:
        raise InputError(f"{path}: cannot be looked at: {error}: give the lens with --fov") from error


def name_of(path: Path) -> str:
    """What people call a scene: the folder's name where every scene has the same one."""
    path = path.absolute()
    return path.parent.name if path.name in ("scene.ply", "base.ply") and path.parent.name else path.stem
