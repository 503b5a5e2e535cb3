"""`spackle weights`: download published weights, and list those on this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import urlsplit

import torch
from rich.console import Console
from rich.filesize import decimal
from rich.table import Table
from safetensors.torch import save_file
from torch import Tensor

from spackle.bases.hf import NOT_INSTALLED, fetch_revision
from spackle.bases.sharp.checkpoint import deterministic_weights, expected_shapes
from spackle.bases.sharp.layers import CONFIGS
from spackle.downloads import (
    WEIGHTS,
    DownloadRecord,
    HubFiles,
    KnownWeights,
    check_recorded,
    download,
    known_weights,
    read_record,
    weights_folder,
)
from spackle.downloads.transfer import digest, write_json
from spackle.errors import InputError
from spackle.files import atomic_path, hold, results_folder
from spackle.inpaint import lama_network
from spackle.progress import Reporter


def get_weights(
    name: str, output: Path | None, reporter: Reporter, *, url: str | None = None, force: bool = False
) -> Path:
    """Download known weights unless they are there, or always with `force`; returns their file.

    `output` is a folder, or a file name with the weights' suffix (None: the weights' folder); `url` is a mirror.
    InputError for an unknown name, and for a file that cannot be downloaded, cannot be written or is damaged.
    """
    known = known_weights(name)
    if known.hub is not None:
        if url is not None:
            raise InputError(f"--url {url}: {name} comes through huggingface_hub: name a mirror in HF_ENDPOINT")
        path = (output or weights_folder()) / known.file
    elif output is None:
        path = weights_folder() / known.file
    elif output.suffix.lower() == Path(known.file).suffix and not os.path.isdir(output):
        path = output
    else:
        path = output / known.file
    record: DownloadRecord | None
    new = force or not os.path.isfile(path)
    if new:
        with results_folder(path.parent, [path.name]):
            if known.hub is not None:
                record = _fetch(known, known.hub, path, reporter)
            else:
                record = _download(known, known.url if url is None else url, path, reporter)
        hint = "" if output is None else f"; {known.named_by}"
        reporter.log(f"{_summary(known, record)} -> {path}{hint}")
    else:
        with reporter.stage("check"):
            record = check_recorded(path)
        if record is None:
            unchecked = "there already, unchecked for want of a record; --force downloads it again"
            reporter.log(f"{known.name}: {unchecked}: {path}")
        else:
            reporter.log(f"{_summary(known, record)}, there already and intact: {path}")
    if known.hub is not None and find_spec("transformers") is None:
        reporter.log(f"{known.name}: not to be used yet: {NOT_INSTALLED}")
    sha256 = None if record is None else record.sha256
    size = os.path.getsize(path)
    reporter.result({"name": known.name, "file": path, "bytes": size, "sha256": sha256, "downloaded": new})
    return path


def make_weights(output: Path, size: str, reporter: Reporter) -> None:
    """Write random weights of SHARP, "full" or "tiny", or of "lama"; InputError for a suffix but .pt, .safetensors."""
    suffix = output.suffix.lower()
    if suffix not in (".pt", ".safetensors"):
        raise InputError(f"{output}: give a name that ends in .pt or .safetensors")
    with results_folder(output.parent, [output.name]), atomic_path(output) as temporary:
        tensors = lama_weights() if size == "lama" else deterministic_weights(expected_shapes(CONFIGS[size]))
        if suffix == ".pt":
            torch.save(tensors, temporary)
        else:
            save_file(tensors, temporary)
    count = sum(tensor.numel() for tensor in tensors.values())
    name, numbers = size if size == "lama" else f"sharp ({size})", f"{count / 1e6:.2f} M random numbers"
    reporter.log(f"{name}: {numbers}, the same each time; they show no scene -> {output}")


def lama_weights(width: int = lama_network.WIDTH, blocks: int = lama_network.BLOCKS) -> dict[str, Tensor]:
    """`deterministic_weights` of LaMa's generator, with variances around one."""
    made = deterministic_weights(lama_network.expected_shapes(width, blocks))
    return {name: 1 + 5 * x.abs() if name.endswith("running_var") else x for name, x in made.items()}


def list_weights(reporter: Reporter, console: Console) -> None:
    """A table of the known weights; of those that are here the size alone is checked, which takes no time."""
    folder, table = weights_folder(), Table(box=None, pad_edge=False)
    for header in ("name", "state", "file", "licence"):
        table.add_column(header, overflow="fold")
    for known in WEIGHTS.values():
        file, state = folder / known.file, _state(folder / known.file)
        reporter.result({"name": known.name, "state": state, "file": file, "licence": known.licence})
        table.add_row(known.name, state, known.file, known.licence)
    if reporter.as_json:
        return
    console.print(table)
    console.print(f"in {folder} (SPACKLE_WEIGHTS names another)", markup=False, soft_wrap=True)


def _download(known: KnownWeights, url: str, path: Path, reporter: Reporter) -> DownloadRecord:
    noticed, parts = False, urlsplit(url)
    if parts.scheme == "http" and parts.hostname not in ("localhost", "127.0.0.1", "::1"):
        reporter.log(f"{known.name}: warning: http:// is not encrypted: others on the way can change the file")
    with reporter.transfer(known.name) as step:

        def advance(done: int, total: int) -> None:
            nonlocal noticed
            if not noticed:  # not before: where nothing comes, nothing needs a licence
                noticed = True
                for line in known.notice:
                    reporter.log(line)
            step(done, total)

        try:
            return download(url, path, advance, known.published)
        except KeyboardInterrupt:
            if noticed:
                reporter.log(f"{known.name}: what has come is kept; the same command goes on from there")
            raise


def _fetch(known: KnownWeights, hub: HubFiles, path: Path, reporter: Reporter) -> DownloadRecord:
    """Files of the hub, by way of a folder beside `path`'s that keeps what has come of a fetch that broke off."""
    for line in known.notice:
        reporter.log(line)
    folder, part = path.parent, path.parent.with_name(f"{path.parent.name}.part")
    try:
        with hold(path.with_name(f"{path.name}.lock")):
            with reporter.stage("download"):
                fetch_revision(hub.model, hub.revision, [path.name, *hub.others], part)
            with open(part / path.name, "rb") as file:
                record = DownloadRecord(known.url, os.path.getsize(part / path.name), digest(file).hexdigest())
            if record.sha256 != hub.sha256:
                shutil.rmtree(part)
                raise InputError(f"{known.url}: what came has not the SHA-256 {hub.sha256}: it is another file")
            write_json(dataclasses.asdict(record), part / f"{path.name}.json")
            for name in (*hub.others, f"{path.name}.json", path.name):  # the weights last: they tell that all is here
                os.replace(part / name, folder / name)
    except BlockingIOError as error:
        raise InputError(f"{path}: another process is downloading this file: wait until it is done") from error
    except OSError as error:
        raise InputError(
            f"{path}: cannot write: {error.strerror or error}: make room or choose another folder"
        ) from error
    with contextlib.suppress(OSError):  # what huggingface_hub notes
        shutil.rmtree(part)
    return record


def _summary(known: KnownWeights, record: DownloadRecord) -> str:
    return f"{known.name}: {decimal(record.size)}, SHA-256 {record.sha256}"


def _state(path: Path) -> str:
    if not os.path.isfile(path):
        return "not here"
    size = os.path.getsize(path)
    try:
        record = read_record(path)
    except InputError:
        return f"{decimal(size)}, damaged record"
    if record is None:
        return f"{decimal(size)}, no record"
    return f"{decimal(size)}, whole" if size == record.size else f"damaged: {size:,} of {record.size:,} bytes"
