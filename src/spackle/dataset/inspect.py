"""`spackle dataset info`, `verify` and `preview`: what a dataset holds, whether it is whole, what it looks like."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.filesize import decimal
from torch import Tensor
from torch.nn.functional import interpolate, pad

from spackle.dataset.reader import DatasetFiles
from spackle.dataset.sample import PhotoGroup
from spackle.dataset.shards import load_manifest, problems
from spackle.errors import InputError
from spackle.formats import save_png, save_video
from spackle.output_folder import results_folder
from spackle.progress import Reporter

SHEET, VIDEO = "sheet.png", "trajectory.mp4"
THUMBNAIL = 192  # pixels along its longer side
FPS = 8


def show_info(location: str, console: Console) -> None:
    """Counts, sizes, holes and configuration."""
    manifest = load_manifest(location)
    samples = manifest.samples
    size = sum(shard.size for shard in manifest.shards)
    state = "complete" if manifest.complete else "not finished"
    lines = [f"{location}: {state}", f"{len(samples)} photos, {manifest.views} views, {len(manifest.shards)} shards"]
    lines.append(f"{decimal(size)}, {decimal(size // max(1, len(samples)))} a photo")
    passed = sum(len(shard.passed_over) for shard in manifest.shards)
    if passed:
        lines.append(f"{passed} photos gave no sample: manifest.json says why")
    if samples:
        holes = np.mean([sample.holes for _, sample in samples], axis=0)
        lines.append("holes of each view: " + " ".join(f"{share:.1%}" for share in holes))
    lines.append("configuration: " + json.dumps(manifest.config, indent=1, sort_keys=True))
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def verify_dataset(location: str, reporter: Reporter) -> int:
    """Read every byte; returns how many things are wrong, after a line for each. InputError without a manifest."""
    manifest = load_manifest(location)
    count = 0
    with reporter.stage("verify", {}) as step:
        for line in problems(location, manifest, step):
            reporter.say(f"{location}: {line}")
            count += 1
    if not count:
        size = sum(shard.size for shard in manifest.shards)
        reporter.say(f"{location}: {len(manifest.samples)} photos, {decimal(size)}, as they were written")
    return count


def preview_dataset(location: str, output: Path, photos: int, views: int, reporter: Reporter) -> None:
    """Write a sheet (base, mask and target of some views of some photos) and a video of one path, base beside target.

    Raises:
        InputError: no finished dataset, a damaged one, or a folder that cannot be written to.
    """
    if min(photos, views) < 1:
        raise InputError("--photos and --views must be at least 1")
    files = DatasetFiles(location)
    if not len(files):
        raise InputError(f"{location}: holds no photos")
    with results_folder(output, (SHEET, VIDEO)):
        chosen = [files.group(index) for index in _spread(len(files), photos)]
        save_png(_stack([_block(group, views) for group in chosen], 0), output / SHEET)
        # The path without the photo's own view, which comes before it.
        path = (chosen[0].view(index) for index in range(1, chosen[0].views))
        frames = (torch.cat([view.rendering.rgb, view.target], dim=1) for view in path)
        save_video(frames, output / VIDEO, fps=FPS)
    reporter.say(f"{SHEET} and {VIDEO} -> {output}")


def _spread(total: int, count: int) -> list[int]:
    """Up to `count` places in 0..total, evenly."""
    return sorted({round(place) for place in np.linspace(0, total - 1, min(count, total))})


def _block(group: PhotoGroup, views: int) -> Tensor:
    """Three rows: base, mask and target; a column for each view."""
    columns = []
    for index in _spread(group.views, views):
        view = group.view(index)
        mask = view.mask[..., None].expand(-1, -1, 3).float()
        columns.append(_stack([_small(picture) for picture in (view.rendering.rgb, mask, view.target)], 0))
    return _stack(columns, 1)


def _small(picture: Tensor) -> Tensor:
    height, width = picture.shape[:2]
    scale = min(1.0, THUMBNAIL / max(height, width))
    size = max(1, round(height * scale)), max(1, round(width * scale))
    return interpolate(picture.permute(2, 0, 1)[None], size=size, mode="area")[0].permute(1, 2, 0)


def _stack(pictures: Sequence[Tensor], axis: int) -> Tensor:
    """Pictures in a row or column, the smaller ones filled up with white."""
    longest = max(picture.shape[1 - axis] for picture in pictures)
    filled = []
    for picture in pictures:
        missing = longest - picture.shape[1 - axis]
        filled.append(pad(picture, (0, 0, 0, missing) if axis == 0 else (0, 0, 0, 0, 0, missing), value=1.0))
    return torch.cat(filled, dim=axis)
