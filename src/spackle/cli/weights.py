"""`spackle weights`: download published weights, and list the weights on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from spackle.cli.options import JsonOption
from spackle.runtime.errors import InputError

weights = typer.Typer(help="Download or list weights that others publish.", no_args_is_help=True)


@weights.command("get")
def weights_get(
    name: Annotated[
        str, typer.Argument(help="Which weights: depth (MoGe-2), sharp, lama or features.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            metavar="OUT",
            help="A folder, or a file name; default: the weights' folder.",
        ),
    ] = None,
    url: Annotated[str | None, typer.Option(help="Download from this mirror.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Download even if the file exists.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Download weights and check their SHA-256; a broken download resumes where it stopped."""
    from rich.filesize import decimal

    from spackle.cli.messages import CommandReporter
    from spackle.runtime.folders import results_folder
    from spackle.weights import published_weights, weights_digest, weights_folder
    from spackle.weights.download import download

    reporter, entry = CommandReporter(as_json=as_json), published_weights(name)
    path = (output or weights_folder()) / entry.file
    if output is not None and output.suffix.lower() == path.suffix and not os.path.isdir(output):
        path = output
    summary = f"{name}: {decimal(entry.bytes)}, SHA-256 {entry.sha256}"
    new = force or not os.path.isfile(path)
    if new:
        with results_folder(path.parent, [path.name], locked=True), reporter.transfer(name) as step:
            download(url or entry.address, path, entry.bytes, entry.sha256, step)
        for line in entry.notice:  # without a download no licence applies
            reporter.log(line)
        reporter.log(f"{summary} -> {path}" + ("" if output is None else f"; {entry.option}"))
    else:
        with reporter.stage("check"):
            if weights_digest(path) != entry.sha256:
                raise InputError(
                    f"{path}: damaged, or a file of yours: SHA-256 is not {entry.sha256}: use --force"
                )
        reporter.log(f"{summary}, already downloaded and intact: {path}")
    reporter.result(
        {
            "name": name,
            "file": path,
            "bytes": entry.bytes,
            "sha256": entry.sha256,
            "downloaded": new,
        }
    )


@weights.command("list")
def weights_list(as_json: JsonOption = False) -> None:
    """List the published weights, and say which are on this machine."""
    from rich.filesize import decimal

    from spackle.cli.messages import CommandReporter
    from spackle.weights import PUBLISHED_WEIGHTS, weights_folder

    reporter, folder = CommandReporter(as_json=as_json), weights_folder()
    for entry in PUBLISHED_WEIGHTS.values():
        file, state = folder / entry.file, "not here"
        if os.path.isfile(file):
            size = os.path.getsize(file)
            state = (
                "whole" if size == entry.bytes else f"damaged, or a file of yours: {size:,} bytes"
            )
        facts = {
            "name": entry.name,
            "state": state,
            "file": file,
            "bytes": entry.bytes,
            "licence": entry.licence,
        }
        reporter.result({**facts, "purpose": entry.purpose})
        if not as_json:
            print(
                f"{entry.name:9} {state:9} {decimal(entry.bytes):>8}  {entry.licence:20} {entry.purpose}"
            )
    if not as_json:
        print(f"in {folder} (SPACKLE_WEIGHTS names another)")
