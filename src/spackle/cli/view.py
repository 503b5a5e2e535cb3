"""`spackle view`: a scene, or a photo that becomes one, in the browser."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import (
    INTERRUPTED,
    CheckpointOption,
    DepthKindOption,
    DepthUnitOption,
    DeviceOption,
    FovOption,
    HostOption,
    JsonOption,
    KeepFrameOption,
    PortOption,
    VerboseOption,
    declared,
)

TOKEN_BYTES = 16  # of the secret in the page's address


def view(
    target: Annotated[
        Path | None,
        typer.Argument(
            metavar="SCENE_OR_PHOTO",
            help="A scene, or a photo to complete; by default the page is empty.",
        ),
    ] = None,
    base: Annotated[
        str, typer.Option(metavar="NAME", help="Base, as for `spackle predict`.")
    ] = "auto",
    depth: Annotated[Path | None, typer.Option(metavar="FILE", help="Depth of the photo.")] = None,
    depth_kind: DepthKindOption = "auto",
    depth_unit: DepthUnitOption = None,
    checkpoint: CheckpointOption = None,
    disparity: Annotated[float | None, declared("disparity")] = None,
    focal_px: Annotated[float | None, declared("focal_px")] = None,
    fov: FovOption = None,
    keep_frame: KeepFrameOption = False,
    device: DeviceOption = "auto",
    host: HostOption = "127.0.0.1",
    port: PortOption = 0,
    browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in a browser.")
    ] = True,
    token: Annotated[
        bool,
        typer.Option(
            "--token/--no-token",
            help="Put a secret token into the page's address. With --no-token everybody on this "
            "machine can open the page, and nobody can send photos.",
        ),
    ] = True,
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Open a page in the browser that shows a scene or completes photos. Ctrl-C ends the server."""
    # Imported here, because the help must not wait for torch.
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.web.local_server import ServerAddress, ViewOptions, show_page

    options = ViewOptions(
        base=BaseSettings(
            name=base,
            depth=depth,
            depth_kind=depth_kind,
            depth_unit=depth_unit,
            checkpoint=checkpoint,
            device=device,
        ),
        disparity=disparity,
        focal_px=focal_px,
        fov=fov,
        keep_frame=keep_frame,
        opens_browser=browser,
    )
    # A new secret for each run, which only who sees the address knows.
    address = ServerAddress(
        host=host, port=port, token=secrets.token_urlsafe(TOKEN_BYTES) if token else None
    )
    show_page(target, options, address, CommandReporter(verbose, as_json=as_json))
    # The server returns only after Ctrl-C.
    raise typer.Exit(INTERRUPTED)
