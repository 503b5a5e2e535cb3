"""`spackle info`: describe files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import JsonOption


def info(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Scenes, photos, depth maps or clips.")
    ],
    as_json: JsonOption = False,
) -> None:
    """Describe files: size, depth range, Gaussians and camera, and commands that take the file."""
    # Imported here, because the help must not wait for torch.
    from spackle.cli.file_facts import print_facts
    from spackle.cli.messages import CommandReporter

    for file in files:
        print_facts(file, CommandReporter(as_json=as_json))
