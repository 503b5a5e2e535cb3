"""`spackle dataset info`, `verify` and `preview`: a dataset's contents, its integrity, and its images."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.filesize import decimal
from torch import Tensor

from spackle.formats import save_png
from spackle.formats.png import contact_sheet
from spackle.paper.dataset.sample import END_OF_ARCHIVE
from spackle.paper.dataset.shards import (
    DatasetFiles,
    Manifest,
    ShardEntry,
    load_manifest,
    open_dataset_file,
)
from spackle.runtime.errors import InputError, as_input_error, printable_line
from spackle.runtime.folders import results_folder
from spackle.runtime.progress import Progress, Reporter, pluralized
from spackle.video.encoding import save_video

SHEET_FILE = "sheet.png"
VIDEO_FILE = "trajectory.mp4"
THUMBNAIL_SIDE_PX = 192  # pixels of a thumbnail's longer side
PREVIEW_FPS = 8


def show_info(location: str, console: Console) -> None:
    """Print a dataset's counts, sizes, holes and configuration."""
    manifest = load_manifest(location)
    samples = manifest.samples
    lines = [
        printable_line(f"{location}: {'complete' if manifest.complete else 'not finished'}"),
        f"{pluralized(len(samples), 'photo')}, {manifest.views} views, {pluralized(len(manifest.shards), 'shard')}",
        f"{decimal(manifest.size)}, {decimal(manifest.size // max(1, len(samples)))} a photo",
    ]
    if skipped := sum(len(shard.passed_over) for shard in manifest.shards):
        lines.append(f"{skipped} photos gave no sample: manifest.json says why")
    if samples:
        holes = np.mean([sample.holes for _, sample in samples], axis=0)
        lines.append("holes of each view: " + " ".join(f"{share:.1%}" for share in holes))
    lines.append("configuration: " + json.dumps(manifest.config, indent=1, sort_keys=True))
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def verify_dataset(location: str, reporter: Reporter) -> int:
    """Read every byte and log each problem; returns the number of problems. InputError without a manifest."""
    manifest = load_manifest(location)
    count = 0
    with reporter.stage("verify") as step:
        for line in find_problems(location, manifest, step):
            reporter.log(f"{location}: {line}")
            count += 1
    if not count:
        reporter.log(
            f"{location}: {len(manifest.samples)} photos, {decimal(manifest.size)}, undamaged"
        )
    return count


def find_problems(
    location: str | os.PathLike[str], manifest: Manifest, progress: Progress
) -> Iterator[str]:
    """Read every byte of a dataset and yield a line for each problem. `progress` counts bytes."""
    done = 0
    if not manifest.complete:
        yield "the dataset is not finished: run the same `spackle dataset build` again"
    for shard in manifest.shards:
        try:
            yield from (f"{shard.file}: {line}" for line in find_shard_problems(location, shard))
        except InputError as error:
            yield str(error)
        done += shard.size
        progress(done, manifest.size)


def find_shard_problems(location: str | os.PathLike[str], shard: ShardEntry) -> Iterator[str]:
    """Check a shard's size, the digest of each sample, and the end of the archive; InputError if reading fails."""
    with (
        open_dataset_file(location, shard.file) as file,
        as_input_error(shard.file, "cannot be read: {reason}", OSError),
    ):
        size = file.seek(0, os.SEEK_END)
        if size != shard.size:
            yield f"{size:,} bytes instead of {shard.size:,}"
        file.seek(0)
        damaged = False
        for sample in shard.samples:
            if hashlib.sha256(file.read(sample.size)).hexdigest() != sample.sha256:
                damaged = True
                yield f"sample {sample.key} ({sample.photo}) is damaged"
        if not damaged and file.read(len(END_OF_ARCHIVE)) != END_OF_ARCHIVE:
            yield "damaged after its last sample"


def preview_dataset(
    location: str, output: Path, photos: int, views: int, reporter: Reporter
) -> None:
    """Write a sheet of base, mask and target for some views of some photos, and a video that shows base beside target.

    InputError if the dataset is unfinished or damaged, or the folder cannot be written to.
    """
    files = DatasetFiles(location)
    with results_folder(output, (SHEET_FILE, VIDEO_FILE), locked=True):
        groups = [files[index] for index in spread_indices(len(files), photos)]
        rows: list[list[Tensor]] = []
        for group in groups:
            chosen = [group.view(index) for index in spread_indices(group.views, views)]
            masks = [view.mask[..., None].expand(-1, -1, 3).float() for view in chosen]
            rows += [
                [view.rendering.rgb for view in chosen],
                masks,
                [view.target for view in chosen],
            ]
        save_png(contact_sheet(rows, THUMBNAIL_SIDE_PX, fill=1.0), output / SHEET_FILE)
        # View 0 is the photo's view, which is not on the path.
        path = (groups[0].view(index) for index in range(1, groups[0].views))
        save_video(
            (torch.cat([view.rendering.rgb, view.target], dim=1) for view in path),
            output / VIDEO_FILE,
            fps=PREVIEW_FPS,
        )
    reporter.log(f"{SHEET_FILE} and {VIDEO_FILE} -> {output}")


def spread_indices(total: int, count: int) -> list[int]:
    return sorted({round(place) for place in np.linspace(0, total - 1, min(count, total))})
