"""`spackle export`: a scene in the formats that other viewers read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import JsonOption


def export(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A 3D Gaussian scene.")],
    output: Annotated[
        list[Path],
        typer.Option(
            "-o",
            "--output",
            metavar="FILE",
            help="Output file; the suffix sets the format: .ply, .compressed.ply, .spz, .v4.spz "
            "(SPZ version 4, for PlayCanvas), .splat, .sog, .glb, or .html (a page that shows the "
            "picture and its motion, for sending). The option may be repeated.",
        ),
    ],
    caption: Annotated[
        str,
        typer.Option(metavar="TEXT", help="Text below the picture of a page.", show_default="none"),
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Write a scene in the formats that other viewers read."""
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.results.saved_scene import export_scene

    export_scene(scene, output, CommandReporter(as_json=as_json), caption=caption)
