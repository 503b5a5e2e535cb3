"""`spackle serve`: complete photos for programs, over HTTP."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import (
    INTERRUPTED,
    CheckpointOption,
    DeviceOption,
    HostOption,
    JsonOption,
    PortOption,
    VerboseOption,
)

TOKEN_BYTES = 16  # of the secret that clients send
SECONDS_A_DAY = 86400
BYTES_A_GB = 1e9


def serve(
    host: HostOption = "127.0.0.1",
    port: PortOption = 8080,
    token: Annotated[
        str | None,
        typer.Option(
            help="The token that clients must send.",
            show_default="a new one",
            envvar="SPACKLE_TOKEN",
        ),
    ] = None,
    clients: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="YAML file of more tokens, each with a name, a limit and scenes of its own; see "
            "docs/http.md.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=64,
            help="Number of processes that share the photos, each with its own copy of the base's "
            "network; default: one for each GPU, or one.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="OUT", help="Folder of photos and scenes.")
    ] = Path("spackle-scenes"),
    keep: Annotated[
        float, typer.Option(min=0, metavar="DAYS", help="Delete scenes after this number of days.")
    ] = 7,
    quota: Annotated[
        float,
        typer.Option(min=0, metavar="GB", help="Delete the oldest scenes if all take more space."),
    ] = 20,
    waiting: Annotated[
        int,
        typer.Option(
            min=1, metavar="N", help="Number of photos that may wait; more photos are refused."
        ),
    ] = 32,
    timeout: Annotated[
        float,
        typer.Option(
            min=1,
            metavar="SECONDS",
            help="Seconds that the work on a photo, or on a file of its scene, may take; then it "
            "fails.",
        ),
    ] = 3600,
    allowed_host: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="A host name by which clients call the server, such as photos.example.com; "
            "may be repeated.",
        ),
    ] = None,
    public_url: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Address of the page behind a reverse proxy, such as https://example.com/photos; "
            "its host name is allowed.",
        ),
    ] = None,
    proxy: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address or network of a reverse proxy whose X-Forwarded-Host is believed; "
            "may be repeated.",
        ),
    ] = None,
    callback_host: Annotated[
        list[str] | None,
        typer.Option(
            metavar="HOST",
            help="A host that may be told that a scene is done, if a client sends callback_url; "
            "may be repeated.",
        ),
    ] = None,
    cors: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ORIGIN",
            help="Origin of another site whose pages may use the interface with the token, such as "
            "https://gallery.example.com; may be repeated.",
        ),
    ] = None,
    base: Annotated[
        str, typer.Option(metavar="NAME", help="Base, as for `spackle predict`.")
    ] = "auto",
    checkpoint: CheckpointOption = None,
    device: DeviceOption = "auto",
    as_json: JsonOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Serve an HTTP interface and a page that complete photos (see docs/http.md).

    Ctrl-C ends the server.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.bases.settings import BaseSettings
    from spackle.cli.messages import CommandReporter
    from spackle.web.clients import read_clients
    from spackle.web.jobs import RetentionLimits
    from spackle.web.local_server import ServerAddress, serve_programs
    from spackle.web.public_address import PublicAddress
    from spackle.web.work import SceneWork

    # Without a token, or with an empty one, the server makes its own and prints it: it never runs
    # open to everybody.
    base_settings = BaseSettings(name=base, checkpoint=checkpoint, device=device)
    serve_programs(
        output,
        SceneWork(base_settings, verbose=verbose),
        workers,
        RetentionLimits(keep * SECONDS_A_DAY, quota * BYTES_A_GB, waiting, timeout),
        ServerAddress(
            host=host,
            port=port,
            token=token or secrets.token_urlsafe(TOKEN_BYTES),
            public=PublicAddress(
                allowed_hosts=tuple(allowed_host or ()),
                url=public_url,
                proxies=tuple(proxy or ()),
                page_origins=tuple(cors or ()),
            ),
            clients=() if clients is None else read_clients(clients),
            callback_hosts=tuple(callback_host or ()),
        ),
        CommandReporter(verbose, as_json=as_json),
    )
    # The server returns only after Ctrl-C.
    raise typer.Exit(INTERRUPTED)
