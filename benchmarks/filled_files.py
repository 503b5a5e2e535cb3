"""Fill a scene from its file alone, as other programs save it, and compare with `predict`.

    python benchmarks/filled_files.py PHOTO[,DEPTH] ... [--splat-transform "npx splat-transform"]
        [--views 9] [-o rows.json]

A photo's base is saved with made-up spherical harmonics of degree 3: by Spackle, by gsply
(`pip install gsply`, if it is installed) and by PlayCanvas's splat-transform (if a command is
given). Each file is filled by `spackle fill` in views along the path that `predict` fills. Each row
of the table is one file:

holes         mean share of hole pixels in the path's leftmost and rightmost view: of the file's
              Gaussians, filled from the file, and filled by `predict` from the photo
file's rows   "same bytes": the file's own rows are unchanged in the filled PLY; else the largest
              difference of any value, relative to the largest of its column, after the file was
              written anew in its format (compressed PLYs are also sorted anew)
photo's view  PSNR in dB at the photo's camera, harmonics included, of the filled file against the
              file ("same": no pixel differs)
colour        the same, without the harmonics against the file with them: what would be lost
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import math
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import torch

import spackle
from spackle.bases.settings import BaseSettings
from spackle.cli.script_command import run_script
from spackle.core.camera import Camera
from spackle.core.gaussians import Gaussians
from spackle.core.photo import load_photo
from spackle.core.trajectories import leftmost_and_rightmost
from spackle.formats.ply_tables import PlyTables
from spackle.formats.scene_content import SceneFile
from spackle.formats.scene_files import encoder_for, load_scene
from spackle.pipeline import CompletedPhoto, Pipeline, PipelineOptions
from spackle.runtime.errors import InputError
from spackle.runtime.files import check_writable
from spackle.runtime.progress import Reporter

HARMONICS_OF_DEGREE_3 = 15  # 4² - 1; those of degree 0 are the colour itself
HARMONICS_SCALE = 0.08  # standard deviation; trained scenes have 0.02 to 0.1
SAME_DB = math.inf  # two equal pictures


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """The figures of one file; see the module's docstring."""

    scene: str
    file: str
    count: int
    added: int
    before: float
    after: float
    predicted: float
    rows: str
    photo_db: float
    constant_db: float
    seconds: float


def complete(photo: Path, depth: Path | None) -> CompletedPhoto:
    """A photo's scene as `spackle predict` makes it."""
    pipeline = Pipeline.open(PipelineOptions(base=BaseSettings(depth=depth)))
    return pipeline.complete(load_photo(photo), Reporter())


def with_harmonics(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with harmonics of degree 3 that vary smoothly with the place."""
    generator = torch.Generator().manual_seed(0)
    # Waves over space, so that neighbours have similar harmonics, as in trained scenes.
    frequencies = torch.randn(3, 3 * HARMONICS_OF_DEGREE_3, generator=generator)
    depth = gaussians.means[:, 2:].abs().clamp(min=1e-6)
    waves = torch.sin(3 * (gaussians.means / depth) @ frequencies)
    harmonics = HARMONICS_SCALE * waves.reshape(-1, HARMONICS_OF_DEGREE_3, 3)
    return dataclasses.replace(gaussians, harmonics=harmonics)


def saved_files(scene: Path, folder: Path, splat_transform: str | None) -> Iterator[Path]:
    """The scene's file, and copies of it that other programs wrote."""
    yield scene
    if importlib.util.find_spec("gsply") is not None:
        import gsply

        copy = folder / "gsply.ply"
        gsply.plywrite(str(copy), gsply.plyread(str(scene)))
        yield copy
    if splat_transform is None:
        return
    for suffix in (".ply", ".compressed.ply", ".spz", ".sog"):
        copy = folder / f"splat-transform{suffix}"
        # One round of clustering of harmonics for a SOG, because a round takes minutes.
        command = [*shlex.split(splat_transform), "-q", "-w", "-g", "cpu", "-i", "1"]
        command += [str(scene), str(copy)]
        subprocess.run(command, check=True, capture_output=True)
        yield copy


def camera_file(cameras: Sequence[Camera], file: Path) -> Path:
    """Write cameras as a file of Spackle's."""
    frames = [
        {
            "K": camera.K.double().tolist(),
            "world_to_camera": camera.world_to_camera.double().tolist(),
            "width": camera.width,
            "height": camera.height,
        }
        for camera in cameras
    ]
    file.write_text(json.dumps({"frames": frames}))
    return file


def mean_holes(gaussians: Gaussians, cameras: Sequence[Camera]) -> float:
    """The mean share of hole pixels."""
    renderer = spackle.get_renderer()
    ratios = [spackle.hole_area_ratio(renderer.render(gaussians, view).alpha) for view in cameras]
    return float(sum(ratios) / len(ratios))


def picture_psnr(one: Gaussians, other: Gaussians, camera: Camera) -> float:
    """PSNR of two scenes at a camera, in dB; infinite if no pixel differs."""
    renderer = spackle.get_renderer()
    difference = renderer.render(one, camera).rgb - renderer.render(other, camera).rgb
    error = float(difference.square().mean())
    return SAME_DB if error == 0 else -10 * math.log10(error)


def compared_rows(source: Path, filled: Path) -> str:
    """Whether a filled file has the source's own rows unchanged, or how far they differ."""
    if source.name.endswith(".ply") and not source.name.endswith(".compressed.ply"):
        is_same = row_bytes(filled).startswith(row_bytes(source))
        return "same bytes" if is_same else "DIFFERENT BYTES"

    if source.name.endswith(".compressed.ply"):
        return "sorted anew"  # a compressed PLY is sorted in space, the file's Gaussians first

    own = load_scene(source).gaussians
    again = load_scene(filled).gaussians.select(slice(0, len(own)))
    largest = 0.0
    for name in ("means", "scales", "opacities", "colors", "harmonics"):
        column = getattr(own, name)
        difference = (column - getattr(again, name)).abs().max() / column.abs().max()
        largest = max(largest, float(difference))
    return f"{largest:.1e}"


def row_bytes(file: Path) -> bytes:
    """The bytes of a PLY's Gaussians."""
    vertex = PlyTables(file).elements_named("vertex")[0]
    return file.read_bytes()[vertex.start_byte :]


def measure(
    source: Path, cameras: Path, ends: Sequence[Camera], photo_camera: Camera, predicted: float
) -> Row:
    """Fill a file by the command, and measure it."""
    filled_file = source.with_name(f"filled_{source.name}")
    start = time.perf_counter()
    command = [sys.executable, "-m", "spackle", "fill", str(source)]
    command += ["--cameras", str(cameras), "-o", str(filled_file)]
    subprocess.run(command, check=True)
    seconds = time.perf_counter() - start

    own = load_scene(source).gaussians
    filled = load_scene(filled_file).gaussians
    return Row(
        scene="",
        file=source.name,
        count=len(own),
        added=len(filled) - len(own),
        before=mean_holes(own, ends),
        after=mean_holes(filled, ends),
        predicted=predicted,
        rows=compared_rows(source, filled_file),
        photo_db=picture_psnr(own, filled, photo_camera),
        constant_db=picture_psnr(own, own.with_harmonics_count(0), photo_camera),
        seconds=seconds,
    )


def rows_of(photo: Path, depth: Path | None, options: argparse.Namespace) -> list[Row]:
    """The rows of one photo."""
    completed = complete(photo, depth)
    scene = completed.scene
    prediction = completed.predicted.prediction
    disparity = prediction.max_disparity
    ends = leftmost_and_rightmost(prediction.camera.even(), disparity, prediction.depth_range)
    # The photo's own camera is among the views, as it is among those of a capture.
    shown = [completed.views.cameras[index] for index in completed.views.views_to_fill]
    step = max(1, len(shown) // options.views)
    views = [prediction.camera, *ends, *shown[::step]]

    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = folder / "spackle.ply"
        content = SceneFile(path=file, gaussians=with_harmonics(scene.base))
        file.write_bytes(encoder_for(file)(content))
        cameras = camera_file(views, folder / "cameras.json")
        for source in saved_files(file, folder, options.splat_transform):
            row = measure(
                source, cameras, ends, prediction.camera, mean_holes(scene.gaussians, ends)
            )
            rows.append(dataclasses.replace(row, scene=photo.parent.name + "/" + photo.stem))
            print(table_line(rows[-1]), flush=True)
    return rows


def table_line(row: Row) -> str:
    """A row of a Markdown table."""
    photo_view = "same" if row.photo_db == SAME_DB else f"{row.photo_db:.1f}"
    cells = (
        row.scene,
        row.file,
        f"{row.count:,} + {row.added:,}",
        f"{row.before:.2%}",
        f"{row.after:.3%}",
        f"{row.predicted:.3%}",
        row.rows,
        photo_view,
        f"{row.constant_db:.1f}",
        f"{row.seconds:.0f}",
    )
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Print the table, and write it as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photos", nargs="+", metavar="PHOTO[,DEPTH]")
    parser.add_argument("--splat-transform", metavar="COMMAND")
    parser.add_argument("--views", type=int, default=9, help="views along the path")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    if options.views < 1:
        raise InputError(f"--views {options.views}: must be at least 1")
    if options.output is not None:
        check_writable(options.output)

    print("| scene | file | Gaussians | holes | filled | by predict | file's rows ", end="")
    print("| photo's view | colour | s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    rows: list[Row] = []
    for words in options.photos:
        photo, _, depth = words.partition(",")
        rows += rows_of(Path(photo), Path(depth) if depth else None, options)
    if options.output is not None:
        options.output.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    sys.exit(run_script(main))
