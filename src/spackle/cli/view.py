"""`spackle view`."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import INTERRUPTED, CheckpointOption, DeviceOption, JsonOption, VerboseOption


def view(
    target: Annotated[Path, typer.Argument(metavar="SCENE_OR_PHOTO", help="A scene (PLY), or a photo to complete.")],
    base: Annotated[
        str, typer.Option(metavar="NAME", help="What turns photos into Gaussians, as `spackle predict` has it.")
    ] = "auto",
    depth: Annotated[Path | None, typer.Option(metavar="FILE", help="Depth of the photo.")] = None,
    checkpoint: CheckpointOption = None,
    disparity: Annotated[float, typer.Option(help="How far photos are completed: 0 to 2; 0.3 is large.")] = 0.3,
    focal_px: Annotated[float | None, typer.Option(help="Focal length in pixels.")] = None,
    fov: Annotated[float | None, typer.Option(help="Horizontal field of view in degrees.")] = None,
    device: DeviceOption = "auto",
    host: Annotated[
        str, typer.Option(metavar="H", help="Listen at this address: 0.0.0.0 lets everybody in the network in.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(metavar="N", help="Listen at this port; 0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = True,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Look at a scene, or complete a photo and look at that, on a page of this machine. Ctrl-C ends it."""
    from spackle.app.view import ViewOptions
    from spackle.app.view import view as view_target
    from spackle.bases.open import BaseSettings
    from spackle.progress import Reporter

    settings = BaseSettings(base, depth, checkpoint=checkpoint, device=device)
    options = ViewOptions(settings, disparity, focal_px, fov, host, port, browser)
    reporter = Reporter(verbose, as_json=as_json)
    if view_target(target, options, reporter):
        raise typer.Exit(INTERRUPTED)
    # A step of a network cannot be interrupted, and Python would wait for it, or fall over it, on its way out.
    reporter.console.show_cursor()
    print("interrupted", file=sys.stderr, flush=True)
    sys.stdout.flush()
    os._exit(INTERRUPTED)
