"""What an evaluation's folder holds for a report: pictures of each image, and a page of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import Image
from torch import Tensor

from spackle.evaluation.report import Source, make_report
from spackle.evaluation.report.pictures import SIDE, encode
from spackle.evaluation.results import Run
from spackle.evaluation.sheets import columns, cut, thumbnail
from spackle.evaluation.tables import make_tables
from spackle.formats import atomic_path
from spackle.formats.png import to_bytes
from spackle.jobs.evaluate.store import IMAGES, RESULTS, TIMES, load_run, read_json, stem_of, write_text

REPORT = "report.html"
BENCH = "bench.json"  # of `spackle bench`


def picture_suffix(name: str) -> str:
    """How the file of a method's picture ends; "truth" is one of them."""
    return f".{name}.webp"


def save_picture(picture: Tensor, path: Path) -> None:
    """[H, W, 3] sRGB 0..1 as WebP, smaller where it is large."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode(Image.fromarray(to_bytes(thumbnail(picture, SIDE)).numpy())))


def load_pictures(run: Run, index: int, folder: Path) -> dict[str, bytes]:
    """The pictures of an image, as WebP.

    Args:
        run: of that folder.
        index: which of its images.
        folder: where `evaluate` wrote. An image from before it kept pictures has thumbnails, which take their place.

    Returns:
        Method, or "truth", to a file's bytes; empty where the folder holds nothing.
    """
    stem = folder / IMAGES / stem_of(index, run.records[index].name)
    files = {name: stem.with_name(stem.name + picture_suffix(name)) for name in columns(run)}
    if all(file.is_file() for file in files.values()):
        return {name: file.read_bytes() for name, file in files.items()}
    try:
        with Image.open(stem.with_name(stem.name + ".png")) as image:
            parts = cut(image.convert("RGB"), columns(run))
    except OSError:  # deleted, or moved away from its results
        return {}
    return {name: encode(part) for name, part in parts.items()}


def source_of(run: Run, folder: Path, versions: Mapping[str, Any], machine: Mapping[str, Any]) -> Source:
    """An evaluation for a report."""
    return Source(run, lambda index: load_pictures(run, index, folder), versions, machine)


def load_source(folder: Path) -> Source:
    """A finished evaluation for a report.

    Raises:
        InputError: there is none.
    """
    run = load_run(folder)
    about = read_json(folder / RESULTS).get("versions", {})
    times = read_json(folder / TIMES) if (folder / TIMES).is_file() else {}
    return source_of(run, folder, about, times.get("hardware", {}))


def find_bench(folders: Sequence[Path]) -> dict[str, Any] | None:
    """What `spackle bench` wrote into the first of the folders that has it."""
    found = next((folder / BENCH for folder in folders if (folder / BENCH).is_file()), None)
    content = None if found is None else read_json(found)
    return content if isinstance(content, dict) else None


def write_report(sources: Sequence[Source], bench: Mapping[str, Any] | None, output: Path) -> None:
    """report.html."""
    tables = make_tables([source.run for source in sources])
    write_text(make_report(sources, tables, bench), output / REPORT)
