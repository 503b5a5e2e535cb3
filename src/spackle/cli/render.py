"""`spackle render`, `spackle export` and `spackle view`: a scene as a video, as files, on a page."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spackle.cli.options import (
    INTERRUPTED,
    CheckpointOption,
    DeviceOption,
    InputOption,
    JsonOption,
    KeepFrameOption,
    VerboseOption,
    given_input,
    with_path_options,
)

if TYPE_CHECKING:
    from spackle.views import PathOptions


@with_path_options
def render(
    *,
    scene: Annotated[
        Path | None, typer.Argument(metavar="SCENE.ply", help="A 3D Gaussian scene.", show_default=False)
    ] = None,
    given: InputOption = None,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="OUT", help="A folder, or name.mp4|webm|gif|webp.")],
    path: PathOptions,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels of the video.")] = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Draw a saved scene along a camera path."""
    from spackle.cli.render_scene import render_scene
    from spackle.progress import Reporter

    render_scene(
        given_input("SCENE.ply", scene, given), output, path, focal_px, device, Reporter(verbose, as_json=as_json)
    )


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
    from spackle.cli.export_scene import export_scene
    from spackle.progress import Reporter

    export_scene(scene, output, Reporter(as_json=as_json))


def view(
    target: Annotated[Path, typer.Argument(metavar="SCENE_OR_PHOTO", help="A scene (PLY), or a photo to complete.")],
    base: Annotated[
        str, typer.Option(metavar="NAME", help="What turns photos into Gaussians, as `spackle predict` has it.")
    ] = "auto",
    depth: Annotated[Path | None, typer.Option(metavar="FILE", help="Depth of the photo.")] = None,
    checkpoint: CheckpointOption = None,
    disparity: Annotated[
        float | None,
        typer.Option(
            help="How far photos are completed: 0 to 2; 0.3 is large.", show_default="0.15 with lite, else 0.3"
        ),
    ] = None,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    keep_frame: KeepFrameOption = False,
    device: DeviceOption = "auto",
    host: Annotated[
        str, typer.Option(metavar="H", help="Listen at this address: 0.0.0.0 lets everybody in the network in.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(metavar="N", help="Listen at this port; 0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = True,
    token: Annotated[
        bool,
        typer.Option("--token/--no-token", help="Put a secret into the page's address, without which nobody gets in."),
    ] = True,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Look at a scene, or complete a photo and look at that, on a page of this machine. Ctrl-C ends it."""
    from spackle.bases.settings import BaseSettings
    from spackle.cli.view_page import ViewOptions
    from spackle.cli.view_page import view as view_target
    from spackle.progress import Reporter

    settings = BaseSettings(base, depth, checkpoint=checkpoint, device=device)
    options = ViewOptions(settings, disparity, focal_px, fov, host, port, browser, keep_frame, token)
    reporter = Reporter(verbose, as_json=as_json)
    if view_target(target, options, reporter):
        raise typer.Exit(INTERRUPTED)
    # A step of a network cannot be interrupted, and Python would wait for it, or fall over it, on its way out.
    reporter.console.show_cursor()
    print("interrupted", file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(INTERRUPTED)
