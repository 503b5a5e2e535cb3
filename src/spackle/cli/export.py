"""`spackle export`, as the command line has it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import JsonOption


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(short_help="A scene for other viewers, or as one page to send")(export)


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
    from spackle.jobs.export import export_scene
    from spackle.progress import Reporter

    export_scene(scene, output, Reporter(as_json=as_json))
