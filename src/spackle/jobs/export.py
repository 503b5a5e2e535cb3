"""`spackle export`: a scene file to the formats that other viewers read."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.filesize import decimal

from spackle.errors import InputError
from spackle.formats import atomic_path, check_writable
from spackle.formats.ply import read_header
from spackle.formats.scene_files import SCENE_WRITERS, SceneFile
from spackle.formats.spz import LARGEST, spz_grid
from spackle.progress import Reporter


def _html(scene: SceneFile, path: Path) -> None:
    from spackle.jobs.options import PredictOptions
    from spackle.jobs.view_scene import page_of
    from spackle.viewer.page import single_html

    path.write_bytes(single_html(page_of(scene, PredictOptions())))


WRITERS: dict[str, Callable[[SceneFile, Path], object]] = {**SCENE_WRITERS, ".html": _html}


def export_scene(scene: Path, outputs: Sequence[Path], reporter: Reporter) -> None:
    """Write a PLY in the formats that the outputs' names end in, each file whole or not at all.

    Raises:
        InputError: a scene that is none, a name that says no format or cannot be written, or a scene that is
            too large for one of the formats.
    """
    writers = [writer_of(output) for output in outputs]
    targets = [check_writable(output) for output in outputs]
    twice = [output for output, target in zip(outputs, targets, strict=True) if targets.count(target) > 1]
    if twice:
        raise InputError(f"{twice[0]}: named twice: give each output once")
    if os.path.realpath(scene) in map(str, targets):
        raise InputError(f"{scene}: is the scene itself, and would be lost: give the output another name")
    loaded = SceneFile.load(scene)
    size = os.path.getsize(scene)
    if rest := _harmonics(scene):
        reporter.say(
            f"{scene}: {rest} spherical harmonics of each Gaussian are left out: its colour is that of degree 0"
        )
    for output, writer in zip(outputs, writers, strict=True):
        start = time.perf_counter()
        try:
            with atomic_path(output) as temporary:
                writer(loaded, temporary)
        except InputError as error:
            raise error if str(output) in str(error) else InputError(f"{output}: {error}") from error
        _say(reporter, loaded, output, size, time.perf_counter() - start)


def _harmonics(scene: Path) -> int:
    """How many values above degree 0 each Gaussian of a file has."""
    with open(scene, "rb") as file:
        elements = read_header(file, scene).elements
    return sum(name.startswith("f_rest_") for element in elements for name, *_ in element.fields)


def writer_of(output: Path) -> Callable[[SceneFile, Path], object]:
    """What writes a file of this name.

    Raises:
        InputError: a name that ends in none of the formats.
    """
    for suffix, writer in WRITERS.items():
        if output.name.lower().endswith(suffix):
            return writer
    raise InputError(f"{output}: which format? Give a name that ends in {', '.join(WRITERS)}")


def _say(reporter: Reporter, scene: SceneFile, output: Path, before: int, seconds: float) -> None:
    """One line about a file, and one about what its format could not hold."""
    size = os.path.getsize(output)
    factor = f"{before / size:.1f} times smaller than" if size < before else f"{size / before:.1f} times the size of"
    if 0.95 < size / before < 1.05:
        factor = "as large as"
    reporter.say(f"{output}: {len(scene.gaussians):,} Gaussians, {decimal(size)}, {factor} the PLY, {seconds:.1f} s")
    result = {"file": output, "gaussians": len(scene.gaussians), "bytes": size, "seconds": round(seconds, 3)}
    far = 0
    if output.name.lower().endswith(".spz"):
        bits, far = spz_grid(scene.gaussians)
        if far:
            reach = f"{LARGEST / 2**bits:,.0f} m"
            reporter.say(f"{output}: {far:,} Gaussians beyond {reach} were drawn nearer, as the photo's eye sees them")
    reporter.result({**result, "drawn_nearer": far})
