"""`spackle dataset info`, `verify` and `preview`: what a dataset holds, whether it is whole, how it
looks."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.filesize import decimal
from torch import Tensor

from spackle.formats import save_png
from spackle.formats.png import contact_sheet
from spackle.paper.dataset.joined import JoinedDataset
from spackle.paper.dataset.sample import END_OF_ARCHIVE, PhotoGroup
from spackle.paper.dataset.shards import (
    PARTS_FOLDER,
    DatasetFiles,
    Manifest,
    ShardEntry,
    load_manifest,
    open_dataset_file,
    read_part,
)
from spackle.runtime.errors import InputError, as_input_error, printable_line
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Progress, Reporter, pluralized
from spackle.video.encoding import save_video

SHEET_FILE = "sheet.png"
VIDEO_FILE = "trajectory.mp4"
THUMBNAIL_SIDE_PX = 192  # the longer side
PREVIEW_FPS = 8  # slow enough to compare the two halves of a frame


def show_info(location: str, console: Console) -> None:
    """Print a dataset's counts, sizes, holes and configuration; InputError without a manifest."""
    manifest = load_manifest(location)
    sample_count = len(manifest.samples)
    state = "complete" if manifest.complete else "not finished"
    photos = pluralized(sample_count, "photo")
    shards = pluralized(len(manifest.shards), "shard")
    bytes_per_photo = manifest.size // max(1, sample_count)
    lines = [
        printable_line(f"{location}: {state}"),
        f"{photos}, {manifest.views} views, {shards}",
        f"{decimal(manifest.size)}, {decimal(bytes_per_photo)} a photo",
    ]

    # What is missing, and how much there is to learn from: views without holes teach nothing.
    skipped_count = sum(len(shard.passed_over) for shard in manifest.shards)
    if skipped_count:
        lines.append(f"{skipped_count} photos gave no sample: manifest.json says why")
    if sample_count:
        hole_ratios = np.mean([sample.holes for _, sample in manifest.samples], axis=0)  # [views]
        lines.append("holes of each view: " + " ".join(f"{ratio:.1%}" for ratio in hole_ratios))
    lines.append("configuration: " + json.dumps(manifest.config, indent=1, sort_keys=True))
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def verify_datasets(locations: Sequence[str], reporter: Reporter) -> int:
    """Read every byte of some datasets and log each problem; returns the number of problems.

    Several datasets must also belong together, so that training can take them as one. InputError
    if a dataset has no readable manifest, which lists what should be there.
    """
    problem_count = 0
    for location in locations:
        problem_count += _verify_dataset(location, reporter)
    if problem_count == 0 and len(locations) > 1:
        try:
            photos = pluralized(len(JoinedDataset(locations)), "photo")
            reporter.log(f"{len(locations)} datasets make one of {photos}")
        except InputError as error:
            reporter.log(str(error))
            problem_count += 1
    return problem_count


def _verify_dataset(location: str, reporter: Reporter) -> int:
    """Read every byte of a dataset and log each problem; returns the number of problems."""
    manifest = load_manifest(location)
    problem_count = 0
    with reporter.stage("verify") as progress:
        for problem in find_problems(location, manifest, progress):
            reporter.log(f"{location}: {problem}")
            problem_count += 1
    if problem_count == 0:
        size = decimal(manifest.size)
        reporter.log(f"{location}: {len(manifest.samples)} photos, {size}, undamaged")
    return problem_count


def find_problems(
    location: str | os.PathLike[str], manifest: Manifest, progress: Progress
) -> Iterator[str]:
    """Read every byte of a dataset and yield a line for each problem.

    Args:
        location: the dataset: a folder, or a URL for fsspec.
        manifest: of the dataset.
        progress: receives (bytes read, bytes in all).
    """
    if not manifest.complete:
        yield "the dataset is not finished: run the same `spackle dataset build` again"
        yield from find_part_problems(Path(location))
    checked_bytes = 0
    for shard in manifest.shards:
        try:
            for problem in find_shard_problems(location, shard):
                yield f"{shard.file}: {problem}"
        except InputError as error:
            yield str(error)
        # A missing shard counts, too, so that the progress ends at 100 %.
        checked_bytes += shard.size
        progress(checked_bytes, manifest.size)


def find_part_problems(folder: Path) -> Iterator[str]:
    """Yield a line for each damaged part, the sample of a photo that waits for its shard.

    Only a folder has parts; a dataset at a URL has none.
    """
    for path in sorted(folder.glob(f"{PARTS_FOLDER}/*.tar")):
        try:
            read_part(path)
        except (InputError, OSError) as error:
            yield str(error)


def find_shard_problems(location: str | os.PathLike[str], shard: ShardEntry) -> Iterator[str]:
    """Yield a line for each problem of a shard, one tar file of a dataset.

    Its size, the digest of each sample and the end of the archive are checked. InputError if
    reading fails.
    """
    with (
        open_dataset_file(location, shard.file) as file,
        as_input_error(shard.file, "cannot be read: {reason}", OSError),
    ):
        size = file.seek(0, os.SEEK_END)
        if size != shard.size:
            yield f"{size:,} bytes instead of {shard.size:,}"

        # Samples follow each other without gaps, so the file is read from the start to the end.
        file.seek(0)
        is_damaged = False
        for sample in shard.samples:
            if hashlib.sha256(file.read(sample.size)).hexdigest() != sample.sha256:
                is_damaged = True
                yield f"sample {sample.key} ({sample.photo}) is damaged"
        # After a damaged sample, a wrong end would only be the same problem once more.
        if not is_damaged and file.read(len(END_OF_ARCHIVE)) != END_OF_ARCHIVE:
            yield "damaged after its last sample"


def preview_dataset(
    location: str, output: Path, photos: int, views: int, reporter: Reporter
) -> None:
    """Write pictures of a dataset into a folder: sheet.png and trajectory.mp4.

    The sheet has three rows for each photo: what the photo's Gaussians show, the mask of the
    holes, and the target. The video shows the views of the first photo beside their targets.

    Args:
        location: the dataset: a folder, or a URL for fsspec.
        output: the folder.
        photos: number of photos on the sheet.
        views: number of views of each photo on the sheet.
        reporter: says where the files are.

    Raises:
        InputError: the dataset is unfinished or damaged, or the folder cannot be written to.
    """
    files = DatasetFiles(location)
    with results_folder(output, (SHEET_FILE, VIDEO_FILE), locked=True):
        # Photos from the whole dataset, because neighbours by name are often alike.
        groups = [files[index] for index in spread_indices(len(files), photos)]
        rows: list[list[Tensor]] = []
        for group in groups:
            rows += sheet_rows(group, views)
        save_png(contact_sheet(rows, THUMBNAIL_SIDE_PX, fill=1.0), output / SHEET_FILE)
        save_video(frames_beside_targets(groups[0]), output / VIDEO_FILE, fps=PREVIEW_FPS)
    reporter.log(f"{SHEET_FILE} and {VIDEO_FILE} -> {output}")


def sheet_rows(group: PhotoGroup, view_count: int) -> list[list[Tensor]]:
    """Three rows of pictures [H, W, 3] of some of a photo's views: rendering, mask, target."""
    views = [group.view(index) for index in spread_indices(group.views, view_count)]
    renderings = [view.rendering.rgb for view in views]
    masks = [view.mask[..., None].expand(-1, -1, 3).float() for view in views]
    targets = [view.target for view in views]
    return [renderings, masks, targets]


def frames_beside_targets(group: PhotoGroup) -> Iterator[Tensor]:
    """Yield a photo's views along the path, each beside its target, as [H, 2 W, 3] sRGB."""
    # View 0 is the photo's view, which is not on the path.
    for index in range(1, group.views):
        view = group.view(index)
        yield torch.cat([view.rendering.rgb, view.target], dim=1)


def spread_indices(total: int, count: int) -> list[int]:
    """Up to `count` different indices below `total`, evenly spread, the first and last included."""
    positions = np.linspace(0, total - 1, min(count, total))
    return sorted({round(position) for position in positions})
