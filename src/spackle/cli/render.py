"""`spackle render` and `spackle export`: what becomes of a scene's file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spackle.cli.options import DeviceOption, JsonOption, VerboseOption, with_path_options

if TYPE_CHECKING:
    from spackle.app.video import PathOptions


@with_path_options
def render(
    *,
    scene: Annotated[Path, typer.Option("-i", "--input", metavar="SCENE.ply", help="A 3D Gaussian scene.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="A folder, or name.mp4|webm|gif|webp.")],
    path: PathOptions,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of the video.")] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Draw a saved scene along a camera path."""
    from spackle.app.render import render_scene
    from spackle.progress import Reporter

    render_scene(scene, output, path, focal_px, device, Reporter(verbose, as_json=as_json))


def export(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.ply", help="A 3D Gaussian scene.")],
    output: Annotated[
        list[Path],
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Ends in .ply, .compressed.ply, .spz, .splat, .sog, .glb or .html, which is a page with the scene "
            "in it; give as many as you like.",
        ),
    ],
    as_json: JsonOption = False,
) -> None:
    """Write a scene in the formats that other viewers read."""
    from spackle.app.export import export_scene
    from spackle.progress import Reporter

    export_scene(scene, output, Reporter(as_json=as_json))
