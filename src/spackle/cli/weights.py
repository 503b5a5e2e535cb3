"""`spackle weights`: download published weights, make random ones, and list those on this machine."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from spackle.cli.options import JsonOption
from spackle.errors import InputError

if TYPE_CHECKING:  # torch takes seconds to load
    from torch import Tensor

    from spackle.progress import Reporter
    from spackle.weights import PublishedWeights

weights = typer.Typer(help="Download or list weights that others publish.", no_args_is_help=True)


@weights.command("get")
def weights_get(
    name: Annotated[str, typer.Argument(help="Which weights: depth (MoGe-2), sharp, lama or features.")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="OUT", help="A folder, or a file name; default: the weights' folder."),
    ] = None,
    url: Annotated[str | None, typer.Option(help="Download from this mirror.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Download even if the file exists.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Download weights and check their SHA-256; a broken download resumes where it stopped."""
    from rich.filesize import decimal

    from spackle.files import results_folder
    from spackle.progress import Reporter
    from spackle.weights import file_digest, published_weights, weights_folder

    reporter, entry = Reporter(as_json=as_json), published_weights(name)
    path = (output or weights_folder()) / entry.file
    if output is not None and output.suffix.lower() == path.suffix and not os.path.isdir(output):
        path = output
    summary = f"{name}: {decimal(entry.bytes)}, SHA-256 {entry.sha256}"
    new = force or not os.path.isfile(path)
    if new:
        with results_folder(path.parent, [path.name], alone=True):
            _fetch(entry, url or entry.address, path, reporter)
        reporter.log(f"{summary} -> {path}" + ("" if output is None else f"; {entry.option}"))
    else:
        with reporter.stage("check"):
            if file_digest(path) != entry.sha256:
                raise InputError(f"{path}: damaged, or your own: SHA-256 is not {entry.sha256}: --force replaces it")
        reporter.log(f"{summary}, already downloaded and intact: {path}")
    reporter.result({"name": name, "file": path, "bytes": entry.bytes, "sha256": entry.sha256, "downloaded": new})


def _fetch(entry: PublishedWeights, url: str, path: Path, reporter: Reporter) -> None:
    """Download weights; prints their licence notice once the first bytes arrive."""
    from urllib.parse import urlsplit

    from spackle.weights.download import check_url, download

    check_url(url)
    parts = urlsplit(url)
    if parts.scheme == "http" and parts.hostname not in ("localhost", "127.0.0.1", "::1"):
        reporter.log(f"{entry.name}: warning: http:// is not encrypted: others on the way see what is downloaded")
    notice = iter(entry.notice)
    with reporter.transfer(entry.name) as step:

        def advance(done: int, total: int) -> None:
            for line in notice:  # once, when bytes arrive: without a download no licence applies
                reporter.log(line)
            step(done, total)

        try:
            download(url, path, entry.bytes, entry.sha256, advance)
        except KeyboardInterrupt:
            reporter.log(f"{entry.name}: the bytes received so far are kept; the same command resumes from there")
            raise


@weights.command("make")
def weights_make(
    output: Annotated[Path, typer.Argument(metavar="FILE", help="A name that ends in .pt or .safetensors.")],
    size: Annotated[
        Literal["full", "tiny", "micro", "lama"],
        typer.Option(help="SHARP in its published size or two test sizes, or LaMa."),
    ] = "full",
) -> None:
    """Make random weights in SHARP's or LaMa's shapes, the same each time, to try all commands without a download."""
    suffix = output.suffix.lower()
    if suffix not in (".pt", ".safetensors"):
        raise InputError(f"{output}: give a name that ends in .pt or .safetensors")
    import torch
    from safetensors.torch import save_file

    from spackle.bases.sharp.base import expected_shapes
    from spackle.bases.sharp.encoder import CONFIGS
    from spackle.files import atomic_path, results_folder
    from spackle.progress import Reporter

    with results_folder(output.parent, [output.name]), atomic_path(output) as temporary:
        tensors = lama_weights() if size == "lama" else deterministic_weights(expected_shapes(CONFIGS[size]))
        (torch.save if suffix == ".pt" else save_file)(tensors, temporary)
    count = sum(tensor.numel() for tensor in tensors.values())
    name, numbers = size if size == "lama" else f"sharp ({size})", f"{count / 1e6:.2f} M random numbers"
    Reporter().log(f"{name}: {numbers}, the same each time; they show no scene -> {output}")


def deterministic_weights(shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Tensor]:
    """A state dict [name → float32 tensor] that depends on names and shapes alone, and shows no scene.

    The scale of each kind is such that signals neither die nor explode, and the Gaussians fill the picture.
    """
    import zlib

    import numpy as np
    import torch

    def made(name: str, shape: tuple[int, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        generator = np.random.Generator(np.random.Philox(zlib.crc32(name.encode())))
        x = generator.standard_normal(shape, dtype=np.float32)
        if name.endswith(("pos_embed", "cls_token")):
            return np.float32(0.02) * x
        if name.endswith(".gamma"):
            return np.float32(0.1) * (1 + np.float32(0.1) * x)
        if name.endswith("monodepth_predictor.head.4.bias"):
            return 1 + np.float32(0.1) * x  # disparities around one
        if len(shape) > 1:
            return x / np.float32(np.sqrt(np.prod(shape[1:])))
        return 1 + np.float32(0.1) * x if name.endswith("weight") else np.float32(0.02) * x

    return {name: torch.from_numpy(made(name, shape)) for name, shape in shapes.items()}


def lama_weights(*size: int) -> dict[str, Tensor]:
    """`deterministic_weights` for LaMa's generator, of the given width and depth if any; variances are around one."""
    from spackle.inpaint.lama import expected_shapes

    made = deterministic_weights(expected_shapes(*size))
    return {name: 1 + 5 * x.abs() if name.endswith("running_var") else x for name, x in made.items()}


@weights.command("list")
def weights_list(as_json: JsonOption = False) -> None:
    """List the published weights, and say which are on this machine."""
    from rich.filesize import decimal

    from spackle.progress import Reporter
    from spackle.weights import PUBLISHED, weights_folder

    reporter, folder = Reporter(as_json=as_json), weights_folder()
    for entry in PUBLISHED.values():
        file, state = folder / entry.file, "not here"
        if os.path.isfile(file):  # only its size is checked, which takes no time
            size = os.path.getsize(file)
            state = "whole" if size == entry.bytes else f"damaged, or your own: {size:,} bytes"
        facts = {"name": entry.name, "state": state, "file": file, "bytes": entry.bytes, "licence": entry.licence}
        reporter.result({**facts, "purpose": entry.purpose})
        if not as_json:
            print(f"{entry.name:9} {state:9} {decimal(entry.bytes):>8}  {entry.licence:20} {entry.purpose}")
    if not as_json:
        print(f"in {folder} (SPACKLE_WEIGHTS names another)")
