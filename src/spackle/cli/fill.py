"""`spackle fill`: a scene of any program without holes in given views."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import DeviceOption, JsonOption


def fill(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A 3D Gaussian scene.")],
    cameras: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="The views to fill, in the scene's world: Spackle's cameras, transforms.json of "
            "nerfstudio, cameras.json of 3DGS, a COLMAP folder and others, see docs/inputs.md.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="FILE", help="Output file, such as filled.ply."),
    ],
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Fill a scene of any program where cameras see holes; its own Gaussians do not change."""
    # Imported here, because the help must not wait for torch.
    from spackle.cli.messages import CommandReporter
    from spackle.results.filled_scene import fill_saved_scene

    fill_saved_scene(scene, output, cameras, CommandReporter(as_json=as_json), device=device)
