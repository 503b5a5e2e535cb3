"""`spackle weights`: download published weights, and list the weights on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from spackle.cli.options import WEIGHTS, JsonOption
from spackle.runtime.errors import InputError

if TYPE_CHECKING:  # help must not wait for the library
    from spackle.weights import PublishedWeights

weights = typer.Typer(help="Download or list weights that others publish.", no_args_is_help=True)


@weights.command("get")
def weights_get(
    name: Annotated[str, typer.Argument(help=f"Which weights: {WEIGHTS}.")],
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
    # Imported here, because the help must not wait for torch.
    from rich.filesize import decimal

    from spackle.cli.messages import CommandReporter
    from spackle.runtime.folders import results_folder
    from spackle.weights import published_weights, weights_digest
    from spackle.weights.download import download

    reporter = CommandReporter(as_json=as_json)
    entry = published_weights(name)
    path = _target_file(entry, output)
    summary = f"{name}: {decimal(entry.bytes)}, SHA-256 {entry.sha256}"
    is_download_needed = force or not os.path.isfile(path)
    if is_download_needed:
        with (
            results_folder(path.parent, [path.name], locked=True),
            reporter.transfer(name) as progress,
        ):
            download(url or entry.address, path, entry.bytes, entry.sha256, progress)
        # The licence binds whoever has downloaded the weights just now.
        for line in entry.notice:
            reporter.log(line)
        # In the weights' folder they are found by themselves; elsewhere an option has to name them.
        how_to_use = "" if output is None else f"; {entry.option}"
        reporter.log(f"{summary} -> {path}{how_to_use}")
    else:
        # The file may be another one of the same name, or damaged on the disk.
        with reporter.stage("check"):
            if weights_digest(path) != entry.sha256:
                raise InputError(
                    f"{path}: damaged, or a file of yours: SHA-256 is not {entry.sha256}: "
                    "use `force`"
                )
        reporter.log(f"{summary}, already downloaded and intact: {path}")
    reporter.result(
        {
            "name": name,
            "file": path,
            "bytes": entry.bytes,
            "sha256": entry.sha256,
            "downloaded": is_download_needed,
        }
    )


def _target_file(entry: PublishedWeights, output: Path | None) -> Path:
    """The file to which weights are downloaded.

    Without `output` it lies in the folder of all weights. `output` is the file itself if it ends as
    weights do, else a folder.
    """
    # Imported here, because the help must not wait for torch.
    from spackle.weights import weights_folder

    if output is None:
        return weights_folder() / entry.file
    has_suffix_of_weights = output.suffix.lower() == Path(entry.file).suffix
    # A folder may have any name, even one that ends as weights do.
    if has_suffix_of_weights and not os.path.isdir(output):
        return output
    return output / entry.file


@weights.command("list")
def weights_list(as_json: JsonOption = False) -> None:
    """List the published weights, and say which are on this machine."""
    # Imported here, because the help must not wait for torch.
    from rich.filesize import decimal

    from spackle.cli.messages import CommandReporter
    from spackle.weights import PUBLISHED_WEIGHTS, weights_folder

    reporter = CommandReporter(as_json=as_json)
    folder = weights_folder()
    for entry in PUBLISHED_WEIGHTS.values():
        file = folder / entry.file
        state = _state_of(file, entry)
        reporter.result(
            {
                "name": entry.name,
                "state": state,
                "file": file,
                "bytes": entry.bytes,
                "licence": entry.licence,
                "purpose": entry.purpose,
            }
        )
        if not as_json:
            size = decimal(entry.bytes)
            print(f"{entry.name:9} {state:9} {size:>8}  {entry.licence:20} {entry.purpose}")
    if not as_json:
        print(f"in {folder} (SPACKLE_WEIGHTS names another)")


def _state_of(file: Path, entry: PublishedWeights) -> str:
    """Whether weights are on this machine, in a word or two."""
    # Sizes are compared, not digests, because to read gigabytes would take too long for a list.
    if not os.path.isfile(file):
        return "not here"
    size = os.path.getsize(file)
    if size == entry.bytes:
        return "whole"
    return f"damaged, or a file of yours: {size:,} bytes"
